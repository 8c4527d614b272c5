"""Filters of sampled sounds: resampling, delay, removal of drift, moving average."""

from __future__ import annotations

import math

import numpy as np

LOWEST_HZ = 20.0  # a piano has no partial below it, only offset, drift or rumble


def resample(x: np.ndarray, old: int, new: int) -> np.ndarray:
    """Resample a sound [..., samples] from the rate `old` to the rate `new`, Hz, by a polyphase filter."""
    from scipy.signal import resample_poly

    divisor = math.gcd(old, new)
    return x if new == old else resample_poly(x, new // divisor, old // divisor, axis=-1)


def reduce_rate(x: np.ndarray, factor: int) -> np.ndarray:
    """Divide the rate of a sound [channels, samples] by an integer. It keeps all frequencies below half the new rate.

    This uses one Fourier transform. So both ends must be silent, because they wrap around.
    """
    from scipy.signal import resample

    if factor == 1:
        return x
    size = -(-x.shape[-1] // factor)
    return np.asarray(resample(np.pad(x, ((0, 0), (0, size * factor - x.shape[-1]))), size, axis=-1))


def delayed(x: np.ndarray, samples: float) -> np.ndarray:
    """Delay a sound [..., samples] by a real number of samples, at most about 1000."""
    size = x.shape[-1] + 2048
    turn = np.exp(-2j * np.pi * np.fft.rfftfreq(size) * samples)
    return np.fft.irfft(np.fft.rfft(x, size) * turn, size)[..., : x.shape[-1]]


def forward_mean(values: np.ndarray, width: int) -> np.ndarray:
    """Mean of the `width` values from each one on [samples - width + 1]."""
    total = np.concatenate([[0.0], np.cumsum(values)])
    width = min(max(width, 1), len(values))
    return np.maximum(total[width:] - total[:-width], 0) / width


def without_drift(x: np.ndarray, rate: int) -> np.ndarray:
    """Return the part of `x` [samples] above `LOWEST_HZ`.

    The filter is causal: a sample does not affect earlier ones. `x` is extended before its beginning by a point
    reflection, so that an offset or a drift does not cause a step.
    """
    from scipy.signal import butter, sosfilt, sosfilt_zi

    lead = min(round(0.02 * rate), len(x) - 1)
    extended = np.append(2 * x[0] - x[lead:0:-1], x)
    sections = butter(4, LOWEST_HZ, "highpass", fs=rate, output="sos")
    return sosfilt(sections, extended, zi=extended[0] * sosfilt_zi(sections))[0][lead:]
