"""The identifiability statement of a fit: which parameters the recordings determine, and how to read the rest.

Every result opens with the statement. Each parameter has a status, and warnings follow in order of importance.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ..conversions import HALF_WIDTH_95
from ..inference import STRING_SIZE, FitProblem, InferenceResult, priors
from ..io.files import printable
from ..io.number_format import format_relative_uncertainty, with_half_interval
from .remarks import mixed_format_warnings, recording_warnings
from .serialise import unit_and_meaning
from .velocity_check import PIANIST_VELOCITY_RATIO, contradictory_velocities

__all__ = [
    "AT_BOUND", "NOT_CONVERGED", "STATUSES", "identifiability_statement", "invariant_status",
    "scaled_parameters", "statuses", "strong_correlations", "unidentifiable_parameters",
    "velocity_assignment_warning", "velocity_statuses", "warnings",
]  # fmt: skip

STATUSES = ("fitted", "scaled", "given", "assumed", "at-bound", "not-identifiable")
# A parameter whose posterior standard deviation exceeds this fraction of its prior's is not identifiable.
MAX_SD_OVER_PRIOR = 0.7
# Nor is one whose standard deviation of log(value) exceeds this.
MAX_LOG_SD = 0.7
# A calibrated recording of the described string is reproduced within hundredths of a decibel. With an excess beyond
# this, dB, an effect outside the model is present and biases the felt parameters.
FELT_EXCESS_DB = 0.1
# With an excess beyond this, dB, the hammer mass is in doubt too.
HAMMER_EXCESS_DB = 0.5
# Correlations of two logarithms beyond this are listed.
STRONG_CORRELATION = 0.99
# A recording whose level error exceeds that of the others by this factor is named.
OUTLIER_FACTOR = 2.0
# A second minimum is named if all but the best have at least this posterior weight together.
MIN_OTHER_WEIGHT = 0.1
MIXTURE_NOTES = {
    "laplace": "Intervals and predictions average over all minima.",
    "profile": "Predictions average over all minima. Intervals of the parameters belong to the minimum shown.",
    "posterior": "Predictions average over all minima. Intervals of the parameters come from the posterior draws.",
}
NOT_CONVERGED = "The search stopped before it converged. Do not use any of the values."
AT_BOUND = "These parameters are at a search bound, which sets their value: {}. Other results are conditional on it."
CRITERION_NOT_DECREASED = "The paper's criterion did not decrease in: {}. This fit does not minimise it."
ONE_RECORDING = (
    "One uncalibrated recording does not determine the hammer felt. A different felt gives the same sound through a "
    "different output path (soundboard, room, microphone). A softer felt struck faster also gives the same sound at "
    "another gain. "
)
ONE_RECORDING_WITHOUT_PATH = (
    "One recording of unknown scale does not determine the hammer felt. A softer felt struck faster gives the same "
    "sound at another gain. "
)
NO_VELOCITIES_COMPARED = (
    "{} uncalibrated recordings do not determine the hammer felt. This needs strokes of clearly different velocities "
    "through one output path (soundboard, room, microphone). Without them, a different felt gives the same sound "
    "through a different output path. "
)
SEVERAL_VELOCITIES = (
    "{} uncalibrated recordings of one key were compared. Differences between strokes are attributed to the hammer. "
    "Everything common to all strokes is attributed to the output path (soundboard, room, microphone). "
)


# --- statuses ---------------------------------------------------------------------------------------------------------


def statuses(fit: InferenceResult) -> dict[str, str]:
    """One of `STATUSES` by parameter name."""
    u, start = fit.problem.parametrisation, fit.problem.initial_values
    at_bound, unidentifiable, scaled = (
        u.at_bound(fit.estimate.theta),
        unidentifiable_parameters(fit),
        scaled_parameters(fit),
    )
    # Standard deviations of log(value). For the parameters of the string only `MAX_LOG_SD` applies.
    prior = np.linalg.norm(u.tangent(fit.estimate.theta) * u.sd, axis=1)
    widest = np.where(np.arange(u.size) < STRING_SIZE, MAX_LOG_SD, np.minimum(MAX_SD_OVER_PRIOR * prior, MAX_LOG_SD))

    def status(i: int, name: str) -> str:
        if not u.free[i]:
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
    return (
        fit.problem.parametrisation.law.parameters_with_unit("N m")
        if fit.problem.velocity_scale_free and _path_compared(fit)
        else ()
    )


def _fastest_over_slowest(fit: InferenceResult, strokes: Sequence[int]) -> tuple[float, float, float]:
    """Logarithm of the largest ratio of the strokes' velocities: low end of its 95 % interval, value, high end."""
    u, z = fit.problem.parametrisation, fit.estimate.theta
    index, direction = u.shared + np.array(strokes), np.zeros(u.size)
    direction[index[np.argmax(z[index])]] += 1
    direction[index[np.argmin(z[index])]] -= 1
    log_ratio = float(z @ direction)
    low, high = fit.posterior.interval(direction) or (log_ratio, log_ratio)
    return low, log_ratio, high


