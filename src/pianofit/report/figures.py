"""Figures of the page. The functions only draw the arrays of `FigureData`."""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np

from .drawing import (
    BORDER,
    FAINT,
    FITTED,
    HATCH,
    HEIGHT,
    INK,
    LINES,
    MEASURED,
    legend,
    log_axis,
    make_figure,
    number_axis,
    page_style,
    panel,
    points,
    span,
    svg,
)
from .figure_data import ContactCurves, FigureData, LevelCurves
from .figures_identifiability import draw_felt, draw_identifiability
from .figures_modal_response import draw_modal_response
from .figures_recordings import draw_held_out, draw_paths, draw_recordings
from .text import BANDS

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["COMPARED", "draw_attack", "draw_figures", "draw_force", "draw_levels", "draw_loop", "draw_spectrum"]

# The three curves of most figures.
COMPARED = ("measured", "initial", "fitted")
ATTACK_TITLES = {"initial": "Before the fit", "fitted": "After the fit"}
# Positions of the arrows on a loop, as shares of the largest force. They differ so that the arrows do not overlap.
RISING, FALLING = 0.6, 0.35
# Decay rates below this share of the slowest of the string are drawn at the edge of the axis.
SLOWEST = 0.1
NODE = 60.0  # dB below all measured levels; lower levels are not drawn
ARROW = np.array([1.0, -0.7 + 0.45j, -0.4, -0.7 - 0.45j, 1.0])  # outline of an arrowhead, pointing right


def draw_figures(
    curves: FigureData, dropped: tuple[str, ...] = (), held_out: tuple[dict[str, Any], ...] = ()
) -> dict[str, list[bytes]]:
    """Draw all figures of the page that have data: name -> SVGs of the panels."""
    with page_style():
        figures = {
            "spectra": _spectra(curves, dropped),
            "attack": [make_figure(draw_attack, curves, name, title=title) for name, title in ATTACK_TITLES.items()],
            "partials": _partials(curves),
            "levels": [make_figure(draw_levels, curves, title="Levels"), _residuals(curves)],
            "force": [
                make_figure(draw_force, curves, title="Force over time"),
                make_figure(draw_loop, curves, title="Force over compression"),
            ],
        }
        if len(curves.recordings) > 1:
            figures["recordings"] = draw_recordings(curves.recordings)
        if len(curves.recordings) > 1 and curves.paths:
            figures["paths"] = draw_paths(curves.paths)
        if held_out:
            figures["held_out"] = draw_held_out(held_out)
        if curves.felt is not None:
            figures["felt"] = draw_felt(curves.felt, curves.recordings)
        if curves.identifiability is not None:
            figures["identifiability"] = draw_identifiability(curves.identifiability)
        if curves.ringing is not None:
            figures |= draw_modal_response(curves.ringing)
        return {name: [svg(figure) for figure in panels] for name, panels in figures.items()}


def _spectra(curves: FigureData, dropped: tuple[str, ...]) -> list[Figure]:
    """Draw two panels if band 3 is much wider than the others, so that the first partials are visible."""
    edges = _band_edges(curves, dropped)
    low, high, split = edges[0][0], edges[-1][1], edges[-1][0]
    limits = [low, split, high] if len(edges) > 1 and high - split > 1.5 * (split - low) else [low, high]
    return [make_figure(_draw_spectra, curves, edges, start, stop) for start, stop in pairwise(limits)]


def _draw_spectra(
    axes: Axes, curves: FigureData, edges: list[tuple[float, float, str, bool]], low: float, high: float
) -> None:
    for name in COMPARED:
        axes.plot(curves.frequency, curves.spectra[name], label=name, **LINES[name])
    bottom, top = span(curves.spectra["measured"], curves.spectra["fitted"])
    axes.set(xlim=(low, high), ylim=(max(bottom, top - 110) - 6, top + 12), xlabel="frequency (Hz)",
             ylabel="level (dB)")  # fmt: skip
    _shade_bands(axes, edges)


