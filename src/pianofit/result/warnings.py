"""The warnings of a fit, the most important first."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from ..analysis import Analysis, beating_warning, count_beating
from ..conversions import BEATING_DB
from ..inference import FitProblem, InferenceResult, priors
from ..io.files import printable
from ..recording.recording import Recording
from ..schema.quantities import Status, unit_of
from .statement import best_combination, strong_correlations
from .statuses import HAMMER_EXCESS_DB, velocity_statuses
from .velocity_check import contradictory_velocities

__all__ = [
    "AT_BOUND",
    "NOT_CONVERGED",
    "fit_warnings",
    "mixed_format_warnings",
    "outlier_warnings",
    "recording_warnings",
    "velocity_assignment_warning",
]

# A recording whose level error exceeds that of the others by this factor is named.
OUTLIER_FACTOR = 2.0
# A second minimum is named if all but the best have at least this posterior weight together.
MIN_OTHER_WEIGHT = 0.1
NOT_CONVERGED = "The search stopped before it converged. Do not use any of the values."
AT_BOUND = "These parameters are at a search bound, which sets their value: {}. Other results are conditional on it."


def fit_warnings(
    fit: InferenceResult, states: Mapping[str, Status], worse: Sequence[str], errors: Sequence[float]
) -> list[str]:
    """All warnings of a fit.

    Parameters
    ----------
    worse : bands in which eq. 19 did not decrease.
    errors : rms level error of every recording, dB.
    """
    problem = fit.problem
    at_bound = [name for name, state in states.items() if state == "at-bound"]
    at_bound += ["v_H0"] * ("at-bound" in velocity_statuses(fit))
    lines = [] if fit.estimate.minima.converged[0] else [NOT_CONVERGED]
    lines += contradictory_velocities(fit)
    lines += _mixture_warning(fit)
    lines += outlier_warnings(problem, errors)
    if worse:
        lines.append(f"The paper's criterion did not decrease in: {', '.join(worse)}. This fit does not minimise it.")
    lines += [AT_BOUND.format(", ".join(at_bound))] if at_bound else []
    lines += [
        f"{a} and {b} are strongly correlated ({r:+.3f}). The best-determined combination is "
        f"{best_combination(fit, a, b)}."
        for a, b, r in strong_correlations(fit)
    ]
    lines += [
        f'[[recording]] file = "{printable(entry)}" matches none of the recordings, so it does not apply to '
        f"{printable(recording)}. Check its spelling."
        for entry, recording in problem.unmatched_entries
    ]
    lines += velocity_assignment_warning(problem)
    lines += _assumption_warnings(fit)
    lines.append(_excess_warning(fit))
    lines += mixed_format_warnings(problem.recordings)
    lines += recording_warnings(problem.recordings, problem.analyses)
    return lines + ([] if fit.alternative is None else [*fit.alternative.messages])


def outlier_warnings(problem: FitProblem, errors: Sequence[float]) -> list[str]:
    """Warnings about recordings that the fit reproduces much worse than the others; `errors` in dB."""
    group, lines = problem.structure.group, []
    for i, (recording, error) in enumerate(zip(problem.recordings, errors, strict=True)):
        others = float(np.median([*errors[:i], *errors[i + 1 :]] or [np.inf]))
        if error > max(OUTLIER_FACTOR * others, HAMMER_EXCESS_DB):
            hint = "If another microphone or instrument made it, give it its own group in a [[recording]] of the setup"
            if group.count(group[i]) == 1:
                hint = "It has a group of its own, so it may come from another instrument"
            lines.append(
                f"{_name(recording)}: its level error is {error:.1f} dB, that of the other recordings {others:.1f} dB. "
                f"{hint}."
            )
    return lines


def velocity_assignment_warning(problem: FitProblem) -> list[str]:
    """The stroke to which v_H0 of [fixed] was assigned, where several are possible."""
    if not problem.velocity_without_file:
        return []
    velocity = problem.measured_velocity[problem.structure.stroke[problem.reference]]
    brightest = _name(problem.recordings[problem.reference])
    return [
        f"[fixed] v_H0 = {velocity:g} m/s was assigned to the stroke of {brightest}, the brightest recording. To "
        "assign it to another one, give v_H0 in its [[recording]] instead."
    ]


def _assumption_warnings(fit: InferenceResult) -> list[str]:
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


def _mixture_warning(fit: InferenceResult) -> list[str]:
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
    unit = "N" if is_force else unit_of(u.names[largest], u.law)
    shown, second = np.exp(z[[0, other], largest])
    note = {
        "laplace": "Intervals and predictions average over all minima.",
        "profile": "Predictions average over all minima. Intervals of the parameters belong to the minimum shown.",
        "posterior": "Predictions average over all minima. Intervals of the parameters come from the posterior draws.",
    }["laplace" if fit.alternative is None else fit.alternative.method]
    return [
        f"The minimum shown has posterior weight {100 * weight[0]:.0f} %. Another minimum, with "
        f"{100 * weight[other]:.0f} %, differs most in {name}: {second:.4g}{f' {unit}' * (unit != '1')} instead of "
        f"{shown:.4g}. {note}"
    ]


# --- warnings of recordings -------------------------------------------------------------------------------------------


def recording_warnings(recordings: Sequence[Recording], analyses: Sequence[Analysis]) -> list[str]:
    """The warnings of the recordings of one key and their analyses.

    Each line has the names of the recordings that share the warning. The line on beating comes last. The warnings of a
    single recording form one line without its name.
    """
    warnings = [(*r.warnings, *a.warnings) for r, a in zip(recordings, analyses, strict=True)]
    if len(recordings) == 1:
        return ["; ".join(warnings[0])] if warnings[0] else []
    names = [_name(recording) for recording in recordings]
    files: dict[str, list[str]] = {}
    for name, own, analysis in zip(names, warnings, analyses, strict=True):
        for warning in own:
            if warning != beating_warning(analysis.partials):
                files.setdefault(warning, []).append(name)
    every = f"all {len(names)} recordings"
    lines = [f"{every if len(own) == len(names) else ', '.join(own)}: {warning}" for warning, own in files.items()]
    counts = [(name, count_beating(one.partials), len(one.partials)) for name, one in zip(names, analyses, strict=True)]
    if beating := [f"{name} ({deep} of {partials} partials)" for name, deep, partials in counts if deep]:
        lines.append(
            f"Beating in {len(beating)} of {len(names)} recordings: {', '.join(beating)}. These partials deviate from "
            f"an exponential decay by more than {BEATING_DB:g} dB. Possible causes are several strings, two "
            "polarisations, or a note that was damped or cut."
        )
    return lines


def mixed_format_warnings(recordings: Sequence[Recording]) -> list[str]:
    """Warnings about recordings of a key that differ in their channels or sample rates."""
    names, lines = [_name(recording) for recording in recordings], []
    for name, values, consequence in (
        ("channels", [len(recording.frames) for recording in recordings], "The sound of the key is mono"),
        ("sample rates", [recording.rate for recording in recordings], "All are resampled to the highest"),
    ):
        if len({*values}) > 1:
            listed = ", ".join(f"{file} {value}" for file, value in zip(names, values, strict=True))
            lines.append(f"The recordings differ in their {name} ({listed}). {consequence}.")
    return lines


def _name(recording: Recording) -> str:
    return printable(Path(recording.path).name)
