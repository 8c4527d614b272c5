"""Pictures of what the data fix: the felt's curve with its band, how well each thing is known, and correlations."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from ..io.number_format import format_relative_uncertainty
from .drawing import FITTED, INITIAL, INK, LINES, LOOP, MEASURED, PAPER, log_axis, make_figure, span
from .figure_data import Felt, IdentifiabilityData, RecordingCurves
from .text import SYMBOLS

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["draw_correlations", "draw_felt", "draw_known", "draw_law", "draw_static_law"]

WIDEST = 10.0  # half an interval, as a logarithm, beyond which a bar ends in an arrow: a factor of 22,000
NARROWEST = 1e-12
FAR = 1e6  # of a law, beyond which its band is not drawn


def draw_felt(felt: Felt, recordings: Sequence[RecordingCurves]) -> list[Figure]:
    """The static law with its band, and the loops that the strokes ran through."""
    rows = 1 if felt.slow is None else 2
    pictures = {"Linear axes": _linear, "Logarithmic axes": _logarithmic}
    return [
        make_figure(draw, felt, recordings, title=title, legend_rows=rows, columns=3)
        for title, draw in pictures.items()
    ]


def draw_static_law(axes: Axes, felt: Felt) -> None:
    """Draw the static law with its band over the compressions that the strokes reached."""
    _laws(axes, felt)
    tall = span(*(ends for ends in (felt.force[0], felt.slow) if ends is not None))[1]
    axes.set(xlim=(0.0, 1.03 * felt.compression[-1]), ylim=(0.0, 1.3 * max(tall, 1e-9)))


def _laws(axes: Axes, felt: Felt) -> None:
    draw_law(axes, felt.compression, felt.force, LINES["fitted"], "static law" if felt.slow is None else "sudden")
    if felt.slow is not None:
        draw_law(axes, felt.compression, felt.slow, LINES["initial"], "slow")
    axes.set(xlabel="compression of the felt (mm)", ylabel="force (N)")


def draw_law(axes: Axes, u: np.ndarray, force: np.ndarray, look: dict, name: str) -> None:
    """Draw one law, N over mm, and its band."""
    low, high = np.clip(force[1:], force[0] / FAR, force[0] * FAR)
    if (high > low).any():
        axes.fill_between(u, low, high, color=look["color"], alpha=0.18, lw=0, zorder=1, label=f"{name}, 95 %")
    axes.plot(u, force[0], label=name, **look)


def _linear(axes: Axes, felt: Felt, recordings: Sequence[RecordingCurves]) -> None:
    for i, one in enumerate(recordings):
        axes.plot(one.compression, one.force, color=LOOP, lw=1.1, zorder=3, label="" if i else "loop of a stroke")
    _laws(axes, felt)
    tall = max(0.0, span(felt.force[0], *(one.force for one in recordings))[1])
    axes.set(xlim=(0.0, 1.03 * felt.compression[-1]), ylim=(0.0, 1.25 * max(tall, 1e-9)))


def _logarithmic(axes: Axes, felt: Felt, recordings: Sequence[RecordingCurves]) -> None:
    """Over one and a half decades of compression, where a power law is a line; marks at the axis: the deepest."""
    _laws(axes, felt)
    u, law = felt.compression[-1], felt.force[0, -1]
    if not (u > 0 and law > 0 and np.isfinite(law)):
        return
    seen = felt.compression >= u / 32
    ends = felt.force[:, seen]
    axes.set(xscale="log", yscale="log", xlim=(u / 32, 1.15 * u))
    axes.set_ylim(max(ends[0].min() / 30, ends[1].min() / 2, law * 1e-9), min(30 * law, 2 * ends[2].max()))
    across, deepest = axes.get_xaxis_transform(), [span(one.compression)[1] for one in recordings]
    axes.plot(deepest, [0.03] * len(deepest), "|", color=MEASURED, ms=13, mew=2, transform=across, zorder=5)
    log_axis(axes.xaxis, (1, 3))
    log_axis(axes.yaxis, (1,))


def draw_known(known: IdentifiabilityData) -> list[Figure]:
    """Half intervals on a logarithmic scale, and the table of correlations in colours."""
    height = 0.32 * max(len(known.half_widths), len(known.names), 5)
    return [
        make_figure(draw, known, height=height, left=0.9, legend_rows=0)
        for draw in (_draw_half_widths, draw_correlations)
    ]


def _draw_half_widths(axes: Axes, known: IdentifiabilityData) -> None:
    """A row each: circles for what needs no assumed scale, squares for parameters below."""
    rows = range(len(known.half_widths))
    reach = np.clip([reach for _, reach, _ in known.half_widths], NARROWEST, WIDEST)
    left = 0.4 * min(reach)
    for row, value, (_, told, combined) in zip(rows, reach, known.half_widths, strict=True):
        colour, marker = (MEASURED, "o") if combined else (FITTED, "s")
        axes.plot([left, value], [row, row], color=colour, lw=1.6, marker=marker, ms=6.5, markevery=[1])
        words = "not at all" if told >= WIDEST else format_relative_uncertainty(told, "× or ÷ {}")
        axes.text(1.35 * value, row, words, va="center", fontsize=9, color=INK)
    axes.set(xscale="log", xlim=(left, 14 * max(reach)), ylim=(len(rows) - 0.4, -0.6))
    axes.set_yticks(rows, [_symbol(name) for name, *_ in known.half_widths])
    axes.set_xticks([], minor=True)
    axes.tick_params(labelbottom=False)
    _without_axes(axes)
    axes.set_title("How well it is known (95 %; logarithmic scale)")


def _without_axes(axes: Axes) -> None:
    """Leave the labels alone."""
    axes.tick_params(left=False, bottom=False)
    axes.grid(visible=False)
    axes.spines[["bottom", "left"]].set_visible(False)


def _symbol(name: str) -> str:
    """As mathtext, with what stands behind it in words."""
    symbol, _, stroke = SYMBOLS.get(name, name).partition(" ")
    lowered = re.sub(r"_(\w+)", r"_{\1}", symbol)
    return (f"${lowered}$" if "_" in symbol else symbol) + (f", {stroke}" if stroke else "")


def draw_correlations(axes: Axes, known: IdentifiabilityData) -> None:
    """Draw the table of correlations, in hundredths: one hue for each sign, the darker the more."""
    from matplotlib.colors import LinearSegmentedColormap

    names, n = [_symbol(name) for name in known.names], max(len(known.names), 2)
    shades = LinearSegmentedColormap.from_list("correlation", [INITIAL, "#ffffff", FITTED], 64)
    below = np.where(np.tri(len(names), k=-1, dtype=bool), known.correlation, np.nan)
    edges = np.arange(len(names) + 1) - 0.5
    axes.pcolormesh(edges, edges, below, cmap=shades, vmin=-1, vmax=1)
    for i in range(len(names)):
        for j in range(i):
            r = known.correlation[i, j]
            if abs(r) >= 0.1:
                axes.text(j, i, f"{100 * r:+.0f}".replace("-", "−"), ha="center", va="center", fontsize=8,
                          color=PAPER if abs(r) > 0.6 else INK)  # fmt: skip
    axes.set(xlim=(-0.5, n - 1.5), ylim=(n - 0.5, 0.5))  # the first row and the last column are empty
    axes.set_xticks(range(len(names) - 1), names[:-1])
    axes.set_yticks(range(1, len(names)), names[1:])
    _without_axes(axes)
    axes.set_title("Correlations of the estimates, %")
