"""Derivatives of F in closed form: for the steps of a search, and for Laplace's approximation.

Let s = C⁻¹r at one node of τ and of the gains. With the Jacobian J of the model, F changes by -Jᵀs. By the variance of
one entry it changes by ½ (C⁻¹_ii - s_i²). By the covariance of a path it changes by ½ (N - Σ UᵀU - s sᵀ), summed over
its recordings. By the covariance ρ² W of the recordings of one partial it changes by ½ (C⁻¹ - s sᵀ), summed over
partials. From this follow the derivatives by ρ and by the velocities. A censored partial adds -log Φ(z),
z = (bound - m)/√V. All changes also move its mean m and its variance V.

By the log-weights x the Hessian has a closed form in P = C⁻¹: a weight changes one entry of C's diagonal,
∂C/∂x_i = -v_i, v = var/w. At one node

    ∂F/∂x_i = ½ v_i (s_i² - P_ii)      ∂²F/∂x_i∂x_j = v_i v_j (s_i P_ij s_j - ½ P_ij²) - δ_ij ∂F/∂x_i
                                       ∂²F/∂θ∂x_i = -(JᵀP)_i v_i s_i

and of a censored partial, with m = tᵀr,

    ∂m/∂x_i = v_i t_i s_i              ∂V/∂x_i = -v_i t_i²              ∂t_j/∂x_i = v_i P_ji t_i.

Nodes are summed as in F. The few second derivatives by φ are differences of the exact gradient.
"""

from __future__ import annotations

from collections.abc import Sequence
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
    interference_db,
    node_weights,
    predicted,
    solve_nodes,
    variance,
)

# A negative eigenvalue of the curvature above this is not rounding, relative to the curvature with φ and w fixed.
NEGATIVE = 1e-3


class Evaluation(NamedTuple):
    """F and the derivatives that the optimiser needs, at one point or at a batch of points [B, ...]."""

    nll: np.ndarray
    gradient: np.ndarray  # by θ [n]
    curvature: np.ndarray  # Gauss-Newton, by θ [n, n]
    by_phi: np.ndarray  # gradient [5]
    by_log_w: np.ndarray  # gradient [R, K]
    by_covariance: np.ndarray  # part of `gradient` through the walk's covariance [n]


def evaluate_batch(
    table: ObservationTable,
    residual: np.ndarray,
    jacobian: np.ndarray,
    phi: np.ndarray,
    w: np.ndarray,
    theta: np.ndarray,
) -> Evaluation:
    """`evaluate` at many points [B, ...]."""
    points = [evaluate(table, *point) for point in zip(residual, jacobian, phi, w, theta, strict=True)]
    if not points:
        size = jacobian.shape[-1]
        shapes = (), (size,), (size, size), phi.shape[1:], residual.shape[1:], (size,)
        return Evaluation(*(np.zeros((0, *shape)) for shape in shapes))
    return Evaluation(*(np.array(column) for column in zip(*points, strict=True)))


def evaluate(
    table: ObservationTable,
    residual: np.ndarray,
    jacobian: np.ndarray,
    phi: np.ndarray,
    w: np.ndarray,
    theta: np.ndarray,
) -> Evaluation:
    """F at one point, its gradient by all unknowns, and its Gauss-Newton curvature by θ, averaged over nodes.

    Parameters
    ----------
    residual, jacobian, phi, w, theta : [R, K], derivatives of the model [R, K, n], [5], [R, K], [n].
    """
    point = _Point.at(table, residual, phi, w, theta)
    by_variance, censored = _by_variance(point)
    by_path, (matern, by_length) = _by_path(point), point.nodes.factors.matern
    excess, others = 2 * np.exp(2 * phi[0]) * table.variance_profile, 2 * interference_db(table, phi) ** 2
    by_noise = by_variance / w + censored
    by_path = 2 * (by_path * matern).sum(), (by_path * by_length).sum()
    by_walk, by_velocity = _by_walk(point, theta)
    by_phi = np.array([(by_noise * excess).sum(), *by_path, (by_noise * others).sum(), by_walk])
    mean, sd = table.prior
    by_log_w = 0.5 * table.degrees_of_freedom * (w - 1) - variance(table, phi, w) * by_variance
    gradient, curvature = _by_theta(point, jacobian)
    return Evaluation(
        combine_nodes(table, point.nodes.nll_per_node, phi, w),
        gradient + by_velocity,
        curvature,
        by_phi + (phi - mean) / sd**2,
        table.detected * by_log_w,
        by_velocity,
    )


