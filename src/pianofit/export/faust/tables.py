"""One key as resonators driven by a force: tables of modes, and a low-rank approximation of the forces.

A stroke of velocity v excites mode m with the amplitude A_m(v) = P_m Σ_n F_v(n) exp(-p_m n). Over all velocities the
matrix A has low effective rank. The forces are projected on its leading singular vectors. Every mode is normalised by
its own size first, so that weak partials keep their levels. With twice as many shapes as modes the projection is
exact. The smallest number of shapes that preserves the levels is used. The shapes of a knock are those of its sound.

The compile time of a Faust table depends on its number of different values: a repeated value costs a fortieth of a new
one. Large tables are therefore integers of few bits, with scales.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.signal import fftconvolve

from ...dsp.filters import resample
from ...instrument import Instrument
from ...model.modal_response import FILTER_REACH
from ...model.note import Note
from ...playback.cached_strike import StringTables, strike_string, string_tables

# Sample rate of forces, Hz.
RATE = 48_000
# MIDI velocities at which forces are tabulated.
VELOCITIES = np.arange(1, 128, 2)
# Largest number of shapes of the forces of a key. Fewer are used if partials within LOUD_DB of the loudest keep their
# levels within NEAR_DB.
SHAPES = 24
LOUD_DB = 60.0
NEAR_DB = 0.02
# Number of shapes of a knock. The remainder is 30 to 50 dB below the knock.
KNOCK_SHAPES = 4
# Bits of integers with sign: of the samples of a knock, with an error of -60 dB, ...
KNOCK_BITS = 10
# ... and of all other tables.
BITS = 16
# A mode that is this far below the loudest at every velocity is left out, dB.
FAINT_DB = 70.0
# Modes below this fraction of the largest amplitude get less weight in the choice of shapes.
FLOOR = 0.03
# Fraction of half the sample rate that resampling of forces preserves.
BAND = 0.9
# The impulse response of the output path ends at this fraction of its peak.
RESPONSE_END = 1e-5
# Bound on the growth of exp(-p t) in the gain of a mode that decays faster than the response of the path, e-folds.
MOST_GROWN = 6.0
# Zeros before and after a table, for cubic interpolation.
MARGIN = 2


class LowRankSignals(NamedTuple):
    """Low-rank approximation of the signals of all velocities: loud · Σ part · scale · shape."""

    loud: np.ndarray  # peak at each velocity, in the unit of the signal [velocities]
    part: np.ndarray  # coefficient of each shape, integer [velocities, shapes]
    scale: np.ndarray  # of part times shape [shapes]
    shape: np.ndarray  # integer [channels, shapes, samples]

    @property
    def numbers(self) -> int:
        """Number of table entries."""
        return self.loud.size + self.part.size + self.scale.size + self.shape.size


class KeyTables(NamedTuple):
    """All tables of one key."""

    pole: np.ndarray  # 1/s, complex [modes]
    pattern: np.ndarray  # file units over N s, complex [channels, modes]
    force: LowRankSignals  # N, at `RATE`, from `MARGIN` + EDGE samples before the contact
    knock: tuple[np.ndarray, np.ndarray, np.ndarray]  # file units, at `RATE`, from LEAD before contact: `_factorise`
    stroke: np.ndarray  # index of the measured stroke at each velocity, interpolated [velocities]
    velocity_gain: np.ndarray  # at the measured strokes, real and imaginary, integer [2, strokes, modes]
    velocity_gain_scale: float
    left_out: int  # number of modes that were left out

    @property
    def numbers(self) -> int:
        """Number of table entries, without the knock."""
        modes = 2 * (self.pole.size + self.pattern.size) + self.velocity_gain.size
        return modes + self.force.numbers + self.stroke.size


def tabulate_key(instrument: Instrument, midi: int, most_modes: int, channels: int) -> KeyTables:
    """Tables of a key with at most `most_modes` modes, the loudest."""
    note = instrument.note(midi, 64)
    table = string_tables(note, RATE)
    strokes = [instrument.note(midi, int(velocity)) for velocity in VELOCITIES]
    forces = []
    for stroke in strokes:
        drive, force = strike_string(table, stroke.hammer, f"key {midi}")
        force = force if note.modal_response is not None else force._replace(force=drive)
        forces.append(RATE * force.at(RATE))
    size = max(map(len, forces))
    force = np.stack([np.pad(x, (MARGIN, size - len(x) + MARGIN)) for x in forces])
    pole, pattern, measured, velocity_gain = _modes(note, table)
    excitation = force @ np.exp(-np.outer(np.arange(force.shape[1]) - FILTER_REACH - MARGIN, pole) / RATE) / RATE
    kept = _loudest(excitation, pole, pattern, most_modes)
    factors = _factorise(force[None], _basis(force, excitation[:, kept], np.linalg.norm(pattern[:, kept], axis=0)))
    velocities = [stroke.size for stroke in strokes]
    stroke_index = np.interp(np.log(velocities), np.log(measured), np.arange(len(measured)))
    own_gain = velocity_gain[:, kept]
    integers, scale = _quantise(np.stack([np.real(own_gain), np.imag(own_gain)]), BITS, (0, 1, 2))
    return KeyTables(
        pole=pole[kept],
        pattern=np.broadcast_to(pattern[:channels, kept], (channels, len(kept))),
        force=_quantise_factors(factors, BITS),
        knock=_knock(note, force, velocities, channels),
        stroke=stroke_index,
        velocity_gain=integers,
        velocity_gain_scale=float(scale.item()),
        left_out=len(pole) - len(kept),
    )


def _modes(note: Note, table: StringTables) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Poles [modes] and patterns, file units per N s [channels, modes], of the modes that sound after a stroke.

    Also return the velocities of the measured strokes, m/s [strokes], and the velocity gain at them [strokes, modes].
    """
    if note.modal_response is not None:
        response = note.modal_response.scale_gain(note.gain).at(RATE)
        pole, pattern, gain = response.pole, response.pattern, response.velocity_gain
    else:
        pole, pattern, gain = np.asarray(table.modes.pole), table.drive[None] * table.rate, None
        if table.path is not None:
            pattern = pattern * _gain(table.path, pole)
    inside = (np.imag(pole) > 0) & (np.imag(pole) < BAND * np.pi * RATE)
    velocity, factor = (np.ones(1), np.ones((1, len(pole)))) if gain is None else gain
    return pole[inside], pattern[:, inside], velocity, factor[:, inside]


