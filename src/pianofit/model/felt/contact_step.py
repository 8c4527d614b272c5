"""One time step of the felt: `relaxing` solves it for the package's laws, `user_law` for all others."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
from jaxtyping import Array

from ...felt import law_of
from ..x64 import float64
from . import relaxing, user_law
from .relaxing import memory_weights, update_relaxation

__all__ = ["compression", "felt_force", "force", "memory_weights", "update_relaxation"]


def _solver(hammer: Any) -> Any:
    """Return the module with `felt_force`, `root` and `residual` for the law of a hammer."""
    return user_law if law_of(hammer).hammers is None else relaxing


@float64
def felt_force(u: Array | float, w: Array | float, hammer: Any, memory: Any = 0.0, share: Any = 0.0) -> Array:
    """Felt force, N, at compression `u`, m, and compression speed `w`, m/s (paper eq. 8, with u = y_H - y_s).

    For a relaxing felt, c is `memory`, m^p, plus `share` times u^p; see `relaxing`.
    """
    return _solver(hammer).felt_force(jnp.asarray(u), jnp.asarray(w), hammer, memory, share)


def compression(e, u_old, w_old, f_old, c, a, hammer: Any, weights=None, memory: Any = None):
    """The root u of u + C (F(u) + F_old) = e. `memory` is the result of `update_relaxation`."""
    upper = e - c * f_old
    root = _solver(hammer).root(jnp.maximum(upper, 0.0), u_old, w_old, c, a, hammer, weights, memory)
    return jnp.where(upper > 0, root, upper)


def force(u, w, upper, c, a, hammer: Any, weights=None, memory: Any = None):
    """F_n from the felt law, or from the displacement of string and hammer, whichever amplifies rounding of u less."""
    solver = _solver(hammer)
    from_law = solver.felt_force(u, w, hammer, *(() if weights is None else (memory, weights.new)))
    _, slope = solver.residual(u, upper, u - a * w, 0.0, c, a, hammer, weights, memory)
    return jnp.where((from_law > 0) & (slope > 2), (upper - u) / c, from_law)
