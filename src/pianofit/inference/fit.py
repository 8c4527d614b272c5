"""The default fit as users call it: string and hammer of one recording, or of several of one key."""

from __future__ import annotations

from collections.abc import Sequence

from ..analysis import Analysis
from ..recording import Recording
from ..setup import Setup
from ..threads import one_blas_thread
from .conclude import conclude
from .estimate import Progress, estimate
from .problem import pose
from .result import Result
from .views import check_intervals, view_of

__all__ = ["fit_recordings"]


@one_blas_thread()
def fit_recordings(
    recordings: Sequence[Recording],
    analyses: Sequence[Analysis],
    setup: Setup | None = None,
    *,
    velocity: float | None = None,
    intervals: str = "laplace",
    seed: int = 0,
    progress: Progress = lambda *_: None,
) -> Result:
    """Fit string and hammer to one or more recordings of one key, from soft to loud in any order.

    String, felt, hammer mass and output path are those of all recordings; each stroke has a velocity, each recording a
    gain and a pitch of its own. Measured velocities, groups and gain groups come from the setup.

    Parameters
    ----------
    velocity : measured hammer velocity, m/s, of a single recording, held fixed.
    intervals : `laplace`, `profile`, or `posterior`, which needs pianofit[bayes].
    seed : of the search, and of the posterior's draws. The same seed gives the same result.
    progress : called with a stage's name and the fraction done.

    Raises
    ------
    ParameterError
        For other intervals.
    FitError
        If a recording is given twice, is of another key or all noise; if no hammer gives a finite sound, or a contact
        does not end.
    """
    check_intervals(intervals)
    problem = pose(recordings, analyses, setup or Setup(), velocity)
    found = estimate(problem, seed, progress)
    view = view_of(problem, found, intervals, seed, progress)
    progress("sounds", 0.93)
    return conclude(problem, found, seed, view)
