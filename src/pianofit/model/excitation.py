"""A string pulled aside and let go: the excitation that needs no hammer."""

from __future__ import annotations

import jax.numpy as jnp

from .contact import FreeMotion, free_motion
from .modes import Modes
from .precision import float64

__all__ = ["pluck"]


@float64
def pluck(modes: Modes, force: float = 1.0) -> FreeMotion:
    """The motion after a steady `force`, N, on the table's contact window is let go.

    Of a mode under a steady force no more is left than its compliance. For `levels`, `waveform` and `spectrum`.
    """
    return free_motion(modes, force * modes.drive / modes.omega2, jnp.zeros_like(modes.omega2), 1)
