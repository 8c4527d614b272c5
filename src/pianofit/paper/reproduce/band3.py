"""Band 3, where the paper saw local minima: its landscape, and who finds the way out of it.

The string is held at its truth, so that nothing but the hammer's five parameters is at issue. All searches see the same
criterion (eq. 19 over partials from the ninth on), the same box about the paper's initial values, and the same starts:
the paper's own, and others at random in the box.

- Gradient descent with a line search, as in the paper (IV.C.1), and a stronger method that the paper did not have,
  least squares (Levenberg-Marquardt): what traps both is the landscape, not the method.
- Annealing (ASA, as the paper's step 3) from the same starts, each with a seed of its own; and what least squares make
  of where it ended.

The felt's stiffness is searched as its force at a reference compression, since K_H and p trade off along equal force.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from ...parameters import Geometry, Hammer
from ..annealing import anneal
from ..gradient import gradient_descent
from ..laboratory.chosen import FINAL, INITIAL
from ..levenberg import Box, descend
from ..spectral import spectral_goal
from ..struck import Cfg, Scene, hammer_costs, hammer_residuals, hold
from .cases import Case

__all__ = ["HAMMERS", "Basin", "Hammers", "Landscape", "Race", "hammers", "landscape", "race"]

HAMMERS = ("F", "mu", "p", "M_H", "v_H0")  # coordinates, all as logarithms; F: the force at the reference compression
REFERENCE = 1e-4  # m
# The box: factors e^± about the paper's initial values.
REACH = np.array([3.0, 2.0, 0.35, 1.0, 0.7])
BATCH = 16
SQUARES = 120  # iterations of least squares, at most
# Of the contact: the rate, Hz, its steps, and rows of the string's table.
RATE, STEPS, MODES = 88_200.0, 1024, 128
SIGMA, BAND = 30.0, 2
# A search has succeeded that ends within this factor of the lowest criterion any of them found.
WITHIN = 2.0
# How far the landscape reaches to either side of the truth, in logarithms.
SEEN = {"F": 1.5, "mu": 1.5, "p": 0.2, "M_H": 0.85, "v_H0": 0.5}
# Two minima are two if they lie this far apart, in logarithms.
APART = 0.03


class Hammers(NamedTuple):
    """The problem of one recording: criteria of hammers z [n, 5], and residuals with their Jacobian."""

    cost: Callable[[np.ndarray], np.ndarray]
    residuals: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]
    lower: np.ndarray
    upper: np.ndarray
    initial: np.ndarray
    true: np.ndarray  # of the laboratory's hammer; mu is the initial one for a relaxing felt, which has none

    def gradient(self, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Criteria [n] and their gradients [n, 5]."""
        residual, jacobian = self.residuals(z)
        return 0.5 * (residual**2).sum(axis=1), np.einsum("nr,nri->ni", residual, jacobian)


class Basin(NamedTuple):
    """A local minimum."""

    z: np.ndarray
    cost: float


class Landscape(NamedTuple):
    """The criterion over two coordinates, the other three at their truth."""

    names: tuple[str, str]
    first: np.ndarray  # log of the first coordinate over its truth [n]
    second: np.ndarray
    criterion: np.ndarray  # [n, n]
    minima: list[Basin]  # z of two numbers, as `first` and `second`; confirmed by descending from the grid's own


class Race(NamedTuple):
    """Where every start [starts] ended, by each method."""

    start: np.ndarray  # criterion at the starts
    gradient: np.ndarray
    converged: np.ndarray  # which of the gradient's had
    squares: np.ndarray  # least squares
    annealed: np.ndarray
    polished: np.ndarray  # annealed, then least squares
    minima: list[Basin]  # distinct ones within the box at which least squares came to rest
    evaluations: dict[str, int]

    @property
    def least(self) -> float:
        """The lowest criterion that any of them found."""
        return float(min(x.min() for x in (self.gradient, self.squares, self.annealed, self.polished)))

    def reached(self, which: str) -> int:
        """How many of a method's searches ended at the deepest minimum."""
        return int((getattr(self, which) <= WITHIN * self.least).sum())


