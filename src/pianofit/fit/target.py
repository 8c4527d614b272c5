"""Recordings as the fit sees them: rows of measured partials, their weights, and the cells of a spectrum."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np

from ..analysis import TRUSTED, Analysis, Partials
from ..criterion import band_of, line_sigma, measure, partial_frequency, path_basis
from ..initial import Start
from ..model.response import LEVEL_DECAY, level_db
from ..parameters import Geometry
from ..recording import Recording
from .residuals import CENT, Lines, Target
from .space import Layout, Space

__all__ = [
    "CENT",
    "ROWS",
    "Measured",
    "Spreads",
    "Takes",
    "buried",
    "lines",
    "measured",
    "measured_alike",
    "side_by_side",
    "straying",
    "target",
]

# Rows come in whole multiples of this, so that notes share compiled programs.
ROWS = 64
# The energy where a silent partial would be bounds it only roughly: other sounds are there too.
SILENT_DB = 3.0
# Levels that scatter more than this, dB, weigh no less: else what is badly fitted would be fitted ever worse.
MOST_SCATTER = 5.0
# Share of a note's partials that must beat for all to be taken to.
BEATS = 0.25
# No model's decays are right to more digits than these, relative: a blow that lasts is no free decay yet.
OFF_LAW = 1e-3
# How much of the pitch at which a gliding note begins is not known: it is carried back from later moments.
UNTOLD = 0.5
# Partials to either side that say how loud one is expected to be, and how much less reliable one below them is at most.
BESIDE, MOST_BURIED = 3, 10.0


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
    sharp: float = 0.0  # cents above its frequencies at which the note began; 0 where no glide is sure
    glide_error: float = 0.0  # cents, of all frequencies alike

    @property
    def found(self) -> int:
        """How many of the rows were found."""
        return len(self.partials)


@dataclass(frozen=True)
class Spreads:
    """How far real partials scatter about any such model, beyond their noise: one number a kind."""

    frequency: float  # cents
    decay: float  # relative
    level: float  # dB, of each take for itself
    rough: float = 0.0  # dB, of a partial in all takes of a group alike: what no smooth path explains


@dataclass(frozen=True)
class Takes:
    """The takes' partials side by side [takes, rows], k = 1 to rows; what a take has not is 0 there."""

    each: tuple[Measured, ...]
    layout: Layout
    rows: int
    found: np.ndarray  # bool
    silent: np.ndarray  # bool
    frequency: np.ndarray  # Hz
    frequency_error: np.ndarray
    decay: np.ndarray  # 1/s
    decay_error: np.ndarray
    level: np.ndarray  # dB
    level_error: np.ndarray
    way: np.ndarray  # int, in which way each level was read off
    buried: np.ndarray  # amplitude of the partials to either side over that of each, 1 if that is less
    doubt: np.ndarray  # [3, takes, rows], Hz, 1/s, dB: what of the three errors neighbouring partials share

    @property
    def number(self) -> np.ndarray:
        """k [rows]."""
        return np.arange(1, self.rows + 1)

    @property
    def calibrated(self) -> bool:
        """Whether levels are in the pickup's own unit."""
        return self.each[0].calibrated

    @property
    def occupied(self) -> tuple[int, ...]:
        """Bands with a partial above the noise in any take."""
        return tuple(sorted({b for data in self.each for b in data.occupied}))

    def spread_out(self, values: list[np.ndarray], fill: float = 0.0) -> np.ndarray:
        """One row a partial of each take's values [rows of the take] or [partials]: as [takes, rows]."""
        out = np.full((len(self.each), self.rows), fill)
        for row, data, x in zip(out, self.each, values, strict=True):
            row[data.number[: len(x)] - 1] = x
        return out


def side_by_side(each: tuple[Measured, ...], layout: Layout) -> Takes:
    """The takes on common rows, in whole multiples of `ROWS`."""
    rows = ROWS * int(np.ceil(max(data.number.max() for data in each) / ROWS))
    blank = np.zeros((len(each), rows))
    more = {"way": blank.astype(int), "buried": blank, "doubt": np.stack([blank] * 3)}
    takes = Takes(each, layout, rows, blank > 0, blank > 0, *(blank,) * 6, **more)
    ones = [np.ones(len(data.number)) for data in each]
    found = takes.spread_out([x[: d.found] for x, d in zip(ones, each, strict=True)]) > 0
    partials = [data.partials for data in each]
    # When it was struck a string that glides was a tenser one, by twice what its pitch shows, and not known as well.
    tenser = [20 * np.log10(1 + 2 * UNTOLD * abs(d.sharp) * CENT) for d in each]
    # Through a path what a beat does to a level it does in every take, and the path takes it up.
    bent = [np.hypot(x, d.partials.level_doubt) * d.calibrated for x, d in zip(tenser, each, strict=True)]
    decay_doubt = [np.hypot(p.decay_doubt, OFF_LAW * p.decay) for p in partials]
    # What one take alone scatters by is its path's roughness, in which what is faint is as sure as what is loud.
    groups = np.array(layout.groups)
    lone = (np.bincount(groups)[groups] == 1) & ~np.array([d.calibrated for d in each])
    shared = ([p.frequency_doubt for p in partials], decay_doubt, bent)
    return replace(
        takes,
        found=found,
        silent=(takes.spread_out(ones) > 0) & ~found,
        frequency=takes.spread_out([d.frequency for d in each]),
        frequency_error=takes.spread_out([p.frequency_error for p in partials]),
        decay=takes.spread_out([p.decay for p in partials]),
        decay_error=takes.spread_out([np.hypot(p.decay_error, OFF_LAW * p.decay) for p in partials]),
        level=takes.spread_out([d.level for d in each]),
        level_error=takes.spread_out([np.hypot(p.level_error, x) for p, x in zip(partials, bent, strict=True)]),
        way=takes.spread_out([p.way for p in partials]).astype(int),
        buried=np.where(lone[:, None], 1.0, takes.spread_out([buried(d.number, d.level, d.found) for d in each], 1.0)),
        doubt=np.stack([takes.spread_out(kind) for kind in shared]),
    )


