"""Profiles of F: fix one parameter, minimise over all others, and follow the rise of F.

A quadratic approximation does not describe a curved ridge, nor one that a bound cuts off. Therefore a parameter is
fixed at one value after the other, outward from the best minimum, and F is minimised over all others: θ, φ and w. The
95 % interval ends where F has risen by 1.96²/2. Where F is quadratic in θ, this is Laplace's interval.

Laplace's approximation integrates φ and w with a quadratic at the minimum, but a profile minimises over them. A profile
follows the heavy tails of Student's t, and an excess that grows with the misfit. It does not include the volume of the
minimised parameters. With few data for φ, both intervals are narrower than the posterior. A profile follows the best
minimum only, and uses the discretisation error of the contact at that minimum.
"""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from ..conversions import HALF_WIDTH_95
from .laplace import Estimate, Interval, IntervalResult, unbounded_warnings
from .objective import Objective
from .optimiser import minimise
from .problem import FitProblem

# Rise of F at the ends of a 95 % interval: half the square of the normal's quantile.
DELTA_NLL_95 = HALF_WIDTH_95**2 / 2
# Branches at a time: a step of one is mostly a single program on a single core.
WORKERS = 4
# Maximum number of values on one side.
MOST = 24
# Relative tolerance of √(rise) at which a secant determines the end.
NEAR = 0.03
# Steps of each minimisation, and its smallest decrease of F: a hundredth of this is lost at an end.
ITERATIONS, TOLERANCE = 60, 1e-4
# First step, log, of a parameter at a bound, which has no standard deviation by Laplace's approximation.
FIRST_STEP = 0.5


class _Point(NamedTuple):
    log: float  # of the fixed value
    logs: np.ndarray  # logarithms of all values [size]
    phi: tuple[np.ndarray, ...]  # of every table [1, 5]
    w: tuple[np.ndarray, ...]  # of every table [1, R, K]
    F: float


class _ProfileBranch(NamedTuple):
    points: list[_Point]  # outward from the minimum
    end: float  # log
    open: bool  # True if it ends at a bound or after the maximum number of values


def profiles(problem: FitProblem, estimate: Estimate) -> IntervalResult:
    """Intervals of the free shared parameters and of the reference stroke's velocity, by profiles of F."""
    names = problem.reported_parameters
    profile = _Profile(problem, estimate)
    jobs = [(i, side) for i in names.values() for side in (-1.0, 1.0)]
    # Separate threads: a branch waits for programs in `batched_model.thread_pool`, so it must not occupy that pool.
    with ThreadPoolExecutor(WORKERS) as threads:
        branches = list(threads.map(lambda job: profile.trace_branch(*job), jobs))
    intervals, diagnostics, lower = {}, {}, {}
    for (name, i), low, high in zip(names.items(), branches[::2], branches[1::2], strict=True):
        first, last = np.clip(np.exp([low.end, high.end]), *np.exp(problem.parametrisation.range(i))).tolist()
        sides = tuple(word for word, branch in (("low", low), ("high", high)) if branch.open)
        intervals[name] = Interval(first, last, "profile", sides)
        points = sorted([*low.points, *high.points[1:]], key=lambda point: point.log)
        rises = [[float(np.exp(p.log)), p.F - profile.start.F] for p in points if np.isfinite(p.F)]
        diagnostics[name] = {"points": rises, "evaluations": len(points)}
        lower[name] = float(estimate.minima.nll.min()) - min(p.F for p in points)
    messages = (*_messages(lower), *unbounded_warnings(intervals))
    return IntervalResult("profile", intervals, messages, {"profile": diagnostics})


def _messages(lower: dict[str, float]) -> list[str]:
    names = [name for name, by in lower.items() if by > 0.5]  # or else it is the same minimum
    if not names:
        return []
    return [
        f"The profile of {', '.join(names)} found F lower by {max(lower.values()):.2g} than the fit: the search missed "
        "the lowest minimum. Try another seed."
    ]


