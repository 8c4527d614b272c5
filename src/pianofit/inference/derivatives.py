"""Derivatives of F in closed form: for the steps of a search, and for Laplace's approximation.

Let s = C⁻¹Δ at one node of τ and of the gains. With the Jacobian J of the model, F changes by -Jᵀs. By the variance of
one entry it changes by ½ (C⁻¹_ii - s_i²). By the covariance of a path it changes by ½ (N - Σ UᵀU - s sᵀ), summed over
its recordings. By the covariance ρ² W of the recordings of one partial it changes by ½ (C⁻¹ - s sᵀ), summed over
partials. From this follow the derivatives by ρ and by the velocities. A censored partial adds -log Φ(z),
z = (bound - m)/√V. All changes also move its mean m and its variance V.

Nodes are summed as in F. Second derivatives are in `curvature.py`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.special import log_ndtr

from .likelihood import (
    CovarianceFactors,
    NodeSolutions,
    ObservationTable,
    before_columns,
    centring,
    combine_nodes,
    flattened,
    interference_db,
    node_weights,
    predicted,
    same_path,
    solve_nodes,
    variance,
)

# Numbers of the largest arrays of one call: more points are evaluated in several calls, whose arrays fit the cache.
CALL_SIZE = 100_000


class Evaluation(NamedTuple):
    """F and the derivatives that the optimiser needs, at many points [B, ...]."""

    nll: np.ndarray
    gradient: np.ndarray  # by θ [B, n]
    curvature: np.ndarray  # Gauss-Newton, by θ [B, n, n]
    by_phi: np.ndarray  # gradient [B, 5]
    by_log_w: np.ndarray  # gradient [B, R, K]
    by_covariance: np.ndarray  # part of `gradient` through the walk's covariance [B, n]


def evaluate(
    table: ObservationTable,
    residual: np.ndarray,
    jacobian: np.ndarray,
    phi: np.ndarray,
    w: np.ndarray,
    theta: np.ndarray,
) -> Evaluation:
    """F, its gradient by all unknowns, and its Gauss-Newton curvature by θ, averaged over nodes, at many points.

    Parameters
    ----------
    residual, jacobian, phi, w, theta : [B, R, K], derivatives of the model [B, R, K, n], [B, 5], [B, R, K], [B, n].
    """
    _, R, K, n = jacobian.shape
    nodes, entries = table.log_weight.size, R * K
    largest = max(len(table.log_tau) * K * K, len(table.log_tau) * n * entries, nodes * len(table.censored) * entries)
    count = max(1, CALL_SIZE // largest)
    if len(residual) > count:
        points = residual, jacobian, phi, w, theta
        calls = [evaluate(table, *(x[i : i + count] for x in points)) for i in range(0, len(residual), count)]
        return Evaluation(*map(np.concatenate, zip(*calls, strict=True)))
    point = Points.at(table, residual, phi, w, theta)
    by_variance, censored = _by_variance(point)
    matern, by_length = point.nodes.factors.matern
    by_path, by_noise = _by_path(point), by_variance / w + censored
    excess = 2 * np.exp(2 * phi[:, 0, None, None]) * table.excess_profile
    by_walk, by_velocity = _by_walk(point, theta)
    terms = by_noise * excess, 2 * by_path * matern, by_path * by_length
    terms = [x.sum(axis=(1, 2)) for x in (*terms, 2 * by_noise * interference_db(table, phi) ** 2)]
    mean, sd = table.prior
    by_log_w = 0.5 * table.degrees_of_freedom * (w - 1) - variance(table, phi, w) * by_variance
    gradient, curvature = _by_theta(point, jacobian)
    return Evaluation(
        combine_nodes(table, point.nodes.nll_per_node, phi, w),
        gradient + by_velocity,
        curvature,
        np.stack([*terms, by_walk], axis=1) + (phi - mean) / sd**2,
        table.detected * by_log_w,
        by_velocity,
    )


class Points(NamedTuple):
    """F at every node of τ and of the gains, and how it depends on the censored entries, at many points."""

    table: ObservationTable
    nodes: NodeSolutions
    weight: np.ndarray  # of the nodes [B, T, M]
    sensitivity: np.ndarray  # derivatives of the censored entries' means by the residual [B, T, M, N, R, K]
    mills: np.ndarray  # minus the slope of -log Φ at the standardised bounds: φ(z)/Φ(z) [B, T, M, N]
    phi: np.ndarray  # [B, 5]

    @classmethod
    def at(
        cls, table: ObservationTable, residual: np.ndarray, phi: np.ndarray, w: np.ndarray, theta: np.ndarray
    ) -> Points:
        """Solve F at residuals [B, R, K], φ [B, 5], w [B, R, K] and θ [B, n]."""
        nodes = solve_nodes(table, residual, phi, w, theta)
        p, censored, z = nodes.factors, nodes.censored, nodes.standardised
        columns = censored.loading.swapaxes(3, 4) @ flattened(p.U)
        sensitivity = censored.gain[:, :, None] + columns.reshape(*columns.shape[:4], *residual.shape[1:])
        mills = np.exp(-0.5 * z**2 - log_ndtr(z)) / np.sqrt(2 * np.pi)
        return cls(table, nodes, node_weights(table, nodes.nll_per_node), sensitivity, mills, phi)

    @property
    def unexplained(self) -> np.ndarray:
        """Part of each censored entry that its conditional mean does not follow [B, T, M, N, R, K]."""
        out, (r, k) = -self.sensitivity, self.table.censored.T
        out[:, :, :, np.arange(len(r)), r, k] += 1.0
        return out

    @property
    def by_mean(self) -> np.ndarray:
        """F's derivatives by the censored entries' means [B, T, M, N]."""
        return self.mills / self.nodes.conditional_sd

    @property
    def by_variance(self) -> np.ndarray:
        """F's derivatives by the censored entries' variances [B, T, M, N]."""
        return 0.5 * self.mills * self.nodes.standardised / self.nodes.conditional_sd**2


def _summed(weight: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Σ weight x over the axes of `weight` [B, ...] after the first; the other axes of x [B, ..., *rest] remain."""
    count, rest, nodes = len(weight), x.shape[weight.ndim :], int(np.prod(weight.shape[1:]))
    return (weight.reshape(count, 1, nodes) @ x.reshape(count, nodes, int(np.prod(rest)))).reshape(count, *rest)


