"""Two ways down in a box: the paper's gradient, and least squares to the floor of a basin.

The paper's algorithm (IV.C.1) moves by an h with C + ∇C·h <= C. To first order that holds for every step against the
gradient, and promises nothing of the cost itself: too long a step raises it. So each step must lower the cost by a
share of what the slope foretells (Armijo, Pacific J. Math. 16 (1966) 1-3; along the projected gradient after Bertsekas,
IEEE Trans. Autom. Control 21 (1976) 174-184). A step that does not is halved, one that does lets the next be longer.
Coordinates are measured in widths of the box, so that a change of their units changes nothing.

Least squares are SciPy's, a dogleg in the box (Voglis and Lagaris 2004): it lays points on the edges exactly.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import least_squares

__all__ = ["Descended", "LeastSquares", "gradient_descent"]

# The share of the foretold decrease that a step must bring. Below 1/2, so that a parabola's exact minimum is accepted.
SHARE = 0.3
# Factors on the next step after one that did not bring it, and after one that did.
SHORTER = 0.5
LONGER = 1.5
# The first step moves the coordinate with the steepest slope by this much, box widths.
FIRST = 0.01
# A step that moves nothing by more than this is none, box widths.
LEAST = 1e-13


class Descended(NamedTuple):
    """Where a descent ended."""

    z: np.ndarray  # [D]
    cost: float
    converged: bool
    evaluations: int


def gradient_descent(
    value_and_gradient: Callable, z: np.ndarray, lower: np.ndarray, upper: np.ndarray, *, iterations: int,
    tolerance: float = 1e-9,
) -> Descended:  # fmt: skip
    """Lower `value_and_gradient(z [D]) -> (cost, gradient [D])` from `z`, by one evaluation in each iteration.

    Costs never rise, and no point outside `lower` <= z <= `upper` [D] is tried. A point at which cost or gradient is
    not finite counts as infinitely bad; a start on such a point stays there.

    Parameters
    ----------
    lower, upper : finite; where they are equal the coordinate is held.
    tolerance : it has converged when a step of a length that fits the slope gains less than this part of the cost, or
        when no step moves it.
    """
    z, size = np.clip(z, lower, upper), upper - lower
    cost, gradient = _evaluate(value_and_gradient, z)
    step = FIRST * _longest(z, gradient, lower, upper)
    fitted, evaluations = False, 1  # whether a step was once too long, so that its length is the slope's
    for _ in range(iterations):
        trial = np.clip(z - step * size**2 * gradient, lower, upper)
        if not np.isfinite(cost) or (np.abs(trial - z) <= LEAST * size).all():
            return Descended(z, cost, bool(np.isfinite(cost)), evaluations)
        new, slope = _evaluate(value_and_gradient, trial)
        evaluations += 1
        if new < cost and new <= cost - SHARE * float(gradient @ (z - trial)):
            gain, z, cost, gradient = cost - new, trial, new, slope
            if fitted and gain <= tolerance * abs(cost):
                return Descended(z, cost, True, evaluations)
            step *= LONGER
        else:
            fitted = True
            step *= SHORTER
        step = min(step, _longest(z, gradient, lower, upper))
    return Descended(z, cost, False, evaluations)


def _longest(z: np.ndarray, gradient: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> float:
    """Return the step that moves the steepest coordinate through the whole box, those on an edge left out."""
    active = ((z <= lower) & (gradient > 0)) | ((z >= upper) & (gradient < 0))
    steepest = float(np.abs(np.where(active, 0.0, gradient * (upper - lower))).max(initial=0.0))
    return 1.0 / steepest if steepest > 1e-300 else 0.0


def _evaluate(value_and_gradient: Callable, z: np.ndarray) -> tuple[float, np.ndarray]:
    cost, gradient = value_and_gradient(z.copy())
    good = np.isfinite(cost) and np.isfinite(gradient).all()
    return (float(cost), np.asarray(gradient, float)) if good else (np.inf, np.zeros(len(z)))


class LeastSquares(NamedTuple):
    """A cost that is half a sum of squares, of many points at once, in a box."""

    costs: Callable[[np.ndarray], np.ndarray]  # z [n, D] -> [n]
    residuals: Callable[[np.ndarray], tuple[np.ndarray, ...]]  # z [n, D] -> [n, bins] and [n, bins, D]
    lower: np.ndarray  # [D]; where it is `upper` the coordinate is held
    upper: np.ndarray

    def slope(self, z: np.ndarray) -> tuple[float, np.ndarray]:
        """The cost of `z` [D], and its gradient [D]."""
        residual, jacobian = (x[0] for x in self.residuals(z[None]))
        return 0.5 * float(residual @ residual), residual @ jacobian

    def finished(self, z: np.ndarray, *, evaluations: int, tolerance: float = 1e-7) -> Descended:
        """Least squares from one point [D] in the box, to where a step gains less than `tolerance` of the cost.

        A point without finite residuals stays where it is.
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
            return Descended(z, cost, False, 1)
        # A function, too, is what SciPy takes for a Jacobian; its annotation says str.
        slopes: Any = lambda part: at(part.tobytes())[1]  # noqa: E731
        end = least_squares(
            lambda part: at(part.tobytes())[0], z[free], slopes, method="dogbox", x_scale="jac",
            bounds=(self.lower[free], self.upper[free]), ftol=tolerance, max_nfev=evaluations,
        )  # fmt: skip
        z[free] = end.x
        return Descended(z, float(end.cost), bool(end.status > 0), int(end.nfev))
