"""Profile likelihood: one parameter is held, all others follow, and the cost says how far it may go.

A parabola is no picture of a valley that bends, nor of one that the box cuts off. So the parameter is held at one value
after the other, outward from the estimate, each fit starting from the last; the interval ends where the cost has risen
by what the 95 % quantile asks for. With half the sum of squares C, the quantile t and the variances of log θ by the
sandwich, V, and by the curvature alone, V_C, that is

    C(θ) - C_min = (t²/2) V/V_C

(Kent 1982, Biometrika 69, 19-27: a likelihood whose weights are not those of the noise, adjusted for one parameter).
Where the cost is a parabola this is the curvature's interval exactly.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from .levenberg import descend
from .space import NAMES
from .state import pool
from .surface import Surface

__all__ = ["Profile", "profiles"]

# Values on one side, and how near the rise must come to what is asked, as a distance from the estimate.
MOST, NEAR = 24, 0.01
# Of each fit along the way.
ITERATIONS, TOLERANCE = 100, 1e-6
# The longest first step, log, however little the curvature says.
FIRST_STEP = 0.5
# A rise this far above what is asked says nothing of where it would be crossed.
STEEP = 2.0


class Profile(NamedTuple):
    """How far one parameter may go."""

    interval: tuple[float, float]
    open: tuple[str, ...]  # `low`, `high`: ends that are the box's, or as far as was looked
    allowed: float  # rise of the cost at the ends
    points: tuple[tuple[float, float], ...]  # value and rise of the cost, from low to high
    lowest: float  # the least rise met; below 0 the estimate was not the best
    settled: bool  # whether the fits along the way did
    evaluations: int


class _Point(NamedTuple):
    log: float  # log of the value held
    z: np.ndarray  # [size]
    rise: float
    settled: bool
    evaluations: int


def profiles(surface: Surface, which: Sequence[int], quantile: np.ndarray) -> dict[str, Profile]:
    """Profiles of the parameters `which` (places in `NAMES`), by name; both sides of all of them run on all cores.

    `quantile` [size] is how many standard deviations a 95 % interval reaches.
    """
    sides = [(name, side) for name in which for side in (-1.0, 1.0)]
    walks = list(pool().map(lambda job: _walk(surface, job[0], job[1], float(quantile[job[0]])), sides))
    return {NAMES[n]: _joined(walks[2 * i], walks[2 * i + 1]) for i, n in enumerate(which)}


class _Walk(NamedTuple):
    points: list[_Point]
    end: float  # log
    open: bool
    allowed: float


def _walk(surface: Surface, name: int, side: float, quantile: float) -> _Walk:
    """Outward on one side until the rise is more than allowed, then back to where it is just allowed."""
    space, change = surface.space, surface.direction(name)
    allowed = 0.5 * quantile**2 * surface.inflation(name)
    here = float(np.log(surface.values[name]))
    edge = float(np.log((space.lower if side < 0 else space.upper)[name]))
    points = [_Point(here, surface.z, 0.0, True, 0)]
    if side * (edge - here) <= 1e-9:
        return _Walk(points, edge, True, allowed)
    plain = surface.covariances(name)[0]
    variance = change @ plain @ change
    along = plain @ change / variance if variance > 0 else change
    step = 0.5 * np.sqrt(2 * allowed * variance) if variance > 0 else FIRST_STEP
    step = float(np.clip(step, 1e-12, FIRST_STEP))
    while len(points) < MOST and _height(points[-1], allowed) < 1:
        last = points[-1]
        if last.log == edge:
            return _Walk(points, edge, True, allowed)
        if len(points) > 1:
            along, step = _onward(points[-2], last, allowed, step)
        log = edge if side * (edge - last.log) <= step else last.log + side * step
        points.append(_held(surface, name, log, last.z + along * (log - last.log)))
    if _height(points[-1], allowed) < 1:
        return _Walk(points, points[-1].log, True, allowed)
    return _Walk(points, _crossing(surface, name, points, allowed), False, allowed)


def _height(point: _Point, allowed: float) -> float:
    """1 where the rise is just allowed; linear in the distance where the cost is a parabola."""
    return float(np.sqrt(max(point.rise, 0.0) / allowed))


def _onward(before: _Point, last: _Point, allowed: float, step: float) -> tuple[np.ndarray, float]:
    """Where the others are heading, per unit of log, and how far the next step goes: to the crossing if it is near."""
    apart = last.log - before.log
    slope = (_height(last, allowed) - _height(before, allowed)) / abs(apart)
    wanted = 1.02 * (1 - _height(last, allowed)) / slope if slope > 0 else np.inf
    return (last.z - before.z) / apart, float(np.clip(wanted, 0.02 * step, 2.0 * step))


def _held(surface: Surface, name: int, log: float, guess: np.ndarray) -> _Point:
    """The best fit with one parameter held, from `guess` [size]: its box is a point."""
    space, value = surface.space, float(np.exp(log))
    lower, upper = space.lower.copy(), space.upper.copy()
    lower[name] = upper[name] = min(max(value, lower[name]), upper[name])
    held = replace(space, lower=lower, upper=upper)
    end = descend(
        surface.evaluate, held.project(guess[None]), held, iterations=ITERATIONS, tolerance=TOLERANCE,
    )  # fmt: skip
    return _Point(log, end.z[0], float(end.cost[0]) - surface.cost, bool(end.settled[0]), end.evaluations)


def _crossing(surface: Surface, name: int, points: list[_Point], allowed: float) -> float:
    """Log of the value at which the rise is just allowed, between the last two points; the tries join `points`."""
    below, above = points[-2], points[-1]
    start = points[0].log
    while len(points) < MOST:
        low, high = _height(below, allowed), _height(above, allowed)
        if high - 1 <= NEAR or 1 - low <= NEAR or abs(above.log - below.log) <= NEAR * abs(below.log - start):
            break
        share = (1 - low) / (high - low) if high <= STEEP else 0.5
        log = below.log + share * (above.log - below.log)
        point = _held(surface, name, log, below.z + share * (above.z - below.z))
        points.append(point)
        below, above = (point, above) if _height(point, allowed) < 1 else (below, point)
    low, high = _height(below, allowed), _height(above, allowed)
    share = (1 - low) / (high - low) if np.isfinite(high) else 0.0
    return below.log + share * (above.log - below.log)


def _joined(down: _Walk, up: _Walk) -> Profile:
    points = sorted([*down.points, *up.points[1:]], key=lambda point: point.log)
    return Profile(
        (float(np.exp(down.end)), float(np.exp(up.end))),
        tuple(word for word, walk in (("low", down), ("high", up)) if walk.open),
        down.allowed,
        tuple((float(np.exp(p.log)), p.rise) for p in points if np.isfinite(p.rise)),
        min(p.rise for p in points),
        all(p.settled for p in points),
        sum(p.evaluations for p in points),
    )
