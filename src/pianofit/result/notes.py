"""Notes of all minima: string, hammer, and the output path that F integrates out, with its velocity discrepancy.

Strokes of similar velocity deviate from the hammer model in similar ways. The deviation of a partial is a random walk
over log velocity, plus independent scatter of each stroke. Step size and scatter are common to all partials of a key
and are integrated over. Differences that the strokes do not resolve shrink to zero. The posterior mean is linear
between strokes and constant beyond them.
"""

from __future__ import annotations

import numpy as np

from ..inference import (
    STRING_SIZE,
    FitProblem,
    InferenceResult,
    LatentPosterior,
    Minima,
    string_law,
)
from ..inference.batched_model import DB
from ..inference.likelihood import ObservationTable, variance
from ..model.note import Note
from ..model.output_path import OutputPath, VelocityDiscrepancy

# Grid of standard deviations, relative (0.1 to 9 dB), for the walk over an e-fold of velocity and for the scatter of a
# stroke. The prior is uniform in the logarithm.
GRID = np.geomspace(0.01, 1.0, 9)
# Standard error of an observation without information.
UNINFORMATIVE_ERROR = 1e3


def notes_of(fit: InferenceResult, which: int) -> list[Note]:
    """The notes of one minimum for every recording, at the velocity of its stroke and without a gain."""
    problem, minima, latent = fit.problem, fit.estimate.minima, fit.latent(which)
    u, z, group = problem.parametrisation, minima.candidates.theta[which], problem.structure.group
    paths = [
        _path(problem, minima, which, index, latent) if problem.path else None
        for index in range(problem.structure.groups)
    ]
    f0, string = problem.analyses[problem.reference].f0, u.string(z)
    return [
        Note(
            string._replace(c=string.c * analysis.f0 / f0),
            u.hammer(z, stroke),
            u.geometry_at(z),
            problem.initial_values.quantity,
            1.0,
            paths[path],
        )
        for analysis, stroke, path in zip(problem.analyses, problem.structure.stroke, group, strict=True)
    ]


def _path(problem: FitProblem, minima: Minima, which: int, group: int, latent: LatentPosterior) -> OutputPath:
    """Posterior mean of a group's output path, dB, at its detected partials.

    Frequencies are those of the string model, since partials are identified by number.
    """
    observed, candidates = problem.observed, minima.candidates
    recordings = np.flatnonzero(np.array(problem.structure.group) == group)
    detected = np.any(np.asarray(observed.level.detected)[recordings] > 0, axis=0)
    number = observed.number[detected]
    frequency = string_law(candidates.theta[which, :STRING_SIZE], number, problem.initial_values.geometry.length)[0][0]
    velocity = np.exp(candidates.theta[which, problem.parametrisation.shared :])[
        np.array(problem.structure.stroke)[recordings]
    ]
    residuals = _residuals(observed.level, candidates.level.phi[which], candidates.level.w[which], latent)
    residual, error, weight = (x[np.ix_(recordings, detected)] for x in residuals)
    velocities, db = stroke_deviations(residual / DB, error / DB, weight, velocity)
    return OutputPath(
        frequency,
        latent.path[group][detected],
        VelocityDiscrepancy(velocities, DB * db) if len(velocities) > 1 else None,
    )


def _residuals(
    table: ObservationTable, phi: np.ndarray, w: np.ndarray, latent: LatentPosterior
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Residual of every level, its standard error without the excess, and its weight in the output path [R, K]."""
    detected, total = np.asarray(table.detected) > 0, variance(table, phi, w)
    # Noise and interference. The small weight of an outlier adds variance beyond the excess, which stays in its error.
    error = np.sqrt(np.maximum(total - np.exp(2 * phi[0]), table.variance))
    return latent.residual, np.where(detected, error, UNINFORMATIVE_ERROR), np.where(detected, 1 / total, 0.0)


# --- velocity discrepancy ---------------------------------------------------------------------------------------------


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
