"""Figures of several recordings: levels of each, output paths, and errors of leave-one-out predictions.

Recordings are identified by number and velocity, so that text from outside does not get into a figure.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from .drawing import FITTED, GROUP, HEIGHT, INITIAL, INK, LAW, LINES, MEASURED, make_figure, number_axis, points, span
from .figure_data import RecordingCurves

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["draw_held_out", "draw_paths", "draw_recordings"]

MOST_UPRIGHT = 6  # with more labels, they are rotated
GROUPS = (FITTED, LAW, GROUP, INITIAL)  # Okabe and Ito
HELD_OUT = (  # key, label, marker style
    ("predicted_db", "prediction by a fit of the others", {"marker": "o", "color": FITTED, "ms": 8}),
    ("nearest_db", "nearest other recording instead", {"marker": "s", "mec": INITIAL, "mfc": "none", "ms": 7.5}),
    ("blend_db", "best blend of the two neighbours", {"marker": "D", "mec": MEASURED, "mfc": "none", "ms": 6.5}),
)


def draw_recordings(recordings: Sequence[RecordingCurves]) -> list[Figure]:
    """Draw the levels of the partials, a panel for each recording from soft to loud, with one scale."""
    in_order = sorted(recordings, key=lambda recording: recording.velocity)
    figures = [make_figure(_levels, recording, height=0.75 * HEIGHT) for recording in in_order]
    panels = [figure.axes[0] for figure in figures]
    low, high = zip(*(axes.get_ylim() for axes in panels), strict=True)
    for axes in panels:
        number_axis(axes, np.concatenate([recording.number for recording in recordings]))
        axes.set_ylim(min(low), max(high))
    return figures


def _levels(axes: Axes, recording: RecordingCurves) -> None:
    axes.plot(recording.number, recording.level_fitted, marker="o", ms=2.6, label="fitted", **LINES["fitted"])
    points(axes, recording.number, recording.level, recording.level_error)
    title = f"recording {recording.place}: {recording.velocity:.3g} m/s, error {recording.error_db:.1f} dB"
    axes.set(title=title, ylabel="level (dB)", xlabel="partial number k")


def draw_paths(paths: Sequence[tuple[np.ndarray, np.ndarray]]) -> list[Figure]:
    """Draw the output path at the partials, in one colour for each path group."""
    return [make_figure(_paths, paths, legend_rows=len(paths) > 1)]


def _paths(axes: Axes, paths: Sequence[tuple[np.ndarray, np.ndarray]]) -> None:
    lowest, highest = span(*(db for _, db in paths))
    extent = max(highest - lowest, 1.0)
    bottom = lowest - 0.08 * extent
    for i, (frequency, db) in enumerate(paths):
        colour = GROUPS[i % len(GROUPS)]
        axes.vlines(frequency, bottom, db, color=colour, lw=1.6, alpha=0.45)
        axes.plot(frequency, db, "o", ms=4, color=colour, label=f"path group {i}" if len(paths) > 1 else "")
    axes.set(xlabel="frequency (Hz)", ylabel="output path (dB)", ylim=(bottom, highest + 0.06 * extent))
    low, high = span(*(frequency for frequency, _ in paths))
    axes.set_xlim(low - 0.02 * (high - low) - 1.0, high + 0.02 * (high - low) + 1.0)


def draw_held_out(recordings: Sequence[dict[str, Any]]) -> list[Figure]:
    """Draw the errors of each recording left out, in order of velocity, with two references without a model."""
    return [make_figure(_held_out, recordings, legend_rows=len(HELD_OUT), columns=1)]


def _held_out(axes: Axes, recordings: Sequence[dict[str, Any]]) -> None:
    places = np.arange(len(recordings))
    for key, label, style in HELD_OUT:
        value = np.array([recording[key] for recording in recordings], float)  # NaN where it is None
        axes.plot(places, value, ls="none", mew=1.6, label=label, zorder=3, **style)
    top = span(*(np.array([recording[key] or 0.0 for recording in recordings]) for key, *_ in HELD_OUT))[1]
    axes.set(ylim=(0.0, 1.12 * max(top, 0.1)), xlim=(-0.5, len(recordings) - 0.5), ylabel="error of the levels (dB)")
    axes.set_xticks(places, [f"{recording['v_H0']:.3g} m/s" for recording in recordings], color=INK)
    axes.tick_params(axis="x", labelrotation=30 if len(recordings) > MOST_UPRIGHT else 0)
