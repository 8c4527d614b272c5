"""Derivatives of F in closed form, and the parts of F, at points of a search.

Let s = C⁻¹r at one node of τ and of the gains. With the Jacobian J of the model, F changes by -Jᵀs. By the variance of
one entry it changes by ½ (C⁻¹_ii - s_i²). By the covariance of a path it changes by ½ (N - Σ UᵀU - s sᵀ), summed over
its recordings. A censored partial adds -log Φ(z), z = (bound - m)/√V. All three changes also move its mean m and its
variance V.
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
    """F and the derivatives that the optimiser needs, at one point or at a batch of points [B, ...]."""

    nll: np.ndarray
    gradient: np.ndarray  # by θ [n]
    curvature: np.ndarray  # Gauss-Newton, by θ [n, n]
    by_phi: np.ndarray  # gradient [4]
    by_log_w: np.ndarray  # gradient [R, K]


def _censored_sensitivities(table: ObservationTable, p: CovarianceFactors, censored: Predicted) -> np.ndarray:
    """Derivatives of the censored entries' means by the residual [T, M, N, R, K]."""
    path = p.relative_precision * (table.group @ censored.cross_gain.swapaxes(1, 2))
    columns = censored.loading.swapaxes(2, 3) @ p.U.reshape(*p.U.shape[:3], -1)
    return path[:, None] + columns.reshape(*columns.shape[:3], *p.precision.shape)


def inverse_mills_ratio(z: np.ndarray) -> np.ndarray:
    """Minus the derivative of -log Φ(z): φ(z)/Φ(z)."""
    return np.exp(-0.5 * z**2 - log_ndtr(z)) / np.sqrt(2 * np.pi)


def evaluate_batch(
    table: ObservationTable, residual: np.ndarray, jacobian: np.ndarray, phi: np.ndarray, w: np.ndarray
) -> Evaluation:
    """`evaluate` at many points [B, ...]."""
    points = [evaluate(table, *point) for point in zip(residual, jacobian, phi, w, strict=True)]
    if not points:
        size = jacobian.shape[-1]
        return Evaluation(*(np.zeros((0, *shape)) for shape in ((), (size,), (size, size), (4,), residual.shape[1:])))
    return Evaluation(*(np.array(column) for column in zip(*points, strict=True)))


def evaluate(
    table: ObservationTable, residual: np.ndarray, jacobian: np.ndarray, phi: np.ndarray, w: np.ndarray
) -> Evaluation:
    """F at one point, its gradient by all unknowns, and its Gauss-Newton curvature by θ, averaged over nodes.

    Parameters
    ----------
    residual, jacobian, phi, w : [R, K], derivatives of the model [R, K, n], [4], [R, K].
    """
    s = solve_nodes(table, residual, phi, w)
    weight, p, z = node_weights(table, s.nll_per_node), s.factors, s.standardised
    sensitivity, mills = _censored_sensitivities(table, p, s.censored), inverse_mills_ratio(z)
    by_mean, by_var = mills / s.conditional_sd, 0.5 * mills * z / s.conditional_sd**2
    mean, sd = table.prior
    by_theta = _by_theta(table, s, weight, sensitivity, mills, jacobian)
    by_variance, censored = _by_variance(table, s, weight, sensitivity, by_mean, by_var)
    by_path = _by_path(table, s, weight, sensitivity, by_mean, by_var)
    matern, by_length = p.matern
    excess, others = 2 * np.exp(2 * phi[0]) * table.variance_profile, 2 * interference_db(table, phi) ** 2
    by_noise = by_variance / w + censored
    by_phi = [
        (by_noise * excess).sum(), 2 * (by_path * matern).sum(), (by_path * by_length).sum(), (by_noise * others).sum(),
    ]  # fmt: skip
    return Evaluation(
        combine_nodes(table, s.nll_per_node, phi, w), *by_theta, np.array(by_phi) + (phi - mean) / sd**2,
        table.detected * (0.5 * table.degrees_of_freedom * (w - 1) - variance(table, phi, w) * by_variance),
    )  # fmt: skip


