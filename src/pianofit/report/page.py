"""The page of a fit as one HTML file (`html.py`): results, quality of the fit, pictures and sounds.

The player reads its sounds from the download links, so that each sound is in the file once.
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

# Length of the sounds of the reference recording in stereo, s; in mono it is `SECONDS`.
STEREO_SECONDS = 5.0
# Samples of the sounds of all other recordings together: 2 MB.
OTHER_SAMPLES = 1_000_000
LONGEST_OTHER, SHORTEST_OTHER = 4.0, 1.5  # s, of each of these sounds
# Functions of the content of `fit.json`. The template uses each result by the name of its function.
TEXTS = (
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
OPTIONAL_FIGURES = ("recordings", "paths", "held_out", "felt", "identifiability")


def report_bytes(fit: dict[str, Any], curves: FigureData, title: str, held_out: dict[str, Any] | None = None) -> bytes:
    """Return the page.

    Parameters
    ----------
    fit
        The content of `fit.json`, of this version.
    title
        Plain text, such as the name of the file and the note.
    held_out
        Result of `cross_validate` for the same recordings, to be added to the page.
    """
    # Pages are passed on, so they contain file names without folders.
    names = _names(fit, held_out)
    fit = replace_strings(fit, names)
    onset = next(row["onset_s"] for row in fit["recordings"] if row["first"])
    held_out = replace_strings(held_out, names)
    figures = draw_figures(
        curves, tuple(fit["criterion"]["dropped"]), tuple(held_out["recordings"]) if held_out else ()
    )
    texts: dict[str, Any] = {function.__name__: function(fit) for function in TEXTS}
    return page_bytes(
        "page.html.j2",
        scripts=("audio.js", "player.js", "zoom.js"),
        title=title,
        contents=True,
        fit=fit,
        **texts,
        invariants=text.rows(fit["invariants"]),
        rows=text.rows(fit["parameters"]),
        equations=_equations(fit, curves),
        clips=_clips(curves, onset),
        ringing=_ringing(fit, curves),
        strokes=_strokes(curves.strokes),
        players=_players(curves, fit["recordings"]),
        stulov=curves.felt is not None and curves.felt.slow is not None,
        held_out=held_out,
        path_groups=len(curves.paths),
        figures=dict.fromkeys(OPTIONAL_FIGURES) | {name: picture(panels) for name, panels in figures.items()},
        has_path=curves.path is not None,
        data=json.dumps(fit, indent=2, ensure_ascii=False, default=str),
    )


def _names(*documents: dict[str, Any] | None) -> dict[str, str]:
    """Return path -> file name of every recording, the longest path first."""
    files = {row["file"] for document in documents if document is not None for row in document["recordings"]}
    return {file: PurePath(file).name for file in sorted(files, key=len, reverse=True) if PurePath(file).name}


def _equations(fit: dict[str, Any], curves: FigureData) -> dict[str, Any]:
    """Return the box of equations. Built-in felt laws are found by name, because some share a type of hammer."""
    law = LAWS.get(fit["felt"])
    user_formula = () if curves.felt is None else curves.felt.formula
    has_modes = bool(curves.ringing and curves.ringing.decays)
    return equations(fit, user_formula if law is None else law.formula, path=curves.path is not None, modes=has_modes)


def _clips(curves: FigureData, onset: float) -> list[Clip]:
    """Return the sounds of the reference recording: recorded and two of the model."""
    sounds = {name: _downmix_to_stereo(x) for name, x in curves.sounds.items()}
    is_mono = all(x.ndim == 1 for x in sounds.values())
    return make_clips(sounds, curves.sound_rate, onset, seconds=SECONDS if is_mono else STEREO_SECONDS)


def _downmix_to_stereo(x: np.ndarray) -> np.ndarray:
    """Return one or two channels unchanged, and the mean of more, which few listeners can play."""
    return x if x.ndim == 1 or len(x) <= 2 else x.mean(axis=0)


def _ringing(fit: dict[str, Any], curves: FigureData) -> dict[str, Any] | None:
    """Return the text on the modal response of the key, and the table of decays and beats."""
    if curves.ringing is None:
        return None
    rows = [
        [str(d.number), f"{d.frequency:.2f}", str(d.modes),
         *(number_format.number(x, 2) for x in (d.early, d.late, d.beat_frequency, d.beat_depth)),
         " to ".join(dict.fromkeys(number_format.number(x, 2) for x in d.error))]
        for d in curves.ringing.decays
    ]  # fmt: skip
    return {"text": text.modal_response_text(fit["ringing"]), "rows": rows}


def _strokes(strokes: Strokes | None) -> dict[str, Any] | None:
    """Return the sounds of the velocity slider, which keep their differences in loudness."""
    if strokes is None:
        return None
    sounds = {f"{number_format.number(v, 3)} m/s": x for v, x in zip(strokes.velocity, strokes.sounds, strict=True)}
    clips = make_clips(sounds, strokes.rate, lead_in=0.0, matched=False, highest_rate=LIGHT_RATE)
    return {"clips": clips, "first": strokes.first, "inside": strokes.inside}


def _players(curves: FigureData, recordings: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return recorded and fitted sound of every recording except the reference, which has its own player."""
    others = [recording for i, recording in enumerate(curves.recordings) if i != curves.reference_index]
    seconds = seconds_each(len(others), OTHER_SAMPLES, LONGEST_OTHER, SHORTEST_OTHER)
    return [
        {
            "id": f"recording-{recording.place}",
            "place": recording.place,
            "file": recordings[recording.place - 1]["file"],
            "velocity": recording.velocity,
            "clips": _pair(recording, seconds),
        }
        for recording in others
    ]


def _pair(recording: RecordingCurves, seconds: float) -> list[Clip]:
    sounds = {"original": recording.sound_original, "fitted": recording.sound_fitted}
    return make_clips(sounds, recording.sound_rate, recording.onset, seconds=seconds, highest_rate=LIGHT_RATE)
