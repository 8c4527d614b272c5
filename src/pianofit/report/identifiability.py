"""Which quantities the data determine: sentences, uncertainties of all estimates, and their correlations.

Each combination of parameters goes to one of three lists of sentences, by the width of its interval and by its status.
Text is plain; the page escapes it.
"""

from __future__ import annotations

import math
import re
from typing import TYPE_CHECKING

import numpy as np

from ..excitation import HAMMER
from ..io.number_format import (
    format_relative_uncertainty,
    log_half_width,
    number,
    with_half_interval,
    with_interval,
)
from ..result import Result
from ..schema.fit import Fit
from ..schema.quantities import MEANINGS, Covariance, Quantity
from .drawing import FITTED, INITIAL, INK, MEASURED, PAPER, Panel
from .text import SYMBOLS, VELOCITY_RATIO

if TYPE_CHECKING:
    from matplotlib.axes import Axes

DETERMINED = "Determined by the data, with 95 % uncertainty in parentheses"
CONDITIONAL = "Not identifiable: the uncertainty in parentheses holds only if model and output path are exactly correct"
UNDETERMINED = "Not determined by the data"
# Half of a 95 % interval, as a logarithm: up to a factor of 2, a quantity that is reported as not identifiable would
# be determined if the model were correct.
LARGEST_CONDITIONAL = math.log(2.0)
# Parameters that are shown as part of an invariant.
IN_INVARIANTS = ("c", "kappa", "M_H", "x0")
# Limits of the length of a line, half of an interval as a logarithm. The larger one is a factor of 22,000.
WIDEST, NARROWEST = 10.0, 1e-12


# --- sentences --------------------------------------------------------------------------------------------------------


def identifiability_sections(fit: Fit) -> list[tuple[str, list[str]]]:
    """Return (heading, sentences): combinations that are determined, conditional on the model, and undetermined."""
    sections: dict[str, list[str]] = {DETERMINED: [], CONDITIONAL: [], UNDETERMINED: []}
    places = [name for name in fit.invariants if name.startswith("x0/L")] or ["x0/L"]
    for name in ("f0", "B", *places, "pickup/L", "width/L", "F/M_S", "M_H/M_S"):
        quantity = fit.invariants.get(name)
        half = None if quantity is None else log_half_width(quantity.interval)
        if quantity is None or half is None:  # given, or not part of this fit
            continue
        heading = DETERMINED
        if quantity.status == "not-identifiable":
            heading = CONDITIONAL if half <= LARGEST_CONDITIONAL else UNDETERMINED
        sections[heading].append(_sentence(fit, quantity, half))
    sections[DETERMINED] += _velocities(fit)
    return [(heading, sentences) for heading, sentences in sections.items() if sentences]


def _sentence(fit: Fit, quantity: Quantity, half: float) -> str:
    """Return the value of an invariant; that of the felt at the compression of the strokes, which determine it."""
    name = quantity.name
    if name == "f0":
        value, _ = with_interval(quantity.value, quantity.interval)
        return f"Pitch: f₀ = {value} Hz (± {number(1200 * half / math.log(2), 2)} cents)."
    if name != "F/M_S":
        return (
            f"{_capitalised(quantity.meaning or MEANINGS[name])}: {name} = {with_half_interval(quantity.value, half)}."
        )
    text = f"{_capitalised(quantity.note)}. Divided by the mass of the string: "
    text += f"{name} = {with_half_interval(quantity.value, half, 'N/kg')}."
    stiffness = fit.parameters.get("K_H")
    half_of_stiffness = None if stiffness is None else log_half_width(stiffness.interval)
    if half_of_stiffness is not None and half_of_stiffness > 1.2 * half:
        uncertainty = format_relative_uncertainty(half_of_stiffness, "a factor of {}")
        text += f" K_H alone is uncertain by {uncertainty}. Its unit depends on p."
    return f"{text} {felt_scale(fit)}".rstrip()


def _capitalised(words: str) -> str:
    return words[:1].upper() + words[1:]


def felt_scale(fit: Fit) -> str:
    """Return the assumptions on which force and compression of the felt depend; empty if there are none."""
    if fit.excitation != HAMMER:
        return ""
    is_mass_assumed = fit.parameters["M_S"].status == "assumed"
    if not fit.velocity_scale_open:
        return "Forces scale with the assumed mass of the string." if is_mass_assumed else ""
    text = "Forces and compressions scale with the velocities, whose common scale was not measured."
    return text + (" Forces also scale with the assumed mass of the string." if is_mass_assumed else "")


