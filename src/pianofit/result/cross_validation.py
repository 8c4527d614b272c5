"""The honest test: every stroke of a key left out in turn, and predicted by the fit of the others.

Beside the prediction stand what needs no model: the nearest recorded layer in its place, and the best blend, in
decibels, of its two neighbours.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from ..analysis import Analysis, analyse, check_analyses
from ..criterion import level_error_db
from ..errors import FitError, ParameterError, check_type
from ..fit_file import gains_of
from ..inference.pipeline import run_inference
from ..io.number_format import counted
from ..parameters import check_seed
from ..recording.recording import Source, load_recordings
from ..setup import Setup
from .build_result import build_result
from .comparison import audible_partials
from .prediction import Prediction, predict_recording
from .result import Result

__all__ = ["cross_validate"]


def cross_validate(
    recordings: Sequence[Source],
    analyses: Sequence[Analysis] | None = None,
    setup: Setup | None = None,
    *,
    note: str | int | None = None,
    f0: float | None = None,
    seed: int = 0,
    progress: Callable[[str, float], None] = lambda *_: None,
) -> tuple[dict, Result]:
    """Leave out each hammer stroke in turn, fit the others, and predict it at every microphone.

    A stroke's other recordings share its velocity, so they are left out with it. Neighbours are of the same group: how
    loud another microphone hears each partial says nothing of this one.

    Parameters
    ----------
    recordings : three or more of one key, in any form that `fit` takes.
    analyses : of the recordings, in their order, if they were analysed before.
    setup : what was known beforehand.
    note, f0 : what is played, or its pitch in Hz; found if None.
    seed : of the searches.
    progress : called with what is being fitted, and the fraction done.

    Returns
    -------
    `recordings`, in order of velocity, each with `file`, `v_H0` (in the fit of all), `predicted_v_H0`, `predicted_db`
    and `partials` (None where no other recording shares the path), `nearest_db` (None without a neighbour), `blend_db`
    (None at a group's ends) and `inner`; `median_inner_db` and `worst_inner_db` (None without an inner recording);
    `messages`. With it the fit of all recordings.

    Raises
    ------
    FitError
        For fewer than three strokes, and as `fit` does.
    RecordingError, AnalysisError
        For a recording that cannot be used.

    Examples
    --------
    >>> found, result = pianofit.cross_validate(["soft.wav", "mezzo.wav", "loud.wav"], note="F#2")  # four fits
    >>> found["median_inner_db"]
    """
    check_seed(seed)
    check_type("recordings=", recordings, list | tuple, "a list of three or more recordings")
    check_type("setup=", setup, Setup | None, "a Setup; load_setup reads one from a file")
    check_analyses(analyses)
    count = len(recordings)
    if analyses is not None and len(analyses) != count:
        raise ParameterError(f"{len(analyses)} analyses were given of {count} recordings; give one of each")
    if count < 3:
        few = "1 recording is" if count == 1 else f"{count} recordings are"
        raise FitError(f"{few} too few to leave one out; give three or more")
    recordings, setup = load_recordings(recordings), setup or Setup()
    analyses = [analyse(one, note=note, f0=f0) for one in recordings] if analyses is None else analyses
    whole = build_result(run_inference(recordings, analyses, setup, seed=seed))
    heard = whole.document["recordings"]
    strokes = list(dict.fromkeys(row["stroke"] for row in heard))
    if len(strokes) < 3:
        raise FitError(
            f"{counted(count, 'recording')} of {counted(len(strokes), 'stroke')} are too few to leave one stroke "
            "out; give three or more"
        )
    predicted: dict[int, Prediction | None] = {}
    for place, stroke in enumerate(strokes):
        progress(f"without stroke {place + 1} of {len(strokes)}", (place + 1) / (len(strokes) + 1))
        rest = [j for j in range(count) if heard[j]["stroke"] != stroke]
        fit = build_result(run_inference([recordings[j] for j in rest], [analyses[j] for j in rest], setup, seed=seed))
        groups = [heard[j]["group"] for j in rest]
        for i in {*range(count)}.difference(rest):
            predicted[i] = _predicted(fit, groups, heard[i]["group"], analyses[i])
    order = sorted(range(count), key=lambda i: heard[i]["v_H0"])
    rows = [_row(heard[i], predicted[i], analyses[i], [analyses[j] for j in _around(i, order, heard)]) for i in order]
    inner = [row["predicted_db"] for row in rows if row["inner"]]
    said = [
        f"{Path(row['file']).name} is not predicted: no other stroke was recorded through its path, which is "
        "therefore unknown."
        for row in rows
        if row["predicted_db"] is None
    ]
    said += [
        f"{Path(recordings[i].path).name} is predicted at {p.velocity:.3g} m/s, an end of the range searched: its "
        "velocity is not found."
        for i, p in predicted.items()
        if p is not None and p.velocity_at_search_limit
    ]
    median, worst = (float(np.median(inner)), float(max(inner))) if inner else (None, None)
    return {"recordings": rows, "median_inner_db": median, "worst_inner_db": worst, "messages": said}, whole


def _predicted(fit: Result, groups: Sequence[int], group: int, analysis: Analysis) -> Prediction | None:
    """A recording left out, through the path of its `group`; None where none of the fit's, in `groups`, went."""
    if group not in groups:
        return None
    at = groups.index(group)
    notes = [(share, notes[at]) for share, notes in zip(fit.weights, fit.minima_notes, strict=True)]
    return predict_recording(notes, analysis, gains=gains_of(fit.document, at))


def _around(i: int, order: list[int], heard: list[dict]) -> list[int]:
    """The recordings of the same group next to this one in velocity: two, or one at the group's ends, or none."""
    group = [j for j in order if heard[j]["group"] == heard[i]["group"]]
    place = group.index(i)
    return group[max(place - 1, 0) : place] + group[place + 1 : place + 2]


def _row(heard: dict, found: Prediction | None, analysis: Analysis, around: Sequence[Analysis]) -> dict:
    """What came of one recording that was left out, and of the layers around it in its place."""
    return {
        "file": heard["file"],
        "v_H0": heard["v_H0"],
        "predicted_v_H0": found.velocity if found else None,
        "predicted_db": found.error_db if found else None,
        "partials": found.partials if found else None,
        "nearest_db": min((_apart(analysis, other) for other in around), default=None),
        "blend_db": _blend(analysis, *around) if len(around) == 2 else None,
        "inner": len(around) == 2,
    }


def _common(analysis: Analysis, others: Sequence[Analysis]) -> tuple[np.ndarray, list[np.ndarray]]:
    """Levels [partials] of those that are scored and stand above the noise in all."""
    p = analysis.partials
    number = p.number[audible_partials(p.frequency, p.level)]
    for other in others:
        number = np.intersect1d(number, other.partials.number)
    level = [a.partials.level[np.searchsorted(a.partials.number, number)] for a in (analysis, *others)]
    return level[0], level[1:]


def _apart(analysis: Analysis, other: Analysis) -> float:
    """The error, dB, of one layer in another's place."""
    level, (instead,) = _common(analysis, [other])
    return level_error_db(instead, level)


def _blend(analysis: Analysis, below: Analysis, above: Analysis) -> float:
    """The error, dB, of the best blend of two neighbours, in decibels."""
    level, (low, high) = _common(analysis, [below, above])
    slope, miss = high - low - (high - low).mean(), level - low - (level - low).mean()
    share = np.clip((slope @ miss) / max(slope @ slope, 1e-300), 0.0, 1.0)
    return level_error_db(low + share * (high - low), level)
