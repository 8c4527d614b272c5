"""Cross-validation: each stroke of a key is left out in turn and predicted by the fit of the others.

Two errors that need no model are reported for comparison: that of the nearest recorded layer in its place, and that of
the best blend, in decibels, of its two neighbours.
"""

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from ..analysis import Analysis, analyse, check_analyses
from ..criterion import level_error_db
from ..errors import FitError, check_type
from ..felt import law_of
from ..inference import run_inference
from ..io.number_format import counted
from ..parameters import check_seed
from ..progress import Progress, progress_bar
from ..recording.recording import Source, load_recordings
from ..schema.decode import builtins_of
from ..schema.fit import RecordingFit
from ..setup import Setup, to_setup
from .build_result import build_result
from .comparison import audible_partials
from .prediction import Prediction, predict_recording
from .result import Result


@dataclass(frozen=True)
class LeftOutRecording:
    """Errors of the prediction of one recording, and of its neighbours in its place; None where there is none."""

    file: str
    stroke_value: float  # velocity, m/s, or plucking position, m, in the fit of all recordings
    predicted_stroke_value: float | None  # None if no other recording has its output path
    predicted_db: float | None  # rms over partials
    partials: int | None
    nearest_db: float | None  # of the nearer neighbour in velocity
    blend_db: float | None  # of the best blend of both neighbours
    has_neighbours: bool  # two, one slower and one faster


@dataclass(frozen=True)
class CrossValidation:
    """Errors of all recordings of a key, each predicted by a fit without its stroke."""

    recordings: tuple[LeftOutRecording, ...]  # by velocity
    median_inner_db: float | None  # of the recordings with two neighbours; None if there are none
    worst_inner_db: float | None
    warnings: tuple[str, ...]
    result: Result  # the fit of all recordings

    def to_dict(self) -> dict[str, Any]:
        """The errors as dicts, lists, numbers and texts, without `result` (docs/files.md)."""
        return {own.name: builtins_of(getattr(self, own.name)) for own in fields(self) if own.name != "result"}


def cross_validate(
    *recordings: Source,
    setup: Setup | Mapping[str, Any] | str | os.PathLike[str] | None = None,
    note: str | int | None = None,
    f0: float | None = None,
    channel: str | int = "average",
    seed: int = 0,
    progress: Progress | bool | None = None,
    analyses: Sequence[Analysis] | None = None,
) -> CrossValidation:
    """Leave out each hammer stroke in turn, fit the others, and predict it at every microphone.

    All recordings of a stroke are left out together, since they share its velocity. Neighbours are of the same path
    group, since another microphone receives each partial at another level.

    Parameters
    ----------
    recordings : three or more recordings of one key, in any form that `fit` takes.
    setup : the given values: a `Setup`, tables as in a `setup.toml`, or the path of one.
    note, f0 : the note, or its pitch in Hz; estimated if None.
    channel : channel of files: "average", "left", "right", or "1" to "8".
    seed : seed of the searches.
    progress : called with a stage's name and the fraction done; False for none. If None, a bar in a terminal and a line
        in a notebook.
    analyses : analyses of the recordings, in their order, if they were analysed before.

    Returns
    -------
    A `CrossValidation`: the errors of every recording, in order of velocity, and the fit of all recordings.

    Raises
    ------
    FitError
        For fewer than three strokes, and as `fit` does.
    PianofitError
        For other invalid input, as `fit` does.

    Examples
    --------
    >>> found = pianofit.cross_validate("soft.wav", "mezzo.wav", "loud.wav", note="F#2")  # four fits
    >>> found.median_inner_db
    """
    check_seed(seed)
    check_type("progress=", progress, Callable | bool | None, "a function of a stage and a fraction, True or False")
    count, setup = len(recordings), to_setup(setup)
    check_analyses(analyses, count)
    if count < 3:
        few = "1 recording is" if count == 1 else f"{count} recordings are"
        raise FitError(f"{few} too few to leave one out; give three or more")
    sounds = load_recordings(recordings, channel)
    analyses = [analyse(sound, note=note, f0=f0) for sound in sounds] if analyses is None else analyses
    complete = build_result(run_inference(sounds, analyses, setup, seed=seed))
    fitted = complete.fit.recordings
    strokes = list(dict.fromkeys(own.stroke for own in fitted))
    if len(strokes) < 3:
        raise FitError(
            f"{counted(count, 'recording')} of {counted(len(strokes), 'stroke')} are too few to leave one stroke "
            "out; give three or more"
        )
    predicted: dict[int, Prediction | None] = {}
    with progress_bar(progress) as report:
        for left_out, stroke in enumerate(strokes, 1):
            report(f"without stroke {left_out} of {len(strokes)}", left_out / (len(strokes) + 1))
            others = [j for j in range(count) if fitted[j].stroke != stroke]
            kept, found = [sounds[j] for j in others], [analyses[j] for j in others]
            fit = build_result(run_inference(kept, found, setup, seed=seed))
            groups = [fitted[j].path_group for j in others]
            for i in {*range(count)}.difference(others):
                predicted[i] = _predict(fit, groups, fitted[i].path_group, analyses[i])
    return _validation(complete, analyses, predicted)


