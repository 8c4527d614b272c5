"""The status of every parameter and velocity: whether the recordings determine it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..inference import STRING_SIZE, InferenceResult
from ..schema.quantities import Status

# A parameter whose posterior standard deviation exceeds this fraction of its prior's is not identifiable.
MAX_SD_OVER_PRIOR = 0.7
# Nor is one whose standard deviation of log(value) exceeds this.
MAX_LOG_SD = 0.7
# A calibrated recording of the described string is reproduced within hundredths of a decibel. With an excess beyond
# this, dB, an effect outside the model is present and biases the felt parameters.
FELT_EXCESS_DB = 0.1
# With an excess beyond this, dB, the hammer mass is in doubt too.
HAMMER_EXCESS_DB = 0.5
# Ratio of a pianist's fastest to slowest hammer velocity: 6 over 0.3 m/s (Askenfelt and Jansson 1991).
PIANIST_VELOCITY_RATIO = 20.0


def statuses(fit: InferenceResult) -> dict[str, Status]:
    """The status of every parameter by name."""
    u, start, theta = fit.problem.parametrisation, fit.problem.initial_values, fit.estimate.theta
    at_bound, unidentifiable, scaled = u.at_bound(theta), unidentifiable_parameters(fit), scaled_parameters(fit)
    # Standard deviations of log(value). For the parameters of the string only `MAX_LOG_SD` applies.
    prior = np.linalg.norm(u.tangent(theta) * u.sd, axis=1)
    widest = np.where(np.arange(u.size) < STRING_SIZE, MAX_LOG_SD, np.minimum(MAX_SD_OVER_PRIOR * prior, MAX_LOG_SD))

    def status(i: int, name: str) -> Status:
        if not u.free[i] or name in start.relative_sd and name != "width":
            return "assumed" if start.fixed.get(name) == "assumed" else "given"
        if at_bound[i]:
            return "at-bound"
        # Without a measured velocity, the prior alone sets the scale of these parameters.
        posterior = fit.gauge_fixed if name in scaled else fit.posterior
        if name in unidentifiable or posterior.sd(np.eye(u.size)[i]) > widest[i]:
            return "not-identifiable"
        return "scaled" if name in scaled or start.assumptions.get(name) else "fitted"

    return {name: status(i, name) for i, name in enumerate(u.names)}


def scaled_parameters(fit: InferenceResult) -> tuple[str, ...]:
    """Felt parameters that change with the common scale of the velocities, if that scale is unknown."""
    law = fit.problem.parametrisation.law
    return law.parameters_with_unit("N m") if fit.problem.velocity_scale_free and path_compared(fit) else ()


def path_compared(fit: InferenceResult) -> bool:
    """True if one output path was recorded with two velocities whose 95 % interval excludes equality."""
    layout = fit.problem.structure
    paths = [
        sorted({s for s, g in zip(layout.stroke, layout.group, strict=True) if g == group})
        for group in set(layout.group)
    ]
    return any(_fastest_over_slowest(fit, strokes)[0] > 0 for strokes in paths)


def velocity_range(fit: InferenceResult) -> tuple[float, float, float]:
    """Ratio of the fastest to the slowest stroke: low end of its 95 % interval, value, high end."""
    u = fit.problem.parametrisation
    low, ratio, high = np.exp(_fastest_over_slowest(fit, range(u.strokes))).tolist()
    return low, ratio, high


def _fastest_over_slowest(fit: InferenceResult, strokes: Sequence[int]) -> tuple[float, float, float]:
    """Logarithm of the largest ratio of the strokes' velocities: low end of its 95 % interval, value, high end."""
    u, z = fit.problem.parametrisation, fit.estimate.theta
    index, direction = u.shared + np.array(strokes), np.zeros(u.size)
    direction[index[np.argmax(z[index])]] += 1
    direction[index[np.argmin(z[index])]] -= 1
    log_ratio = float(z @ direction)
    low, high = fit.posterior.interval(direction) or (log_ratio, log_ratio)
    return low, log_ratio, high


def exceeds_pianist(fit: InferenceResult) -> bool:
    """True if the velocities of the strokes certainly differ by more than those of a pianist."""
    return velocity_range(fit)[0] > PIANIST_VELOCITY_RATIO


def unidentifiable_parameters(fit: InferenceResult) -> tuple[str, ...]:
    """Hammer parameters reported as not identifiable, even if their interval is narrow."""
    problem = fit.problem
    felt = tuple(problem.parametrisation.law.parameters)
    if problem.calibrated:
        return () if fit.excess <= FELT_EXCESS_DB else felt if fit.excess <= HAMMER_EXCESS_DB else (*felt, "M_H")
    if path_compared(fit):
        return felt if exceeds_pianist(fit) else ()
    return (*felt, "M_H") if problem.path else felt


def invariant_status(factors: Sequence[Status], deviation: float) -> Status:
    """Status of a ratio or product from the statuses of its factors and the standard deviation of its logarithm."""
    if "not-identifiable" in factors:
        return "not-identifiable"
    if "at-bound" in factors:
        return "at-bound"
    if not deviation:
        return "assumed" if "assumed" in factors else "given"
    return "not-identifiable" if deviation > MAX_LOG_SD else "fitted"


def velocity_statuses(fit: InferenceResult) -> list[Status]:
    """The status of every stroke's velocity."""
    problem = fit.problem
    if problem.calibrated:
        unidentifiable = fit.excess > HAMMER_EXCESS_DB
    else:
        unidentifiable = not path_compared(fit) or exceeds_pianist(fit)
    searched: Status = "not-identifiable" if unidentifiable else "scaled" if problem.velocity_scale_free else "fitted"
    at_bound = problem.parametrisation.at_bound(fit.estimate.theta)[problem.parametrisation.velocities]
    return [
        "given" if v is not None else "at-bound" if bound else searched
        for v, bound in zip(problem.measured_velocity, at_bound, strict=True)
    ]
