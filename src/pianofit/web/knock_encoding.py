"""Encodings of knocks and release noises: every sound as small as one common error allows.

A page has room for a certain number of bytes. The attack noise of a bass key lies mostly below 2 kHz, because a long
contact excites little above. That of a treble key reaches 10 kHz. So one sample rate for all keys would waste room or
lose attacks. Here all sounds get the same error relative to the note, the smallest for which all fit. A sound has the
sample rate that is sufficient for it. Its step of rounding falls with the square root of the level, so that the decay
of a knock does not end in silence. Samples are packed with the number of bits that their block needs.
"""

import base64
import math
from bisect import bisect_left
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from ..dsp.filters import resample
from ..model.modal_response import ForcePulse, ModalResponse
from ..playback.voice import CHANNELS, KNOCK_RATES

# Samples that share a step and a number of bits, which are stored in one byte.
BLOCK = 64
# Largest number that half a byte can state: the most bits of a block, and the most halvings of its step.
HALF_BYTE = 15
# Steps between zero and the largest sample, at most: one bit is the sign.
MOST_STEPS = 2 ** (HALF_BYTE - 1) - 1
# Part of half the sample rate that the filter of the resampling keeps.
PASS_BAND = 0.9
# Errors that are tried, dB relative to the energy of the note.
ERRORS_DB = np.arange(-90.0, 1.0)
# Span of the note to whose energy an error is compared, s: an attack.
ATTACK_SECONDS = 0.03


class KnockEncoding(NamedTuple):
    """Encoding of a sound."""

    rate: float  # highest sample rate, Hz; the rate of a sound is never raised
    step: float  # of rounding at the largest sample, in units of the sound; at least this sample over `MOST_STEPS`


BEST = KnockEncoding(math.inf, 0.0)