def hammers(case: Case) -> Hammers:
    """The hammer's problem on one measurement."""
    a, recording, geometry = case.analysis, case.recording, FINAL.geometry
    goal = spectral_goal(
        recording.samples[recording.onset :], recording.rate, a.f0, a.B, int(a.partials.number.max()), SIGMA,
        bands=(BAND,), delay=(recording.onset - case.measurement.onset) / recording.rate, unit=case.measurement.scale,
    )  # fmt: skip
    cfg = Cfg(MODES, STEPS, "velocity")
    # The box is in the force; the stiffness itself needs no bounds of its own.
    given: list[Any] = [np.asarray(RATE), np.asarray(np.log(REFERENCE)), np.array([-np.inf, np.inf])]
    scene = Scene(Geometry(*map(np.float64, geometry)), *given)
    initial = _coordinates(INITIAL.hammer._replace(v_H0=case.setup.initial["v_H0"]))
    true = _coordinates(
        FINAL.hammer._replace(v_H0=case.velocity, mu=case.measurement.true.get("mu", INITIAL.hammer.mu))
    )
    whole: Any = np.concatenate([np.log([*FINAL.string]), true])
    held = hold(whole, goal, scene, cfg)

    def cost(z: np.ndarray) -> np.ndarray:
        rows = [np.asarray(hammer_costs(part, held, goal, scene, cfg)[0]) for part in _batches(z)]
        return np.concatenate(rows)[: len(z)]

    def residuals(z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        rows = [hammer_residuals(part, held, goal, scene, cfg) for part in _batches(z)]
        first, second = (np.concatenate([np.asarray(row[k]) for row in rows])[: len(z)] for k in (0, 1))
        return first, second

    return Hammers(cost, residuals, initial - REACH, initial + REACH, initial, true)


def _coordinates(hammer: Hammer) -> np.ndarray:
    z = np.log([*hammer])
    z[0] += hammer.p * np.log(REFERENCE)
    return z


def _batches(z: np.ndarray) -> list[np.ndarray]:
    """Rows of `z` in whole batches, the last filled up with its own last row."""
    full = np.concatenate([z, np.repeat(z[-1:], -len(z) % BATCH, axis=0)])
    return [full[i : i + BATCH] for i in range(0, len(full), BATCH)]


def landscape(problem: Hammers, points: int, names: tuple[str, str] = ("F", "M_H")) -> Landscape:
    """The criterion on a grid of `points` by `points`."""
    i, j = (HAMMERS.index(name) for name in names)
    first, second = (np.linspace(-SEEN[name], SEEN[name], points) for name in names)
    z = np.repeat(problem.true[None], points**2, axis=0)
    z[:, i] += np.repeat(first, points)
    z[:, j] += np.tile(second, points)
    value = problem.cost(z).reshape(points, points)
    ends = _descended(problem, z[_lower_than_neighbours(value).ravel()], (i, j))
    minima = _distinct([Basin((end.z - problem.true)[[i, j]], end.cost) for end in ends])
    inside = [m for m in minima if abs(m.z[0]) < first[-1] and abs(m.z[1]) < second[-1]]
    return Landscape(names, first, second, value, inside)


def _lower_than_neighbours(value: np.ndarray) -> np.ndarray:
    """Which inner points of a grid [n, n] lie below all eight around them."""
    n, m = value.shape
    around = [value[1 + a : n - 1 + a, 1 + b : m - 1 + b] for a in (-1, 0, 1) for b in (-1, 0, 1) if (a, b) != (0, 0)]
    low = np.zeros(value.shape, bool)
    low[1:-1, 1:-1] = value[1:-1, 1:-1] < np.min(around, axis=0)
    return low


def _descended(problem: Hammers, z: np.ndarray, free: tuple[int, ...] = (0, 1, 2, 3, 4)) -> list[Basin]:
    """Least squares from every row of `z` [n, 5] over the coordinates `free`, in the box, to the floor."""
    if not len(z):
        return []
    held = np.isin(np.arange(len(HAMMERS)), free, invert=True)
    box = Box(np.where(held, z[0], problem.lower), np.where(held, z[0], problem.upper))
    end = descend(problem.residuals, z, box, iterations=SQUARES, tolerance=1e-7)
    return [Basin(at, float(cost)) for at, cost in zip(end.z, end.cost, strict=True)]


def _distinct(basins: list[Basin]) -> list[Basin]:
    """Those that lie apart, the deepest first."""
    kept: list[Basin] = []
    for basin in sorted(basins, key=lambda b: b.cost):
        if all(np.abs(basin.z - other.z).max() > APART for other in kept):
            kept.append(basin)
    return kept


def race(problem: Hammers, starts: int, seed: int, *, iterations: int, evaluations: int) -> Race:
    """All methods from the same starts.

    Parameters
    ----------
    iterations : of the gradient descent.
    evaluations : of the criterion, for each annealing.
    """
    random = np.random.default_rng(seed)
    z = problem.lower + (problem.upper - problem.lower) * random.random((starts, len(HAMMERS)))
    z[0] = problem.initial
    down = gradient_descent(problem.gradient, z, problem.lower, problem.upper, iterations=iterations)
    squares = _descended(problem, z)
    hot = [
        anneal(
            problem.cost, problem.lower, problem.upper, chains=BATCH, evaluations=evaluations, seed=seed + n, start=row
        )
        for n, row in enumerate(z)
    ]
    cooled = _descended(problem, np.array([one.z for one in hot]))
    inside = [e for e in squares if ((e.z > problem.lower + 1e-6) & (e.z < problem.upper - 1e-6)).all()]
    return Race(
        start=problem.cost(z),
        gradient=down.cost,
        converged=down.converged,
        squares=np.array([end.cost for end in squares]),
        annealed=np.array([one.cost for one in hot]),
        polished=np.array([end.cost for end in cooled]),
        minima=_distinct([end for end in inside if np.isfinite(end.cost)]),
        evaluations={"gradient": down.evaluations, "annealing": max(one.evaluations for one in hot)},
    )
