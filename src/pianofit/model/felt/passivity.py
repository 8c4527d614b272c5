"""What a law of the felt says of itself, computed: whether it gives more than it stores, and its static curve."""

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

# Where a law is tried for giving more than it has stored: compressions, m, and their speeds, m/s.
TRIED_U = np.geomspace(1e-6, 2e-3, 25)
TRIED_W = np.array([-5.0, -1.0, -0.2, 0.2, 1.0, 5.0])
# Rounding that is forgiven there, relative.
ROUNDING = 1e-9


@float64
def check_passive(law: FeltLaw, hammer: Any) -> None:
    """Refuse a hammer whose felt gives more than its law's storage holds.

    Raises
    ------
    ParameterError
        Naming the law, and where it does.
    """
    storage = law.storage
    if storage is None:
        return
    u, w = (jnp.asarray(x.ravel()) for x in np.meshgrid(TRIED_U, TRIED_W))
    stored = jax.vmap(jax.grad(lambda x: jnp.asarray(storage(x, hammer), float)))(u)
    push = felt_force(u, w, hammer)
    given = np.asarray((stored - push) * w)
    worst = int(np.argmax(given))
    if given[worst] > ROUNDING * float(abs(push[worst] * w[worst])):
        raise ParameterError(
            f"felt law {law.name}: at u={float(u[worst]):.2g} m and u̇={float(w[worst]):g} m/s the felt would "
            "give more than its storage holds; the force while it is pressed must be at least the storage's slope, "
            "and while it springs back at most"
        )


@float64
def static_force(u: np.ndarray, hammer: Any, slow: bool = False) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """The static curve of a hammer's felt, and how it moves with each parameter.

    Parameters
    ----------
    u : compressions above 0, m [n].
    slow : pressed slowly, where the law relaxes; else suddenly.

    Returns
    -------
    F, N [n]; by parameter the derivative of log F by its logarithm [n].
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
