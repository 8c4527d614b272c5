"""Levenberg-Marquardt in a box, from many starts at once.

Each step solves (JᵀJ + λ diag(JᵀJ)) d = -Jᵀr over the coordinates that are free and on no active edge, goes there, and
steps back into the box; λ falls after a step that lowers the cost and rises after one that does not. The starts share
evaluations of residuals and Jacobian and nothing else; one that has converged is evaluated no more.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

__all__ = ["Box", "Descent", "descend"]

# λ of the first step,
FIRST_DAMPING = 1e-2
# and its range; at its end no step in any direction lowers the cost.
LEAST_DAMPING = 1e-12
MOST_DAMPING = 1e12
# Factors on λ after a step that lowered the cost and after one that did not.
EASIER = 0.2
HARDER = 6.0
# A start has converged when a step moves no coordinate by more than this.
SMALL = 1e-9


class Box(NamedTuple):
    """A box in search coordinates [size]; where its edges meet nothing moves."""

    lower: np.ndarray
    upper: np.ndarray

    def active(self, z: np.ndarray, downhill: np.ndarray) -> np.ndarray:
        """Which coordinates [..., size] sit on an edge that a step `downhill` would leave."""
        return ((z <= self.lower) & (downhill < 0)) | ((z >= self.upper) & (downhill > 0))


class Descent(NamedTuple):
    """Where the starts ended: points [starts, size], costs and whether each converged [starts], and the last J."""

    z: np.ndarray
    cost: np.ndarray
    converged: np.ndarray
    residual: np.ndarray
    jacobian: np.ndarray
    evaluations: int


def descend(evaluate: Callable, z: np.ndarray, box: Box, *, iterations: int, tolerance: float = 1e-9) -> Descent:
    """Lower half the sum of squares of `evaluate(z) -> (residuals, Jacobian)` from every row of `z` [starts, size].

    A start has converged when a step gains less than `tolerance` of its cost. Costs never rise. A point at which the
    residuals are not finite counts as infinitely bad.
    """
    z = np.clip(z, *box)
    residual, jacobian, cost = _evaluate(evaluate, z)
    damping = np.full(len(z), FIRST_DAMPING)
    converged = np.zeros(len(z), bool)
    evaluations = 1
    for _ in range(iterations):
        on = np.flatnonzero(~converged)
        trial = np.clip(z[on] + _step(box, z[on], residual[on], jacobian[on], damping[on]), *box)
        moved, slope, new_cost = _evaluate(evaluate, trial)
        evaluations += 1
        better = new_cost < cost[on]
        gain = np.where(better, cost[on] - np.where(better, new_cost, 0.0), 0.0)
        small = np.abs(trial - z[on]).max(axis=1) < SMALL
        converged[on] = (better & (gain <= tolerance * cost[on])) | small | (damping[on] >= MOST_DAMPING)
        z[on[better]], residual[on[better]], jacobian[on[better]] = trial[better], moved[better], slope[better]
        cost[on[better]] = new_cost[better]
        damping[on] = np.clip(damping[on] * np.where(better, EASIER, HARDER), LEAST_DAMPING, MOST_DAMPING)
        if converged.all():
            break
    return Descent(z, cost, converged, residual, jacobian, evaluations)


def _evaluate(evaluate: Callable, z: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    residual, jacobian = (np.asarray(x) for x in evaluate(z)[:2])
    good = np.all(np.isfinite(residual), axis=1) & np.all(np.isfinite(jacobian), axis=(1, 2))
    cost = np.where(good, 0.5 * (np.where(good[:, None], residual, 0.0) ** 2).sum(axis=1), np.inf)
    return np.nan_to_num(residual), np.nan_to_num(jacobian), cost


def _step(box: Box, z, residual, jacobian, damping) -> np.ndarray:
    """The step [starts, size], before it is taken back into the box."""
    downhill = -np.einsum("srn,sr->sn", jacobian, residual)
    moves = (box.upper > box.lower) & ~box.active(z, downhill)
    j = jacobian * moves[:, None, :]
    normal = np.einsum("srm,srn->smn", j, j)
    diagonal = np.einsum("snn->sn", normal)
    scale = diagonal + 1e-12 * diagonal.max(axis=1, keepdims=True) + 1e-300
    lhs = normal + np.einsum("sn,nm->snm", damping[:, None] * scale, np.eye(normal.shape[1]))
    lhs += np.einsum("sn,nm->snm", np.where(moves, 0.0, 1.0), np.eye(normal.shape[1]))
    rhs = -np.einsum("srn,sr->sn", j, residual)
    return np.where(moves, np.linalg.solve(lhs, rhs[..., None])[..., 0], 0.0)
