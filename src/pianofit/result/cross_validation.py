"""Cross-validation: each stroke of a key is left out in turn and predicted by the fit of the others.

Two errors that need no model are reported for comparison: that of the nearest recorded layer in its place, and that of
the best blend, in decibels, of its two neighbours.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from ..analysis import Analysis, analyse, check_analyses
from ..criterion import level_error_db
from ..errors import FitError, ParameterError, check_type
from ..fit_file import relative_gains
from ..inference import run_inference
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

    All recordings of a stroke are left out together, since they share its velocity. Neighbours are of the same path
    group, since another microphone receives each partial at another level.

    Parameters
    ----------
    recordings : three or more recordings of one key, in any form that `fit` takes.
    analyses : analyses of the recordings, in their order, if they were analysed before.
    setup : the given values.
    note, f0 : the note, or its pitch in Hz; estimated if None.
    seed : seed of the searches.
    progress : called with a stage's name and the fraction done.

    Returns
    -------
    dict
        `recordings`, in order of velocity, each with `file`, `v_H0` (in the fit of all), `predicted_v_H0`,
        `predicted_db` and `partials` (None if no other recording shares the output path), `nearest_db` (None without a
        neighbour), `blend_db` (None at the ends of a group) and `inner`; `median_inner_db` and `worst_inner_db` (None
        without an inner recording); `messages`.
    Result
        The fit of all recordings.

    Raises
    ------
    FitError
        For fewer than three strokes, and as `fit` does.
    RecordingError, AnalysisError
        For a recording that cannot be used.

    Examples
    --------
    >>> scores, result = pianofit.cross_validate(["soft.wav", "mezzo.wav", "loud.wav"], note="F#2")  # four fits
    >>> scores["median_inner_db"]
    """
    check_seed(seed)
    check_type("recordings=", recordings, list | tuple, "a list of three or more recordings")
    check_type("setup=", setup, Setup | None, "a Setup; load_setup reads one from a file")
    check_analyses(analyses)
    count = len(recordings)
    if analyses is not None and len(analyses) != count:
        raise ParameterError(f"{len(analyses)} analyses were given for {count} recordings; give one for each")
    if count < 3:
        few = "1 recording is" if count == 1 else f"{count} recordings are"
        raise FitError(f"{few} too few to leave one out; give three or more")
    recordings, setup = load_recordings(recordings), setup or Setup()
    analyses = [analyse(recording, note=note, f0=f0) for recording in recordings] if analyses is None else analyses
    complete = build_result(run_inference(recordings, analyses, setup, seed=seed))
    fitted = complete.document["recordings"]
    strokes = list(dict.fromkeys(row["stroke"] for row in fitted))
    if len(strokes) < 3:
        raise FitError(
            f"{counted(count, 'recording')} of {counted(len(strokes), 'stroke')} are too few to leave one stroke "
            "out; give three or more"
        )
    predicted: dict[int, Prediction | None] = {}
    for left_out, stroke in enumerate(strokes, 1):
        progress(f"without stroke {left_out} of {len(strokes)}", left_out / (len(strokes) + 1))
        others = [j for j in range(count) if fitted[j]["stroke"] != stroke]
        fit = build_result(
            run_inference([recordings[j] for j in others], [analyses[j] for j in others], setup, seed=seed)
        )
        groups = [fitted[j]["group"] for j in others]
        for i in {*range(count)}.difference(others):
            predicted[i] = _predict(fit, groups, fitted[i]["group"], analyses[i])
    order = sorted(range(count), key=lambda i: fitted[i]["v_H0"])
    rows = [
        _row(fitted[i], predicted[i], analyses[i], [analyses[j] for j in _neighbours(i, order, fitted)]) for i in order
    ]
    inner = [row["predicted_db"] for row in rows if row["inner"]]
    messages = [
        f"{Path(row['file']).name} cannot be predicted: no other stroke was recorded through its output path, so the "
        "path is unknown."
        for row in rows
        if row["predicted_db"] is None
    ]
    messages += [
        f"{Path(recordings[i].path).name} is predicted at {p.velocity:.3g} m/s, at the limit of the searched range: "
        "its velocity could not be determined."
        for i, p in predicted.items()
        if p is not None and p.velocity_at_search_limit
    ]
    median, worst = (float(np.median(inner)), float(max(inner))) if inner else (None, None)
    return {"recordings": rows, "median_inner_db": median, "worst_inner_db": worst, "messages": messages}, complete


def _predict(fit: Result, groups: Sequence[int], group: int, analysis: Analysis) -> Prediction | None:
    """Predict a recording through the path of its `group`; None if no recording of the fit has it."""
    if group not in groups:
        return None
    recording = groups.index(group)
    notes = [(weight, notes[recording]) for weight, notes in zip(fit.weights, fit.minima_notes, strict=True)]
    return predict_recording(notes, analysis, gains=relative_gains(fit.document, recording))


def _neighbours(i: int, order: list[int], fitted: list[dict]) -> list[int]:
    """Neighbours of a recording in velocity within its group: two, one at an end of the group, or none."""
    group = [j for j in order if fitted[j]["group"] == fitted[i]["group"]]
    position = group.index(i)
    return group[max(position - 1, 0) : position] + group[position + 1 : position + 2]


def _row(fitted: dict, prediction: Prediction | None, analysis: Analysis, neighbours: Sequence[Analysis]) -> dict:
    """Errors of the prediction of one recording, and of its neighbours in its place."""
    return {
        "file": fitted["file"],
        "v_H0": fitted["v_H0"],
        "predicted_v_H0": prediction.velocity if prediction else None,
        "predicted_db": prediction.error_db if prediction else None,
        "partials": prediction.partials if prediction else None,
        "nearest_db": min((_difference_db(analysis, other) for other in neighbours), default=None),
        "blend_db": _blend_error_db(analysis, *neighbours) if len(neighbours) == 2 else None,
        "inner": len(neighbours) == 2,
    }


def _common_levels(analysis: Analysis, others: Sequence[Analysis]) -> tuple[np.ndarray, list[np.ndarray]]:
    """Levels, dB [partials], of the scored partials that all recordings have."""
    p = analysis.partials
    number = p.number[audible_partials(p.frequency, p.level)]
    for other in others:
        number = np.intersect1d(number, other.partials.number)
    level = [a.partials.level[np.searchsorted(a.partials.number, number)] for a in (analysis, *others)]
    return level[0], level[1:]


def _difference_db(analysis: Analysis, other: Analysis) -> float:
    """Level error of another layer in place of this one, dB."""
    level, (substitute,) = _common_levels(analysis, [other])
    return level_error_db(substitute, level)


def _blend_error_db(analysis: Analysis, below: Analysis, above: Analysis) -> float:
    """Level error of the best blend of two neighbours, dB; levels are blended in decibels."""
    level, (low, high) = _common_levels(analysis, [below, above])
    step, target = high - low - (high - low).mean(), level - low - (level - low).mean()
    fraction = np.clip((step @ target) / max(step @ step, 1e-300), 0.0, 1.0)
    return level_error_db(low + fraction * (high - low), level)