def _gain(path: np.ndarray, pole: np.ndarray) -> np.ndarray:
    """Gain of the output path at the poles [modes], with bounded growth for modes that decay before its response."""
    response = path[: int(np.flatnonzero(np.abs(path) > RESPONSE_END * np.abs(path).max())[-1]) + 1]
    n = np.arange(len(response)) / RATE
    growth = np.exp(np.minimum(np.outer(-np.real(pole), n), MOST_GROWN))
    return (growth * np.exp(-1j * np.outer(np.imag(pole), n))) @ response


def _loudest(excitation: np.ndarray, pole: np.ndarray, pattern: np.ndarray, most: int) -> np.ndarray:
    """Indices of the modes to keep [kept], by their largest share of the energy over all velocities."""
    energy = np.abs(excitation) ** 2 * np.sum(np.abs(pattern) ** 2, axis=0) / (-2 * np.real(pole))
    share = np.max(energy / np.maximum(energy.max(axis=1, keepdims=True), 1e-300), axis=0)
    order = np.argsort(-share)[:most]
    return np.sort(order[share[order] > 10 ** (-FAINT_DB / 10)])


def _basis(force: np.ndarray, excitation: np.ndarray, mode_gain: np.ndarray) -> np.ndarray:
    """Orthonormal basis over velocities [velocities, shapes] for forces [velocities, samples], after normalisation.

    `excitation` is the amplitude that the forces leave in the modes, complex [velocities, modes]. `mode_gain` is the
    size of the pattern of a mode [modes].
    """
    excitation = excitation / np.abs(force).max(axis=1, keepdims=True)
    size = np.sqrt(np.mean(np.abs(excitation) ** 2, axis=0))
    normalised = excitation / (size + FLOOR * size.max())
    u, _, _ = np.linalg.svd(np.concatenate([np.real(normalised), np.imag(normalised)], axis=1), full_matrices=False)
    level = np.abs(excitation) * mode_gain
    strong = level > level.max(axis=1, keepdims=True) * 10 ** (-LOUD_DB / 20)
    rank = next((n for n in range(1, SHAPES) if _keeps_levels(excitation, u[:, :n], strong)), SHAPES)
    return u[:, :rank]


