"""The interface of an excitation: everything that a fit asks of it.

F compares the levels of partials over strokes. For them it needs the parameters that all strokes share, the one
parameter that differs from stroke to stroke, and the motion that a stroke leaves on the string. That motion is a
contact with a felt, or an initial displacement that is released. The size of a linear excitation is a factor of the
sound. The gains of F integrate it out, so it is not a parameter.
"""

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from types import MappingProxyType
from typing import Any, ClassVar, NamedTuple

import numpy as np

from ..parameters import Geometry, Parameter

# Fields of `Geometry` by the names of parameters of a fit.
GEOMETRY_FIELDS = {
    "x0": "strike_position",
    "width": "width",
    "L": "length",
    "M_S": "mass",
    "pickup": "pickup",
}


class Words(NamedTuple):
    """Nouns for messages and pages."""

    player: str  # the thing that excites the string
    stroke: str  # the parameter of a stroke
    strokes: str  # the same in plural
    order: str  # of recordings sorted by that parameter
    verb: str  # as in "a struck string"


@dataclass(frozen=True)
class StrokeParameter:
    """The parameter that differs from stroke to stroke.

    Parameters
    ----------
    name, unit, meaning : as of `Parameter`.
    prior : median and standard deviation of the logarithm, given a geometry.
    bounds : lower and upper bound, given a geometry.
    coarse, fine : values to scan, given a geometry: for thousands of candidates, and for a few.
    given : value that the setup gives to a stroke, from its [[recording]] and the setup; None if it gives none.
    starts : start values of all strokes for a descent, given a geometry and the rank of every stroke by brightness.
    scale_is_open : True if one common factor of all strokes changes nothing in the sound when other parameters follow.
    """

    name: str
    unit: str
    meaning: str
    prior: Callable[[Geometry], tuple[float, float]]
    bounds: Callable[[Geometry], tuple[float, float]]
    coarse: Callable[[Geometry], Any]
    fine: Callable[[Geometry], Any]
    starts: Callable[[Geometry, Any], Sequence[Any]]
    given: Callable[[Any, Any], float | None]
    scale_is_open: bool


class Excitation:
    """Interface of all excitations: the felt laws of a hammer, and the pluck.

    Attributes
    ----------
    name, kind : name of the law, and of the excitation in files.
    parameters : own parameters, shared by all strokes, with unit, bounds and prior.
    columns : names of the shared entries of a fit after those of the string, in order.
    stroke : the parameter of each stroke, the last entry.
    hammers : type of the object that a `Note` has as its hammer; None if `hammer_type` makes one.
    has_contact : True if a hammer touches the sounding string, so that its force is a pulse.
    gain_deviations : prior standard deviations of the gains of strokes through one path, dB. Each is one answer to the
        question of whether the gains are equal.
    roughness : prior of the differences between partials in a path through the body of such instruments and a room, dB:
        median, and spread of the logarithm.
    spreads : prior standard deviations of the logarithms of columns, next to those of a hammer.
    ranges : bounds of columns over the string length, next to those of a hammer.
    figures : names of the figures of a page that show the excitation.
    size : name of the field of a hammer that MIDI velocities set: velocity, m/s, or static force, N.
    size_is_gain : True if the size is a factor of the sound. Recordings through one path then share one gain, and
        differ in size.
    key_quantities : names of the keyboard laws that describe the excitation.
    power, base, storage, slow : of felt laws only; see `FeltLaw`.
    """

    name: str
    kind: ClassVar[str]
    parameters: Mapping[str, Parameter]
    columns: tuple[str, ...]
    stroke: ClassVar[StrokeParameter]
    words: ClassVar[Words]
    formula: tuple[str, ...]
    hammers: Any = None
    has_contact: ClassVar[bool] = True
    gain_deviations: ClassVar[tuple[float, ...]]
    roughness: ClassVar[tuple[float, float]]
    figures: ClassVar[tuple[str, ...]]
    size: ClassVar[str]
    size_is_gain: ClassVar[bool] = False
    key_quantities: ClassVar[tuple[str, ...]]
    spreads: ClassVar[Mapping[str, float]] = MappingProxyType({})
    ranges: ClassVar[Mapping[str, tuple[float, float]]] = MappingProxyType({})
    power: tuple[str, str] | None = None
    base: Callable[[Any, Any], Any] | None = None
    storage: Callable[..., Any] | None = None
    slow: Callable[[Any, Any], Any] | None = None

    @cached_property
    def hammer_type(self) -> Any:
        """Type of the objects that excite the string: a named tuple, and so a JAX pytree."""
        return self.hammers

    @property
    def hammer_parameters(self) -> dict[str, Parameter]:
        """Unit, meaning and bounds of the fields of `hammer_type`."""
        return dict(self.parameters)

    def displacement(self, modes: Any, hammer: Any) -> Any:
        """Return the modal displacement at t = 0, m [modes]; only of an excitation without contact.

        Parameters
        ----------
        modes : the table of modes. Plain arithmetic suffices, so this package does not load JAX.
        hammer : an object of `hammer_type`.
        """
        raise NotImplementedError

    def mode_excitation(self, omega: Any) -> Any:
        """Return the size of the excitation of modes by a unit of the pulse, over that by an impulse of 1 N s [modes].

        Parameters
        ----------
        omega : angular frequencies, rad/s [modes].
        """
        return 1.0 + 0.0 * omega

    def typical(self, preset: Geometry, length: float | None) -> Geometry:
        """Return the assumed sizes of a string.

        Parameters
        ----------
        preset : the literature's piano string of the key.
        length : given length, m; None if it is assumed too.
        """
        raise NotImplementedError

    def nominal(self, hammer: Any) -> Any:
        """Return a hammer with an ordinary stroke, from which steps and modes are chosen."""
        return hammer

    def parameters_with_unit(self, units: str) -> tuple[str, ...]:
        """Return the parameters whose unit contains one of `units`, such as "N" or "m"."""
        pattern = re.compile(rf"(?<![A-Za-z])({'|'.join(units.split())})(?![A-Za-z])")
        return tuple(name for name, parameter in self.parameters.items() if pattern.search(parameter.unit))

    def unit_exponent(self, name: str, units: str) -> float:
        """Return the exponent of one of `units`, such as "N kg", in the unit of a parameter; of several their sum."""
        upper, *lower = self.parameters[name].unit.replace("²", "^2").replace("³", "^3").split("/")
        pattern = rf"(?<![A-Za-z])(?:{'|'.join(units.split())})(?:\^(-?[\d.]+))?(?![A-Za-z^])"
        total = sum(float(x or 1) for x in re.findall(pattern, upper))
        return total - sum(float(x or 1) for x in re.findall(pattern, "/".join(lower)))

    def force_exponent(self, name: str) -> float:
        """Return the exponent with which a parameter scales with forces and masses: that of N and kg in its unit."""
        return self.unit_exponent(name, "N kg")

    def log_power(self, u: Any, values: Mapping[str, Any], xp: Any = np) -> Any:
        """Return log F - log K = p log g, F the static force at compression `u`, m, of a felt with these `values`.

        `xp` is the array library.
        """
        raise NotImplementedError

    def make_hammer(self, values: Mapping[str, Any], absent: Any = 0.0) -> Any:
        """Return a hammer with these `values`; fields of its type that the excitation does not have are `absent`."""
        return self.hammer_type(
            *(values[name] if name in self.hammer_parameters else absent for name in self.hammer_type._fields)
        )
