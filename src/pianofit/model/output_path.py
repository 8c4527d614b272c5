"""The output path: soundboard, room and microphone, as a filter of unknown phase.

Each partial has its own level through the path. A file consists of the modes of the string, through a filter with these
levels. Their decay rates are those of the string, b1 + b2 β²; decays of single partials belong to the modal response.
"""

import math
from typing import Any, NamedTuple

import numpy as np

from ..dsp.filters import convolve
from ..io.number_format import summary

# Largest relative difference of frequencies of the same partial: the pitch of recordings differs by cents.
SAME_PARTIAL_TOLERANCE = 0.005
# Shortest duration of the computed impulse response, s; its first half is kept. It spans several periods of the lowest
# note, since neighbouring partials may differ in level.
MIN_RESPONSE_S = 1.0


class VelocityDiscrepancy(NamedTuple):
    """Velocity discrepancy: deviation of each partial from hammer and path, in strokes of these velocities."""

    velocity: np.ndarray  # of the strokes, m/s, ascending [strokes]
    db: np.ndarray  # [strokes, partials]

    def __repr__(self) -> str:
        return summary(self)


class OutputPath(NamedTuple):
    """An output path, given at the frequencies of partials, Hz, ascending.

    Between them it is linear in log frequency, beyond them constant.
    """

    frequency: np.ndarray
    db: np.ndarray
    velocity_discrepancy: VelocityDiscrepancy | None = None  # for predictions only; playback uses one path

    def __repr__(self) -> str:
        return summary(self)

    def at(self, frequency: np.ndarray) -> np.ndarray:
        """Return the path in dB at `frequency`, Hz [frequencies]; for a given partial its own value."""
        interpolated = np.interp(np.log(np.maximum(frequency, 1e-9)), np.log(self.frequency), self.db)
        nearest, is_same = self._nearest(frequency)
        return np.where(is_same, self.db[nearest], interpolated)

    def velocity_discrepancy_db(self, frequency: np.ndarray, velocity: np.ndarray) -> np.ndarray:
        """Velocity discrepancy of strokes of `velocity`, m/s, at `frequency`, Hz: dB [velocities, frequencies].

        It is interpolated by `at_velocity`, and zero at frequencies that are not partials.
        """
        if (discrepancy := self.velocity_discrepancy) is None:
            return np.zeros((len(velocity), len(frequency)))
        nearest, is_same = self._nearest(frequency)
        return np.where(is_same, at_velocity(discrepancy.velocity, discrepancy.db[:, nearest], velocity), 0.0)

    def has(self, frequency: float) -> bool:
        """Return whether the path is given at `frequency`, Hz, and not only between or beyond its partials."""
        return bool(self._nearest(np.array([frequency]))[1][0])

    def _nearest(self, frequency: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Index of the nearest given partial for each `frequency`, and whether it is the same partial."""
        nearest = np.abs(frequency[:, None] - self.frequency).argmin(axis=1)
        return nearest, np.abs(frequency / self.frequency[nearest] - 1) < SAME_PARTIAL_TOLERANCE


def at_velocity(stroke_velocity: np.ndarray, rows: np.ndarray, velocity: Any) -> np.ndarray:
    """Interpolate rows of strokes to other velocities: linear in log velocity, constant beyond the last stroke.

    Parameters
    ----------
    stroke_velocity, rows : velocities of the strokes, m/s, ascending [strokes], and their values [strokes, ...].
    velocity : m/s, a number or an array [velocities], which is then the first axis of the result.
    """
    index = np.asarray(np.interp(np.log(velocity), np.log(stroke_velocity), np.arange(len(stroke_velocity))))
    low, high = (rows[rounded(index).astype(int)] for rounded in (np.floor, np.ceil))
    return low + (index % 1).reshape(*index.shape, *(1,) * (rows.ndim - 1)) * (high - low)


def sample_at_modes(path: OutputPath | None, pole: np.ndarray) -> OutputPath | None:
    """Return the path at the frequencies of modes of complex `pole`, 1/s [modes]; None without a path."""
    if path is None:
        return None
    frequency = np.abs(pole) / (2 * np.pi)  # |pole| is ascending at any damping
    return OutputPath(frequency, path.at(frequency))


def impulse_response(path: OutputPath | None, rate: float) -> np.ndarray | None:
    """Return the minimum-phase impulse response of a path [samples] at `rate`, Hz.

    Levels do not determine phases, but a path is causal. During contact modes follow the hammer far below their own
    frequencies, so factors on single modes cannot replace this filter. Between neighbouring partials the level is a
    smooth step. It is flat around each partial, whose peak has a width, and beyond the lowest and highest partial.
    """
    if path is None:
        return None
    size = 2 ** math.ceil(math.log2(MIN_RESPONSE_S * rate))
    order, frequency = np.arange(len(path.frequency)), np.fft.rfftfreq(size, 1 / rate)
    index, fraction = np.divmod(np.interp(frequency, path.frequency, order), 1.0)
    step = index + fraction**2 * (3 - 2 * fraction)
    level = math.log(10) / 20 * np.interp(step, order, path.db)
    # The cepstrum of a causal response with a causal inverse is causal (Oppenheim and Schafer).
    cepstrum = np.fft.irfft(level, size)
    cepstrum[1 : size // 2] *= 2
    cepstrum[size // 2 + 1 :] = 0
    return np.fft.irfft(np.exp(np.fft.rfft(cepstrum)), size)[: size // 2]


def apply_filter(sound: np.ndarray, response: np.ndarray | None) -> np.ndarray:
    """Filter a sound [samples] and append the decay of the filter; without a filter return it unchanged."""
    return sound if response is None or not len(sound) else convolve(sound, response)
