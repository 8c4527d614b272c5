"""Felt laws, one file each. A law added here is available in `setup.toml`, fits, files and reports.

An instrument accepts only fits whose hammer is a `Hammer` or a `SoftHammer`.

The file of a law holds data and plain arithmetic, so a setup is checked without JAX. `steps`, which the contact
imports, computes the steps of all laws, and `make_hammer` finds a law by its parameters: a new law needs its file only.
"""

import copyreg
import pkgutil
from collections.abc import Mapping
from dataclasses import fields
from importlib import import_module
from typing import Any

from ..errors import ParameterError
from ..excitation import OTHERS, Excitation
from ..parameters import HAMMER_NAMES, PARAMETERS, Hammer, Parameter, check
from .hunt_crossley import HUNT_CROSSLEY, POWER
from .law import COMMON_PARAMETERS, FeltLaw
from .relaxing import RelaxingHammer
from .soft_skin import SOFT_SKIN, SoftHammer

# The felt laws of this package by their name in files.
LAWS: dict[str, FeltLaw] = {
    law.name: law
    for module in pkgutil.iter_modules(__path__)
    if not module.ispkg
    for law in getattr(import_module(f".{module.name}", __name__), "LAWS", ())
}
# The law for setups that name none.
DEFAULT_LAW = SOFT_SKIN
# Unit, meaning and bounds of all parameters that fits with these laws search.
ALL_PARAMETERS: dict[str, Parameter] = PARAMETERS | {n: p for law in LAWS.values() for n, p in law.parameters.items()}


def is_builtin(law: Excitation) -> bool:
    """Return true if a law belongs to this package, so that its name in a file identifies it."""
    return (LAWS | OTHERS).get(law.name) is law


def _builtin_law(name: str) -> FeltLaw:
    return LAWS[name]


def _reduced(law: FeltLaw) -> tuple[Any, tuple[Any, ...]]:
    """Return a call that copies a law in another process. Laws of this package remain one object each."""
    if is_builtin(law):
        return _builtin_law, (law.name,)
    return FeltLaw, tuple(getattr(law, own.name) for own in fields(law))


copyreg.pickle(FeltLaw, _reduced)


def law_of(hammer: Any) -> Any:
    """Return the felt law of a hammer by its type; a `Hammer` has the law of Hunt and Crossley, also with μ = 0."""
    kind = type(hammer)
    for law in (getattr(kind, "law", None), *LAWS.values(), *OTHERS.values()):
        if law is not None and law.hammer_type is kind:
            return law
    raise ParameterError(f"{kind.__name__} is not a hammer; use Hammer, SoftHammer, RelaxingHammer, or FeltLaw.hammer")


def plain_law(hammer: Any) -> Any:
    """Return the law with the fewest parameters that describes this hammer."""
    law = law_of(hammer)
    return POWER if law is HUNT_CROSSLEY and not hammer.mu else law


def check_hammer(hammer: Any, where: str = "hammer") -> None:
    """Reject a hammer outside the bounds of its law, as `check` does; μ = 0, a felt without loss, is allowed."""
    law = law_of(hammer)
    for name, value in hammer._asdict().items():
        if getattr(value, "ndim", 0):
            raise ParameterError(f"{where}: {name} has the shape {value.shape} and must be one number; use jax.vmap")
    values = {name: float(value) for name, value in hammer._asdict().items()}
    if law.hammers is not None:
        values = {name: value for name, value in values.items() if (name, value) != ("mu", 0.0)}
    check(values, where, ALL_PARAMETERS | law.hammer_parameters)


def make_hammer(values: Mapping[str, float], where: str = "argument") -> Any:
    """Return a hammer with these `values`, of the law that has all of them; without more than `Hammer` has, a `Hammer`.

    Raises `ParameterError` if a law with one of these values needs another one too.
    """
    for law in LAWS.values():
        own = [name for name in law.hammer_type._fields if name not in HAMMER_NAMES]
        if given := [name for name in own if name in values]:
            if len(given) < len(own):
                raise ParameterError(f"{where}: the felt law {law.name} needs {' and '.join(own)}; give all of them")
            return law.hammer_type(**{name: values[name] for name in law.hammer_type._fields})
    return Hammer(*(values[name] for name in HAMMER_NAMES))
