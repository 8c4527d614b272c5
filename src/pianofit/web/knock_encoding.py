"""Encodings of knocks and release noises: every sound as small as one common error allows.

A page has room for a certain number of bytes. The attack noise of a bass key lies mostly below 2 kHz, because a long
contact excites nothing above. That of a treble key reaches 10 kHz, and is short. So one sample rate for all keys would
waste room or lose attacks. Here all sounds get the same error relative to the note, the smallest for which all fit.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ..dsp.filters import resample
from ..model.modal_response import ForcePulse, ModalResponse
from ..playback.voice import CHANNELS, KNOCK_RATES

# Samples of a knock that share a scale.
SCALE_BLOCK = 256
# Part of half the sample rate that the filter of the resampling keeps.
PASS_BAND = 0.9
# Errors that are tried, dB relative to the energy of the note.
ERRORS_DB = np.arange(-90.0, -9.0)
# Span of the note to whose energy an error is compared, s: an attack.
ATTACK_SECONDS = 0.3


class KnockEncoding(NamedTuple):
    """Encoding of a sound."""

    rate: float  # highest sample rate, Hz
    bits: int  # 8 or 16, of the largest sample within `SCALE_BLOCK`


# The best encoding, and the others from the smallest on. The rate of a knock is never raised.
BEST = KnockEncoding(math.inf, 16)
ENCODINGS = (*(KnockEncoding(rate, 8) for rate in reversed(KNOCK_RATES)), KnockEncoding(math.inf, 8), BEST)


class EncodedSize(NamedTuple):
    """Characters and errors of a sound in every encoding of `ENCODINGS`."""

    characters: np.ndarray  # of base64 [encodings]
    error_db: np.ndarray  # relative to the energy of the note, dB [encodings]


def knock_sizes(response: ModalResponse, force: ForcePulse) -> EncodedSize:
    """Return characters and errors of a knock, as a stroke of this force makes it sound."""
    count = round(ATTACK_SECONDS * response.rate)
    note = response.sound(force, response.rate, count)[:CHANNELS]
    return sound_sizes(response.knock[:CHANNELS], response.rate, force.at(response.rate), float((note**2).sum()))


def sound_sizes(sound: np.ndarray, rate: int, pulse: np.ndarray, energy: float) -> EncodedSize:
    """Return characters and errors of a sound.

    Parameters
    ----------
    sound : response to a unit impulse [channels, samples].
    rate : its sample rate, Hz.
    pulse : what it is convolved with [samples].
    energy : energy of the note, the sum of squares of samples at `rate`.
    """
    size = sound.shape[-1] + len(pulse)
    filtered = np.abs(np.fft.rfft(pulse, size)) ** 2
    # Energy of the filtered sound by bins, and the sum from each bin to the highest.
    spectrum = 2 * filtered * (np.abs(np.fft.rfft(sound, size)) ** 2).sum(axis=0) / size
    above = np.append(np.cumsum(spectrum[::-1])[::-1], 0.0)
    characters, errors = [], []
    for encoding in ENCODINGS:
        reduced = min(encoding.rate, rate)
        samples = math.ceil(sound.shape[-1] * reduced / rate)
        blocks = math.ceil(samples / SCALE_BLOCK)
        bins = math.ceil(0.5 * reduced / rate * size)
        lost = 0.0 if reduced == rate else above[math.ceil(PASS_BAND * bins)]
        # Rounding is white noise up to half of the reduced rate, with a twelfth of the square of a step a sample.
        step = _block_peaks(sound, SCALE_BLOCK * rate / reduced) / (2 ** (encoding.bits - 1) - 1)
        rounding = (step**2).sum() * SCALE_BLOCK * rate / reduced / 12 * filtered[:bins].mean()
        characters.append(len(sound) * (_base64_size(samples * encoding.bits // 8) + _base64_size(4 * blocks)))
        errors.append(10 * math.log10(max(lost + rounding, 1e-300) / max(energy, 1e-300)))
    return EncodedSize(np.array(characters), np.array(errors))


def choose_encodings(sizes: Sequence[EncodedSize], room: int) -> tuple[list[KnockEncoding], float] | None:
    """Return an encoding for each sound and the largest error, dB; None if no choice fits into `room` characters.

    At every error of `ERRORS_DB` a sound takes the smallest encoding that keeps it, or the best one.
    """
    for allowed in ERRORS_DB:
        chosen = [_smallest(size, allowed) for size in sizes]
        if sum(int(size.characters[i]) for size, i in zip(sizes, chosen, strict=True)) <= room:
            worst = max((float(size.error_db[i]) for size, i in zip(sizes, chosen, strict=True)), default=-math.inf)
            return [ENCODINGS[i] for i in chosen], worst
    return None


def reduce_rate(sound: np.ndarray, rate: int, encoding: KnockEncoding) -> tuple[np.ndarray, int]:
    """Reduce the rate of a sound [channels, samples] to that of an encoding; also return its rate."""
    if not sound.shape[-1] or rate <= encoding.rate:
        return sound, rate
    return resample(sound, rate, int(encoding.rate)), int(encoding.rate)


def _smallest(size: EncodedSize, allowed: float) -> int:
    kept = np.flatnonzero(size.error_db <= allowed)
    return int(kept[np.argmin(size.characters[kept])]) if len(kept) else len(ENCODINGS) - 1


def _block_peaks(sound: np.ndarray, block: float) -> np.ndarray:
    """Return the largest sample of each block [channels, blocks]."""
    if not sound.size:
        return np.zeros((len(sound), 0))
    begins = np.arange(0, sound.shape[-1], block).astype(int)
    return np.maximum.reduceat(np.abs(sound), begins, axis=-1)


def _base64_size(count: int) -> int:
    return 4 * math.ceil(count / 3)
