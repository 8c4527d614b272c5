"""Curvature of F by θ with φ and all log-weights integrated out, in a quadratic approximation.

By the log-weights x the Hessian has a closed form in P = C⁻¹: a weight changes one entry of C's diagonal,
∂C/∂x_i = -v_i, v = var/w. With s = Pr, at one node of τ and of the gains

    ∂F/∂x_i = ½ v_i (s_i² - P_ii)      ∂²F/∂x_i∂x_j = v_i v_j (s_i P_ij s_j - ½ P_ij²) - δ_ij ∂F/∂x_i
    ∂F/∂θ = -Jᵀs                       ∂²F/∂θ∂x_i = -(JᵀP)_i v_i s_i

A censored partial adds -log Φ(z), z = (bound - m)/√V. Its mean m = tᵀr and variance V change by

    ∂m/∂x_i = v_i t_i s_i              ∂V/∂x_i = -v_i t_i²              ∂t_j/∂x_i = v_i P_ji t_i.

Nodes are summed as in F. The few columns by φ are differences of the exact gradient.
"""

from __future__ import annotations

import numpy as np

from .candidates import TableState
from .derivatives import DenseTerms, dense_terms, evaluate_batch
from .likelihood import ObservationTable

__all__ = ["marginalise_nuisances"]

# Step of the differences of F's exact gradient by φ.
STEP = 1e-4
# Curvatures by φ and log w below this fraction of the largest are rounding.
FLOOR = 1e-8
# A negative eigenvalue of the curvature above this is not rounding, relative to the curvature with φ and w fixed.
NEGATIVE = 1e-3


def marginalise_nuisances(table: ObservationTable, point: TableState, hyper: int) -> tuple[np.ndarray, float]:
    """Curvature by θ with the first `hyper` of φ and all log-weights integrated out [size, size], and their log volume.

    The curvature by θ alone is Gauss-Newton.

    Parameters
    ----------
    point : the state of one candidate, without the leading axis.
    """
    phi, w, residual, jacobian, derivatives, _ = point
    detected = np.asarray(table.detected) > 0
    cross, by_weights = _by_weights(table, residual, jacobian, phi, w)
    r, J, phis, ws = (np.repeat(x[None], hyper, axis=0) for x in (residual, jacobian, phi, w))
    moved = evaluate_batch(table, r, J, phis + STEP * np.eye(len(phi))[:hyper], ws)
    by_both = (moved.by_log_w - derivatives.by_log_w)[:, detected] / STEP
    by_phi = (moved.by_phi - derivatives.by_phi)[:, :hyper] / STEP
    cross = np.concatenate([(moved.gradient - derivatives.gradient) / STEP, cross])
    nuisances = np.block([[by_phi, by_both], [by_both.T, by_weights]])
    value, vector = np.linalg.eigh(0.5 * (nuisances + nuisances.T))
    value = np.maximum(value, FLOOR * value.max())
    projected = vector.T @ cross
    curvature = derivatives.curvature - (projected / value[:, None]).T @ projected
    # In units in which each parameter's own curvature is 1: with clean recordings they differ by decades.
    unit = np.sqrt(np.maximum(np.diag(derivatives.curvature), np.finfo(float).tiny))
    ratio, along = np.linalg.eigh(curvature / np.outer(unit, unit))
    # Without a positive curvature the quadratic approximation fails: φ and w are treated as known.
    if ratio[0] < -NEGATIVE:
        return derivatives.curvature, float(np.log(value).sum())
    root = unit[:, None] * along * np.sqrt(np.maximum(ratio, 0.0))
    return root @ root.T, float(np.log(value).sum())


def _by_weights(
    table: ObservationTable, residual: np.ndarray, jacobian: np.ndarray, phi: np.ndarray, w: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """F's second derivatives by log w of the n detected entries: with θ [n, size], and with log w [n, n]."""
    at = np.flatnonzero(np.asarray(table.detected))
    J, bound = jacobian.reshape(-1, jacobian.shape[-1])[at], jacobian[tuple(table.censored.T)]
    terms = dense_terms(table, residual, phi, w)
    v = terms.variance.ravel()[at]
    cross, hessian = np.zeros((len(at), J.shape[1])), np.diag(0.5 * float(table.degrees_of_freedom) * w.ravel()[at])
    slopes = []
    for node, weight in np.ndenumerate(terms.weight):
        *first, node_cross, node_hessian = _at_node(terms, node, at, v, J, bound)
        slopes.append((weight, *first))
        cross += weight * node_cross
        hessian += weight * node_hessian
    # F = -log Σ weight exp(-F at a node): nodes with different slopes take weight from one another.
    weight, by_theta, by_x = (np.array(x) for x in zip(*slopes, strict=True))
    deviation = by_x - weight @ by_x
    weighted = (weight[:, None] * deviation).T
    return cross - weighted @ (by_theta - weight @ by_theta), hessian - weighted @ deviation


def _at_node(
    e: DenseTerms, node: tuple[int, ...], at: np.ndarray, v: np.ndarray, J: np.ndarray, bound: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """F's derivatives by θ [size] and log w [n], and the second ones by both [n, size] and by log w [n, n]."""
    P, s = e.inverse[node][np.ix_(at, at)], e.precision_residual[node].ravel()[at]
    PJ, vs = P @ J, v * s
    gradient, slope = -s @ J, 0.5 * v * (s**2 - np.diag(P))
    cross = -vs[:, None] * PJ
    hessian = np.outer(vs, vs) * P - 0.5 * np.outer(v, v) * P**2 - np.diag(slope)
    if not len(bound):
        return gradient, slope, cross, hessian

    z, sd, mills = e.standardised[node], e.conditional_sd[node], e.mills[node]
    t = e.sensitivity[node].reshape(len(z), -1)[:, at] / sd[:, None]  # over the standard deviation
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
