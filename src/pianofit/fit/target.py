"""A recording as the fit sees it: rows of measured partials, their weights, and the cells of its spectrum."""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

from ..analysis import TRUSTED, Analysis, Partials
from ..criterion import band_of, line_sigma, measure, partial_frequency, path_basis
from ..initial import Start
from ..model.response import LEVEL_DECAY, level_db
from ..parameters import Geometry
from ..recording import Recording
from .residuals import Lines, Target
from .space import Space

__all__ = ["CENT", "ROWS", "Measured", "Spreads", "doubt", "lines", "measured", "pad", "target"]

# Rows come in whole multiples of this, so that notes share compiled programs.
ROWS = 64
# The energy where a silent partial would be bounds it only roughly: other sounds are there too.
SILENT_DB = 3.0
# Levels that scatter more than this, dB, weigh no less: else what is badly fitted would be fitted ever worse.
MOST_SCATTER = 5.0
CENT = np.log(2) / 1200


@dataclass(frozen=True)
class Measured:
    """The partials in the pickup's own unit (full scale where uncalibrated), levels in dB.

    [rows] are first the partials that were found, then the silent ones: numbers below the last without one.
    """

    partials: Partials
    calibrated: bool
    occupied: tuple[int, ...]  # bands (0 to 2) with a partial above the noise
    number: np.ndarray  # int [rows], k
    frequency: np.ndarray  # Hz, [rows]
    level: np.ndarray  # dB, [rows]; of a silent one, all the energy there is at its place
    floor: np.ndarray  # dB, energy of the noise in a partial's band, [rows]
    line: np.ndarray  # dB, the level that eq. 19 likes best, [rows]
    sigma: float  # 1/s, of that eq. 19

    @property
    def found(self) -> int:
        """How many of the rows were found."""
        return len(self.partials)


@dataclass(frozen=True)
class Spreads:
    """How far real partials scatter about any such model, beyond their noise: one number a kind."""

    frequency: float  # cents
    decay: float  # relative
    level: float  # dB


def measured(recording: Recording, analysis: Analysis, start: Start) -> Measured:
    """The analysis in the unit in which the model is to be compared with it."""
    unit = 0.0 if start.scale is None else 20 * np.log10(start.scale)
    p = analysis.partials
    silent = np.setdiff1d(np.arange(1, p.number.max() + 1), p.number)
    sigma = line_sigma(analysis.f0)
    line, bound = _lines_of(recording, analysis, sigma)
    # A partial's energy stands `snr` dB above that of the noise it was read through.
    floor = np.append(p.level - np.maximum(p.snr, 0.0), bound[silent - 1])
    number = np.append(p.number, silent)
    return Measured(
        partials=p,
        calibrated=start.scale is not None,
        occupied=tuple(int(b) for b in np.unique(band_of(p.number))),
        number=number,
        frequency=np.append(p.frequency, partial_frequency(silent, analysis.f0, analysis.B)),
        level=np.append(p.level, bound[silent - 1]) + unit,
        floor=floor + unit,
        line=np.append(line[p.number - 1], bound[silent - 1]) + unit,
        sigma=sigma,
    )


def _lines_of(recording: Recording, analysis: Analysis, sigma: float) -> tuple[np.ndarray, np.ndarray]:
    """Two levels, dB, for k = 1 to the last: of the line that fits each cell best, and of all that is in the cell.

    A partial |A| is the line |A/2|²/((σ + α)² + (2πf)²), which over all frequencies holds |A|²/(8 (σ + α)).
    """
    last = int(analysis.partials.number.max())
    samples = recording.samples[recording.onset :]
    cells, energy = measure(samples, recording.rate, analysis.f0, analysis.B, last, sigma)
    k = np.arange(1, last + 1)
    decay = analysis.b1 + analysis.d2 * k**2
    centre = partial_frequency(k, analysis.f0, analysis.B)
    line = 0.25 / ((sigma + decay)[:, None] ** 2 + (2 * np.pi * (cells.frequency - centre[:, None])) ** 2)
    best = (energy * line).sum(axis=1) / (line**2).sum(axis=1)
    full = 8 * (sigma + decay) * energy.sum(axis=1) * cells.spacing
    return np.asarray(level_db(np.sqrt(best), decay, np)), np.asarray(level_db(np.sqrt(full), decay, np))


def pad(x: np.ndarray, fill: float = 0.0) -> np.ndarray:
    """`x` [partials] filled up to a whole number of `ROWS`."""
    return np.pad(np.asarray(x, float), (0, -len(x) % ROWS), constant_values=fill)


def _basis(data: Measured, start: Start) -> np.ndarray:
    """Gain and path as columns over the rows [rows, 1 + terms]: none, the gain alone, or both."""
    basis = np.column_stack([np.ones(len(data.frequency)), path_basis(data.frequency)])
    if data.calibrated:
        return 0 * basis
    return basis if start.quantity == "pressure" else basis * (np.arange(basis.shape[1]) == 0)


