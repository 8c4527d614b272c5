"""F's derivatives in closed form, and what F is made of, at points of a search.

With s = C⁻¹r at one node of τ and of the gains, F changes by a level law's derivatives J as -Jᵀs, by an entry's own
variance as ½ (C⁻¹_ii - s_i²), and by a path's covariance as ½ (N - Σ UᵀU - s sᵀ) summed over its recordings. An absent
partial adds -log Φ(z), z = (bound - m)/√V, whose mean m and variance V change with all three.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.special import log_ndtr

from .likelihood import (
    CovarianceFactors,
    NodeSolutions,
    ObservationTable,
    Predicted,
    before_columns,
    combine_nodes,
    interference_db,
    node_weights,
    path_mean,
    predicted,
    solve_nodes,
    variance,
)

__all__ = [
    "LatentPosterior",
    "DenseTerms",
    "Evaluation",
    "latent_posterior",
    "dense_terms",
    "evaluate",
    "evaluate_batch",
]


class Evaluation(NamedTuple):
    """F and what a descent on it needs, of one point or of many [B, ...]."""

    nll: np.ndarray
    gradient: np.ndarray  # by θ [n]
    curvature: np.ndarray  # Gauss and Newton's, by θ [n, n]
    by_phi: np.ndarray  # gradient [4]
    by_log_w: np.ndarray  # gradient [R, K]


def _censored_sensitivities(table: ObservationTable, p: CovarianceFactors, absent: Predicted) -> np.ndarray:
    """What moves the means of absent entries: their derivatives by the residual [T, M, N, R, K]."""
    path = p.log_weight * (table.group @ absent.cross_gain.swapaxes(1, 2))
    columns = absent.by.swapaxes(2, 3) @ p.own.reshape(*p.own.shape[:3], -1)
    return path[:, None] + columns.reshape(*columns.shape[:3], *p.precision.shape)


def inverse_mills_ratio(z: np.ndarray) -> np.ndarray:
    """Minus the derivative of -log Φ(z)."""
    return np.exp(-0.5 * z**2 - log_ndtr(z)) / np.sqrt(2 * np.pi)


def evaluate_batch(
    table: ObservationTable, residual: np.ndarray, jacobian: np.ndarray, phi: np.ndarray, w: np.ndarray
) -> Evaluation:
    """`report` of many points [B, ...]."""
    points = [evaluate(table, *point) for point in zip(residual, jacobian, phi, w, strict=True)]
    if not points:
        size = jacobian.shape[-1]
        return Evaluation(*(np.zeros((0, *shape)) for shape in ((), (size,), (size, size), (4,), residual.shape[1:])))
    return Evaluation(*(np.array(column) for column in zip(*points, strict=True)))


def evaluate(
    table: ObservationTable, residual: np.ndarray, jacobian: np.ndarray, phi: np.ndarray, w: np.ndarray
) -> Evaluation:
    """F at one point, its gradient by everything, and its curvature by θ: Gauss and Newton's, averaged over nodes.

    Parameters
    ----------
    residual, jacobian, phi, w : [R, K], what moves the law [R, K, n], [4], [R, K].
    """
    s = solve_nodes(table, residual, phi, w)
    weight, p = node_weights(table, s.nll_per_node), s.pieces
    pull, steep, z = _censored_sensitivities(table, p, s.censored), inverse_mills_ratio(s.z), s.z
    far, near = (
        steep / s.conditional_sd,
        0.5 * steep * z / s.conditional_sd**2,
    )  # by an absent one's mean, and by its variance
    mean, sd = table.prior
    by_theta = _by_theta(table, s, weight, pull, steep, jacobian)
    by_variance, absent = _by_variance(table, s, weight, pull, far, near)
    smooth = _by_path(table, s, weight, pull, far, near)
    own, by_length = p.has_unknown_path
    excess, others = 2 * np.exp(2 * phi[0]) * table.variance_profile, 2 * interference_db(table, phi) ** 2
    changed = by_variance / w + absent
    by_phi = [(changed * excess).sum(), 2 * (smooth * own).sum(), (smooth * by_length).sum(), (changed * others).sum()]
    return Evaluation(
        combine_nodes(table, s.nll_per_node, phi, w), *by_theta, np.array(by_phi) + (phi - mean) / sd**2,
        table.detected * (0.5 * table.degrees_of_freedom * (w - 1) - variance(table, phi, w) * by_variance),
    )  # fmt: skip


def _by_theta(
    table: ObservationTable,
    s: NodeSolutions,
    weight: np.ndarray,
    pull: np.ndarray,
    steep: np.ndarray,
    jacobian: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Gradient [n] and curvature [n, n]. An absent partial's bound stays, what is there takes its mean along."""
    p, size = s.pieces, jacobian.shape[-1]
    J = np.moveaxis(jacobian, -1, 0)
    flat = jacobian.reshape(-1, size)
    before = before_columns(table, p.precision, p.log_weight, p.path, J)
    through = p.own.reshape(*p.own.shape[:3], -1) @ flat
    moved = pull.reshape(*pull.shape[:3], len(flat)) @ flat - jacobian[table.censored[:, 0], table.censored[:, 1]]
    moved /= s.conditional_sd[..., None]
    gradient = -np.tensordot(weight, s.precision_residual, 2).reshape(-1) @ flat - np.tensordot(
        weight[..., None] * steep, moved, 3
    )
    bend = weight[..., None] * np.maximum(steep * (steep + s.z), 0.0)
    return gradient, (
        np.tensordot(weight.sum(axis=1), before, 1).reshape(size, -1) @ flat
        - np.tensordot(weight[..., None, None] * through, through, ((0, 1, 2), (0, 1, 2)))
        + np.tensordot(bend[..., None] * moved, moved, ((0, 1, 2), (0, 1, 2)))
    )  # fmt: skip


