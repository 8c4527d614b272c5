"""Laplace's approximation at every minimum of F, and the mixture of the minima.

At a minimum F is approximated by a quadratic in θ, φ and the log-weights. φ and the log-weights are integrated out with
it, so an interval includes that the excess itself is estimated from a few levels. The posterior weight of a minimum is
its density times its volume,

    weight ∝ exp(-F) |H|^(-1/2),     H the Hessian of F by (θ, φ, log w)

and a 95 % interval holds 95 % of the mixture. A parameter at a bound is fixed there. Its factor of the volume is that
of the exponential by which the density falls inward.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import jax
import numpy as np
from scipy.optimize import brentq
from scipy.special import erfcx
from scipy.stats import norm

from ..conversions import HALF_WIDTH_95
from .marginal_curvature import marginalise_nuisances
from .problem import FitProblem
from .refine import Minima

__all__ = ["HYPER", "Posterior", "laplace"]

# Probability on each side of a 95 % interval.
TAIL = 0.025
# Number of unknown hyperparameters φ of the tables of levels, frequencies and decays.
HYPER = (4, 1, 1)
# Curvatures across a bound below this fraction of the parameter's own curvature are rounding.
FLAT = 1e-8


@dataclass(frozen=True)
class Posterior:
    """Mixture of Gaussians in the logarithms of values: shared parameters, K_H in place of the force, velocities."""

    mean: np.ndarray  # [B, size]
    covariance: np.ndarray  # [B, size, size]; 0 for fixed parameters
    weight: np.ndarray  # posterior weights [B]

    def interval(self, change: np.ndarray) -> tuple[float, float] | None:
        """The 95 % interval of the sum of logarithms `change` [size]; None if all of them are fixed."""
        centre = self.mean @ change
        sd = np.sqrt(np.maximum(np.einsum("i,bij,j->b", change, self.covariance, change), 0.0))
        if not sd.any():
            return None
        sd = np.maximum(sd, 1e-12)
        reach = 10 * sd.max() + np.ptp(centre)

        def end(probability: float) -> float:
            low, high = float(centre.min() - reach), float(centre.max() + reach)
            root: Any = brentq(lambda x: float(self.weight @ norm.cdf((x - centre) / sd)) - probability, low, high)
            return float(root)

        return end(TAIL), end(1 - TAIL)

    def sd(self, change: np.ndarray) -> float:
        """The standard deviation of a Gaussian with the same 95 % interval; 0 if all are fixed."""
        low, high = self.interval(change) or (0.0, 0.0)
        return (high - low) / (2 * HALF_WIDTH_95)

    def condition_on(self, fixed: np.ndarray) -> Posterior:
        """Condition on the sum of logarithms `fixed` [size], at each minimum's value: gauge-fixed."""
        covariance = self.covariance.copy()
        for cov in covariance:
            variance = fixed @ cov @ fixed
            if variance > 0:
                cov -= np.outer(cov @ fixed, cov @ fixed) / variance
        return Posterior(self.mean, covariance, self.weight)


def laplace(problem: FitProblem, minima: Minima) -> Posterior:
    """The mixture of the minima of F."""
    u, candidates = problem.parametrisation, minima.candidates
    logs, covariances, volumes = [], [], []
    for i in range(len(candidates)):
        precision, log_det = _precision(problem, minima, i)
        covariance = np.zeros((u.size, u.size))
        bound = u.at_bound(candidates.theta[i])
        free = minima.optimiser.is_free & ~bound
        along = u.bound_jacobian(candidates.theta[i : i + 1], bound[None])[0]
        projected = along.T @ precision @ along
        inner = projected[np.ix_(free, free)]
        scale = 1 / np.sqrt(np.diag(inner))
        covariance[np.ix_(free, free)] = np.linalg.inv(inner * np.outer(scale, scale)) * np.outer(scale, scale)
        slope = along.T @ minima.optimiser.slope(candidates)[i]
        for k in np.flatnonzero(minima.optimiser.is_free & bound):
            across = projected[k, k] - projected[k] @ covariance @ projected[k]
            log_det += _log_curvature(abs(slope[k]), max(across, FLAT * projected[k, k]))
        tangent = u.tangent(candidates.theta[i]) @ along
        covariance = tangent @ covariance @ tangent.T
        covariances.append(0.5 * (covariance + covariance.T))  # symmetric to the last bit
        volumes.append(-0.5 * (np.linalg.slogdet(inner)[1] + log_det))
        logs.append(u.log_values(candidates.theta[i]))
    score = -minima.nll + np.array(volumes)
    weight = np.exp(score - score.max())
    return Posterior(np.array(logs), np.array(covariances), weight / weight.sum())


def _log_curvature(slope: float, curvature: float) -> float:
    """Replacement of a log curvature at a bound, from the slope and curvature with which F rises inward.

    That is -2 log of ∫ exp(-slope t - ½ curvature t²) dt, t > 0, over √(2π).
    """
    return float(np.log(curvature) - 2 * np.log(0.5 * erfcx(slope / np.sqrt(2 * curvature))))


def _precision(problem: FitProblem, minima: Minima, i: int) -> tuple[np.ndarray, float]:
    """Precision of θ [size, size] with φ and w of all tables integrated out, and the log determinant of their part."""
    u, candidates = problem.parametrisation, minima.candidates
    precision = np.diag(np.where(minima.optimiser.is_free, u.precision, 0.0))
    log_det = 0.0
    for table, part, hyper in zip(minima.optimiser.tables, candidates.parts, HYPER, strict=True):
        curvature, volume = marginalise_nuisances(table, jax.tree.map(lambda x: x[i], part), hyper)
        precision += curvature
        log_det += volume
    return precision, log_det