def _band_edges(curves: FigureData, dropped: tuple[str, ...]) -> list[tuple[float, float, str, bool]]:
    """Return (low, high, label, is excluded) of each visible band. Bands have names if their borders match a set."""
    borders = [border for border in curves.borders if np.isfinite(border)]
    pairs = list(pairwise(borders)) or [span(curves.frequency)]
    used = [name for name in BANDS if name not in dropped]
    names = list(BANDS) if len(pairs) == len(BANDS) else used if len(pairs) == len(used) else [""] * len(pairs)
    end = curves.frequency[-1]
    return [
        (low, min(high, end), BANDS.get(name, "") + (", excluded" if name in dropped else ""), name in dropped)
        for (low, high), name in zip(pairs, names, strict=True)
        if low < end
    ]


def draw_spectrum(axes: Axes, curves: FigureData, dropped: tuple[str, ...]) -> None:
    """Draw measured, initial and fitted spectrum, and the bands of the criterion."""
    edges = [(low, high, "", is_excluded) for low, high, _, is_excluded in _band_edges(curves, dropped)]
    _draw_spectra(axes, curves, edges, edges[0][0], edges[-1][1])


def draw_force(axes: Axes, curves: FigureData | ContactCurves) -> None:
    """Draw the hammer force over time before and after the fit."""
    for name, force in curves.force.items():
        axes.plot(curves.force_ms, force, label=name, **LINES[name])
    axes.set(xlabel="time from the first contact (ms)", ylabel="force (N)")
    axes.set_ylim(bottom=0.0)


def draw_levels(axes: Axes, curves: FigureData | LevelCurves) -> None:
    """Draw the levels of the partials, measured, initial and fitted."""
    axes.plot(curves.number, _without_nodes(curves, "initial"), marker="s", ms=3.4, label="initial", **LINES["initial"])
    axes.plot(curves.number, _without_nodes(curves, "fitted"), marker="o", ms=3.4, label="fitted", **LINES["fitted"])
    points(axes, curves.number, curves.levels["measured"], curves.level_error)
    axes.set(xlabel="partial number k", ylabel="level (dB)")
    number_axis(axes, curves.number)


def _shade_bands(axes: Axes, edges: list[tuple[float, float, str, bool]]) -> None:
    start, stop = axes.get_xlim()
    for index, (low, high, label, is_excluded) in enumerate(edges):
        low, high = max(low, start), min(high, stop)
        if low >= high:
            continue
        if is_excluded:
            axes.axvspan(low, high, facecolor="none", edgecolor=HATCH, hatch="///", lw=0, zorder=0)
        elif index % 2:
            axes.axvspan(low, high, color=FAINT, lw=0, zorder=0)
        for edge in {low, high} - {start, stop}:
            axes.axvline(edge, color=BORDER, lw=0.8, ls=":", zorder=1)
        is_narrow = (high - low) < 0.25 * (stop - start)
        text = label.split(":")[0] + (", excluded" if is_excluded else "") if is_narrow else label
        # Right-aligned in a narrow band at the end, so that the text stays within the frame.
        x, side = (high, "right") if is_narrow and high == stop else ((low + high) / 2, "center")
        axes.text(x, 0.985, text, transform=axes.get_xaxis_transform(), ha=side, va="top", color=INK, fontsize=8.5)


def draw_attack(axes: Axes, curves: FigureData, name: str) -> None:
    """Draw the waveforms of the first milliseconds, with one scale for all panels."""
    for curve in ("measured", name):
        axes.plot(curves.attack_ms, curves.attack[curve], label=curve, **LINES[curve])
    low, high = span(*curves.attack.values())
    margin = 0.05 * max(high - low, 1e-12)
    axes.set(xlabel="time from the onset (ms)", ylabel="signal (full scale = 1)", ylim=(low - margin, high + margin))


def _partials(curves: FigureData) -> list[Figure]:
    figure, (cents, residual) = panel(0.68 * HEIGHT, 0.32 * HEIGHT)
    points(cents, curves.number, curves.frequency_cents, curves.frequency_cents_error)
    cents.plot(curves.number, curves.frequency_cents_law, label="fitted string", **LINES["fitted"])
    cents.set(title="Frequency", ylabel="cents above k·f₀")
    points(residual, curves.number, curves.frequency_cents - curves.frequency_cents_law, curves.frequency_cents_error)
    residual.axhline(0.0, **LINES["fitted"])
    residual.set(ylabel="residual (cents)", xlabel="partial number k")
    number_axis(cents, curves.number)
    legend(figure, cents)
    return [figure, make_figure(_draw_decays, curves, height=HEIGHT + 0.12)]


