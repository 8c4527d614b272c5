"""The page's pictures. One look for all: measured is black, initial is dashed orange, fitted is blue.

The colours are Okabe and Ito's, which stay apart for colour-blind eyes; line style and order tell them apart in grey.
Nothing here computes physics: the functions draw the arrays of `Curves`. Figures for the page are SVG, whose letters
stay letters; that was both quicker and sharper than PNG at twice the resolution.
"""

from __future__ import annotations

import io
import os
from itertools import pairwise
from threading import Lock
from typing import TYPE_CHECKING, Any

import numpy as np

from .curves import Curves
from .output import replace_file

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["draw_figures", "write_picture"]

INK, MEASURED, INITIAL, FITTED, FAINT = "#333333", "#1a1a1a", "#d55e00", "#0072b2", "#eeeeee"
LINES: dict[str, dict[str, Any]] = {
    "measured": {"color": MEASURED, "lw": 1.1, "zorder": 2},
    "initial": {"color": INITIAL, "lw": 1.2, "ls": (0, (4, 1.6)), "zorder": 3},
    "fitted": {"color": FITTED, "lw": 1.5, "zorder": 4},
}
BANDS = {"band1": "band 1: fundamental", "band2": "band 2: partials 2 to 8", "band3": "band 3: partials from 9"}
STYLE: dict[Any, Any] = {
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans"],
    "font.size": 9.5,
    "axes.titlesize": 10,
    "axes.titlelocation": "left",
    "axes.titlecolor": INK,
    "axes.edgecolor": "#9aa3ad",
    "axes.labelcolor": INK,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.unicode_minus": True,
    "axes.xmargin": 0.0,
    "grid.color": "#e3e7ec",
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


_LOCK = Lock()  # matplotlib's settings are global


def draw_figures(curves: Curves, dropped: tuple[str, ...] = ()) -> dict[str, bytes]:
    """Draw all figures of the page, name -> SVG."""
    from matplotlib import rc_context

    drawings = {"attack": _attack, "partials": _partials, "levels": _levels, "force": _force}
    with _LOCK, rc_context(STYLE):
        figures = {"spectra": _spectra(curves, dropped)} | {name: draw(curves) for name, draw in drawings.items()}
        return {name: _svg(figure) for name, figure in figures.items()}


def write_picture(path: str | os.PathLike[str], fit: dict[str, Any], curves: Curves) -> None:
    """Write one PNG of 1400 × 900 pixels: spectra, attack, partial levels and the felt's loop.

    Raises
    ------
    OutputError
        If `path` cannot be written.
    """
    from matplotlib import rc_context
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.image import imsave

    with _LOCK, rc_context(STYLE):
        figure = _figure(14, 9)
        spectra, attack, levels, loop = (
            figure.add_axes((left, bottom, width, 0.38))
            for bottom in (0.58, 0.10)
            for left, width in ((0.05, 0.42), (0.55, 0.43))
        )
        edges = _band_edges(curves, tuple((fit.get("criterion") or {}).get("dropped") or ()))
        _draw_spectra(spectra, curves, edges[0][0], edges[-1][1])
        _shade_bands(spectra, [(low, high, "", left_out) for low, high, _, left_out in edges])
        spectra.set(title="Spectra and the bands of the fit", ylabel="level (dB)")
        _draw_attack(attack, curves, ("measured", "initial", "fitted"))
        attack.set(title="Attack", xlabel="time from the onset (ms)")
        _draw_levels(levels, curves)
        levels.set(title="Levels of the partials", xlabel="partial number")
        _draw_loop(loop, curves)
        loop.set(title="Felt: force over compression")
        _legend(figure, attack)
        figure.set_dpi(100)
        canvas = FigureCanvasAgg(figure)
        canvas.draw()
        file = io.BytesIO()  # 16 levels of each colour: half the size, and no eye sees it in lines on white
        imsave(file, (np.asarray(canvas.buffer_rgba()) // 16 * 17).astype(np.uint8), format="png")
    replace_file(path, file.getvalue())


def _figure(width: float, height: float) -> Figure:
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height))


def _svg(figure: Figure) -> bytes:
    file = io.BytesIO()
    figure.savefig(file, format="svg", metadata={"Date": None, "Creator": None})
    return file.getvalue().replace(b"'DejaVu Sans'", b"system-ui, 'DejaVu Sans'")


def _spectra(curves: Curves, dropped: tuple[str, ...]) -> Figure:
    """Two scales side by side when there is much above band 2, so that the first partials are not a sliver."""
    figure = _figure(11.25, 4.4)
    edges = _band_edges(curves, dropped)
    low, high, split = edges[0][0], edges[-1][1], edges[-1][0]
    cuts = [low, split, high] if len(edges) > 1 and high - split > 1.5 * (split - low) else [low, high]
    share = [0.40, 0.60] if len(cuts) == 3 else [1.0]
    left, first = 0.06, None
    for start, stop, part in zip(cuts, cuts[1:], share, strict=False):
        width = 0.93 * part - 0.015
        axes = figure.add_axes((left, 0.19, width, 0.79), sharey=first)
        _draw_spectra(axes, curves, start, stop)
        _shade_bands(axes, edges)
        if first is None:
            axes.set_ylabel("level (dB)")
            first = axes
        else:
            axes.tick_params(labelleft=False)
        left += width + 0.03
    _legend(figure, first)
    return figure


def _draw_spectra(axes: Axes, curves: Curves, low: float, high: float) -> None:
    for name, line in LINES.items():
        axes.plot(curves.frequency, getattr(curves, f"{name}_db"), label=name, **line)
    bottom, top = _span(curves.measured_db, curves.fitted_db)
    axes.set(xlim=(low, high), ylim=(max(bottom, top - 110) - 6, top + 12), xlabel="frequency (Hz)")


def _band_edges(curves: Curves, dropped: tuple[str, ...]) -> list[tuple[float, float, str, bool]]:
    """(low, high, label, left out) of each band, matched to names when all three or just the kept ones have borders."""
    borders = [border for border in curves.borders if np.isfinite(border)]
    pairs = list(pairwise(borders)) or [_span(curves.frequency)]
    kept = [name for name in BANDS if name not in dropped]
    names = list(BANDS) if len(pairs) == len(BANDS) else kept if len(pairs) == len(kept) else [""] * len(pairs)
    return [
        (low, high, BANDS.get(name, "") + (", left out" if name in dropped else ""), name in dropped)
        for (low, high), name in zip(pairs, names, strict=True)
    ]


def _shade_bands(axes: Axes, edges: list[tuple[float, float, str, bool]]) -> None:
    start, stop = axes.get_xlim()
    for index, (low, high, label, left_out) in enumerate(edges):
        low, high = max(low, start), min(high, stop)
        if low >= high:
            continue
        if left_out:
            axes.axvspan(low, high, facecolor="none", edgecolor="#c3cad2", hatch="///", lw=0, zorder=0)
        elif index % 2:
            axes.axvspan(low, high, color=FAINT, lw=0, zorder=0)
        for edge in {low, high} - {start, stop}:
            axes.axvline(edge, color="#7b8794", lw=0.8, ls=":", zorder=1)
        narrow = (high - low) < 0.25 * (stop - start)
        text = label.split(":")[0] + (", left out" if narrow and left_out else "") if narrow else label
        axes.text((low + high) / 2, 0.985, text, transform=axes.get_xaxis_transform(), ha="center", va="top",
                  color=INK, fontsize=8.5)  # fmt: skip


def _attack(curves: Curves) -> Figure:
    figure = _figure(11.25, 5.0)
    upper = figure.add_axes((0.07, 0.585, 0.92, 0.355))
    lower = figure.add_axes((0.07, 0.155, 0.92, 0.355), sharex=upper, sharey=upper)
    _draw_attack(upper, curves, ("measured", "initial"))
    _draw_attack(lower, curves, ("measured", "fitted"))
    upper.tick_params(labelbottom=False)
    upper.set_title("start values", pad=4)
    lower.set_title("after the fit", pad=4)
    lower.set_xlabel("time from the onset (ms)")
    _legend(figure, upper, lower)
    return figure


def _draw_attack(axes: Axes, curves: Curves, names: tuple[str, ...]) -> None:
    for name in names:
        axes.plot(curves.attack_ms, getattr(curves, f"attack_{name}"), label=name, **LINES[name])
    axes.set_ylabel("signal (full scale = 1)")


def _partials(curves: Curves) -> Figure:
    from matplotlib.ticker import LogLocator, NullFormatter

    figure = _figure(11.25, 4.8)
    cents = figure.add_axes((0.06, 0.42, 0.41, 0.51))
    rest = figure.add_axes((0.06, 0.17, 0.41, 0.19), sharex=cents)
    decay = figure.add_axes((0.56, 0.17, 0.43, 0.76))
    _points(cents, curves.number, curves.frequency_cents, curves.frequency_cents_error)
    cents.plot(curves.number, curves.frequency_cents_law, label="law of the fitted string", **LINES["fitted"])
    cents.set(title="Frequency", ylabel="cents above k·f₀")
    cents.tick_params(labelbottom=False)
    _points(rest, curves.number, curves.frequency_cents - curves.frequency_cents_law, curves.frequency_cents_error)
    rest.axhline(0.0, **LINES["fitted"])
    rest.set(ylabel="from law\n(cents)", xlabel="partial number k")
    _points(decay, curves.number, curves.decay, curves.decay_error)
    decay.plot(curves.number, curves.decay_law, **LINES["fitted"])
    positive = curves.decay[np.isfinite(curves.decay)]
    if len(positive) and np.min(positive) > 0:
        decay.set_yscale("log")
        decay.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        decay.yaxis.set_major_formatter("{x:g}")
        decay.yaxis.set_minor_formatter(NullFormatter())
    decay.set(title="Decay of the amplitude", ylabel="decay rate α (1/s)", xlabel="partial number k")
    for axes in (cents, decay):
        _number_axis(axes, curves)
    _legend(figure, cents)
    return figure


def _levels(curves: Curves) -> Figure:
    """Levels, what is left of them, and the path if there is one, one above the other over the partial number."""
    rows = [3.0, 1.6] if curves.path is None else [3.0, 1.6, 1.3]
    figure = _figure(11.25, 5.2 if curves.path is None else 6.6)
    grid = figure.add_gridspec(
        len(rows), 1, height_ratios=rows, left=0.07, right=0.99, top=0.97, bottom=0.14, hspace=0.12
    )
    panels = [figure.add_subplot(grid[0])]
    panels += [figure.add_subplot(cell, sharex=panels[0]) for cell in list(grid)[1:]]  # type: ignore[call-overload]
    _draw_levels(panels[0], curves)
    for name, marker in (("initial", "s"), ("fitted", "o")):
        error = getattr(curves, f"level_{name}") - curves.level
        panels[1].plot(curves.number, error, marker=marker, ms=3.4, **LINES[name])
    panels[1].axhline(0.0, color=MEASURED, lw=1)
    panels[1].set_ylabel("minus\nmeasured (dB)")
    if curves.path is not None:
        panels[2].plot(curves.number, curves.path, color=FITTED, lw=1.4, marker="D", ms=3)
        panels[2].set_ylabel("output\npath (dB)")
    for panel in panels[:-1]:
        panel.tick_params(labelbottom=False)
    panels[-1].set_xlabel("partial number k")
    figure.align_ylabels(panels)
    _legend(figure, panels[0])
    return figure


def _draw_levels(axes: Axes, curves: Curves) -> None:
    axes.plot(curves.number, curves.level_initial, marker="s", ms=3.4, label="initial", **LINES["initial"])
    axes.plot(curves.number, curves.level_fitted, marker="o", ms=3.4, label="fitted", **LINES["fitted"])
    _points(axes, curves.number, curves.level, curves.level_error)
    axes.set_ylabel("level (dB)")
    _number_axis(axes, curves)


def _force(curves: Curves) -> Figure:
    figure = _figure(11.25, 4.3)
    time, loop = figure.add_axes((0.06, 0.19, 0.41, 0.72)), figure.add_axes((0.56, 0.19, 0.43, 0.72))
    for name in ("initial", "fitted"):
        time.plot(curves.force_ms, getattr(curves, f"force_{name}"), label=name, **LINES[name])
    time.set(title="Force over time", xlabel="time from the first touch (ms)", ylabel="force (N)")
    time.set_ylim(bottom=0.0)
    _draw_loop(loop, curves)
    loop.set(title="Force over compression")
    _legend(figure, time)
    return figure


def _draw_loop(axes: Axes, curves: Curves) -> None:
    """Draw force over compression, with arrows: up on the way in, lower on the way back."""
    for name in ("initial", "fitted"):
        x, force = getattr(curves, f"compression_{name}"), getattr(curves, f"force_{name}")
        touching = np.where(x > 0, 1.0, np.nan)
        axes.plot(x * touching, force * touching, label=name, **LINES[name])
        look = {"arrowstyle": "-|>", "color": LINES[name]["color"], "mutation_scale": 14, "shrinkA": 0, "shrinkB": 0}
        for start, stop in _arrows(x, force):
            axes.annotate("", (x[stop], force[stop]), (x[start], force[start]), arrowprops=look)
    axes.set(xlabel="compression of the felt (mm)", ylabel="force (N)")
    axes.set_xlim(0.0, 1.05 * max(_span(curves.compression_initial, curves.compression_fitted)[1], 1e-9))
    axes.set_ylim(bottom=0.0)


def _arrows(compression: np.ndarray, force: np.ndarray) -> list[tuple[int, int]]:
    """Where force passes half of its largest value, first up and last down, each as a short way along the curve."""
    if not (len(force) > 2 and np.isfinite(force).all() and force.max() > 0 and compression.max() > 0):
        return []
    above = np.flatnonzero(force > force.max() / 2)
    stride = max(1, len(above) // 20)
    return [(at - stride, at) for at in (above[0], above[-1] + 1) if stride <= at < len(force)]


def _points(axes: Axes, number: np.ndarray, value: np.ndarray, error: np.ndarray) -> None:
    """Measured values, with bars of 95 % (1.96 standard deviations)."""
    axes.errorbar(number, value, yerr=1.96 * np.nan_to_num(np.abs(error)), fmt="o", ms=3.6, color=MEASURED, lw=1,
                  label="measured", zorder=5)  # fmt: skip


def _number_axis(axes: Axes, curves: Curves) -> None:
    from matplotlib.ticker import MaxNLocator

    low, high = _span(curves.number)
    axes.set_xlim(low - 0.7, high + 0.7)
    axes.xaxis.set_major_locator(MaxNLocator(nbins=10, integer=True, min_n_ticks=1))


def _legend(figure: Figure, *sources: Axes | None) -> None:
    """One legend for the figure, below it, in the order measured, initial, fitted."""
    found: dict[str, Any] = {}
    for axes in sources:
        if axes is not None:
            handles, labels = axes.get_legend_handles_labels()
            found.update(zip(labels, handles, strict=True))
    order = sorted(found, key=lambda name: [*LINES, name].index(name))
    figure.legend([found[name] for name in order], order, loc="lower center", ncols=len(order))


def _span(*arrays: np.ndarray) -> tuple[float, float]:
    """Smallest and largest finite value; (0, 1) where there is none."""
    finite = np.concatenate([np.ravel(array)[np.isfinite(np.ravel(array))] for array in arrays])
    return (float(finite.min()), float(finite.max())) if len(finite) else (0.0, 1.0)
