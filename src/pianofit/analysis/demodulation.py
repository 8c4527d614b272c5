"""Demodulation: one complex baseband signal per partial.

One FFT of the zero-padded recording is computed for all partials. A slice of its bins around each partial is weighted
by the transform of a Kaiser window and transformed back to time at a low rate. This gives the samples of a short-time
Fourier transform at that one frequency. The window has a finite length T, so from half a window after the end of the
contact to half a window before the end of the recording a damped cosine Re(c exp(pt)) appears as exactly one
exponential,

    z(t) = c/2 · G(p − jω_c) · exp((p − jω_c) t),     G(s) = sinhc(√(β² + (sT/2)²)) / sinhc(β),

with a complex gain in closed form (`Bands.gain`). Further transients do not occur. The first zero of the window's
transform lies on the nearest neighbour.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import cast

import numpy as np
from numpy.typing import NDArray

__all__ = ["Bands", "demodulate", "fast_length"]

_BETA = 14.0  # side lobes 105 dB down; the remaining leakage of neighbours is subtracted (baseband_fit.py)
_NULL = float(np.hypot(_BETA, np.pi) / np.pi)  # first zero of G, in units of 1/T
_SLICE = 1.3  # half width of the slice, in units of the first zero


@dataclass(frozen=True)
class Bands:
    """Complex basebands of all partials on one time axis (s after the onset)."""

    z: NDArray[np.complex128]  # complex [partials, frames], full scale
    time: np.ndarray  # [frames], s
    centre: np.ndarray  # [partials], Hz
    spacing: float  # Hz to the first zero
    window: float  # T, s
    rate: float  # frames per second
    noise_width: float  # ∫|G|² df, Hz: noise variance of a frame over its two-sided density

    def select(self, keep: np.ndarray) -> Bands:
        """The bands of the partials selected by `keep`, bool [partials]."""
        return replace(self, z=self.z[keep], centre=self.centre[keep])

    def gain(self, s: np.ndarray) -> NDArray[np.complex128]:
        """G at complex frequency `s` (1/s) relative to the centre."""
        return _kaiser_transform(s * (self.window / 2))

    def colour(self, frames: int) -> tuple[int, np.ndarray]:
        """Size of a Fourier transform that holds `frames` twice, and the noise's spectrum |G|² at its bins."""
        size = fast_length(2 * frames)
        return size, np.abs(self.gain(2j * np.pi * np.fft.fftfreq(size, 1 / self.rate))) ** 2

    def frames_within(self, start: float, stop: float, least: int = 8) -> slice:
        """Frames centred within `start`..`stop` s, at least `least` of them."""
        first = min(int(np.searchsorted(self.time, start - 1e-9)), max(len(self.time) - least, 0))
        return slice(first, max(int(np.searchsorted(self.time, stop + 1e-9)), first + least))


def _kaiser_transform(x: np.ndarray) -> NDArray[np.complex128]:
    """sinhc(√(β² + x²)) / sinhc(β): transform of a Kaiser window of unit area and length T at s = 2x/T."""
    root = np.sqrt(_BETA**2 + np.asarray(x, complex) ** 2)
    return np.sinh(root) / root * (_BETA / np.sinh(_BETA))


def fast_length(count: int) -> int:
    """Return a length of at least `count` for which the FFT is fast."""
    from scipy.fft import next_fast_len

    return cast(int, next_fast_len(count, real=True))


def demodulate(samples: np.ndarray, rate: int, centre: np.ndarray, spacing: float, skip: float) -> Bands:
    """Basebands around `centre` [partials] (Hz), with zeros at neighbours `spacing` Hz away.

    Parameters
    ----------
    samples : [samples], beginning at the onset
    rate : Hz
    skip : end of the contact, s after the onset; no window begins before it
    """
    window = _NULL / spacing
    size = fast_length(len(samples) + int(window * rate) + 1)
    width = rate / size
    count = fast_length(2 * max(4, int(_SLICE * spacing / width)))
    offset = np.arange(count) - count // 2
    weight = _kaiser_transform(1j * np.pi * offset * width * window).real
    bins = np.fft.rfft(samples, size)
    middle = np.round(centre / width).astype(int)
    index = middle[:, None] + offset
    outside = (index < 0) | (index >= len(bins))
    # Frames begin at the same time for recordings of any length, so that a beat changes a sum of frames equally in all.
    begin, frame_rate = skip + window / 2, count * width
    slices = np.where(outside, 0.0, bins[np.clip(index, 0, len(bins) - 1)] * weight)
    slices = slices * np.exp(2j * np.pi * begin * width * offset)
    frames = max(int(np.floor((len(samples) / rate - window / 2 - begin) * frame_rate)) + 1, 0)
    z = np.fft.ifft(np.fft.ifftshift(slices, axes=1), axis=1)[:, :frames] * (count / size)
    time = begin + np.arange(frames) / frame_rate
    return Bands(z, time, middle * width, spacing, window, frame_rate, float(np.sum(weight**2) * width))
