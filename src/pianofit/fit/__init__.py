"""From a recording to parameters with intervals.

Stages share one loop (`levenberg`) and one kind of residual (`residuals`); `recipe` puts them in order, `misfit` weighs
them, `uncertainty` and `verdict` say what came out of it, and `result` writes it down.
"""

from __future__ import annotations

from ..analysis import Analysis
from ..initial import starting_values
from ..recording import Recording
from ..setup_file import Setup
from .recipe import Progress, fit_partials
from .result import Result, Sound, conclude
from .voice import Voice

__all__ = ["Result", "Sound", "Voice", "fit_recording"]


def fit_recording(
    recording: Recording,
    analysis: Analysis,
    setup: Setup | None = None,
    *,
    velocity: float | None = None,
    seed: int = 0,
    progress: Progress = lambda *_: None,
) -> Result:
    """Fit string and hammer to one recording.

    Parameters
    ----------
    setup : what was known beforehand; nothing by default.
    velocity : measured hammer velocity, m/s, held fixed.
    seed : of the hammers that the search starts from. The same seed gives the same result.
    progress : called with a stage's name and the fraction done.

    Raises
    ------
    FitError
        If no hammer gives a finite sound, or a contact does not end.
    """
    start = starting_values(analysis, setup or Setup(), velocity)
    fit = fit_partials(recording, analysis, start, seed=seed, progress=progress)
    return conclude(recording, analysis, start, fit, seed)
