"""Inference from recordings of one key: from recordings to the minima of F and its posterior."""

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
    """The problem, its estimate, and intervals by a method other than Laplace's approximation."""

    problem: FitProblem
    estimate: Estimate
    seed: int
    alternative: IntervalResult | None = None

    @property
    def posterior(self) -> Posterior:
        """Posterior by Laplace's approximation at all minima."""
        return self.estimate.posterior

    @cached_property
    def initial_theta(self) -> np.ndarray:
        """Initial θ of the hammer's search, with the fitted string [size]."""
        return initial_point(self.problem, self.estimate.theta[:STRING_SIZE])

    @cached_property
    def gauge_fixed(self) -> Posterior:
        """The posterior, gauge-fixed at the reference velocity if only the prior sets the scale of the velocities."""
        if not self.problem.velocity_scale_free:
            return self.posterior
        return self.posterior.condition_on(
            np.eye(self.problem.parametrisation.size)[self.problem.reference_velocity_index]
        )

    @property
    def excess(self) -> float:
        """Excess standard deviation of the levels, dB."""
        return float(np.exp(self.estimate.minima.candidates.level.phi[0, 0]))

    def alternative_interval(self, name: str) -> dict:
        """Interval of a parameter by the other method, in the form of `fit.json`; empty if there is none."""
        return {} if self.alternative is None else self.alternative.entries.get(name, {})


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
    """Infer string and hammer from recordings of one key; the arguments are those of `fit`, which documents them.

    Raises `ParameterError` for an unknown method of intervals. Raises `FitError` if a recording is given twice, is of
    another key or contains only noise, or if no hammer gives a finite sound.
    """
    check_intervals(intervals)
    problem = build_problem(recordings, analyses, setup or Setup(), velocity)
    estimate = map_estimate(problem, seed, progress)
    return InferenceResult(problem, estimate, seed, compute_intervals(problem, estimate, intervals, seed, progress))
