"""Random tables of observations, and their likelihood by one dense covariance of all entries."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from scipy.special import logsumexp
from scipy.stats import multivariate_normal, norm

from pianofit.inference.derivatives import Evaluation, evaluate
from pianofit.inference.likelihood import INTERFERENCE_DB, JITTER, ObservationTable
from pianofit.inference.priors import STUDENT

SMALL = -50.0  # log τ without a τ
# R, K, groups, columns, nodes of τ and of the gains, unknown path, maximum number of censored partials.
SHAPES = {
    "one recording": (1, 9, 1, 1, (3, 1), True, 2),
    "two microphones": (4, 8, 2, 5, (1, 1), True, 4),
    "no path": (3, 8, 1, 4, (1, 1), False, 3),
    "nothing absent": (3, 8, 1, 2, (1, 2), True, 0),
    "ten nodes": (2, 7, 2, 2, (5, 2), True, 3),
}
PHI = np.array([-0.3, 1.2, -0.4, -5.0, 0.4])
# Parameters of θ before the velocities, one for each recording.
SHARED = 1


def table(shape: str, seed: int = 0) -> ObservationTable:
    """One of `SHAPES` with random numbers; groups alternate."""
    R, K, groups, columns, nodes, path, count = SHAPES[shape]
    random = np.random.default_rng([seed, *map(ord, shape)])
    octave = np.log2(np.arange(1, K + 1) * 100.0)
    censored = np.argwhere(random.random((R, K)) < 0.3)[:count]
    detected = np.ones((R, K))
    detected[tuple(censored.T)] = 0.0
    log_tau = np.log(0.3 + 2 * random.random((nodes[0], groups))) if path else np.full((nodes[0], groups), SMALL)
    weight = random.random(nodes)
    return ObservationTable(
        value=random.normal(size=(R, K)),
        variance=0.1 + random.random((R, K)),
        detected=detected,
        censored=censored,
        group=np.eye(groups)[np.arange(R) % groups],
        columns=2 * random.normal(size=(columns, R, K)),
        scale=0.5 + random.random((nodes[1], columns)),
        systematic=0.1 * np.exp(-np.abs(np.subtract.outer(np.arange(K), np.arange(K)))),
        distance_octaves=np.abs(octave[:, None] - octave),
        has_unknown_path=np.full(groups, float(path)),
        log_tau=log_tau,
        log_weight=np.log(weight / weight.sum()),
        excess_profile=1 + random.random(K),
        smooth_profile=1 + random.random(K),
        ratio=5 * random.random((R, K)),
        pitch=np.linspace(-0.06, 0.1, R)[:, None] * np.arange(1, K + 1),
        prior=(np.log([0.7, 8, 0.7, 0.002, 1.0]), np.array([0.7, 0.4, 0.4, 0.9, 1.0])),
        velocity=np.eye(R, SHARED + R, SHARED),
        degrees_of_freedom=np.float64(STUDENT),
    )


def point(shape: str, seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Residuals, weights and θ of a random point."""
    random = np.random.default_rng([seed, 1, *map(ord, shape)])
    R, K, *_ = SHAPES[shape]
    return 3 * random.normal(size=(R, K)), np.exp(0.3 * random.normal(size=(R, K))), random.normal(size=SHARED + R)


def noise(t: ObservationTable, phi: np.ndarray) -> np.ndarray:
    """Variance of each entry's own error at a weight of 1 [R, K]."""
    return np.asarray(
        t.variance + np.exp(2 * phi[0]) * t.excess_profile + (np.exp(phi[3]) * INTERFERENCE_DB * t.ratio) ** 2
    )


def walk(t: ObservationTable, phi: np.ndarray, theta: np.ndarray) -> np.ndarray:
    """Covariance between recordings of the walks, from independent increments between sorted velocities [R, R]."""
    R, log_velocity, group = len(t.value), t.velocity @ theta, np.argmax(np.asarray(t.group), axis=1)
    total = np.zeros((R, R))
    for g in np.unique(group):
        own = np.flatnonzero(group == g)
        order = own[np.argsort(log_velocity[own])]
        increments = np.zeros((R, len(own) - 1))  # each increment moves all faster strokes
        for i, (slow, fast) in enumerate(pairwise(order)):
            increments[order[i + 1 :], i] = np.exp(phi[4]) * np.sqrt(log_velocity[fast] - log_velocity[slow])
        increments[own] -= increments[own].mean(axis=0)
        total += increments @ increments.T
    return total


def shared(t: ObservationTable, phi: np.ndarray, node: tuple[int, int], theta: np.ndarray) -> np.ndarray:
    """The covariance of paths, walks and columns over all entries [RK, RK], entry by entry."""
    R, K = t.value.shape
    d = np.sqrt(3) * np.asarray(t.distance_octaves) / np.exp(phi[2])
    growth = np.asarray(t.smooth_profile)
    matern = np.exp(2 * phi[1]) * np.outer(growth, growth) * (1 + d) * np.exp(-d)
    total = np.zeros((R, K, R, K))
    walks = walk(t, phi, theta)
    for i in range(R):
        for j in range(R):
            total[i, :, j, :] = walks[i, j] * np.eye(K)
            if (t.group[i] == t.group[j]).all():
                g = int(np.argmax(t.group[i]))
                tau2 = np.exp(2 * t.log_tau[node[0], g]) + JITTER
                total[i, :, j, :] += t.has_unknown_path[g] * matern + t.systematic + tau2 * np.eye(K)
                total[i, :, j, :] += np.diag(t.pitch[i] * t.pitch[j])
    columns = np.asarray(t.scale[node[1]])[:, None] * np.asarray(t.columns).reshape(len(t.columns), -1)
    return total.reshape(R * K, R * K) + columns.T @ columns


def dense_nodes(
    t: ObservationTable, residual: np.ndarray, phi: np.ndarray, w: np.ndarray, theta: np.ndarray
) -> np.ndarray:
    """Minus the log density of everything at each node [T, M], weights of nodes included."""
    detected, out = np.asarray(t.detected).ravel() > 0, np.empty(np.shape(t.log_weight))
    for node, weight in np.ndenumerate(t.log_weight):
        latent, noise_variance = shared(t, phi, node, theta), noise(t, phi).ravel()
        full = latent + np.diag(noise_variance / w.ravel())
        inside, y = full[np.ix_(detected, detected)], residual.ravel()[detected]
        nll = -multivariate_normal(np.zeros(len(y)), inside).logpdf(y) - 0.5 * len(y) * np.log(2 * np.pi)
        for r, k in np.asarray(t.censored):
            at = r * t.value.shape[1] + k
            pull = np.linalg.solve(inside, latent[detected, at])
            sd = np.sqrt(latent[at, at] + noise_variance[at] - pull @ latent[detected, at])
            nll -= norm.logcdf((residual.ravel()[at] - pull @ y) / sd)
        out[node] = nll - weight
    return out


def dense(t: ObservationTable, residual: np.ndarray, phi: np.ndarray, w: np.ndarray, theta: np.ndarray) -> float:
    """F, densely."""
    mean, sd = t.prior
    mixture = 0.5 * t.degrees_of_freedom * (t.detected * (w - 1 - np.log(w))).sum()
    nodes = -logsumexp(-dense_nodes(t, residual, phi, w, theta))
    return float(nodes + mixture + 0.5 * (((phi - mean) / sd) ** 2).sum())


def evaluate_one(t, *at):
    """`evaluate` at one point."""
    return Evaluation(*(x[0] for x in evaluate(t, *(np.asarray(x)[None] for x in at))))