def _shares(data: Measured) -> np.ndarray:
    """Root of each line's share in its band's ∫ |S|⁴ [rows]: a line's ∫ is ∝ |A|⁴/(σ + α)³, |A|² from the level."""
    decay = np.append(data.partials.decay, np.full(len(data.number) - data.found, np.median(data.partials.decay)))
    line = 10 ** ((data.line - data.line.max()) / 10) * (decay + LEVEL_DECAY) / (decay + data.sigma) ** 1.5
    band = band_of(data.number)
    return line / np.sqrt(np.bincount(band, line**2, minlength=3))[band]


def doubt(number: np.ndarray) -> np.ndarray:
    """Factor on the scatter of frequencies [partials]: windings and shear bend high partials away from the law."""
    return np.sqrt(1 + (number / TRUSTED) ** 2)


def _level_weight(data: Measured, spread: Spreads, robust: np.ndarray, grade: float) -> np.ndarray:
    """1/dB [rows]: from noise, scatter, and how far each partial fell out of line."""
    silent = len(data.number) - data.found
    scatter = min(spread.level, MOST_SCATTER)
    own = robust / np.hypot(data.partials.level_error, scatter)
    weight = np.append(own, np.full(silent, 1 / np.hypot(scatter, SILENT_DB)))
    loud = 10 ** ((data.level - data.level.max()) * (grade / 10))
    return weight * loud / np.sqrt(np.mean(loud**2))


def target(
    data: Measured, start: Start, space: Space, spread: Spreads, robust: np.ndarray, *, rate: float, delay: float,
    grade: float = 0.0, criterion: float = 0.0,
) -> Target:  # fmt: skip
    """Everything the residuals need.

    Parameters
    ----------
    robust : three factors [3, partials] ≤ 1 on the weights of frequency, decay and level.
    grade : level weights go with energy to this power; 0 counts all partials' decibels alike, which has many false
        minima, and ½ their amplitudes, which has few.
    criterion : a band whose eq. 19 is 1, as for silence, costs half this much.
    """
    fields = _observed(data) | _weights(data, spread, robust, grade, criterion) | {
        "by_energy": 0.0,
        "basis": np.pad(_basis(data, start), ((0, -len(data.number) % ROWS), (0, 0))),
        "start": space.z(space.start),
        "prior_weight": np.where(np.isfinite(space.spread), 1 / space.spread, 0.0) * space.free,
        "log_u": space.log_u,
        "delay": delay,
        "geometry": Geometry(*map(np.float64, start.geometry)),
        "rate": rate,
    }  # fmt: skip
    return Target(**jax.tree.map(jnp.asarray, fields))


def _observed(data: Measured) -> dict[str, np.ndarray]:
    """The partials as `Target` holds them, padded."""
    p, silent = data.partials, len(data.number) - data.found
    return {
        "row": pad(data.number - 1).astype(np.int32),
        "frequency": pad(data.frequency),
        "decay": pad(np.append(p.decay, np.full(silent, np.median(p.decay))), 1.0),
        "level": pad(data.level),
        "floor": pad(data.floor, -300.0),
        "line": pad(data.line),
    }


def _weights(
    data: Measured, spread: Spreads, robust: np.ndarray, grade: float, criterion: float
) -> dict[str, np.ndarray]:
    """The weights of `Target`, padded; a silent partial has a level alone."""
    p, none = data.partials, np.zeros(len(data.number) - data.found)
    sd_frequency = np.hypot(p.frequency_error, p.frequency * CENT * spread.frequency * doubt(p.number))
    sd_decay = np.hypot(p.decay_error, p.decay * spread.decay)
    share, band = _shares(data), band_of(data.number)
    hammer_band = max(data.occupied)  # band 3, or the next occupied one below
    return {
        "frequency_weight": pad(np.append(robust[0] / sd_frequency, none)),
        "decay_weight": pad(np.append(robust[1] / sd_decay, none)),
        "level_weight": pad(_level_weight(data, spread, robust[2], grade)),
        "line_weight": pad(np.sqrt(criterion) * share * np.isin(band, data.occupied)),
        "hammer_line": pad(share * (band == hammer_band)),
    }


def lines(
    recording: Recording, analysis: Analysis, data: Measured, band: int, sigma: float, start: Start, rate: float
) -> Lines:
    """The cells of one band's partials, weighted so that the sum of squares is the paper's criterion on that band."""
    rows = np.arange(9) if band < 2 else np.arange(9, 9 + ROWS)
    chosen = np.isin(rows, data.partials.number[band_of(data.partials.number) == band] - 1)
    samples = recording.samples[recording.onset :]
    cells, energy = measure(samples, recording.rate, analysis.f0, analysis.B, int(rows[-1]) + 1, sigma)
    energy, spacing = energy[rows], cells.spacing[rows]
    total = (spacing[chosen, None] * energy[chosen] ** 2).sum()
    weight = np.where(chosen, np.sqrt(spacing / total), 0.0)
    geometry = Geometry(*map(np.float64, start.geometry))
    return Lines(*jax.tree.map(jnp.asarray, (cells.frequency[rows], energy, weight, sigma, geometry, float(rate))))
