"""Profiles of F: one parameter is held, everything else follows, and F says how far it may go.

A parabola is no picture of a valley that bends, nor of one that the box cuts off. So a parameter is held at one value
after the other, outward from the best minimum, and F is minimised over all others: θ, φ and w. The 95 % interval ends
where F has risen by 1.96²/2; where F is a parabola in θ, this is Laplace's.

Laplace's approximation integrates φ and w by a parabola about the minimum, a profile minimises over them: it follows
the heavy tails of Student's t and an excess that grows with the misfit, but has not the volume of what it minimises
over. Where φ itself is hardly known both are narrower than the posterior. A profile keeps to the valley of the best
minimum, and its contact's step error to that minimum's.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from ..conversions import NORMAL
from .intervals import IntervalResult, reported_parameters, unbounded_warnings
from .map_estimate import Estimate
from .optimiser import Optimiser
from .problem import FitProblem

__all__ = ["DELTA_NLL_95", "profiles"]

# Of F, at the ends of a 95 % interval: half the square of the normal's quantile.
DELTA_NLL_95 = NORMAL**2 / 2
# Walks at a time: a step of one is mostly a single program on a single core.
WALKERS = 4
# Values on one side.
MOST = 24
# √(rise) this near to what is asked, as a share, is near enough to find the end by a secant.
NEAR = 0.03
# Of each minimisation: steps, and the least gain of F by a step; a hundredth of this is lost on an end.
ITERATIONS, TOLERANCE = 60, 1e-4
# The first step, log, of what Laplace's approximation knows nothing of because it is at a bound.
FIRST_STEP = 0.5
# √(rise) this far above what is asked tells nothing of where it is crossed.
STEEP = 2.0
# F this much lower than the fit's is another minimum.
LOWER = 0.5


class _Point(NamedTuple):
    log: float  # of the value held
    x: np.ndarray  # logarithms of all values [size]
    phi: tuple[np.ndarray, ...]  # of every table [1, 4]
    w: tuple[np.ndarray, ...]  # likewise [1, R, K]
    F: float


class _ProfileBranch(NamedTuple):
    points: list[_Point]  # outward from the minimum
    end: float  # log
    open: bool  # at the box, or as far as was looked


def profiles(problem: FitProblem, found: Estimate) -> IntervalResult:
    """Intervals of what is shared and free, and of the reference stroke's velocity, by profiles of F."""
    names = reported_parameters(problem)
    profile = _Profile(problem, found)
    jobs = [(i, side) for i in names.values() for side in (-1.0, 1.0)]
    # Threads of their own: a walk waits for programs in `lanes.pool`, in which it must not itself stand.
    with ThreadPoolExecutor(WALKERS) as threads:
        walks = list(threads.map(lambda job: profile.trace_branch(*job), jobs))
    entries, told = {}, {}
    lower = dict.fromkeys(names, 0.0)
    for (name, i), low, high in zip(names.items(), walks[::2], walks[1::2], strict=True):
        ends = np.clip(np.exp([low.end, high.end]), *np.exp(problem.unknowns.range(i)))
        sides = [word for word, walk in (("low", low), ("high", high)) if walk.open]
        entries[name] = {"interval": ends.tolist(), "interval_by": "profile", "interval_open": sides}
        points = sorted([*low.points, *high.points[1:]], key=lambda point: point.log)
        rises = [[float(np.exp(p.log)), p.F - profile.start.F] for p in points if np.isfinite(p.F)]
        told[name] = {"points": rises, "evaluations": len(points)}
        lower[name] = float(found.minima.F.min()) - min(p.F for p in points)
    return IntervalResult("profile", entries, (*_messages(lower), *unbounded_warnings(entries)), {"profile": told})


def _messages(lower: dict[str, float]) -> list[str]:
    names = [name for name, by in lower.items() if by > LOWER]
    said = (
        f"The profile of {', '.join(names)} found F lower by {max(lower.values()):.2g} than the fit: the search had "
        "not found the lowest minimum, and another seed may."
    )
    return [said] * bool(names)


