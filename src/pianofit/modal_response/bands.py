"""One partial at a time: the band about it, shifted to 0 Hz and sampled as slowly as its width allows."""

from __future__ import annotations

from typing import NamedTuple, cast

import numpy as np
from scipy.fft import next_fast_len

__all__ = ["Band", "band", "kernel_gain", "kernel_seconds"]

# Length of a band's kernel in periods of the spacing of partials. Its main lobe then ends half-way to the neighbours.
KERNEL = 4.0
# Shortest kernel, s. With a shorter one the bands of the treble would be wider than their modes need.
SHORTEST = 0.03
# Longest kernel, s. A longer one would smooth the attack of bass notes.
LONGEST = 0.16


class Band(NamedTuple):
    """Complex signals of a band, relative to its centre frequency."""

    time: np.ndarray  # s [frames]
    values: np.ndarray  # complex [..., frames]
    kernel: float  # s, length of the Hann kernel that smoothed them

    @property
    def step(self) -> float:
        """Time between frames, s."""
        return float(self.time[1])


def kernel_seconds(spacing: float) -> float:
    """Length of the kernel, s, for partials `spacing` Hz apart."""
    return float(np.clip(KERNEL / spacing, SHORTEST, LONGEST))


def kernel_gain(pole: np.ndarray, seconds: float) -> np.ndarray:
    """Factor on exp(pole t) after smoothing by a Hann kernel of length `seconds`, complex [...]."""
    return _hann(pole * seconds / (2j * np.pi))


def _hann(u: np.ndarray) -> np.ndarray:
    """Fourier transform of a Hann kernel of length 1 and sum 1, at `u` cycles per length."""
    with np.errstate(all="ignore"):
        return np.where(np.abs(np.abs(u) - 1) < 1e-6, 0.5, np.sinc(u) / (1 - u * u))


def band(spectrum: np.ndarray, samples: int, rate: float, centre: float, seconds: float) -> Band:
    """The band about `centre` Hz of signals with these half spectra [..., bins], smoothed by a Hann kernel.

    A frame is valid if the kernel about it lies within the signal. The frame rate is the lowest that holds the kernel's
    main lobe. The side lobes are discarded.
    """
    reach = int(np.ceil(2.0 / seconds * samples / rate))
    middle = round(centre * samples / rate)
    bins = np.arange(middle - reach, middle + reach + 1)
    weight = _hann((bins * rate / samples - centre) * seconds)
    size = cast(int, next_fast_len(2 * reach + 1))
    inside = (bins >= 0) & (bins < samples // 2)
    wrapped = np.zeros((*spectrum.shape[:-1], size), complex)
    wrapped[..., (bins - middle) % size] = np.where(inside, spectrum[..., np.clip(bins, 0, samples // 2)], 0) * weight
    time = np.arange(size) * (samples / rate) / size
    rotation = np.exp(2j * np.pi * (middle * rate / samples - centre) * time)
    return Band(time, np.fft.ifft(wrapped, axis=-1) * (size / samples) * rotation, seconds)