def _velocities(fit: Fit) -> list[str]:
    """Return how well the hammer velocities are determined; only their ratios if none was measured."""
    if fit.excitation != HAMMER:
        return []  # plucking positions are among the invariants
    if fit.velocity_scale_open:
        noun = "Ratios of the hammer velocities"
        ratios = (q for name, q in fit.invariants.items() if name.startswith(VELOCITY_RATIO))
        intervals = [(q.status, q.interval) for q in ratios]
    else:
        noun = "Hammer velocities"
        intervals = [(row.stroke_status, row.stroke_interval) for row in fit.recordings if len(fit.recordings) > 1]
    halves = [log_half_width(interval) for status, interval in intervals if status != "not-identifiable"]
    widths = [half for half in halves if half is not None]
    return [f"{noun} (the least certain one: {format_relative_uncertainty(max(widths))})."] if widths else []


# --- figures ----------------------------------------------------------------------------------------------------------


def half_widths(fit: Fit) -> list[tuple[str, float, bool]]:
    """Return name, half of the 95 % interval of the logarithm, and whether it is an invariant, of each quantity."""
    rows = [(name, q.interval, True) for name, q in fit.invariants.items()]
    rows += [(name, q.interval, False) for name, q in fit.parameters.items() if name not in IN_INVARIANTS]
    halves = [(name, log_half_width(interval), is_invariant) for name, interval, is_invariant in rows]
    return [(name, half, is_invariant) for name, half, is_invariant in halves if half is not None]


def draw_identifiability(result: Result) -> list[Panel]:
    """Draw half intervals on a logarithmic scale, and the table of correlations in colours; [] without intervals."""
    correlation, halves = result.correlation, half_widths(result.fit)
    if correlation is None or not correlation.names:
        return []
    height = 0.32 * max(len(halves), len(correlation.names), 5)
    panels = {_draw_half_widths: halves, draw_correlations: correlation}
    return [Panel(draw, (data,), heights=(height,), left=0.9, legend_rows=0) for draw, data in panels.items()]


def _draw_half_widths(axes: Axes, entries: list[tuple[str, float, bool]]) -> None:
    """Draw one row a quantity: circles for invariants, squares for parameters."""
    halves = np.clip([half for _, half, _ in entries], NARROWEST, WIDEST)
    left = 0.4 * min(halves)
    for row, (value, (_, half, is_invariant)) in enumerate(zip(halves, entries, strict=True)):
        colour, marker = (MEASURED, "o") if is_invariant else (FITTED, "s")
        axes.plot([left, value], [row, row], color=colour, lw=1.6, marker=marker, ms=6.5, markevery=[1])
        text = "unknown" if half >= WIDEST else format_relative_uncertainty(half)
        axes.text(1.35 * value, row, text, va="center", fontsize=9, color=INK)
    axes.set(xscale="log", xlim=(left, 14 * max(halves)), ylim=(len(entries) - 0.4, -0.6))
    axes.set_yticks(range(len(entries)), [_symbol(name) for name, *_ in entries])
    axes.set_xticks([], minor=True)
    axes.tick_params(labelbottom=False)
    _hide_frame(axes)
    axes.set_title("Uncertainty (95 %, logarithmic scale)")


def draw_correlations(axes: Axes, correlation: Covariance) -> None:
    """Draw the table of correlations in per cent: a hue for each sign, darker for stronger correlation."""
    from matplotlib.colors import LinearSegmentedColormap

    names, n = [_symbol(name) for name in correlation.names], max(len(correlation.names), 2)
    shades = LinearSegmentedColormap.from_list("correlation", [INITIAL, "#ffffff", FITTED], 64)
    below = np.where(np.tri(len(names), k=-1, dtype=bool), correlation.matrix, np.nan)
    edges = np.arange(len(names) + 1) - 0.5
    axes.pcolormesh(edges, edges, below, cmap=shades, vmin=-1, vmax=1)
    for i, j in np.argwhere(np.abs(below) >= 0.1):
        r = below[i, j]
        text, colour = f"{100 * r:+z.0f}".replace("-", "−"), PAPER if abs(r) > 0.6 else INK
        axes.text(j, i, text, ha="center", va="center", fontsize=8, color=colour)
    axes.set(xlim=(-0.5, n - 1.5), ylim=(n - 0.5, 0.5))  # the first row and the last column are empty
    axes.set_xticks(range(len(names) - 1), names[:-1])
    axes.set_yticks(range(1, len(names)), names[1:])
    _hide_frame(axes)
    axes.set_title("Correlations of the estimates, %")


def _hide_frame(axes: Axes) -> None:
    """Hide everything except the labels."""
    axes.tick_params(left=False, bottom=False)
    axes.grid(visible=False)
    axes.spines[["bottom", "left"]].set_visible(False)


def _symbol(name: str) -> str:
    """Return a symbol as mathtext, followed by the number of a stroke if it has one."""
    symbol, _, stroke = SYMBOLS.get(name, name).partition(" ")
    mathtext = re.sub(r"_(\w+)", r"_{\1}", symbol)
    return (f"${mathtext}$" if "_" in symbol else symbol) + (f", {stroke}" if stroke else "")
