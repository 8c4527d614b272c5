"""The figure of two felts: static force over one axis of compression, with bands."""

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

# Kinds of file, by the ending of the name.
KINDS = ("svg", "png", "pdf")
LARGEST = 100.0  # of a logarithm, so that e to it is a number
LONGEST = 28  # characters of a label, so that both fit below a figure
DASHED = (0, (4, 1.6))
# The axis of the ratio ends at this factor: farther apart, the upper panel shows the difference.
FARTHEST = 10.0


def draw_felts(axes: Axes, felts: tuple[Felt, Felt], labels: tuple[str, str], unit: str) -> None:
    """Draw both static laws with 95 % bands, and each with a bar where the table compares them."""
    reach, labels = felts[0].compression[-1], _shown(labels)
    for felt, label, hue in zip(felts, labels, HUES, strict=False):
        draw_law(axes, felt.compression, felt.force, {"color": hue, "lw": 1.6, "zorder": 4}, label)
        if felt.slow is not None:
            look = {"color": hue, "lw": 1.2, "ls": DASHED, "zorder": 3}
            draw_law(axes, felt.compression, felt.slow, look, f"{label}, slow")
        at = middle(felt)
        force, low, high = felt.force[:, at]
        axes.errorbar(felt.compression[at], force, yerr=[[force - low], [high - force]],
                      fmt="o", ms=4, color=hue, lw=1.4, capsize=3, zorder=6)  # fmt: skip
    _, top = span(*(curve[0] for felt in felts for curve in (felt.force, felt.slow) if curve is not None))
    highest = min(float(np.nanmax([felt.force[2].max() for felt in felts])), 2 * top)
    axes.set(
        xlabel="compression of the felt (mm)", xlim=(0.0, 1.02 * reach), ylim=(0.0, 1.05 * max(highest, 1e-9)),
        ylabel="static force (N)" if unit == "N" else "static force over the string's mass (N/kg)",
    )  # fmt: skip


def _shown(labels: tuple[str, str]) -> tuple[str, str]:
    """Labels that a legend shows as they are, without formulas: a "$" begins one, and a "_" hides an entry."""
    first, second = (label if len(label) <= LONGEST else label[: LONGEST - 1] + "…" for label in labels)
    first, second = (label.replace("$", r"\$") for label in (first, second))
    return f" {first}" if first.startswith("_") else first, f" {second}" if second.startswith("_") else second


def _draw_ratio(axes: Axes, felts: tuple[Felt, Felt], labels: tuple[str, str]) -> None:
    """Draw the second force over the first, with the 95 % band of two independent fits."""
    first, second = (np.log(np.maximum(felt.force, np.finfo(float).tiny)) for felt in felts)
    ratio = second[0] - first[0]
    half = np.hypot(second[2] - second[0], first[2] - first[0])
    low, middle_, high = (np.exp(np.clip(x, -LARGEST, LARGEST)) for x in (ratio - half, ratio, ratio + half))
    u, labels = felts[0].compression, _shown(labels)
    axes.fill_between(u, low, high, color=INK, alpha=0.15, lw=0)
    axes.plot(u, middle_, color=INK, lw=1.3)
    axes.axhline(1.0, color=INK, lw=0.8, ls=":")
    seen = u >= u[-1] / 10  # below, a band is wide and says little
    bottom, top = min(low[seen].min(), 1.0), max(high[seen].max(), 1.0)
    room = 0.08 * (top - bottom) + 1e-6
    axes.set(ylim=(max(bottom - room, 1 / FARTHEST), min(top + room, FARTHEST)), ylabel="ratio",
             xlabel="compression of the felt (mm)")  # fmt: skip
    axes.text(0.99, 0.05, f"{labels[1]} over {labels[0]}", transform=axes.transAxes, ha="right", va="bottom",
              fontsize=8.5, color=INK)  # fmt: skip


def figure_of_felts(felts: tuple[Felt, Felt], labels: tuple[str, str], unit: str, kind: str) -> bytes:
    """The content of a file of the figure, the same for the same felts: the forces, and below them their ratio."""
    with page_style():
        rows = 2 * (1 + any(felt.slow is not None for felt in felts))
        figure, (force, ratio) = panel(0.7 * HEIGHT, 0.4 * HEIGHT, legend_rows=rows)
        draw_felts(force, felts, labels, unit)
        force.set(title="Static force of the felts", xlabel="")
        _draw_ratio(ratio, felts, labels)
        legend(figure, force, 2)
        return file_of(figure, kind)
