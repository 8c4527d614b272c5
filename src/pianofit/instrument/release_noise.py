"""Noise of a key that is let go."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

# Logarithm of the amplitude from release velocity 64 to 127. Chosen: the noise of an impact is proportional to the
# speed of the key, and the speed follows the MIDI velocity as that of hammers does (`VelocityCurve`).
VELOCITY_RISE = 1.5
# Time in which a note reaches 63 % of the noise of a long note, s. Chosen: a key that is let go this early has not come
# to rest at its bottom, so it returns over a shorter way and more slowly.
SOUNDING_TIME = 0.1


@dataclass(frozen=True, eq=False)
class ReleaseNoise:
    """Recorded noises of keys that are let go while their strings are silent.

    Parameters
    ----------
    sounds : noises by MIDI number, file units [channels, samples]. There is at least one.
    rate : their sample rate, Hz.
    """

    sounds: Mapping[int, np.ndarray]
    rate: int

    def sound(self, midi: int, velocity: int, seconds: float, rate: int) -> np.ndarray:
        """Return the noise of a key, file units [channels, samples].

        Parameters
        ----------
        midi : MIDI number of the key. A key without a recording has the noise of the nearest recorded key.
        velocity : MIDI release velocity, 0 to 127. 64 is the velocity of the recording.
        seconds : time since the stroke. Long notes have the noise as recorded.
        rate : sample rate, Hz.
        """
        from scipy.signal import resample_poly

        nearest = min(self.sounds, key=lambda key: (abs(key - midi), key))
        gain = math.exp(VELOCITY_RISE * (velocity - 64) / 63) * -math.expm1(-max(seconds, 0.0) / SOUNDING_TIME)
        common = math.gcd(rate, self.rate)
        return gain * resample_poly(self.sounds[nearest], rate // common, self.rate // common, axis=-1)
