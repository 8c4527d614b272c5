"""The level of a partial: its energy in the first 0.35 s after the onset under exp(-8t), in closed form.

The energy is that of the real signal without the part that oscillates at twice its frequency. That part depends on the
phase of the partial at the onset and carries no information on the strike.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

LEVEL_SECONDS = 0.35
LEVEL_RATE = 16.0  # 1/s, decay rate of the weight on power


def level_energy(decay: Any, xp: Any = np) -> Any:
    """∫ exp(-(decay + 16)t) dt, s [...], over the 0.35 s of a level, for the `decay` rate of a power, 1/s.

    Parameters
    ----------
    decay : real or complex, any shape
    xp : NumPy, or jax.numpy for JAX arrays
    """
    x = -(decay + LEVEL_RATE) * LEVEL_SECONDS
    x = xp.where(xp.abs(x) < 1e-12, 1e-12, x)
    return LEVEL_SECONDS * xp.expm1(x) / x


def energy_level(amplitude: NDArray[np.complex128], pole: NDArray[np.complex128]) -> np.ndarray:
    """10 log10 ½ ∫_0^0.35s |Σ_i c_i exp(p_i t)|² exp(−16 t) dt, dB re full scale² · s, [partials].

    Parameters
    ----------
    amplitude, pole : complex [partials, components], c (full scale) and p (1/s)
    """
    c, d = amplitude[:, :, None], amplitude[:, None, :]
    p, q = pole[:, :, None], pole[:, None, :]
    energy = np.sum(c * d.conj() * level_energy(-(p + q.conj())), axis=(1, 2)).real / 2
    return 10 * np.log10(np.maximum(energy, 1e-60))


def mean_time(decay: np.ndarray) -> np.ndarray:
    """Mean time, s, of the energy in the level, for the `decay`, 1/s; d level / d log|envelope|(t) is centred there."""
    x = (2 * np.maximum(decay, -7.0) + LEVEL_RATE) * LEVEL_SECONDS
    return LEVEL_SECONDS * (1 / x - 1 / np.expm1(x))
