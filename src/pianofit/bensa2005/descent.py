"""Two local minimisers in a box: the paper's gradient descent, and least squares.

The paper's algorithm (IV.C.1) moves by an h with C + ∇C·h <= C. Every step against the gradient satisfies this to first
order, but a long step can raise the cost. Each step must therefore lower the cost by a share of the predicted decrease
(Armijo, Pacific J. Math. 16 (1966) 1-3; along the projected gradient after Bertsekas, IEEE Trans. Autom. Control 21
(1976) 174-184). After a rejected step the step size is halved, after an accepted one it is increased. Coordinates are
measured in widths of the box, so that the result does not depend on their units.

Least squares use SciPy's dogleg in the box (Voglis and Lagaris 2004), which places points exactly on the edges.
"""

import math
from collections.abc import Callable
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import least_squares

# Share of the predicted decrease that a step must reach. Below 1/2, so that the exact minimum of a parabola passes.
SUFFICIENT_DECREASE = 0.3
# Factors on the step size after a rejected and after an accepted step.
STEP_REDUCTION = 0.5
STEP_GROWTH = 1.5
# The first step moves the coordinate with the steepest slope by this much, box widths.
FIRST = 0.01
# A step that moves every coordinate by at most this does not count as a step, box widths.
LEAST = 1e-13


class DescentResult(NamedTuple):
    """Result of a descent."""

    z: np.ndarray  # [D]
    cost: float
    converged: bool
    evaluations: int


def gradient_descent(
    value_and_gradient: Callable,
    z: np.ndarray,
    lower: np.ndarray,
    upper: np.ndarray,
    *,
    iterations: int,
    tolerance: float = 1e-9,
) -> DescentResult:
    """Minimise `value_and_gradient(z [D]) -> (cost, gradient [D])` from `z`, with one evaluation in each iteration.

    The cost never rises, and every trial point lies in `lower` <= z <= `upper` [D]. A point at which cost or gradient
    is not finite counts as infinitely bad. A start at such a point stays there.

    Parameters
    ----------
    lower, upper : finite. A coordinate is fixed where they are equal.
    tolerance : the descent has converged when an accepted step gains less than this part of the cost, after at least
        one step was rejected. It has also converged when no step moves the point.
    """
    z, size = np.clip(z, lower, upper), upper - lower
    cost, gradient = _evaluate(value_and_gradient, z)
    step = FIRST * _longest(z, gradient, lower, upper)
    limited, evaluations = False, 1  # limited: a step was once too long, so the step size fits the slope
    for _ in range(iterations):
        trial = np.clip(z - step * size**2 * gradient, lower, upper)
        if not np.isfinite(cost) or (np.abs(trial - z) <= LEAST * size).all():
            return DescentResult(z, cost, bool(np.isfinite(cost)), evaluations)
        new, slope = _evaluate(value_and_gradient, trial)
        evaluations += 1
        if new < cost and new <= cost - SUFFICIENT_DECREASE * float(gradient @ (z - trial)):
            gain, z, cost, gradient = cost - new, trial, new, slope
            if limited and gain <= tolerance * abs(cost):
                return DescentResult(z, cost, True, evaluations)
            step *= STEP_GROWTH
        else:
            limited = True
            step *= STEP_REDUCTION
        step = min(step, _longest(z, gradient, lower, upper))
    return DescentResult(z, cost, False, evaluations)


def _longest(z: np.ndarray, gradient: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> float:
    """Return the step size that moves the steepest coordinate, of those not at an active bound, through the box."""
    active = ((z <= lower) & (gradient > 0)) | ((z >= upper) & (gradient < 0))
    steepest = float(np.abs(np.where(active, 0.0, gradient * (upper - lower))).max(initial=0.0))
    return 1.0 / steepest if steepest > 1e-300 else 0.0


def _evaluate(value_and_gradient: Callable, z: np.ndarray) -> tuple[float, np.ndarray]:
    cost, gradient = value_and_gradient(z.copy())
    good = np.isfinite(cost) and np.isfinite(gradient).all()
    return (float(cost), np.asarray(gradient, float)) if good else (np.inf, np.zeros(len(z)))


class LeastSquares(NamedTuple):
    """A cost in a box that is half a sum of squares, for batches of points."""

    costs: Callable[[np.ndarray], np.ndarray]  # z [n, D] -> [n]
    residuals: Callable[[np.ndarray], tuple[np.ndarray, ...]]  # z [n, D] -> [n, bins] and [n, bins, D]
    lower: np.ndarray  # [D]; a coordinate is fixed where it equals `upper`
    upper: np.ndarray

    def value_and_gradient(self, z: np.ndarray) -> tuple[float, np.ndarray]:
        """Return the cost at `z` [D] and its gradient [D]; the cost is infinite where a residual is not finite."""
        residual, jacobian = (x[0] for x in self.residuals(z[None]))
        if not np.isfinite(residual).all():
            return math.inf, np.zeros(len(z))
        return 0.5 * float(residual @ residual), residual @ jacobian

    def minimise(self, z: np.ndarray, *, evaluations: int, tolerance: float = 1e-7) -> DescentResult:
        """Minimise by least squares from one point [D], until a step gains less than `tolerance` of the cost.

        A point without finite residuals is returned unchanged.
        """
        z, free = np.clip(z, self.lower, self.upper), self.upper > self.lower

        @lru_cache(maxsize=2)
        def at(part: bytes) -> tuple[np.ndarray, np.ndarray]:
            whole = z.copy()
            whole[free] = np.frombuffer(part)
            residual, jacobian = self.residuals(whole[None])
            return residual[0], jacobian[0][:, free]

        residual, _ = at(z[free].tobytes())
        cost = 0.5 * float(residual @ residual)
        if not (np.isfinite(cost) and free.any()):
            return DescentResult(z, cost, False, 1)
        # SciPy accepts a function here, but its annotation allows only str.
        slopes: Any = lambda part: at(part.tobytes())[1]  # noqa: E731
        end = least_squares(
            lambda part: at(part.tobytes())[0],
            z[free],
            slopes,
            method="dogbox",
            x_scale="jac",
            bounds=(self.lower[free], self.upper[free]),
            ftol=tolerance,
            max_nfev=evaluations,
        )
        z[free] = end.x
        return DescentResult(z, float(end.cost), bool(end.status > 0), int(end.nfev))
