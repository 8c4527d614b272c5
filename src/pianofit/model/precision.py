"""float64 inside, whatever the caller computes in.

JAX computes in float32 unless a process-wide switch is set, and a library that sets it changes every program of its
user. JAX also has that switch as a context, for one thread and one block of code. All that this package computes runs
inside it. What comes back is float64: of NumPy where the caller is outside, since JAX would narrow its own arrays there
with a warning, and of JAX where the caller is inside.

A context opened inside of a function is not enough where that function is traced: JAX applies its rules for derivatives
and batches later, outside of it, and mixes the two precisions. There the caller has to open it.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array

from ..errors import ParameterError

__all__ = ["AnyArray", "float64", "scope"]

# What is computed with: arrays of JAX, traced ones among them, or of NumPy.
AnyArray = Array | np.ndarray

P = ParamSpec("P")
R = TypeVar("R")


def scope() -> Any:
    """The context in which JAX computes in float64, in this thread only: a pool's threads have to enter it too."""
    return jax.enable_x64(True)


def float64(function: Callable[P, R]) -> Callable[P, R]:
    """`function` in float64, its arrays of other floating types (NumPy's, JAX's, traced ones) widened first.

    Raises
    ------
    ParameterError
        Where it is traced outside of the scope.
    """

    @functools.wraps(function)
    def call(*args: P.args, **kwargs: P.kwargs) -> R:
        outside = not _wide()
        if outside:
            _refuse_traced((args, kwargs), function.__name__)
        with scope():
            args, kwargs = jax.tree.map(_widened, (args, kwargs))
            result = function(*args, **kwargs)
        if not outside:
            return result
        _refuse_traced(result, function.__name__)  # as under `jit`, where even constants are
        return jax.tree.map(_of_numpy, result)

    return call


def _refuse_traced(tree: Any, name: str) -> None:
    if any(isinstance(x, Tracer) for x in jax.tree.leaves(tree)):
        raise ParameterError(
            f"{name} is traced by jit, vmap or grad in float32, and needs float64; call your transformed function "
            "inside `with jax.enable_x64(True):`"
        )


def _wide() -> bool:
    """Whether this thread is inside the scope."""
    return jax.dtypes.canonicalize_dtype(np.float64) == np.float64


def _of_numpy(x: Any) -> Any:
    return np.asarray(x) if isinstance(x, jax.Array) else x


def _widened(x: Any) -> Any:
    if not isinstance(x, jax.Array | np.ndarray | np.generic):
        return x
    if jnp.issubdtype(x.dtype, jnp.floating):
        return x if x.dtype == np.float64 else x.astype(np.float64)
    return x.astype(np.complex128) if x.dtype == np.complex64 else x
