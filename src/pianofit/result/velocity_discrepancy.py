"""What varies from stroke to stroke, seen through errors, as random walks over the logarithm of the velocity.

Strokes of like velocity show alike what a model of the hammer leaves over. How far walks go, and by how much any two
strokes differ beside that, is the same for all walks of a key, which say it together; both are integrated over. So what
strokes do not tell apart stays their mean. Between strokes the mean of such a walk is linear, beyond them constant.
"""

from __future__ import annotations

import numpy as np

__all__ = ["NOTHING", "stroke_deviations", "smooth_random_walk"]

# Standard deviations that are tried of a walk over an e-fold of velocity and of a stroke, relative: 0.1 to 9 dB, as
# likely on a logarithmic scale.
TRIED = np.geomspace(0.01, 1.0, 9)
# A standard error that leaves nothing said.
NOTHING = 1e3


def smooth_random_walk(seen: np.ndarray, error: np.ndarray, velocity: np.ndarray) -> np.ndarray:
    """The mean of walks over log velocity, from anywhere on, given what strokes show of them [strokes, walks].

    Parameters
    ----------
    seen, error : values and their standard errors [strokes, walks]; to the errors a common one is added.
    velocity : of the strokes, m/s, rising.
    """
    far, y = np.log(velocity / velocity[0]), seen.T
    size, other = (x.ravel()[:, None, None, None] for x in np.meshgrid(TRIED, TRIED))
    walk = size**2 * np.minimum.outer(far, far)  # [tried, 1, strokes, strokes]
    noise = other[..., 0] ** 2 + error.T**2  # [tried, walks, strokes]
    covariance = walk + noise[..., None] * np.eye(len(far))
    right = np.stack([np.ones_like(y), y], axis=-1)
    solved = np.linalg.solve(covariance, np.broadcast_to(right, (len(covariance), *right.shape)))
    # Their unknown begin is integrated over (restricted maximum likelihood, Patterson and Thompson 1971).
    weight = solved[..., 0].sum(axis=-1)
    begin = solved[..., 1].sum(axis=-1) / weight
    rest = solved[..., 1] - begin[..., None] * solved[..., 0]
    misfit = (rest * (y - begin[..., None])).sum(axis=-1)
    evidence = -0.5 * (np.linalg.slogdet(covariance)[1] + np.log(weight) + misfit).sum(axis=1)
    share = np.exp(evidence - evidence.max())
    mean = begin[..., None] + (walk @ rest[..., None])[..., 0]
    return np.einsum("t,tws->sw", share / share.sum(), mean)


def stroke_deviations(
    seen: np.ndarray, error: np.ndarray, weight: np.ndarray, velocity: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """How walks differ from stroke to stroke: the velocities there are, rising, and what each has [strokes, walks].

    What all strokes have in common is taken out: it belongs to what they share, which has had its own prior.

    Parameters
    ----------
    seen, error : as of `smoothed`, of recordings in any order [recordings, walks].
    weight : of each in the mean that is taken out [recordings, walks]; some above 0 in every walk.
    velocity : of the recordings' strokes, m/s; those of one stroke have the same.
    """
    order = np.argsort(velocity, kind="stable")
    known, first = np.unique(velocity[order], return_index=True)
    walk = smooth_random_walk(seen[order], error[order], velocity[order])
    walk -= (weight[order] * walk).sum(axis=0) / weight.sum(axis=0)
    return known, walk[first]
