"""Bands of a recording, each shifted to 0 Hz and sampled as slowly as its width allows.

A slice of the recording's Fourier transform around the centre of a band is weighted by the transform of a window and
transformed back to time at a low rate. This gives the samples of a short-time Fourier transform at that one frequency.
The window has a finite length T, so from half a window after the start of a damped cosine Re(c exp(pt)) to half a
window before its end the band holds exactly one exponential,

    z(t) = c/2 · G(p − jω_c) · exp((p − jω_c) t),

with a complex gain G in closed form (`Bands.gain`). Further transients do not occur. There are two windows:

- Kaiser (`kaiser_bands`): side lobes 105 dB down, and the first zero of its transform on the nearest neighbour.
- Hann (`hann_band`): less than half as long at equal width, for partials that change fast.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import cast

import numpy as np
from numpy.typing import NDArray

BETA = 14.0  # side lobes of the Kaiser window 105 dB down; `analysis` subtracts the remaining leakage of neighbours
KAISER_NULL = float(np.hypot(BETA, np.pi) / np.pi)  # first zero of G, in units of 1/T


def kaiser_gain(s: np.ndarray, seconds: float) -> NDArray[np.complex128]:
    """G(s) = sinhc(√(β² + (sT/2)²)) / sinhc(β) of a Kaiser window of length T = `seconds` at `s`, 1/s."""
    root = np.sqrt(BETA**2 + np.asarray(s * (seconds / 2), complex) ** 2)
    return np.sinh(root) / root * (BETA / np.sinh(BETA))


def hann_gain(s: np.ndarray, seconds: float) -> NDArray[np.complex128]:
    """G(s) = sinc(u) / (1 − u²), u = sT/2πj, of a Hann window of length T = `seconds` at `s`, 1/s."""
    u = s * seconds / (2j * np.pi)
    with np.errstate(all="ignore"):
        return np.where(np.abs(u * u - 1) < 1e-6, 0.5, np.sinc(u) / (1 - u * u))


@dataclass(frozen=True)
class Bands:
    """Complex signals of bands relative to their centre frequencies, on one time axis."""

    z: NDArray[np.complex128]  # [..., frames]; [partials, frames] of a Kaiser window
    time: np.ndarray  # [frames], s
    centre: np.ndarray  # Hz [partials]
    spacing: float  # Hz to the first zero
    window: float  # T, s
    rate: float  # frames per second
    noise_width: float  # ∫|G|² df, Hz: noise variance of a frame over its two-sided density
    transform: Callable[[np.ndarray, float], NDArray[np.complex128]] = kaiser_gain

    @property
    def step(self) -> float:
        """Time between frames, s."""
        return float(self.time[1] - self.time[0])

    def select(self, keep: np.ndarray) -> Bands:
        """The bands of the partials selected by `keep`, bool [partials]."""
        return replace(self, z=self.z[keep], centre=self.centre[keep])

    def gain(self, s: np.ndarray) -> NDArray[np.complex128]:
        """G at complex frequency `s` (1/s) relative to the centre."""
        return self.transform(s, self.window)

    def colour(self, frames: int) -> tuple[int, np.ndarray]:
        """Size of a Fourier transform that holds `frames` twice, and the noise's spectrum |G|² at its bins."""
        size = fast_length(2 * frames)
        return size, np.abs(self.gain(2j * np.pi * np.fft.fftfreq(size, 1 / self.rate))) ** 2

    def frames_within(self, start: float, stop: float, least: int = 8) -> slice:
        """Frames centred within `start`..`stop` s, at least `least` of them."""
        first = min(int(np.searchsorted(self.time, start - 1e-9)), max(len(self.time) - least, 0))
        return slice(first, max(int(np.searchsorted(self.time, stop + 1e-9)), first + least))


def fast_length(count: int, real: bool = True) -> int:
    """Return a length of at least `count` for which the FFT is fast."""
    from scipy.fft import next_fast_len

    return cast(int, next_fast_len(count, real=real))


def kaiser_bands(samples: np.ndarray, rate: int, centre: np.ndarray, spacing: float, skip: float) -> Bands:
    """Bands around `centre` [partials] (Hz), with zeros at neighbours `spacing` Hz away.

    Each centre is moved to the nearest bin. Only frames whose window lies within the recording are returned.

    Parameters
    ----------
    samples : [samples], beginning at the onset
    rate : Hz
    skip : end of the contact, s after the onset; no window begins before it
    """
    window = KAISER_NULL / spacing
    size = fast_length(len(samples) + int(window * rate) + 1)
    width = rate / size
    count = fast_length(2 * max(4, int(1.3 * spacing / width)))
    offset = np.arange(count) - count // 2
    weight = kaiser_gain(2j * np.pi * offset * width, window).real
    middle = np.round(centre / width).astype(int)
    # Frames begin at the same time for recordings of any length, so that a beat changes a sum of frames equally in all.
    begin, frame_rate = skip + window / 2, count * width
    turn = 2j * np.pi * begin * width
    frames = max(int(np.floor((len(samples) / rate - window / 2 - begin) * frame_rate)) + 1, 0)
    z = _demodulate(np.fft.rfft(samples, size), middle[:, None], offset, weight, count, turn)
    time = begin + np.arange(frames) / frame_rate
    noise_width = float(np.sum(weight**2) * width)
    return Bands(z[:, :frames] * (count / size), time, middle * width, spacing, window, frame_rate, noise_width)


def hann_band(spectrum: np.ndarray, samples: int, rate: float, centre: float, seconds: float) -> Bands:
    """The band around `centre` Hz of signals of this length with half spectra [..., bins], by a window of `seconds`.

    A frame is valid if the window around it lies within the signal. The frame rate is the lowest that holds the main
    lobe of the window. The side lobes are discarded.
    """
    reach = int(np.ceil(2.0 / seconds * samples / rate))
    middle, offset = round(centre * samples / rate), np.arange(-reach, reach + 1)
    weight = hann_gain(2j * np.pi * ((middle + offset) * rate / samples - centre), seconds).real
    count = fast_length(2 * reach + 1, real=False)
    time = np.arange(count) * (samples / rate) / count
    rotation = np.exp(2j * np.pi * (middle * rate / samples - centre) * time)
    z = _demodulate(spectrum, middle, offset, weight, count) * (count / samples) * rotation
    frame_rate = count * rate / samples
    return Bands(z, time, np.array(centre), 2 / seconds, seconds, frame_rate, 1.5 / seconds, hann_gain)


def _demodulate(
    spectrum: np.ndarray,
    middle: np.ndarray | int,
    offset: np.ndarray,
    weight: np.ndarray,
    count: int,
    turn: complex = 0j,
) -> NDArray[np.complex128]:
    """Signals [..., count] of the weighted bins `middle + offset` of half spectra, times their size over `count`.

    `turn` is the phase for each bin of `offset`, rad times j. It moves the first frame from 0 s to another time.
    """
    index = middle + offset
    inside = (index >= 0) & (index < spectrum.shape[-1])
    slices = np.where(inside, spectrum[..., np.clip(index, 0, spectrum.shape[-1] - 1)], 0) * weight
    wrapped = np.zeros((*slices.shape[:-1], count), complex)
    wrapped[..., offset % count] = slices * np.exp(turn * offset)
    return np.asarray(np.fft.ifft(wrapped, axis=-1), complex)
