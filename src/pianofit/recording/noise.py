"""Offset and noise floor of a recording."""

from __future__ import annotations

import math

import numpy as np

from ..errors import RecordingError
from .onset import forward_mean, without_drift

__all__ = ["noise_rms", "offset"]

LEAD_SECONDS = 0.05  # before the onset; a shorter lead-in does not determine the noise


def offset(x: np.ndarray) -> float:
    """Mean under a Hann window.

    A partial ω contributes 4π²/(ωT)³ of its amplitude. To a plain mean it contributes 1/(ωT), 750 times more at
    27.5 Hz.
    """
    window = np.hanning(len(x) + 2)[1:-1]
    return float(window @ x / window.sum())


def noise_rms(x: np.ndarray, onset: int, rate: int) -> float:
    """Return the rms of the noise: of the lead-in above 20 Hz, or of the quietest second without a lead-in."""
    floor = _quiet_floor(x, rate)
    loudest = math.sqrt(forward_mean(x * x, round(0.02 * rate)).max())
    # 6 dB: the level of noise alone varies by less than 1 dB. In a short file partials of a low note fill the spectrum.
    if loudest < 2 * floor and len(x) > 0.5 * rate:
        raise RecordingError(f"holds no sound above its noise (rms {loudest:.2g}, noise {floor:.2g}); record it again")
    lead = x[: onset - round(0.001 * rate)] if onset > LEAD_SECONDS * rate else x[:1]
    if np.ptp(lead) == 0:  # no lead-in, or digital silence, which is not the noise of the room
        return floor
    power = forward_mean(without_drift(lead, rate) ** 2, round(0.01 * rate))
    return math.sqrt(np.median(power))  # the median ignores a knock


def _quiet_floor(x: np.ndarray, rate: int) -> float:
    """Return the rms of the noise in the quietest second, in which partials may still ring.

    Partials are narrow, so a running median over 100 Hz of the spectrum ignores them. The median of the exponential
    distribution of a noise spectrum is ln 2 of its mean.
    """
    from scipy.ndimage import median_filter

    length = min(len(x), rate)
    starts = {*range(0, len(x) - length, length // 2), len(x) - length}
    frames = [f for s in sorted(starts) if np.ptp(f := x[s : s + length]) > 0]
    quietest = min(frames, key=lambda f: float(np.var(f)))
    window = np.hanning(length)
    power = np.abs(np.fft.rfft(quietest * window)) ** 2 / (window @ window)
    smooth = median_filter(power, max(round(100 * length / rate), 11))
    return math.sqrt(float(smooth.mean()) / math.log(2))
