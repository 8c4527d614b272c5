"""Figures of a string that is released from a displacement: its shape, and the levels that the shape gives."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ..model.note import Note
from ..result import Result
from .drawing import FITTED, GROUPS, INK, Panel, number_axis

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# Modes and points of the shape: it is drawn to a thousandth of its height.
MODES, POINTS = 512, 601
# Lowest level that is drawn, dB below the first partial.
LOWEST = -80.0


def draw_release(result: Result) -> list[Panel]:
    """Draw the shape of the string at the release for each recording, and its levels."""
    count = int(result.fit.reference.partials.number.max())
    return [
        Panel(_draw_shapes, (result,), "String at the release", legend_rows=0),
        Panel(_draw_levels, (result.note, count), "Levels of the initial displacement", legend_rows=0),
    ]


def displacements(note: Note, count: int) -> np.ndarray:
    """Return the displacement of the first modes at the release, relative to the first [modes]."""
    from ..model.modes import raised_cosine_weights

    omega = note.frequencies(count)
    displacement = np.asarray(raised_cosine_weights(note.geometry, count, np)) / omega**2
    return displacement / displacement[0]


def _draw_shapes(axes: Axes, result: Result) -> None:
    x = np.linspace(0.0, 1.0, POINTS)
    sines = np.sin(np.pi * np.outer(np.arange(1, MODES + 1), x))
    for i, note in enumerate(result.minima_notes[0]):
        shape = displacements(note, MODES) @ sines
        axes.plot(x, shape / np.abs(shape).max(), color=GROUPS[i % len(GROUPS)], lw=1.4)
    row, length = result.fit.reference, float(result.note.geometry.length)
    if row.stroke_interval is not None:
        axes.axvspan(*(end / length for end in row.stroke_interval), color=FITTED, alpha=0.15, lw=0)
    marks = "shaded: 95 % interval"
    if result.fit.pickup.quantity == "magnetic-pickup":
        axes.plot(float(result.note.geometry.pickup) / length, 0.0, "^", color=INK, ms=8, clip_on=False)
        marks += "; triangle: pickup"
    axes.set(xlabel=f"position over length ({marks})", ylabel="displacement")
    axes.set(xlim=(0.0, 1.0), ylim=(0.0, 1.08))


def _draw_levels(axes: Axes, note: Note, count: int) -> None:
    number = np.arange(1, count + 1)
    level = 20 * np.log10(np.maximum(np.abs(displacements(note, count)), 10 ** (LOWEST / 20)))
    axes.vlines(number, LOWEST, level, color=FITTED, lw=1.6, alpha=0.45)
    axes.plot(number, level, "o", color=FITTED, ms=4)
    axes.set(ylabel="level (dB)", ylim=(LOWEST, 5.0))
    number_axis(axes, number)
