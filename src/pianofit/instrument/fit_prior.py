"""The prior of a key's fit, and its removal from the posterior of the fit.

The keyboard starts from the literature, and the fit of every key did so too. If a recording does not determine a
parameter, its posterior is the prior. Nine such keys would then make the law of the parameter certain. So a key hands
over its posterior without its prior. A prior `WIDER` times as wide takes its place, which keeps covariances finite.
"""

import math
from typing import NamedTuple

import numpy as np

from ..excitation import OTHERS
from ..felt import LAWS
from ..felt.published import HAMMER_SD
from ..parameters import Geometry
from ..schema.fit import Fit, Minimum

# Standard deviation of the new prior over that of the old one. The keyboard's own priors are as wide as the old one.
WIDER = 10.0
# Variance of the removed information over that of the prior: 1 less a share of 1/WIDER².
REMOVED = 1 / (1 - WIDER**-2)
# The size of the string by which a value of a fit scales, if that size is uncertain.
SCALED_BY = {"K_H": "M_S", "M_H": "M_S", "x0": "L", "width": "L"}
# Largest shift of a mean, standard deviations of the posterior: farther from its mode, a posterior is not Gaussian.
REACH = 2.0
# Step of the logarithms of felt parameters in a derivative by differences.
STEP = 1e-6
# Smallest variance of a posterior over that of its prior: smaller ones are rounding.
ROUNDING = 1e-12


class FitPrior(NamedTuple):
    """The prior of a fit, as Gaussian measurements of a minimum with a standard deviation of 1."""

    rows: np.ndarray  # derivatives of its values by the logarithms of the fit [priors, names]
    away: np.ndarray  # values at the minimum minus their medians [priors]


class Removal(NamedTuple):
    """Change of a minimum without its prior."""

    shift: np.ndarray  # of the logarithms of the fit [names]
    covariance: np.ndarray  # new one [names, names]
    log_weight: float  # logarithm of the factor on the weight of the minimum


def prior_of(fit: Fit, minimum: Minimum, names: tuple[str, ...]) -> FitPrior:
    """Return the prior of hammer and felt, or of a pluck, at one minimum, without values that the user gave."""
    law = LAWS.get(fit.felt)
    spread = HAMMER_SD | ({n: p.prior_sd for n, p in law.parameters.items()} if law else {}) | _pluck_spreads(fit)
    initial = {n: q.initial for n, q in fit.parameters.items() if q.initial and q.status not in ("given", "assumed")}
    found = {n: sd for n, sd in spread.items() if n in names and n in initial}
    rows = np.array([[float(name == other) for other in names] for name in found]).reshape(len(found), len(names))
    values = minimum.values(fit)
    away = np.array([math.log(values[name] / initial[name]) for name in found])
    if law and law.power and law.power[0] in found:
        # A fit searches the force at the reference compression, and not the stiffness.
        u, stiffness = fit.derived.reference_compression_mm * 1e-3, list(found).index(law.power[0])
        at, start = dict(minimum.parameters), {**minimum.parameters, **initial}
        term = law.log_power(u, at)
        for name in {*law.parameters} & {*names}:
            changed = law.log_power(u, at | {name: at[name] * math.exp(STEP)})
            rows[stiffness, names.index(name)] += (changed - term) / STEP
        away[stiffness] += term - law.log_power(u, start)
    for name, size in SCALED_BY.items():  # the prior is that of a value for the given sizes
        if name in found and size in names:
            rows[list(found).index(name), names.index(size)] -= 1.0
    sd = np.array(list(found.values()))
    return FitPrior(rows / sd[:, None], away / sd)


def _pluck_spreads(fit: Fit) -> dict[str, float]:
    """Prior standard deviations that a pluck has in place of those of a hammer."""
    if fit.excitation not in OTHERS:
        return {}
    law, at = OTHERS[fit.excitation], fit.parameters
    length, mass, position, width = (at[name].value for name in ("L", "M_S", "x0", "width"))
    place = Geometry(length, mass, position, width, 0.5 * length)
    return {**law.spreads, law.stroke.name: law.stroke.prior(place)[1]}


def remove_prior(prior: FitPrior, covariance: np.ndarray) -> Removal:
    """Remove the prior from a Gaussian posterior.

    It is a measurement with the variance `-REMOVED`. A posterior as wide as its prior, or wider, contains no more than
    the prior.
    """
    share, axes = np.linalg.eigh(prior.rows @ covariance @ prior.rows.T)
    share = np.clip(share, ROUNDING, 1.0)
    along, left = prior.away @ axes, REMOVED - share
    pull = np.clip(along / left, -REACH / np.sqrt(share), REACH / np.sqrt(share))
    change = covariance @ prior.rows.T @ axes
    shift, wider = change @ pull, covariance + (change / left) @ change.T
    away = prior.away + prior.rows @ shift
    total = prior.rows @ wider @ prior.rows.T + REMOVED * np.eye(len(share))
    return Removal(shift, wider, 0.5 * float(away @ np.linalg.solve(total, away) + np.linalg.slogdet(total)[1]))
