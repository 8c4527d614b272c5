"""Figures in the report's style, each drawn once: as SVG for the page, and as PNG beside it.

Lines are told apart by colour and by stroke: the page must be readable in grey and by colour-blind eyes (Okabe and
Ito's colours). Functions that draw get arrays and compute nothing.
"""

from __future__ import annotations

import io
from collections.abc import Callable
from threading import Lock
from typing import TYPE_CHECKING, Any

from ...report.figures import FITTED, INITIAL, INK, MEASURED, STYLE

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["LINES", "THREE", "WIDTH", "drawn", "figure", "key", "marks"]

WIDTH = 11.25  # inches; the page shows it 1128 pixels wide
DPI = 120
GLOBAL, DEFAULT, PURPLE = "#b8860b", "#009e73", "#8a5a9e"
# One look for each sound wherever it appears.
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
_LOCK = Lock()  # matplotlib's settings are global


def drawn(draw: Callable[[], Figure]) -> tuple[bytes, bytes]:
    """The figure that `draw` makes, as SVG and as PNG; the same arrays give the same bytes."""
    from matplotlib import rc_context

    with _LOCK, rc_context(STYLE):
        made = draw()
        svg, png = io.BytesIO(), io.BytesIO()
        made.savefig(svg, format="svg", metadata={"Date": None, "Creator": None}, dpi=DPI)
        made.savefig(png, format="png", metadata={"Software": None}, dpi=DPI)
    return svg.getvalue().replace(b"'DejaVu Sans'", b"system-ui, 'DejaVu Sans'"), png.getvalue()


def figure(height: float) -> Figure:
    """An empty one of the page's width, inches."""
    from matplotlib.figure import Figure

    return Figure(figsize=(WIDTH, height))


def key(made: Figure, axes: Axes, **options: Any) -> None:
    """One legend at the lower edge for all."""
    handles, labels = axes.get_legend_handles_labels()
    made.legend(handles, labels, loc="lower center", ncols=len(labels), **options)


def marks(name: str) -> dict[str, Any]:
    """How points of a sound look."""
    return {"color": LINES[name]["color"], "marker": MARKERS[name], "ls": "none", "ms": 7, "label": name}


__all__ += ["DEFAULT", "FITTED", "GLOBAL", "INITIAL", "INK", "MEASURED", "PURPLE"]
