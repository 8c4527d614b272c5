"""Pictures of how the note rings: envelopes of partials, and levels over time and frequency, recorded and played."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from .drawing import FITTED, HEIGHT, INITIAL, LINES, make_figure, panel, span
from .figure_data import Envelope, RingingCurves

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["draw_envelope", "draw_ringing"]

# An envelope is shown so many dB down from its top.
DEEPEST = 75.0
# Colours of a difference end here, dB.
WIDEST = 20.0
# Marks on an axis of mel bands, Hz.
MARKS = (100, 500, 1000, 2000, 5000, 10_000)
# From nothing, which is the page itself, to the loudest.
SHADES = ["#ffffff", "#9cc9e3", "#2f86bd", "#0a2f4f"]


def draw_ringing(curves: RingingCurves) -> dict[str, list[Figure]]:
    """Name -> panels: the envelopes; the levels recorded and played to one scale, and their difference."""
    envelopes = [make_figure(draw_envelope, one, height=0.6 * HEIGHT) for one in curves.envelopes]
    return {"envelopes": envelopes, "spectrograms": _spectrograms(curves)}


def draw_envelope(axes: Axes, envelope: Envelope) -> None:
    """Draw the level of one partial over time: recorded, by the string's law, and as the key rings."""
    shown = {"measured": envelope.measured, "law": envelope.law, "fitted": envelope.fitted}
    for name, db in shown.items():
        if db is not None:
            axes.plot(envelope.time, db, label=name, **LINES[name])
    low, top = span(envelope.measured, *(db for db in (envelope.fitted, envelope.law) if db is not None))
    axes.set(title=f"partial {envelope.number}, {envelope.frequency:.0f} Hz", xlabel="time from the onset (s)",
             ylabel="level (dB)", xlim=(0.0, 1.02 * max(span(envelope.time)[1], 1e-3)),
             ylim=(max(low, top - DEEPEST) - 3, top + 4))  # fmt: skip


def _spectrograms(curves: RingingCurves) -> list[Figure]:
    from matplotlib.colors import LinearSegmentedColormap

    levels = LinearSegmentedColormap.from_list("level", SHADES)
    signs = LinearSegmentedColormap.from_list("difference", [INITIAL, "#ffffff", FITTED])
    low, high = span(curves.measured)
    return [
        _map(curves, curves.measured, "recorded", levels, (low, high), "level (dB)"),
        _map(curves, curves.played, "played", levels, (low, high), "level (dB)"),
        _map(curves, curves.played - curves.measured, "played minus recorded", signs, (-WIDEST, WIDEST),
             "difference (dB)"),
    ]  # fmt: skip


def _map(curves: RingingCurves, db: np.ndarray, title: str, colours, limits: tuple[float, float], label: str) -> Figure:
    """Levels [bands, frames] in colours, a raster, with its scale below."""
    figure, (axes,) = panel(HEIGHT, legend_rows=2)
    bands, end = np.arange(len(curves.frequency)), max(span(curves.time)[1], 1e-3)
    raster = axes.imshow(db, cmap=colours, vmin=limits[0], vmax=limits[1], aspect="auto", origin="lower",
                         extent=(0.0, end, -0.5, len(bands) - 0.5), interpolation="nearest")  # fmt: skip
    marks = [mark for mark in MARKS if curves.frequency[0] <= mark <= curves.frequency[-1]]
    axes.set_yticks(np.interp(marks, curves.frequency, bands), [f"{mark:g}" for mark in marks])
    axes.set(title=title, xlabel="time from the onset (s)", ylabel="frequency (Hz)")
    axes.grid(visible=False)
    box, tall = axes.get_position(), figure.get_figheight()
    scale = figure.add_axes((box.x0, 0.36 / tall, 0.55 * box.width, 0.1 / tall))
    figure.colorbar(raster, cax=scale, orientation="horizontal", label="")
    scale.text(1.05, 0.5, label, transform=scale.transAxes, va="center")
    scale.grid(visible=False)
    return figure
