"""Single steps of a search on eq. 19: down the gradient with σ falling, or by annealing over hammers.

How far a step looks to either side of a point `x` [9] (`problem`) is counted in widths of the lines that rule the
criterion for the string, and in spreads of the literature's hammers for the hammer; the gradient takes its scale from
that.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from ..criterion import band_of
from ..errors import FitError
from ..felt import DEFAULT_LAW
from ..inference.priors import HAMMER_SPREAD
from ..parameters import FIT_NAMES, HAMMER_NAMES, STRING_NAMES
from .annealing import anneal
from .gradient import gradient_descent
from .levenberg import Box, descend
from .problem import LINEAR, Problem, logs
from .spectral import Goal
from .struck import Held, Scene, hammer_costs, hammer_residuals, hold, struck_gradients

__all__ = ["ALL", "Search"]

ALL = (0, 1, 2)
# Overlap of the spectra of two lines that lie one linewidth apart.
MEETING = 0.8
# Widths of a line to either side.
LINES = 10.0
# Spreads of the literature's hammers to either side.
SPREADS = 2.5
# Steps of the gradient at one σ,
ITERATIONS = 60
# and where it ends a search.
LAST_ITERATIONS = 400
TOLERANCE = 1e-7
CHAINS = 32
STRING = len(STRING_NAMES)
# Of the logarithm of v_H0 no more is said.
SPREAD = HAMMER_SPREAD | {n: p.deviation for n, p in DEFAULT_LAW.parameters.items()} | {"v_H0": 1.0}
HAMMER_REACH = np.array([SPREADS * SPREAD[n] if n in HAMMER_NAMES else 0.0 for n in FIT_NAMES])
NO_HAMMER = "no hammer within the bounds gives a finite sound; widen [bounds] or check [known] in the setup"


@dataclass
class Search:
    """What the steps of one search share, and what they have cost so far."""

    problem: Problem
    evaluations: int = 0
    converged: bool = True

    def down(self, x: np.ndarray, names: Sequence[str], bands: Sequence[int]) -> np.ndarray:
        """Down the gradient of eq. 19 on some bands with σ falling; only `names` move.

        It begins at the finest σ at which the model's lines still meet the recording's. Wider ones meet from afar, but
        while the hammer is wrong they bend the string to excuse it, farther than narrow ones find back.
        """
        goals = [self.problem.goal(bands, sigma) for sigma in self.problem.sigmas]
        apart = [i for i, goal in enumerate(goals) if self._overlap(x, goal) < MEETING]
        first = min(apart, default=len(goals))
        for goal in goals[max(first - 1, 0) :]:
            x = self._string_down(x, names, bands, goal)
        return x

    def finely_down(self, x: np.ndarray, names: Sequence[str], bands: Sequence[int]) -> np.ndarray:
        """The same at the finest σ alone."""
        return self._string_down(x, names, bands, self.problem.goal(bands, self.problem.sigmas[-1]))

    def hammer_down(self, x: np.ndarray) -> np.ndarray:
        """The hammer alone, down the gradient of eq. 19 in its band."""
        held, goal, scene = self._held(x)

        def function(z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            residual, jacobian = hammer_residuals(z[:, STRING:], held, goal, scene, self.problem.cfg)
            gradient = np.einsum("sr,srn->sn", residual, jacobian)
            return 0.5 * (np.asarray(residual) ** 2).sum(axis=1), np.pad(gradient, ((0, 0), (STRING, 0)))

        box = self.problem.box(x, HAMMER_REACH, HAMMER_NAMES)
        return self._descended(function, x, box, LAST_ITERATIONS)

    def hammer_finished(self, x: np.ndarray) -> np.ndarray:
        """The hammer alone, to the floor of its basin, by least squares on the same criterion."""
        held, goal, scene = self._held(x)
        lower, upper = self.problem.box(x, HAMMER_REACH, HAMMER_NAMES)
        end = descend(
            lambda z: hammer_residuals(z, held, goal, scene, self.problem.cfg), x[None, STRING:],
            Box(lower[STRING:], upper[STRING:]), iterations=ITERATIONS, tolerance=TOLERANCE,
        )  # fmt: skip
        self.evaluations += end.evaluations
        self.converged = bool(end.converged[0])
        return np.append(x[:STRING], end.z[0])

    def annealed(self, x: np.ndarray, evaluations: int, seed: int) -> np.ndarray:
        """The hammer alone, by annealing on eq. 19 in its band, starting from `x` and from points all over the box.

        Raises
        ------
        FitError
            If no hammer has a finite criterion.
        """
        held, goal, scene = self._held(x)
        lower, upper = self.problem.box(x, HAMMER_REACH, HAMMER_NAMES)
        found = anneal(
            lambda z: hammer_costs(z, held, goal, scene, self.problem.cfg)[0], lower[STRING:],
            upper[STRING:], chains=CHAINS, evaluations=evaluations, seed=seed, start=x[STRING:],
        )  # fmt: skip
        self.evaluations += found.evaluations
        if not np.isfinite(found.cost):
            raise FitError(NO_HAMMER)
        return np.append(x[:STRING], found.z)

    def _held(self, x: np.ndarray) -> tuple[Held, Goal, Scene]:
        """The string of `x`, with the goal of the hammer's band."""
        problem = self.problem
        goal, scene = problem.goal((problem.band(2),), problem.sigma), problem.scene()
        return hold(logs(x), goal, scene, problem.cfg), goal, scene

    def _overlap(self, x: np.ndarray, goal: Goal) -> float:
        """∫ |Y|² |S|² dω over the root of ∫ |Y|⁴ dω ∫ |S|⁴ dω: eq. 19 with the best gain is 1 less its square."""
        free, problem = goal._replace(calibrated=np.zeros_like(goal.calibrated)), self.problem
        cost = float(struck_gradients(logs(x)[None], free, problem.scene(), problem.cfg)[0][0])
        return max(1 - cost, 0.0) ** 0.5

    def _reach(self, x: np.ndarray, goal: Goal, bands: Sequence[int]) -> np.ndarray:
        """How far to look [9]: what moves the lines, each with its share in eq. 19, by some of their widths."""
        c, kappa, b1, b2, *_ = self.problem.natural(x)
        k = np.arange(1, self.problem.last + 1)
        k = k[np.isin(band_of(k), bands)]
        beta2 = (k * np.pi / self.problem.start.geometry.length) ** 2
        omega = np.sqrt(c**2 * beta2 + kappa**2 * beta2**2)
        width = float(goal.sigma) + b1 + b2 * beta2
        share = np.asarray((goal.weight * goal.energy) ** 2).sum(axis=1)[: len(k)]
        moved = np.stack([c**2 * beta2 / omega, kappa**2 * beta2**2 / omega, np.ones(len(k)), beta2]) / width
        return HAMMER_REACH + np.append(LINES / np.sqrt((share * moved**2).sum(axis=1)), np.zeros(len(HAMMER_NAMES)))

    def _string_down(self, x: np.ndarray, names: Sequence[str], bands: Sequence[int], goal: Goal) -> np.ndarray:
        scene, box = self.problem.scene(), self.problem.box(x, self._reach(x, goal, bands), names)
        return self._descended(lambda z: struck_gradients(z, goal, scene, self.problem.cfg), x, box, ITERATIONS)

    def _descended(self, function: Callable, x: np.ndarray, box: tuple, iterations: int) -> np.ndarray:
        """Down the gradient of `function(z [1, 9])`, which knows logarithms only."""

        def by_point(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            cost, slope = (np.asarray(a) for a in function(logs(points)))
            return cost, slope / np.where(LINEAR, points, 1.0)

        end = gradient_descent(by_point, x[None], *box, iterations=iterations, tolerance=TOLERANCE)
        self.evaluations += end.evaluations
        self.converged = bool(end.converged[0])
        return end.z[0]
