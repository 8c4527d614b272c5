"""Two ways down in a box: the paper's gradient, and least squares to the floor of a basin.

The paper's algorithm (IV.C.1) moves by an h with C + ∇C·h <= C. To first order that holds for every step against the
gradient, and promises nothing of the cost itself: too long a step raises it. So each step must lower the cost by a
share of what the slope foretells (Armijo, Pacific J. Math. 16 (1966) 1-3; along the projected gradient after Bertsekas,
IEEE Trans. Autom. Control 21 (1976) 174-184). A step that does not is halved, one that does lets the next be longer.
Coordinates are measured in widths of the box, so that a change of their units changes nothing. The starts share every
evaluation and nothing else.

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
    """Where the starts ended: points [starts, D], their costs, gradients, and whether each has converged [starts]."""

    z: np.ndarray
    cost: np.ndarray
    gradient: np.ndarray  # [starts, D], units of cost per unit of z
    converged: np.ndarray
    evaluations: int  # calls of `value_and_gradient`


def gradient_descent(
    value_and_gradient: Callable, z: np.ndarray, lower: np.ndarray, upper: np.ndarray, *, iterations: int,
    tolerance: float = 1e-9,
) -> Descended:  # fmt: skip
    """Lower `value_and_gradient(z [starts, D]) -> (cost [starts], gradient [starts, D])` from every row of `z`.

    Costs never rise, and no point outside `lower` <= z <= `upper` [D] is tried. Every iteration evaluates one trial
    point for each start. A point at which cost or gradient is not finite counts as infinitely bad; a start on such a
    point stays there.

    Parameters
    ----------
    lower, upper : finite; where they are equal the coordinate is held.
    tolerance : a start has converged when a step of a length that fits the slope gains less than this part of its cost,
        or when no step moves it.
    """
    z, size = np.clip(z, lower, upper), upper - lower
    cost, gradient = _evaluate(value_and_gradient, z)
    step = FIRST * _longest(z, gradient, lower, upper)
    fitted = np.zeros(len(z), bool)  # whether a step was once too long, so that its length is the slope's
    converged, evaluations = np.zeros(len(z), bool), 1
    for _ in range(iterations):
        trial = np.clip(z - step[:, None] * size**2 * gradient, lower, upper)
        converged |= np.isfinite(cost) & (np.abs(trial - z) <= LEAST * size).all(axis=1)
        if (converged | ~np.isfinite(cost)).all():
            break
        trial = np.where(converged[:, None], z, trial)
        new_cost, new_gradient = _evaluate(value_and_gradient, trial)
        evaluations += 1
        foretold = -np.einsum("sn,sn->s", gradient, trial - z)
        better = (new_cost < cost) & (new_cost <= cost - SHARE * foretold) & ~converged
        gain = np.where(better, cost, 0.0) - np.where(better, new_cost, 0.0)
        fitted |= ~better
        z = np.where(better[:, None], trial, z)
        gradient = np.where(better[:, None], new_gradient, gradient)
        cost = np.where(better, new_cost, cost)
        step = np.minimum(step * np.where(better, LONGER, SHORTER), _longest(z, gradient, lower, upper))
        converged |= fitted & better & (gain <= tolerance * np.abs(cost))
    return Descended(z, cost, gradient, converged, evaluations)


def _longest(z: np.ndarray, gradient: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
    """Return the step [starts] that moves the steepest coordinate through the whole box, those on an edge left out."""
    active = ((z <= lower) & (gradient > 0)) | ((z >= upper) & (gradient < 0))
    steepest = np.abs(np.where(active, 0.0, gradient * (upper - lower))).max(axis=1, initial=0.0)
    return np.divide(1.0, steepest, out=np.zeros_like(steepest), where=steepest > 1e-300)


def _evaluate(value_and_gradient: Callable, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    cost, gradient = (np.asarray(x, float) for x in value_and_gradient(z.copy()))
    good = np.isfinite(cost) & np.isfinite(gradient).all(axis=1)
    return np.where(good, cost, np.inf), np.where(good[:, None], gradient, 0.0)


class LeastSquares(NamedTuple):
    """A cost that is half a sum of squares, of many points at once."""

    costs: Callable[[np.ndarray], np.ndarray]  # z [n, D] -> [n]
    residuals: Callable[[np.ndarray], tuple[np.ndarray, ...]]  # z [n, D] -> [n, bins] and [n, bins, D]

    def slopes(self, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Costs [n] and their gradients [n, D], of z [n, D]."""
        residual, jacobian = self.residuals(z)
        return 0.5 * (residual**2).sum(axis=1), np.einsum("nr,nri->ni", residual, jacobian)

    def finished(
        self, z: np.ndarray, lower: np.ndarray, upper: np.ndarray, *, evaluations: int, tolerance: float = 1e-7
    ) -> Descended:
        """Least squares from one point [D] in the box, to where a step gains less than `tolerance` of the cost.

        A point without finite residuals stays where it is.
        """
        z, free = np.clip(z, lower, upper), upper > lower

        @lru_cache(maxsize=2)
        def at(part: bytes) -> tuple[np.ndarray, np.ndarray]:
            whole = z.copy()
            whole[free] = np.frombuffer(part)
            residual, jacobian = self.residuals(whole[None])
            return residual[0], jacobian[0][:, free]

        residual, _ = at(z[free].tobytes())
        cost, converged, count = 0.5 * float(residual @ residual), False, 1
        if np.isfinite(cost) and free.any():
            # A function, too, is what SciPy takes for a Jacobian; its annotation says str.
            slopes: Any = lambda part: at(part.tobytes())[1]  # noqa: E731
            end = least_squares(
                lambda part: at(part.tobytes())[0], z[free], slopes, method="dogbox", x_scale="jac",
                bounds=(lower[free], upper[free]), ftol=tolerance, max_nfev=evaluations,
            )  # fmt: skip
            z[free], cost, converged, count = end.x, float(end.cost), bool(end.status > 0), int(end.nfev)
        return Descended(z[None], np.array([cost]), np.zeros((1, len(z))), np.array([converged]), count)
