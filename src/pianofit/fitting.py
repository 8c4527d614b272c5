"""Fits as users call them: the default estimator, or one of the paper's recipes, of one recording or of several."""

from __future__ import annotations

from .analysis import Analysis
from .inference import Progress, Result
from .inference.fit import fit_takes
from .inference.views import check_intervals
from .recording import Recording
from .setup import Setup

__all__ = ["fit_recording"]


def fit_recording(
    recording: Recording,
    analysis: Analysis,
    setup: Setup | None = None,
    *,
    velocity: float | None = None,
    recipe: str = "default",
    evaluations: int | None = None,
    intervals: str = "laplace",
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
    intervals : `laplace`, `profile`, or `posterior`, which needs pianofit[bayes].
    seed : of the search, and of the posterior's draws. The same seed gives the same result.
    progress : called with a stage's name and the fraction done.

    Raises
    ------
    FitError
        If no hammer gives a finite sound, or a contact does not end.
    ParameterError
        For another recipe, or evaluations or intervals that it cannot have.
    """
    check_intervals(intervals, recipe)
    if recipe == "default" and evaluations is None:
        return fit_takes(
            [recording], [analysis], setup, velocity=velocity, intervals=intervals, seed=seed, progress=progress
        )
    from .paper.recipes import fit_by_recipe  # for comparison: whoever does not ask for it does not load it

    return fit_by_recipe(
        recording, analysis, setup, recipe, velocity=velocity, evaluations=evaluations, seed=seed, progress=progress
    )