def _path_compared(fit: InferenceResult) -> bool:
    """True if one output path was recorded with two velocities whose 95 % interval excludes equality."""
    layout = fit.problem.structure
    paths = [
        sorted({s for s, g in zip(layout.stroke, layout.group, strict=True) if g == group})
        for group in set(layout.group)
    ]
    return any(_fastest_over_slowest(fit, strokes)[0] > 0 for strokes in paths)


def unidentifiable_parameters(fit: InferenceResult) -> tuple[str, ...]:
    """Hammer parameters reported as not identifiable, even if their interval is narrow."""
    problem = fit.problem
    felt = tuple(problem.parametrisation.law.parameters)
    if problem.calibrated:
        return () if fit.excess <= FELT_EXCESS_DB else felt if fit.excess <= HAMMER_EXCESS_DB else (*felt, "M_H")
    if _path_compared(fit):
        return felt if _implausible_velocities(fit) else ()
    return (*felt, "M_H") if problem.path else felt


def invariant_status(states: Sequence[str], deviation: float) -> str:
    """Status of a ratio or product from the statuses of its factors and the standard deviation of its logarithm."""
    for decisive in ("not-identifiable", "at-bound"):
        if decisive in states:
            return decisive
    if not deviation:
        return "assumed" if "assumed" in states else "given"
    return "not-identifiable" if deviation > MAX_LOG_SD else "fitted"


def velocity_statuses(fit: InferenceResult) -> list[str]:
    """One of `STATUSES` for the velocity of every stroke."""
    problem = fit.problem
    if problem.calibrated:
        unidentifiable = fit.excess > HAMMER_EXCESS_DB
    else:
        unidentifiable = not _path_compared(fit) or bool(_implausible_velocities(fit))
    searched = "not-identifiable" if unidentifiable else "scaled" if problem.velocity_scale_free else "fitted"
    at_bound = problem.parametrisation.at_bound(fit.estimate.theta)[problem.parametrisation.shared :]
    return [
        "given" if v is not None else "at-bound" if bound else searched
        for v, bound in zip(problem.measured_velocity, at_bound, strict=True)
    ]


def _names_at_bound(fit: InferenceResult, states: dict[str, str]) -> list[str]:
    """Parameters at a search bound."""
    names = [name for name, state in states.items() if state == "at-bound"]
    return names + ["v_H0"] * ("at-bound" in velocity_statuses(fit))


# --- sentences --------------------------------------------------------------------------------------------------------


def identifiability_statement(fit: InferenceResult, states: dict[str, str], levels: dict) -> str:
    """The opening sentences: the kind of measurement, and which parameters it determines."""
    problem = fit.problem
    if problem.calibrated:
        return _calibrated(fit, states)
    count = len(problem.recordings)
    several = SEVERAL_VELOCITIES if _path_compared(fit) else NO_VELOCITIES_COMPARED
    text = (ONE_RECORDING if problem.path else ONE_RECORDING_WITHOUT_PATH) if count == 1 else several.format(count)
    text += (
        f"The rms error of the partial levels is {levels['initial_db']:.1f} dB before the fit, "
        f"{levels['fitted_db']:.1f} dB after it. With the {_initial_hammer(problem)} hammer, at its best velocities "
        f"and {'output path' if problem.path else 'gain'}, it is {levels['path_only_db']:.1f} dB."
    )
    if not _path_compared(fit):
        felt = any(
            problem.parametrisation.free[problem.parametrisation.index_of(name)]
            for name in problem.parametrisation.law.parameters
        )
        prior = "the prior of the output path" if problem.path else "the prior"
        return text + f" The felt parameters shown are one possibility under {prior}. Do not interpret them." * felt
    implausible = _implausible_velocities(fit)
    text += implausible
    if problem.velocity_scale_free and not implausible:
        scaled = (name.replace("mu", "μ") for name in problem.parametrisation.law.parameters_with_unit("N m"))
        text += (
            f" No hammer velocity was measured. {_listed('Velocities', *scaled)} are therefore determined only up to "
            "one common factor, and their intervals come from the prior. The ratios listed first, f0 and B do not "
            "depend on this factor."
        )
    return text


def _initial_hammer(problem: FitProblem) -> str:
    """The origin of the hammer with which the search began."""
    start = problem.initial_values
    return "initial" if start.user_given or start.law.hammers is None else "literature"


