"""Computation in float64 and with the default settings of JAX, independent of the caller's settings.

JAX computes in float32 unless a process-wide switch is set. A library that sets it would change every program of its
user. JAX also has its settings as contexts, for one thread and one block of code. All computations of this package run
inside such contexts: settings of the caller have no effect on them and stay unchanged. Results are float64. They are
arrays of JAX if the caller is inside the context, else of NumPy, since JAX would convert its own to float32.

If a function is traced, a context inside it is not sufficient: JAX applies its rules for derivatives and batches later,
outside the context, and mixes the precisions. The caller then has to open the context. Each traced result carries a
mark, which raises an error if it is differentiated in reverse mode outside the context.

The outermost call also checks the types of its arguments by their names: a name has the same meaning in all functions.
"""

from __future__ import annotations

import functools
import inspect
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from numbers import Integral, Real
from typing import Any, ParamSpec, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir
from jaxtyping import Array

from .errors import FitError, ParameterError, check_type
from .io.files import printable
from .parameters import Geometry, String
from .threads import check_process

# Arrays of JAX, traced ones included, or of NumPy.
AnyArray = Array | np.ndarray

P = ParamSpec("P")
R = TypeVar("R")

# The settings of JAX that affect this package, each as a context and the value that the code assumes. Intermediate
# results may be infinite or NaN and are masked afterwards.
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
    (jax.disable_jit, False),
    (jax.transfer_guard, "allow"),
)
_now = threading.local()  # `inside`: true while this thread is in the scope


