"""Figures of several recordings: levels of each, output paths, and errors of leave-one-out predictions.

Recordings are identified by number and velocity, so that text from outside does not get into a figure.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from ..conversions import HALF_WIDTH_95
from ..excitation import STROKES
from ..schema.fit import Fit, PartialLevels, PathEntry, RecordingFit
from .drawing import FITTED, GROUPS, HEIGHT, INITIAL, INK, LINES, MEASURED, Panel, number_axis, points, span

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from ..result.cross_validation import LeftOutRecording

MOST_UPRIGHT = 6  # with more labels, they are rotated
LEFT_OUT = {  # attribute -> label, marker style
    "predicted_db": ("prediction by a fit of the others", {"marker": "o", "color": FITTED, "ms": 8}),
    "nearest_db": ("nearest other recording instead", {"marker": "s", "mec": INITIAL, "mfc": "none", "ms": 7.5}),
    "blend_db": ("best blend of the two neighbours", {"marker": "D", "mec": MEASURED, "mfc": "none", "ms": 6.5}),
}


def draw_recordings(fit: Fit) -> list[Panel]:
    """Draw the levels of the partials, a panel for each recording from soft to loud, with one scale; [] for one."""
    if len(fit.recordings) == 1:
        return []
    rows = sorted(enumerate(fit.recordings, start=1), key=lambda place: place[1].stroke_value)
    unit = STROKES[fit.excitation].unit
    number = np.concatenate([row.partials.number for row in fit.recordings])
    low, high = zip(*(_limits(row.partials) for row in fit.recordings), strict=True)
    values = number, (min(low), max(high)), unit
    return [Panel(_draw_recording, (*row, *values), heights=(0.75 * HEIGHT,)) for row in rows]


def _limits(levels: PartialLevels) -> tuple[float, float]:
    """Return the range of the levels of a recording, with a margin of 5 %."""
    bars = HALF_WIDTH_95 * levels.error
    low, high = span(levels.fitted, levels.measured - bars, levels.measured + bars)
    return low - 0.05 * (high - low), high + 0.05 * (high - low)


def _draw_recording(
    axes: Axes, place: int, row: RecordingFit, number: np.ndarray, limits: tuple[float, float], unit: str
) -> None:
    levels = row.partials
    axes.plot(levels.number, levels.fitted, marker="o", ms=2.6, label="fitted", **LINES["fitted"])
    points(axes, levels.number, levels.measured, levels.error)
    axes.set_title(f"recording {place}: {row.stroke_value:.3g} {unit}, error {row.levels.fitted_db:.1f} dB")
    axes.set(ylabel="level (dB)", xlabel="partial number k", ylim=limits)
    number_axis(axes, number)


def draw_paths(fit: Fit) -> list[Panel]:
    """Draw the output path at the partials, in one colour for each path group; [] for one or calibrated recordings."""
    groups = fit.pickup.paths
    paths = [groups[group] for group in sorted(groups, key=int)] or [fit.pickup.path]
    if len(fit.recordings) == 1 or None in paths:
        return []
    return [Panel(_draw_paths, (paths,), legend_rows=len(paths) > 1)]


def _draw_paths(axes: Axes, paths: Sequence[PathEntry]) -> None:
    lowest, highest = span(*(path.db for path in paths))
    extent = max(highest - lowest, 1.0)
    bottom = lowest - 0.08 * extent
    for i, path in enumerate(paths):
        colour = GROUPS[i % len(GROUPS)]
        axes.vlines(path.frequency, bottom, path.db, color=colour, lw=1.6, alpha=0.45)
        axes.plot(path.frequency, path.db, "o", ms=4, color=colour, label=f"path group {i}" if len(paths) > 1 else "")
    axes.set(xlabel="frequency (Hz)", ylabel="output path (dB)", ylim=(bottom, highest + 0.06 * extent))
    low, high = span(*(path.frequency for path in paths))
    axes.set_xlim(low - 0.02 * (high - low) - 1.0, high + 0.02 * (high - low) + 1.0)


def draw_left_out(recordings: Sequence[LeftOutRecording], unit: str) -> list[Panel]:
    """Draw the errors of each recording left out, in order of its stroke, with two references without a model.

    `unit` is that of the parameter of a stroke.
    """
    return [Panel(_draw_left_out, (recordings, unit), legend_rows=len(LEFT_OUT), columns=1)] if recordings else []


def _draw_left_out(axes: Axes, recordings: Sequence[LeftOutRecording], unit: str) -> None:
    places = np.arange(len(recordings))
    errors = {name: np.array([getattr(row, name) for row in recordings], float) for name in LEFT_OUT}  # NaN for None
    for name, (label, style) in LEFT_OUT.items():
        axes.plot(places, errors[name], ls="none", mew=1.6, label=label, zorder=3, **style)
    top = span(*errors.values())[1]
    axes.set(ylim=(0.0, 1.12 * max(top, 0.1)), xlim=(-0.5, len(recordings) - 0.5), ylabel="error of the levels (dB)")
    axes.set_xticks(places, [f"{row.stroke_value:.3g} {unit}" for row in recordings], color=INK)
    axes.tick_params(axis="x", labelrotation=30 if len(recordings) > MOST_UPRIGHT else 0)
