"""What an argument of the model may be, by its name: one name has one meaning in all of its functions."""

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
    """Whether a value is a number, or an array or a tracer of numbers."""
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
    """Whether a value is a `kind` of named tuple with these `fields`, among them, and numbers in all of its own."""

    def is_one(value: Any) -> bool:
        there = getattr(value, "_fields", ())
        return isinstance(value, kind) and {*fields} <= {*there} and all(map(is_numeric, value))

    return is_one


def _is_scalar(value: Any) -> bool:
    return is_numeric(value) and np.ndim(value) == 0


NUMBER, WHOLE = (_is_scalar, "a number"), (_is_whole, "a whole number above 0")
ARRAY, TEXT = (_is_array, "an array of numbers"), (lambda value: isinstance(value, str), "a text")
KINDS: Mapping[str, tuple[Callable[[Any], bool], str]] = {
    "string": (_numbers_of(kind=String), "a String of numbers"),
    "geometry": (_numbers_of(kind=Geometry), "a Geometry of numbers"),
    "hammer": (_numbers_of("v_H0"), "a Hammer, a RelaxingHammer or a FeltLaw's hammer, of numbers"),
    "modes": (_numbers_of("omega2", "pole"), "a table of modes, as mode_table returns it"),
    "free": (_numbers_of("amplitude", "energy"), "a free motion, as pluck returns it"),
    "rate": NUMBER, "sigma": (is_numeric, "a number"), "length": NUMBER, "force": NUMBER,
    "drive": ARRAY, "frequency": ARRAY, "strike_weights": ARRAY,
    "n_modes": WHOLE, "steps": WHOLE, "samples": (_is_count, "a whole number from 0"), "oversampling": WHOLE,
    "quantity": TEXT, "kind": TEXT,
}  # fmt: skip


def check_arguments(signature: inspect.Signature, args: tuple, kwargs: Mapping[str, Any]) -> None:
    """Refuse an argument that is not what its name says; None is what a default of None allows.

    Raises
    ------
    ParameterError
        Naming the argument, the value and what it must be.
    """
    try:
        given = signature.bind(*args, **kwargs).arguments
    except TypeError:  # one too many or too few, which the call itself refuses
        return
    for name, value in given.items():
        is_one, must = KINDS.get(name, (None, ""))
        if is_one is None or (value is None and signature.parameters[name].default is None) or is_one(value):
            continue
        check_type(f"{name}=", value, (), must)
