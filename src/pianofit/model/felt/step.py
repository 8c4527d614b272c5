"""One step of the felt: the package's first laws by a solver of their own, all others by what their law says."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
from jaxtyping import Array

from ...felt import law_of
from ..precision import float64
from . import own, relaxing
from .relaxing import memory_weights, remember

__all__ = ["compression", "felt_force", "force", "memory_weights", "remember"]


def _generic(hammer: Any) -> bool:
    return law_of(hammer).hammers is None


@float64
def felt_force(u: Array | float, w: Array | float, hammer: Any, memory: Any = 0.0, share: Any = 0.0) -> Array:
    """Felt force, N, at compression `u`, m, and compression speed `w`, m/s (paper eq. 8, with u = y_H - y_s).

    For a felt that remembers, c is `memory`, m^p, and `share` of u^p; see `relaxing`.
    """
    u, w = jnp.asarray(u), jnp.asarray(w)
    return own.felt_force(u, w, hammer) if _generic(hammer) else relaxing.felt_force(u, w, hammer, memory, share)


def compression(e, u_old, w_old, f_old, c, a, hammer: Any, weights=None, memory: Any = None):
    """The root u of u + C (F(u) + F_old) = e. `memory` is what `remember` returned."""
    if _generic(hammer):
        return own.compression(e, u_old, w_old, f_old, c, a, hammer)
    return relaxing.compression(e, u_old, w_old, f_old, c, a, hammer, weights, memory)


def force(u, w, upper, c, a, hammer: Any, weights=None, memory: Any = None):
    """F_n at the root."""
    if _generic(hammer):
        return own.force(u, w, upper, c, a, hammer)
    return relaxing.force(u, w, upper, c, a, hammer, weights, memory)
