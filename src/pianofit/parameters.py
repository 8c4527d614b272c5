"""What a struck string is made of, in numbers: names, units, bounds and scale, in one place.

`String` and `Hammer` together are the paper's nine parameters (eq. 20). `Geometry` is what the paper measures with a
ruler and a balance. All three are named tuples, and so JAX pytrees: they pass through `jit`, `vmap` and `grad` as they
are, and this module needs no JAX.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

from .errors import ParameterError

__all__ = [
    "FIT_NAMES",
    "HAMMER_NAMES",
    "PARAMETERS",
    "STRING_NAMES",
    "Geometry",
    "Hammer",
    "Parameter",
    "String",
    "check",
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
    """The hammer and its felt (paper eq. 5 and 8), F = K_H u^p (1 + μ u̇)."""

    K_H: Number  # felt stiffness, N/m^p
    mu: Number  # felt loss coefficient, s/m
    p: Number  # stiffness exponent, 1
    M_H: Number  # hammer mass, kg
    v_H0: Number  # initial hammer velocity, m/s


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
}
STRING_NAMES = String._fields
HAMMER_NAMES = Hammer._fields
FIT_NAMES = STRING_NAMES + HAMMER_NAMES


def check(values: dict[str, float], where: str = "argument") -> dict[str, float]:
    """Return `values` as finite floats within the box of `PARAMETERS`.

    Raises
    ------
    ParameterError
        Naming `where`, the parameter, its value, and the range with its unit.
    """
    for name, value in values.items():
        if name not in PARAMETERS:
            raise ParameterError(f"{where}: no parameter is called {name!r}; known: {', '.join(PARAMETERS)}")
        box = PARAMETERS[name]
        if not (isinstance(value, int | float) and math.isfinite(value) and box.lower <= value <= box.upper):
            raise ParameterError(
                f"{where}: {name}={value!r} must be a number from {box.lower:g} to {box.upper:g} {box.unit}"
            )
    return {name: float(value) for name, value in values.items()}
