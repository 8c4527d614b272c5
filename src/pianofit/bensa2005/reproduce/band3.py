"""Band 3, in which the paper reports local minima: the criterion over a plane, and a comparison of search methods.

The string is fixed at its true values, so that only the five parameters of the hammer are searched. This is the third
step of the recipe `paper`, with the same criterion and the same box around the paper's initial values. All searches
have the same starts: the paper's own, and others at random in the box.

- Gradient descent with a line search, as in the paper (IV.C.1), and least squares, a stronger method that the paper did
  not use. A local minimum that stops both is a property of the criterion, not of the method.
- Annealing (ASA, as in step 3 of the paper) from the same starts, each with its own seed, and least squares from the
  end of each annealing.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.ndimage import minimum_filter

from ...inference import starting_values
from ...parameters import FIT_NAMES, STRING_NAMES
from ..annealing import anneal
from ..descent import DescentResult, LeastSquares, gradient_descent
from ..laboratory import INITIAL
from ..search import make_search
from .strokes import Stroke

__all__ = [
    "WITHIN", "CriterionPlane", "HammerSearch", "SearchComparison", "criterion_plane", "hammer_search",
    "search_comparison",
]  # fmt: skip

HAMMERS = ("F", "mu", "p", "M_H", "v_H0")  # coordinates, all as logarithms; F: the force at the reference compression
CHAINS = 16
SQUARES = 120  # most evaluations of one least-squares search
# A search succeeds if it ends within this factor of the lowest criterion of all searches.
WITHIN = 2.0
# The plane shown, and its half-widths around the true values, in logarithms.
PLANE_AXES = {"F": 1.5, "M_H": 0.85}
PLANE = [HAMMERS.index(name) for name in PLANE_AXES]
# Distance above which two minima count as different, in logarithms.
APART = 0.03
# A point within this distance of an edge of the box does not count as a minimum.
EDGE = 1e-6


class HammerSearch(NamedTuple):
    """Search for the hammer of one recording."""

    search: LeastSquares
    initial: np.ndarray  # [5]
    true: np.ndarray  # [5]; for a relaxing felt, which has no mu, mu has its initial value


class CriterionPlane(NamedTuple):
    """The criterion over the two coordinates of `PLANE_AXES`, with the other three at their true values."""

    first: np.ndarray  # log of the first coordinate over its true value [n]
    second: np.ndarray
    criterion: np.ndarray  # [n, n]
    minima: list[
        DescentResult
    ]  # z [2] in the units of `first` and `second`; confirmed by least squares from grid minima


class SearchComparison(NamedTuple):
    """Ends of all searches, by method."""

    ends: dict[str, np.ndarray]  # start, gradient, squares, annealed, polished (by squares) -> criteria [starts]
    converged: int  # number of gradient searches that converged
    minima: list[DescentResult]  # different ends of the least squares inside the box
    evaluations: dict[str, int]

    @property
    def least(self) -> float:
        """The lowest criterion of all searches."""
        return float(min(x.min() for method, x in self.ends.items() if method != "start"))

    def successes(self, method: str) -> int:
        """Return the number of searches of a method that ended at the deepest minimum."""
        return int((self.ends[method] <= WITHIN * self.least).sum())


def hammer_search(stroke: Stroke) -> HammerSearch:
    """Return the search for the hammer of one measurement."""
    search = make_search(stroke.recording, stroke.analysis, starting_values(stroke.analysis, stroke.setup))
    search.delay = (stroke.recording.onset - stroke.measurement.onset) / stroke.recording.rate
    values = {"mu": float(INITIAL.hammer.mu)} | stroke.measurement.true
    string, true = np.split(search.x(np.array([values[name] for name in FIT_NAMES])), [len(STRING_NAMES)])
    initial = search.x(search.values)[len(STRING_NAMES) :]
    return HammerSearch(search.hammer_search(np.append(string, initial)), initial, true)


def criterion_plane(problem: HammerSearch, points: int) -> CriterionPlane:
    """Compute the criterion on a grid of `points` by `points`."""
    first, second = (np.linspace(-reach, reach, points) for reach in PLANE_AXES.values())
    z = np.repeat(problem.true[None], points**2, axis=0)
    z[:, PLANE] += np.stack(np.meshgrid(first, second, indexing="ij"), axis=-1).reshape(-1, 2)
    value = problem.search.costs(z).reshape(points, points)
    # Inner points below all eight neighbours.
    neighbours = np.array([[True] * 3, [True, False, True], [True] * 3])
    low = value < minimum_filter(value, footprint=neighbours, mode="constant", cval=-np.inf)
    shown = np.isin(np.arange(len(HAMMERS)), PLANE)
    lower, upper = (np.where(shown, edge, problem.true) for edge in (problem.search.lower, problem.search.upper))
    ends = _descended(problem.search._replace(lower=lower, upper=upper), z[low.ravel()])
    minima = _distinct([end._replace(z=(end.z - problem.true)[PLANE]) for end in ends])
    inside = [m for m in minima if abs(m.z[0]) < first[-1] and abs(m.z[1]) < second[-1]]
    return CriterionPlane(first, second, value, inside)


def search_comparison(
    problem: HammerSearch, starts: int, seed: int, *, iterations: int, evaluations: int
) -> SearchComparison:
    """Run all methods from the same starts: `iterations` of the gradient, `evaluations` in each annealing."""
    search, lower, upper = problem.search, problem.search.lower, problem.search.upper
    z = np.random.default_rng(seed).uniform(lower, upper, (starts, len(HAMMERS)))
    z[0] = problem.initial
    descents = [gradient_descent(search.value_and_gradient, row, lower, upper, iterations=iterations) for row in z]
    squares = _descended(search, z)
    annealings = [
        anneal(search.costs, lower, upper, chains=CHAINS, evaluations=evaluations, seed=seed + n, start=row)
        for n, row in enumerate(z)
    ]
    polished = _descended(search, np.array([end.z for end in annealings]))
    methods = {"gradient": descents, "squares": squares, "annealed": annealings, "polished": polished}
    ends = {method: np.array([end.cost for end in results]) for method, results in methods.items()}
    inside = [end for end in squares if ((end.z > lower + EDGE) & (end.z < upper - EDGE)).all()]
    return SearchComparison(
        {"start": search.costs(z)} | ends, sum(end.converged for end in descents),
        _distinct([end for end in inside if np.isfinite(end.cost)]),
        {"gradient": max(end.evaluations for end in descents),
         "annealing": max(end.evaluations for end in annealings)},
    )  # fmt: skip


def _descended(search: LeastSquares, z: np.ndarray) -> list[DescentResult]:
    """Run least squares in the box from every row of `z` [n, 5]."""
    return [search.minimise(row, evaluations=SQUARES) for row in z]


def _distinct(ends: list[DescentResult]) -> list[DescentResult]:
    """Return the different minima, the deepest first."""
    kept: list[DescentResult] = []
    for end in sorted(ends, key=lambda e: e.cost):
        if all(np.abs(end.z - other.z).max() > APART for other in kept):
            kept.append(end)
    return kept
