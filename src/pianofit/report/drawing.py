"""Style of the figures: a colour and a line style for each of measured, initial, string model and fitted.

The colours are those of Okabe and Ito, which colour-blind readers can distinguish. Line style and order distinguish the
lines in grey. A page replaces each colour by the property of `page.css` that `COLOURS` names, which has a second value
on dark pages. Figures are SVG with text as text, which was faster and sharper than PNG at twice the resolution.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from threading import Lock
from typing import TYPE_CHECKING, Any

import numpy as np

from ..conversions import HALF_WIDTH_95, HIGHEST_KEY, LOWEST_KEY

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

INK, MEASURED, INITIAL, LAW, FITTED, FAINT = "#333333", "#1a1a1a", "#d55e00", "#009e73", "#0072b2", "#eeeeee"
PAPER, GRID, EDGE, BORDER, HATCH = "#ffffff", "#e3e7ec", "#9aa3ad", "#7b8794", "#c3cad2"
LOOP, BAND, GROUP, WRONG = "#8fbfe0", "#cfe3f1", "#cc79a7", "#a3123a"
GROUPS = (FITTED, LAW, GROUP, INITIAL)  # of path groups, or of partials
MARKERS = "osD^"  # of partials
# Colour -> property of `page.css`.
COLOURS = (
    {INK: "ink", MEASURED: "measured", INITIAL: "initial", LAW: "law", FITTED: "fitted", FAINT: "faint"}
    | {PAPER: "paper", GRID: "line", EDGE: "axis", BORDER: "edge", HATCH: "axis"}
    | {LOOP: "loop", BAND: "band", GROUP: "group", WRONG: "bad"}
)
# Inches. A figure is one panel that is legible on a telephone. A page puts panels side by side.
WIDTH = 5.6
HEIGHT = 3.1
LEFT, RIGHT, TOP, GAP = 0.72, 0.16, 0.3, 0.12
BELOW = 0.52  # the ticks and the label of x
# From the left edge to the label of y, and from the axes down to the label of x. They are fixed, because matplotlib
# would lay out all ticks once more to find the positions.
Y_LABEL, X_LABEL = 0.21, 0.31
LEGEND = 0.28  # a line of the legend
LINES: dict[str, dict[str, Any]] = {
    "measured": {"color": MEASURED, "lw": 1.1, "zorder": 2},
    "initial": {"color": INITIAL, "lw": 1.2, "ls": (0, (4, 1.6)), "zorder": 3},
    "string model": {"color": LAW, "lw": 1.2, "ls": (0, (6, 1.6)), "zorder": 3},
    "fitted": {"color": FITTED, "lw": 1.5, "zorder": 4},
}
STYLE: dict[Any, Any] = {
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans"],
    "font.size": 9.5,
    "text.color": INK,
    "axes.facecolor": "none",
    "axes.titlesize": 10,
    "axes.titlelocation": "left",
    "axes.titlecolor": INK,
    "axes.titley": 1.0,  # otherwise matplotlib lays out all ticks once more to avoid overlap with the title
    "axes.edgecolor": EDGE,
    "axes.labelcolor": INK,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.unicode_minus": True,
    "axes.xmargin": 0.0,
    "grid.color": GRID,
    "grid.linewidth": 0.7,
    "xtick.color": INK,
    "ytick.color": INK,
    "legend.frameon": False,
    "legend.fontsize": 9.5,
    "errorbar.capsize": 0,
    "figure.facecolor": "white",
    "svg.fonttype": "none",
    "svg.hashsalt": "pianofit",
    "text.usetex": False,
    "path.simplify_threshold": 0.2,
}
# Kinds of files, and what matplotlib would write about itself or the time.
METADATA = {"svg": ("Date", "Creator"), "png": ("Software",), "pdf": ("CreationDate", "Creator", "Producer")}
DPI = 120  # of a PNG, and of raster images within an SVG
_LOCK = Lock()  # matplotlib's settings are global


@contextmanager
def page_style() -> Iterator[None]:
    """Draw and save in the page's style."""
    from matplotlib import rc_context

    with _LOCK, rc_context(STYLE):
        yield


