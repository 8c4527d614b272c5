"""A recording as the fit sees it: rows of measured partials, their weights, and the cells of its spectrum."""

from __future__ import annotations

from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np

from ..analysis import Analysis, Partials
from ..criterion import band_of, measure, partial_frequency, path_basis
from ..initial import Start
from ..model.response import LEVEL_DECAY, level_db
from ..parameters import Geometry
from ..recording import Recording
from .residuals import Lines, Target
from .space import Space

__all__ = ["Measured", "Spreads", "REPORT_SIGMA", "level_variance", "level_weights", "lines", "measured", "pad", "path_design", "target"]

# Rows come in whole multiples of this, so that notes share compiled programs.
ROWS = 64
# The energy where a silent partial would be bounds it only roughly: other sounds are there too.
SILENT_DB = 3.0
# A band whose criterion is 1, as for silence, costs half this much in the last stage.
CRITERION = 100.0
# The criterion is weighed and reported with lines this wide, σ in 1/s.
REPORT_SIGMA = 30.0
CENT = np.log(2) / 1200


@dataclass(frozen=True)
class Measured:
    """The partials in the pickup's own unit (full scale where uncalibrated), levels in dB."""

    partials: Partials
    level: np.ndarray  # dB, [partials]
    floor: np.ndarray  # dB, energy of the noise in a partial's band, [partials]
    calibrated: bool
    occupied: tuple[int, ...]  # bands (0 to 2) with a partial above the noise
    silent: np.ndarray  # int [silent], numbers k below the last for which no partial was found
    silent_frequency: np.ndarray  # Hz, where they would be
    silent_level: np.ndarray  # dB: all the energy there is at that place

    @property
    def frequency(self) -> np.ndarray:
        """Hz, of the partials and then of the silent ones [rows]."""
        return np.concatenate([self.partials.frequency, self.silent_frequency])


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
    # A partial's energy stands `snr` dB above that of the noise it was read through.
    floor = p.level - np.maximum(p.snr, 0.0)
    occupied = tuple(int(b) for b in np.unique(band_of(p.number)))
    silent = np.setdiff1d(np.arange(1, p.number.max() + 1), p.number)
    return Measured(
        p, p.level + unit, floor + unit, start.scale is not None, occupied,
        silent, partial_frequency(silent, analysis.f0, analysis.B), _bound(recording, analysis, silent) + unit,
    )  # fmt: skip


def _bound(recording: Recording, analysis: Analysis, silent: np.ndarray) -> np.ndarray:
    """Level that a partial would have which held all the energy of its cell, dB [silent]: none can be louder.

    A line |A/2|²/((σ + α)² + (2πf)²) holds |A|²/(8 (σ + α)) over all frequencies.
    """
    last = int(analysis.partials.number.max())
    samples = recording.samples[recording.onset :]
    cells, energy = measure(samples, recording.rate, analysis.f0, analysis.B, last, REPORT_SIGMA)
    decay = float(np.median(analysis.partials.decay))
    amplitude2 = 8 * (REPORT_SIGMA + decay) * (energy.sum(axis=1) * cells.spacing)[silent - 1]
    return np.asarray(level_db(np.sqrt(amplitude2), decay))


def pad(x: np.ndarray, fill: float = 0.0) -> np.ndarray:
    """`x` [partials] filled up to a whole number of `ROWS`."""
    return np.pad(np.asarray(x, float), (0, -len(x) % ROWS), constant_values=fill)


def path_design(data: Measured) -> tuple[np.ndarray, np.ndarray]:
    """Gain and path as columns [rows, 1 + terms] over partials and silent ones, and the terms' standard deviations."""
    basis, sd = path_basis(data.frequency)
    basis = np.column_stack([np.ones(len(basis)), basis])
    return basis, sd


def _projector(data: Measured, start: Start, weight: np.ndarray) -> np.ndarray:
    """Orthonormal columns of the weighted gain and path, over padded rows; none for a calibrated recording."""
    basis, sd = path_design(data)
    rows = len(pad(data.frequency))
    columns = np.zeros((rows + len(sd), 1 + len(sd)))
    if data.calibrated:
        return columns
    columns[: len(weight)] = weight[:, None] * basis
    columns[rows:, 1:] = np.diag(1 / sd)
    if start.quantity != "pressure":  # a known pickup: only its gain is unknown
        columns[:, 1:] = 0.0
        columns[:, 0] /= np.linalg.norm(columns[:, 0])
        return columns
    return np.linalg.qr(columns)[0]


