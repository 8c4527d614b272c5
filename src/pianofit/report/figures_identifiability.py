"""Figures on identifiability: felt law with its band, uncertainty of each quantity, and correlations."""

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

__all__ = ["draw_correlations", "draw_felt", "draw_identifiability", "draw_law", "draw_static_law"]

# Limits of the length of a line, half of an interval as a logarithm. The larger one is a factor of 22,000.
WIDEST, NARROWEST = 10.0, 1e-12
LARGEST_BAND = 1e6  # factor up to which the band of a law is drawn


def draw_felt(felt: Felt, recordings: Sequence[RecordingCurves]) -> list[Figure]:
    """Draw the static law with its band, and the loops of force over compression of the strokes."""
    rows = 1 if felt.slow is None else 2
    panels = {"Linear axes": _linear, "Logarithmic axes": _logarithmic}
    return [
        make_figure(draw, felt, recordings, title=title, legend_rows=rows, columns=3) for title, draw in panels.items()
    ]


def draw_static_law(axes: Axes, felt: Felt) -> None:
    """Draw the static law with its band over the compressions of the strokes."""
    _laws(axes, felt)
    top = span(*(curve for curve in (felt.force[0], felt.slow) if curve is not None))[1]
    axes.set(xlim=(0.0, 1.03 * felt.compression[-1]), ylim=(0.0, 1.3 * max(top, 1e-9)))


def _laws(axes: Axes, felt: Felt) -> None:
    draw_law(
        axes, felt.compression, felt.force, LINES["fitted"], "static law" if felt.slow is None else "sudden compression"
    )
    if felt.slow is not None:
        draw_law(axes, felt.compression, felt.slow, LINES["initial"], "slow compression")
    axes.set(xlabel="compression of the felt (mm)", ylabel="force (N)")


def draw_law(axes: Axes, u: np.ndarray, force: np.ndarray, style: dict, name: str) -> None:
    """Draw one law, N over mm, with its band."""
    low, high = np.clip(force[1:], force[0] / LARGEST_BAND, force[0] * LARGEST_BAND)
    if (high > low).any():
        axes.fill_between(u, low, high, color=style["color"], alpha=0.18, lw=0, zorder=1, label=f"{name}, 95 %")
    axes.plot(u, force[0], label=name, **style)


def _linear(axes: Axes, felt: Felt, recordings: Sequence[RecordingCurves]) -> None:
    for i, recording in enumerate(recordings):
        label = "" if i else "during the stroke"
        axes.plot(recording.compression, recording.force, color=LOOP, lw=1.1, zorder=3, label=label)
    _laws(axes, felt)
    top = max(0.0, span(felt.force[0], *(recording.force for recording in recordings))[1])
    axes.set(xlim=(0.0, 1.03 * felt.compression[-1]), ylim=(0.0, 1.25 * max(top, 1e-9)))


def _logarithmic(axes: Axes, felt: Felt, recordings: Sequence[RecordingCurves]) -> None:
    """Draw one and a half decades of compression, with a mark at the largest compression of each recording."""
    _laws(axes, felt)
    u, law = felt.compression[-1], felt.force[0, -1]
    if not (u > 0 and law > 0 and np.isfinite(law)):
        return
    curves = felt.force[:, felt.compression >= u / 32]
    axes.set(xscale="log", yscale="log", xlim=(u / 32, 1.15 * u))
    axes.set_ylim(max(curves[0].min() / 30, curves[1].min() / 2, law * 1e-9), min(30 * law, 2 * curves[2].max()))
    transform, largest = axes.get_xaxis_transform(), [span(recording.compression)[1] for recording in recordings]
    axes.plot(largest, [0.03] * len(largest), "|", color=MEASURED, ms=13, mew=2, transform=transform, zorder=5)
    log_axis(axes.xaxis, (1, 3))
    log_axis(axes.yaxis, (1,))


def draw_identifiability(data: IdentifiabilityData) -> list[Figure]:
    """Draw half intervals on a logarithmic scale, and the table of correlations in colours."""
    height = 0.32 * max(len(data.half_widths), len(data.names), 5)
    return [
        make_figure(draw, data, height=height, left=0.9, legend_rows=0)
        for draw in (_draw_half_widths, draw_correlations)
    ]


def _draw_half_widths(axes: Axes, data: IdentifiabilityData) -> None:
    """Draw one row a quantity: circles for invariants, squares for parameters."""
    rows = range(len(data.half_widths))
    halves = np.clip([half for _, half, _ in data.half_widths], NARROWEST, WIDEST)
    left = 0.4 * min(halves)
    for row, value, (_, half, is_invariant) in zip(rows, halves, data.half_widths, strict=True):
        colour, marker = (MEASURED, "o") if is_invariant else (FITTED, "s")
        axes.plot([left, value], [row, row], color=colour, lw=1.6, marker=marker, ms=6.5, markevery=[1])
        text = "unknown" if half >= WIDEST else format_relative_uncertainty(half, "× or ÷ {}")
        axes.text(1.35 * value, row, text, va="center", fontsize=9, color=INK)
    axes.set(xscale="log", xlim=(left, 14 * max(halves)), ylim=(len(rows) - 0.4, -0.6))
    axes.set_yticks(rows, [_symbol(name) for name, *_ in data.half_widths])
    axes.set_xticks([], minor=True)
    axes.tick_params(labelbottom=False)
    _without_axes(axes)
    axes.set_title("Uncertainty (95 %, logarithmic scale)")


def _without_axes(axes: Axes) -> None:
    """Hide everything except the labels."""
    axes.tick_params(left=False, bottom=False)
    axes.grid(visible=False)
    axes.spines[["bottom", "left"]].set_visible(False)


def _symbol(name: str) -> str:
    """Return a symbol as mathtext, followed by the number of a stroke if it has one."""
    symbol, _, stroke = SYMBOLS.get(name, name).partition(" ")
    mathtext = re.sub(r"_(\w+)", r"_{\1}", symbol)
    return (f"${mathtext}$" if "_" in symbol else symbol) + (f", {stroke}" if stroke else "")


def draw_correlations(axes: Axes, data: IdentifiabilityData) -> None:
    """Draw the table of correlations in per cent: a hue for each sign, darker for stronger correlation."""
    from matplotlib.colors import LinearSegmentedColormap

    names, n = [_symbol(name) for name in data.names], max(len(data.names), 2)
    shades = LinearSegmentedColormap.from_list("correlation", [INITIAL, "#ffffff", FITTED], 64)
    below = np.where(np.tri(len(names), k=-1, dtype=bool), data.correlation, np.nan)
    edges = np.arange(len(names) + 1) - 0.5
    axes.pcolormesh(edges, edges, below, cmap=shades, vmin=-1, vmax=1)
    for i in range(len(names)):
        for j in range(i):
            r = data.correlation[i, j]
            if abs(r) >= 0.1:
                axes.text(j, i, f"{100 * r:+.0f}".replace("-", "−"), ha="center", va="center", fontsize=8,
                          color=PAPER if abs(r) > 0.6 else INK)  # fmt: skip
    axes.set(xlim=(-0.5, n - 1.5), ylim=(n - 0.5, 0.5))  # the first row and the last column are empty
    axes.set_xticks(range(len(names) - 1), names[:-1])
    axes.set_yticks(range(1, len(names)), names[1:])
    _without_axes(axes)
    axes.set_title("Correlations of the estimates, %")
