"""One key as resonators that its forces drive: modes, and the forces of all velocities as sums of a few shapes.

A stroke leaves mode m ringing with A_m(v) = P_m Σ_n F_v(n) exp(-p_m n). Over all velocities the matrix A has few
directions that matter; on those of its singular value decomposition forces are projected. Every mode counts by its own
size there, so that weak partials keep their levels. With twice as many shapes as modes the projection is exact.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.signal import fftconvolve, resample_poly

from ...keyboard.document import Instrument
from ...model.modal import EDGE
from ...model.note import Note
from ..contact import Table, stroke, table_of

__all__ = ["KNOCK_SHAPES", "MARGIN", "RATE", "SHAPES", "VELOCITIES", "Key", "key_of", "kept_at"]

# Forces are sampled so, Hz.
RATE = 48_000
# MIDI velocities at which they are known.
VELOCITIES = np.arange(1, 128, 2)
# Shapes of a key's forces: partials within 60 dB of the loudest then keep their levels to 0.1 dB.
SHAPES = 20
# Of its knock, which is no partial.
KNOCK_SHAPES = 6
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


class Key(NamedTuple):
    """The numbers of one key, from its force to the file."""

    pole: np.ndarray  # 1/s, complex [modes]
    pattern: np.ndarray  # file units over N s, complex [channels, modes]
    shapes: np.ndarray  # N [shapes, samples] at `RATE`, from `MARGIN` + EDGE samples before the touch
    weights: np.ndarray  # of each shape in the force of each velocity [velocities, shapes]
    knock: (
        np.ndarray
    )  # file units [channels, KNOCK_SHAPES, samples] at `knock_rate`, from LEAD before the touch; or empty
    knock_weights: np.ndarray  # [velocities, KNOCK_SHAPES]
    knock_rate: int  # Hz
    stroke: (
        np.ndarray
    )  # which of the strokes that are known each velocity is, a number between two of them [velocities]
    participation: np.ndarray  # of the modes in those, complex [strokes, modes]
    left_out: int  # modes


def key_of(instrument: Instrument, midi: int, most_modes: int, channels: int) -> Key:
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
    force = np.stack([np.pad(x, (0, size - len(x))) for x in forces])
    pole, pattern, known, participation = _modes(note, table)
    left = force @ np.exp(-np.outer(np.arange(size) - EDGE, pole) / RATE) / RATE
    kept = _loudest(left, pole, pattern, most_modes)
    weights, shapes = _shapes(force, left[:, kept])
    knock_weights, knock, rate = _knock(note, force)
    struck = np.interp(np.log([hammer.v_H0 for hammer in hammers]), np.log(known), np.arange(len(known)))
    sound = np.broadcast_to(pattern[:, kept], (channels, len(kept))) if len(pattern) == 1 else pattern[:channels, kept]
    return Key(
        pole[kept], sound, np.pad(shapes, ((0, 0), (MARGIN, MARGIN))), weights,
        np.broadcast_to(knock, (channels, *knock.shape[1:])) if len(knock) == 1 else knock[:channels],
        knock_weights, rate, struck, participation[:, kept], int(len(pole) - len(kept)),
    )  # fmt: skip


def _modes(note: Note, table: Table) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """What rings after a stroke: poles [modes], and file units over a force's N s [channels, modes].

    And how modes take part in strokes of some velocities, m/s [strokes], beyond their force [strokes, modes].
    """
    if note.ringing is not None:
        own = note.ringing.louder(note.gain).at(RATE)
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


def _shapes(force: np.ndarray, left: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Weights [velocities, SHAPES] and shapes [SHAPES, samples] of forces [velocities, samples]."""
    loud = np.abs(force).max(axis=1, keepdims=True)
    size = np.sqrt(np.mean(np.abs(left / loud) ** 2, axis=0))
    even = left / loud / (size + FLOOR * size.max())
    u, _, _ = np.linalg.svd(np.concatenate([np.real(even), np.imag(even)], axis=1), full_matrices=False)
    return _projected(force, loud, u[:, :SHAPES], SHAPES)


def _projected(force: np.ndarray, loud: np.ndarray, u: np.ndarray, rank: int) -> tuple[np.ndarray, np.ndarray]:
    u = np.pad(u, ((0, 0), (0, rank - u.shape[1])))
    return loud * u, u.T @ (force / loud)


def _knock(note: Note, force: np.ndarray) -> tuple[np.ndarray, np.ndarray, int]:
    """Weights [velocities, KNOCK_SHAPES], and what each shape of the force makes of the knock."""
    if note.ringing is None or not note.ringing.knock.size:
        return np.zeros((len(force), KNOCK_SHAPES)), np.zeros((1, KNOCK_SHAPES, 0)), RATE
    kernel = note.ringing.louder(note.gain).at(RATE).knock
    loud = np.abs(force).max(axis=1, keepdims=True)
    u, _, _ = np.linalg.svd(force / loud, full_matrices=False)
    weights, shapes = _projected(force, loud, u[:, :KNOCK_SHAPES], KNOCK_SHAPES)
    return weights, fftconvolve(kernel[:, None], shapes[None] / RATE, axes=-1)[..., EDGE:], RATE


def kept_at(key: Key, rate: int | None) -> Key:
    """The same key with its knock at another rate, Hz, a whole part of its own, between noughts; or without one."""
    if rate is None or not key.knock.size:
        return key._replace(knock=np.zeros((*key.knock.shape[:2], 2 * MARGIN)), knock_rate=rate or RATE)
    knock = resample_poly(key.knock, 1, key.knock_rate // rate, axis=-1)
    return key._replace(knock=np.pad(knock, ((0, 0), (0, 0), (MARGIN, MARGIN))), knock_rate=rate)
