"""Steps of a felt in contact with a string, and its static force. They are computed with JAX.

`relaxing` has the solver that the laws of this package share, `any_law` the one for all others.
"""

from __future__ import annotations

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ...x64 import float64
from .. import FeltLaw, law_of
from . import any_law, relaxing
from .relaxing import memory_weights, update_relaxation


def _solver(hammer: Any) -> Any:
    """Return the module with `felt_force`, `root` and `residual` for the law of a hammer."""
    return any_law if law_of(hammer).hammers is None else relaxing


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


@float64
def static_force(
    u: Float[np.ndarray, " n"], hammer: Any, slow: bool = False
) -> tuple[Float[np.ndarray, " n"], dict[str, Float[np.ndarray, " n"]]]:
    """Compute the static force curve of a felt, and its derivatives by the parameters.

    Parameters
    ----------
    u : compressions above 0, m [n].
    slow : slow compression of a relaxing felt; else sudden compression.

    Returns
    -------
    F, N [n]; for each parameter the derivative of log F by its logarithm [n].
    """
    law = law_of(hammer)
    names = tuple(name for name in law.parameters if getattr(hammer, name) > 0)
    at = np.log([float(getattr(hammer, name)) for name in names])
    log, slopes = _log_force(at, u, type(hammer)(*map(np.float64, hammer)), law, names, slow)
    return np.exp(np.asarray(log)), dict(zip(names, np.asarray(slopes).T, strict=True))


@functools.partial(jax.jit, static_argnames=("law", "names", "slow"))
def _log_force(at, u, hammer, law: FeltLaw, names: tuple[str, ...], slow: bool):
    """The logarithm of the static force [n], and its derivatives by the parameters' logarithms `at` [n, names]."""

    def log_force(log_values):
        felt = hammer._replace(**dict(zip(names, jnp.exp(log_values), strict=True)))
        push = law.slow(u, felt) if slow and law.slow else law.force(u, 0.0, felt)
        return jnp.log(jnp.maximum(push, jnp.finfo(float).tiny))

    return log_force(at), jax.jacfwd(log_force)(at)
