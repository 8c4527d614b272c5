"""A felt law as one object: its parameters with bounds and priors, its force, and its stored energy.

This object holds all that fits, files and pages need from a felt law. The units of the parameters determine which
values depend on an assumed string mass, or on a velocity that was not measured. If all lengths scale by s, all masses
by t, and every parameter as its unit does, the string sounds the same.
"""

import re
from collections import namedtuple
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from keyword import iskeyword
from types import SimpleNamespace
from typing import Any, ClassVar, Self

import numpy as np

from ..errors import ParameterError, check_type
from ..excitation.hammer import GAIN_DEVIATION, HAMMER_WORDS, NOMINAL, PATH, STRIKE, VELOCITY_OF_STROKE
from ..excitation.protocol import GEOMETRY_FIELDS, Excitation, StrokeParameter, Words
from ..parameters import PARAMETERS, STRING_NAMES, Geometry, Parameter, check

# Parameters of every hammer, in addition to those of its felt.
COMMON_PARAMETERS = ("M_H", "v_H0")
# Names with another meaning in string, contact or tables of a fit: parameters of a law must not use them.
RESERVED_NAMES = {*STRING_NAMES, *COMMON_PARAMETERS, *GEOMETRY_FIELDS}


@dataclass(frozen=True, eq=False)
class FeltLaw(Excitation):
    """A felt law F(u, u̇) for `strike`, `simulate`, `Note` and `fit`; those of this package are `pianofit.felt.LAWS`.

    Parameters
    ----------
    name : name in files: letters, digits, hyphens.
    parameters : for each the unit, meaning, bounds, and for fits the prior median and spread, see `Parameter`. All are
        positive. A unit that contains N or m states that the value scales with masses or lengths.
    force : `force(u, w, hammer)`, N, for compression u > 0, m, and its speed w, m/s, written in `jax.numpy` or plain
        arithmetic, with the parameters as fields of `hammer`. It must not fall as u rises. Values below 0 count as 0,
        since a felt does not pull. Only a function of a module can be pickled, and so sent to another process.
    storage : `storage(u, hammer)`, J: the energy that the felt can return. If it is given, hammers whose felt returns
        more are rejected.
    slow : `slow(u, hammer)`, N: force of a relaxing felt in slow compression.
    power : names of K and p if the force has the factor K u^p, or K g^p with another base g. A fit then searches the
        static force at a reference compression in place of K, whose unit depends on p.
    base : `base(u, hammer)`, m: the base g, if it is not the compression.
    hammers, columns : only for laws of this package, which share a solver: type of their hammers, and order of the
        parameters of a fit.
    formula : the law for the page of a fit, one equation per string, in the subset of TeX that a page typesets.

    Raises
    ------
    ParameterError
        For an invalid or reserved name, and for a parameter with invalid bounds or prior.

    Examples
    --------
    >>> import pianofit
    >>> straw = pianofit.FeltLaw(
    ...     "straw", {"k": pianofit.Parameter("N/m", "stiffness", 1e3, 1e6)}, lambda u, w, felt: felt.k * u
    ... )
    >>> hammer = straw.hammer(k=2e4, M_H=5e-3, v_H0=1.0)
    >>> it = pianofit.typical("C4")
    >>> f"{1e3 * pianofit.simulate(it.string, hammer, it.geometry).contact_time:.2f} ms"
    '2.65 ms'
    """

    name: str
    parameters: Mapping[str, Parameter]
    force: Callable[..., Any]
    storage: Callable[..., Any] | None = None
    slow: Callable[[Any, Any], Any] | None = None
    power: tuple[str, str] | None = None
    base: Callable[[Any, Any], Any] | None = None
    hammers: Any = None
    columns: tuple[str, ...] = ()
    formula: tuple[str, ...] = ()
    kind: ClassVar[str] = "hammer"
    stroke: ClassVar[StrokeParameter] = VELOCITY_OF_STROKE
    words: ClassVar[Words] = HAMMER_WORDS
    gain_deviations: ClassVar[tuple[float, ...]] = GAIN_DEVIATION
    roughness: ClassVar[tuple[float, float]] = PATH
    figures: ClassVar[tuple[str, ...]] = ("force", "felt")
    size: ClassVar[str] = "v_H0"
    key_quantities: ClassVar[tuple[str, ...]] = ("M_H/M_S", "F/M_S", "local_exponent", "mu", "skin")

    def __copy__(self) -> Self:
        return self  # a copy would be another law, whose contact is compiled again

    def __deepcopy__(self, _: dict) -> Self:
        return self

    def __post_init__(self) -> None:
        check_type("felt law: name=", self.name, str, "a text")
        if not re.fullmatch(r"[A-Za-z][A-Za-z0-9_-]*", self.name):
            raise ParameterError(
                f"felt law {self.name!r}: the name must be letters, digits and hyphens, a letter first"
            )
        for name in ("force", "storage", "slow", "base"):
            kinds = (Callable,) if name == "force" else (Callable, type(None))
            check_type(f"felt law {self.name!r}: {name}=", getattr(self, name), kinds, "a function; see FeltLaw")
        check_type(f"felt law {self.name!r}: parameters=", self.parameters, Mapping, "a Parameter for each name")
        for name, parameter in self.parameters.items():
            check_type(f"felt law {self.name!r}: {name}=", parameter, Parameter, "a Parameter")
            if not name.isidentifier() or iskeyword(name) or name.startswith("_") or name in RESERVED_NAMES:
                raise ParameterError(
                    f"felt law {self.name!r}: {name!r} must be a name other than {', '.join(sorted(RESERVED_NAMES))}, "
                    "and not a keyword of Python"
                )
            parameter.check(f"felt law {self.name}: {name}")
        if self.power is not None and not {*self.power} <= {*self.parameters}:
            raise ParameterError(f"felt law {self.name}: power={self.power} must name two of its parameters")
        if isinstance(self.formula, str):
            raise ParameterError(f"felt law {self.name}: formula={self.formula!r} must be a tuple of strings")
        if not self.columns:
            object.__setattr__(self, "columns", (*self.parameters, "M_H", "x0", "width"))

    def __repr__(self) -> str:
        return f"FeltLaw({self.name!r})"

    @cached_property
    def hammer_type(self) -> Any:
        """Type of the hammers with this law: a named tuple, and so a JAX pytree, with the attribute `law`."""
        if self.hammers is not None:
            return self.hammers
        name = self.name.replace("-", "_")
        fields = namedtuple(name, (*self.parameters, *COMMON_PARAMETERS))  # the fields follow from the parameters
        # Pickle finds no such class by its name.
        reduced = {"__reduce__": lambda hammer: (_make_hammer, (self, *hammer))}
        return type(name, (fields,), {"__slots__": (), "law": self, **reduced})

    @property
    def hammer_parameters(self) -> dict[str, Parameter]:
        """Unit, meaning and bounds of the parameters of a hammer."""
        return {**self.parameters, **{name: PARAMETERS[name] for name in COMMON_PARAMETERS}}

    def log_power(self, u: Any, values: Mapping[str, Any], xp: Any = np) -> Any:
        """Return log F - log K = p log g, F the static force at compression `u`, m, of a felt with these `values`."""
        _, exponent = self.power or ("", "")
        return values[exponent] * xp.log(u if self.base is None else self.base(u, SimpleNamespace(**values)))

    def typical(self, preset: Geometry, length: float | None) -> Geometry:
        """Return the sizes of a piano string; one of another length has the mass per metre of the preset."""
        length = float(length or preset.length)
        mass = preset.mass * length / preset.length
        return Geometry(length, mass, STRIKE * length, min(preset.width, 0.1 * length), 0.5 * length)

    def nominal(self, hammer: Any) -> Any:
        """Return the hammer at an ordinary velocity."""
        return hammer._replace(v_H0=NOMINAL)

    def hammer(self, **values: float) -> Any:
        """Return a hammer with this felt.

        Parameters
        ----------
        values : the parameters of the law, M_H, kg, and v_H0, m/s, by name.

        Returns
        -------
        A hammer: a named tuple, and so a pytree of JAX.

        Raises
        ------
        ParameterError
            For a value that is missing, unknown or out of bounds, and for a felt that returns more than it stores.
        """
        if missing := [name for name in self.hammer_parameters if name not in values]:
            raise ParameterError(f"felt law {self.name}: a hammer needs {', '.join(missing)} too")
        hammer = self.make_hammer(check(values, f"felt law {self.name}", self.hammer_parameters))
        if self.storage is not None and self.hammers is None:
            from .steps.any_law import check_passive  # it loads JAX

            check_passive(hammer)
        return hammer


def _make_hammer(law: FeltLaw, *values: Any) -> Any:
    return law.hammer_type(*values)


def scale_velocity(values: Mapping[str, Any], law: Excitation, s: Any) -> dict[str, Any]:
    """Return values with all velocities times `s`, and so forces and compressions; only a law with a power has it."""
    scaled = {name: value * s for name, value in values.items() if name.startswith("v_H0")}
    if law.power is None:
        return {**values}
    scaled |= {name: values[name] * s ** law.unit_exponent(name, "N m") for name in law.parameters}
    stiffness, exponent = law.power  # its unit has a length to the power of a parameter
    return {**values, **scaled, stiffness: values[stiffness] * s ** (1 - values[exponent])}
