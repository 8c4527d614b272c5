"""The paper's quadratic criterion: C = ½ ∫ (|Y|² - |S|²)² dω (eq. 19), made dimensionless.

Spectra are taken on the damped circle (§ `model.response`), where a recording that ends is as good as one that does
not. Divided by ½ ∫ |S|⁴ dω, the value is 0 for equal spectra and 1 for silence, in each band as in all of them.
"""

from __future__ import annotations

import numpy as np

from .bands import BANDS, Cells, band_of, cell_grid

__all__ = ["band_values", "closed_form_gain", "measure"]

# exp(-σT) of the signal is left where it is cut; -σT = 14 leaves 1e-6.
ENOUGH_DAMPING = 14.0


def measure(samples: np.ndarray, rate: float, f0: float, B: float, last: int, sigma: float) -> tuple[Cells, np.ndarray]:
    """|S|² of a recording that starts at its onset, at the cells of partials 1 to `last`.

    Parameters
    ----------
    samples : [samples] from the onset on.

    Returns
    -------
    The cells, and |S|² [partials, nodes], unit² · s².
    """
    n = min(len(samples), int(np.ceil(ENOUGH_DAMPING / sigma * rate)))
    # At least 16 bins to a linewidth, so that rounding a node to a bin costs nothing.
    size = 2 ** int(np.ceil(np.log2(max(n, 16 * rate * 2 * np.pi / sigma))))
    cells = cell_grid(f0, B, last, sigma, rate / size)
    damped = samples[:n] * np.exp(-sigma * np.arange(n) / rate)
    spectrum = np.fft.rfft(damped, size) / rate
    index = np.clip(np.round(cells.frequency * size / rate).astype(int), 0, size // 2)
    return cells, np.abs(spectrum[index]) ** 2


def closed_form_gain(model: np.ndarray, measured: np.ndarray, weight: np.ndarray) -> float:
    """The g² ≥ 0 that minimises Σ w (g² |Y|² - |S|²)²."""
    return float(max((weight * model * measured).sum() / max((weight * model**2).sum(), 1e-300), 0.0))


def band_values(model: np.ndarray, measured: np.ndarray, spacing: np.ndarray) -> dict[str, float]:
    """The criterion of |Y|² against |S|² [partials, nodes] over all partials, `global`, and in each band with any."""
    miss = (spacing[:, None] * (model - measured) ** 2).sum(axis=1)
    full = (spacing[:, None] * measured**2).sum(axis=1)
    band = band_of(np.arange(1, len(miss) + 1))
    values = {"global": float(miss.sum() / full.sum())}
    for index, name in enumerate(BANDS):
        if (band == index).any():
            values[name] = float(miss[band == index].sum() / full[band == index].sum())
    return values
