"""Properties computed from a felt law: passivity, which is checked, and the static force curve."""

from __future__ import annotations

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ...errors import ParameterError
from ...felt import FeltLaw, law_of
from ..x64 import float64
from .user_law import felt_force

__all__ = ["check_passive", "static_force"]

# Points at which passivity is tested: compressions, m, and their speeds, m/s.
TESTED_U = np.geomspace(1e-6, 2e-3, 25)
TESTED_W = np.array([-5.0, -1.0, -0.2, 0.2, 1.0, 5.0])
# Relative tolerance of this test, for rounding.
TOLERANCE = 1e-9


@float64
def check_passive(law: FeltLaw, hammer: Any) -> None:
    """Reject a hammer whose felt returns more energy than the storage function of its law allows.

    Raises
    ------
    ParameterError
        The message names the law and a point where this happens.
    """
    storage = law.storage
    if storage is None:
        return
    u, w = (jnp.asarray(x.ravel()) for x in np.meshgrid(TESTED_U, TESTED_W))
    stored = jax.vmap(jax.grad(lambda x: jnp.asarray(storage(x, hammer), float)))(u)
    push = felt_force(u, w, hammer)
    excess = np.asarray((stored - push) * w)
    worst = int(np.argmax(excess))
    if excess[worst] > TOLERANCE * float(abs(push[worst] * w[worst])):
        raise ParameterError(
            f"felt law {law.name}: at u={float(u[worst]):.2g} m and u̇={float(w[worst]):g} m/s the felt returns "
            "more energy than it stores; the force must not be below the slope of storage during compression, "
            "and not above it during release"
        )


@float64
def static_force(u: np.ndarray, hammer: Any, slow: bool = False) -> tuple[np.ndarray, dict[str, np.ndarray]]:
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
