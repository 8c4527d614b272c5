"""Joint draws from the posterior of a fit, as sets of parameters in SI units.

The posterior is a mixture of Gaussians, one for each minimum. They are drawn in the coordinates of the search, which
have the logarithm of the felt force at the reference compression in place of log K_H. There a Gaussian describes the
posterior best. A fit with `intervals="posterior"` has draws of its own, which are used instead. A profile has no joint
distribution, so its draws are those of the mixture.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.special import ndtri

from ..complex_step import slope_by_entry
from ..errors import FitError
from ..excitation import Excitation
from ..felt import ALL_PARAMETERS
from ..inference import Posterior
from ..schema.fit import Fit, Minimum
from ..sobol import sobol_points

# Draws from the mixture: 2 to this power, as Sobol's points need. The ends of an interval are exact for a sum of
# logarithms, and within about a tenth of its half-width for a function that no such sum resembles.
LOG2_DRAWS = 8
# Most draws of a sampler that are used, evenly thinned: its chains have some 400 to 1000 independent ones.
MOST_SAMPLED = 1000
# A minimum needs this many draws for each parameter to have slopes of its own.
DRAWS_PER_SLOPE = 3
ENDS = (0.025, 0.975)


@dataclass(frozen=True, eq=False)
class JointDraws:
    """Draws of all parameters and velocities by name [draws], in SI units; fixed ones have one value [1]."""

    values: dict[str, np.ndarray]
    mixture: Mixture | None = None  # None for draws of a sampler, and without a free parameter

    def interval(self, found: np.ndarray) -> tuple[float, float]:
        """Return the 95 % interval of a function from its values at the draws [draws].

        The function is compared with the line in the normal numbers that resembles it best. The quantiles of this line
        are known exactly. Their error at the draws is subtracted, in proportion to the variance that the line explains
        (a control variate, Hsu and Nelson 1990).
        """
        is_positive = bool((found > 0).all())
        y = np.log(found) if is_positive else found
        ends = np.quantile(y, ENDS)
        if self.mixture is not None and np.var(y) > 0:
            line, centre, sd = self.mixture.line(y)
            exact = Posterior(centre[:, None], sd[:, None, None] ** 2, self.mixture.weight).interval(np.ones(1))
            explained = max(1 - np.var(y - line) / np.var(y), 0.0)
            if exact is not None:
                ends = ends - explained * (np.quantile(line, ENDS) - exact)
        low, high = (np.exp(ends) if is_positive else ends).tolist()
        return low, high


@dataclass(frozen=True, eq=False)
class Mixture:
    """The Gaussians of all minima, and which numbers gave each draw."""

    standard: np.ndarray  # standard normal numbers [draws, parameters]
    minimum: np.ndarray  # index of the minimum [draws]
    weight: np.ndarray  # posterior weights [minima]

    def line(self, y: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the line that resembles `y` best [draws], and its mean and standard deviation at minima [minima]."""
        design = np.column_stack([np.ones(len(y)), self.standard])
        common = np.linalg.lstsq(design, y, rcond=None)[0]
        line, centre, sd = np.empty(len(y)), np.full(len(self.weight), common[0]), np.zeros(len(self.weight))
        for which in range(len(centre)):
            own = np.flatnonzero(self.minimum == which)
            slopes = common
            if len(own) >= DRAWS_PER_SLOPE * design.shape[1]:
                slopes = np.linalg.lstsq(design[own], y[own], rcond=None)[0]
            elif len(own):
                slopes = np.append(np.mean(y[own] - design[own, 1:] @ common[1:]), common[1:])
            line[own] = design[own] @ slopes
            centre[which], sd[which] = slopes[0], np.linalg.norm(slopes[1:])
        return line, centre, sd


