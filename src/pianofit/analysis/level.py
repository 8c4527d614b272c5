"""The level of a partial: its energy in the first 0.35 s under exp(-8t).

It is computed from the energy of the first 2 s, converted to that span by the decay law
(`baseband_fit.measure_levels`). A partial that was not detected has an upper bound: the level of an exponential with
all the energy in its band.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .demodulation import demodulate

__all__ = ["absent_level_bounds", "energy_level", "mean_time"]

LEVEL_SECONDS = 0.35  # s
LEVEL_RATE = 16.0  # 1/s, decay rate of the weight on power
_MAX_DECAY = 40.0  # 1/s, upper bound of the decay law extrapolated beyond the detected partials
_NULL = 0.97  # first zero of an absent partial's band, in spacings of the partials


def energy_level(amplitude: NDArray[np.complex128], pole: NDArray[np.complex128]) -> np.ndarray:
    """10 log10 ½ ∫_0^0.35s |Σ_i c_i exp(p_i t)|² exp(−16 t) dt, in closed form; dB re full scale² · s, [partials].

    The energy of the real signal without the part that oscillates at twice its frequency. That part depends on the
    phase of the partial at the onset and carries no information on the strike.

    Parameters
    ----------
    amplitude, pole : complex [partials, components], c (full scale) and p (1/s)
    """

    def integral(rate: np.ndarray) -> np.ndarray:
        x = (rate - LEVEL_RATE) * LEVEL_SECONDS
        x = np.where(np.abs(x) < 1e-12, 1e-12, x)
        return LEVEL_SECONDS * np.expm1(x) / x

    c, d = amplitude[:, :, None], amplitude[:, None, :]
    p, q = pole[:, :, None], pole[:, None, :]
    energy = np.sum(c * d.conj() * integral(p + q.conj()), axis=(1, 2)).real / 2
    return 10 * np.log10(np.maximum(energy, 1e-60))


def mean_time(decay: np.ndarray) -> np.ndarray:
    """Mean time, s, of the energy in the level; d level / d log|envelope|(t) is centred there.

    Parameters
    ----------
    decay : 1/s, any shape
    """
    x = (2 * np.maximum(decay, -7.0) + LEVEL_RATE) * LEVEL_SECONDS
    return LEVEL_SECONDS * (1 / x - 1 / np.expm1(x))


def absent_level_bounds(
    samples: np.ndarray, rate: int, frequency: np.ndarray, decay: np.ndarray, f0: float, skip: float
) -> np.ndarray:
    """Upper bounds on the levels of partials that were not detected, dB re full scale² · s, [absent].

    Each is the level of an exponential of that frequency and decay with all the energy in the band, including noise.
    The band falls to zero at the neighbours. At 0.3 spacings it is 5.5 dB down.

    Parameters
    ----------
    samples : [samples] at `rate` (Hz), beginning at the onset
    frequency, decay : [absent], Hz and 1/s, from the laws of the string
    f0 : Hz
    skip : end of the contact, s
    """
    if not len(frequency):
        return np.zeros(0)
    decay = np.minimum(decay, _MAX_DECAY)
    bands = demodulate(samples[:rate], rate, frequency, _NULL * f0, skip)
    frames = bands.frames_within(0.0, LEVEL_SECONDS, least=1)
    z, t = bands.z[:, frames], bands.time[frames]
    pole = -decay + 2j * np.pi * (frequency - bands.centre)
    wave = np.abs(bands.gain(pole) / 2)[:, None] * np.exp(-decay[:, None] * t)
    weight = np.exp(-LEVEL_RATE * t)
    power = (np.abs(z) ** 2 @ weight) / (wave**2 @ weight)
    return energy_level(np.sqrt(power)[:, None], (-decay + 2j * np.pi * frequency)[:, None])
