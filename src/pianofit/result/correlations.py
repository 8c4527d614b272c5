"""Pairs of parameters that the recordings do not distinguish."""

from typing import NamedTuple

import numpy as np

from ..conversions import HALF_WIDTH_95
from ..inference import InferenceResult
from ..io.number_format import format_relative_uncertainty, with_half_interval
from .minima import covariance_of

# Correlations of two logarithms beyond this are listed.
STRONG_CORRELATION = 0.99


class StrongCorrelation(NamedTuple):
    """Two parameters that the recordings do not distinguish."""

    first: str
    second: str
    correlation: float  # of their logarithms, as in `Result.correlation`
    best_combination: str  # that the recordings determine, with its uncertainty


def strong_correlations(fit: InferenceResult) -> tuple[StrongCorrelation, ...]:
    """The pairs of parameters whose correlation exceeds `STRONG_CORRELATION`."""
    correlation = covariance_of(fit, 0).of_shared(fit.problem.velocity_scale_open).normalised
    names, r = correlation.names, correlation.matrix
    return tuple(
        StrongCorrelation(names[j], names[i], float(r[i, j]), _best_combination(fit, names[j], names[i]))
        for i in range(len(names))
        for j in range(i)
        if abs(r[i, j]) > STRONG_CORRELATION
    )


def _best_combination(fit: InferenceResult, a: str, b: str) -> str:
    """A well-determined combination of two correlated parameters, with its uncertainty.

    That of K_H and p is the felt force at the reference compression. log a − s log b of two others has the least
    variance at s = cov(a, b)/var(b).
    """
    u, posterior = fit.problem.parametrisation, fit.gauge_fixed
    i, j = (fit.problem.parameter_indices[name] for name in (a, b))
    if (a, b) == u.law.power:
        force = float(np.exp(fit.estimate.theta[i]))
        half = HALF_WIDTH_95 * posterior.sd(u.force_direction(fit.estimate.theta))
        return f"the {u.felt_force_name}, {with_half_interval(force, half, 'N')}"
    cov = posterior.covariance[0]
    slope = cov[i, j] / cov[j, j]
    half = HALF_WIDTH_95 * float(np.sqrt(max(cov[i, i] - slope * cov[i, j], 0.0)))
    return f"the product {a} · {b}^{-slope:.2g} ({format_relative_uncertainty(half)})"
