"""Figure of two felts: static force over one axis of compression, with bands."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from .comparison_table import middle
from .drawing import HEIGHT, INK, file_of, legend, page_style, panel, span
from .figure_data import Felt
from .figures_identifiability import draw_law
from .overlay import HUES

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["KINDS", "draw_felts", "figure_of_felts"]

# Kinds of files, by their suffix.
KINDS = ("svg", "png", "pdf")
LARGEST_EXPONENT = 100.0  # so that exp does not overflow
LONGEST_LABEL = 28  # characters, so that both fit below a figure
DASHED = (0, (4, 1.6))
# Limit of the axis of the ratio. The upper panel shows larger differences.
LARGEST_RATIO = 10.0


def draw_felts(axes: Axes, felts: tuple[Felt, Felt], labels: tuple[str, str], unit: str) -> None:
    """Draw both static laws with 95 % bands, and an error bar at the compared compression."""
    largest, labels = felts[0].compression[-1], _escape_labels(labels)
    for felt, label, hue in zip(felts, labels, HUES, strict=False):
        draw_law(axes, felt.compression, felt.force, {"color": hue, "lw": 1.6, "zorder": 4}, label)
        if felt.slow is not None:
            style = {"color": hue, "lw": 1.2, "ls": DASHED, "zorder": 3}
            draw_law(axes, felt.compression, felt.slow, style, f"{label}, slow")
        index = middle(felt)
        force, low, high = felt.force[:, index]
        axes.errorbar(felt.compression[index], force, yerr=[[force - low], [high - force]],
                      fmt="o", ms=4, color=hue, lw=1.4, capsize=3, zorder=6)  # fmt: skip
    _, top = span(*(curve[0] for felt in felts for curve in (felt.force, felt.slow) if curve is not None))
    highest = min(float(np.nanmax([felt.force[2].max() for felt in felts])), 2 * top)
    axes.set(
        xlabel="compression of the felt (mm)", xlim=(0.0, 1.02 * largest), ylim=(0.0, 1.05 * max(highest, 1e-9)),
        ylabel="static force (N)" if unit == "N" else "static force over string mass (N/kg)",
    )  # fmt: skip


def _escape_labels(labels: tuple[str, str]) -> tuple[str, str]:
    """Return shortened labels that a legend shows literally. A "$" would begin a formula, and a "_" hide an entry."""
    first, second = (label if len(label) <= LONGEST_LABEL else label[: LONGEST_LABEL - 1] + "…" for label in labels)
    first, second = (label.replace("$", r"\$") for label in (first, second))
    return f" {first}" if first.startswith("_") else first, f" {second}" if second.startswith("_") else second


def _draw_ratio(axes: Axes, felts: tuple[Felt, Felt], labels: tuple[str, str]) -> None:
    """Draw the second force over the first, with the 95 % band of two independent fits."""
    first, second = (np.log(np.maximum(felt.force, np.finfo(float).tiny)) for felt in felts)
    ratio = second[0] - first[0]
    half = np.hypot(second[2] - second[0], first[2] - first[0])
    low, centre, high = (
        np.exp(np.clip(x, -LARGEST_EXPONENT, LARGEST_EXPONENT)) for x in (ratio - half, ratio, ratio + half)
    )
    u, labels = felts[0].compression, _escape_labels(labels)
    axes.fill_between(u, low, high, color=INK, alpha=0.15, lw=0)
    axes.plot(u, centre, color=INK, lw=1.3)
    axes.axhline(1.0, color=INK, lw=0.8, ls=":")
    in_range = u >= u[-1] / 10  # bands are wide at small compressions
    bottom, top = min(low[in_range].min(), 1.0), max(high[in_range].max(), 1.0)
    margin = 0.08 * (top - bottom) + 1e-6
    axes.set(ylim=(max(bottom - margin, 1 / LARGEST_RATIO), min(top + margin, LARGEST_RATIO)), ylabel="ratio",
             xlabel="compression of the felt (mm)")  # fmt: skip
    axes.text(0.99, 0.05, f"{labels[1]} over {labels[0]}", transform=axes.transAxes, ha="right", va="bottom",
              fontsize=8.5, color=INK)  # fmt: skip


def figure_of_felts(felts: tuple[Felt, Felt], labels: tuple[str, str], unit: str, kind: str) -> bytes:
    """Return the content of a file of the figure: the forces, and below them their ratio."""
    with page_style():
        rows = 2 * (1 + any(felt.slow is not None for felt in felts))
        figure, (force, ratio) = panel(0.7 * HEIGHT, 0.4 * HEIGHT, legend_rows=rows)
        draw_felts(force, felts, labels, unit)
        force.set(title="Static force of the felts", xlabel="")
        _draw_ratio(ratio, felts, labels)
        legend(figure, force, 2)
        return file_of(figure, kind)
