"""Laws of the felt, one file each; a file added here is a law of `setup.toml`, of fits, of files and of pages.

What stands in a law's file is data and plain arithmetic, so that a setup is checked without JAX; `model/felt` steps it.
"""

from __future__ import annotations

import pkgutil
from collections.abc import Mapping
from importlib import import_module
from typing import Any

from ..errors import ParameterError
from ..parameters import HAMMER_NAMES, PARAMETERS, Hammer, Parameter, check
from .hunt_crossley import HUNT_CROSSLEY
from .law import COMMON, FeltLaw
from .relaxing import RelaxingHammer

__all__ = [
    "BOXES", "COMMON", "DEFAULT_LAW", "LAWS", "FeltLaw", "RelaxingHammer", "check_hammer", "is_builtin", "law_of",
    "make_hammer",
]  # fmt: skip

# The package's laws by the name that files have.
LAWS: dict[str, FeltLaw] = {
    law.name: law
    for module in pkgutil.iter_modules(__path__)
    for law in getattr(import_module(f".{module.name}", __name__), "LAWS", ())
}
# The law unless the setup names one: the paper's.
DEFAULT_LAW = HUNT_CROSSLEY
# Unit, meaning and bounds of everything that a fit with one of them searches.
BOXES: dict[str, Parameter] = PARAMETERS | {n: p for law in LAWS.values() for n, p in law.parameters.items()}


def is_builtin(law: FeltLaw) -> bool:
    """Whether a law is one of the package's, which a file's name stands for."""
    return LAWS.get(law.name) is law


def law_of(hammer: Any) -> FeltLaw:
    """The law of a hammer's felt, by its type; a `Hammer` whose μ is 0 has Hunt and Crossley's without its loss.

    Raises
    ------
    ParameterError
        For what is no hammer.
    """
    kind = type(hammer)
    for law in (getattr(kind, "law", None), *LAWS.values()):
        if law is not None and law.kind is kind:
            return law
    raise ParameterError(f"{kind.__name__} is no hammer; use Hammer, RelaxingHammer, or FeltLaw.hammer")


def check_hammer(hammer: Any, where: str = "hammer") -> None:
    """Refuse a hammer outside the box of its law, as `check` does; μ = 0 is a felt without that loss.

    Raises
    ------
    ParameterError
        Naming `where`, the parameter, its value and its range.
    """
    law = law_of(hammer)
    for name, value in hammer._asdict().items():
        if getattr(value, "ndim", 0):
            raise ParameterError(f"{where}: {name} has the shape {value.shape} and must be one number; use jax.vmap")
    values = {name: float(value) for name, value in hammer._asdict().items()}
    if law.hammers is not None:
        values = {name: value for name, value in values.items() if (name, value) != ("mu", 0.0)}
    check(values, where, BOXES | law.boxes)


def make_hammer(values: Mapping[str, float], where: str = "argument", law: FeltLaw | None = None) -> Any:
    """Return the hammer that `values` speak of: of a `law`, or else one with memory where they have epsilon and tau.

    Raises
    ------
    ParameterError
        If one is missing.
    """
    if law is not None and law.hammers is None:
        if missing := [name for name in law.boxes if name not in values]:
            raise ParameterError(f"{where}: felt law {law.name}: {', '.join(missing)} missing")
        return law.make_hammer(values)
    five = [values[name] for name in HAMMER_NAMES]
    memory = [values[name] for name in RelaxingHammer._fields[len(five) :] if name in values]
    if len(memory) == 1:
        raise ParameterError(f"{where}: a relaxing felt needs both epsilon and tau; give the other one too")
    return RelaxingHammer(*five, *memory) if memory else Hammer(*five)
