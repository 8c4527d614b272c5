"""One key as resonators that its forces drive: modes, and the forces of all velocities as sums of a few shapes.

A stroke leaves mode m ringing with A_m(v) = P_m Σ_n F_v(n) exp(-p_m n). Over all velocities the matrix A has few
directions that matter; on those of its singular value decomposition forces are projected. Every mode counts by its own
size there, so that weak partials keep their levels. With twice as many shapes as modes the projection is exact; fewer
do, as many as keep the levels. Of a knock the shapes are those of its sound.

What Faust takes to compile a table is the time for its different numbers; one that was there costs a fortieth. So what
there is much of are whole numbers of few bits, with scales.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.signal import fftconvolve, resample_poly

from ...instrument.document import Instrument
from ...model.modal_response import EDGE
from ...model.note import Note
from ...playback.repeated_strike import StringTables, stroke, table_of

__all__ = ["MARGIN", "RATE", "VELOCITIES", "KeyTables", "LowRankSignals", "key_of", "knock_at"]

# Forces are sampled so, Hz.
RATE = 48_000
# MIDI velocities at which they are known.
VELOCITIES = np.arange(1, 128, 2)
# Shapes of a key's forces at the most; with fewer, partials within so many dB of the loudest keep their levels, dB.
SHAPES = 24
LOUD_DB = 60.0
NEAR_DB = 0.02
# Of its knock, which is no partial: 30 to 50 dB below it is left out.
KNOCK_SHAPES = 4
# Of whole numbers, with their sign: of a knock's samples, which keep it to 60 dB, ...
KNOCK_BITS = 10
# ... and of all others.
BITS = 16
# A mode so far below the loudest, dB, at every velocity is left out.
FAINT_DB = 70.0
# A mode below this part of the key's largest counts no more for shapes, amplitude.
FLOOR = 0.03
# Of half the sample rate, what the resampling of forces leaves as it is.
BAND = 0.9
# A path's response is over where it is so far below its peak, amplitude.
OVER = 1e-5
# A mode that decays faster than the path's response would be heard through it for ever: e-folds that count at the most.
MOST_GROWN = 6.0
# Noughts before and after a table that is read by a cubic.
MARGIN = 2


class LowRankSignals(NamedTuple):
    """Signals of all velocities, loud · Σ part · scale · shape, `loud` in their own unit."""

    loud: np.ndarray  # of each velocity [velocities]
    part: np.ndarray  # of each shape in it, whole [velocities, shapes]
    scale: np.ndarray  # of part times shape [shapes]
    shape: np.ndarray  # whole [channels, shapes, samples]

    @property
    def numbers(self) -> int:
        """How many they are."""
        return self.loud.size + self.part.size + self.scale.size + self.shape.size


class KeyTables(NamedTuple):
    """The numbers of one key, from its force to the file."""

    pole: np.ndarray  # 1/s, complex [modes]
    pattern: np.ndarray  # file units over N s, complex [channels, modes]
    force: LowRankSignals  # N, at `RATE`, from `MARGIN` + EDGE samples before the touch
    knock: tuple[np.ndarray, np.ndarray, np.ndarray]  # file units, at `RATE` from LEAD before the touch: see `_parts`
    stroke: np.ndarray  # which of the strokes that are known each velocity is, or between which [velocities]
    participation: np.ndarray  # of the modes in those, real and imaginary, whole [2, strokes, modes]
    participation_scale: float
    left_out: int  # modes

    @property
    def numbers(self) -> int:
        """How many they are, without the knock."""
        modes = 2 * (self.pole.size + self.pattern.size) + self.participation.size
        return modes + self.force.numbers + self.stroke.size


def key_of(instrument: Instrument, midi: int, most_modes: int, channels: int) -> KeyTables:
    """The tables of a key, of its loudest `most_modes` modes at the most."""
    note = instrument.note(midi, 64)
    table = table_of(note, RATE)
    still = np.zeros(len(table.pole), complex)
    hammers = [instrument.note(midi, int(velocity)).hammer for velocity in VELOCITIES]
    forces = []
    for hammer in hammers:
        drive, force = stroke(table, hammer, still, f"key {midi}")
        force = force if note.ringing is not None else force._replace(newton=drive)
        forces.append(RATE * force.at(RATE))
    size = max(map(len, forces))
    force = np.stack([np.pad(x, (MARGIN, size - len(x) + MARGIN)) for x in forces])
    pole, pattern, known, participation = _modes(note, table)
    left = force @ np.exp(-np.outer(np.arange(force.shape[1]) - EDGE - MARGIN, pole) / RATE) / RATE
    kept = _loudest(left, pole, pattern, most_modes)
    parts = _parts(force[None], _directions(force, left[:, kept], np.linalg.norm(pattern[:, kept], axis=0)))
    velocities = [hammer.v_H0 for hammer in hammers]
    struck = np.interp(np.log(velocities), np.log(known), np.arange(len(known)))
    sound = np.broadcast_to(pattern[:, kept], (channels, len(kept))) if len(pattern) == 1 else pattern[:channels, kept]
    part = participation[:, kept]
    whole, scale = _whole(np.stack([np.real(part), np.imag(part)]), BITS, (0, 1, 2))
    return KeyTables(
        pole[kept], sound, _coded(parts, BITS), _knock(note, force, velocities, channels), struck, whole,
        float(scale.item()), int(len(pole) - len(kept)),
    )  # fmt: skip


def _modes(note: Note, table: StringTables) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """What rings after a stroke: poles [modes], and file units over a force's N s [channels, modes].

    And how modes take part in strokes of some velocities, m/s [strokes], beyond their force [strokes, modes].
    """
    if note.ringing is not None:
        own = note.ringing.scale_gain(note.gain).at(RATE)
        pole, pattern, part = own.pole, own.pattern, own.participation
    else:
        pole, pattern = table.pole, table.drive[None] * table.rate
        part = None
        if table.path is not None:
            pattern = pattern * _gain(table.path, pole)
    inside = (np.imag(pole) > 0) & (np.imag(pole) < BAND * np.pi * RATE)
    velocity, factor = (np.ones(1), np.ones((1, len(pole)))) if part is None else part
    return pole[inside], pattern[:, inside], velocity, factor[:, inside]


def _gain(path: np.ndarray, pole: np.ndarray) -> np.ndarray:
    """A filter's gain [modes] for what decays: that at its pole, where the response has decayed before the mode."""
    heard = path[: int(np.flatnonzero(np.abs(path) > OVER * np.abs(path).max())[-1]) + 1]
    n = np.arange(len(heard)) / RATE
    grown = np.exp(np.minimum(np.outer(-np.real(pole), n), MOST_GROWN))
    return (grown * np.exp(-1j * np.outer(np.imag(pole), n))) @ heard


