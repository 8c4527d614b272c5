"""Fits as users call them: the default estimator, or one of the paper's recipes, of one recording or of several."""

from __future__ import annotations

from .analysis import Analysis
from .inference import Progress, Result
from .inference.fit import fit_takes
from .inference.point import point_result
from .inference.start import Start, starting_values
from .inference.views import MEANS, check_intervals
from .paper.recipes import RECIPES, Found, check_recipe, claims, fit_by_paper
from .recording import Recording
from .setup import Setup

__all__ = ["MEANS", "RECIPES", "check_intervals", "check_recipe", "fit_recording"]


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
    check_recipe(recipe, evaluations)
    check_intervals(intervals, recipe)
    if recipe == "default":
        return fit_takes(
            [recording], [analysis], setup, velocity=velocity, intervals=intervals, seed=seed, progress=progress
        )
    start = _start_of_paper(analysis, setup or Setup(), velocity)
    found = fit_by_paper(recording, analysis, start, recipe, evaluations=evaluations, seed=seed, progress=progress)
    return _paper_result(recording, analysis, start, recipe, seed, found)


def _start_of_paper(analysis: Analysis, setup: Setup, velocity: float | None) -> Start:
    measured = velocity if velocity is not None else next((t.v_H0 for t in setup.takes if t.v_H0), None)
    return starting_values(analysis, setup, measured)


def _paper_result(
    recording: Recording, analysis: Analysis, start: Start, recipe: str, seed: int, found: Found
) -> Result:
    """What a recipe of the paper found, as a result that claims no more than it can."""
    opening, messages = claims(recipe, start.scale is not None)
    return point_result(
        recording, analysis, start, found.string, found.hammer, recipe=recipe, seed=seed, delay=found.delay,
        converged=found.converged, evaluations=found.evaluations, at_bound=found.at_bound, opening=opening,
        messages=messages,
    )  # fmt: skip
