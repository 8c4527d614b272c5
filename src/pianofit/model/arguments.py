"""Type checks of the model's arguments by their names: a name has the same meaning in all functions."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from numbers import Integral, Real
from typing import Any

import jax
import numpy as np

from ..errors import check_type
from ..parameters import Geometry, String

__all__ = ["check_arguments", "is_numeric"]


def is_numeric(value: Any) -> bool:
    """Return true for a number, and for an array or a tracer of numbers."""
    if isinstance(value, np.ndarray | np.generic | jax.Array):
        return np.issubdtype(value.dtype, np.number)
    return isinstance(value, Real) and not isinstance(value, bool)


def _is_array(value: Any) -> bool:
    return isinstance(value, np.ndarray | jax.Array) and np.issubdtype(value.dtype, np.number)


def _is_whole(value: Any, least: int = 1) -> bool:
    if isinstance(value, jax.Array):
        return np.issubdtype(value.dtype, np.integer)
    return isinstance(value, Integral) and not isinstance(value, bool) and int(value) >= least


def _is_count(value: Any) -> bool:
    return _is_whole(value, 0)


def _numbers_of(*fields: str, kind: type = tuple) -> Callable[[Any], bool]:
    """Return a test for named tuples of a `kind` that have at least these `fields` and hold only numbers."""

    def is_valid(value: Any) -> bool:
        present = getattr(value, "_fields", ())
        return isinstance(value, kind) and {*fields} <= {*present} and all(map(is_numeric, value))

    return is_valid


def _is_scalar(value: Any) -> bool:
    return is_numeric(value) and np.ndim(value) == 0


NUMBER, WHOLE = (_is_scalar, "a number"), (_is_whole, "a whole number above 0")
ARRAY, TEXT = (_is_array, "an array of numbers"), (lambda value: isinstance(value, str), "a string")
KINDS: Mapping[str, tuple[Callable[[Any], bool], str]] = {
    "string": (_numbers_of(kind=String), "a String of numbers"),
    "geometry": (_numbers_of(kind=Geometry), "a Geometry of numbers"),
    "hammer": (_numbers_of("v_H0"), "a Hammer, a RelaxingHammer or a hammer of a FeltLaw, of numbers"),
    "modes": (_numbers_of("omega2", "pole"), "a table of modes, as mode_table returns it"),
    "free": (_numbers_of("amplitude", "energy"), "a free motion, as pluck returns it"),
    "rate": NUMBER, "sigma": (is_numeric, "a number"), "length": NUMBER, "force": NUMBER,
    "drive": ARRAY, "frequency": ARRAY, "strike_weights": ARRAY,
    "n_modes": WHOLE, "steps": WHOLE, "samples": (_is_count, "a whole number from 0"), "oversampling": WHOLE,
    "quantity": TEXT, "kind": TEXT,
}  # fmt: skip


def check_arguments(signature: inspect.Signature, args: tuple, kwargs: Mapping[str, Any]) -> None:
    """Reject an argument of the wrong type. None is allowed where it is the default.

    Raises
    ------
    ParameterError
        If an argument has the wrong type. The message names argument, value and required type.
    """
    try:
        given = signature.bind(*args, **kwargs).arguments
    except TypeError:  # wrong number of arguments: the call itself raises
        return
    for name, value in given.items():
        is_valid, requirement = KINDS.get(name, (None, ""))
        if is_valid is None or (value is None and signature.parameters[name].default is None) or is_valid(value):
            continue
        check_type(f"{name}=", value, (), requirement)