class _Profile:
    """F about the best minimum with one value fixed."""

    def __init__(self, problem: FitProblem, estimate: Estimate) -> None:
        self.problem, self.unknowns = problem, problem.parametrisation
        self.mean, self.covariance = estimate.posterior.mean[0], estimate.posterior.covariance[0]
        best = estimate.minima.candidates.take(np.array([0]))
        self.offset = best.offset
        at = _Point(0.0, self.mean, best.phi, best.w, float(estimate.minima.nll[0]))
        # Minimised as accurately as the branches, or a rise would contain what the search left.
        self.start = self._minimised(problem, at)

    def _minimised(self, problem: FitProblem, near: _Point) -> _Point:
        """The minimum of F by the parameters of `problem`, from `near`; infinite if a contact does not end there."""
        u, objective = problem.parametrisation, Objective.complete(problem)
        theta = u.project(u.from_log_values(near.logs))
        candidate = objective.start(theta[None], near.phi, near.w, self.offset)
        if not len(candidate):
            return near._replace(F=np.inf)
        end = minimise(objective, candidate, ITERATIONS, TOLERANCE)
        return _Point(near.log, u.log_values(end.theta[0]), end.phi, end.w, float(objective.total(end)[0]))

    def _fixed(self, i: int, log: float, near: _Point, logs: np.ndarray) -> _Point:
        """The minimum with value `i` fixed, from `logs` [size] and the nuisances of `near`."""
        unknowns = self.unknowns.fix_parameter(i, log)
        logs = logs.copy()
        logs[i] = log
        return self._minimised(replace(self.problem, parametrisation=unknowns), near._replace(log=log, logs=logs))

    def normalised_rise(self, point: _Point) -> float:
        """√(rise/target): 1 at the interval's end, linear in the distance where F is quadratic."""
        return float(np.sqrt(max(point.F - self.start.F, 0.0) / DELTA_NLL_95))

    def trace_branch(self, i: int, side: float) -> _ProfileBranch:
        """Go outward on one side until F has risen beyond the target, then interpolate the crossing."""
        first, bound = float(self.start.logs[i]), self.unknowns.range(i)[int(side > 0)]
        points = [self.start._replace(log=first)]
        variance = self.covariance[i, i]
        along = self.covariance[i] / variance if variance > 0 else np.eye(len(self.mean))[i]
        step = min(0.5 * np.sqrt(2 * DELTA_NLL_95 * variance), FIRST_STEP) if variance > 0 else FIRST_STEP
        while len(points) < MOST and self.normalised_rise(points[-1]) < 1 - NEAR:
            last = points[-1]
            if side * (bound - last.log) <= 1e-9:
                return _ProfileBranch(points, bound, True)
            if len(points) > 1:
                along, step = self._extrapolate(points[-2], last, step)
            log = last.log + side * min(step, side * (bound - last.log))
            points.append(self._fixed(i, log, last, last.logs + along * (log - last.log)))
        if self.normalised_rise(points[-1]) < 1 - NEAR:
            return _ProfileBranch(points, points[-1].log, True)
        return self._crossing(i, points)

    def _extrapolate(self, before: _Point, last: _Point, step: float) -> tuple[np.ndarray, float]:
        """Direction of the other parameters per unit of log, and the next step: to the crossing if it is near."""
        distance = last.log - before.log
        slope = (self.normalised_rise(last) - self.normalised_rise(before)) / abs(distance)
        needed = (1 - self.normalised_rise(last)) / slope if slope > 0 else np.inf
        return (last.logs - before.logs) / distance, float(np.clip(needed, 0.02 * step, 2.0 * step))

    def _crossing(self, i: int, points: list[_Point]) -> _ProfileBranch:
        """Locate the crossing by secants between the last two points; trial points join the others."""
        below, above = points[-2:]
        while True:
            low, high = self.normalised_rise(below), self.normalised_rise(above)
            fraction = (1 - low) / (high - low) if np.isfinite(high) else 0.0
            if high - 1 <= NEAR or 1 - low <= NEAR or len(points) >= MOST:
                return _ProfileBranch(points, below.log + fraction * (above.log - below.log), False)
            fraction = fraction if high <= 2.0 else 0.5  # far above the target, a secant does not locate the crossing
            log = below.log + fraction * (above.log - below.log)
            points.append(self._fixed(i, log, below, below.logs + fraction * (above.logs - below.logs)))
            below, above = (points[-1], above) if self.normalised_rise(points[-1]) < 1 else (below, points[-1])
