"""One look for each sound wherever it appears, in the report's style.

Lines are told apart by colour and by stroke: the page must be readable in grey and by colour-blind eyes (Okabe and
Ito's colours). Functions that draw get arrays and compute nothing.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from ...report.drawing import FITTED, INITIAL, INK, MEASURED

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = [
    "DEFAULT", "FITTED", "GLOBAL", "GREY", "INITIAL", "INK", "LINES", "PURPLE", "THREE", "figure", "key", "marks",
    "mark_truth",
]  # fmt: skip

WIDTH = 11.25  # inches; the page shows it 1128 pixels wide
GREY = "#9aa3ad"
GLOBAL = "#b8860b"
DEFAULT = "#009e73"
PURPLE = "#8a5a9e"
LINES: dict[str, dict[str, Any]] = {
    "measured": {"color": MEASURED, "ls": "-", "lw": 1.2},
    "initial": {"color": INITIAL, "ls": (0, (4, 1.6)), "lw": 1.2},
    "global criterion": {"color": GLOBAL, "ls": (0, (1, 1.2)), "lw": 1.8},
    "three bands": {"color": FITTED, "ls": "-", "lw": 1.6},
    "three bands, string read": {"color": PURPLE, "ls": (0, (8, 1.5)), "lw": 1.6},
    "default recipe": {"color": DEFAULT, "ls": (0, (6, 1.5, 1, 1.5)), "lw": 1.4},
}
MARKERS = {
    "measured": "o",
    "initial": "s",
    "global criterion": "^",
    "three bands": "D",
    "three bands, string read": "P",
    "default recipe": "v",
}
# Three velocities, soft to hard.
THREE = (
    {"color": "#56b4e9", "ls": (0, (5, 1.5)), "lw": 1.5},
    {"color": FITTED, "ls": "-", "lw": 1.5},
    {"color": INITIAL, "ls": "-", "lw": 1.5},
)


def figure(height: float) -> Figure:
    """An empty one of the page's width, inches."""
    from matplotlib.figure import Figure

    return Figure(figsize=(WIDTH, height))


def key(made: Figure, axes: Axes) -> None:
    """One legend at the lower edge for all."""
    handles, labels = axes.get_legend_handles_labels()
    made.legend(handles, labels, loc="lower center", ncols=len(labels))


def marks(name: str) -> dict[str, Any]:
    """How points of a sound look."""
    return {"color": LINES[name]["color"], "marker": MARKERS[name], "ls": "none", "ms": 7, "label": name}


def mark_truth(line: Any, at: float, **options: Any) -> None:
    """A dashed line at a value that others are to be read against; `line` is a method of the axes."""
    line(at, color=INK, lw=1.0, ls=(0, (3, 2)), **options)
