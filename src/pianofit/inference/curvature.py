"""Second derivatives of F by the log-weights of Student's t, and the information that they take from θ.

By the log-weights x the Hessian has a closed form in P = C⁻¹: a weight changes one entry of C's diagonal,
∂C/∂x_i = -v_i, v = var/w. At one node

    ∂F/∂x_i = ½ v_i (s_i² - P_ii)      ∂²F/∂x_i∂x_j = v_i v_j (s_i P_ij s_j - ½ P_ij²) - δ_ij ∂F/∂x_i
                                       ∂²F/∂θ∂x_i = -(JᵀP)_i v_i s_i

and of a censored partial, with m = tᵀr,

    ∂m/∂x_i = v_i t_i s_i              ∂V/∂x_i = -v_i t_i²              ∂t_j/∂x_i = v_i P_ji t_i.

Nodes are summed as in F.
"""

from typing import NamedTuple

import numpy as np

from .derivatives import Points, dense_inverse
from .likelihood import ObservationTable, variance


class TablePoint(NamedTuple):
    """One table at a minimum."""

    table: ObservationTable
    residual: np.ndarray  # [R, K]
    jacobian: np.ndarray  # [R, K, size]
    phi: np.ndarray  # [5]
    w: np.ndarray  # [R, K]
    theta: np.ndarray  # [size]
    hyper: list[int]  # indices of the unknown hyperparameters φ


def information_lost_to_weights(point: TablePoint) -> np.ndarray:
    """Decrease of F's curvature by θ [size, size] if the log-weights are unknown, by a quadratic approximation.

    The covariance of the walk is that of the velocities at θ.
    """
    cross, by_weights = _by_weights(point)
    value, vector = np.linalg.eigh(0.5 * (by_weights + by_weights.T))
    value = np.maximum(value, 1e-8 * value.max())  # smaller ones are rounding
    projected = vector.T @ cross
    return (projected / value[:, None]).T @ projected


def _by_weights(point: TablePoint) -> tuple[np.ndarray, np.ndarray]:
    """F's second derivatives by log w of the n detected entries: with θ [n, size], and with log w [n, n]."""
    table, residual, jacobian, phi, w, theta, _ = point
    at = np.flatnonzero(np.asarray(table.detected))
    J, bound = jacobian.reshape(-1, jacobian.shape[-1])[at], jacobian[tuple(table.censored.T)]
    one = [x[None] for x in (residual, phi, w, theta)]
    points = Points.at(table, *one)
    inverse, v = dense_inverse(table, points.nodes.factors)[0], variance(table, *one[1:3]).ravel()[at]
    cross, hessian = np.zeros((len(at), J.shape[1])), np.diag(0.5 * float(table.degrees_of_freedom) * w.ravel()[at])
    slopes = []
    for node, weight in np.ndenumerate(points.weight[0]):
        P = inverse[node][np.ix_(at, at)]
        *first, node_cross, node_hessian = _at_node(points, node, at, P, v, J, bound)
        slopes.append((weight, *first))
        cross += weight * node_cross
        hessian += weight * node_hessian
    # F = -log Σ weight exp(-F at a node): nodes with different slopes take weight from one another.
    weight, by_theta, by_x = (np.array(x) for x in zip(*slopes, strict=True))
    deviation = by_x - weight @ by_x
    weighted = (weight[:, None] * deviation).T
    return cross - weighted @ (by_theta - weight @ by_theta), hessian - weighted @ deviation


def _at_node(
    point: Points,
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


def inverse_curvature(curvature: np.ndarray) -> np.ndarray:
    """Inverses of curvatures by θ [..., n, n], in units in which each parameter's own curvature is 1.

    With clean recordings the curvatures of two parameters differ by decades.
    """
    unit = 1 / np.sqrt(np.diagonal(curvature, axis1=-2, axis2=-1))
    scale = unit[..., :, None] * unit[..., None, :]
    return np.linalg.inv(curvature * scale) * scale
