"""Pictures of several recordings: the levels of each, what they share, and what was predicted of those left out.

No text from outside gets into a picture: recordings go by their number and their velocity.
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

CROWDED = 6  # more labels than this stand aslant
GROUPS = (FITTED, LAW, GROUP, INITIAL)  # Okabe and Ito's
HELD_OUT = (  # key, label, look
    ("predicted_db", "predicted by the fit of the others", {"marker": "o", "color": FITTED, "ms": 8}),
    ("nearest_db", "nearest other recording in its place", {"marker": "s", "mec": INITIAL, "mfc": "none", "ms": 7.5}),
    ("blend_db", "best blend of its two neighbours", {"marker": "D", "mec": MEASURED, "mfc": "none", "ms": 6.5}),
)


def draw_recordings(recordings: Sequence[RecordingCurves]) -> list[Figure]:
    """Levels of the partials, a panel for each of some recordings from soft to loud, all to one scale."""
    in_turn = sorted(recordings, key=lambda one: one.velocity)
    figures = [make_figure(_levels, one, height=0.75 * HEIGHT) for one in in_turn]
    panels = [figure.axes[0] for figure in figures]
    low, high = zip(*(axes.get_ylim() for axes in panels), strict=True)
    for axes in panels:
        number_axis(axes, np.concatenate([one.number for one in recordings]))
        axes.set_ylim(min(low), max(high))
    return figures


def _levels(axes: Axes, one: RecordingCurves) -> None:
    axes.plot(one.number, one.level_fitted, marker="o", ms=2.6, label="fitted", **LINES["fitted"])
    points(axes, one.number, one.level, one.level_error)
    axes.set(title=f"recording {one.place}: {one.velocity:.3g} m/s, {one.error_db:.1f} dB off",
             ylabel="level (dB)", xlabel="partial number k")  # fmt: skip


def draw_paths(paths: Sequence[tuple[np.ndarray, np.ndarray]]) -> list[Figure]:
    """What lies between string and file, at the partials, a line for each group of recordings."""
    return [make_figure(_paths, paths, legend_rows=len(paths) > 1)]


def _paths(axes: Axes, paths: Sequence[tuple[np.ndarray, np.ndarray]]) -> None:
    lowest, highest = span(*(db for _, db in paths))
    room = max(highest - lowest, 1.0)
    bottom = lowest - 0.08 * room
    for i, (frequency, db) in enumerate(paths):
        colour = GROUPS[i % len(GROUPS)]
        axes.vlines(frequency, bottom, db, color=colour, lw=1.6, alpha=0.45)
        axes.plot(frequency, db, "o", ms=4, color=colour, label=f"group {i}" if len(paths) > 1 else "")
    axes.set(xlabel="frequency (Hz)", ylabel="output path (dB)", ylim=(bottom, highest + 0.06 * room))
    low, high = span(*(frequency for frequency, _ in paths))
    axes.set_xlim(low - 0.02 * (high - low) - 1.0, high + 0.02 * (high - low) + 1.0)


def draw_held_out(recordings: Sequence[dict[str, Any]]) -> list[Figure]:
    """Errors of each recording left out, in order of velocity: predicted, and by what needs no model."""
    return [make_figure(_held_out, recordings, legend_rows=len(HELD_OUT), columns=1)]


def _held_out(axes: Axes, recordings: Sequence[dict[str, Any]]) -> None:
    places = np.arange(len(recordings))
    for key, label, look in HELD_OUT:
        value = np.array([recording[key] for recording in recordings], float)  # NaN where it is None
        axes.plot(places, value, ls="none", mew=1.6, label=label, zorder=3, **look)
    top = span(*(np.array([recording[key] or 0.0 for recording in recordings]) for key, *_ in HELD_OUT))[1]
    axes.set(ylim=(0.0, 1.12 * max(top, 0.1)), xlim=(-0.5, len(recordings) - 0.5), ylabel="error of the levels (dB)")
    axes.set_xticks(places, [f"{recording['v_H0']:.3g} m/s" for recording in recordings], color=INK)
    axes.tick_params(axis="x", labelrotation=30 if len(recordings) > CROWDED else 0)
