"""What lies between the string and the file: pickup, soundboard and microphone, as a filter of unknown phase.

Every partial has a level through the path, and a decay of its own. A file is the modes with those decays, through a
filter with those levels.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from scipy.signal import oaconvolve

from ..io.number_format import summary
from .free_response import level_energy

__all__ = ["SAME_PARTIAL", "OutputPath", "VelocityDiscrepancy", "at_velocity", "filtered", "impulse", "apply_to_modes"]

# A frequency within this, relative, of a partial's is that partial's: the pitch of recordings differs by cents.
SAME_PARTIAL = 0.005
# A path's response is computed for at least this long, s, and its first half kept: some periods of the lowest note,
# since its neighbours may differ in level.
RESPONSE = 1.0


class VelocityDiscrepancy(NamedTuple):
    """What partials in strokes of known velocity have over hammer and path; strokes of like velocity have it alike."""

    velocity: np.ndarray  # of the strokes, m/s, rising [strokes]
    db: np.ndarray  # [strokes, partials]

    def __repr__(self) -> str:
        return summary(self)


class OutputPath(NamedTuple):
    """A path known at some partials' frequencies, Hz, ascending.

    In between it is linear in log frequency, beyond it is level.
    """

    frequency: np.ndarray
    db: np.ndarray
    decay: np.ndarray | None = None  # of each partial's decay rate over that of the string's law
    wander: VelocityDiscrepancy | None = None  # of predictions; what is played goes through one path

    def __repr__(self) -> str:
        return summary(self)

    def at(self, frequency: np.ndarray) -> np.ndarray:
        """The path in dB at `frequency`, Hz [any number]: a partial's own, if it is one that is known."""
        between = np.interp(np.log(np.maximum(frequency, 1e-9)), np.log(self.frequency), self.db)
        nearest, near = self._nearest(frequency)
        return np.where(near, self.db[nearest], between)

    def decay_at(self, frequency: np.ndarray) -> np.ndarray:
        """Decay rate over the law's at `frequency`, Hz: a partial's own, and 1 where none was heard."""
        if self.decay is None:
            return np.ones(len(frequency))
        nearest, near = self._nearest(frequency)
        return np.where(near, self.decay[nearest], 1.0)

    def velocity_discrepancy_db(self, frequency: np.ndarray, velocity: np.ndarray) -> np.ndarray:
        """What strokes of `velocity`, m/s, have over the path at `frequency`, Hz: dB [velocities, frequencies].

        As `at_velocity` has it; of what is no partial it is nought.
        """
        if self.wander is None:
            return np.zeros((len(velocity), len(frequency)))
        nearest, near = self._nearest(frequency)
        return np.where(near, at_velocity(self.wander.velocity, self.wander.db[:, nearest], velocity), 0.0)

    def _nearest(self, frequency: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Which of the path's partials is next to each `frequency`, and whether it is the same."""
        nearest = np.abs(frequency[:, None] - self.frequency).argmin(axis=1)
        return nearest, np.abs(frequency / self.frequency[nearest] - 1) < SAME_PARTIAL


def at_velocity(known: np.ndarray, rows: np.ndarray, velocity: Any) -> np.ndarray:
    """What has a row a stroke, at other velocities: between strokes linear in log velocity, beyond them the last's.

    Parameters
    ----------
    known, rows : velocities of the strokes, m/s, rising [strokes], and what they have [strokes, ...].
    velocity : m/s, one or many [velocities]; those are then the first axis of the result.
    """
    place = np.asarray(np.interp(np.log(velocity), np.log(known), np.arange(len(known))))
    low, high = (rows[end(place).astype(int)] for end in (np.floor, np.ceil))
    return low + (place % 1).reshape(*place.shape, *(1,) * (rows.ndim - 1)) * (high - low)


def apply_to_modes(path: OutputPath | None, pole: np.ndarray) -> tuple[OutputPath | None, np.ndarray]:
    """What a path makes of modes of complex `pole`, 1/s [modes]: the filter they go through, and their poles.

    Every partial has a level of its own, which is the filter's, and a decay of its own, at which that level stays.
    """
    if path is None:
        return None, pole
    frequency, law = np.abs(pole) / (2 * np.pi), -np.real(pole)  # ascending, however damped
    own = law * path.decay_at(frequency)
    held = 10 * np.log10(level_energy(2 * law) / level_energy(2 * own))
    return OutputPath(frequency, path.at(frequency) + held), -own + 1j * np.imag(pole)


def impulse(path: OutputPath | None, rate: float) -> np.ndarray | None:
    """A path's response to an impulse [samples] at `rate`, of the least phase that its levels allow.

    Levels tell no phases, but a path hears nothing before it sounds. While the hammer holds the string down, modes
    follow it far below their own frequencies, so no factor on each mode can stand for this filter. From one of the
    path's partials to the next it leads by a smooth step: about each it is level, as a partial's line has a width. So
    it is below the lowest and above the highest, where nothing is known.
    """
    if path is None:
        return None
    size = 2 ** math.ceil(math.log2(RESPONSE * rate))
    order, frequency = np.arange(len(path.frequency)), np.fft.rfftfreq(size, 1 / rate)
    before, between = np.divmod(np.interp(frequency, path.frequency, order), 1.0)
    step = before + between**2 * (3 - 2 * between)
    level = math.log(10) / 20 * np.interp(step, order, path.db)
    # The cepstrum of a causal response with a causal inverse is causal (Oppenheim and Schafer).
    cepstrum = np.fft.irfft(level, size)
    cepstrum[1 : size // 2] *= 2
    cepstrum[size // 2 + 1 :] = 0
    return np.fft.irfft(np.exp(np.fft.rfft(cepstrum)), size)[: size // 2]


def filtered(sound: np.ndarray, response: np.ndarray | None) -> np.ndarray:
    """The sound [samples] through a filter, and what the filter rings on; without one as it is."""
    return sound if response is None or not len(sound) else oaconvolve(sound, response)