def _keeps_levels(excitation: np.ndarray, u: np.ndarray, strong: np.ndarray) -> bool:
    """Return whether the projection on `u` preserves the levels of the strong modes."""
    ratio = np.abs((u @ (u.T @ excitation))[strong]) / np.abs(excitation[strong])
    return bool((np.abs(np.log10(np.maximum(ratio, 1e-9))) < NEAR_DB / 20).all())


def _factorise(signals: np.ndarray, u: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Factors of signals [channels, velocities, samples]: peaks [velocities], u, shapes [channels, shapes, samples]."""
    loud = np.maximum(np.abs(signals).max(axis=(0, 2)), 1e-30)
    return loud, u, np.einsum("vs,cvn->csn", u, signals / loud[:, None])


def _quantise_factors(factors: tuple[np.ndarray, np.ndarray, np.ndarray], bits: int) -> LowRankSignals:
    """Round factors to integers, with `bits` bits for the shapes."""
    loud, u, shape = factors
    part, part_scale = _quantise(u, BITS, (0,))
    integers, scale = _quantise(shape, bits, (0, 2))
    return LowRankSignals(loud, part, part_scale.ravel() * scale.ravel(), integers)


def _quantise(values: np.ndarray, bits: int, axes: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Round to integers of `bits` bits; also return their scale, which is constant along `axes`."""
    most = np.abs(values).max(axis=axes, keepdims=True, initial=0.0)
    scale = np.where(most > 0, most, 1.0) / (2 ** (bits - 1) - 1)
    return np.round(values / scale).astype(int), scale


def _knock(
    note: Note, force: np.ndarray, velocities: Sequence[float], channels: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Knock at all velocities as factors; see `_factorise`."""
    if note.modal_response is None or not note.modal_response.knock.size:
        return np.ones(len(force)), np.zeros((len(force), KNOCK_SHAPES)), np.zeros((channels, KNOCK_SHAPES, 0))
    response = note.modal_response.scale_gain(note.gain).at(RATE)
    kernel = np.stack([response.attack_noise(v)[:channels] for v in velocities], axis=1)
    sound = fftconvolve(kernel, force[None] / RATE, axes=-1)[..., FILTER_REACH + MARGIN :]
    normalised = sound / np.sqrt(np.mean(sound**2, axis=(0, 2)))[:, None]
    _, u = np.linalg.eigh(np.einsum("cvn,cwn->vw", normalised, normalised))
    loud, u, shape = _factorise(sound, u[:, : -KNOCK_SHAPES - 1 : -1])
    return loud, u, np.broadcast_to(shape, (channels, *shape.shape[1:]))  # a single channel is copied to all


def tabulate_knock(key: KeyTables, rate: int) -> LowRankSignals:
    """Knock of a key at a rate, Hz, that divides `RATE`, with zeros at both ends."""
    loud, u, shape = key.knock
    shape = resample(shape, RATE, rate) if shape.size else shape
    return _quantise_factors((loud, u, np.pad(shape, ((0, 0), (0, 0), (MARGIN, MARGIN)))), KNOCK_BITS)
