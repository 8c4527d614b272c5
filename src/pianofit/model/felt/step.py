"""One step of the felt, by the law that the hammer's type stands for."""

from __future__ import annotations

from typing import Any

from jaxtyping import Array

from ..precision import float64
from . import own, relaxing
from .relaxing import memory_weights, remember

__all__ = ["compression", "felt_force", "force", "memory_weights", "remember"]


@float64
def felt_force(u: Array, w: Array, hammer: Any, memory: Any = 0.0, share: Any = 0.0) -> Array:
    """Felt force, N, at compression `u`, m, and compression speed `w`, m/s (paper eq. 8, with u = y_H - y_s).

    For a felt that remembers, c is `memory`, m^p, and `share` of u^p; see `relaxing`.
    """
    return own.felt_force(u, w, hammer) if own.own_law(hammer) else relaxing.felt_force(u, w, hammer, memory, share)


def compression(e, u_old, w_old, f_old, c, a, hammer: Any, weights=None, memory: Any = None):
    """The root u of u + C (F(u) + F_old) = e. `memory` is what `remember` returned."""
    if own.own_law(hammer):
        return own.compression(e, u_old, w_old, f_old, c, a, hammer)
    return relaxing.compression(e, u_old, w_old, f_old, c, a, hammer, weights, memory)


def force(u, w, upper, c, a, hammer: Any, weights=None, memory: Any = None):
    """F_n at the root."""
    if own.own_law(hammer):
        return own.force(u, w, upper, c, a, hammer)
    return relaxing.force(u, w, upper, c, a, hammer, weights, memory)
