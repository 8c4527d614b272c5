"""The spectrum of the noise floor of a recording.

It is measured in the silence before the onset if the file has enough of it, otherwise in the second that has the least
power. Partials that still ring are narrow in the spectrum of a second, so a running median over frequency ignores them.
The medians of bands of a sixth of an octave are the noise density. The median of an exponential variable is ln 2 times
its mean.
"""

import numpy as np

from ..dsp.bands import BETA
from ..recording.recording import Recording

# Frequencies of the density, Hz: six an octave over the audible range.
FREQUENCIES = 20.0 * 2.0 ** (np.arange(61) / 6)
# Length of a segment of the silence before the onset, s, and the least length of that silence: two segments. The end of
# it is left out, s, because a knock begins before the onset.
SEGMENT, LEAST_SILENCE, GAP = 0.1, 0.2, 0.02
# Width of the running median, Hz. The lowest partials, 27.5 Hz apart, are 9 Hz wide in a second.
MEDIAN_WIDTH = 150.0


def noise_density(recording: Recording) -> np.ndarray:
    """Return the density of the noise floor, full scale² per Hz, at `FREQUENCIES` [channels, frequencies].

    It is 0 above half the sample rate, and for digital silence.
    """
    rate = recording.rate
    silence = recording.frames[:, : max(recording.onset - round(GAP * rate), 0)]
    length = min(round(SEGMENT * rate), recording.frames.shape[-1])
    if silence.shape[-1] < LEAST_SILENCE * rate or np.ptp(silence) == 0:
        silence = _quietest_second(recording.frames, rate)
        length = silence.shape[-1]  # one segment, in which the partials that ring are narrow
    starts = range(0, silence.shape[-1] - length + 1, max(length // 4, 1))
    window = np.kaiser(length, BETA)  # so that a partial that rings hides no noise next to it
    segments = np.stack([silence[:, start : start + length] * window for start in starts])
    power = 2 * np.abs(np.fft.rfft(segments)) ** 2 / (rate * (window @ window))
    return np.array([_density(row, rate / length) for row in np.median(power, axis=0) / np.log(2)])


def _quietest_second(frames: np.ndarray, rate: int) -> np.ndarray:
    """The second of a recording [channels, samples] with the least power; all of a shorter recording."""
    length = min(frames.shape[-1], rate)
    starts = [*range(0, frames.shape[-1] - length, length // 2), frames.shape[-1] - length]
    parts = [frames[:, start : start + length] for start in starts]
    return min(parts, key=lambda part: float(np.mean(part**2)))


def _density(power: np.ndarray, step: float) -> np.ndarray:
    """Density at `FREQUENCIES` of one channel from the power at multiples of `step`, Hz [bins]."""
    from scipy.ndimage import median_filter

    smooth = median_filter(power[1:], max(round(MEDIAN_WIDTH / step), 1))  # without the offset
    return np.interp(FREQUENCIES, step * np.arange(1, len(power)), smooth, right=0.0)