@dataclass(frozen=True)
class Panel:
    """A panel of a page that is not drawn yet: `draw(*axes, *values)` draws it, on as many axes as `heights` has.

    The axes lie one above the other and share their x. The legend below them has the labels of the first.
    """

    draw: Callable[..., None]
    values: tuple[Any, ...] = ()
    title: str = ""
    heights: tuple[float, ...] = (HEIGHT,)  # inches
    left: float = LEFT  # space for the ticks and the label of y, inches
    legend_rows: int = 1
    columns: int = 4  # of the legend

    def figure(self) -> Figure:
        """Draw the panel, within `page_style`."""
        from matplotlib.figure import Figure

        width, total = WIDTH - self.left - RIGHT, TOP + sum(self.heights) + GAP * (len(self.heights) - 1)
        total += BELOW + LEGEND * self.legend_rows
        figure, panels, bottom = Figure(figsize=(WIDTH, total)), [], total - TOP
        for height in self.heights:
            bottom -= height
            box = (self.left / WIDTH, bottom / total, width / WIDTH, height / total)
            axes = figure.add_axes(box, sharex=panels[0] if panels else None)
            axes.yaxis.set_label_coords((Y_LABEL - self.left) / width, 0.5)
            axes.xaxis.set_label_coords(0.5, -X_LABEL / height)
            panels.append(axes)
            bottom -= GAP
        for axes in panels[:-1]:
            axes.tick_params(labelbottom=False)
        self.draw(*panels, *self.values)
        if self.title:
            panels[0].set_title(self.title)
        legend(figure, panels[0], self.columns)
        return figure


def saved(figure: Figure, kind: str) -> bytes:
    """Return the figure as the content of an svg, png or pdf, byte for byte the same for the same figure."""
    file = io.BytesIO()
    ground: Any = "none" if kind == "svg" else "auto"
    figure.savefig(file, dpi=DPI, format=kind, facecolor=ground, metadata=dict.fromkeys(METADATA[kind]))
    content = file.getvalue()
    return content.replace(b"'DejaVu Sans'", b"system-ui, 'DejaVu Sans'") if kind == "svg" else content


def points(axes: Axes, number: np.ndarray, value: np.ndarray, error: np.ndarray) -> None:
    """Draw measured values with 95 % bars."""
    bars = HALF_WIDTH_95 * np.nan_to_num(np.abs(error))
    axes.errorbar(number, value, yerr=bars, fmt="o", ms=3.6, color=MEASURED, lw=1, label="measured", zorder=5)


def number_axis(axes: Axes, number: np.ndarray) -> None:
    """Make the horizontal axis one of partial numbers, from the smallest to the largest of `number`."""
    from matplotlib.ticker import MaxNLocator

    low, high = span(number)
    axes.set_xlim(low - 0.7, high + 0.7)
    axes.xaxis.set_major_locator(MaxNLocator(nbins=10, integer=True, min_n_ticks=1))


def key_axis(axes: Axes, span: tuple[int, int] = (LOWEST_KEY - 1, HIGHEST_KEY + 1)) -> None:
    """Make the horizontal axis one of keys, between two MIDI numbers."""
    ticks = {24 + 12 * i: f"C{i + 1}" for i in range(8) if span[0] <= 24 + 12 * i <= span[1]}
    axes.set_xlim(*span)
    axes.set_xticks(list(ticks), list(ticks.values()))


def log_axis(axis: Any, subs: tuple[int, ...] = (1, 2, 5)) -> None:
    """Mark a logarithmic axis at `subs` times each power of ten, with plain numbers."""
    from matplotlib.ticker import LogLocator, NullLocator

    axis.set_major_locator(LogLocator(subs=subs))
    axis.set_major_formatter("{x:g}")
    axis.set_minor_locator(NullLocator())


def legend(figure: Figure, axes: Axes, columns: int = 4) -> None:
    """Draw a legend below the axes, in the order of `LINES`, then in the order of drawing."""
    handles, labels = axes.get_legend_handles_labels()
    entries = dict(zip(labels, handles, strict=True))
    order = sorted(entries, key=lambda name: [*LINES, name].index(name))
    if order:
        figure.legend([entries[name] for name in order], order, loc="lower center", ncols=min(len(order), columns))


def span(*arrays: np.ndarray) -> tuple[float, float]:
    """Return the smallest and the largest finite value; (0, 1) if no value is finite."""
    finite = np.concatenate([np.ravel(array)[np.isfinite(np.ravel(array))] for array in arrays])
    return (float(finite.min()), float(finite.max())) if len(finite) else (0.0, 1.0)
