"""How sure: Laplace's approximation at every minimum of F, and the mixture of the minima.

At a minimum F is a parabola in θ, φ and the log-weights; φ and the weights are integrated out with it, so an interval
knows that the excess is itself read off a few levels. A minimum's share is its density times its volume,

    share ∝ exp(-F) |H|^(-1/2),     H the Hessian of F by (θ, φ, log w)

and a 95 % interval holds 95 % of the mixture. What lies at a bound is held there, and its share of the volume is that
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

from ..conversions import NORMAL
from .marginal_curvature import marginalise_nuisances
from .problem import FitProblem
from .refine import Minima

__all__ = ["HYPER", "Posterior", "laplace"]

# Of a two-sided 95 % interval.
TAIL = 0.025
# How many of φ are unknown, of the tables of levels, frequencies and decays.
HYPER = (4, 1, 1)
# A curvature across an edge below this share of its own is rounding.
FLAT = 1e-8


@dataclass(frozen=True)
class Posterior:
    """A mixture of Gaussians in the logarithms of values: what is shared, K_H in the force's place, then velocities."""

    mean: np.ndarray  # [B, size]
    covariance: np.ndarray  # [B, size, size]; 0 for what is held
    share: np.ndarray  # [B]

    def interval(self, change: np.ndarray) -> tuple[float, float] | None:
        """The 95 % interval of the sum of logarithms `change` [size]; None for what is held."""
        centre = self.mean @ change
        sd = np.sqrt(np.maximum(np.einsum("i,bij,j->b", change, self.covariance, change), 0.0))
        if not sd.any():
            return None
        sd = np.maximum(sd, 1e-12)
        reach = 10 * sd.max() + np.ptp(centre)

        def end(probability: float) -> float:
            low, high = float(centre.min() - reach), float(centre.max() + reach)
            root: Any = brentq(lambda x: float(self.share @ norm.cdf((x - centre) / sd)) - probability, low, high)
            return float(root)

        return end(TAIL), end(1 - TAIL)

    def spread(self, change: np.ndarray) -> float:
        """The standard deviation of a Gaussian with the same 95 % interval; 0 for what is held."""
        low, high = self.interval(change) or (0.0, 0.0)
        return (high - low) / (2 * NORMAL)

    def given(self, held: np.ndarray) -> Posterior:
        """The same with the sum of logarithms `held` [size] fixed at each minimum's value: gauge-fixed."""
        covariance = self.covariance.copy()
        for cov in covariance:
            variance = held @ cov @ held
            if variance > 0:
                cov -= np.outer(cov @ held, cov @ held) / variance
        return Posterior(self.mean, covariance, self.share)


def laplace(problem: FitProblem, minima: Minima) -> Posterior:
    """The mixture of the minima of F."""
    u, people = problem.unknowns, minima.people
    logs, covariances, volumes = [], [], []
    for i in range(len(people)):
        precision, log_det = _precision(problem, minima, i)
        covariance = np.zeros((u.size, u.size))
        bound = u.at_bound(people.theta[i])
        moves = minima.descent.is_free & ~bound
        along = u.bound_jacobian(people.theta[i : i + 1], bound[None])[0]
        whole = along.T @ precision @ along
        inner = whole[np.ix_(moves, moves)]
        scale = 1 / np.sqrt(np.diag(inner))
        covariance[np.ix_(moves, moves)] = np.linalg.inv(inner * np.outer(scale, scale)) * np.outer(scale, scale)
        slope = along.T @ minima.descent.slope(people)[i]
        for edge in np.flatnonzero(minima.descent.is_free & bound):
            across = whole[edge, edge] - whole[edge] @ covariance @ whole[edge]
            log_det += _log_curvature(abs(slope[edge]), max(across, FLAT * whole[edge, edge]))
        tangent = u.tangent(people.theta[i]) @ along
        covariance = tangent @ covariance @ tangent.T
        covariances.append(0.5 * (covariance + covariance.T))  # to the last bit
        volumes.append(-0.5 * (np.linalg.slogdet(inner)[1] + log_det))
        logs.append(u.log_values(people.theta[i]))
    score = -minima.F + np.array(volumes)
    share = np.exp(score - score.max())
    return Posterior(np.array(logs), np.array(covariances), share / share.sum())


def _log_curvature(slope: float, curvature: float) -> float:
    """What at a bound stands for the logarithm of a curvature, where F rises inward by a slope and a curvature.

    That is -2 log of ∫ exp(-slope t - ½ curvature t²) dt, t > 0, over √(2π).
    """
    return float(np.log(curvature) - 2 * np.log(0.5 * erfcx(slope / np.sqrt(2 * curvature))))


def _precision(problem: FitProblem, minima: Minima, i: int) -> tuple[np.ndarray, float]:
    """Of θ [size, size] with φ and w of all tables integrated out, and the logarithm of the volume these had."""
    u, people = problem.unknowns, minima.people
    precision = np.diag(np.where(minima.descent.is_free, u.precision, 0.0))
    volume = 0.0
    for table, part, hyper in zip(minima.descent.tables, people.parts, HYPER, strict=True):
        more, own = marginalise_nuisances(table, jax.tree.map(lambda x: x[i], part), hyper)
        precision += more
        volume += own
    return precision, volume