def _draw_decays(axes: Axes, curves: FigureData) -> None:
    # With beats, an estimated decay rate can be near zero. It would compress the range of all others.
    bottom = SLOWEST * float(np.min(curves.decay_law))
    in_range = ~(curves.decay < bottom)
    points(axes, curves.number[in_range], curves.decay[in_range], curves.decay_error[in_range])
    if not in_range.all():
        axes.plot(curves.number[~in_range], np.full((~in_range).sum(), bottom), "v", mfc="none", color=MEASURED,
                  label="below this axis")  # fmt: skip
    axes.plot(curves.number, curves.decay_law, label="fitted string", **LINES["fitted"])
    if bottom > 0:
        axes.set_yscale("log")
        log_axis(axes.yaxis)
    axes.set(title="Decay of the amplitude", ylabel="decay rate α (1/s)", xlabel="partial number k")
    number_axis(axes, curves.number)


def _residuals(curves: FigureData) -> Figure:
    """Draw the residuals of the levels, and below them the output path if there is one."""
    path = curves.path
    figure, (error, *below) = panel(*((HEIGHT,) if path is None else (0.6 * HEIGHT, 0.4 * HEIGHT - 0.12)))
    for name, marker in (("initial", "s"), ("fitted", "o")):
        residual = _without_nodes(curves, name) - curves.levels["measured"]
        error.plot(curves.number, residual, marker=marker, ms=3.4, label=name, **LINES[name])
    error.axhline(0.0, color=MEASURED, lw=1)
    error.set(title="Residuals", ylabel="model − measured (dB)")
    if path is not None:
        below[0].plot(curves.number, path, color=FITTED, lw=1.4, marker="D", ms=3)
        below[0].set_ylabel("output path (dB)")
    (below or [error])[-1].set_xlabel("partial number k")
    number_axis(error, curves.number)
    legend(figure, error)
    return figure


def _without_nodes(curves: FigureData | LevelCurves, name: str) -> np.ndarray:
    """Return levels, dB, with NaN far below all measured ones, because a given strike position can be on a node."""
    low, _ = span(curves.levels["measured"])
    level = curves.levels[name]
    return np.where(level > low - NODE, level, np.nan)


def draw_loop(axes: Axes, curves: FigureData) -> None:
    """Draw force over compression, with arrowheads for the direction."""
    for name in ("initial", "fitted"):
        x, force = curves.compression[name], curves.force[name]
        contact = np.where(x > 0, 1.0, np.nan)
        axes.plot(x * contact, force * contact, label=name, **LINES[name])
    axes.set(xlabel="compression of the felt (mm)", ylabel="force (N)")
    axes.set_xlim(0.0, 1.05 * max(span(*curves.compression.values())[1], 1e-9))
    axes.set_ylim(bottom=0.0)
    for name in ("initial", "fitted"):
        for position, step in _arrow_positions(curves.compression[name], curves.force[name]):
            marker = _arrowhead(_angle(axes, position, step))
            axes.plot(*position, marker=marker, ms=13, mew=0, color=LINES[name]["color"], zorder=6)


def _arrow_positions(compression: np.ndarray, force: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return point and step where the force first exceeds `RISING` and last exceeds `FALLING` of its maximum."""
    if not (len(force) > 2 and np.isfinite(force).all() and force.max() > 0 and compression.max() > 0):
        return []
    curve = np.stack([compression, force], axis=1)
    arrows = []
    for share, end in ((RISING, 0), (FALLING, -1)):
        level = share * force.max()
        above = np.flatnonzero(force > level)
        start = above[end] - (end == 0)
        if 0 <= start < len(force) - 1:
            step = curve[start + 1] - curve[start]
            arrows.append((curve[start] + step * (level - force[start]) / step[1], step))
    return arrows


def _arrowhead(angle: float) -> list[tuple[float, float]]:
    """Return a slender arrowhead in the direction `angle`, degrees, as a marker."""
    turn = np.exp(1j * np.radians(angle))
    return [(float(z.real), float(z.imag)) for z in ARROW * turn]


def _angle(axes: Axes, point: np.ndarray, step: np.ndarray) -> float:
    """Return the direction of a step from a point on the page, degrees."""
    dx, dy = axes.transData.transform(point + step) - axes.transData.transform(point)
    return float(np.degrees(np.arctan2(dy, dx)))