class _Profile:
    """F about the best minimum with one value held."""

    def __init__(self, problem: FitProblem, found: Estimate) -> None:
        self.problem, self.unknowns = problem, problem.unknowns
        self.mean, self.covariance = found.posterior.mean[0], found.posterior.covariance[0]
        best = found.minima.people.take(np.array([0]))
        self.offset = best.offset
        at = _Point(0.0, self.mean, best.phi, best.w, float(found.minima.F[0]))
        # As far down as along the way: else a rise would hold what the search left.
        self.start = self._lowest(problem, at)

    def _lowest(self, problem: FitProblem, near: _Point) -> _Point:
        """The minimum of F with the unknowns of `problem`, from `near`; infinite if a contact does not end there."""
        u = problem.unknowns
        z = u.project(u.from_log_values(near.x))
        search = Optimiser(problem)
        begun = search.initialise(z[None], near.phi, near.w, self.offset)
        if not len(begun):
            return near._replace(F=np.inf)
        one = search.minimise(begun, 0.0, ITERATIONS, TOLERANCE)
        return _Point(near.log, u.log_values(one.theta[0]), one.phi, one.w, float(search.total(one)[0]))

    def _held(self, i: int, log: float, near: _Point, x: np.ndarray) -> _Point:
        """The minimum with value `i` held, from `x` [size] and the nuisances of `near`."""
        unknowns = self.unknowns.fix_parameter(i, log)
        x = x.copy()
        x[i] = log
        return self._lowest(replace(self.problem, unknowns=unknowns), near._replace(log=log, x=x))

    def normalised_rise(self, point: _Point) -> float:
        """1 where the rise is what is asked; linear in the distance where F is a parabola."""
        return float(np.sqrt(max(point.F - self.start.F, 0.0) / DELTA_NLL_95))

    def trace_branch(self, i: int, side: float) -> _ProfileBranch:
        """Outward on one side until F has risen more than asked, then back to where it is just that."""
        here, edge = float(self.start.x[i]), self.unknowns.range(i)[int(side > 0)]
        points = [self.start._replace(log=here)]
        variance = self.covariance[i, i]
        along = self.covariance[i] / variance if variance > 0 else np.eye(len(self.mean))[i]
        step = min(0.5 * np.sqrt(2 * DELTA_NLL_95 * variance), FIRST_STEP) if variance > 0 else FIRST_STEP
        while len(points) < MOST and self.normalised_rise(points[-1]) < 1 - NEAR:
            last = points[-1]
            if side * (edge - last.log) <= 1e-9:
                return _ProfileBranch(points, edge, True)
            if len(points) > 1:
                along, step = self._extrapolate(points[-2], last, step)
            log = last.log + side * min(step, side * (edge - last.log))
            points.append(self._held(i, log, last, last.x + along * (log - last.log)))
        if self.normalised_rise(points[-1]) < 1 - NEAR:
            return _ProfileBranch(points, points[-1].log, True)
        return self._crossing(i, points)

    def _extrapolate(self, before: _Point, last: _Point, step: float) -> tuple[np.ndarray, float]:
        """Where the others are heading, per unit of log, and how far to go: to the crossing if it is near."""
        apart = last.log - before.log
        slope = (self.normalised_rise(last) - self.normalised_rise(before)) / abs(apart)
        wanted = (1 - self.normalised_rise(last)) / slope if slope > 0 else np.inf
        return (last.x - before.x) / apart, float(np.clip(wanted, 0.02 * step, 2.0 * step))

    def _crossing(self, i: int, points: list[_Point]) -> _ProfileBranch:
        """Where the rise is just asked: by secants between the last two points, whose tries join the others."""
        below, above = points[-2:]
        while True:
            low, high = self.normalised_rise(below), self.normalised_rise(above)
            share = (1 - low) / (high - low) if np.isfinite(high) else 0.0
            if high - 1 <= NEAR or 1 - low <= NEAR or len(points) >= MOST:
                return _ProfileBranch(points, below.log + share * (above.log - below.log), False)
            share = share if high <= STEEP else 0.5
            log = below.log + share * (above.log - below.log)
            points.append(self._held(i, log, below, below.x + share * (above.x - below.x)))
            below, above = (points[-1], above) if self.normalised_rise(points[-1]) < 1 else (below, points[-1])
