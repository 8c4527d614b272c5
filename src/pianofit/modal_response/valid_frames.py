"""Valid frames of a partial's band, and their weights.

Frames are valid from the end of the attack until the partial falls below the noise and does not return. Each layer is
weighted relative to its own envelope, and evenly in the logarithm of time.
"""

from dataclasses import dataclass

import numpy as np

from ..dsp.bands import Bands
from ..dsp.common_poles import Signals
from .aligned_layers import SPAN

# From this time on, s, frames are weighted evenly in the logarithm of time.
LOG_TIME_START = 0.1
# Frames this far below the band's largest value, dB, are not fitted, even without noise. They also hold the resonance
# of other strings and the remains of a removed glide.
RANGE = 48.0
# A layer whose band exceeds its noise by less, dB, does not contribute to the poles.
LEAST_SNR = 10.0
# Averaging time of the envelope, s.
ENVELOPE = 0.06
# Least number of frames of a fitted signal, however soon it falls below the noise.
FEWEST = 12
# Valid frames begin this time, s, after the window has left the onset: the length of the first contact.
CONTACT = 0.003
# The envelope is above the noise where it exceeds this multiple of the noise amplitude.
NOISE_MARGIN = 2.0
# Least standard deviation in the search for poles, dB relative to the first frame of the signal.
LEAST_DEVIATION_DB = 40.0


@dataclass(frozen=True)
class ValidFrames:
    """The part of a band that is fitted: layers, channels, start and standard deviation."""

    above_noise: np.ndarray  # bool [layers, channels]
    signals: Signals  # of layers and channels above the noise
    scale: np.ndarray  # standard deviation of each signal [signals]
    start: float  # s
    noise: np.ndarray  # [layers, channels]
    snr: np.ndarray  # [layers]


def select_valid_frames(b: Bands, between: np.ndarray, ends: np.ndarray) -> ValidFrames | None:
    """Select the frames of a band [layers, channels, frames] that are fitted; None if no layer exceeds its noise.

    The noise is measured `between` partials, in the band half a spacing above [layers, channels, frames].
    """
    # The noise is measured in the last fifth of each layer, or in the last valid frame of a short one. The rms of noise
    # is 1.2 times the median of its magnitude (Rayleigh).
    quiet = [(b.time > min(0.8 * end, end - b.window - b.step)) & (b.time <= end - b.window) for end in ends]
    noise = np.stack([np.median(between[i][:, frames], axis=-1) for i, frames in enumerate(quiet)]) * 1.2 + 1e-9
    width = max(1, round(ENVELOPE / b.step))
    power = np.pad(b.z.real**2 + b.z.imag**2, ((0, 0), (0, 0), (width // 2, width - 1 - width // 2)))
    envelope = np.sqrt(np.lib.stride_tricks.sliding_window_view(power, width, axis=-1).mean(axis=-1))
    first = int(np.ceil((b.window / 2 + CONTACT) / b.step))
    # Files are often faded out over the last 10 ms.
    stop = np.array([int((min(SPAN, end - 0.01) - b.window / 2) / b.step) for end in ends])
    top = envelope[..., first : first + 3].max(axis=-1)
    snr = 20 * np.log10(np.maximum(top, noise * 1e-6) / noise)  # a channel may be silent
    floor = np.maximum(noise, top * 10 ** (-RANGE / 20))
    above_noise = (snr > LEAST_SNR) & (stop > first + FEWEST)[:, None]
    if not above_noise.any():
        return None
    frame = np.arange(first, stop.max())
    # A partial can beat below the noise and return, and noise can exceed its margin. So the partial ends where the sum
    # of its levels above the noise is largest: what follows lies below the noise on the whole.
    above = np.log(np.maximum(envelope[..., frame], 1e-300) / (NOISE_MARGIN * floor[..., None]))
    total = np.cumsum(np.where(frame < stop[:, None, None], above, -np.inf), axis=-1)
    length = np.where(total.max(axis=-1) > 0, total.argmax(axis=-1) + 1, 0)
    length = np.maximum(length, max(FEWEST, int(0.1 / b.step)))[above_noise]
    frame = frame[: length.max()]
    # The square root gives equal ratios of time equal weight.
    even = np.sqrt((b.time[frame] + LOG_TIME_START) / (b.time[first] + LOG_TIME_START))
    weight = 1 / ((envelope[:, :, frame] + NOISE_MARGIN * floor[..., None]) * even)[above_noise]
    weight[np.arange(len(frame)) >= length[:, None]] = 0.0
    scale = np.maximum(floor, envelope[..., first] * 10 ** (-LEAST_DEVIATION_DB / 20))[above_noise]
    signals = Signals(b.z[:, :, frame][above_noise], weight, b.step)
    return ValidFrames(above_noise, signals, scale, first * b.step, floor, snr.max(axis=1))
