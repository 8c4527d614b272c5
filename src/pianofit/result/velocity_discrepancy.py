"""The velocity discrepancy: smooth deviations of partial levels over log velocity, estimated as random walks.

Strokes of similar velocity deviate from the hammer model in similar ways. The deviation of a partial is a random walk
over log velocity, plus independent scatter of each stroke. Step size and scatter are common to all partials of a key
and are integrated over. Differences that the strokes do not resolve shrink to zero. The posterior mean is linear
between strokes and constant beyond them.
"""

from __future__ import annotations

import numpy as np

__all__ = ["UNINFORMATIVE_ERROR", "stroke_deviations", "smooth_random_walk"]

# Grid of standard deviations, relative (0.1 to 9 dB), for the walk over an e-fold of velocity and for the scatter of a
# stroke. The prior is uniform in the logarithm.
GRID = np.geomspace(0.01, 1.0, 9)
# Standard error of an observation without information.
UNINFORMATIVE_ERROR = 1e3


def smooth_random_walk(observed: np.ndarray, error: np.ndarray, velocity: np.ndarray) -> np.ndarray:
    """Posterior mean of random walks over log velocity, with unknown start [strokes, walks].

    Parameters
    ----------
    observed, error : values and their standard errors [strokes, walks]. A common scatter is added to the errors.
    velocity : velocities of the strokes, m/s, increasing.
    """
    log_velocity, y = np.log(velocity / velocity[0]), observed.T
    step, scatter = (x.ravel()[:, None, None, None] for x in np.meshgrid(GRID, GRID))
    walk = step**2 * np.minimum.outer(log_velocity, log_velocity)  # [grid, 1, strokes, strokes]
    noise = scatter[..., 0] ** 2 + error.T**2  # [grid, walks, strokes]
    covariance = walk + noise[..., None] * np.eye(len(log_velocity))
    right = np.stack([np.ones_like(y), y], axis=-1)
    solved = np.linalg.solve(covariance, np.broadcast_to(right, (len(covariance), *right.shape)))
    # The unknown start is integrated out (restricted maximum likelihood, Patterson and Thompson 1971).
    weight = solved[..., 0].sum(axis=-1)
    start = solved[..., 1].sum(axis=-1) / weight
    rest = solved[..., 1] - start[..., None] * solved[..., 0]
    misfit = (rest * (y - start[..., None])).sum(axis=-1)
    evidence = -0.5 * (np.linalg.slogdet(covariance)[1] + np.log(weight) + misfit).sum(axis=1)
    grid_weight = np.exp(evidence - evidence.max())
    mean = start[..., None] + (walk @ rest[..., None])[..., 0]
    return np.einsum("t,tws->sw", grid_weight / grid_weight.sum(), mean)


def stroke_deviations(
    observed: np.ndarray, error: np.ndarray, weight: np.ndarray, velocity: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Deviations of each stroke from the mean over the strokes.

    The mean over the strokes is subtracted because it belongs to the output path, which has its own prior.

    Parameters
    ----------
    observed, error : as for `smooth_random_walk`, with recordings in any order [recordings, walks].
    weight : weights of the mean that is subtracted [recordings, walks]. Each walk needs a weight above 0.
    velocity : velocity of each recording's stroke, m/s. Recordings of one stroke have the same velocity.

    Returns
    -------
    Distinct velocities, increasing [strokes], and deviations [strokes, walks].
    """
    order = np.argsort(velocity, kind="stable")
    velocities, first = np.unique(velocity[order], return_index=True)
    walk = smooth_random_walk(observed[order], error[order], velocity[order])
    walk -= (weight[order] * walk).sum(axis=0) / weight.sum(axis=0)
    return velocities, walk[first]
