"""Band 3, where the paper saw local minima: its landscape, and who finds the way out of it.

The string is held at its truth, so that nothing but the hammer's five parameters is at issue. It is the third step of
the recipe `paper`, criterion and box about the paper's initial values and all; all searches have the same starts: the
paper's own, and others at random in the box.

- Gradient descent with a line search, as in the paper (IV.C.1), and a stronger method that the paper did not have,
  least squares: what traps both is the landscape, not the method.
- Annealing (ASA, as the paper's step 3) from the same starts, each with a seed of its own; and what least squares make
  of where it ended.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.ndimage import minimum_filter

from ...inference.initial_values import starting_values
from ...parameters import FIT_NAMES, STRING_NAMES
from ..annealing import anneal
from ..descent import Descended, LeastSquares, gradient_descent
from ..laboratory import INITIAL
from ..search import pose
from .strokes import Stroke

__all__ = ["WITHIN", "Hammers", "Landscape", "Race", "hammers", "landscape", "race"]

HAMMERS = ("F", "mu", "p", "M_H", "v_H0")  # coordinates, all as logarithms; F: the force at a compression of the stroke
CHAINS = 16
SQUARES = 120  # evaluations by least squares, at most
# A search has succeeded that ends within this factor of the lowest criterion any of them found.
WITHIN = 2.0
# The plane shown, and how far it reaches to either side of the truth, in logarithms.
SEEN = {"F": 1.5, "M_H": 0.85}
PLANE = [HAMMERS.index(name) for name in SEEN]
# Two minima are two if they lie this far apart, in logarithms.
APART = 0.03
# A minimum on an edge of the box, to this, is none.
EDGE = 1e-6


class Hammers(NamedTuple):
    """The problem of one recording."""

    search: LeastSquares
    initial: np.ndarray  # [5]
    true: np.ndarray  # of the laboratory's hammer; mu is the initial one for a relaxing felt, which has none


class Landscape(NamedTuple):
    """The criterion over the two coordinates of `SEEN`, the other three at their truth."""

    first: np.ndarray  # log of the first coordinate over its truth [n]
    second: np.ndarray
    criterion: np.ndarray  # [n, n]
    minima: list[Descended]  # z of two numbers, as `first` and `second`; confirmed by descending from the grid's own


class Race(NamedTuple):
    """Where every start ended, by each method."""

    ends: dict[str, np.ndarray]  # start, gradient, squares, annealed, polished (by squares) -> criteria [starts]
    converged: int  # how many of the gradient's had
    minima: list[Descended]  # distinct ones within the box at which least squares came to rest
    evaluations: dict[str, int]

    @property
    def least(self) -> float:
        """The lowest criterion that any of them found."""
        return float(min(x.min() for method, x in self.ends.items() if method != "start"))

    def reached(self, method: str) -> int:
        """How many of a method's searches ended at the deepest minimum."""
        return int((self.ends[method] <= WITHIN * self.least).sum())


def hammers(stroke: Stroke) -> Hammers:
    """The hammer's problem on one measurement."""
    search = pose(stroke.recording, stroke.analysis, starting_values(stroke.analysis, stroke.setup))
    search.delay = (stroke.recording.onset - stroke.measurement.onset) / stroke.recording.rate
    values = {"mu": float(INITIAL.hammer.mu)} | stroke.measurement.true
    string, true = np.split(search.x(np.array([values[name] for name in FIT_NAMES])), [len(STRING_NAMES)])
    initial = search.x(search.values)[len(STRING_NAMES) :]
    return Hammers(search.hammers(np.append(string, initial)), initial, true)


def landscape(problem: Hammers, points: int) -> Landscape:
    """The criterion on a grid of `points` by `points`."""
    first, second = (np.linspace(-reach, reach, points) for reach in SEEN.values())
    z = np.repeat(problem.true[None], points**2, axis=0)
    z[:, PLANE] += np.stack(np.meshgrid(first, second, indexing="ij"), axis=-1).reshape(-1, 2)
    value = problem.search.costs(z).reshape(points, points)
    # Inner points that lie below all eight around them.
    around = np.array([[True] * 3, [True, False, True], [True] * 3])
    low = value < minimum_filter(value, footprint=around, mode="constant", cval=-np.inf)
    shown = np.isin(np.arange(len(HAMMERS)), PLANE)
    lower, upper = (np.where(shown, edge, problem.true) for edge in (problem.search.lower, problem.search.upper))
    ends = _descended(problem.search._replace(lower=lower, upper=upper), z[low.ravel()])
    minima = _distinct([end._replace(z=(end.z - problem.true)[PLANE]) for end in ends])
    inside = [m for m in minima if abs(m.z[0]) < first[-1] and abs(m.z[1]) < second[-1]]
    return Landscape(first, second, value, inside)


def race(problem: Hammers, starts: int, seed: int, *, iterations: int, evaluations: int) -> Race:
    """All methods from the same starts: `iterations` of the gradient, `evaluations` by each annealing."""
    search, lower, upper = problem.search, problem.search.lower, problem.search.upper
    z = np.random.default_rng(seed).uniform(lower, upper, (starts, len(HAMMERS)))
    z[0] = problem.initial
    down = [gradient_descent(search.slope, row, lower, upper, iterations=iterations) for row in z]
    squares = _descended(search, z)
    hot = [
        anneal(search.costs, lower, upper, chains=CHAINS, evaluations=evaluations, seed=seed + n, start=row)
        for n, row in enumerate(z)
    ]
    polished = _descended(search, np.array([one.z for one in hot]))
    methods = {"gradient": down, "squares": squares, "annealed": hot, "polished": polished}
    ends = {method: np.array([end.cost for end in found]) for method, found in methods.items()}
    inside = [end for end in squares if ((end.z > lower + EDGE) & (end.z < upper - EDGE)).all()]
    return Race(
        {"start": search.costs(z)} | ends, sum(one.converged for one in down),
        _distinct([end for end in inside if np.isfinite(end.cost)]),
        {"gradient": max(one.evaluations for one in down), "annealing": max(one.evaluations for one in hot)},
    )  # fmt: skip


def _descended(search: LeastSquares, z: np.ndarray) -> list[Descended]:
    """Least squares from every row of `z` [n, 5], in the box, to the floor."""
    return [search.finished(row, evaluations=SQUARES) for row in z]


def _distinct(ends: list[Descended]) -> list[Descended]:
    """Those that lie apart, the deepest first."""
    kept: list[Descended] = []
    for end in sorted(ends, key=lambda e: e.cost):
        if all(np.abs(end.z - other.z).max() > APART for other in kept):
            kept.append(end)
    return kept
