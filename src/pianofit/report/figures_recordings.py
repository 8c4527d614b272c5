"""Pictures of several recordings: the levels of each, what they share, and what was predicted of those left out.

No text from outside gets into a picture: recordings go by their number and their velocity.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from .curves import RecordingCurves
from .drawing import FITTED, INITIAL, INK, LINES, MEASURED, figure_of, legend, number_axis, points, span

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["draw_held_out", "draw_paths", "draw_recordings"]

GROUPS = (FITTED, "#009e73", "#cc79a7", INITIAL)  # Okabe and Ito's
HELD_OUT = (  # key, label, look
    ("predicted_db", "predicted by the fit of the others", {"marker": "o", "color": FITTED, "ms": 8}),
    ("nearest_db", "nearest other recording in its place", {"marker": "s", "mec": INITIAL, "mfc": "none", "ms": 7.5}),
    ("blend_db", "best blend of its two neighbours", {"marker": "D", "mec": MEASURED, "mfc": "none", "ms": 6.5}),
)


def draw_recordings(recordings: Sequence[RecordingCurves]) -> Figure:
    """Levels of the partials, a panel for each recording from soft to loud, all to one scale."""
    recordings = sorted(recordings, key=lambda recording: recording.velocity)
    columns = 2
    rows = -(-len(recordings) // columns)
    figure = figure_of(11.25, 0.75 + 1.95 * rows)
    grid = figure.add_gridspec(
        rows, columns, left=0.06, right=0.99, top=1 - 0.26 / (0.75 + 1.95 * rows), bottom=0.75 / (0.75 + 1.95 * rows),
        hspace=0.26, wspace=0.04,
    )  # fmt: skip
    first = None
    for i, recording in enumerate(recordings):
        axes = figure.add_subplot(grid[i // columns, i % columns], sharex=first, sharey=first)
        axes.plot(recording.number, recording.level_fitted, marker="o", ms=2.6, label="fitted", **LINES["fitted"])
        points(axes, recording.number, recording.level, recording.level_error)
        axes.set_title(
            f"recording {recording.place}: {recording.velocity:.3g} m/s, {recording.error_db:.1f} dB off", pad=3
        )
        axes.tick_params(labelbottom=i + columns >= len(recordings), labelleft=i % columns == 0)
        if i % columns == 0:
            axes.set_ylabel("level (dB)")
        if i + columns >= len(recordings):
            axes.set_xlabel("partial number k")
        first = first or axes
    if first is not None:
        number_axis(first, np.concatenate([recording.number for recording in recordings]))
    legend(figure, first)
    return figure


def draw_paths(paths: Sequence[tuple[np.ndarray, np.ndarray]]) -> Figure:
    """What lies between string and file, at the partials, a line for each group of recordings."""
    figure = figure_of(11.25, 3.3)
    axes = figure.add_axes((0.06, 0.17, 0.93, 0.77))
    lowest, highest = span(*(db for _, db in paths))
    room = max(highest - lowest, 1.0)
    bottom = lowest - 0.08 * room
    for i, (frequency, db) in enumerate(paths):
        colour = GROUPS[i % len(GROUPS)]
        axes.vlines(frequency, bottom, db, color=colour, lw=1.6, alpha=0.45)
        axes.plot(frequency, db, "o", ms=4, color=colour, label=f"group {i}")
    axes.set(xlabel="frequency (Hz)", ylabel="output path (dB)", ylim=(bottom, highest + 0.06 * room))
    low, high = span(*(frequency for frequency, _ in paths))
    axes.set_xlim(low - 0.02 * (high - low) - 1.0, high + 0.02 * (high - low) + 1.0)
    if len(paths) > 1:
        axes.legend(loc="upper right", ncols=len(paths))
    return figure


def draw_held_out(recordings: Sequence[dict[str, Any]]) -> Figure:
    """Errors of each recording left out, in order of velocity: predicted, and by what needs no model."""
    figure = figure_of(11.25, 3.5)
    axes = figure.add_axes((0.06, 0.25, 0.93, 0.70))
    places = np.arange(len(recordings))
    for key, label, look in HELD_OUT:
        value = np.array([np.nan if recording.get(key) is None else recording[key] for recording in recordings], float)
        axes.plot(places, value, ls="none", mew=1.6, label=label, zorder=3, **look)
    top = span(*(np.array([recording.get(key) or 0.0 for recording in recordings], float) for key, *_ in HELD_OUT))[1]
    axes.set(ylim=(0.0, 1.12 * max(top, 0.1)), xlim=(-0.5, len(recordings) - 0.5), ylabel="error of the levels (dB)")
    axes.set_xticks(places, [_place(recording) for recording in recordings], color=INK)
    handles, labels = axes.get_legend_handles_labels()
    figure.legend(handles, labels, loc="lower center", ncols=len(HELD_OUT))
    return figure


def _place(recording: dict[str, Any]) -> str:
    velocity = recording.get("v_H0")
    return f"{velocity:.3g} m/s" if isinstance(velocity, int | float) else "–"