def level_weights(data: Measured, spread: Spreads, robust: np.ndarray) -> np.ndarray:
    """1/dB: from noise, scatter, how far each partial fell out of line, and its share of the paper's criterion.

    Where the model misses partials by decibels, noise no longer says which of them matter; the criterion does. To first
    order it counts a level error of d dB in a band as (d ln10/10)² times the partial's share of ∫ |S|⁴.
    """
    own = robust**2 / (data.partials.level_error**2 + spread.level**2)
    return np.sqrt(own + CRITERION * (np.log(10) / 10) ** 2 * _shares(data))


def level_variance(data: Measured, spread: Spreads, robust: np.ndarray) -> np.ndarray:
    """Variance [partials] that a level residual has after weighting: 1 where noise and scatter alone set the weight."""
    sd = np.hypot(data.partials.level_error, spread.level)
    return (level_weights(data, spread, robust) * sd) ** 2


def _shares(data: Measured) -> np.ndarray:
    """Share of each partial's line in its band's ∫ |S|⁴ [partials]: |A|⁴/(σ + α)³ with |A|² from the level."""
    p = data.partials
    relative = 10 ** ((data.level - data.level.max()) / 10)
    line = (relative * (p.decay + LEVEL_DECAY)) ** 2 / (p.decay + REPORT_SIGMA) ** 3
    band = band_of(p.number)
    return line / np.bincount(band, line, minlength=3)[band]


def target(
    data: Measured, start: Start, space: Space, spread: Spreads, robust, shift, *, rate: float, delay: float,
    grade: float = 0.0,
) -> Target:
    """Everything the residuals need.

    Parameters
    ----------
    robust : three factors [3, partials] ≤ 1 on the weights of frequency, decay and level.
    shift : dB [rows], gain and path as known so far: what the noise, measured behind them, is worth before them.
    grade : level weights go with energy to this power; 0 counts all partials' decibels alike, which has many false
        minima, and ½ their amplitudes, which has few.
    """
    p, silent = data.partials, np.zeros(len(data.silent))
    weight = np.concatenate([level_weights(data, spread, robust[2]), silent + 1 / np.hypot(spread.level, SILENT_DB)])
    loud = 10 ** (np.concatenate([data.level, data.silent_level]) * (grade / 10))
    weight = weight * loud / np.sqrt(np.mean(loud**2))
    sd_frequency = np.hypot(p.frequency_error, p.frequency * spread.frequency * CENT)
    sd_decay = np.hypot(p.decay_error, p.decay * spread.decay)
    number = np.concatenate([p.number, data.silent])
    hammer_band = max(data.occupied)  # band 3, or the next occupied one below
    prior = np.where(np.isfinite(space.spread), 1 / space.spread, 0.0) * space.free
    arrays = Target(
        row=pad(number - 1).astype(np.int32),
        frequency=pad(data.frequency),
        decay=pad(np.concatenate([p.decay, silent + np.median(p.decay)]), 1.0),
        level=pad(np.concatenate([data.level, data.silent_level])),
        floor=pad(np.concatenate([data.floor, data.silent_level]) - shift, -300.0),
        frequency_weight=pad(np.concatenate([robust[0] / sd_frequency, silent])),
        decay_weight=pad(np.concatenate([robust[1] / sd_decay, silent])),
        level_weight=pad(weight),
        energy_weight=pad(band_of(number) == hammer_band),
        scale=1.0,
        projector=_projector(data, start, weight),
        start=space.z(space.start[None])[0],
        prior_weight=prior,
        log_u=space.log_u,
        delay=delay,
        geometry=Geometry(*map(np.float64, start.geometry)),
        rate=rate,
    )
    return Target(*(Geometry(*map(jnp.asarray, a)) if isinstance(a, Geometry) else jnp.asarray(a) for a in arrays))


def lines(recording: Recording, analysis: Analysis, data: Measured, band: int, sigma: float, start: Start, rate: float):
    """The cells of one band's partials, weighted so that the sum of squares is the paper's criterion on that band."""
    rows = np.arange(9) if band < 2 else np.arange(9, 9 + ROWS)
    chosen = np.isin(rows, data.partials.number[band_of(data.partials.number) == band] - 1)
    samples = recording.samples[recording.onset :]
    cells, energy = measure(samples, recording.rate, analysis.f0, analysis.B, int(rows[-1]) + 1, sigma)
    energy, spacing = energy[rows], cells.spacing[rows]
    total = (spacing[chosen, None] * energy[chosen] ** 2).sum()
    weight = np.where(chosen, np.sqrt(spacing / total), 0.0)
    return Lines(
        *(jnp.asarray(x) for x in (cells.frequency[rows], energy, weight, sigma)),
        Geometry(*map(jnp.asarray, map(np.float64, start.geometry))),
        jnp.asarray(float(rate)),
    )
