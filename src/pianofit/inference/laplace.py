"""Laplace's approximation at every minimum of F, and the mixture of the minima.

At a minimum F is approximated by a quadratic in θ for every φ, and φ is integrated over (hyperparameters.py). The
posterior weight of a minimum is its density times its volume,

    weight ∝ ∫ exp(-F + ½ gᵀH⁻¹g) |H|^(-1/2) dφ,     g and H the gradient and curvature of F by θ at the minimum

and a 95 % interval holds 95 % of the mixture. A parameter at a bound is fixed there. Its factor of the volume is that
of the exponential by which the density falls inward. An `Interval` by profiles or by draws has the same form.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from scipy.special import erfcx, ndtr

from ..conversions import HALF_WIDTH_95
from .curvature import TablePoint, information_lost_to_weights, inverse_curvature
from .hyperparameters import Quadratic, draw_hyperparameters
from .objective import Candidates, Objective

# Indices of the unknown hyperparameters φ of the tables of levels, frequencies and decays.
HYPER = ([0, 1, 2, 3, 4], [0, 1, 2], [0, 1, 2])
# Largest share of the information about a combination of parameters that unknown weights take: more is the effect of an
# outlier, for which the quadratic approximation fails.
LARGEST_LOSS = 0.75
# Bisections of the ends of an interval: the last is within 1e-15 of the whole range of the search.
BISECTIONS = 50
# Minima are the same if every parameter agrees within this, in standard deviations of the lower one.
SAME = 1.0
# Curvatures across a bound below this fraction of the parameter's own curvature are rounding.
FLAT = 1e-8


@dataclass(frozen=True)
class Interval:
    """A 95 % interval of a value."""

    low: float
    high: float
    method: str  # laplace, profile or posterior
    unbounded: tuple[str, ...] = ()  # ends, low or high, that are limits of the search range


class ObservedValues(NamedTuple):
    """Observations of one table [observations each]."""

    value: np.ndarray  # levels and bounds of censored partials, dB; cents and log decays over the string model
    recording: np.ndarray  # int, its place in the order given, from 1; 0 where a value is of all recordings
    partial: np.ndarray  # int, k; 0 for the knock


@dataclass(frozen=True)
class IntervalResult:
    """Intervals by a profile or by posterior samples."""

    method: str
    intervals: dict[str, Interval]  # by parameter
    messages: tuple[str, ...] = ()
    diagnostics: dict = field(default_factory=dict)
    draws: dict[str, np.ndarray] | None = None  # values [chains, draws] of all searched parameters, by name
    # Log density of each observation given all others [chains, draws, observations], by table.
    log_likelihood: dict[str, np.ndarray] = field(default_factory=dict)
    observed: dict[str, ObservedValues] = field(default_factory=dict)


class Minima(NamedTuple):
    """Minima of F, the one with the largest posterior weight first; [B, ...]."""

    candidates: Candidates
    nll: np.ndarray  # of all tables and priors
    converged: np.ndarray

    def take(self, which: np.ndarray) -> Minima:
        """Select some, in this order."""
        return Minima(self.candidates.take(which), self.nll[which], self.converged[which])


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
        reach, probability = 10 * sd.max() + np.ptp(centre), np.array([0.025, 0.975])
        low, high = np.full(2, centre.min() - reach), np.full(2, centre.max() + reach)
        for _ in range(BISECTIONS):
            middle = 0.5 * (low + high)
            below = ndtr((middle[:, None] - centre) / sd) @ self.weight < probability
            low, high = np.where(below, middle, low), np.where(below, high, middle)
        first, last = (0.5 * (low + high)).tolist()
        return first, last

    def value_interval(
        self, change: np.ndarray, value: float, bounds: tuple[float, float] = (-np.inf, np.inf)
    ) -> Interval | None:
        """The 95 % interval of a value with the logarithms `change` [size], about the `value` shown.

        The logarithms `bounds` limit it.
        """
        interval = self.interval(change)
        if interval is None:
            return None
        ends = np.clip(np.add(interval, np.log(value) - float(self.mean[0] @ change)), *bounds)
        sides = zip(("low", "high"), ends, bounds, strict=True)
        low, high = np.exp(np.minimum(ends, 700.0)).tolist()  # the exponential of 710 is infinite
        return Interval(low, high, "laplace", tuple(side for side, end, bound in sides if end == bound))

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


class Estimate(NamedTuple):
    """Result of a search of F."""

    minima: Minima
    posterior: Posterior
    n_strokes_computed: int  # number of strokes that the model computed

    @property
    def theta(self) -> np.ndarray:
        """θ of the minimum with the largest posterior weight, which is reported first [size]."""
        return self.minima.candidates.theta[0]


def laplace(objective: Objective, minima: Minima) -> tuple[Minima, Posterior]:
    """The distinct minima of the complete F, and their mixture; the one with the largest posterior weight is first.

    A minimum within the width of a lower one is removed, because the Gaussian of the lower one contains it. The lowest
    minimum need not have the largest weight, because a narrow one holds little of the posterior. In the treble, narrow
    minima are lobes of the pulse's spectrum. There a few levels can agree to a tenth of a dB at a wrong velocity.
    """
    mean = objective.problem.parametrisation.log_values(minima.candidates.theta)
    found: dict[int, tuple[float, np.ndarray]] = {}
    for i in np.argsort(minima.nll, kind="stable").tolist():
        if all(_distance(mean[i] - mean[j], covariance) > SAME for j, (_, covariance) in found.items()):
            found[i] = _at_minimum(objective, minima.candidates, i)
    kept, score = np.array([*found]), np.array([log_weight for log_weight, _ in found.values()])
    weight = np.exp(score - score.max())
    order = np.argsort(-weight, kind="stable")
    covariance = np.array([covariance for _, covariance in found.values()])[order]
    return minima.take(kept[order]), Posterior(mean[kept[order]], covariance, weight[order] / weight.sum())


def _distance(change: np.ndarray, covariance: np.ndarray) -> float:
    """The largest change of a parameter [size] in standard deviations; fixed parameters do not count."""
    sd = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    return float((np.abs(change) / np.where(sd > 0, sd, np.inf)).max())


def _at_minimum(objective: Objective, candidates: Candidates, i: int) -> tuple[float, np.ndarray]:
    """Logarithm of the posterior mass at a minimum, and the covariance of the logarithms of values [size, size].

    The covariance is about the minimum, so a shift of θ with φ widens it.
    """
    u, theta = objective.problem.parametrisation, candidates.theta[i]
    bound = u.at_bound(theta)
    free = np.flatnonzero(objective.free & ~bound)
    lower, upper = u.bounds_at(theta)
    inward = np.where(objective.free & bound, np.where(theta - lower < upper - theta, 1, -1), 0)
    along = u.bound_jacobian(theta[None], bound[None])[0]
    points = [
        TablePoint(term.table, part.residual[i], part.jacobian[i], part.phi[i], part.w[i], theta, hyper)
        for term, part, hyper in zip(objective.terms, candidates.parts, HYPER[-len(candidates.parts) :], strict=True)
    ]
    here = objective.curvature(candidates.take(np.array([i])))[0]
    F, negative_log_proposal = draw_hyperparameters(points, Quadratic(*objective.prior(theta[None])), along[:, free])
    log_weight, covariances = negative_log_proposal - F.value, []
    for n, (gradient, curvature) in enumerate(zip(*F.along(along), strict=True)):
        covariance, log_det = _inverse(curvature, free, inward, gradient)
        shift = covariance @ gradient
        log_weight[n] += 0.5 * (gradient @ shift - log_det)
        covariances.append(covariance + np.outer(shift, shift))
    weight = np.exp(log_weight - log_weight.max())
    # A draw in the tail of the proposal must not count alone (Ionides 2008, J. Comput. Graph. Stat. 17).
    weight = np.minimum(weight, weight.mean() * np.sqrt(len(weight)))
    total = np.tensordot(weight / weight.sum(), np.array(covariances), 1)
    total += _by_unknown_weights(points, here, along[:, free], free)
    tangent = u.tangent(theta) @ along
    covariance = tangent @ total @ tangent.T
    log_mass = float(np.log(weight.mean()) + log_weight.max())
    return log_mass, 0.5 * (covariance + covariance.T)  # symmetric to the last bit


def _by_unknown_weights(
    points: Sequence[TablePoint], curvature: np.ndarray, axes: np.ndarray, free: np.ndarray
) -> np.ndarray:
    """Increase of the covariance of θ [size, size] if the log-weights of partials are unknown, at the minimum of F."""
    root = np.linalg.inv(np.linalg.cholesky(axes.T @ curvature @ axes))
    share, vector = np.linalg.eigh(root @ axes.T @ sum(map(information_lost_to_weights, points)) @ axes @ root.T)
    share = np.minimum(share, LARGEST_LOSS)
    increase, along = np.zeros(curvature.shape), root.T @ vector
    increase[np.ix_(free, free)] = (along * (share / (1 - share))) @ along.T
    return increase


def _inverse(
    precision: np.ndarray, free: np.ndarray, inward: np.ndarray, gradient: np.ndarray
) -> tuple[np.ndarray, float]:
    """Covariance of θ [size, size], 0 for fixed parameters, and log|H| with the factors of parameters at a bound.

    `inward` [size] is the sign of the direction away from the bound, 0 for parameters that are not at one. Free
    parameters follow their minimum as such a parameter moves, which changes the slope and the curvature of F. At a φ
    for which F falls inward, the parameter counts as at its minimum: a quadratic about a bound does not reach far.
    """
    covariance, inner = np.zeros(precision.shape), precision[np.ix_(free, free)]
    covariance[np.ix_(free, free)] = inverse_curvature(inner)
    log_det = float(np.linalg.slogdet(inner)[1])
    for k in np.flatnonzero(inward):
        following = precision[k] @ covariance
        slope = max(inward[k] * float(gradient[k] - following @ gradient), 0.0)
        across = float(precision[k, k] - following @ precision[k])
        log_det += _log_curvature(slope, max(across, FLAT * float(precision[k, k])))
    return covariance, log_det


def _log_curvature(slope: float, curvature: float) -> float:
    """Replacement of a log curvature at a bound, from the slope and curvature with which F rises inward.

    That is -2 log of ∫ exp(-slope t - ½ curvature t²) dt, t > 0, over √(2π).
    """
    return float(np.log(curvature) - 2 * np.log(0.5 * erfcx(slope / np.sqrt(2 * curvature))))


def unbounded_warnings(intervals: Mapping[str, Interval]) -> list[str]:
    """Messages that name the intervals with an end at a search bound."""
    endings = {
        ("low", "high"): ": the interval is the whole search range",
        ("low",): " below: the interval ends at the search bound",
        ("high",): " above: the interval ends at the search bound",
    }
    named = {side: [name for name, one in intervals.items() if one.unbounded == side] for side in endings}
    return [f"The recordings do not bound {', '.join(named[side])}{endings[side]}." for side in endings if named[side]]
