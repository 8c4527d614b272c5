"""Distance of a modelled sound from a recording: the paper's energy criterion in bands, and levels of partials.

**Eq. 19**, C = ½ ∫ (|Y|² - |S|²)² dω, is divided by ½ ∫ |S|⁴ dω. It is then 0 for equal spectra and 1 for silence, in
each band and in total. Spectra are taken on the damped circle (§ `model.response`), where a truncated recording is as
good as a complete one.

**Bands.** The paper splits the spectrum after the tristimulus: the fundamental, partials two to eight, and everything
above (IV.B). Borders lie midway between inharmonic partials, at k = 0.5, 1.5 and 8.5 of f_k = k f0 √(1 + B k²). They
come from the analysis and stay fixed during a fit. Between partials there is almost no energy to compare. So each cell
extends only a number of linewidths from its partial, or to its borders.

**Levels** in dB are compared with one gain removed. The output path between string and file is in `model.output_path`.
"""

from typing import Any, NamedTuple

import numpy as np

from .analysis import law_frequency

BANDS = ("band1", "band2", "band3")
# Number of frequencies in a cell.
NODES = 48
# Half width of a cell in linewidths σ/2π. Beyond it the energy of a Lorentzian is lower by a factor of 150.
HALF_CELL_LINEWIDTHS = 12.0
# Largest σ of the criterion, 1/s, and smallest spacing of partials, in linewidths.
WIDEST_SIGMA, MIN_SPACING_LINEWIDTHS = 30.0, 16.0
# A signal of length T is truncated at σT = 14, where the damping exp(-σT) leaves 1e-6.
ENOUGH_DAMPING = 14.0


class SpectralCells(NamedTuple):
    """Frequencies at which spectra are compared on the damped circle of `sigma`, 1/s."""

    frequency: np.ndarray  # Hz, [partials, nodes]
    spacing: np.ndarray  # Hz, [partials]: the weight of each node
    sigma: float


def damping_for(f0: float) -> float:
    """σ, 1/s, for lines that tolerate errors of a few cents while the partials of `f0`, Hz, stay separate."""
    return min(WIDEST_SIGMA, 2 * np.pi * f0 / MIN_SPACING_LINEWIDTHS)


def band_borders(f0: float, B: float, last: int) -> tuple[float, ...]:
    """Band edges, Hz: below the fundamental, 1|2, 8|9, and above partial `last`."""
    k = np.array([0.5, 1.5, 8.5, max(last, 9) + 0.5])
    return tuple(law_frequency(f0, B, k).tolist())


def band_of(number: np.ndarray) -> np.ndarray:
    """Index into `BANDS` of each partial number."""
    return np.searchsorted([2, 9], number, side="right")


def cell_grid(f0: float, B: float, last: int, sigma: float, resolution: float) -> SpectralCells:
    """Cells of partials 1 to `last`, with nodes at whole multiples of `resolution`, Hz."""
    k = np.arange(1, last + 1)
    centre = law_frequency(f0, B, k)
    half = np.minimum(HALF_CELL_LINEWIDTHS * sigma / (2 * np.pi), 0.5 * f0)
    low = np.maximum(law_frequency(f0, B, k - 0.5), centre - half)
    high = np.minimum(law_frequency(f0, B, k + 0.5), centre + half)
    spacing = np.maximum(np.round((high - low) / NODES / resolution), 1) * resolution
    first = np.round((centre - spacing * (NODES - 1) / 2) / resolution) * resolution
    return SpectralCells(first[:, None] + spacing[:, None] * np.arange(NODES), spacing, sigma)


def measure(
    samples: np.ndarray, rate: float, f0: float, B: float, last: int, sigma: float
) -> tuple[SpectralCells, np.ndarray]:
    """Cells of partials 1 to `last`, and |S|² of `samples` (from the onset on) there [partials, nodes], unit² · s²."""
    n = min(len(samples), int(np.ceil(ENOUGH_DAMPING / sigma * rate)))
    # At least 16 bins for each linewidth, so that rounding a node to a bin has no effect.
    size = 2 ** int(np.ceil(np.log2(max(n, 16 * rate * 2 * np.pi / sigma))))
    cells = cell_grid(f0, B, last, sigma, rate / size)
    damped = samples[:n] * np.exp(-sigma * np.arange(n) / rate)
    spectrum = np.fft.rfft(damped, size) / rate
    index = np.clip(np.round(cells.frequency * size / rate).astype(int), 0, size // 2)
    return cells, np.abs(spectrum[index]) ** 2


def closed_form_gain(model: Any, measured: Any, weight: Any, xp: Any = np) -> Any:
    """The g² ≥ 0 that minimises Σ w (g² |Y|² - |S|²)²; `xp` is NumPy, or jax.numpy for JAX arrays."""
    best = (weight * model * measured).sum() / xp.maximum((weight * model**2).sum(), 1e-300)
    return xp.maximum(best, 0.0)


def band_values(model: np.ndarray, measured: np.ndarray, spacing: np.ndarray) -> dict[str, float]:
    """The criterion for |Y|² and |S|² [partials, nodes], over all partials (`global`) and in each occupied band."""
    difference = (spacing[:, None] * (model - measured) ** 2).sum(axis=1)
    norm = (spacing[:, None] * measured**2).sum(axis=1)
    band = band_of(np.arange(1, len(difference) + 1))
    values = {"global": float(difference.sum() / norm.sum())}
    for index, name in enumerate(BANDS):
        if (band == index).any():
            values[name] = float(difference[band == index].sum() / norm[band == index].sum())
    return values


def level_error_db(model: np.ndarray, measured: np.ndarray) -> float:
    """Rms difference of levels [partials], dB, with one gain removed."""
    difference = model - measured
    return float(np.sqrt(np.mean((difference - difference.mean()) ** 2)))
