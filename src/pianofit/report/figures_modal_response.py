"""Figures of the modal response: envelopes of partials, and spectrograms of recording and fitted note."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from .drawing import FITTED, HEIGHT, INITIAL, LINES, make_figure, panel, span
from .figure_data import Envelope, ModalResponseCurves

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["draw_envelope", "draw_modal_response"]

ENVELOPE_RANGE = 75.0  # dB below the maximum
LARGEST_DIFFERENCE = 20.0  # dB, end of the colour scale
# Ticks of an axis of mel bands, Hz.
TICKS = (100, 500, 1000, 2000, 5000, 10_000)
# From the background of the page to the highest level.
SHADES = ["#ffffff", "#9cc9e3", "#2f86bd", "#0a2f4f"]


def draw_modal_response(curves: ModalResponseCurves) -> dict[str, list[Figure]]:
    """Draw the envelopes, and the spectrograms of both sounds and of their difference: name -> panels."""
    envelopes = [make_figure(draw_envelope, envelope, height=0.6 * HEIGHT) for envelope in curves.envelopes]
    return {"envelopes": envelopes, "spectrograms": _spectrograms(curves)}


def draw_envelope(axes: Axes, envelope: Envelope) -> None:
    """Draw the level of one partial over time: recorded, with the string model, and with the modes of the key."""
    levels = {"measured": envelope.measured, "string model": envelope.law, "fitted": envelope.fitted}
    for name, db in levels.items():
        if db is not None:
            axes.plot(envelope.time, db, label=name, **LINES[name])
    low, top = span(envelope.measured, *(db for db in (envelope.fitted, envelope.law) if db is not None))
    axes.set(title=f"partial {envelope.number}, {envelope.frequency:.0f} Hz", xlabel="time from the onset (s)",
             ylabel="level (dB)", xlim=(0.0, 1.02 * max(span(envelope.time)[1], 1e-3)),
             ylim=(max(low, top - ENVELOPE_RANGE) - 3, top + 4))  # fmt: skip


def _spectrograms(curves: ModalResponseCurves) -> list[Figure]:
    from matplotlib.colors import LinearSegmentedColormap

    levels = LinearSegmentedColormap.from_list("level", SHADES)
    signs = LinearSegmentedColormap.from_list("difference", [INITIAL, "#ffffff", FITTED])
    low, high = span(curves.measured)
    limits = (-LARGEST_DIFFERENCE, LARGEST_DIFFERENCE)
    return [
        _map(curves, curves.measured, "recorded", levels, (low, high), "level (dB)"),
        _map(curves, curves.played, "fitted note", levels, (low, high), "level (dB)"),
        _map(curves, curves.played - curves.measured, "fitted minus recorded", signs, limits, "difference (dB)"),
    ]


def _map(
    curves: ModalResponseCurves, db: np.ndarray, title: str, colours, limits: tuple[float, float], label: str
) -> Figure:
    """Draw levels [bands, frames] as an image, with its colour scale below."""
    figure, (axes,) = panel(HEIGHT, legend_rows=2)
    bands, end = np.arange(len(curves.frequency)), max(span(curves.time)[1], 1e-3)
    image = axes.imshow(db, cmap=colours, vmin=limits[0], vmax=limits[1], aspect="auto", origin="lower",
                         extent=(0.0, end, -0.5, len(bands) - 0.5), interpolation="nearest")  # fmt: skip
    ticks = [tick for tick in TICKS if curves.frequency[0] <= tick <= curves.frequency[-1]]
    axes.set_yticks(np.interp(ticks, curves.frequency, bands), [f"{tick:g}" for tick in ticks])
    axes.set(title=title, xlabel="time from the onset (s)", ylabel="frequency (Hz)")
    axes.grid(visible=False)
    box, height = axes.get_position(), figure.get_figheight()
    scale = figure.add_axes((box.x0, 0.36 / height, 0.55 * box.width, 0.1 / height))
    figure.colorbar(image, cax=scale, orientation="horizontal", label="")
    scale.text(1.05, 0.5, label, transform=scale.transAxes, va="center")
    scale.grid(visible=False)
    return figure
