"""Plucking: a string is displaced by a steady force and released."""

from __future__ import annotations

import jax.numpy as jnp

from ..x64 import float64
from .contact import FreeMotion, free_motion
from .modes import Modes

__all__ = ["pluck"]


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
