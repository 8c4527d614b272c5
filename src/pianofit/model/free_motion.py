"""Free motion of a string: released from an initial shape and velocity, or plucked."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..errors import ParameterError
from ..io.number_format import summary
from ..x64 import float64
from .modes import ComplexModes, Modes, RealModes, RealModesLike


class FreeMotion(NamedTuple):
    """Free motion of a string, q = Re(amplitude · z^n), with its speed and energy."""

    amplitude: ComplexModes  # m
    speed: Float[Array, ""]  # of the string under the hammer at t = 0, m/s, as the scheme computes it
    energy: Float[Array, ""]  # J

    def __repr__(self) -> str:
        return summary(self)


@float64
def project(shape: Callable | np.ndarray, length: float, n_modes: int) -> RealModes:
    """Modal coordinates of an initial shape or velocity: y(x) = Σ q_k sin(β_k x).

    Parameters
    ----------
    shape : a function of x in metres, or its values [points] at the inner points x_i = i L/(points + 1).
    length : L, m.

    Raises
    ------
    ParameterError
        If there are fewer points than modes.
    """
    if callable(shape):
        points = max(4095, 8 * n_modes - 1)
        shape = np.asarray(shape(np.arange(1, points + 1) * (length / (points + 1))))
    values = jnp.asarray(shape)
    points = len(values)
    if points < n_modes:
        raise ParameterError(f"shape has {points} points; {n_modes} modes need at least as many")
    i = jnp.arange(1, points + 1) / (points + 1)
    return jnp.sin(jnp.pi * jnp.arange(1, n_modes + 1)[:, None] * i) @ values * (2 / (points + 1))


@float64
def free_motion(modes: Modes, displacement: RealModesLike, velocity: RealModesLike) -> FreeMotion:
    """The motion of a string released at t = 0 with modal `displacement`, m, and `velocity`, m/s [modes]."""
    rate = modes.free_rate
    amplitude = displacement - 1j * (velocity - rate.real * displacement) / rate.imag
    at_node = modes.modal_gain == 0  # the hammer neither drives nor senses this mode
    mass = jnp.where(at_node, 0.0, modes.strike / jnp.where(at_node, 1.0, modes.modal_gain))
    # The scheme's energy needs the scheme's velocity: p̃ = (z - 1)/(z + 1)/a.
    z_1 = jnp.expm1(modes.pole * modes.step)
    velocity = (amplitude * z_1 / (2 + z_1)).real * (2 / modes.step)
    energy = 0.5 * (mass * (velocity**2 + modes.omega2 * displacement**2)).sum()
    return FreeMotion(jnp.asarray(amplitude), (modes.strike * velocity).sum(), energy)


@float64
def pluck(modes: Modes, force: float = 1.0) -> FreeMotion:
    """Return the free motion after a steady force on the contact window of the table is released.

    The force displaces each mode by its static compliance. The result is an argument of `levels`, `waveform`,
    `spectrum` and `strike`.

    Parameters
    ----------
    modes : the table, see `mode_table`.
    force : the steady force, N.

    Returns
    -------
    The free motion: `amplitude`, complex, m [modes]; `speed`, m/s; `energy`, J.

    Raises
    ------
    ParameterError
        If it is traced in float32.

    Examples
    --------
    >>> import pianofit
    >>> it = pianofit.preset("bensa-final")
    >>> modes = pianofit.mode_table(it.string, it.geometry, rate=88_200.0, n_modes=64)
    >>> f"{1e6 * pianofit.pluck(modes, 2.0).energy:.1f} μJ"
    '356.6 μJ'
    """
    return free_motion(modes, force * modes.modal_gain / modes.omega2, jnp.zeros_like(modes.omega2))
