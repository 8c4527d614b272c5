"""Levenberg-Marquardt in a box, from many starts at once.

Each step solves (JᵀJ + λ diag(JᵀJ)) d = -Jᵀr over the coordinates that are free and not pressed against an edge, goes
there, and steps back into the box; λ falls after a step that lowers the cost and rises after one that does not. The
starts share evaluations of residuals and Jacobian and nothing else; one that has settled is evaluated no more.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from .space import Box, K, P, Space

__all__ = ["Descent", "descend", "in_groups"]

FIRST_DAMPING, LEAST_DAMPING, MOST_DAMPING = 1e-2, 1e-12, 1e12
SETTLED = 1e-9


class Descent(NamedTuple):
    """Where the starts ended: search points [starts, 10], costs and whether each settled [starts], and the last J."""

    z: np.ndarray
    cost: np.ndarray
    settled: np.ndarray
    residual: np.ndarray
    jacobian: np.ndarray
    evaluations: int


def descend(
    evaluate: Callable,
    z: np.ndarray,
    space: Space | Box,
    *,
    iterations: int,
    free: np.ndarray | None = None,
    tolerance: float = 1e-9,
) -> Descent:
    """Lower half the sum of squares of `evaluate(z) -> (residuals, Jacobian, ...)` from every row of `z` [starts, 10].

    A start has settled when a step gains less than `tolerance` of its cost. Costs never rise. A point at which the
    residuals are not finite counts as infinitely bad.
    """
    free = space.free if free is None else free & space.free
    held = z.copy()
    z = _into(space, z, held, free)
    residual, jacobian, cost = _evaluate(evaluate, z)
    damping = np.full(len(z), FIRST_DAMPING)
    settled = np.zeros(len(z), bool)
    evaluations = 1
    for _ in range(iterations):
        on = np.flatnonzero(~settled)
        trial = _into(space, _trial(space, z[on], residual[on], jacobian[on], damping[on], free), held[on], free)
        moved, slope, new_cost = _evaluate(evaluate, trial)
        evaluations += 1
        better = new_cost < cost[on]
        gain = np.where(better, cost[on] - np.where(better, new_cost, 0.0), 0.0)
        small = np.abs(trial - z[on]).max(axis=1) < SETTLED
        settled[on] = (better & (gain <= tolerance * cost[on])) | small | (damping[on] >= MOST_DAMPING)
        z[on[better]], residual[on[better]], jacobian[on[better]] = trial[better], moved[better], slope[better]
        cost[on[better]] = new_cost[better]
        damping[on] = np.clip(damping[on] * np.where(better, 0.2, 6.0), LEAST_DAMPING, MOST_DAMPING)
        if settled.all():
            break
    return Descent(z, cost, settled, residual, jacobian, evaluations)


def in_groups(evaluate: Callable, size: int, run: Callable = map) -> Callable:
    """`evaluate` for any number of rows, `size` at a time by `run`, so that one compiled program serves all."""

    def every(z: np.ndarray) -> tuple[np.ndarray, ...]:
        rows = -(-len(z) // size) * size
        padded = np.concatenate([z, np.repeat(z[-1:], rows - len(z), axis=0)])
        parts = run(evaluate, padded.reshape(-1, size, z.shape[1]))
        return tuple(np.concatenate([np.asarray(x) for x in column])[: len(z)] for column in zip(*parts, strict=True))

    return every


def _evaluate(evaluate: Callable, z: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    residual, jacobian = (np.asarray(x) for x in evaluate(z)[:2])
    good = np.all(np.isfinite(residual), axis=1) & np.all(np.isfinite(jacobian), axis=(1, 2))
    cost = np.where(good, 0.5 * (np.where(good[:, None], residual, 0.0) ** 2).sum(axis=1), np.inf)
    return np.nan_to_num(residual), np.nan_to_num(jacobian), cost


def _into(space: Space | Box, z: np.ndarray, held: np.ndarray, free: np.ndarray) -> np.ndarray:
    return space.project(np.where(free, z, held))


def _trial(space: Space | Box, z, residual, jacobian, damping, free) -> np.ndarray:
    """Where the step leads [starts, size], before it is taken back into the box."""
    if isinstance(space, Space):
        return _felt_trial(space, z, residual, jacobian, damping, free)
    pressed = space.pressed(z, -np.einsum("srn,sr->sn", jacobian, residual))
    return z + _step(residual, jacobian, damping, free, pressed)


def _felt_trial(space: Space, z, residual, jacobian, damping, free) -> np.ndarray:
    """`_trial` of a hammer's felt.

    The box holds K_H, the search the force F_ref = K_H u_ref^p. While K_H is pressed against its edge, p moves along
    that edge, d log F_ref = p log u_ref d log p.
    """
    at_edge = space.pressed(z, -np.einsum("srn,sr->sn", jacobian, residual))[:, K] & free[K]
    along = np.where(at_edge, space.values(z)[:, P] * space.log_u, 0.0)
    bent = jacobian.copy()
    bent[:, :, P] += along[:, None] * jacobian[:, :, K]
    pressed = space.pressed(z, -np.einsum("srn,sr->sn", bent, residual))
    pressed[:, K] = at_edge
    step = _step(residual, bent, damping, free, pressed)
    step[:, K] += along * step[:, P]
    trial = z + step
    # Along a curved edge a straight step leaves it: K_H goes back onto it.
    trial[:, K] = np.where(
        at_edge, np.log(space.values(z)[:, K]) + np.exp(trial[:, P].clip(-300, 6)) * space.log_u, trial[:, K]
    )
    return trial


def _step(residual, jacobian, damping, free, pressed) -> np.ndarray:
    active = free & ~pressed
    j = jacobian * active[:, None, :]
    normal = np.einsum("srm,srn->smn", j, j)
    diagonal = np.einsum("snn->sn", normal)
    scale = diagonal + 1e-12 * diagonal.max(axis=1, keepdims=True) + 1e-300
    lhs = normal + np.einsum("sn,nm->snm", damping[:, None] * scale, np.eye(normal.shape[1]))
    lhs += np.einsum("sn,nm->snm", np.where(active, 0.0, 1.0), np.eye(normal.shape[1]))
    rhs = -np.einsum("srn,sr->sn", j, residual)
    return np.where(active, np.linalg.solve(lhs, rhs[..., None])[..., 0], 0.0)