class _Point(NamedTuple):
    """F at every node of τ and of the gains, and how it depends on the censored entries."""

    table: ObservationTable
    nodes: NodeSolutions
    weight: np.ndarray  # of the nodes [T, M]
    sensitivity: np.ndarray  # derivatives of the censored entries' means by the residual [T, M, N, R, K]
    mills: np.ndarray  # minus the slope of -log Φ at the standardised bounds: φ(z)/Φ(z) [T, M, N]
    log_walk: float  # log ρ

    @classmethod
    def at(
        cls, table: ObservationTable, residual: np.ndarray, phi: np.ndarray, w: np.ndarray, theta: np.ndarray
    ) -> _Point:
        nodes = solve_nodes(table, residual, phi, w, theta)
        p, censored, z = nodes.factors, nodes.censored, nodes.standardised
        columns = censored.loading.swapaxes(2, 3) @ p.U.reshape(*p.U.shape[:3], -1)
        sensitivity = censored.gain[:, None] + columns.reshape(*columns.shape[:3], *residual.shape)
        mills = np.exp(-0.5 * z**2 - log_ndtr(z)) / np.sqrt(2 * np.pi)
        return cls(table, nodes, node_weights(table, nodes.nll_per_node), sensitivity, mills, phi[4])

    @property
    def unexplained(self) -> np.ndarray:
        """Part of each censored entry that its conditional mean does not follow [T, M, N, R, K]."""
        out = -self.sensitivity
        out[:, :, np.arange(out.shape[2]), self.table.censored[:, 0], self.table.censored[:, 1]] += 1.0
        return out

    @property
    def by_mean(self) -> np.ndarray:
        """F's derivatives by the censored entries' means [T, M, N]."""
        return self.mills / self.nodes.conditional_sd

    @property
    def by_variance(self) -> np.ndarray:
        """F's derivatives by the censored entries' variances [T, M, N]."""
        return 0.5 * self.mills * self.nodes.standardised / self.nodes.conditional_sd**2


