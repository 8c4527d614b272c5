"""Integration over the hyperparameters φ of all tables at a minimum of F, by importance sampling.

F has its minimum at the φ with which one θ describes the tables best, and every free parameter lowers the excess σ and
the size A of the smooth deviations there. With few partials this bias, and not the noise, would set the intervals. The
marginal posterior of φ does not have it. With F quadratic in θ about the minimum, with gradient g and curvature H,

    p(φ | data) ∝ exp(-F + ½ gᵀH⁻¹g) |H|^(-1/2)

and given φ, θ is Gaussian with covariance H⁻¹ about its minimum, which lies by -H⁻¹g from that of F. The posterior of
θ is the mean of these Gaussians over p(φ | data) (Rue, Martino and Chopin 2009, J. R. Stat. Soc. B 71).

φ is drawn from Student's t about the mode of p(φ | data), with the curvature there. The ratio of the two densities is
the weight of a draw. The log-weights w of partials take their expectations at each φ.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.linalg import block_diag
from scipy.special import gammaincinv, ndtri

from ..sobol import sobol_points
from .curvature import TablePoint, inverse_curvature
from .derivatives import Evaluation, evaluate
from .likelihood import em_weights

# Draws of φ: a power of two, as Sobol points require.
DRAWS = 64
# Degrees of freedom of the t distribution: its tails hold more than those of a posterior.
DEGREES = 6.0
# Factor of its width: a proposal that is too wide wastes draws, and one that is too narrow is wrong.
WIDENING = 1.15
# Steps of Newton's method from the minimum of F to the mode,
MODE_STEPS = 2
# their longest, in standard deviations of the prior,
LONGEST = 1.0
# and the least precision there, relative to that of the prior: the quadratic approximation of log p(φ) fails below.
LEAST_PRECISION = 0.5
# Change of φ for a difference of the exact gradient.
STEP = 1e-4


class Quadratic(NamedTuple):
    """F about one θ at many φ; [N, ...]."""

    value: np.ndarray
    gradient: np.ndarray  # by θ [N, size]
    curvature: np.ndarray  # by θ [N, size, size]

    def along(self, axes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Gradient [N, axes] and curvature [N, axes, axes] along directions of θ [size, axes]."""
        return self.gradient @ axes, axes.T @ self.curvature @ axes


def draw_hyperparameters(
    points: Sequence[TablePoint], prior: Quadratic, axes: np.ndarray
) -> tuple[Quadratic, np.ndarray]:
    """F at draws of φ of all tables about a minimum of F, and minus the logarithms of their density [N].

    Parameters
    ----------
    prior : of θ at the minimum [1, ...].
    axes : the directions in which θ is free [size, axes].
    """
    mean, root = _proposal(points, prior, axes)
    uniform = sobol_points(len(mean) + 1, DRAWS, 0).clip(1e-6, 1 - 1e-6)
    # A chi-squared variable over its degrees of freedom.
    spread = 2 * gammaincinv(0.5 * DEGREES, uniform[:, -1]) / DEGREES
    normal = ndtri(uniform[:, :-1]) / np.sqrt(spread)[:, None]
    log_density = -0.5 * (DEGREES + len(mean)) * np.log1p((normal**2).sum(axis=1) / DEGREES)
    phi = _by_table(points, mean + normal @ root.T)
    w = [
        em_weights(point.table, _evaluate(point, own, point.w).by_log_w, point.w)
        for point, own in zip(points, phi, strict=True)
    ]
    found = [_evaluate(point, own, weights) for point, own, weights in zip(points, phi, w, strict=True)]
    log_volume = np.log(np.diag(root)).sum() + 0.5 * len(mean) * np.log(2 * np.pi)
    return _total(prior, found), log_volume - log_density