def joint_draws(fit: Fit, law: Excitation, sampled: Mapping[str, np.ndarray] | None = None) -> JointDraws:
    """Return draws of the posterior of a fit, from the mixture or from those of a sampler [chains, draws] by name."""
    fixed = {name: np.array([quantity.value]) for name, quantity in fit.parameters.items()}
    if sampled is not None:
        count = next(iter(sampled.values())).size
        kept = np.linspace(0, count - 1, min(count, MOST_SAMPLED)).round().astype(int)
        names = (name for name in sampled if name in fixed or name.startswith(f"{fit.stroke_name} "))
        return JointDraws(fixed | {name: sampled[name].ravel()[kept] for name in names})
    if fit.covariance is None:
        if fit.has_intervals:
            raise FitError("covariance: this fit.json has none; fit the recordings again")
        return JointDraws(fixed)
    names = fit.covariance.names
    points = sobol_points(len(names) + 1, 2**LOG2_DRAWS, fit.seed)
    weight = np.array([minimum.weight for minimum in fit.minima])
    which = np.searchsorted(np.cumsum(weight)[:-1], points[:, 0])  # each minimum in proportion to its weight
    standard, log = ndtri(points[:, 1:]), np.zeros((len(points), len(names)))
    for i, minimum in enumerate(fit.minima):
        log[which == i] = _gaussian(fit, law, minimum, standard[which == i])
    values = _within_bounds(fit, law, dict(zip(names, log.T, strict=True)))
    free = int((np.diag(fit.covariance.matrix) > 0).sum())
    return JointDraws(fixed | values, Mixture(standard[:, :free], which, weight))


def _gaussian(fit: Fit, law: Excitation, minimum: Minimum, standard: np.ndarray) -> np.ndarray:
    """Return logarithms [draws, names] about one minimum from standard normal numbers [draws, names]."""
    covariance = minimum.covariance
    if covariance is None:
        raise ValueError("a minimum has no covariance")
    names, reference = covariance.names, fit.reference.stroke

    def value(name: str) -> float:
        of, _, number = name.partition(" ")
        stroke = None if of != fit.stroke_name else int(number) - 1 if number else reference
        if stroke is not None:
            return float(minimum.stroke_values[stroke])
        # Sizes are the same at all minima. A scale of the pickup is drawn as a ratio to its given value.
        return minimum.parameters.get(name, fit.parameters[name].value if name in fit.parameters else 1.0)

    mean = np.log([value(name) for name in names])
    power = [names.index(name) for name in law.power or ()]
    if not power or not covariance.matrix[power[0], power[0]] > 0:  # a given K_H is fixed
        return mean + standard @ _root(covariance.matrix).T
    stiffness = power[0]

    def over_stiffness(log: np.ndarray) -> np.ndarray:
        """log F(u_ref) - log K_H from logarithms [..., names]."""
        values = {name: np.exp(log[..., names.index(name)]) for name in law.parameters if name in names}
        return law.log_power(1e-3 * fit.derived.reference_compression_mm, values)

    to_search = np.eye(len(names))  # d log F = d log K_H + its derivatives by the other parameters
    to_search[stiffness] += [slope_by_entry(over_stiffness, mean, i) for i in range(len(names))]
    log = mean + standard @ _root(to_search @ covariance.matrix @ to_search.T).T
    log[:, stiffness] -= over_stiffness(log) - over_stiffness(mean)
    return log


def _root(covariance: np.ndarray) -> np.ndarray:
    """Return R with R Rᵀ = covariance, its columns from the widest axis to the narrowest.

    Axes are those of the correlations, because variances differ by 14 orders of magnitude. The first numbers of Sobol's
    points are the most even, so they go along the widest axes.
    """
    sd = np.sqrt(np.diag(covariance))
    scale = np.where(sd > 0, sd, 1.0)
    variance, axes = np.linalg.eigh(covariance / np.outer(scale, scale))
    return (sd[:, None] * axes * np.sqrt(np.maximum(variance, 0.0)))[:, ::-1]


def _within_bounds(fit: Fit, law: Excitation, log: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return the values of logarithms, moved to the nearest bound of the search where they exceed it.

    A search bound that the posterior reaches is an end of the interval in the fit.
    """
    ranges, clipped = ALL_PARAMETERS | law.hammer_parameters, {}
    for name, values in log.items():
        own, box = fit.parameters.get(name), ranges.get(name.partition(" ")[0])
        low, high = (0.0, np.inf) if box is None else (box.lower, box.upper)
        if own is not None and own.interval is not None:
            low = own.interval[0] if "low" in own.interval_unbounded else low
            high = own.interval[1] if "high" in own.interval_unbounded else high
        clipped[name] = np.clip(np.exp(values), low, high)
    return clipped