def _predict(fit: Result, groups: Sequence[int], group: int, analysis: Analysis) -> Prediction | None:
    """Predict a recording through the path of its `group`; None if no recording of the fit has it."""
    if group not in groups:
        return None
    index = groups.index(group)
    notes = [(weight, notes[index]) for weight, notes in zip(fit.weights, fit.minima_notes, strict=True)]
    return predict_recording(notes, analysis, gains=fit.fit.relative_gains(index))


def _validation(
    complete: Result, analyses: Sequence[Analysis], predicted: Mapping[int, Prediction | None]
) -> CrossValidation:
    """The errors of every recording, by velocity, and their median and maximum."""
    fitted = complete.fit.recordings
    order = sorted(range(len(fitted)), key=lambda i: fitted[i].stroke_value)
    recordings = [_left_out(i, order, fitted, predicted[i], analyses) for i in order]
    inner = [own.predicted_db for own in recordings if own.has_neighbours and own.predicted_db is not None]
    warnings = [
        f"{Path(own.file).name} cannot be predicted: no other stroke was recorded through its output path, so the "
        "path is unknown."
        for own in recordings
        if own.predicted_db is None
    ]
    warnings += [
        f"{Path(fitted[i].file).name} is predicted at {p.stroke_value:.3g} {p.stroke.unit}, at the limit of the "
        f"searched range: its {law_of(p.note.hammer).words.stroke} could not be determined."
        for i, p in predicted.items()
        if p is not None and p.at_search_limit
    ]
    median, worst = (float(np.median(inner)), max(inner)) if inner else (None, None)
    return CrossValidation(tuple(recordings), median, worst, tuple(warnings), complete)


def _left_out(
    i: int,
    order: Sequence[int],
    fitted: Sequence[RecordingFit],
    prediction: Prediction | None,
    analyses: Sequence[Analysis],
) -> LeftOutRecording:
    """The errors of one recording. Its neighbours are the recordings of its path group next to it in velocity."""
    group = [j for j in order if fitted[j].path_group == fitted[i].path_group]
    at = group.index(i)
    neighbours = [analyses[j] for j in group[max(at - 1, 0) : at] + group[at + 1 : at + 2]]
    errors = [_difference_db(analyses[i], other) for other in neighbours]
    return LeftOutRecording(
        file=fitted[i].file,
        stroke_value=fitted[i].stroke_value,
        predicted_stroke_value=prediction.stroke_value if prediction else None,
        predicted_db=prediction.error_db if prediction else None,
        partials=prediction.partials if prediction else None,
        nearest_db=min(errors, default=None),
        blend_db=_blend_error_db(analyses[i], *neighbours) if len(neighbours) == 2 else None,
        has_neighbours=len(neighbours) == 2,
    )


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
