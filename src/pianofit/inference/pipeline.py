"""The one door to F: recordings of a key in, its minima and its posterior out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ..analysis import Analysis
from ..recording.recording import Recording
from ..setup import Setup
from ..threads import one_blas_thread
from .intervals import IntervalResult, check_intervals, compute_intervals
from .laplace import Posterior
from .map_estimate import Estimate, Progress, initial_point, map_estimate
from .parametrisation import STRING_SIZE
from .problem import FitProblem, build_problem

__all__ = ["InferenceResult", "run_inference"]


@dataclass(frozen=True)
class InferenceResult:
    """What recordings say by F: the problem they pose, what was found, and intervals by a view other than Laplace's."""

    problem: FitProblem
    found: Estimate
    seed: int
    view: IntervalResult | None = None

    @property
    def posterior(self) -> Posterior:
        """By Laplace's approximation, about all minima."""
        return self.found.posterior

    @cached_property
    def begun(self) -> np.ndarray:
        """Where the hammer's search began, with the string that was found [size]."""
        return initial_point(self.problem, self.found.z[:STRING_SIZE])

    @cached_property
    def gauge_fixed(self) -> Posterior:
        """The posterior, gauge-fixed at the reference's velocity where the scale of the velocities is the prior's."""
        if not self.problem.velocity_scale_free:
            return self.posterior
        return self.posterior.given(np.eye(self.problem.unknowns.size)[self.problem.velocity])

    @property
    def excess(self) -> float:
        """By how much levels leave the model beyond their noise, dB."""
        return float(np.exp(self.found.minima.people.level.phi[0, 0]))

    def alternative_interval(self, name: str) -> dict:
        """The interval of a parameter by the other view, in the form of `fit.json`; empty where there is none."""
        return {} if self.view is None else self.view.entries.get(name, {})


@one_blas_thread()
def run_inference(
    recordings: Sequence[Recording],
    analyses: Sequence[Analysis],
    setup: Setup | None = None,
    *,
    velocity: float | None = None,
    intervals: str = "laplace",
    seed: int = 0,
    progress: Progress = lambda *_: None,
) -> InferenceResult:
    """What recordings of one key say of string and hammer; arguments are those of `fit`, which says what they mean.

    Raises `ParameterError` for other intervals, and `FitError` if a recording is given twice, is of another key or all
    noise, or if no hammer gives a finite sound.
    """
    check_intervals(intervals)
    problem = build_problem(recordings, analyses, setup or Setup(), velocity)
    found = map_estimate(problem, seed, progress)
    return InferenceResult(problem, found, seed, compute_intervals(problem, found, intervals, seed, progress))
