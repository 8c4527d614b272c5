"""float64 and JAX's own defaults inside, whatever the caller computes in.

JAX computes in float32 unless a process-wide switch is set, and a library that sets it changes every program of its
user. JAX also has its switches as contexts, for one thread and one block of code. All that this package computes runs
inside them, so a caller's settings do not change it, nor does it change them. What comes back is float64: of NumPy
where the caller is outside, since JAX would narrow its own arrays there with a warning, and of JAX where the caller is
inside.

A context opened inside of a function is not enough where that function is traced: JAX applies its rules for derivatives
and batches later, outside of it, and mixes the two precisions. There the caller has to open it. Every traced result
carries a mark, which refuses to be differentiated backwards outside of the context.
"""

from __future__ import annotations

import functools
import inspect
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Any, ParamSpec, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir
from jaxtyping import Array

from ..errors import FitError, ParameterError
from ..io.files import printable
from ..threads import check_process
from .arguments import check_arguments

__all__ = ["AnyArray", "derivative", "float64", "x64_scope"]

# What is computed with: arrays of JAX, traced ones among them, or of NumPy.
AnyArray = Array | np.ndarray

P = ParamSpec("P")
R = TypeVar("R")

# The settings of JAX that decide what this package's code means, each as a context and the value that it is written
# for. Infinities and nan are intermediate results that are masked afterwards.
SETTINGS: tuple[tuple[Any, Any], ...] = (
    (jax.enable_x64, True),
    (jax.numpy_rank_promotion, "allow"),
    (jax.numpy_dtype_promotion, "standard"),
    (jax.enable_custom_prng, False),
    (jax.legacy_prng_key, "allow"),
    (jax.default_prng_impl, "threefry2x32"),
    (jax.threefry_partitionable, True),
    (jax.debug_nans, False),
    (jax.debug_infs, False),
    (jax.transfer_guard, "allow"),
)
_now = threading.local()  # `inside`: whether this thread is in the scope already


@contextmanager
def x64_scope() -> Iterator[None]:
    """The context in which JAX computes in float64, in this thread only: a pool's threads have to enter it too.

    Raises
    ------
    FitError
        In a process that was forked after JAX had started, and where JAX has no device to compute on.
    """
    if getattr(_now, "inside", False):
        yield
        return
    check_process()
    _check_device()
    with ExitStack() as stack:
        for setting, value in SETTINGS:
            stack.enter_context(setting(value))
        _now.inside = True
        try:
            yield
        finally:
            _now.inside = False


@functools.cache
def _check_device() -> None:
    try:
        jax.local_devices()
    except Exception as error:  # of any class, where a platform's plugin is missing
        reason = printable(str(error).partition("\n")[0]) or type(error).__name__
        raise FitError(
            f"JAX cannot start with JAX_PLATFORMS={jax.config.values['jax_platforms']} ({reason}); set "
            "JAX_PLATFORMS=cpu, or unset it"
        ) from None


def float64(function: Callable[P, R]) -> Callable[P, R]:
    """`function` in float64, its arrays of other floating types (NumPy's, JAX's, traced ones) widened first.

    Raises
    ------
    ParameterError
        For an argument of another kind than its name says; where it is traced outside of the scope, or its derivative.
    """
    signature = inspect.signature(function)

    @functools.wraps(function)
    def call(*args: P.args, **kwargs: P.kwargs) -> R:
        outside, outermost = not _wide(), not getattr(_now, "inside", False)
        if outermost:
            check_arguments(signature, args, kwargs)
        if outside:
            _refuse_traced((args, kwargs), function.__name__)
        with x64_scope():
            args, kwargs = jax.tree.map(_widened, (args, kwargs))
            result = function(*args, **kwargs)
            if not outside:
                return jax.tree.map(_marked, result) if outermost else result
        _refuse_traced(result, function.__name__)  # as under `jit`, where even constants are
        return jax.tree.map(_of_numpy, result)

    return call


def derivative(rule: Callable[P, R]) -> Callable[P, R]:
    """A rule of a custom derivative, which JAX may apply after the scope was left.

    Raises
    ------
    ParameterError
        Where that is outside of the caller's scope too.
    """

    @functools.wraps(rule)
    def call(*args: P.args, **kwargs: P.kwargs) -> R:
        if not _wide():
            raise _outside("a derivative")
        with x64_scope():
            return rule(*args, **kwargs)

    return call


def _refuse_traced(tree: Any, name: str) -> None:
    if any(isinstance(x, Tracer) for x in jax.tree.leaves(tree)):
        raise _outside(name)


def _outside(name: str) -> ParameterError:
    return ParameterError(
        f"{name} is traced by jit, vmap or grad in float32, and needs float64; call your transformed function "
        "inside `with jax.enable_x64(True):`, and do not open that scope within the function"
    )


def _marked(x: Any) -> Any:
    return _mark.bind(x) if isinstance(x, Tracer) and jnp.issubdtype(x.dtype, jnp.inexact) else x


def _transposed(cotangent: Any, _: Any) -> list[Any]:
    if not _wide():
        raise _outside("a derivative")
    return [cotangent]


# The identity, except that its transpose, the step backwards of `grad`, needs the scope.
_mark = Primitive("pianofit_float64")
_mark.def_impl(lambda x: x)
_mark.def_abstract_eval(lambda x: x)
ad.deflinear2(_mark, _transposed)
batching.defvectorized(_mark)
mlir.register_lowering(_mark, lambda _, x: [x])


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