def _by_variance(
    table: ObservationTable, s: NodeSolutions, weight: np.ndarray, pull: np.ndarray, far: np.ndarray, near: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """By the variance of each entry that is there, and of each that is absent [R, K]."""
    p = s.pieces
    alone = p.precision * (1 - p.log_weight)
    path = np.tensordot(weight.sum(axis=1), np.diagonal(p.path, axis1=2, axis2=3), 1)
    there = 0.5 * ((table.group @ path) * p.log_weight**2 + alone)
    there -= 0.5 * np.tensordot(weight, (p.own**2).sum(axis=2) + s.precision_residual**2, 2)
    absent = np.zeros(there.shape)
    if pull.shape[2]:
        flat = pull.reshape(*pull.shape[:3], -1)
        drawn = (far[:, :, None] @ flat).reshape(s.precision_residual.shape)
        there -= np.tensordot(weight, drawn * s.precision_residual, 2)
        there += np.tensordot(weight[..., None] * near, pull**2, 3)
        np.add.at(absent, tuple(table.censored.T), np.tensordot(weight, near, 2))
    return there, absent


def _by_path(
    table: ObservationTable, s: NodeSolutions, weight: np.ndarray, pull: np.ndarray, far: np.ndarray, near: np.ndarray
) -> np.ndarray:
    """By the covariance of the paths that are unknown, together [K, K]."""
    p, K = s.pieces, len(table.distance_octaves)
    smooth = table.has_unknown_path

    def square(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Σ of outer products of rows [..., G, K], for paths that are unknown."""
        return (smooth[:, None] * x).reshape(-1, K).T @ y.reshape(-1, K)

    push, u = table.group.T @ s.precision_residual, table.group.T @ p.own
    out = 0.5 * np.tensordot(weight.sum(axis=1)[:, None] * smooth, p.path, 2)
    out -= 0.5 * square(weight[..., None, None, None] * u, u) + 0.5 * square(weight[..., None, None] * push, push)
    if pull.shape[2]:
        # What of a path an absent partial has that the others' mean has not.
        apart = -(table.group.T @ pull)
        n = np.arange(pull.shape[2])
        apart[:, :, n, :, table.censored[:, 1]] += table.group[table.censored[:, 0]][:, None, None]
        drawn = (far[:, :, None] @ apart.reshape(*apart.shape[:3], -1)).reshape(push.shape)
        out += square(weight[..., None, None] * drawn, push)
        out += square((weight[..., None] * near)[..., None, None] * apart, apart)
    return out


class LatentPosterior(NamedTuple):
    """Posterior means of what is integrated out, and of e."""

    common: np.ndarray  # a [G, K]
    columns: np.ndarray  # Σ c_q B_q [R, K]
    own: np.ndarray  # e [R, K]
    variance: np.ndarray  # of a + Σ c B at each entry [R, K]


def latent_posterior(table: ObservationTable, residual: np.ndarray, phi: np.ndarray, w: np.ndarray) -> LatentPosterior:
    """Posterior means at φ and w, averaged over nodes."""
    s = solve_nodes(table, residual, phi, w)
    weight, p = node_weights(table, s.nll_per_node), s.pieces
    columns = np.tensordot((s.q[:, :, None] @ p.root)[:, :, 0], table.columns, 1)
    mean = path_mean(table, p.log_weight, residual - columns)
    common = (mean[..., None, :] @ p.path[:, None] @ p.prior[:, None])[..., 0, :]
    own = residual - table.group @ common - columns
    every = np.argwhere(np.ones(residual.shape))
    spread = predicted(table, p, path_mean(table, p.log_weight, residual), s.q, every).variance
    spread = spread.reshape(*weight.shape, *residual.shape)
    return LatentPosterior(*(np.tensordot(weight, x, 2) for x in (common, columns, own, spread)))


class DenseTerms(NamedTuple):
    """F at every node of τ and of the gains, opened; see `likelihood.Solved`."""

    each: np.ndarray  # F there [T, M]
    inverse: np.ndarray  # C⁻¹ of all entries, 0 where nothing was found [T, M, RK, RK]
    weight: np.ndarray  # of the nodes at this residual [T, M]
    variance: np.ndarray  # var/w [R, K]
    push: np.ndarray  # C⁻¹r [T, M, R, K]
    pull: np.ndarray  # of what is absent: derivatives of its mean by the residual [T, M, N, R, K],
    z: np.ndarray  # bound less mean, in standard deviations [T, M, N],
    spread: np.ndarray  # these deviations, dB,
    hazard: np.ndarray  # and minus the slope of -log Φ(z)


def dense_terms(table: ObservationTable, residual: np.ndarray, phi: np.ndarray, w: np.ndarray) -> DenseTerms:
    """F at one point, opened."""
    s = solve_nodes(table, residual, phi, w)
    p, count = s.pieces, residual.size
    every = np.eye(count).reshape(count, *residual.shape)
    before = before_columns(table, p.precision, p.log_weight, p.path, every).reshape(-1, 1, count, count)
    u = p.own.reshape(*p.own.shape[:3], count)
    return DenseTerms(
        s.nll_per_node,
        before - u.swapaxes(2, 3) @ u,
        node_weights(table, s.nll_per_node),
        variance(table, phi, w),
        s.precision_residual,
        _censored_sensitivities(table, p, s.censored),
        s.z,
        s.conditional_sd,
        inverse_mills_ratio(s.z),
    )
