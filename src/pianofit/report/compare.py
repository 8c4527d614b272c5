"""Comparison of two fits: every quantity with difference and z, and both felts over one axis of compression.

The rules are in `comparison_table.py`.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from html import escape
from typing import TYPE_CHECKING, Any

from ..errors import FitError, ParameterError
from ..io.files import printable
from ..io.number_format import columns, format_with_interval
from ..io.table_output import data_frame, html_table
from ..result import Result
from ..schema.decode import builtins_of
from ..schema.fit import fit_path
from .comparison_table import ComparedQuantity, Sides
from .plots import drawn_on
from .static_law import StaticLaw, compared_laws, draw_compared_laws

if TYPE_CHECKING:
    from matplotlib.axes import Axes

NAMES = ("A", "B")
FIGURE_KINDS = ("svg", "png", "pdf")  # of files, by their suffix
COLUMNS = ("name", "a", "b", "unit", "difference", "sd", "z", "status_a", "status_b", "reason")


@dataclass(frozen=True, eq=False, repr=False)
class Comparison:
    """Comparison of two fits: iterate over its `ComparedQuantity`, or take one by name, such as `comparison["f0"]`.

    `felts` are both static laws over the same compressions, with 95 % bands, in `felt_unit`. They are None if a fit
    has no covariance. `warnings` are the limits of the comparison.
    """

    labels: tuple[str, str]
    quantities: tuple[ComparedQuantity, ...]
    felts: tuple[StaticLaw, StaticLaw] | None
    felt_unit: str  # N, or N/kg if the mass of a string was assumed
    compressions_mm: tuple[float, float]  # reference compressions, at which felt forces are compared
    warnings: tuple[str, ...]

    def __getitem__(self, name: str) -> ComparedQuantity:
        for quantity in self.quantities:
            if quantity.name == name:
                return quantity
        raise KeyError(f"{name!r} is not compared; choose one of {', '.join(q.name for q in self.quantities)}")

    def __iter__(self) -> Iterator[ComparedQuantity]:
        return iter(self.quantities)

    def __len__(self) -> int:
        return len(self.quantities)

    def __repr__(self) -> str:
        return "\n".join([*columns([self._heading, *map(_cells, self)], right=1), *self.warnings])

    @property
    def _heading(self) -> tuple[str, ...]:
        return "", *self.labels, "unit", "difference", "sd", "z", ""

    def _repr_html_(self) -> str:
        notes = "".join(f"<li>{escape(warning)}</li>" for warning in self.warnings)
        return f"{html_table(self._heading, map(_cells, self))}<ul>{notes}</ul>"

    def plot(self, ax: Axes | None = None) -> Axes:
        """Draw the static force of both felts over compression with 95 % bands, and marks at the reference compression.

        Raises
        ------
        FitError
            If a fit has no covariance, so that no band can be drawn.
        """
        felts = self._drawable()
        return drawn_on(
            ax, lambda axes: draw_compared_laws(axes, felts, self.compressions_mm, self.labels, self.felt_unit)
        )

    def figure(self, kind: str = "svg") -> bytes:
        """Return `plot`, with the ratio of both forces, as the content of a file: svg, png or pdf.

        Raises
        ------
        ParameterError
            For another kind.
        FitError
            If a fit has no covariance, so that no band can be drawn.
        """
        if kind not in FIGURE_KINDS:
            raise ParameterError(f"kind={kind!r} must be one of {', '.join(FIGURE_KINDS)}")
        return compared_laws(self._drawable(), self.compressions_mm, self.labels, self.felt_unit, kind)

    def _drawable(self) -> tuple[StaticLaw, StaticLaw]:
        if self.felts is None:
            raise FitError(f"{' '.join(self.warnings)} Fit the recordings again to draw the felts".strip())
        return self.felts

    def to_dict(self) -> dict[str, Any]:
        """Return everything as dicts, lists and numbers, as `pianofit compare --json` prints it."""
        return builtins_of(self)

    def to_dataframe(self) -> Any:
        """Return a pandas data frame with one row a quantity.

        Raises
        ------
        OutputError
            If pandas is not installed.
        """
        return data_frame(COLUMNS, (quantity.row for quantity in self))


def compare(
    a: Result | str | os.PathLike[str], b: Result | str | os.PathLike[str], *, labels: Sequence[str] | None = None
) -> Comparison:
    """Compare two fits, quantity by quantity.

    Parameters
    ----------
    a, b : two fits, each a `Result`, a folder that it was saved to, or a `fit.json`.
    labels : names of the fits in tables and figures; the names of their folders, or A and B, if None.

    Returns
    -------
    A `Comparison`: for every quantity both values, the difference b - a, its standard deviation and z, or the reason
    why z is missing.

    Raises
    ------
    FitError
        If a file cannot be used. The message names it.
    ParameterError
        If an argument is not a fit, or the labels are not two different texts.

    Examples
    --------
    Compare the folder that the example of `fit` saves with itself:

    >>> import pianofit
    >>> same = pianofit.compare("fit", pianofit.Result.load("fit"), labels=("first", "second"))
    >>> same["f0"].z, same["L"].reason
    (0.0, 'held fixed in first and second')
    """
    results, names = (_result(a, "a"), _result(b, "b")), _labels((a, b), labels)
    sides = Sides(results, names)
    laws, problems = sides.laws()
    return Comparison(
        names, sides.quantities(), laws, sides.felt_unit, sides.compressions_mm, (*sides.warnings(), *problems)
    )


def _result(fit: Any, name: str) -> Result:
    if isinstance(fit, Result):
        return fit
    if isinstance(fit, str | os.PathLike):
        return Result.load(fit)
    raise ParameterError(f"{name}={printable(repr(fit))[:60]} must be a Result, the folder of a fit or its fit.json")


def _labels(fits: tuple[Any, Any], labels: Sequence[str] | None) -> tuple[str, str]:
    if labels is not None:
        given = [labels] if isinstance(labels, str) else [*labels]
        if len(given) != 2 or not all(isinstance(label, str) and label for label in given) or given[0] == given[1]:
            raise ParameterError(f"labels={labels!r} must be two different texts")
        return given[0], given[1]
    names = [
        name if isinstance(fit, Result) else printable(fit_path(fit).resolve().parent.name) or name
        for fit, name in zip(fits, NAMES, strict=True)
    ]
    return (names[0], names[1]) if names[0] != names[1] else NAMES


def _cells(quantity: ComparedQuantity) -> tuple[str, ...]:
    values = [("-" if q is None else format_with_interval(q.value, q.interval)[0]) for q in (quantity.a, quantity.b)]
    unit = "" if quantity.unit == "1" else quantity.unit
    if quantity.z is None or quantity.difference is None or quantity.sd is None:
        return quantity.name, *values, unit, "-", "-", "-", quantity.reason
    numbers = (f"{quantity.difference:+.2g}", f"{quantity.sd:.2g}", f"{round(quantity.z, 1) + 0.0:+.1f}")
    return quantity.name, *values, unit, *numbers, ""
