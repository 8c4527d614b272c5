"""A string pulled aside and let go: the excitation that needs no hammer."""

from __future__ import annotations

import jax.numpy as jnp

from .contact import FreeMotion, free_motion
from .modes import Modes
from .x64 import float64

__all__ = ["pluck"]


@float64
def pluck(modes: Modes, force: float = 1.0) -> FreeMotion:
    """The motion after a steady force on the table's contact window is let go.

    Of a mode under a steady force no more is left than its compliance. For `levels`, `waveform` and `spectrum`, and
    for `strike`.

    Parameters
    ----------
    modes : the table, see `mode_table`.
    force : N.

    Returns
    -------
    The free motion: `amplitude`, complex, m [modes]; `speed`, m/s; `energy`, J.

    Raises
    ------
    ParameterError
        Where it is traced in float32.

    Examples
    --------
    >>> import pianofit
    >>> it = pianofit.preset("bensa-final")
    >>> modes = pianofit.mode_table(it.string, it.geometry, rate=88_200.0, n_modes=64)
    >>> f"{1e6 * pianofit.pluck(modes, 2.0).energy:.1f} μJ"
    '356.6 μJ'
    """
    return free_motion(modes, force * modes.modal_gain / modes.omega2, jnp.zeros_like(modes.omega2))
