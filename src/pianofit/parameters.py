"""What a struck string is made of, in numbers: names, units, bounds and scale, in one place.

`String` and `Hammer` together are the paper's nine parameters (eq. 20); hammers with other felts are those of `felt`.
`Geometry` is what the paper measures with a ruler and a balance. All are named tuples, and so JAX pytrees: they pass
through `jit`, `vmap` and `grad` as they are, and this module needs no JAX.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from numbers import Integral
from typing import Any, NamedTuple

from .errors import ParameterError, check_range
from .io.number_format import summary

__all__ = [
    "FIT_NAMES", "HAMMER_NAMES", "PARAMETERS", "STRING_NAMES", "Geometry", "Hammer", "Number", "Parameter", "String",
    "check", "check_seed", "check_velocity",
]  # fmt: skip

# A box that says nothing else is the 95 % of its prior: so many standard deviations, 2 · 1.96.
BOX_WIDTH = 3.92
# A field holds a number, or an array or tracer of the same meaning inside a computation.
Number = Any


class String(NamedTuple):
    """The string's wave equation (paper eq. 1).

    Parameters
    ----------
    c : transverse wave speed, m/s.
    kappa : stiffness coefficient, m²/s.
    b1, b2 : loss parameters, 1/s and m²/s: a mode of wave number β decays at b1 + b2 β².
    """

    c: Number
    kappa: Number
    b1: Number
    b2: Number

    def __repr__(self) -> str:
        return summary(self, exact=True)


class Hammer(NamedTuple):
    """The hammer and its felt (paper eq. 5 and 8), F = K_H u^p (1 + μ u̇); with μ = 0 the power law.

    Parameters
    ----------
    K_H : felt stiffness, N/m^p.
    mu : felt loss coefficient, s/m.
    p : stiffness exponent.
    M_H : hammer mass, kg.
    v_H0 : hammer velocity at the first touch, m/s.
    """

    K_H: Number
    mu: Number
    p: Number
    M_H: Number
    v_H0: Number

    def __repr__(self) -> str:
        return summary(self, exact=True)


class Geometry(NamedTuple):
    """The string's size, and where it is struck and heard; positions are measured from the agraffe.

    Parameters
    ----------
    length : L, m.
    mass : M_S, of the whole string, kg.
    strike : x0, centre of the contact window, m.
    width : full width of the contact window, m.
    pickup : x_m, m; ignored by a pickup at the bridge.
    """

    length: Number
    mass: Number
    strike_position: Number
    width: Number
    pickup: Number

    def __repr__(self) -> str:
        return summary(self, exact=True)


class Parameter(NamedTuple):
    """One parameter's unit, meaning and box, and for fits its prior: log-normal, within the box.

    All are searched on a log scale: all are positive and span decades.
    """

    unit: str
    meaning: str
    lower: float
    upper: float
    # Of the prior; a function of the MIDI key where it changes over the keyboard, the middle of the box if None,
    median: float | Callable[[float], float] | None = None
    # and the standard deviation of the logarithm; if None the box is its 95 %.
    spread: float | None = None

    def prior_median(self, midi: float) -> float:
        """The prior's median at a key."""
        if self.median is None:
            return math.sqrt(self.lower * self.upper)
        return float(self.median(midi) if callable(self.median) else self.median)

    @property
    def prior_sd(self) -> float:
        """The prior's standard deviation of the logarithm."""
        return math.log(self.upper / self.lower) / BOX_WIDTH if self.spread is None else self.spread

    def check(self, where: str) -> None:
        """Refuse a box that is none, and a prior outside of it.

        Raises
        ------
        ParameterError
            Naming `where`, what is wrong, and the values.
        """
        if not 0 < self.lower < self.upper < math.inf:
            raise ParameterError(f"{where}: bounds {self.lower!r} to {self.upper!r} must rise from above 0")
        if not (self.median is None or callable(self.median) or self.lower <= self.median <= self.upper):
            raise ParameterError(f"{where}: median={self.median!r} must be from {self.lower:g} to {self.upper:g}")
        if not (self.spread is None or 0 < self.spread < math.inf):
            raise ParameterError(f"{where}: spread={self.spread!r} must be above 0; hold a value by [fixed]")


PARAMETERS: dict[str, Parameter] = {
    "c": Parameter("m/s", "transverse wave speed", 20.0, 2000.0),
    "kappa": Parameter("m²/s", "string stiffness coefficient", 1e-3, 1e2),
    "b1": Parameter("1/s", "loss, the same for all partials", 1e-3, 1e2),
    "b2": Parameter("m²/s", "loss that grows with frequency", 1e-12, 1e-1),
    "K_H": Parameter("N/m^p", "felt stiffness", 1e4, 1e16),
    "mu": Parameter("s/m", "felt loss coefficient", 1e-3, 1e1),
    "p": Parameter("1", "stiffness exponent", 1.0, 5.0),
    "M_H": Parameter("kg", "hammer mass, one string's share", 1e-4, 1e-1),
    "v_H0": Parameter("m/s", "initial hammer velocity", 1e-2, 2e1),
}
STRING_NAMES = String._fields
HAMMER_NAMES = Hammer._fields
FIT_NAMES = STRING_NAMES + HAMMER_NAMES  # the paper's nine


def check(
    values: Mapping[str, float], where: str = "argument", bounds: Mapping[str, Parameter] = PARAMETERS
) -> dict[str, float]:
    """Return `values` as finite floats within their `boxes`.

    Raises `ParameterError`, naming `where`, the parameter, its value, and the range with its unit.
    """
    for name, value in values.items():
        if name not in bounds:
            raise ParameterError(f"{where}: no parameter is called {name!r}; known: {', '.join(bounds)}")
        box = bounds[name]
        if not (isinstance(value, int | float) and math.isfinite(value) and box.lower <= value <= box.upper):
            unit = "" if box.unit == "1" else f" {box.unit}"
            raise ParameterError(
                f"{where}: {name}={value!r} must be a number from {box.lower:g} to {box.upper:g}{unit}"
            )
    return {name: float(value) for name, value in values.items()}


def check_velocity(velocity: float | None) -> None:
    """Refuse by a `ParameterError` a hammer velocity, m/s, outside the box; None is one that was not given."""
    if velocity is not None:
        check_range("velocity=", velocity, PARAMETERS["v_H0"].lower, PARAMETERS["v_H0"].upper, " m/s")


def check_seed(seed: int) -> None:
    """Refuse by a `ParameterError` a seed that no random numbers come of."""
    if not isinstance(seed, Integral) or seed < 0:
        raise ParameterError(f"seed={seed!r} must be a whole number from 0")