def _products(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Σ x_i y_j [B, i, j] over all other axes of x [B, ..., i] and y [B, ..., j]."""
    rows = int(np.prod(x.shape[1:-1]))
    x, y = (z.reshape(len(z), rows, z.shape[-1]) for z in (x, y))
    return x.swapaxes(1, 2) @ y


def _by_recording(weight: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Σ weight x y of two recordings [B, R, R] over partials and all other axes of x and y [B, ..., R, K]."""
    return (weight * (x @ y.swapaxes(-1, -2))).sum(axis=tuple(range(1, x.ndim - 2)))


def _by_theta(point: Points, jacobian: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Gradient [B, n] and curvature [B, n, n]; θ moves the mean of a censored partial but not its bound."""
    table, s, weight, sensitivity, mills, _ = point
    p = s.factors
    flat = flattened(np.moveaxis(jacobian, -1, 1)).swapaxes(1, 2)
    before = _summed(weight.sum(axis=2), before_columns(table, p, np.moveaxis(jacobian, -1, 1)))
    through = flattened(p.U) @ flat[:, None, None]
    moved = flattened(sensitivity) @ flat[:, None, None]
    moved -= jacobian[:, table.censored[:, 0], table.censored[:, 1]][:, None, None]
    moved /= s.conditional_sd[..., None]
    gradient = -(flattened(_summed(weight, s.precision_residual))[:, None] @ flat)[:, 0]
    gradient -= _summed(weight[..., None] * mills, moved)
    bend = weight[..., None] * np.maximum(mills * (mills + s.standardised), 0.0)
    curvature = flattened(before) @ flat
    curvature -= _products(weight[..., None, None] * through, through)
    return gradient, curvature + _products(bend[..., None] * moved, moved)


def _by_variance(point: Points) -> tuple[np.ndarray, np.ndarray]:
    """Derivatives by the variance of each detected entry and of each censored entry [B, R, K]."""
    table, s, weight, sensitivity, *_ = point
    p = s.factors
    own = np.diagonal(p.precision, axis1=2, axis2=3).swapaxes(1, 2) - p.precision_sum * p.relative_precision
    path = _summed(weight.sum(axis=2), np.diagonal(p.path, axis1=3, axis2=4))
    detected = 0.5 * ((table.group @ path) * p.relative_precision**2 + own)
    detected -= 0.5 * _summed(weight, (p.U**2).sum(axis=3) + s.precision_residual**2)
    censored = np.zeros(detected.shape)
    if sensitivity.shape[3]:
        through_mean = _through_mean(point, sensitivity)
        detected -= _summed(weight, through_mean * s.precision_residual)
        detected += _summed(weight[..., None] * point.by_variance, sensitivity**2)
        r, k = table.censored.T  # each entry once
        censored[:, r, k] = _summed(weight, point.by_variance)
    return detected, censored


def _through_mean(point: Points, x: np.ndarray) -> np.ndarray:
    """Σ of x [B, T, M, N, ...] over the censored entries, by F's derivatives by their means [B, T, M, ...]."""
    return (point.by_mean[..., None, :] @ flattened(x)).reshape(*x.shape[:3], *x.shape[4:])


def _by_path(point: Points) -> np.ndarray:
    """Derivative by the covariance of the unknown paths, summed over paths [B, K, K]."""
    table, s, weight, sensitivity, *_ = point
    p, unknown = s.factors, table.has_unknown_path
    by_group, u = table.group.T @ s.precision_residual, table.group.T @ p.U
    out = 0.5 * _summed(weight.sum(axis=2)[..., None] * unknown, p.path)
    of_nodes = weight[..., None, None] * unknown[:, None]
    out -= 0.5 * (_products(of_nodes[..., None, :, :] * u, u) + _products(of_nodes * by_group, by_group))
    if sensitivity.shape[3]:
        remaining = table.group.T @ point.unexplained
        out += _products(of_nodes * _through_mean(point, remaining), by_group)
        by_variance = (weight[..., None] * point.by_variance)[..., None, None] * unknown[:, None]
        out += _products(by_variance * remaining, remaining)
    return out


def _by_walk(point: Points, theta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Derivatives by log ρ [B], and by θ through the velocities [B, n]."""
    table, s, weight, *_ = point
    p = s.factors
    if p.walk.shape[1] == table.group.shape[1]:  # one recording of each path
        return np.zeros(len(theta)), np.zeros(theta.shape)
    path = table.group @ _summed(weight.sum(axis=2), np.diagonal(p.path, axis1=3, axis2=4))
    # Derivative by ρ² W, between recordings of one path [B, R, R].
    out = p.precision.sum(axis=1) - p.relative_precision @ p.precision_sum.swapaxes(1, 2)
    out += (path * p.relative_precision) @ p.relative_precision.swapaxes(1, 2)
    of_nodes, residual = weight[..., None, None], s.precision_residual
    out -= _by_recording(of_nodes[..., None], p.U, p.U) + _by_recording(of_nodes, residual, residual)
    out *= 0.5
    if point.sensitivity.shape[3]:
        remaining, by_variance = point.unexplained, weight[..., None] * point.by_variance
        out += _by_recording(of_nodes, _through_mean(point, remaining), residual)
        out += _by_recording(by_variance[..., None, None], remaining, remaining)
    log_velocity, centred = theta @ table.velocity.T, centring(table)
    by_distance = centred.T @ (out + out.swapaxes(1, 2)) @ centred * same_path(table)
    faster = np.sign(log_velocity[:, :, None] - log_velocity[:, None])
    slope = -0.5 * np.exp(2 * point.phi[:, 4, None]) * (by_distance * faster).sum(axis=2)
    return 2 * (out * p.walk).sum(axis=(1, 2)), slope @ table.velocity


class LatentPosterior(NamedTuple):
    """Posterior means of the integrated quantities and of the residual e."""

    path: np.ndarray  # a [G, K]
    columns: np.ndarray  # Σ c_q B_q and p m [R, K]
    discrepancy: np.ndarray  # d [R, K]
    residual: np.ndarray  # e [R, K]
    variance: np.ndarray  # of a + Σ c B + p m + d at each entry [R, K]


def latent_posterior(
    table: ObservationTable, residual: np.ndarray, phi: np.ndarray, w: np.ndarray, theta: np.ndarray
) -> LatentPosterior:
    """Posterior means at one φ, w and θ, averaged over nodes."""
    s = solve_nodes(table, *(x[None] for x in (residual, phi, w, theta)))
    weight, p = node_weights(table, s.nll_per_node), s.factors
    columns = np.tensordot((s.q[..., None, :] @ p.root)[..., 0, :], table.columns, 1)
    columns = columns + table.pitch * (same_path(table) @ (table.pitch * s.precision_residual))
    common = ((table.group.T @ s.precision_residual)[..., None, :] @ p.prior[:, :, None])[..., 0, :]
    discrepancy = p.walk[:, None, None] @ s.precision_residual
    own = residual - table.group @ common - columns - discrepancy
    entries = np.argwhere(np.ones(residual.shape))
    posterior_variance = predicted(table, p, residual[None], s.q, entries).variance
    posterior_variance = posterior_variance.reshape(*weight.shape, *residual.shape)
    parts = common, columns, discrepancy, own, posterior_variance
    return LatentPosterior(*(_summed(weight, x)[0] for x in parts))


def dense_inverse(table: ObservationTable, p: CovarianceFactors) -> np.ndarray:
    """C⁻¹ of all entries at every node, 0 where no partial was detected [B, T, M, RK, RK]."""
    shape = p.relative_precision.shape[1:]
    count = int(np.prod(shape))
    before = before_columns(table, p, np.eye(count).reshape(1, count, *shape))
    before = before.reshape(*before.shape[:2], 1, count, count)
    u = p.U.reshape(*p.U.shape[:4], count)
    return before - u.swapaxes(3, 4) @ u
