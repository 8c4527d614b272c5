"""How F curves by θ once φ and all log-weights have been integrated out, as a parabola in them.

By the log-weights x the Hessian has a closed form in P = C⁻¹: a weight changes one entry of C's diagonal,
∂C/∂x_i = -v_i, v = var/w. With s = Pr, at one node of τ and of the gains

    ∂F/∂x_i = ½ v_i (s_i² - P_ii)      ∂²F/∂x_i∂x_j = v_i v_j (s_i P_ij s_j - ½ P_ij²) - δ_ij ∂F/∂x_i
    ∂F/∂θ = -Jᵀs                       ∂²F/∂θ∂x_i = -(JᵀP)_i v_i s_i

and an absent partial adds -log Φ(z), z = (bound - m)/√V, whose mean m = tᵀr and variance V change by

    ∂m/∂x_i = v_i t_i s_i              ∂V/∂x_i = -v_i t_i²              ∂t_j/∂x_i = v_i P_ji t_i.

Nodes are summed over as F sums over them. The few columns by φ are differences of the exact gradient.
"""

from __future__ import annotations

import numpy as np

from .candidates import TableState
from .derivatives import DenseTerms, dense_terms, evaluate_batch
from .likelihood import ObservationTable

__all__ = ["marginalise_nuisances"]

# Step of the differences of F's exact gradient by φ.
STEP = 1e-4
# Curvatures by φ and log w below this share of the largest are rounding.
FLOOR = 1e-8
# An eigenvalue of a curvature so far below 0, over what it is with φ and w known, is no rounding.
NEGATIVE = 1e-3


def marginalise_nuisances(table: ObservationTable, point: TableState, hyper: int) -> tuple[np.ndarray, float]:
    """Curvature by θ with the first `hyper` of φ and all log-weights integrated out [size, size], and their log volume.

    By θ alone it is Gauss and Newton's.

    Parameters
    ----------
    point : one candidate's, without the leading axis.
    """
    phi, w, residual, jacobian, there, _ = point
    found = np.asarray(table.detected) > 0
    cross, by_weights = _by_weights(table, residual, jacobian, phi, w)
    r, J, phis, ws = (np.repeat(x[None], hyper, axis=0) for x in (residual, jacobian, phi, w))
    moved = evaluate_batch(table, r, J, phis + STEP * np.eye(len(phi))[:hyper], ws)
    by_both = (moved.by_log_w - there.by_log_w)[:, found] / STEP
    by_phi = (moved.by_phi - there.by_phi)[:, :hyper] / STEP
    cross = np.concatenate([(moved.gradient - there.gradient) / STEP, cross])
    own = np.block([[by_phi, by_both], [by_both.T, by_weights]])
    value, vector = np.linalg.eigh(0.5 * (own + own.T))
    value = np.maximum(value, FLOOR * value.max())
    projected = vector.T @ cross
    curvature = there.curvature - (projected / value[:, None]).T @ projected
    # In units in which each unknown's own curvature is 1: of clean sounds they are decades apart.
    unit = np.sqrt(np.maximum(np.diag(there.curvature), np.finfo(float).tiny))
    share, along = np.linalg.eigh(curvature / np.outer(unit, unit))
    # A curvature that is not positive says only that the parabola ends here: then φ and w count as known.
    if share[0] < -NEGATIVE:
        return there.curvature, float(np.log(value).sum())
    root = unit[:, None] * along * np.sqrt(np.maximum(share, 0.0))
    return root @ root.T, float(np.log(value).sum())


def _by_weights(
    table: ObservationTable, residual: np.ndarray, jacobian: np.ndarray, phi: np.ndarray, w: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """F's second derivatives by log w of the n entries found: and by θ [n, size], and by log w [n, n]."""
    at = np.flatnonzero(np.asarray(table.detected))
    J, bound = jacobian.reshape(-1, jacobian.shape[-1])[at], jacobian[tuple(table.censored.T)]
    everything = dense_terms(table, residual, phi, w)
    v = everything.variance.ravel()[at]
    cross, own = np.zeros((len(at), J.shape[1])), np.diag(0.5 * float(table.degrees_of_freedom) * w.ravel()[at])
    slopes = []
    for node, weight in np.ndenumerate(everything.weight):
        *first, more_cross, more = _at_node(everything, node, at, v, J, bound)
        slopes.append((weight, *first))
        cross += weight * more_cross
        own += weight * more
    # F = -log Σ share exp(-F of each): nodes whose slopes differ take weight from one another.
    weight, by_theta, by_x = (np.array(x) for x in zip(*slopes, strict=True))
    away = by_x - weight @ by_x
    return cross - (weight[:, None] * away).T @ (by_theta - weight @ by_theta), own - (weight[:, None] * away).T @ away


def _at_node(
    e: DenseTerms, node: tuple[int, ...], at: np.ndarray, v: np.ndarray, J: np.ndarray, bound: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """F's derivatives by θ [size] and log w [n], and the second ones by both [n, size] and by log w [n, n]."""
    P, s = e.inverse[node][np.ix_(at, at)], e.push[node].ravel()[at]
    PJ, vs = P @ J, v * s
    gradient, slope = -s @ J, 0.5 * v * (s**2 - np.diag(P))
    cross = -vs[:, None] * PJ
    own = np.outer(vs, vs) * P - 0.5 * np.outer(v, v) * P**2 - np.diag(slope)
    if not len(bound):
        return gradient, slope, cross, own

    z, sd, steep = e.z[node], e.spread[node], e.hazard[node]
    t = e.pull[node].reshape(len(z), -1)[:, at] / sd[:, None]  # over the standard deviation
    m, V = v * t * s, -v * t**2  # of mean and variance, over deviation and variance [N, n]
    z_theta, z_x = t @ J - bound / sd[:, None], -m - 0.5 * z[:, None] * V
    bend = steep * (steep + z)
    hz = 0.5 * steep * z
    pulled, square = steep @ t, (hz[:, None] * t).T @ t
    vv = np.outer(v, v) * P
    second = vv * (np.outer(s, pulled) + np.outer(pulled, s) - 2 * square)
    second += np.diag(-vs * pulled + v * np.diag(square))
    mixed = (steep[:, None] * m).T @ V
    second -= 0.5 * (mixed + mixed.T) + 1.5 * (hz[:, None] * V).T @ V
    second += (bend[:, None] * z_x).T @ z_x
    both = (
        -v[:, None] * pulled[:, None] * PJ + (steep[:, None] * 0.5 * V).T @ z_theta + (bend[:, None] * z_x).T @ z_theta
    )
    return gradient - steep @ z_theta, slope - steep @ z_x, cross + both, own + second