class EncodedSound:
    """A sound of a page, and the smallest encoding for any error.

    Parameters
    ----------
    sound : response to a unit impulse [channels, samples].
    rate : its sample rate, Hz.
    pulse : what it is convolved with [samples].
    energy : energy of the note, the sum of the squares of the differences of its samples at `rate`. The differences
        weigh high frequencies as much as low ones, whose partials are stronger.
    """

    def __init__(self, sound: np.ndarray, rate: int, pulse: np.ndarray, energy: float) -> None:
        self.energy = energy
        size = sound.shape[-1] + len(pulse)
        gain = np.abs(np.fft.rfft(pulse, size) * (1 - np.exp(-2j * np.pi * np.arange(size // 2 + 1) / size))) ** 2
        spectrum = 2 * gain * (np.abs(np.fft.rfft(sound, size)) ** 2).sum(axis=0) / size
        above = np.append(np.cumsum(spectrum[::-1])[::-1], 0.0)
        self._choices = []  # of rate: sound, energy above it, and energy of rounding for a step of 1
        for highest in (*(x for x in KNOCK_RATES if x < rate), math.inf):
            reduced, own = reduce_rate(sound, rate, highest)
            bins = math.ceil(0.5 * own / rate * size)
            lost = 0.0 if own == rate else float(above[math.ceil(PASS_BAND * bins)])
            finer = np.mean([0.25 ** _halvings(_blocks(row)) for row in reduced]) if reduced.size else 0.0
            self._choices.append((highest, reduced, lost, sound.size / 12 * float(gain[:bins].mean() * finer)))

    def smallest(self, error_db: float) -> tuple[KnockEncoding, int]:
        """Return the smallest encoding with this error, or the best one, and its characters."""
        allowed = 10 ** (error_db / 10) * self.energy
        found = []
        for highest, sound, lost, rounding in self._choices:
            if lost < allowed or highest == math.inf:
                step = math.sqrt(max(allowed - lost, 0.0) / max(rounding, 1e-300))
                found.append((KnockEncoding(highest, step), _characters(sound, step)))
        return min(found, key=lambda pair: pair[1])

    def error_db(self, encoding: KnockEncoding) -> float:
        """Return the error of an encoding relative to the energy of the note, dB."""
        sound, lost, rounding = next(rest for highest, *rest in self._choices if highest == encoding.rate)
        step = max(_least_step(row, encoding.step) for row in sound)
        return 10 * math.log10(max(lost + rounding * step**2, 1e-300) / max(self.energy, 1e-300))


def encoded_knock(response: ModalResponse, force: ForcePulse) -> EncodedSound:
    """Return the sound of a knock, with its error in a stroke of this force."""
    count = round(ATTACK_SECONDS * response.rate)
    note = np.diff(response.sound(force, response.rate, count)[:CHANNELS])
    return EncodedSound(
        response.continuous_knock()[:CHANNELS], response.rate, force.at(response.rate), float((note**2).sum())
    )


def choose_encodings(sounds: Sequence[EncodedSound], room: int) -> tuple[list[KnockEncoding], float]:
    """Return an encoding for each sound and the largest error, dB.

    They fit into `room` characters, unless no error of `ERRORS_DB` does.
    """

    def fits(error_db: float) -> bool:  # the characters fall with the error
        return sum(sound.smallest(error_db)[1] for sound in sounds) <= room

    error_db = ERRORS_DB[bisect_left(ERRORS_DB[:-1], True, key=fits)]
    chosen = [sound.smallest(error_db)[0] for sound in sounds]
    return chosen, max(sound.error_db(encoding) for sound, encoding in zip(sounds, chosen, strict=True))


def reduce_rate(sound: np.ndarray, rate: int, highest: float) -> tuple[np.ndarray, int]:
    """Reduce the rate of a sound [channels, samples] to `highest`, Hz, if it is above; also return its rate."""
    if not sound.shape[-1] or rate <= highest:
        return sound, rate
    return resample(sound, rate, int(highest)), int(highest)


def pack(samples: np.ndarray, step: float) -> dict[str, Any]:
    """Encode the samples of a channel for `samples` in `prepare.js`: step, a byte for each block, and whole numbers.

    The byte has the number of bits in its lower half, and the halvings of the step in its upper half. A block of b bits
    has numbers from -2^(b-1) to 2^(b-1) - 1, stored from 0 on, with the highest bit first.
    """
    step = float(f"{_least_step(samples, step):.6g}")
    halvings, whole, bits = _whole(samples, step)
    packed = [
        (((row[:, None] + (1 << (width - 1))) >> np.arange(width - 1, -1, -1)) & 1).ravel()
        for row, width in zip(whole, bits, strict=True)
        if width
    ]
    stream = np.packbits(np.concatenate([np.zeros(0, int), *packed]).astype(bool))
    return {"step": step, "blocks": encode_array(halvings * 16 + bits, "<u1"), "packed": encode_array(stream, "<u1")}


def _characters(sound: np.ndarray, step: float) -> int:
    """Return the characters of base64 of a sound [channels, samples]."""
    total = 0
    for row in sound:
        bits = _whole(row, _least_step(row, step))[2]
        total += _base64_size(len(bits)) + _base64_size(math.ceil(int(bits.sum()) * BLOCK / 8))
    return total


def _least_step(samples: np.ndarray, step: float) -> float:
    return max(step, float(np.abs(samples).max(initial=0.0)) / MOST_STEPS, 1e-300)


def _blocks(samples: np.ndarray) -> np.ndarray:
    """Return samples as rows of a block [blocks, BLOCK]."""
    return np.pad(samples, (0, -len(samples) % BLOCK)).reshape(-1, BLOCK)


def _halvings(rows: np.ndarray) -> np.ndarray:
    """Return how often the step of each block is halved: half as often as its peak [blocks]."""
    peak = np.abs(rows).max(axis=1)
    fall = np.log2(np.maximum(peak.max(initial=0.0), 1e-300) / np.maximum(peak, 1e-300))
    return np.minimum(np.floor(fall / 2), HALF_BYTE).astype(int)


def _whole(samples: np.ndarray, step: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the halvings [blocks], whole numbers [blocks, BLOCK] and bits [blocks] of samples."""
    rows = _blocks(samples)
    halvings = _halvings(rows)
    whole = np.round(rows / (step * 0.5 ** halvings[:, None])).astype(int)
    peak = np.abs(whole).max(axis=1)
    bits = np.where(peak > 0, np.ceil(np.log2(np.maximum(peak, 1) + 1)) + 1, 0).astype(int)
    return halvings, whole, bits


def encode_array(values: np.ndarray, kind: str) -> str:
    """Encode an array in base64, as numbers of a NumPy type such as "<f4"; integers are rounded."""
    values = np.round(values) if kind[1] in "iu" else values
    return base64.b64encode(np.ascontiguousarray(values, kind).tobytes()).decode()


def _base64_size(count: int) -> int:
    return 4 * math.ceil(count / 3)
