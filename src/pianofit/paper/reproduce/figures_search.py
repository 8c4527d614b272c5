"""The landscape of band 3, and where the searches in it ended."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from .band3 import WITHIN, Landscape, Race
from .looks import FITTED, GLOBAL, GREY, INITIAL, PURPLE, figure, key, mark_truth

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["plane", "searches"]

AXES = {
    "F": "felt's stiffness over the true one (as force at 0.1 mm)", "M_H": "hammer's mass over the true one",
    "v_H0": "velocity over the true one", "mu": "μ over the true one", "p": "p over the true one",
}  # fmt: skip


def plane(seen: Landscape) -> Figure:
    """The criterion over two coordinates, with its minima."""
    made = figure(5.6)
    axes, bar = made.add_axes((0.07, 0.11, 0.80, 0.86)), made.add_axes((0.89, 0.11, 0.022, 0.86))
    x, y = np.exp(seen.second), np.exp(seen.first)
    level = np.log10(np.clip(np.where(np.isfinite(seen.criterion), seen.criterion, np.nan), 1e-6, 1e2))
    levels = np.arange(np.floor(4 * np.nanmin(level)) / 4, min(np.nanmax(level), 0.5) + 0.1, 0.125)
    shown = axes.contourf(x, y, level, levels=levels, cmap="viridis", extend="max")
    shown.set_rasterized(True)
    for n, minimum in enumerate(seen.minima):
        deepest = n == 0
        axes.plot(np.exp(minimum.z[1]), np.exp(minimum.z[0]), marker="*" if deepest else "o", ms=17 if deepest else 9,
                  color="white", mec="black", mew=1.0, ls="none",
                  label="deepest minimum" if deepest else "other minima" if n == 1 else None)  # fmt: skip
        side = "right" if minimum.z[1] > 0.8 * seen.second[-1] else "left"
        axes.annotate(f"{minimum.cost:.2g}", (np.exp(minimum.z[1]), np.exp(minimum.z[0])), xytext=(0, 11), ha=side,
                      color="white", textcoords="offset points", fontsize=9.5, fontweight="bold")  # fmt: skip
    axes.set_xscale("log")
    axes.set_yscale("log")
    for axis, ticks in ((axes.xaxis, (0.5, 0.7, 1, 1.4, 2)), (axes.yaxis, (0.1, 0.2, 0.5, 1, 2, 5, 10))):
        low, high = (x[0], x[-1]) if axis is axes.xaxis else (y[0], y[-1])
        inside = [t for t in ticks if low <= t <= high]
        axis.set_ticks(inside, [f"{t:g}" for t in inside])
        axis.set_ticks([], minor=True)
    axes.set(xlabel=AXES[seen.names[1]], ylabel=AXES[seen.names[0]])
    axes.grid(visible=False)
    ticks = [t for t in (-4, -3, -2, -1.5, -1, -0.5, 0) if t >= levels[0]]
    made.colorbar(shown, cax=bar, label="criterion in band 3", ticks=ticks, format=lambda t, _: f"{10.0**t:.2g}")
    return made


def searches(run: Race) -> Figure:
    """Where every search ended, sorted method by method."""
    made = figure(4.8)
    axes = made.add_axes((0.07, 0.21, 0.92, 0.76))
    kinds = (
        ("start", "start", GREY, "x"), ("gradient", "gradient descent", INITIAL, "s"),
        ("squares", "least squares", PURPLE, "^"), ("annealed", "annealing", FITTED, "o"),
        ("polished", "annealing, then least squares", GLOBAL, "D"),
    )  # fmt: skip
    for name, label, color, marker in kinds:
        value = np.sort(getattr(run, name))
        axes.plot(np.arange(1, len(value) + 1), np.clip(value, None, 10.0), color=color, marker=marker, ms=6, lw=1.0,
                  label=label, mfc="none" if name == "polished" else color)  # fmt: skip
    mark_truth(axes.axhline, WITHIN * run.least)
    axes.text(0.995, WITHIN * run.least * 1.05, "below this line: the deepest minimum", ha="right", va="bottom",
              fontsize=9, transform=axes.get_yaxis_transform())  # fmt: skip
    axes.set_yscale("log")
    axes.set(xlabel="searches, each method's own sorted by where they ended", ylabel="criterion in band 3")
    axes.locator_params(axis="x", integer=True)
    axes.margins(x=0.02)
    key(made, axes)
    return made
