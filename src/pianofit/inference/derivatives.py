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
    flattened,
    interference_db,
    node_weights,
    predicted,
    same_path,
    solve_nodes,
    variance,
)

# A negative eigenvalue of the curvature above this is not rounding, relative to the curvature with φ and w fixed.
NEGATIVE = 1e-3


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
    points = residual, jacobian, phi, w, theta
    calls = [_evaluate(table, *(x[i : i + count] for x in points)) for i in range(0, max(len(residual), 1), count)]
    return calls[0] if len(calls) == 1 else Evaluation(*map(np.concatenate, zip(*calls, strict=True)))


def _evaluate(
    table: ObservationTable,
    residual: np.ndarray,
    jacobian: np.ndarray,
    phi: np.ndarray,
    w: np.ndarray,
    theta: np.ndarray,
) -> Evaluation:
    """`evaluate` in one call."""
    point = _Points.at(table, residual, phi, w, theta)
    by_variance, censored = _by_variance(point)
    matern, by_length = point.nodes.factors.matern
    by_path, by_noise = _by_path(point), by_variance / w + censored
    excess = 2 * np.exp(2 * phi[:, 0, None, None]) * table.variance_profile
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


class _Points(NamedTuple):
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
    ) -> _Points:
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


def _by_theta(point: _Points, jacobian: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
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


def _by_variance(point: _Points) -> tuple[np.ndarray, np.ndarray]:
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


def _through_mean(point: _Points, x: np.ndarray) -> np.ndarray:
    """Σ of x [B, T, M, N, ...] over the censored entries, by F's derivatives by their means [B, T, M, ...]."""
    return (point.by_mean[..., None, :] @ flattened(x)).reshape(*x.shape[:3], *x.shape[4:])


def _by_path(point: _Points) -> np.ndarray:
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


def _by_walk(point: _Points, theta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
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
    columns: np.ndarray  # Σ c_q B_q [R, K]
    discrepancy: np.ndarray  # d [R, K]
    residual: np.ndarray  # e [R, K]
    variance: np.ndarray  # of a + Σ c B + d at each entry [R, K]


def latent_posterior(
    table: ObservationTable, residual: np.ndarray, phi: np.ndarray, w: np.ndarray, theta: np.ndarray
) -> LatentPosterior:
    """Posterior means at one φ, w and θ, averaged over nodes."""
    s = solve_nodes(table, *(x[None] for x in (residual, phi, w, theta)))
    weight, p = node_weights(table, s.nll_per_node), s.factors
    columns = np.tensordot((s.q[..., None, :] @ p.root)[..., 0, :], table.columns, 1)
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
    found = evaluate(table, r, J, phi + steps, ws, thetas)
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
    one = [x[None] for x in (residual, phi, w, theta)]
    point = _Points.at(table, *one)
    inverse, v = dense_inverse(table, point.nodes.factors)[0], variance(table, *one[1:3]).ravel()[at]
    cross, hessian = np.zeros((len(at), J.shape[1])), np.diag(0.5 * float(table.degrees_of_freedom) * w.ravel()[at])
    slopes = []
    for node, weight in np.ndenumerate(point.weight[0]):
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
    point: _Points,
    node: tuple[int, ...],
    at: np.ndarray,
    P: np.ndarray,
    v: np.ndarray,
    J: np.ndarray,
    bound: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """F's derivatives by θ [size] and log w [n], and the second ones by both [n, size] and by log w [n, n]."""
    at_node = 0, *node
    s = point.nodes.precision_residual[at_node].ravel()[at]
    PJ, vs = P @ J, v * s
    gradient, slope = -s @ J, 0.5 * v * (s**2 - np.diag(P))
    cross = -vs[:, None] * PJ
    hessian = np.outer(vs, vs) * P - 0.5 * np.outer(v, v) * P**2 - np.diag(slope)
    if not len(bound):
        return gradient, slope, cross, hessian

    z, sd, mills = (x[at_node] for x in (point.nodes.standardised, point.nodes.conditional_sd, point.mills))
    t = point.sensitivity[at_node].reshape(len(z), -1)[:, at] / sd[:, None]  # over the standard deviation
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