def _proposal(points: Sequence[TablePoint], prior: Quadratic, axes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mode of p(φ | data) [hyperparameters] and a root of the covariance there, by Newton's method."""
    mean = np.concatenate([point.phi[point.hyper] for point in points])
    sd = np.concatenate([point.table.prior[1][point.hyper] for point in points])
    value, vector = np.ones(len(mean)), np.eye(len(mean))
    for _ in range(MODE_STEPS):
        slope, precision = _slope_and_precision(points, prior, axes, mean)
        value, vector = np.linalg.eigh(np.outer(sd, sd) * precision)
        value = np.maximum(value, LEAST_PRECISION)
        step = -(vector / value) @ vector.T @ (sd * slope)
        mean = mean + sd * np.clip(step, -LONGEST, LONGEST)
    covariance = np.outer(sd, sd) * ((vector / value) @ vector.T)
    return mean, WIDENING * np.linalg.cholesky(covariance)


def _slope_and_precision(
    points: Sequence[TablePoint], prior: Quadratic, axes: np.ndarray, at: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Gradient of -log p(φ | data) at φ [hyperparameters], and its curvature without that of log|H|."""
    tables, here = [], []
    for point, phi in zip(points, _by_table(points, at[None]), strict=True):
        steps = np.concatenate([np.zeros((1, phi.shape[1])), STEP * np.eye(phi.shape[1])[point.hyper]])
        found = _evaluate(point, phi + steps, point.w)
        tables.append((found, point.hyper))
        here.append(Evaluation._make(x[:1] for x in found))
    gradient, curvature = (x[0] for x in _total(prior, here).along(axes))
    inverse = inverse_curvature(curvature)
    shift = -inverse @ gradient
    slopes, rows, blocks = [], [], []
    for found, own in tables:
        by_theta = found.gradient - found.by_covariance
        of_gradient = (by_theta[1:] - by_theta[0]) @ axes / STEP
        of_curvature = axes.T @ (found.curvature[1:] - found.curvature[0]) @ axes / STEP
        # The minimum by θ moves with φ, and so does the volume.
        of_minimum = of_gradient @ shift + 0.5 * np.einsum("i,nij,j->n", shift, of_curvature, shift)
        slopes.append(found.by_phi[0, own] + of_minimum + 0.5 * np.einsum("ij,nji->n", inverse, of_curvature))
        block = (found.by_phi[1:] - found.by_phi[0])[:, own] / STEP
        blocks.append(0.5 * (block + block.T))
        rows.append(of_gradient)
    cross = np.concatenate(rows)
    return np.concatenate(slopes), block_diag(*blocks) - cross @ inverse @ cross.T


def _by_table(points: Sequence[TablePoint], draws: np.ndarray) -> list[np.ndarray]:
    """φ of every table [N, 5] from the unknown hyperparameters of all [N, hyperparameters]."""
    out, at = [], 0
    for point in points:
        phi = np.tile(point.phi, (len(draws), 1))
        phi[:, point.hyper] = draws[:, at : at + len(point.hyper)]
        out.append(phi)
        at += len(point.hyper)
    return out


def _evaluate(point: TablePoint, phi: np.ndarray, w: np.ndarray) -> Evaluation:
    """F of a table at many φ [N, 5] and w, the same for all [R, K] or for each."""

    def everywhere(x: np.ndarray) -> np.ndarray:
        return np.broadcast_to(x, (len(phi), *x.shape))

    residual, jacobian, theta = everywhere(point.residual), everywhere(point.jacobian), everywhere(point.theta)
    return evaluate(point.table, residual, jacobian, phi, np.broadcast_to(w, residual.shape), theta)


def _total(prior: Quadratic, found: Sequence[Evaluation]) -> Quadratic:
    """F of all tables and of the prior; the covariance of the walk is that of the velocities at θ."""
    return Quadratic(
        prior.value + sum(one.nll for one in found),
        prior.gradient + sum(one.gradient - one.by_covariance for one in found),
        prior.curvature + sum(one.curvature for one in found),
    )
