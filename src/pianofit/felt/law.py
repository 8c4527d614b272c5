"""A law of the felt as one object: its parameters with bounds and priors, its force, and the energy that it stores.

Whatever a fit, a file or a page has to know of a felt stands here, and nothing of a felt stands elsewhere. Which values
rest on an assumed string mass, and which on velocities that nobody measured, follows from the units: scale all lengths
by s and all masses by t at the same time, and the string sounds the same if every parameter scales as its unit does.
"""

from __future__ import annotations

import re
from collections import namedtuple
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from keyword import iskeyword
from typing import Any

from ..errors import ParameterError
from ..parameters import PARAMETERS, Parameter, check

__all__ = ["COMMON", "FeltLaw"]

# What every hammer has beside its felt.
COMMON = ("M_H", "v_H0")
# What the string, the contact and a fit's tables call something else; a law's own names must be others.
TAKEN = {*COMMON, *(name for name in PARAMETERS if name not in ("K_H", "mu", "p")), "x0", "width", "L", "M_S", "pickup"}


@dataclass(frozen=True, eq=False)
class FeltLaw:
    """A felt F(u, u̇), for `strike`, `simulate`, a `Note` and `fit`; the package's own are `pianofit.felt.LAWS`.

    Parameters
    ----------
    name : what files call it: letters, digits, hyphens.
    parameters : of each the unit, meaning, bounds, and for fits the prior's median and spread, see `Parameter`. All are
        positive. A unit with N or m in it says that the value scales with masses or lengths.
    force : `force(u, w, hammer)`, N, of compression u > 0, m, and its speed w, m/s, written in `jax.numpy` or plain
        arithmetic, with the parameters as fields of `hammer`. It must not fall as u rises. Below 0 it counts as 0: a
        felt does not pull.
    storage : `storage(u, hammer)`, J: the energy that the felt gives back. Where it is given, hammers whose felt would
        give more than that are refused.
    slow : `slow(u, hammer)`, N, of a felt that relaxes: its force where it is pressed slowly.
    power : the names of K and p if the force has the factor K u^p: a fit then searches the force K u_ref^p in place of
        K, whose unit changes with p.
    formula : the law for the page of a fit, one equation a string, in the part of TeX that a page sets.
    hammers, columns : of the package's laws, which share a solver of their own: the hammers' type, and the order of a
        fit's unknowns.

    Raises
    ------
    ParameterError
        For a name that is none, or that has another meaning, and for a parameter whose bounds or prior are none.
    """

    name: str
    parameters: Mapping[str, Parameter]
    force: Callable[..., Any]
    storage: Callable[..., Any] | None = None
    slow: Callable[[Any, Any], Any] | None = None
    power: tuple[str, str] | None = None
    hammers: Any = None
    columns: tuple[str, ...] = ()
    formula: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if not re.fullmatch(r"[A-Za-z][A-Za-z0-9_-]*", self.name):
            raise ParameterError(
                f"felt law {self.name!r}: the name must be letters, digits and hyphens, a letter first"
            )
        for name, parameter in self.parameters.items():
            if not name.isidentifier() or iskeyword(name) or name.startswith("_") or name in TAKEN:
                raise ParameterError(
                    f"felt law {self.name!r}: {name!r} must be a name other than {', '.join(sorted(TAKEN))}, "
                    "and no word of Python's own"
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
    def kind(self) -> Any:
        """The type of its hammers: a named tuple, and so a JAX pytree, that knows its law."""
        if self.hammers is not None:
            return self.hammers
        name = self.name.replace("-", "_")
        fields = namedtuple(name, (*self.parameters, *COMMON))  # fields are known at run time
        return type(name, (fields,), {"__slots__": (), "law": self})

    @property
    def boxes(self) -> dict[str, Parameter]:
        """Unit, meaning and bounds of what a hammer has."""
        return {**self.parameters, **{name: PARAMETERS[name] for name in COMMON}}

    def scaling(self, units: str) -> tuple[str, ...]:
        """Which parameters have one of the `units`, such as "N" or "m", in theirs."""
        found = re.compile(rf"(?<![A-Za-z])({'|'.join(units.split())})(?![A-Za-z])")
        return tuple(name for name, parameter in self.parameters.items() if found.search(parameter.unit))

    def make_hammer(self, values: Mapping[str, Any], absent: Any = 0.0) -> Any:
        """The hammer that `values` by name make; what its type has and the law has not is `absent`."""
        return self.kind(*(values[name] if name in self.boxes else absent for name in self.kind._fields))

    def hammer(self, **values: float) -> Any:
        """A hammer with this felt: the law's parameters, M_H, kg, and v_H0, m/s.

        Raises
        ------
        ParameterError
            For a value that is missing, unknown or out of its bounds, and for a felt that gives more than it stores.
        """
        if missing := [name for name in self.boxes if name not in values]:
            raise ParameterError(f"felt law {self.name}: a hammer needs {', '.join(missing)} too")
        hammer = self.make_hammer(check(values, f"felt law {self.name}", self.boxes))
        if self.storage is not None and self.hammers is None:
            from ..model.felt.passivity import check_passive

            check_passive(self, hammer)
        return hammer
