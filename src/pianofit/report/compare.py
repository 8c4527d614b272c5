"""Comparison of two fits: every quantity with difference and z, and both felts over one axis of compression.

The rules are in `comparison_table.py`.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from html import escape
from typing import TYPE_CHECKING, Any

import numpy as np

from ..errors import FitError, ParameterError
from ..io.files import printable
from ..io.number_format import columns, format_with_interval
from ..io.table_output import data_frame, html_table
from ..result import Result
from ..schema.decode import builtins_of
from ..schema.fit import fit_path
from .comparison_table import ComparedQuantity, Sides
from .drawing import FITTED, HEIGHT, INITIAL, INK, METADATA, Panel, page_style, saved, span
from .plots import drawn_on
from .static_law import StaticLaw, draw_band

if TYPE_CHECKING:
    from matplotlib.axes import Axes

NAMES = ("A", "B")
FIGURE_KINDS = tuple(METADATA)  # of files, by their suffix
LARGEST_RATIO = 10.0  # limit of the axis of the ratio; the panel of the forces shows larger differences
LONGEST_LABEL = 28  # characters, so that both labels fit below a figure
COLUMNS = ("name", "a", "b", "unit", "difference", "sd", "z", "status_a", "status_b", "reason")


@dataclass(frozen=True, eq=False, repr=False)
class Comparison:
    """Comparison of two fits: iterate over its `ComparedQuantity`, or take one by name, such as `comparison["f0"]`.

    `felts` are both static laws over the same compressions, with 95 % bands at the best minimum, in `felt_unit`. They
    are None if a fit has no covariance. `warnings` are the limits of the comparison.
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
        return drawn_on(ax, _draw_laws, (self, self._drawable()))

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
        felts = self._drawable()
        rows, heights = 2 * (1 + any(law.slow is not None for law in felts)), (0.7 * HEIGHT, 0.4 * HEIGHT)
        panel = Panel(
            _draw_laws_and_ratio, (self, felts), "Static force of the felts", heights, legend_rows=rows, columns=2
        )
        with page_style():
            return saved(panel.figure(), kind)

    def _drawable(self) -> tuple[StaticLaw, StaticLaw]:
        if self.felts is None:
            raise FitError(f"{' '.join(self.warnings)} So they have no figure")
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
    numbers = (f"{quantity.difference:+.2g}", f"{quantity.sd:.2g}", f"{quantity.z:+z.1f}")
    return quantity.name, *values, unit, *numbers, ""


# --- figures ----------------------------------------------------------------------------------------------------------


def _draw_laws(axes: Axes, it: Comparison, felts: tuple[StaticLaw, StaticLaw]) -> None:
    """Draw both static laws with 95 % bands, and an error bar at the reference compression of each."""
    u = felts[0].compression_mm
    rows = zip(felts, it.compressions_mm, _escape_labels(it.labels), (FITTED, INITIAL), strict=True)
    for law, mark, label, hue in rows:
        draw_band(axes, u, law.force, {"color": hue, "lw": 1.6, "zorder": 4}, label)
        if law.slow is not None:
            style = {"color": hue, "lw": 1.2, "ls": (0, (4, 1.6)), "zorder": 3}
            draw_band(axes, u, law.slow, style, f"{label}, slow")
        if not u[0] <= mark <= u[-1]:
            continue
        force, low, high = law.at(mark)
        bars = [[force - low], [high - force]]
        axes.errorbar(mark, force, yerr=bars, fmt="o", ms=4, color=hue, lw=1.4, capsize=3, zorder=6)
    _, top = span(*(curve[0] for law in felts for curve in (law.force, law.slow) if curve is not None))
    highest = min(float(np.nanmax([law.force[2].max() for law in felts])), 2 * top)
    axes.set(xlabel="compression of the felt (mm)", xlim=(0.0, 1.02 * u[-1]), ylim=(0.0, 1.05 * max(highest, 1e-9)))
    axes.set_ylabel("static force (N)" if it.felt_unit == "N" else "static force over string mass (N/kg)")


def _escape_labels(labels: tuple[str, str]) -> list[str]:
    """Return shortened labels that a legend shows literally. A "$" would begin a formula, and a "_" hide an entry."""
    short = (label if len(label) <= LONGEST_LABEL else label[: LONGEST_LABEL - 1] + "…" for label in labels)
    return [f"{' ' * label.startswith('_')}{label}".replace("$", r"\$") for label in short]


def _draw_laws_and_ratio(force: Axes, axes: Axes, it: Comparison, felts: tuple[StaticLaw, StaticLaw]) -> None:
    """Draw both laws, and below them the second force over the first, with the 95 % band of two independent fits."""
    _draw_laws(force, it, felts)
    force.set_xlabel("")
    first, second = (np.log(np.maximum(law.force, np.finfo(float).tiny)) for law in felts)
    ratio = second[0] - first[0]
    half = np.hypot(second[2] - second[0], first[2] - first[0])
    low, centre, high = (np.exp(np.clip(x, -100.0, 100.0)) for x in (ratio - half, ratio, ratio + half))
    u, (first_label, second_label) = felts[0].compression_mm, _escape_labels(it.labels)
    axes.fill_between(u, low, high, color=INK, alpha=0.15, lw=0)
    axes.plot(u, centre, color=INK, lw=1.3)
    axes.axhline(1.0, color=INK, lw=0.8, ls=":")
    in_range = u >= u[-1] / 10  # bands are wide at small compressions
    bottom, top = min(low[in_range].min(), 1.0), max(high[in_range].max(), 1.0)
    margin = 0.08 * (top - bottom) + 1e-6
    axes.set_ylim(max(bottom - margin, 1 / LARGEST_RATIO), min(top + margin, LARGEST_RATIO))
    axes.set(ylabel="ratio", xlabel="compression of the felt (mm)")
    text = f"{second_label} over {first_label}"
    axes.text(0.99, 0.05, text, transform=axes.transAxes, ha="right", va="bottom", fontsize=8.5, color=INK)
