"""Decay rates of the envelope of each partial, early (prompt sound) and late (aftersound), with errors due to beats.

A rate is the slope of the least-squares line through the logarithm of the envelope of the band (`dsp/bands.py`). The
early line is as long as the time for which the envelope lies within `EARLY_RANGE` of its maximum. A beat does not
change this time on average. The late line begins there. It ends where the envelope is lost in the noise, or the
recording ends.

Components of a partial interfere. The slope of the envelope therefore differs from the rate at which their energy
decays. The deviations of the visible log envelope from one line show the beats. A sine of frequency f in the log
envelope, with rms σ and unknown phase, changes the slope of a line of duration T by h(fT) σ/T, with

    h(x) = 12 |∫_{-1/2}^{1/2} u exp(2πixu) du| = 6 |sin(πx) − πx cos(πx)| / (πx)².

The spectrum of the deviations, weighted by h², is the variance of the slope. Beats that are slower than the recording
are not visible in their own partial. Neighbouring partials have beats of similar size, so the error in nepers is at
least the rms of the neighbours. A bend of the envelope counts as a beat. Deviations from a line with a bend or from a
parabola hide slow beats: on synthetic partials that beat, only 88 % of the late intervals then hold.
"""

from dataclasses import dataclass

import numpy as np

from ..conversions import DB
from .baseband_fit import FittedBands

# dB; as the early decay time of room acoustics (ISO 3382). A shorter line follows the beats, a longer one the
# aftersound: lines of 8, 10, 15 and 20 dB are within a factor of 1.25 of the slope over 0.05 to 0.8 s, where that part
# of the envelope is straight, for 81, 84, 73 and 58 % of the partials of four pianos.
EARLY_RANGE = 10.0
CLEAR = 10.0  # dB above the noise of a frame, from which noise changes the log envelope by less than 2 dB rms
_FEWEST = 8  # frames of a line, and of the whole envelope
_SLOWEST = 0.75  # periods within the visible envelope, of the beat that the slowest component stands for
_HIDDEN = 1.66  # rms of that beat over the rms of its deviation from a line, averaged over its phase
_WINDOWS = 2.0  # shortest line, in windows of the bands: frames within one window are not independent


@dataclass(frozen=True)
class Slopes:
    """Decay rates of a part of each envelope, and their errors; [partials], NaN where the part is not visible."""

    rate: np.ndarray  # 1/s
    noise: np.ndarray  # 1/s, standard error due to noise
    beats: np.ndarray  # Np, standard deviation of the change of the log envelope over the part, due to beats
    start: np.ndarray  # s
    stop: np.ndarray  # s

    @property
    def beat_error(self) -> np.ndarray:
        """Standard deviation of the rate due to beats, 1/s [partials]."""
        return self.beats / (self.stop - self.start)


def measure_decay_rates(fitted: FittedBands) -> tuple[Slopes, Slopes]:
    """Decay rates of the early and the late part of the envelope of each partial."""
    log = _log_envelopes(fitted)
    least = max(_FEWEST, round(_WINDOWS * fitted.bands.window * fitted.bands.rate))
    early: list[tuple[float, ...]] = []
    late: list[tuple[float, ...]] = []
    for row, frame in zip(log, fitted.frame_noise, strict=True):
        end, stop = _spans(row, 0.5 * np.log(max(frame, 1e-300)), least)
        beats = _deviation(row[:stop])
        early.append(_line(fitted, row, frame, slice(0, end), beats))
        late.append(_line(fitted, row, frame, slice(end, stop), beats) if stop - end >= least else (np.nan,) * 5)
    return Slopes(*np.array(early).T), Slopes(*np.array(late).T)


def _log_envelopes(fitted: FittedBands) -> np.ndarray:
    """Logarithms of the envelopes [partials, frames], Np, at least those of the noise: a null has no logarithm."""
    power = np.abs(fitted.z) ** 2
    return 0.5 * np.log(np.maximum(power, np.maximum(fitted.frame_noise, 1e-300)[:, None]))


def _spans(row: np.ndarray, noise: float, least: int) -> tuple[int, int]:
    """First frames after the early part and after the whole visible envelope; each part has at least `least`.

    Both are numbers of frames above a level. The last frame above it would follow one beat, or one peak of the noise.
    """
    stop = min(max(int(np.sum(row > noise + CLEAR / DB)), least), len(row))
    early = int(np.sum(row[:stop] > row[:stop].max() - EARLY_RANGE / DB))
    return min(max(early, least), stop), stop


def _line(fitted: FittedBands, row: np.ndarray, frame: float, part: slice, beats: np.ndarray) -> tuple[float, ...]:
    """Fields of `Slopes` for the frames `part` of the log envelope `row`, which deviates from one line by `beats`."""
    bands = fitted.bands
    t = bands.time[part] - np.mean(bands.time[part])
    weight = t / np.sum(t**2)
    correlated = bands.rate / bands.noise_width  # frames with the noise of one
    noise = np.sqrt(np.sum(weight**2 * frame / 2 * np.exp(-2 * row[part])) * max(correlated, 1.0))
    start, end = bands.time[part][[0, -1]]
    return -float(weight @ row[part]), float(noise), _change(beats, (end - start) / bands.step), start, end


def _deviation(row: np.ndarray) -> np.ndarray:
    """Deviation of a log envelope [frames] from its least-squares line."""
    x = np.linspace(-1, 1, len(row))
    return row - np.mean(row) - x * (x @ row) / (x @ x)


def _change(beats: np.ndarray, length: float) -> float:
    """Standard deviation of the change along a line over `length` frames, Np, by `beats` [frames] of unknown phase."""
    spectrum = np.abs(np.fft.rfft(beats)[1:] / len(beats)) ** 2
    phase = np.pi * length / len(beats) * np.arange(1, len(spectrum) + 1)
    phase[0] *= _SLOWEST
    response = 6 * (np.sin(phase) - phase * np.cos(phase)) / phase**2
    response[0] *= _HIDDEN
    return float(np.sqrt(2 * np.sum(spectrum * response**2)))
