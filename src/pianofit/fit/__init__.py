"""From a recording to parameters with intervals.

Stages share one loop (`levenberg`) and one kind of residual (`residuals`); `recipe` puts them in order, `misfit` weighs
them, `uncertainty` and `verdict` say what came out of it, and `result` writes it down.
"""

from __future__ import annotations

from collections.abc import Sequence

from ..analysis import Analysis
from ..recording import Recording
from ..setup_file import Setup
from .certainty import MEANS, assess, check_intervals
from .model_fit import ModelFit, fit_model
from .paper import RECIPES, check_recipe, fit_by_paper, without_claims
from .recipe import Progress, fit_partials
from .result import Result, Sound, conclude
from .spectral import SoundModel
from .takes import arranged
from .voice import Voice

__all__ = [
    "MEANS",
    "RECIPES",
    "ModelFit",
    "Result",
    "Sound",
    "SoundModel",
    "Voice",
    "check_intervals",
    "check_recipe",
    "fit_model",
    "fit_recording",
    "fit_takes",
]


def fit_recording(
    recording: Recording,
    analysis: Analysis,
    setup: Setup | None = None,
    *,
    velocity: float | None = None,
    recipe: str = "default",
    evaluations: int | None = None,
    intervals: str = "curvature",
    seed: int = 0,
    progress: Progress = lambda *_: None,
) -> Result:
    """Fit string and hammer to one recording.

    Parameters
    ----------
    setup : what was known beforehand; nothing by default.
    velocity : measured hammer velocity, m/s, held fixed.
    recipe : `default`, or the paper's own, which give no intervals: `paper`, its three steps, and `global`, its
        criterion over the whole spectrum.
    evaluations : of the criterion by the recipe `paper`'s annealing, 20,000 unless given.
    intervals : `curvature`, `profile`, or `posterior`, which needs pianofit[bayes].
    seed : of the hammers that the search starts from, and of the posterior's draws. The same seed gives the same
        result.
    progress : called with a stage's name and the fraction done.

    Raises
    ------
    FitError
        If no hammer gives a finite sound, or a contact does not end.
    ParameterError
        For another recipe, or evaluations or intervals that it cannot have.
    """
    check_recipe(recipe, evaluations)
    check_intervals(intervals, recipe)
    if recipe != "default":
        takes, start, _, _ = arranged([recording], [analysis], setup or Setup(), velocity)
        fit = fit_by_paper(recording, analysis, start, recipe, evaluations=evaluations, seed=seed, progress=progress)
        return without_claims(conclude(takes, start, fit, seed), recipe, fit, start)
    return fit_takes(
        [recording], [analysis], setup, velocity=velocity, intervals=intervals, seed=seed, progress=progress
    )


def fit_takes(
    recordings: Sequence[Recording],
    analyses: Sequence[Analysis],
    setup: Setup | None = None,
    *,
    velocity: float | None = None,
    intervals: str = "curvature",
    seed: int = 0,
    progress: Progress = lambda *_: None,
) -> Result:
    """Fit string and hammer to one or more recordings of one key, from soft to loud in any order.

    String, felt, hammer mass and output path are those of all takes; each has a velocity, a gain and a pitch of its
    own. The takes' velocities, groups and gain groups come from the setup.

    Parameters
    ----------
    velocity : measured hammer velocity, m/s, of a single recording, held fixed.
    intervals : `curvature`, `profile`, or `posterior`, which needs pianofit[bayes].
    seed : of the hammers that the search starts from, and of the posterior's draws. The same seed gives the same
        result.
    progress : called with a stage's name and the fraction done.

    Raises
    ------
    ParameterError
        For other intervals.
    FitError
        If a take is given twice, is of another key or all noise; if no hammer gives a finite sound, or a contact does
        not end.
    """
    check_intervals(intervals)
    takes, start, layout, order = arranged(recordings, analyses, setup or Setup(), velocity)
    fit = fit_partials(takes, start, layout, seed=seed, progress=progress)
    return conclude(takes, start, fit, seed, order, assess(fit, intervals, seed, progress))