def buried(number: np.ndarray, level: np.ndarray, found: int) -> np.ndarray:
    """Amplitude of the partials to either side over that of each of the first `found`, at least 1 [found].

    Where the hammer's spectrum has a zero, or the strike's place a node, little is left, and what no model has (another
    axis, another string, the window's shape) is as strong as anywhere: there levels are missed by more.

    Parameters
    ----------
    number, level : k, all from 1 to the last, and dB [rows]
    """
    by_number = np.full(number.max() + 1, np.nan)
    by_number[number] = level
    out = np.ones(found)
    for i, k in enumerate(number[:found]):
        below, above = by_number[max(k - BESIDE, 1) : k][::-1], by_number[k + 1 : k + 1 + BESIDE]
        near = min(len(below), len(above))
        if near:
            beside = 0.5 * (np.median(below[:near]) + np.median(above[:near]))
            out[i] = np.clip(10 ** ((beside - by_number[k]) / 20), 1.0, MOST_BURIED)
    return out


def measured_alike(tables: Sequence[Partials]) -> list[Partials]:
    """The takes' tables [takes] with the levels of each partial read off in one way: that of the take that beats most.

    A faint beat is seen in loud takes and not in soft ones, and in loud partials and not in soft ones. Read off in two
    ways, one and the same partial would come out as a difference between takes; and where many partials beat, the whole
    of none is one exponential, seen or not.
    """
    way = np.full(1 + max(int(table.number.max()) for table in tables), -1)
    for table in tables:
        way[table.number] = np.maximum(way[table.number], table.way)
    heard = way[way >= 0]
    way = np.maximum(way, 1 if (heard > 0).mean() > BEATS else 0)
    out = []
    for table in tables:
        which = way[table.number], np.arange(len(table))
        out.append(replace(table, level=table.levels[which], level_error=table.level_errors[which], way=which[0]))
    return out


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
        sharp=analysis.glide_start,
        glide_error=analysis.glide_error,
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


def basis(takes: Takes, start: Start) -> np.ndarray:
    """Gain and path in search coordinates [takes, rows, size], dB: none, the gain alone, or both."""
    layout = takes.layout
    out = np.zeros((layout.takes, takes.rows, layout.size))
    if takes.calibrated:
        return out
    there = takes.found | takes.silent
    row = there.any(axis=0)
    terms = np.zeros((takes.rows, layout.path.shape[1]))
    terms[row] = path_basis(takes.frequency.max(axis=0)[row])
    for take in range(layout.takes):
        out[take, :, layout.gain[take]] = 1.0
        if start.quantity == "pressure":
            out[take][:, layout.path[take]] = terms
    return out * there[..., None]


def _shares(data: Measured) -> np.ndarray:
    """Root of each line's share in its band's ∫ |S|⁴ [rows]: a line's ∫ is ∝ |A|⁴/(σ + α)³, |A|² from the level."""
    decay = np.append(data.partials.decay, np.full(len(data.number) - data.found, np.median(data.partials.decay)))
    line = 10 ** ((data.line - data.line.max()) / 10) * (decay + LEVEL_DECAY) / (decay + data.sigma) ** 1.5
    band = band_of(data.number)
    return line / np.sqrt(np.bincount(band, line**2, minlength=3))[band]


def straying(number: np.ndarray) -> np.ndarray:
    """Factor on the scatter of frequencies [partials]: windings and shear bend high partials away from the law."""
    return np.sqrt(1 + (number / TRUSTED) ** 2)


def _level_weight(takes: Takes, spread: Spreads, robust: np.ndarray, grade: float) -> np.ndarray:
    """1/dB [takes, rows]: from noise, scatter, and how far each partial fell out of line."""
    scatter = min(spread.level, MOST_SCATTER)
    weight = takes.found * robust / np.hypot(takes.level_error, scatter * takes.buried)
    weight = np.where(takes.silent, 1 / np.hypot(np.hypot(scatter, spread.rough), SILENT_DB), weight)
    there = takes.found | takes.silent
    loudest = np.where(there, takes.level, -np.inf).max(axis=1, keepdims=True)
    loud = np.where(there, 10 ** ((takes.level - loudest) * (grade / 10)), 0.0)
    return weight * loud / np.sqrt((loud**2).sum(axis=1, keepdims=True) / there.sum(axis=1, keepdims=True))