def _calibrated(fit: InferenceResult, states: dict[str, str]) -> str:
    """The statement of calibrated recordings."""
    several = len(fit.problem.recordings) > 1
    opening = "The recordings are calibrated" if several else "The recording is calibrated"
    if fit.excess > FELT_EXCESS_DB:
        advice = "An effect outside the model is present. Do not interpret the felt parameters."
        if fit.excess > HAMMER_EXCESS_DB:
            advice = (
                "Another hammer may explain them better, or the setup does not describe this string. Do not interpret "
                "the hammer parameters."
            )
        return f"{opening}, but the model misses the partial levels by {fit.excess:.2f} dB beyond the noise. {advice}"
    unidentifiable = [name for name, state in states.items() if state == "not-identifiable" and name != "width"]
    if unidentifiable:
        return f"{opening}, but {'do' if several else 'does'} not determine {_listed(*unidentifiable)}."
    pairs = (
        f" {a} and {b} are determined mainly in one combination: {_identified(fit, a, b)}."
        for a, b, _ in strong_correlations(fit)
    )
    return f"{opening} and {'determine' if several else 'determines'} all free parameters." + "".join(pairs)


def _implausible_velocities(fit: InferenceResult) -> str:
    """A sentence if the velocities of the strokes certainly differ by more than those of a pianist."""
    logs = _fastest_over_slowest(fit, range(fit.problem.parametrisation.size - fit.problem.parametrisation.shared))
    if logs[0] <= np.log(PIANIST_VELOCITY_RATIO):
        return ""
    low, ratio, high = np.exp(logs)
    return (
        f" The fitted velocities differ by a factor of {ratio:.3g} ({low:.3g} to {high:.3g}), those of a pianist by at "
        f"most {PIANIST_VELOCITY_RATIO:.0f}. The layers differ in a way that the model does not describe. Do not "
        "interpret the felt parameters and velocities."
    )


def _listed(*names: str) -> str:
    return " and ".join(filter(None, (", ".join(names[:-1]), names[-1])))


def strong_correlations(fit: InferenceResult) -> list[tuple[str, str, float]]:
    """Pairs of parameters that the recordings do not distinguish, with their correlation."""
    names, cov = fit.problem.parametrisation.names, fit.posterior.covariance[0]
    sd = np.sqrt(np.diag(cov))
    return [
        (names[j], names[i], float(r))
        for i in range(len(names))
        for j in range(i)
        if sd[i] > 0 and sd[j] > 0 and abs(r := cov[i, j] / (sd[i] * sd[j])) > STRONG_CORRELATION
    ]


def _identified(fit: InferenceResult, a: str, b: str) -> str:
    """The best-determined combination of two correlated parameters, with its uncertainty.

    log a − s log b has the least variance at s = cov(a, b)/var(b). For K_H and p the combination is the static force
    K_H u^p at the compression u of least variance: d log(K_H u^p) = d log K_H + log(u) p d log p.
    """
    i, j = (fit.problem.parametrisation.index_of(name) for name in (a, b))
    cov, mean = fit.posterior.covariance[0], fit.posterior.mean[0]
    slope = cov[i, j] / cov[j, j]
    half = HALF_WIDTH_95 * float(np.sqrt(max(cov[i, i] - slope * cov[i, j], 0.0)))
    if (a, b) == fit.problem.parametrisation.law.power:
        p = float(np.exp(mean[j]))
        u = float(np.exp(-slope / p))
        force = with_half_interval(float(np.exp(mean[i]) * u**p), half, "N")
        return f"the static felt force at {1e3 * u:.4g} mm, {a} u^{b} = {force}"
    return f"the product {a} · {b}^{-slope:.2g} ({format_relative_uncertainty(half)})"


def warnings(fit: InferenceResult, states: dict[str, str], worse: Sequence[str], errors: Sequence[float]) -> list[str]:
    """Warnings, the most important first.

    Parameters
    ----------
    worse : bands in which eq. 19 did not decrease.
    errors : rms level error of every recording, dB.
    """
    problem, at_bound = fit.problem, _names_at_bound(fit, states)
    lines = [] if fit.estimate.minima.converged[0] else [NOT_CONVERGED]
    lines += contradictory_velocities(fit)
    lines += _mixture(fit)
    lines += _outlying_recordings(fit, errors)
    lines += [CRITERION_NOT_DECREASED.format(", ".join(worse))] if worse else []
    lines += [AT_BOUND.format(", ".join(at_bound))] if at_bound else []
    lines += [
        f"{a} and {b} are strongly correlated ({r:+.3f}). The best-determined combination is {_identified(fit, a, b)}."
        for a, b, r in strong_correlations(fit)
    ]
    lines += [
        f'[[recording]] file = "{printable(entry)}" matches none of the recordings, so it does not apply to '
        f"{printable(recording)}. Check its spelling."
        for entry, recording in problem.unmatched_entries
    ]
    lines += [
        *velocity_assignment_warning(problem),
        *_assumed(fit),
        _excess_warning(fit),
        *mixed_format_warnings(problem.recordings),
    ]
    lines += recording_warnings(problem.recordings, problem.analyses)
    return lines + ([] if fit.alternative is None else [*fit.alternative.messages])