def _by_theta(
    table: ObservationTable,
    s: NodeSolutions,
    weight: np.ndarray,
    sensitivity: np.ndarray,
    mills: np.ndarray,
    jacobian: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Gradient [n] and curvature [n, n]; θ moves the mean of a censored partial but not its bound."""
    p, size = s.factors, jacobian.shape[-1]
    J = np.moveaxis(jacobian, -1, 0)
    flat = jacobian.reshape(-1, size)
    before = before_columns(table, p.precision, p.relative_precision, p.path, J)
    through = p.U.reshape(*p.U.shape[:3], -1) @ flat
    moved = sensitivity.reshape(*sensitivity.shape[:3], len(flat)) @ flat
    moved -= jacobian[table.censored[:, 0], table.censored[:, 1]]
    moved /= s.conditional_sd[..., None]
    gradient = -np.tensordot(weight, s.precision_residual, 2).reshape(-1) @ flat
    gradient -= np.tensordot(weight[..., None] * mills, moved, 3)
    bend = weight[..., None] * np.maximum(mills * (mills + s.standardised), 0.0)
    return gradient, (
        np.tensordot(weight.sum(axis=1), before, 1).reshape(size, -1) @ flat
        - np.tensordot(weight[..., None, None] * through, through, ((0, 1, 2), (0, 1, 2)))
        + np.tensordot(bend[..., None] * moved, moved, ((0, 1, 2), (0, 1, 2)))
    )  # fmt: skip


def _by_variance(
    table: ObservationTable,
    s: NodeSolutions,
    weight: np.ndarray,
    sensitivity: np.ndarray,
    by_mean: np.ndarray,
    by_var: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Derivatives by the variance of each detected entry and of each censored entry [R, K]."""
    p = s.factors
    own = p.precision * (1 - p.relative_precision)
    path = np.tensordot(weight.sum(axis=1), np.diagonal(p.path, axis1=2, axis2=3), 1)
    detected = 0.5 * ((table.group @ path) * p.relative_precision**2 + own)
    detected -= 0.5 * np.tensordot(weight, (p.U**2).sum(axis=2) + s.precision_residual**2, 2)
    censored = np.zeros(detected.shape)
    if sensitivity.shape[2]:
        flat = sensitivity.reshape(*sensitivity.shape[:3], -1)
        through_mean = (by_mean[:, :, None] @ flat).reshape(s.precision_residual.shape)
        detected -= np.tensordot(weight, through_mean * s.precision_residual, 2)
        detected += np.tensordot(weight[..., None] * by_var, sensitivity**2, 3)
        np.add.at(censored, tuple(table.censored.T), np.tensordot(weight, by_var, 2))
    return detected, censored


def _by_path(
    table: ObservationTable,
    s: NodeSolutions,
    weight: np.ndarray,
    sensitivity: np.ndarray,
    by_mean: np.ndarray,
    by_var: np.ndarray,
) -> np.ndarray:
    """Derivative by the covariance of the unknown paths, summed over paths [K, K]."""
    p, K = s.factors, len(table.distance_octaves)
    unknown = table.has_unknown_path

    def square(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Σ of outer products of rows [..., G, K] over the unknown paths."""
        return (unknown[:, None] * x).reshape(-1, K).T @ y.reshape(-1, K)

    by_group, u = table.group.T @ s.precision_residual, table.group.T @ p.U
    out = 0.5 * np.tensordot(weight.sum(axis=1)[:, None] * unknown, p.path, 2)
    shared = 0.5 * square(weight[..., None, None, None] * u, u)
    out -= shared + 0.5 * square(weight[..., None, None] * by_group, by_group)
    if sensitivity.shape[2]:
        # Part of the path of a censored partial that its conditional mean does not follow.
        remaining = -(table.group.T @ sensitivity)
        n = np.arange(sensitivity.shape[2])
        remaining[:, :, n, :, table.censored[:, 1]] += table.group[table.censored[:, 0]][:, None, None]
        through_mean = (by_mean[:, :, None] @ remaining.reshape(*remaining.shape[:3], -1)).reshape(by_group.shape)
        out += square(weight[..., None, None] * through_mean, by_group)
        out += square((weight[..., None] * by_var)[..., None, None] * remaining, remaining)
    return out


class LatentPosterior(NamedTuple):
    """Posterior means of the integrated quantities and of the residual e."""

    path: np.ndarray  # a [G, K]
    columns: np.ndarray  # Σ c_q B_q [R, K]
    residual: np.ndarray  # e [R, K]
    variance: np.ndarray  # of a + Σ c B at each entry [R, K]


def latent_posterior(table: ObservationTable, residual: np.ndarray, phi: np.ndarray, w: np.ndarray) -> LatentPosterior:
    """Posterior means at φ and w, averaged over nodes."""
    s = solve_nodes(table, residual, phi, w)
    weight, p = node_weights(table, s.nll_per_node), s.factors
    columns = np.tensordot((s.q[:, :, None] @ p.root)[:, :, 0], table.columns, 1)
    mean = path_mean(table, p.relative_precision, residual - columns)
    common = (mean[..., None, :] @ p.path[:, None] @ p.prior[:, None])[..., 0, :]
    own = residual - table.group @ common - columns
    entries = np.argwhere(np.ones(residual.shape))
    posterior_variance = predicted(table, p, path_mean(table, p.relative_precision, residual), s.q, entries).variance
    posterior_variance = posterior_variance.reshape(*weight.shape, *residual.shape)
    return LatentPosterior(*(np.tensordot(weight, x, 2) for x in (common, columns, own, posterior_variance)))


class DenseTerms(NamedTuple):
    """F and its dense factors at every node of τ and of the gains; see `likelihood.NodeSolutions`."""

    nll_per_node: np.ndarray  # F [T, M]
    inverse: np.ndarray  # C⁻¹ of all entries, 0 where no partial was detected [T, M, RK, RK]
    weight: np.ndarray  # of the nodes at this residual [T, M]
    variance: np.ndarray  # var/w [R, K]
    precision_residual: np.ndarray  # C⁻¹r [T, M, R, K]
    sensitivity: np.ndarray  # derivatives of the censored entries' means by the residual [T, M, N, R, K]
    standardised: np.ndarray  # bound minus mean of the censored entries, in standard deviations [T, M, N]
    conditional_sd: np.ndarray  # these standard deviations, dB [T, M, N]
    mills: np.ndarray  # minus the slope of -log Φ at the standardised bounds [T, M, N]


def dense_terms(table: ObservationTable, residual: np.ndarray, phi: np.ndarray, w: np.ndarray) -> DenseTerms:
    """F at one point with its dense factors."""
    s = solve_nodes(table, residual, phi, w)
    p, count = s.factors, residual.size
    unit = np.eye(count).reshape(count, *residual.shape)
    before = before_columns(table, p.precision, p.relative_precision, p.path, unit).reshape(-1, 1, count, count)
    u = p.U.reshape(*p.U.shape[:3], count)
    return DenseTerms(
        s.nll_per_node,
        before - u.swapaxes(2, 3) @ u,
        node_weights(table, s.nll_per_node),
        variance(table, phi, w),
        s.precision_residual,
        _censored_sensitivities(table, p, s.censored),
        s.standardised,
        s.conditional_sd,
        inverse_mills_ratio(s.standardised),
    )