def _roughness(takes: Takes, weight: np.ndarray, rough: float) -> tuple[np.ndarray, np.ndarray]:
    """What takes of a group have in common [groups, takes, rows], and by how much it counts less [groups, rows].

    The covariance of one partial's residuals, weighted, is 1 + s² w wᵀ over a group's takes; C^(-1/2) leaves all across
    w as it is and divides what lies along w by √(1 + s² |w|²).
    """
    group = np.array(takes.layout.groups)
    mine = weight * takes.found * (group == np.arange(group.max() + 1)[:, None])[..., None]
    power = (mine**2).sum(axis=1)
    common = mine / np.sqrt(np.where(power > 0, power, 1.0))[:, None]
    return common, 1 - 1 / np.sqrt(1 + rough**2 * power)


def target(
    takes: Takes, start: Start, space: Space, spread: Spreads, robust: np.ndarray, *, rate: float, delay: np.ndarray,
    grade: float = 0.0, criterion: float = 0.0, more: np.ndarray | float = 0.0,
) -> Target:  # fmt: skip
    """Everything the residuals need.

    Parameters
    ----------
    robust : three factors [3, takes, rows] ≤ 1 on the weights of frequency, decay and level.
    delay : s, [takes], from the first touch to the recording's onset.
    grade : level weights go with energy to this power; 0 counts all partials' decibels alike, which has many false
        minima, and ½ their amplitudes, which has few.
    criterion : a band whose eq. 19 is 1, as for silence, costs half this much.
    more : dB, [takes, rows], to be added to the model's levels.
    """
    take, layout = np.arange(takes.layout.takes), takes.layout
    ratio, cents = np.zeros((2, layout.takes, layout.size))
    ratio[take, layout.ratio], cents[take, layout.cents] = 1.0, 1.0
    fields = _observed(takes) | _weights(takes, _decay_law(takes, start), spread, robust, grade, criterion) | {
        "by_energy": 0.0,
        "basis": basis(takes, start),
        "ratio": ratio,
        "cents": cents,
        "start": space.z(space.start),
        "prior_weight": np.where(np.isfinite(space.spread), 1 / space.spread, 0.0) * space.free,
        "log_u": space.log_u,
        "delay": delay,
        "geometry": Geometry(*map(np.float64, start.geometry)),
        "rate": rate,
        "more": np.broadcast_to(more, takes.level.shape),
    }  # fmt: skip
    return Target(**jax.tree.map(jnp.asarray, fields))


def _decay_law(takes: Takes, start: Start) -> np.ndarray:
    """α = b1 + b2 β² of the partials [rows], 1/s, as the analysis found it."""
    return start.values["b1"] + start.values["b2"] * (np.pi * takes.number / start.geometry.length) ** 2


def _observed(takes: Takes) -> dict[str, np.ndarray]:
    """The partials as `Target` holds them."""
    return {
        "frequency": takes.frequency,
        "decay": np.where(takes.found, takes.decay, 1.0),
        "level": takes.level,
        "floor": takes.spread_out([data.floor for data in takes.each], -300.0),
        "line": takes.spread_out([data.line for data in takes.each]),
    }


def _weights(
    takes: Takes, law: np.ndarray, spread: Spreads, robust: np.ndarray, grade: float, criterion: float
) -> dict[str, np.ndarray]:
    """The weights of `Target`; a silent partial has a level alone.

    A real string's partials leave the law in all takes alike: together they tell no more of it than one.
    """
    alike = takes.found / np.sqrt(np.maximum(takes.found.sum(axis=0), 1))
    unknown = ~takes.found  # lest it be divided by its 0
    sd_frequency = np.hypot(takes.frequency_error, takes.frequency * CENT * spread.frequency * straying(takes.number))
    # Relative to the law: relative to itself, a decay that a beat made small would be held the surest of all.
    sd_decay = np.hypot(takes.decay_error, law * spread.decay)
    band = band_of(takes.number)
    share = takes.spread_out([_shares(data) for data in takes.each])
    hammer_band = np.array([max(data.occupied) for data in takes.each])  # band 3, or the next occupied one below
    level = _level_weight(takes, spread, robust[2], grade)
    common, shrink = _roughness(takes, level, spread.rough)
    occupied = np.array([np.isin(band, data.occupied) for data in takes.each])
    return {
        "frequency_weight": alike * robust[0] / (sd_frequency + unknown),
        "decay_weight": alike * robust[1] / (sd_decay + unknown),
        "level_weight": level,
        "line_weight": np.sqrt(criterion) * share * occupied,
        "hammer_line": share * (band == hammer_band[:, None]),
        "common": common,
        "shrink": shrink,
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
