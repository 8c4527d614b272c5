"""One HTML file that says what was fitted and how well, shows it, and lets it be heard; see `kit`.

The player reads its sounds from the links that also let them be saved.
"""

from __future__ import annotations

import json
from pathlib import PurePath
from typing import Any

import numpy as np

from ..felt import LAWS
from ..io import number_format
from ..io.files import replace_strings
from . import identifiability_text, text
from .equations import equations
from .figure_data import FigureData, RecordingCurves, Strokes
from .figures import draw_figures
from .html import page_bytes, picture
from .sound import LIGHT_RATE, SECONDS, Clip, make_clips, seconds_each

__all__ = ["FigureData", "report_bytes"]

# Of the first recording, where a sound has two channels.
STEREO_SECONDS = 5.0
# Of the other recordings' sounds all together: 2 MB.
LIGHT_SAMPLES = 1_000_000
LONGEST = 4.0  # s, of each of them,
SHORTEST = 1.5  # s, however many there are
# What is said of a fit, on the page by the functions' names.
SAID = (
    text.notices,
    text.summary_tiles,
    text.groups,
    text.comparison,
    text.glide,
    text.bands,
    text.minima,
    text.interval_method_text,
    identifiability_text.identifiability_sections,
    identifiability_text.felt_scale,
    identifiability_text.open_scale,
    identifiability_text.is_power_law,
)
# Pictures that only some fits have.
SOMETIMES = ("recordings", "paths", "held_out", "felt", "known")


def report_bytes(fit: dict[str, Any], curves: FigureData, title: str, held_out: dict[str, Any] | None = None) -> bytes:
    """Return the page.

    Parameters
    ----------
    fit
        The content of `fit.json`, of this version.
    title
        Plain text, such as the name of the file and the note.
    held_out
        What `predict.cross_validate` returned of the same recordings, to be shown beside their fit.
    """
    # A page is shown to others, who need not know any folder.
    names = _names(fit, held_out)
    fit = replace_strings(fit, names)
    onset = next(row["onset_s"] for row in fit["recordings"] if row["first"])
    left_out = replace_strings(held_out, names)
    figures = draw_figures(
        curves, tuple(fit["criterion"]["dropped"]), tuple(left_out["recordings"]) if left_out else ()
    )
    said: dict[str, Any] = {say.__name__: say(fit) for say in SAID}
    return page_bytes(
        "page.html.j2",
        scripts=("audio.js", "player.js", "zoom.js"),
        title=title,
        contents=True,
        fit=fit,
        **said,
        invariants=text.rows(fit["invariants"]),
        rows=text.rows(fit["parameters"]),
        equations=_equations(fit, curves),
        clips=_clips(curves, onset),
        ringing=_ringing(fit, curves),
        strokes=_strokes(curves.strokes),
        players=_players(curves, fit["recordings"]),
        stulov=curves.felt is not None and curves.felt.slow is not None,
        held_out=left_out,
        path_groups=len(curves.paths),
        figures=dict.fromkeys(SOMETIMES) | {name: picture(panels) for name, panels in figures.items()},
        has_path=curves.path is not None,
        data=json.dumps(fit, indent=2, ensure_ascii=False, default=str),
    )


def _names(*documents: dict[str, Any] | None) -> dict[str, str]:
    """The path of every recording -> its name; the longest path first."""
    files = {row["file"] for document in documents if document is not None for row in document["recordings"]}
    return {file: PurePath(file).name for file in sorted(files, key=len, reverse=True) if PurePath(file).name}


def _equations(fit: dict[str, Any], curves: FigureData) -> dict[str, Any]:
    """The box of equations; the package's laws go by the name in the file, since some share a type of hammer."""
    law = LAWS.get(fit["felt"])
    own = () if curves.felt is None else curves.felt.formula
    modes = bool(curves.ringing and curves.ringing.decays)
    return equations(fit, own if law is None else law.formula, path=curves.path is not None, modes=modes)


def _clips(curves: FigureData, onset: float) -> list[Clip]:
    """The first recording's sounds: beside it the fit as it rings and by its law, or before and after the fit."""
    sounds = {name: _downmix_to_stereo(x) for name, x in curves.sounds.items()}
    mono = all(x.ndim == 1 for x in sounds.values())
    return make_clips(sounds, curves.sound_rate, onset, seconds=SECONDS if mono else STEREO_SECONDS)


def _downmix_to_stereo(x: np.ndarray) -> np.ndarray:
    """One channel or two as they are; the mean of more, for which a listener has no loudspeakers."""
    return x if x.ndim == 1 or len(x) <= 2 else x.mean(axis=0)


def _ringing(fit: dict[str, Any], curves: FigureData) -> dict[str, Any] | None:
    """What is said of how the note rings, and the table of its decays."""
    if curves.ringing is None:
        return None
    rows = [
        [str(d.number), f"{d.frequency:.2f}", str(d.modes),
         *(number_format.number(x, 2) for x in (d.early, d.late, d.beat_frequency, d.beat_depth)),
         " to ".join(dict.fromkeys(number_format.number(x, 2) for x in d.error))]
        for d in curves.ringing.decays
    ]  # fmt: skip
    return {"words": text.ringing(fit["ringing"]), "rows": rows}


def _strokes(strokes: Strokes | None) -> dict[str, Any] | None:
    """The sounds of the slider, which keep their loudness to each other."""
    if strokes is None:
        return None
    sounds = {f"{number_format.number(v, 3)} m/s": x for v, x in zip(strokes.velocity, strokes.sounds, strict=True)}
    clips = make_clips(sounds, strokes.rate, lead_in=0.0, matched=False, highest_rate=LIGHT_RATE)
    return {"clips": clips, "first": strokes.first, "inside": strokes.inside}


def _players(curves: FigureData, recordings: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Recorded and fitted sound of every recording but the first, which has its own player."""
    others = [recording for i, recording in enumerate(curves.recordings) if i != curves.first]
    seconds = seconds_each(len(others), LIGHT_SAMPLES, LONGEST, SHORTEST)
    return [
        {"id": f"recording-{one.place}", "place": one.place, "file": recordings[one.place - 1]["file"],
         "velocity": one.velocity, "clips": _pair(one, seconds)}
        for one in others
    ]  # fmt: skip


def _pair(recording: RecordingCurves, seconds: float) -> list[Clip]:
    sounds = {"original": recording.sound_original, "fitted": recording.sound_fitted}
    return make_clips(sounds, recording.sound_rate, recording.onset, seconds=seconds, highest_rate=LIGHT_RATE)
