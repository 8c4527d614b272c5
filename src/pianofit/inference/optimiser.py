"""Minimisation of an objective by θ, φ and w together: Levenberg-Marquardt in θ, then BFGS in φ and EM in w."""

from dataclasses import replace

import numpy as np

from .objective import FIRST_DAMPING, Candidates, Objective, select

# Lowest damping, where rounding begins,
LEAST_DAMPING = 1e-7
# and highest, where a step is too short to change F measurably.
MOST_DAMPING = 1e6
# Longest step of θ, in the smaller of 1 and the prior's standard deviations.
LONGEST_STEP = 1.5
# A minimum is reached when a step lowers F by less than this, a tenth of a percent of a likelihood.
CONVERGED = 1e-3


def minimise(
    objective: Objective, candidates: Candidates, steps: int, tolerance: float = CONVERGED, sigma_floor: float = 0.0
) -> Candidates:
    """Minimise the objective from every candidate; sort, lowest first.

    Parameters
    ----------
    steps : maximum number of steps.
    tolerance : smallest decrease of F by a step.
    sigma_floor : lowest excess σ of the levels, dB: it smooths the landscape.
    """
    count = len(candidates)
    candidates = replace(
        objective.enter(candidates, sigma_floor),
        damping=np.minimum(candidates.damping, FIRST_DAMPING),
        last_decrease=np.full(count, np.inf),
    )
    for _ in range(steps):
        active = np.flatnonzero(candidates.last_decrease > tolerance)
        if not len(active):
            break
        candidates = candidates.put(active, step(objective, candidates.take(active), sigma_floor))
    return candidates.take(np.argsort(objective.total(candidates), kind="stable"))


def step(objective: Objective, now: Candidates, sigma_floor: float = 0.0) -> Candidates:
    """Step in θ where it lowers the objective, then in φ and w."""
    before = objective.total(now)
    theta = objective.problem.parametrisation.project(now.theta + _direction(objective, now, now.damping)[0])
    trial, valid = objective.move(now, theta)
    better = np.where(valid, objective.total(trial), np.inf) < before
    stuck = ~better & (now.damping >= MOST_DAMPING)
    damping = np.clip(now.damping * np.where(better, 0.2, 8.0), LEAST_DAMPING, 8 * MOST_DAMPING)
    now = objective.step_nuisances(replace(select(better, trial, now), damping=damping), sigma_floor)
    return replace(now, last_decrease=np.where(better | stuck, before - objective.total(now), np.inf))


def predicted_decrease(objective: Objective, candidates: Candidates) -> np.ndarray:
    """Decrease of F that a step of θ predicts from the quadratic approximation [B]."""
    return _direction(objective, candidates, np.zeros(len(candidates)))[1]


def _direction(objective: Objective, now: Candidates, damping: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Steps of θ [B, size] and the decrease of F that they predict [B]; a parameter that would cross a bound stays."""
    u = objective.problem.parametrisation
    gradient, curvature = objective.gradient(now), objective.curvature(now)
    lower, upper = u.bounds_at(now.theta)
    active = ((now.theta <= lower) & (gradient > 0)) | ((now.theta >= upper) & (gradient < 0))
    along = u.bound_jacobian(now.theta, active)
    gradient = (along.mT @ gradient[..., None])[..., 0]
    curvature = along.mT @ curvature @ along
    active |= ((now.theta <= lower) & (gradient > 0)) | ((now.theta >= upper) & (gradient < 0))
    free = objective.free & ~active
    lhs = curvature + (damping[:, None] * np.einsum("bii->bi", curvature))[..., None] * np.eye(u.size)
    lhs = np.where(free[:, :, None] & free[:, None, :], lhs, np.eye(u.size))
    step = np.linalg.solve(lhs, np.where(free, -gradient, 0.0)[..., None])[..., 0]
    size = (np.abs(step) / np.where(u.free, np.minimum(u.sd, 1.0), 1.0)).max(axis=1)
    return step * np.minimum(1.0, LONGEST_STEP / np.maximum(size, 1e-12))[:, None], -0.5 * (gradient * step).sum(1)
