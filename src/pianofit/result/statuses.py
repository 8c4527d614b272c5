"""The status of every parameter and velocity: whether the recordings determine it."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import chdtrc

from ..inference import STRING_SIZE, InferenceResult
from ..schema.dependencies import CONTACT, FELT, MAX_LOG_SD, VELOCITIES, foundations
from ..schema.quantities import Status

# A parameter whose posterior standard deviation exceeds this fraction of its prior's is not identifiable.
MAX_SD_OVER_PRIOR = 0.7
# A calibrated recording of the described string is reproduced within hundredths of a decibel. With an excess beyond
# this, dB, an effect outside the model is present and biases the felt parameters.
FELT_EXCESS_DB = 0.1
# With an excess beyond this, dB, the force over time and the velocity are in doubt too.
HAMMER_EXCESS_DB = 0.5
# Ratio of a pianist's fastest to slowest hammer velocity: 6 over 0.3 m/s (Askenfelt and Jansson 1991).
PIANIST_VELOCITY_RATIO = 20.0
# Probability of velocities as different as those found if all strokes were equal, below which they differ.
SIGNIFICANCE = 0.05
# Standard deviation of the logarithm of a velocity that was given as exact, so that a test has no zero.
EXACT = 1e-9


@dataclass(frozen=True)
class Statuses:
    """The status of every parameter and velocity, and the tests that decide about them."""

    parameters: dict[str, Status]  # by name
    velocities: list[Status]  # of every stroke
    scaled: tuple[str, ...]  # felt parameters that change with the common scale of the velocities, if it is unknown
    unidentifiable: tuple[str, ...]  # hammer parameters that are not identifiable, even if their interval is narrow
    compared: bool  # by `path_compared`
    velocity_range: tuple[float, float, float]
    exceeds_pianist: bool  # whether the velocities certainly differ by more than those of a pianist


def statuses(fit: InferenceResult) -> Statuses:
    """The statuses of a fit."""
    compared, span, law = path_compared(fit), velocity_range(fit), fit.problem.parametrisation.law
    exceeds_pianist = span[0] > PIANIST_VELOCITY_RATIO
    parts = undetermined(fit, compared, exceeds_pianist)
    scaled = law.parameters_with_unit("N m") if fit.problem.velocity_scale_open and compared else ()
    unidentifiable = tuple(law.parameters) * (FELT in parts) + ("M_H",) * bool(parts & {*foundations("M_H")})
    parameters, velocities = _of_parameters(fit, scaled, unidentifiable), _of_velocities(fit, VELOCITIES in parts)
    return Statuses(parameters, velocities, scaled, unidentifiable, compared, span, exceeds_pianist)


def _of_parameters(fit: InferenceResult, scaled: Sequence[str], unidentifiable: Sequence[str]) -> dict[str, Status]:
    u, start, theta = fit.problem.parametrisation, fit.problem.initial_values, fit.estimate.theta
    at_bound = u.at_bound(theta)
    # Standard deviations of log(value). For the parameters of the string only `MAX_LOG_SD` applies.
    prior = np.linalg.norm(u.tangent(theta) * u.sd, axis=1)
    widest = np.where(np.arange(u.size) < STRING_SIZE, MAX_LOG_SD, np.minimum(MAX_SD_OVER_PRIOR * prior, MAX_LOG_SD))

    def status(i: int, name: str) -> Status:
        if not u.free[i] or u.given[i]:
            return "assumed" if start.fixed.get(name) == "assumed" else "given"
        if at_bound[i]:
            return "at-bound"
        # Without a measured velocity, the prior alone sets the scale of these parameters.
        posterior = fit.gauge_fixed if name in scaled else fit.posterior
        if name in unidentifiable or posterior.sd(np.eye(u.size)[i]) > widest[i]:
            return "not-identifiable"
        return "scaled" if name in scaled or start.assumptions.get(name) else "fitted"

    return {name: status(i, name) for i, name in enumerate(u.names)}


def path_compared(fit: InferenceResult) -> bool:
    """True if the strokes through one output path did not all have one velocity, by one test over all of them.

    A test of the fastest against the slowest stroke would not be one test: the largest of many differences is large by
    chance. If all n strokes of a path had one velocity, the squared distance of the n - 1 differences from 0, in units
    of their joint covariance, would be chi-squared with n - 1 degrees of freedom. Its probability is averaged over the
    minima.
    """
    layout = fit.problem.structure
    paths = [
        sorted({s for s, g in zip(layout.stroke, layout.group, strict=True) if g == group})
        for group in set(layout.group)
    ]
    return any(_probability_of_one_velocity(fit, strokes) < SIGNIFICANCE for strokes in paths if len(strokes) > 1)


def _probability_of_one_velocity(fit: InferenceResult, strokes: Sequence[int]) -> float:
    """Probability of differences as large as those found if all strokes had one velocity."""
    posterior, index = fit.posterior, fit.problem.parametrisation.shared + np.array(strokes)
    contrasts = np.eye(len(index))[1:] - np.eye(len(index))[0]
    difference = posterior.mean[:, index] @ contrasts.T
    covariance = contrasts @ posterior.covariance[:, index[:, None], index] @ contrasts.T
    covariance = covariance + EXACT**2 * np.eye(len(contrasts))
    squared = (difference * np.linalg.solve(covariance, difference[..., None])[..., 0]).sum(axis=1)
    return float(posterior.weight @ chdtrc(len(contrasts), squared))


def velocity_range(fit: InferenceResult) -> tuple[float, float, float]:
    """Ratio of the fastest to the slowest stroke: low end of its 95 % interval, value, high end."""
    u, z = fit.problem.parametrisation, fit.estimate.theta
    velocities, direction = z[u.shared : u.shared + u.strokes], np.zeros(u.size)
    direction[u.shared + np.argmax(velocities)] += 1
    direction[u.shared + np.argmin(velocities)] -= 1
    log_ratio = float(z @ direction)
    low, high = fit.posterior.interval(direction) or (log_ratio, log_ratio)
    low, ratio, high = np.exp([low, log_ratio, high]).tolist()
    return low, ratio, high


def undetermined(fit: InferenceResult, compared: bool, exceeds_pianist: bool) -> frozenset[str]:
    """Parts of the model on which the recordings have no evidence: of `FELT`, `CONTACT` and `VELOCITIES`.

    K_H, p and μ alone can be wide while their combination is not. The felt is undetermined if its force where the
    strokes press is, by the joint posterior.
    """
    problem, everything = fit.problem, frozenset({FELT, CONTACT, VELOCITIES})
    if not problem.parametrisation.law.has_contact:
        return frozenset()
    if problem.calibrated:
        felt = frozenset({FELT} if fit.excess > FELT_EXCESS_DB else ())
        parts = everything if fit.excess > HAMMER_EXCESS_DB else felt
    elif compared:
        parts = everything if exceeds_pianist else frozenset()
    else:  # with an unknown gain alone, the force is known up to a factor
        parts = everything if problem.has_unknown_path else frozenset({FELT, VELOCITIES})
    force = force_direction(fit)
    is_wide = force is not None and fit.gauge_fixed.sd(force) > MAX_LOG_SD
    return parts | {FELT, CONTACT} if is_wide else parts


def force_direction(fit: InferenceResult) -> np.ndarray | None:
    """The logarithm of the static felt force at the reference compression, over the string mass [size].

    None for a law without a power, and for a given stiffness, which has no reference compression.
    """
    u, place = fit.problem.parametrisation, fit.problem.parametrisation.force_and_exponent_index
    if place is None or not u.free[place[0]] or u.given[place[0]]:
        return None
    direction = u.force_direction(fit.estimate.theta)
    if "M_S" in u.sizes:
        direction[u.index_of("M_S")] = -1.0
    return direction


def _of_velocities(fit: InferenceResult, undecided: bool) -> list[Status]:
    problem, u = fit.problem, fit.problem.parametrisation
    at_bound = u.at_bound(fit.estimate.theta)

    def status(at: int, measured: float | None) -> Status:
        if measured is not None:
            return "given"
        if at_bound[at]:
            return "at-bound"
        # Without a measured velocity, the prior alone sets their scale: only their ratios can be too wide.
        if undecided or fit.gauge_fixed.sd(np.eye(u.size)[at]) > min(MAX_SD_OVER_PRIOR * u.sd[at], MAX_LOG_SD):
            return "not-identifiable"
        is_scaled = problem.velocity_scale_open or problem.initial_values.assumptions.get(u.law.stroke.name)
        return "scaled" if is_scaled else "fitted"

    places = range(u.size)[u.velocities]
    return [status(at, measured) for at, measured in zip(places, problem.measured_velocity, strict=True)]
