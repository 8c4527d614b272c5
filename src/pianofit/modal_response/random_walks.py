"""Random walks over log velocity whose step size and scatter are unknown: what strokes of similar velocity share.

Step size and scatter are common to all quantities and are integrated over. Differences that the strokes do not resolve
shrink to zero. The posterior mean is linear between strokes and constant beyond them.
"""

import numpy as np

# Grid of standard deviations, relative (0.1 to 9 dB), for the walk over an e-fold of velocity and for the scatter of a
# stroke. The prior is uniform in the logarithm.
GRID = np.geomspace(0.01, 1.0, 9)
# Standard error of an observation without information.
UNINFORMATIVE_ERROR = 1e3


def smooth_random_walk(observed: np.ndarray, error: np.ndarray, velocity: np.ndarray) -> np.ndarray:
    """Posterior mean of random walks over log velocity, with unknown start [strokes, walks].

    A common scatter is added to the standard errors [strokes, walks]. Velocities of the strokes, m/s, increase.
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
