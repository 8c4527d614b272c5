"""A partial's band cut to where it is heard, and weighed: each layer relative to itself, and even in log time."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import signal

from .aligned_layers import SPAN
from .bands import Band
from .esprit import Signals

__all__ = ["RANGE", "ValidFrames", "select_valid_frames"]

# Time, s, that is counted even in its logarithm from here on.
EVEN = 0.1
# What lies so far below a band's largest, dB, is not fitted however clean: other strings ring along there, and a fall
# of pitch that was taken out leaves its traces.
RANGE = 48.0
# A layer whose band stands less above its noise, dB, says nothing of its poles.
LEAST_SNR = 10.0
# Length of the envelope's average, s.
ENVELOPE = 0.06
# A signal is fitted for so many frames and so long, s, at the least, however soon it is lost in the noise.
FEWEST = 12
SHORTEST = 0.1
# It begins when the kernel has left the onset by this, s, the first contact's length, and is lost within so many times
# the noise's amplitude, which is what the end of the recording, from this part of it on, has beside the partial: in a
# short one, the last frame that is valid.
CONTACT = 0.003
LOST = 2.0
QUIET = 0.8
# Rms of noise over the median of its magnitude (Rayleigh).
RMS_OVER_MEDIAN = 1.2
# Before the end of a recording, s, frames are not used: files are faded.
FADED = 0.01
# A deviation of 1, where poles are sought, is at least so far below a signal's begin, dB.
FINE = 40.0
# Frames at the begin whose largest is the band's.
TOP = 3


@dataclass(frozen=True)
class ValidFrames:
    """What is fitted of a band: which layers and channels, from when, and what is a deviation of 1."""

    above_noise: np.ndarray  # bool [layers, channels]
    signals: Signals  # the live ones
    scale: np.ndarray  # [signals]
    start: float  # s
    noise: np.ndarray  # [layers, channels]
    snr: np.ndarray  # [layers]


def select_valid_frames(b: Band, z: np.ndarray, beside: np.ndarray, ends: np.ndarray) -> ValidFrames | None:
    """Cut a band to where it is heard.

    Parameters
    ----------
    z : the band [layers, channels, frames]; `beside`: magnitude of the band half a spacing above, likewise.
    ends : s, of each layer.
    """
    quiet = [(b.time > min(QUIET * end, end - b.kernel - b.step)) & (b.time <= end - b.kernel) for end in ends]
    noise = np.stack([np.median(beside[i][:, at], axis=-1) for i, at in enumerate(quiet)]) * RMS_OVER_MEDIAN + 1e-9
    width = max(1, round(ENVELOPE / b.step))
    smooth = np.ones((1, 1, width)) / width
    envelope = np.sqrt(signal.convolve(np.abs(z) ** 2, smooth, "same").clip(0))
    first = int(np.ceil((b.kernel / 2 + CONTACT) / b.step))
    stop = np.array([int((min(SPAN, end - FADED) - b.kernel / 2) / b.step) for end in ends])
    top = envelope[..., first : first + TOP].max(axis=-1)
    snr = 20 * np.log10(np.maximum(top, noise * 1e-6) / noise)  # a channel may be silent
    floor = np.maximum(noise, top * 10 ** (-RANGE / 20))
    live = (snr > LEAST_SNR) & (stop > first + FEWEST)[:, None]
    if not live.any():
        return None
    frame = np.arange(first, stop.max())
    low = (envelope[..., frame] < LOST * floor[..., None]) | (frame >= stop[:, None, None])
    length = np.where(low.any(axis=-1), low.argmax(axis=-1), len(frame))
    length = np.maximum(length, max(FEWEST, int(SHORTEST / b.step)))[live]
    frame = frame[: length.max()]
    # The root counts equal ratios of time alike.
    even = np.sqrt((b.time[frame] + EVEN) / (b.time[first] + EVEN))
    weight = 1 / ((envelope[:, :, frame] + LOST * floor[..., None]) * even)[live]
    weight[np.arange(len(frame)) >= length[:, None]] = 0.0
    scale = np.maximum(floor, envelope[..., first] * 10 ** (-FINE / 20))[live]
    return ValidFrames(
        live, Signals(z[:, :, frame][live], weight, b.step), scale, first * b.step, floor, snr.max(axis=1)
    )
