"""The one door to F: recordings of a key in, its minima and its posterior out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ..analysis import Analysis
from ..recording import Recording
from ..setup import Setup
from ..threads import one_blas_thread
from .coordinates import STRING_SIZE
from .estimate import Estimate, Progress, beginning, estimate
from .posterior import Posterior
from .problem import Problem, pose
from .views import View, check_intervals, view_of

__all__ = ["Inferred", "infer"]


@dataclass(frozen=True)
class Inferred:
    """What recordings say by F: the problem they pose, what was found, and intervals by a view other than Laplace's."""

    problem: Problem
    found: Estimate
    seed: int
    view: View | None = None

    @property
    def posterior(self) -> Posterior:
        """By Laplace's approximation, about all minima."""
        return self.found.posterior

    @cached_property
    def begun(self) -> np.ndarray:
        """Where the hammer's search began, with the string that was found [size]."""
        return beginning(self.problem, self.found.z[:STRING_SIZE])

    @cached_property
    def gauged(self) -> Posterior:
        """The posterior, gauge-fixed at the reference's velocity where the scale of the velocities is the prior's."""
        if not self.problem.unscaled:
            return self.posterior
        return self.posterior.given(np.eye(self.problem.unknowns.size)[self.problem.velocity])

    @property
    def excess(self) -> float:
        """By how much levels leave the model beyond their noise, dB."""
        return float(np.exp(self.found.minima.people.level.phi[0, 0]))

    def seen(self, name: str) -> dict:
        """The interval of a parameter by the other view, in the form of `fit.json`; empty where there is none."""
        return {} if self.view is None else self.view.entries.get(name, {})


@one_blas_thread()
def infer(
    recordings: Sequence[Recording],
    analyses: Sequence[Analysis],
    setup: Setup | None = None,
    *,
    velocity: float | None = None,
    intervals: str = "laplace",
    seed: int = 0,
    progress: Progress = lambda *_: None,
) -> Inferred:
    """What recordings of one key say of string and hammer; arguments are those of `fit`, which says what they mean.

    Raises `ParameterError` for other intervals, and `FitError` if a recording is given twice, is of another key or all
    noise, or if no hammer gives a finite sound.
    """
    check_intervals(intervals)
    problem = pose(recordings, analyses, setup or Setup(), velocity)
    found = estimate(problem, seed, progress)
    return Inferred(problem, found, seed, view_of(problem, found, intervals, seed, progress))