def _by_theta(point: _Point, jacobian: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Gradient [n] and curvature [n, n]; θ moves the mean of a censored partial but not its bound."""
    table, s, weight, sensitivity, mills, _ = point
    p, size = s.factors, jacobian.shape[-1]
    flat = jacobian.reshape(-1, size)
    before = before_columns(table, p, np.moveaxis(jacobian, -1, 0))
    through = p.U.reshape(*p.U.shape[:3], -1) @ flat
    moved = sensitivity.reshape(*sensitivity.shape[:3], len(flat)) @ flat
    moved -= jacobian[table.censored[:, 0], table.censored[:, 1]]
    moved /= s.conditional_sd[..., None]
    gradient = -np.tensordot(weight, s.precision_residual, 2).reshape(-1) @ flat
    gradient -= np.tensordot(weight[..., None] * mills, moved, 3)
    bend = weight[..., None] * np.maximum(mills * (mills + s.standardised), 0.0)
    curvature = np.tensordot(weight.sum(axis=1), before, 1).reshape(size, -1) @ flat
    curvature = curvature - np.tensordot(weight[..., None, None] * through, through, ((0, 1, 2), (0, 1, 2)))
    return gradient, curvature + np.tensordot(bend[..., None] * moved, moved, ((0, 1, 2), (0, 1, 2)))


def _by_variance(point: _Point) -> tuple[np.ndarray, np.ndarray]:
    """Derivatives by the variance of each detected entry and of each censored entry [R, K]."""
    table, s, weight, sensitivity, *_ = point
    p = s.factors
    own = np.diagonal(p.precision, axis1=1, axis2=2).T - p.precision_sum * p.relative_precision
    path = np.tensordot(weight.sum(axis=1), np.diagonal(p.path, axis1=2, axis2=3), 1)
    detected = 0.5 * ((table.group @ path) * p.relative_precision**2 + own)
    detected -= 0.5 * np.tensordot(weight, (p.U**2).sum(axis=2) + s.precision_residual**2, 2)
    censored = np.zeros(detected.shape)
    if sensitivity.shape[2]:
        flat = sensitivity.reshape(*sensitivity.shape[:3], -1)
        through_mean = (point.by_mean[:, :, None] @ flat).reshape(s.precision_residual.shape)
        detected -= np.tensordot(weight, through_mean * s.precision_residual, 2)
        detected += np.tensordot(weight[..., None] * point.by_variance, sensitivity**2, 3)
        np.add.at(censored, tuple(table.censored.T), np.tensordot(weight, point.by_variance, 2))
    return detected, censored


def _by_path(point: _Point) -> np.ndarray:
    """Derivative by the covariance of the unknown paths, summed over paths [K, K]."""
    table, s, weight, sensitivity, *_ = point
    p, K, unknown = s.factors, len(table.distance_octaves), table.has_unknown_path

    def square(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Σ of outer products of rows [..., G, K] over the unknown paths."""
        return (unknown[:, None] * x).reshape(-1, K).T @ y.reshape(-1, K)

    by_group, u = table.group.T @ s.precision_residual, table.group.T @ p.U
    out = 0.5 * np.tensordot(weight.sum(axis=1)[:, None] * unknown, p.path, 2)
    shared = 0.5 * square(weight[..., None, None, None] * u, u)
    out -= shared + 0.5 * square(weight[..., None, None] * by_group, by_group)
    if sensitivity.shape[2]:
        remaining = table.group.T @ point.unexplained
        through_mean = (point.by_mean[:, :, None] @ remaining.reshape(*remaining.shape[:3], -1)).reshape(by_group.shape)
        out += square(weight[..., None, None] * through_mean, by_group)
        out += square((weight[..., None] * point.by_variance)[..., None, None] * remaining, remaining)
    return out


def _by_walk(point: _Point, theta: np.ndarray) -> tuple[float, np.ndarray]:
    """Derivatives by log ρ, and by θ through the velocities [n]."""
    table, s, weight, *_ = point
    p, root = s.factors, np.sqrt(weight)[..., None, None, None]
    if len(p.walk) == table.group.shape[1]:  # one recording of each path
        return 0.0, np.zeros(len(theta))
    path = np.tensordot(weight.sum(axis=1), np.diagonal(p.path, axis1=2, axis2=3), 1)
    # Derivative by ρ² W, between recordings of one path [R, R].
    out = p.precision.sum(axis=0) - p.relative_precision @ p.precision_sum.T
    out += ((table.group @ path) * p.relative_precision) @ p.relative_precision.T
    out -= _products(root * p.U) + _products(root * s.precision_residual[:, :, None])
    out *= 0.5
    if point.sensitivity.shape[2]:
        remaining, by_mean = point.unexplained, (weight[..., None] * point.by_mean)[..., None, None]
        out += _products((by_mean * remaining).sum(axis=2, keepdims=True), s.precision_residual[:, :, None])
        out += _products((weight[..., None] * point.by_variance)[..., None, None] * remaining, remaining)
    log_velocity, centred = table.velocity @ theta, centring(table)
    by_distance = centred.T @ (out + out.T) @ centred * (table.group @ table.group.T)
    faster = np.sign(log_velocity[:, None] - log_velocity)
    slope = -0.5 * np.exp(2 * point.log_walk) * (by_distance * faster).sum(axis=1)
    return float(2 * (out * p.walk).sum()), slope @ table.velocity


def _products(x: np.ndarray, y: np.ndarray | None = None) -> np.ndarray:
    """Σ x y of two recordings over nodes, rows and partials [T, M, n, R, K]: [R, R]; y = x if None."""
    R = x.shape[3]
    first, second = (np.moveaxis(one, 3, 0).reshape(R, -1) for one in (x, x if y is None else y))
    return first @ second.T


class LatentPosterior(NamedTuple):
    """Posterior means of the integrated quantities and of the residual e."""

    path: np.ndarray  # a [G, K]
    columns: np.ndarray  # Σ c_q B_q [R, K]
    discrepancy: np.ndarray  # d [R, K]
    residual: np.ndarray  # e [R, K]
    variance: np.ndarray  # of a + Σ c B + d at each entry [R, K]


def latent_posterior(
    table: ObservationTable, residual: np.ndarray, phi: np.ndarray, w: np.ndarray, theta: np.ndarray
) -> LatentPosterior:
    """Posterior means at φ, w and θ, averaged over nodes."""
    s = solve_nodes(table, residual, phi, w, theta)
    weight, p = node_weights(table, s.nll_per_node), s.factors
    columns = np.tensordot((s.q[:, :, None] @ p.root)[:, :, 0], table.columns, 1)
    common = ((table.group.T @ s.precision_residual)[..., None, :] @ p.prior[:, None])[..., 0, :]
    discrepancy = p.walk @ s.precision_residual
    own = residual - table.group @ common - columns - discrepancy
    entries = np.argwhere(np.ones(residual.shape))
    posterior_variance = predicted(table, p, residual, s.q, entries).variance
    posterior_variance = posterior_variance.reshape(*weight.shape, *residual.shape)
    parts = common, columns, discrepancy, own, posterior_variance
    return LatentPosterior(*(np.tensordot(weight, x, 2) for x in parts))


def dense_inverse(table: ObservationTable, p: CovarianceFactors) -> np.ndarray:
    """C⁻¹ of all entries at every node, 0 where no partial was detected [T, M, RK, RK]."""
    shape, count = p.relative_precision.shape, p.relative_precision.size
    unit = np.eye(count).reshape(count, *shape)
    before = before_columns(table, p, unit).reshape(-1, 1, count, count)
    u = p.U.reshape(*p.U.shape[:3], count)
    return before - u.swapaxes(2, 3) @ u


class Marginal(NamedTuple):
    """F of one table at a point, with hyperparameters and log-weights integrated out of its curvature."""

    curvature: np.ndarray  # by θ [size, size]
    log_det: float  # of the curvature by what is integrated out
    nll: float  # F


def marginalise_nuisances(
    table: ObservationTable,
    residual: np.ndarray,
    jacobian: np.ndarray,
    phi: np.ndarray,
    w: np.ndarray,
    theta: np.ndarray,
    hyper: Sequence[int],
) -> Marginal:
    """Curvature by θ with the entries `hyper` of φ and all log-weights integrated out.

    The approximation is quadratic in all of them. The curvature by θ alone is Gauss-Newton. The covariance of the walk
    is that of the velocities at θ.
    """
    detected, step = np.asarray(table.detected) > 0, 1e-4
    cross, by_weights = _by_weights(table, residual, jacobian, phi, w, theta)
    r, J, ws, thetas = (np.repeat(x[None], len(hyper) + 1, axis=0) for x in (residual, jacobian, w, theta))
    steps = np.concatenate([np.zeros((1, len(phi))), step * np.eye(len(phi))[list(hyper)]])
    found = evaluate_batch(table, r, J, phi + steps, ws, thetas)
    curvature = found.curvature[0]
    by_both = (found.by_log_w[1:] - found.by_log_w[0])[:, detected] / step
    by_phi = (found.by_phi[1:] - found.by_phi[0])[:, list(hyper)] / step
    gradient = found.gradient - found.by_covariance
    cross = np.concatenate([(gradient[1:] - gradient[0]) / step, cross])
    nuisances = np.block([[by_phi, by_both], [by_both.T, by_weights]])
    value, vector = np.linalg.eigh(0.5 * (nuisances + nuisances.T))
    value = np.maximum(value, 1e-8 * value.max())  # smaller ones are rounding
    projected = vector.T @ cross
    marginal = curvature - (projected / value[:, None]).T @ projected
    # In units in which each parameter's own curvature is 1: with clean recordings they differ by decades.
    unit = np.sqrt(np.maximum(np.diag(curvature), np.finfo(float).tiny))
    ratio, along = np.linalg.eigh(marginal / np.outer(unit, unit))
    # Without a positive curvature the quadratic approximation fails: φ and w are treated as known.
    if ratio[0] < -NEGATIVE:
        return Marginal(curvature, float(np.log(value).sum()), float(found.nll[0]))
    root = unit[:, None] * along * np.sqrt(np.maximum(ratio, 0.0))
    return Marginal(root @ root.T, float(np.log(value).sum()), float(found.nll[0]))


def _by_weights(
    table: ObservationTable,
    residual: np.ndarray,
    jacobian: np.ndarray,
    phi: np.ndarray,
    w: np.ndarray,
    theta: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """F's second derivatives by log w of the n detected entries: with θ [n, size], and with log w [n, n]."""
    at = np.flatnonzero(np.asarray(table.detected))
    J, bound = jacobian.reshape(-1, jacobian.shape[-1])[at], jacobian[tuple(table.censored.T)]
    point = _Point.at(table, residual, phi, w, theta)
    inverse, v = dense_inverse(table, point.nodes.factors), variance(table, phi, w).ravel()[at]
    cross, hessian = np.zeros((len(at), J.shape[1])), np.diag(0.5 * float(table.degrees_of_freedom) * w.ravel()[at])
    slopes = []
    for node, weight in np.ndenumerate(point.weight):
        P = inverse[node][np.ix_(at, at)]
        *first, node_cross, node_hessian = _at_node(point, node, at, P, v, J, bound)
        slopes.append((weight, *first))
        cross += weight * node_cross
        hessian += weight * node_hessian
    # F = -log Σ weight exp(-F at a node): nodes with different slopes take weight from one another.
    weight, by_theta, by_x = (np.array(x) for x in zip(*slopes, strict=True))
    deviation = by_x - weight @ by_x
    weighted = (weight[:, None] * deviation).T
    return cross - weighted @ (by_theta - weight @ by_theta), hessian - weighted @ deviation


def _at_node(
    point: _Point, node: tuple[int, ...], at: np.ndarray, P: np.ndarray, v: np.ndarray, J: np.ndarray, bound: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """F's derivatives by θ [size] and log w [n], and the second ones by both [n, size] and by log w [n, n]."""
    s = point.nodes.precision_residual[node].ravel()[at]
    PJ, vs = P @ J, v * s
    gradient, slope = -s @ J, 0.5 * v * (s**2 - np.diag(P))
    cross = -vs[:, None] * PJ
    hessian = np.outer(vs, vs) * P - 0.5 * np.outer(v, v) * P**2 - np.diag(slope)
    if not len(bound):
        return gradient, slope, cross, hessian

    z, sd, mills = point.nodes.standardised[node], point.nodes.conditional_sd[node], point.mills[node]
    t = point.sensitivity[node].reshape(len(z), -1)[:, at] / sd[:, None]  # over the standard deviation
    m, V = v * t * s, -v * t**2  # derivatives of mean and variance, over sd and variance [N, n]
    z_theta, z_x = t @ J - bound / sd[:, None], -m - 0.5 * z[:, None] * V
    bend = mills * (mills + z)
    hz = 0.5 * mills * z
    sum_t, square = mills @ t, (hz[:, None] * t).T @ t
    vv = np.outer(v, v) * P
    second = vv * (np.outer(s, sum_t) + np.outer(sum_t, s) - 2 * square)
    second += np.diag(-vs * sum_t + v * np.diag(square))
    mixed = (mills[:, None] * m).T @ V
    second -= 0.5 * (mixed + mixed.T) + 1.5 * (hz[:, None] * V).T @ V
    second += (bend[:, None] * z_x).T @ z_x
    both = -v[:, None] * sum_t[:, None] * PJ
    both += (mills[:, None] * 0.5 * V).T @ z_theta
    both += (bend[:, None] * z_x).T @ z_theta
    return gradient - mills @ z_theta, slope - mills @ z_x, cross + both, hessian + second