@contextmanager
def x64_scope() -> Iterator[None]:
    """Open the context in which JAX computes in float64, for this thread only: each thread of a pool has to open it.

    Raises
    ------
    FitError
        In a process that was forked after JAX had started, and if JAX has no device.
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
    except Exception as error:  # the class depends on the platform plugin that is missing
        reason = printable(str(error).partition("\n")[0]) or type(error).__name__
        raise FitError(
            f"JAX cannot start with JAX_PLATFORMS={jax.config.values['jax_platforms']} ({reason}); set "
            "JAX_PLATFORMS=cpu, or unset it"
        ) from None


def float64(function: Callable[P, R]) -> Callable[P, R]:
    """Wrap `function` to compute in float64; arrays of other floating types are converted first.

    Raises
    ------
    ParameterError
        For an argument of the wrong type, and if the function or its derivative is traced outside the scope.
    """
    signature = inspect.signature(function)

    @functools.wraps(function)
    def call(*args: P.args, **kwargs: P.kwargs) -> R:
        outside, outermost = not _is_x64(), not getattr(_now, "inside", False)
        if outermost:
            _check_arguments(signature, args, kwargs)
        if outside:
            _reject_traced((args, kwargs), function.__name__)
        with x64_scope():
            args, kwargs = jax.tree.map(_to_float64, (args, kwargs))
            result = function(*args, **kwargs)
            if not outside:
                return jax.tree.map(_marked, result) if outermost else result
        _reject_traced(result, function.__name__)  # under `jit` constants are traced too
        return jax.tree.map(_to_numpy, result)

    return call


def derivative(rule: Callable[P, R]) -> Callable[P, R]:
    """Wrap the rule of a custom derivative, which JAX may apply after the scope was closed.

    Raises
    ------
    ParameterError
        If the rule is applied outside the scope of the caller too.
    """

    @functools.wraps(rule)
    def call(*args: P.args, **kwargs: P.kwargs) -> R:
        if not _is_x64():
            raise _scope_error("a derivative")
        with x64_scope():
            return rule(*args, **kwargs)

    return call


def _reject_traced(tree: Any, name: str) -> None:
    if any(isinstance(x, Tracer) for x in jax.tree.leaves(tree)):
        raise _scope_error(name)


def _scope_error(name: str) -> ParameterError:
    return ParameterError(
        f"{name} is traced by jit, vmap or grad in float32, and needs float64; call the transformed function "
        "inside `with jax.enable_x64(True):`, and do not open that context within the function"
    )


def _marked(x: Any) -> Any:
    return _mark.bind(x) if isinstance(x, Tracer) and jnp.issubdtype(x.dtype, jnp.inexact) else x


def _transposed(cotangent: Any, _: Any) -> list[Any]:
    if not _is_x64():
        raise _scope_error("a derivative")
    return [cotangent]


# The identity, except that its transpose, which reverse mode applies, needs the scope.
_mark = Primitive("pianofit_float64")
_mark.def_impl(lambda x: x)
_mark.def_abstract_eval(lambda x: x)
ad.deflinear2(_mark, _transposed)
batching.defvectorized(_mark)
mlir.register_lowering(_mark, lambda _, x: [x])


def _is_x64() -> bool:
    """Return true inside the scope."""
    return jax.dtypes.canonicalize_dtype(np.float64) == np.float64


def _to_numpy(x: Any) -> Any:
    return np.asarray(x) if isinstance(x, jax.Array) else x


def _to_float64(x: Any) -> Any:
    if not isinstance(x, jax.Array | np.ndarray | np.generic):
        return x
    if jnp.issubdtype(x.dtype, jnp.floating):
        return x if x.dtype == np.float64 else x.astype(np.float64)
    return x.astype(np.complex128) if x.dtype == np.complex64 else x


def is_numeric(value: Any) -> bool:
    """Return true for a number, and for an array or a tracer of numbers."""
    if isinstance(value, np.ndarray | np.generic | jax.Array):
        return np.issubdtype(value.dtype, np.number)
    return isinstance(value, Real) and not isinstance(value, bool)


def _is_array(value: Any) -> bool:
    return isinstance(value, np.ndarray | jax.Array) and is_numeric(value)


def _is_row(value: Any) -> bool:
    return _is_array(value) and value.ndim == 1 and np.isrealobj(value)


def _is_scalar(value: Any) -> bool:
    return is_numeric(value) and np.ndim(value) == 0


def _is_whole(value: Any, least: int = 1) -> bool:
    if isinstance(value, jax.Array):
        return np.issubdtype(value.dtype, np.integer)
    return isinstance(value, Integral) and not isinstance(value, bool) and int(value) >= least


def _is_tuple_of(*fields: str, kind: type = tuple) -> Callable[[Any], bool]:
    """Return a test for named tuples of a `kind` that have at least these `fields` and hold only numbers."""
    return lambda value: (
        isinstance(value, kind) and {*fields} <= {*getattr(value, "_fields", ())} and all(map(is_numeric, value))
    )


# For the names of arguments: a test of the value, and the requirement in words.
KINDS: dict[str, tuple[Callable[[Any], bool], str]] = {
    "string": (_is_tuple_of(kind=String), "a String of numbers"),
    "geometry": (_is_tuple_of(kind=Geometry), "a Geometry of numbers"),
    "hammer": (
        lambda value: _is_tuple_of("v_H0")(value) or _is_tuple_of("force")(value),
        "a Hammer, a SoftHammer, a RelaxingHammer, a hammer of a FeltLaw or a Pluck, of numbers",
    ),
    "modes": (_is_tuple_of("omega2", "pole"), "a table of modes, as mode_table returns it"),
    "free": (_is_tuple_of("amplitude", "energy"), "a free motion, as pluck returns it"),
    "sigma": (is_numeric, "a number"),
    "samples": (lambda value: _is_whole(value, 0), "a whole number from 0"),
    **dict.fromkeys(("rate", "length", "force"), (_is_scalar, "a number")),
    "drive": (lambda value: _is_row(value) and value.size > 0, "an array of real numbers [steps]"),
    "frequency": (_is_row, "an array of real numbers [bins]"),
    "strike_weights": (_is_array, "an array of numbers"),
    **dict.fromkeys(("n_modes", "steps", "oversampling"), (_is_whole, "a whole number above 0")),
    **dict.fromkeys(("quantity", "kind"), (lambda value: isinstance(value, str), "a string")),
}


def _check_arguments(signature: inspect.Signature, args: tuple, kwargs: Mapping[str, Any]) -> None:
    """Raise a `ParameterError` for an argument of the wrong type. None is allowed where it is the default."""
    try:
        given = signature.bind(*args, **kwargs).arguments
    except TypeError:  # wrong number of arguments: the call itself raises
        return
    for name, value in given.items():
        is_valid, requirement = KINDS.get(name, (lambda _: True, ""))
        is_default = value is None and signature.parameters[name].default is None
        if not (is_default or is_valid(value)):
            check_type(f"{name}=", value, (), requirement)