def _outlying_recordings(fit: InferenceResult, errors: Sequence[float]) -> list[str]:
    """Warnings about recordings that the fit reproduces much worse than the others."""
    group, lines = fit.problem.structure.group, []
    for i, (recording, error) in enumerate(zip(fit.problem.recordings, errors, strict=True)):
        others = float(np.median([*errors[:i], *errors[i + 1 :]] or [np.inf]))
        if error > max(OUTLIER_FACTOR * others, HAMMER_EXCESS_DB):
            hint = "If another microphone or instrument made it, give it its own group in a [[recording]] of the setup"
            if group.count(group[i]) == 1:
                hint = "It has a group of its own, so it may come from another instrument"
            lines.append(
                f"{printable(Path(recording.path).name)}: its level error is {error:.1f} dB, that of the other "
                f"recordings {others:.1f} dB. {hint}."
            )
    return lines


def velocity_assignment_warning(problem: FitProblem) -> list[str]:
    """The stroke to which v_H0 of [fixed] was assigned, where several are possible."""
    if not problem.velocity_without_file:
        return []
    velocity = problem.measured_velocity[problem.structure.stroke[problem.reference]]
    name = printable(Path(problem.recordings[problem.reference].path).name)
    return [
        f"[fixed] v_H0 = {velocity:g} m/s was assigned to the stroke of {name}, the brightest recording. To assign it "
        "to another one, give v_H0 in its [[recording]] instead."
    ]


def _assumed(fit: InferenceResult) -> list[str]:
    """Warnings about assumed sizes and a fitted width of the contact window."""
    start, u, lines = fit.problem.initial_values, fit.problem.parametrisation, []
    assumed = sorted({size for sizes in start.assumptions.values() for size in sizes})
    if assumed:
        lines.append(
            f"The string {' and '.join(assumed)} {'was' if len(assumed) == 1 else 'were'} not given. Literature values "
            f"for this key are used, and the SI values of {', '.join(start.assumptions)} scale with them."
        )
    if u.free[width := u.index_of("width")]:
        lines.append(
            "The shape of the contact window is unknown, so an effective width is fitted: "
            f"{1e3 * np.exp(fit.estimate.theta[width]):.2f} mm (given or assumed: {1e3 * start.geometry.width:.2f} mm)."
        )
    return lines


def _excess_warning(fit: InferenceResult) -> str:
    """The deviations of partials from the model beyond the noise."""
    frequency, decay = (np.exp(phi[0, 0]) for phi in fit.estimate.minima.candidates.phi[1:])
    return (
        f"Beyond the noise, partials deviate from the model by {frequency:.2f} cents (more from partial "
        f"{priors.LAW_REACH:.0f} on), {100 * decay:.0f} % in decay rate and {fit.excess:.2f} dB in level. "
        "The intervals treat these deviations as independent between partials."
    )


def _mixture(fit: InferenceResult) -> list[str]:
    """The posterior weight of the minimum shown, and the parameter in which the next one differs most."""
    weight, z = fit.posterior.weight, fit.estimate.minima.candidates.theta
    if len(weight) == 1 or weight[0] > 1 - MIN_OTHER_WEIGHT:
        return []
    u, other = fit.problem.parametrisation, 1 + int(np.argmax(weight[1:]))
    # Differences in standard deviations, in the coordinates of the search: force and exponent instead of K_H and p.
    to_search = np.linalg.inv(u.tangent(z[0]))
    sd = np.sqrt(np.diag(to_search @ fit.posterior.covariance[0] @ to_search.T))
    difference = np.abs(z[other] - z[0]) / np.where(u.free, np.where(sd > 0, sd, u.sd), np.inf)
    largest = int(np.argmax(difference[: u.shared]))
    is_force = bool(u.force_and_exponent_index) and largest == u.force_and_exponent_index[0]
    name = f"the felt force at {1e3 * np.exp(u.log_reference_compression):.3g} mm" if is_force else u.names[largest]
    unit = "N" if is_force else unit_and_meaning(u.names[largest], u.law)["unit"]
    shown, second = np.exp(z[[0, other], largest])
    first, next_best = (f"{100 * weight[at]:.0f} %" for at in (0, other))
    return [
        f"The minimum shown has posterior weight {first}. Another minimum, with {next_best}, differs most in {name}: "
        f"{second:.4g}{f' {unit}' * (unit != '1')} instead of {shown:.4g}. "
        + MIXTURE_NOTES["laplace" if fit.alternative is None else fit.alternative.method]
    ]
