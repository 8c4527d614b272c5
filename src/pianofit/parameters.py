"""Parameters of a struck string: names, units, bounds and priors.

`String` and `Hammer` together hold the nine parameters of the paper (eq. 20). `felt` has hammers with other felt laws.
`Geometry` holds the sizes that the paper measures directly. All are named tuples, which JAX treats as pytrees, so they
pass through `jit`, `vmap` and `grad`. This module does not import JAX.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from numbers import Integral, Real
from typing import Any, NamedTuple

from .errors import ParameterError, check_range, check_type
from .io.number_format import is_number, summary

# Width of a box in standard deviations of its prior, 2 · 1.96, unless a spread is given: the box is the 95 % interval.
BOX_WIDTH = 3.92
# Fields hold numbers, or arrays and tracers inside a computation.
Number = Any


class String(NamedTuple):
    """Coefficients of the wave equation of the string (paper eq. 1).

    Parameters
    ----------
    c : wave speed, m/s.
    kappa : stiffness coefficient, m²/s.
    b1, b2 : loss parameters, 1/s and m²/s: a mode of wavenumber β has the decay rate b1 + b2 β².
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
    p : felt exponent.
    M_H : hammer mass, kg.
    v_H0 : hammer velocity at the first contact, m/s.
    """

    K_H: Number
    mu: Number
    p: Number
    M_H: Number
    v_H0: Number

    def __repr__(self) -> str:
        return summary(self, exact=True)


# Largest width of a contact window over the distance from its centre to the nearer end of the string. 2 is the limit.
WINDOW_WITHIN = 1.98


class Geometry(NamedTuple):
    """Size of the string, and positions of hammer and pickup, measured from the agraffe.

    Parameters
    ----------
    length : L, m.
    mass : M_S, of the whole string, kg.
    strike_position : x0, centre of the contact window, m.
    width : full width of the contact window, m.
    pickup : x_m, m; not used by a pickup at the bridge.
    """

    length: Number
    mass: Number
    strike_position: Number
    width: Number
    pickup: Number

    def __repr__(self) -> str:
        return summary(self, exact=True)

    def with_window_on_string(self) -> Geometry:
        """Return the geometry with a contact window that ends before both ends of the string."""
        widest = WINDOW_WITHIN * min(self.strike_position, self.length - self.strike_position)
        return self._replace(width=min(self.width, widest))


class Parameter(NamedTuple):
    """Unit, meaning, bounds and prior of one parameter. The prior is log-normal within the bounds.

    Fits search the logarithms, because all parameters are positive and span decades.

    Parameters
    ----------
    unit, meaning : "N/m^p" and "felt stiffness", for example; "1" without a unit.
    lower, upper : bounds, positive.
    median : median of the prior, or a function of the MIDI key. None: the geometric mean of the bounds.
    spread : prior standard deviation of the logarithm. None: the bounds are the 95 % interval.
    """

    unit: str
    meaning: str
    lower: float
    upper: float
    median: float | Callable[[float], float] | None = None
    spread: float | None = None

    def prior_median(self, midi: float) -> float:
        """Median of the prior at a key."""
        if self.median is None:
            return math.sqrt(self.lower * self.upper)
        return float(self.median(midi) if callable(self.median) else self.median)

    @property
    def prior_sd(self) -> float:
        """Standard deviation of the logarithm under the prior."""
        return math.log(self.upper / self.lower) / BOX_WIDTH if self.spread is None else self.spread

    def check(self, where: str) -> None:
        """Raise a `ParameterError` if a type or the bounds are invalid, or the prior is outside the bounds."""
        kinds = (str, str, Real, Real, (Real, Callable, type(None)), (Real, type(None)))
        for name, kind in zip(self._fields, kinds, strict=True):
            expected = "a text" if kind is str else "a number" if kind is Real else "a number; see Parameter"
            check_type(f"{where}: {name}=", getattr(self, name), kind, expected)
        if not 0 < self.lower < self.upper < math.inf:
            raise ParameterError(f"{where}: bounds {self.lower!r} to {self.upper!r} must be positive and increasing")
        if not (self.median is None or callable(self.median) or self.lower <= self.median <= self.upper):
            raise ParameterError(f"{where}: median={self.median!r} must be from {self.lower:g} to {self.upper:g}")
        if not (self.spread is None or 0 < self.spread < math.inf):
            raise ParameterError(f"{where}: spread={self.spread!r} must be above 0; use [fixed] to hold a value")


# The nine parameters of the paper (eq. 20), with the bounds of a search.
PARAMETERS: dict[str, Parameter] = {
    "c": Parameter("m/s", "transverse wave speed", 20.0, 2000.0),
    "kappa": Parameter("m²/s", "string stiffness coefficient", 1e-3, 1e2),
    "b1": Parameter("1/s", "loss, the same for all partials", 1e-3, 1e2),
    "b2": Parameter("m²/s", "loss that grows with frequency", 1e-12, 1e-1),
    "K_H": Parameter("N/m^p", "felt stiffness", 1e4, 1e16),
    "mu": Parameter("s/m", "felt loss coefficient", 1e-3, 1e1),
    "p": Parameter("1", "felt exponent", 1.0, 5.0),
    "M_H": Parameter("kg", "hammer mass, one string's share", 1e-4, 1e-1),
    "v_H0": Parameter("m/s", "initial hammer velocity", 1e-2, 2e1),
}
STRING_NAMES = String._fields
HAMMER_NAMES = Hammer._fields
FIT_NAMES = STRING_NAMES + HAMMER_NAMES  # the paper's nine


def check(
    values: Mapping[str, float], where: str = "argument", bounds: Mapping[str, Parameter] = PARAMETERS
) -> dict[str, float]:
    """Return `values` as finite floats within their `bounds`, or raise a `ParameterError` that begins with `where`."""
    for name, value in values.items():
        if name not in bounds:
            raise ParameterError(f"{where}: no parameter is called {name!r}; use one of {', '.join(bounds)}")
        box = bounds[name]
        if not (is_number(value) and box.lower <= value <= box.upper):
            unit = "" if box.unit == "1" else f" {box.unit}"
            raise ParameterError(
                f"{where}: {name}={value!r} must be a number from {box.lower:g} to {box.upper:g}{unit}"
            )
    return {name: float(value) for name, value in values.items()}


def check_velocity(velocity: float | None) -> None:
    """Raise a `ParameterError` if a hammer velocity, m/s, is out of range. None means not given."""
    if velocity is not None:
        check_range("velocity=", velocity, PARAMETERS["v_H0"].lower, PARAMETERS["v_H0"].upper, " m/s")


def check_seed(seed: int) -> None:
    """Raise a `ParameterError` if `seed` is not a whole number from 0."""
    if isinstance(seed, bool) or not isinstance(seed, Integral) or seed < 0:
        raise ParameterError(f"seed={seed!r} must be a whole number from 0")