def _loudest(left: np.ndarray, pole: np.ndarray, pattern: np.ndarray, most: int) -> np.ndarray:
    """Which modes to keep [kept], by their energy at the velocity where each is loudest beside the others."""
    energy = np.abs(left) ** 2 * np.sum(np.abs(pattern) ** 2, axis=0) / (-2 * np.real(pole))
    share = np.max(energy / np.maximum(energy.max(axis=1, keepdims=True), 1e-300), axis=0)
    order = np.argsort(-share)[:most]
    return np.sort(order[share[order] > 10 ** (-FAINT_DB / 10)])


def _directions(force: np.ndarray, left: np.ndarray, heard: np.ndarray) -> np.ndarray:
    """Of forces [velocities, samples], all of one size: what to project them on [velocities, shapes].

    `left` is what they leave ringing, complex [velocities, modes], and `heard` how loud a mode is [modes].
    """
    left = left / np.abs(force).max(axis=1, keepdims=True)
    size = np.sqrt(np.mean(np.abs(left) ** 2, axis=0))
    even = left / (size + FLOOR * size.max())
    u, _, _ = np.linalg.svd(np.concatenate([np.real(even), np.imag(even)], axis=1), full_matrices=False)
    level = np.abs(left) * heard
    strong = level > level.max(axis=1, keepdims=True) * 10 ** (-LOUD_DB / 20)
    rank = next((n for n in range(1, SHAPES) if _near(left, u[:, :n], strong)), SHAPES)
    return u[:, :rank]


def _near(left: np.ndarray, u: np.ndarray, strong: np.ndarray) -> bool:
    """Whether the levels of what counts are still there, projected."""
    ratio = np.abs((u @ (u.T @ left))[strong]) / np.abs(left[strong])
    return bool((np.abs(np.log10(np.maximum(ratio, 1e-9))) < NEAR_DB / 20).all())


def _parts(signals: np.ndarray, u: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Signals [channels, velocities, samples] as loud [velocities], parts u, and shapes [channels, shapes, samples]."""
    loud = np.maximum(np.abs(signals).max(axis=(0, 2)), 1e-30)
    return loud, u, np.einsum("vs,cvn->csn", u, signals / loud[:, None])


def _coded(parts: tuple[np.ndarray, np.ndarray, np.ndarray], bits: int) -> LowRankSignals:
    """In whole numbers; shapes of so many bits."""
    loud, u, shape = parts
    part, by = _whole(u, BITS, (0,))
    whole, scale = _whole(shape, bits, (0, 2))
    return LowRankSignals(loud, part, by.ravel() * scale.ravel(), whole)


def _whole(values: np.ndarray, bits: int, axes: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Whole numbers of so many bits, and what they are times, the same along some axes."""
    most = np.abs(values).max(axis=axes, keepdims=True, initial=0.0)
    scale = np.where(most > 0, most, 1.0) / (2 ** (bits - 1) - 1)
    return np.round(values / scale).astype(int), scale


def _knock(
    note: Note, force: np.ndarray, velocities: Sequence[float], channels: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """What forces of all velocities make of the knock, in shapes: see `_parts`."""
    if note.ringing is None or not note.ringing.knock.size:
        return np.ones(len(force)), np.zeros((len(force), KNOCK_SHAPES)), np.zeros((channels, KNOCK_SHAPES, 0))
    own = note.ringing.scale_gain(note.gain).at(RATE)
    kernel = np.stack([own.attack_noise(v)[:channels] for v in velocities], axis=1)
    sound = fftconvolve(kernel, force[None] / RATE, axes=-1)[..., EDGE + MARGIN :]
    even = sound / np.sqrt(np.mean(sound**2, axis=(0, 2)))[:, None]
    _, u = np.linalg.eigh(np.einsum("cvn,cwn->vw", even, even))
    loud, u, shape = _parts(sound, u[:, : -KNOCK_SHAPES - 1 : -1])
    return loud, u, np.broadcast_to(shape, (channels, *shape.shape[1:]))  # one channel is heard in all


def knock_at(key: KeyTables, rate: int) -> LowRankSignals:
    """A key's knock at a rate, Hz, that is a whole part of `RATE`, between noughts."""
    loud, u, shape = key.knock
    shape = resample_poly(shape, 1, RATE // rate, axis=-1) if shape.size else shape
    return _coded((loud, u, np.pad(shape, ((0, 0), (0, 0), (MARGIN, MARGIN)))), KNOCK_BITS)
