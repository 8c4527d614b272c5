"""What a struck string is made of, in numbers: names, units, bounds and scale, in one place.

`String` and `Hammer` together are the paper's nine parameters (eq. 20). A `MemoryHammer` has two more; which of the two
a hammer is chooses the felt's law. `Geometry` is what the paper measures with a ruler and a balance. All are named
tuples, and so JAX pytrees: they pass through `jit`, `vmap` and `grad` as they are, and this module needs no JAX.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

from .errors import ParameterError

__all__ = [
    "FELT_LAWS",
    "FIT_NAMES",
    "HAMMER_NAMES",
    "MEMORY_NAMES",
    "PARAMETERS",
    "STRING_NAMES",
    "Geometry",
    "Hammer",
    "MemoryHammer",
    "Parameter",
    "String",
    "check",
    "check_hammer",
    "check_velocity",
    "make_hammer",
]

# A field holds a number, or an array or tracer of the same meaning inside a computation.
Number = Any


class String(NamedTuple):
    """The string's wave equation (paper eq. 1)."""

    c: Number  # transverse wave speed, m/s
    kappa: Number  # stiffness coefficient, m²/s
    b1: Number  # loss parameter, 1/s
    b2: Number  # loss parameter, m²/s; a mode decays at α = b1 + b2 β²


class Hammer(NamedTuple):
    """The hammer and its felt (paper eq. 5 and 8), F = K_H u^p (1 + μ u̇); with μ = 0 the power law."""

    K_H: Number  # felt stiffness, N/m^p
    mu: Number  # felt loss coefficient, s/m
    p: Number  # stiffness exponent, 1
    M_H: Number  # hammer mass, kg
    v_H0: Number  # initial hammer velocity, m/s


class MemoryHammer(NamedTuple):
    """A hammer whose felt remembers: F = K_H [u^p (1 + μ u̇) - ε c], τ ċ = u^p - c; with μ = 0 Stulov's felt.

    From a hammer of the same stiffness: `MemoryHammer(*hammer._replace(mu=0.0), epsilon, tau)`.
    """

    K_H: Number  # felt stiffness to a sudden compression, N/m^p; a slow one feels K_H (1 - ε)
    mu: Number  # felt loss coefficient, s/m
    p: Number  # stiffness exponent, 1
    M_H: Number  # hammer mass, kg
    v_H0: Number  # initial hammer velocity, m/s
    epsilon: Number  # share of the stiffness that relaxes, 1
    tau: Number  # relaxation time, s


class Geometry(NamedTuple):
    """The string's size, and where it is struck and heard. Positions are measured from the agraffe."""

    length: Number  # L, m
    mass: Number  # M_S, of the whole string, kg
    strike: Number  # x0, centre of the contact window, m
    width: Number  # full width of the contact window, m
    pickup: Number  # x_m, m; ignored by a pickup at the bridge


class Parameter(NamedTuple):
    """One parameter's unit, meaning and box. All are searched on a log scale: all are positive and span decades."""

    unit: str
    meaning: str
    lower: float
    upper: float


PARAMETERS: dict[str, Parameter] = {
    "c": Parameter("m/s", "transverse wave speed", 20.0, 2000.0),
    "kappa": Parameter("m²/s", "string stiffness coefficient", 1e-3, 1e2),
    "b1": Parameter("1/s", "loss parameter", 1e-3, 1e2),
    "b2": Parameter("m²/s", "loss parameter", 1e-12, 1e-1),
    "K_H": Parameter("N/m^p", "felt stiffness", 1e4, 1e16),
    "mu": Parameter("s/m", "felt loss coefficient", 1e-3, 1e1),
    "p": Parameter("1", "stiffness exponent", 1.0, 5.0),
    "M_H": Parameter("kg", "hammer mass", 1e-4, 1e-1),
    "v_H0": Parameter("m/s", "initial hammer velocity", 1e-2, 2e1),
    "epsilon": Parameter("1", "share of the felt's stiffness that relaxes", 1e-3, 0.99),
    "tau": Parameter("s", "relaxation time of the felt", 1e-6, 1e-2),
}
STRING_NAMES = String._fields
HAMMER_NAMES = Hammer._fields
FIT_NAMES = STRING_NAMES + HAMMER_NAMES  # the paper's nine
MEMORY_NAMES = ("epsilon", "tau")
# The parameters of each law of the felt; the others are 0.
FELT_LAWS: dict[str, tuple[str, ...]] = {
    "power": ("K_H", "p"),
    "hunt-crossley": ("K_H", "mu", "p"),
    "stulov": ("K_H", "p", "epsilon", "tau"),
}
# The law unless the setup names one: the paper's.
DEFAULT_LAW = "hunt-crossley"


def check(
    values: Mapping[str, float], where: str = "argument", boxes: Mapping[str, Parameter] = PARAMETERS
) -> dict[str, float]:
    """Return `values` as finite floats within their `boxes`.

    Raises
    ------
    ParameterError
        Naming `where`, the parameter, its value, and the range with its unit.
    """
    for name, value in values.items():
        if name not in boxes:
            raise ParameterError(f"{where}: no parameter is called {name!r}; known: {', '.join(boxes)}")
        box = boxes[name]
        if not (isinstance(value, int | float) and math.isfinite(value) and box.lower <= value <= box.upper):
            raise ParameterError(
                f"{where}: {name}={value!r} must be a number from {box.lower:g} to {box.upper:g} {box.unit}"
            )
    return {name: float(value) for name, value in values.items()}


def check_velocity(velocity: float | None) -> None:
    """Refuse a hammer velocity, m/s, outside the box; None is one that was not given.

    Raises
    ------
    ParameterError
        Naming its value and its range.
    """
    box = PARAMETERS["v_H0"]
    if velocity is not None and not box.lower <= velocity <= box.upper:
        raise ParameterError(f"velocity={velocity} m/s must be from {box.lower:g} to {box.upper:g}")


def check_hammer(hammer: Hammer | MemoryHammer, where: str = "hammer") -> None:
    """Refuse a hammer outside the box, as `check` does; μ = 0 is a felt without that loss.

    A hammer of a `FeltLaw` has the boxes of its law.
    """
    values = {name: float(value) for name, value in hammer._asdict().items()}
    law = getattr(type(hammer), "law", None)
    if law is not None:
        check(values, where, law.boxes)
        return
    check({name: value for name, value in values.items() if (name, value) != ("mu", 0.0)}, where)


def make_hammer(values: dict[str, float], where: str = "argument") -> Hammer | MemoryHammer:
    """Return the hammer that `values` speak of: one with memory where they have epsilon and tau.

    Raises
    ------
    ParameterError
        If only one of the two is there.
    """
    five = [values[name] for name in HAMMER_NAMES]
    memory = [values[name] for name in MEMORY_NAMES if name in values]
    if len(memory) == 1:
        raise ParameterError(f"{where}: a relaxing felt needs both epsilon and tau; give the other one too")
    return MemoryHammer(*five, *memory) if memory else Hammer(*five)
