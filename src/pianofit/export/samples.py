"""The samples of a key: what each stroke sounds like, where each begins, and how loud the key is over velocity."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy.interpolate import PchipInterpolator

from ..instrument.document import Instrument
from ..model.note import arrival
from ..playback.voice import CHANNELS, StringVoice
from .layers import LOUDEST, SOFTEST, Zone, crossfaded, velocities_of

__all__ = ["LEVEL_SECONDS", "KeySamples", "measure_layers", "sample", "stroke"]

# A sample ends when it is this far below its peak, dB, or after the seconds asked for, with a fade of this part of it.
SILENT_DB = 110.0
FADE = 0.05
# A sample begins just before it first reaches this level below its peak, dB: stiff strings send their treble ahead.
BEGINS_DB = 80.0
# How many samples before.
BEFORE = 16
# Level, correlation and peak of a note are those of so long a part from its begin, s: the loudest moment lies in it.
LEVEL_SECONDS = 1.0
# The level is measured at so many velocities, and those of the layers. Between them it is smooth, but in the treble,
# where the force's spectrum has its first nought, it is no power law.
LEVELS = 22
# How far a stroke may be moved against the next louder one, s: a softer hammer stays longer, and its force's middle
# comes later. More than neighbouring layers of any key need (0.4 ms).
FARTHEST_MOVE = 1e-3


class KeySamples(NamedTuple):
    """What is known of a key before its samples are written."""

    zones: list[Zone]
    begin: list[int]  # sample of `stroke` at which each zone's begins; negative where silence comes first
    peak: float  # of the loudest, file units


def measure_layers(
    instrument: Instrument, string: StringVoice, velocities: Sequence[int], seconds: float
) -> KeySamples:
    """Strike a key at all velocities of its layers, and more to know its level."""
    tried = sorted({*velocities, *velocities_of(LEVELS)})
    sounds = {velocity: stroke(instrument, string, velocity, min(seconds, LEVEL_SECONDS)) for velocity in tried}
    level_db = [10 * np.log10(max(np.mean(sound**2, axis=-1).sum(), 1e-30)) for sound in sounds.values()]
    layers = [sounds[velocity] for velocity in velocities]
    moves, alike = _aligned(layers, max(round(FARTHEST_MOVE * string.rate), 1))
    first = [0 if string.lead else max(int(np.argmax(_above(sound, BEGINS_DB))) - BEFORE, 0) for sound in layers]
    begin = min(f - move for f, move in zip(first, moves, strict=True))
    # Not extrapolated: below the softest stroke is as loud as it.
    curve = PchipInterpolator(tried, level_db)(np.clip(np.arange(LOUDEST + 1), SOFTEST, LOUDEST))
    peak = max(float(np.abs(sound).max()) for sound in layers)
    return KeySamples(crossfaded(velocities, curve, alike), [begin + move for move in moves], peak)


def sample(instrument: Instrument, string: StringVoice, velocity: int, begin: int, seconds: float) -> np.ndarray:
    """A stroke [channels, samples] from the sample `begin` on, faded out."""
    sound = stroke(instrument, string, velocity, seconds + max(begin, 0) / string.rate)
    sound = np.pad(sound[:, max(begin, 0) :], ((0, 0), (max(-begin, 0), 0)))
    return _faded(sound[:, : round(seconds * string.rate)], string.rate)


def stroke(instrument: Instrument, string: StringVoice, velocity: int, seconds: float) -> np.ndarray:
    """One stroke on the string at rest [channels, samples], from its contact on, or a knock's begin before it."""
    note = instrument.note(string.midi, velocity)
    string.reset()
    # The way to the pickup comes on top.
    samples = round((seconds + arrival(note.string, note.geometry, note.quantity)) * string.rate)
    head = string.strike(note.hammer.v_H0)
    sound = np.concatenate([head, string.ring(max(samples - head.shape[-1], 0))], axis=-1)
    return string.heard(sound)[:CHANNELS, :samples]


def _above(sound: np.ndarray, below_db: float) -> np.ndarray:
    """Where a sound [channels, samples] is less than so far below its peak [samples]."""
    level = np.abs(sound).max(axis=0)
    return level > level.max() * 10 ** (-below_db / 20)


def _aligned(layers: Sequence[np.ndarray], farthest: int) -> tuple[list[int], list[float]]:
    """By how many samples each layer is late, the loudest by none, and its correlation with the next louder one."""
    moves, alike = [0], []
    for soft, loud in reversed(list(pairwise(layers))):
        size = soft.shape[-1]
        spectra = [np.fft.rfft(x, 2 * size) for x in (soft, loud)]
        cross = np.fft.irfft((spectra[0] * spectra[1].conj()).sum(axis=0))
        near = np.arange(-farthest, farthest + 1)
        best = int(near[np.argmax(cross[near])])
        alike.append(max(float(cross[best] / np.sqrt(np.sum(soft**2) * np.sum(loud**2))), 0.0))
        moves.append(moves[-1] + best)
    return moves[::-1], alike[::-1]


def _faded(sound: np.ndarray, rate: int) -> np.ndarray:
    """Cut where it has become silent, and faded out to its end."""
    loud = np.flatnonzero(_above(sound, SILENT_DB))
    sound = sound[:, : max(int(loud[-1]) + 1 if loud.size else 1, rate // 20)].copy()
    fade = max(int(FADE * sound.shape[-1]), 2)
    sound[:, -fade:] *= 0.5 * (1 + np.cos(np.pi * np.arange(1, fade + 1) / fade))
    return sound
