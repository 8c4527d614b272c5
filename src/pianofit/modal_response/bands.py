"""One partial at a time: a band about it, brought to 0 Hz and to a rate of its own."""

from __future__ import annotations

from typing import NamedTuple, cast

import numpy as np
from scipy.fft import next_fast_len

__all__ = ["Band", "band", "kernel_gain", "kernel_seconds"]

# A band's kernel lasts so many periods of the partials' spacing: its main lobe then ends half-way to the neighbours,
KERNEL = 4.0
# but no shorter, s, or the treble's bands would be wider than their modes need,
SHORTEST = 0.03
# and no longer, s, or the bass would lose its attack.
LONGEST = 0.16


class Band(NamedTuple):
    """A band's signals about its centre, and what made them."""

    time: np.ndarray  # s [frames]
    values: np.ndarray  # complex [..., frames]
    kernel: float  # s, length of the Hann kernel that made it

    @property
    def step(self) -> float:
        """Between frames, s."""
        return float(self.time[1])


def kernel_seconds(spacing: float) -> float:
    """Length of the kernel, s, for partials `spacing` Hz apart."""
    return float(np.clip(KERNEL / spacing, SHORTEST, LONGEST))


def kernel_gain(pole: np.ndarray, seconds: float) -> np.ndarray:
    """What a Hann kernel of length `seconds` makes of exp(pole t), complex [...]."""
    return _hann(pole * seconds / (2j * np.pi))


def _hann(u: np.ndarray) -> np.ndarray:
    """The transform of a Hann kernel of length 1 and sum 1, at `u` turns over its length."""
    with np.errstate(all="ignore"):
        return np.where(np.abs(np.abs(u) - 1) < 1e-6, 0.5, np.sinc(u) / (1 - u * u))


def band(spectrum: np.ndarray, samples: int, rate: float, centre: float, seconds: float) -> Band:
    """The band about `centre` Hz of signals with these half spectra [..., bins], smoothed by a Hann kernel.

    A frame is valid if the kernel about it lies within the signal. Frames follow each other just fast enough for the
    kernel's main lobe, which is all of it that is kept.
    """
    reach = int(np.ceil(2.0 / seconds * samples / rate))
    middle = round(centre * samples / rate)
    at = np.arange(middle - reach, middle + reach + 1)
    weight = _hann((at * rate / samples - centre) * seconds)
    size = cast(int, next_fast_len(2 * reach + 1))
    inside = (at >= 0) & (at < samples // 2)
    wrapped = np.zeros((*spectrum.shape[:-1], size), complex)
    wrapped[..., (at - middle) % size] = np.where(inside, spectrum[..., np.clip(at, 0, samples // 2)], 0) * weight
    time = np.arange(size) * (samples / rate) / size
    turn = np.exp(2j * np.pi * (middle * rate / samples - centre) * time)
    return Band(time, np.fft.ifft(wrapped, axis=-1) * (size / samples) * turn, seconds)
