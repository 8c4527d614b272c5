"""Joint draws from the posterior of a fit, as sets of parameters in SI units.

The posterior is a mixture of Gaussians, one for each minimum. They are drawn in the coordinates of the search, which
have the logarithm of the felt force at the reference compression in place of log K_H. There a Gaussian describes the
posterior best. A fit with `intervals="posterior"` has draws of its own, which are used instead. A profile has no joint
distribution, so its draws are those of the mixture.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from scipy.special import ndtri
from scipy.stats import qmc

from ..felt import ALL_PARAMETERS, FeltLaw
from ..schema.fit import Fit, Minimum

# Draws from the mixture, a power of 2 as Sobol's points need. They spread evenly, so the ends of the 95 % interval of a
# sum of logarithms are within 2 % of its half-width. Independent draws would need some 2000 for that.
LOG2_DRAWS = 8
# Most draws of a sampler that are used, evenly thinned: its chains have some 400 to 1000 independent ones.
MOST_SAMPLED = 1000


def joint_draws(fit: Fit, law: FeltLaw, sampled: Mapping[str, np.ndarray] | None = None) -> dict[str, np.ndarray]:
    """Return draws of all parameters and velocities by name [draws], in SI units; fixed ones have one value [1].

    Parameters
    ----------
    sampled : posterior draws by name [chains, draws], if the fit has them.
    """
    fixed = {name: np.array([quantity.value]) for name, quantity in fit.parameters.items()}
    if sampled is not None:
        count = next(iter(sampled.values())).size
        kept = np.linspace(0, count - 1, min(count, MOST_SAMPLED)).round().astype(int)
        return fixed | {name: sampled[name].ravel()[kept] for name in sampled if name in fixed or name[:5] == "v_H0 "}
    if fit.covariance is None:
        return fixed
    log = _mixture(fit, law)
    return fixed | {name: np.exp(values) for name, values in _within_bounds(fit, law, log).items()}


def _mixture(fit: Fit, law: FeltLaw) -> dict[str, np.ndarray]:
    """Return draws of the logarithms, each from a minimum in proportion to its weight."""
    names = fit.minima[0].covariance.names if fit.minima[0].covariance else ()
    points = qmc.Sobol(len(names) + 1, rng=np.random.default_rng(fit.seed)).random_base2(LOG2_DRAWS)
    minimum = np.searchsorted(np.cumsum([m.weight for m in fit.minima])[:-1], points[:, 0])
    standard, log = ndtri(points[:, 1:]), np.zeros((len(points), len(names)))
    for which, own in enumerate(fit.minima):
        chosen = minimum == which
        log[chosen] = _gaussian(fit, law, own, standard[chosen])
    return dict(zip(names, log.T, strict=True))


def _gaussian(fit: Fit, law: FeltLaw, minimum: Minimum, standard: np.ndarray) -> np.ndarray:
    """Return logarithms [draws, names] about one minimum from standard normal numbers [draws, names]."""
    covariance = minimum.covariance
    if covariance is None:
        raise ValueError("a minimum has no covariance")
    names, reference = covariance.names, fit.reference.stroke

    def value(name: str) -> float:
        stroke = reference if name == "v_H0" else int(name[5:]) - 1 if name.startswith("v_H0 ") else None
        return minimum.parameters[name] if stroke is None else float(minimum.velocities[stroke])

    mean, to_search = np.log([value(name) for name in names]), np.eye(len(names))
    log_u = np.log(1e-3 * fit.derived.reference_compression_mm)
    power = [names.index(name) for name in law.power or ()]
    power = power if power and covariance.matrix[power[0], power[0]] > 0 else []  # a given K_H is no force
    if power:  # d log F = d log K_H + p log(u_ref) d log p
        stiffness, exponent = power
        to_search[stiffness, exponent] = np.exp(mean[exponent]) * log_u
    variance, axes = np.linalg.eigh(to_search @ covariance.matrix @ to_search.T)
    # The first numbers of Sobol's points are the most even, so they go along the widest axes.
    log = mean + standard @ (axes * np.sqrt(np.maximum(variance, 0.0)))[:, ::-1].T
    if power:
        log[:, stiffness] -= (np.exp(log[:, exponent]) - np.exp(mean[exponent])) * log_u
    return log


def _within_bounds(fit: Fit, law: FeltLaw, log: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return the logarithms, moved to the nearest bound of the search where they exceed it.

    A search bound that the posterior reaches is an end of the interval in the fit.
    """
    ranges, clipped = ALL_PARAMETERS | law.hammer_parameters, {}
    for name, values in log.items():
        own, box = fit.parameters.get(name), ranges.get(name.partition(" ")[0])
        low, high = (-np.inf, np.inf) if box is None else np.log([box.lower, box.upper])
        if own is not None and own.interval is not None:
            low = np.log(own.interval[0]) if "low" in own.interval_unbounded else low
            high = np.log(own.interval[1]) if "high" in own.interval_unbounded else high
        clipped[name] = np.clip(values, low, high)
    return clipped
