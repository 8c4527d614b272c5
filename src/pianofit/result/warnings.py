"""The warnings of a fit, the most important first."""

from collections.abc import Iterator, Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np

from ..analysis import Analysis, beating_warning, count_beating
from ..conversions import BEATING_DB, HALF_WIDTH_95
from ..inference import FitProblem, InferenceResult, priors
from ..inference.parametrisation import Parametrisation
from ..io.files import printable
from ..io.number_format import first_of
from ..recording.recording import Recording
from ..schema.quantities import unit_of
from .comparison import worse_bands
from .correlations import StrongCorrelation
from .fitted_recording import FittedRecording
from .statuses import HAMMER_EXCESS_DB, PIANIST_VELOCITY_RATIO, Statuses

# A recording whose level error exceeds that of the others by this factor is named.
OUTLIER_FACTOR = 2.0
# A model that leaves more than this, dB rms, explains no level: levels in a field of many overlapping modes scatter so
# about their mean (Schroeder 1954).
UNEXPLAINED_DB = 5.57
# A second minimum is named if all but the best have at least this posterior weight together.
MIN_OTHER_WEIGHT = 0.1
# A faster stroke must be duller than a slower one by this many standard errors. In 55 pairs of neighbouring layers of
# three real pianos the louder one is always brighter, in 51 of them by more than this.
DULLER_STANDARD_ERRORS = 3.0
# Slopes above this are ignored, dB an octave: half of the smallest of those 55, 0.94, for a step of 2.4 dB.
DULLER_SLOPE = -0.5
# Mean level difference, dB, below which a faster stroke counts as fainter. A normalised file stays above it.
FAINTER_DB = -3.0
FEWEST_COMMON = 5  # common partials for a slope with a standard error
# Scatter of a partial's level from stroke to stroke, dB, added to its standard error.
STROKE_SCATTER_DB = 1.0
# Standard deviations by which a hammer parameter may deviate from the literature's value for the key: for the felt
# exponent this is 1.4 to 3.8 in the middle of the keyboard. One value in a hundred deviates more by chance.
LITERATURE_Z = 2.5
NOT_CONVERGED = "The search stopped before it converged. Do not use any of the values."
NOT_MINIMISED = "The paper's criterion did not decrease in: {}. This fit does not minimise it."
AT_BOUND = "These parameters are at a search bound, which sets their value: {}. Other results are conditional on it."


def fit_warnings(
    fit: InferenceResult,
    states: Statuses,
    correlated: Sequence[StrongCorrelation],
    compared: Sequence[FittedRecording],
) -> tuple[str, ...]:
    """All warnings of a fit; `compared` are its recordings with their sounds."""
    problem, worse = fit.problem, worse_bands(compared[fit.problem.reference].criterion)
    sections = (
        [] if fit.estimate.minima.converged[0] else [NOT_CONVERGED],
        contradictory_velocities(fit) if problem.parametrisation.law.has_contact else [],
        literature_warnings(fit),
        _mixture_warning(fit),
        unexplained_warnings([(_name(it.recording), it.levels.fitted_db) for it in compared]),
        outlier_warnings(problem, [recording.levels.fitted_db for recording in compared]),
        [NOT_MINIMISED.format(", ".join(worse))] if worse else [],
        _bound_warning(fit, states),
        _correlation_warnings(correlated),
        _unmatched_warnings(problem),
        velocity_assignment_warning(problem),
        _assumption_warnings(fit),
        [_excess_warning(fit)],
        mixed_format_warnings(problem.recordings),
        recording_warnings(problem.recordings, problem.analyses),
        fit.alternative.messages if fit.alternative else (),
    )
    return tuple(line for section in sections for line in section)


def _bound_warning(fit: InferenceResult, states: Statuses) -> list[str]:
    at_bound = [name for name, state in states.parameters.items() if state == "at-bound"]
    if "at-bound" in states.velocities:
        at_bound.append(fit.problem.parametrisation.law.stroke.name)
    return [AT_BOUND.format(", ".join(at_bound))] if at_bound else []


def _correlation_warnings(correlated: Sequence[StrongCorrelation]) -> list[str]:
    return [
        f"{pair.first} and {pair.second} are strongly correlated ({pair.correlation:+z.3f}). The best-determined "
        f"combination is {pair.best_combination}."
        for pair in correlated
    ]


def _unmatched_warnings(problem: FitProblem) -> list[str]:
    similar = [(entry, recording) for entry, recording in problem.unmatched_entries if recording]
    lines = [
        f'[[recording]] file = "{printable(entry)}" matches none of the recordings, so it does not apply to '
        f"{printable(recording)}. Check its spelling."
        for entry, recording in similar
    ]
    if problem.unmatched_entries and not similar:
        entries = first_of([f'"{printable(entry)}"' for entry, _ in problem.unmatched_entries])
        lines.append(
            f"No [[recording]] of the setup matches a recording, so its values are not used: file = {entries}. Give "
            "the names of the files."
        )
    return lines


def literature_warnings(fit: InferenceResult) -> list[str]:
    """Warnings about hammer parameters that deviate from the literature's values for the key, or from other keys."""
    u, theta, lines = fit.problem.parametrisation, fit.estimate.theta, []
    for name in (*u.law.parameters, *(name for name in ("M_H", "x0") if name in u.names)):
        i = u.index_of(name)
        if not u.free[i] or u.given[i]:
            continue
        deviations = float(theta[i] - u.mean[i]) / float(u.sd[i])
        if abs(deviations) < LITERATURE_Z:
            continue
        label, unit = _name_and_unit(u, i)
        source = "the literature" if u.joint is None else "the prediction from the other keys"
        low, value, high = np.exp([u.mean[i] - HALF_WIDTH_95 * u.sd[i], theta[i], u.mean[i] + HALF_WIDTH_95 * u.sd[i]])
        lines.append(
            f"{label} = {value:.3g}{f' {unit}' * (unit != '1')} deviates by {abs(deviations):.1f} standard deviations "
            f"from {source}, which has {low:.3g} to {high:.3g} (95 %) for this key. Check the setup, and compare "
            "other layers."
        )
    return lines


def _name_and_unit(u: Parametrisation, i: int) -> tuple[str, str]:
    """The name and the unit of the searched parameter `i`: the felt force in place of K_H."""
    if u.force_and_exponent_index and i == u.force_and_exponent_index[0]:
        return f"the {u.felt_force_name}", "N"
    return u.names[i], unit_of(u.names[i], u.law)


def unexplained_warnings(errors: Sequence[tuple[str, float]]) -> list[str]:
    """A warning about recordings whose levels the model does not explain; their names and errors after the fit, dB."""
    unexplained = [f"{name} ({error:.1f} dB)" for name, error in errors if error > UNEXPLAINED_DB]
    return [
        f"The model does not explain the partial levels of {first_of(unexplained)}. Levels of many "
        f"overlapping modes scatter by {UNEXPLAINED_DB:.1f} dB. Check the sizes and positions of the setup."
    ] * bool(unexplained)


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
        one = len(assumed) == 1
        source = "Literature values for this key" if u.law.has_contact else "Typical values"
        scaled = [name for name in start.assumptions if name in u.reported and u.free[u.index_of(name)]]
        lines.append(
            f"The string {' and '.join(assumed)} {'was' if one else 'were'} not given. {source} are used, and the SI "
            f"values of {', '.join(scaled)} scale with {'it' if one else 'them'}."
        )
    if u.free[width := u.index_of("width")]:
        lines.append(
            "The shape of the contact window is unknown, so an effective width is fitted: "
            f"{1e3 * np.exp(fit.estimate.theta[width]):.2f} mm (given or assumed: {1e3 * start.geometry.width:.2f} mm)."
        )
    return lines


def _excess_warning(fit: InferenceResult) -> str:
    """The deviations of partials from the model beyond the noise."""
    frequency, decay = (np.hypot(*np.exp(phi[0, :2])) for phi in fit.estimate.minima.candidates.phi[1:])
    return (
        "Partials deviate from the model by more than the noise. The standard deviation is "
        f"{frequency:.2f} cents in frequency (at partial {priors.REFERENCE_PARTIAL:.0f}), a factor of "
        f"{np.exp(decay):.2f} in decay rate and {fit.excess:.2f} dB in level."
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
    stroke = u.law.stroke
    # Velocities of a hammer follow from the other parameters.
    largest = int(np.argmax(difference[: u.shared if stroke.scale_is_open else u.velocities.stop]))
    name, unit = _name_and_unit(u, largest) if largest < u.shared else (stroke.name, stroke.unit)
    shown, second = np.exp(z[[0, other], largest])
    note = {
        "laplace": "Intervals and predictions average over all minima.",
        "profile": "Predictions average over all minima. Intervals of the parameters belong to the minimum shown.",
        "posterior": "Predictions average over all minima. Intervals of the parameters come from the posterior draws.",
    }["laplace" if fit.alternative is None else fit.alternative.method]
    return [
        f"The minimum shown has posterior weight {100 * weight[0]:.0f} %, another one {100 * weight[other]:.0f} %. "
        f"They differ most in {name}: {shown:.4g}{f' {unit}' * (unit != '1')} in the minimum shown, {second:.4g} in "
        f"the other one. {note}"
    ]


# --- measured velocities ----------------------------------------------------------------------------------------------
#
# Two observations need neither a gain nor a unit. Felt stiffens under compression, so a faster stroke is brighter:
# levels rise more towards high frequencies. The change in brightness also determines the felt exponent. So a wrong
# ratio of the velocities gives an exponent outside the range of felts.


def brightening(slower: Analysis, faster: Analysis) -> tuple[float, float, float]:
    """Change of the levels from one stroke to another, over their common partials.

    Returns
    -------
    Slope in dB an octave, its standard error (infinite for too few common partials), and mean change in dB.
    """
    a, b = slower.partials, faster.partials
    number, i, j = np.intersect1d(a.number, b.number, return_indices=True)
    if len(number) < FEWEST_COMMON:
        return 0.0, np.inf, 0.0
    change = b.level[j] - a.level[i]
    weight = 1 / (a.level_error[i] ** 2 + b.level_error[j] ** 2 + STROKE_SCATTER_DB**2)
    (slope, _), covariance = np.polyfit(np.log2(number), change, 1, w=np.sqrt(weight), cov=True)
    return float(slope), float(np.sqrt(covariance[0, 0])), float(np.average(change, weights=weight))


def contradictory_velocities(fit: InferenceResult) -> list[str]:
    """Warnings about measured velocities that contradict the recordings; empty if none do."""
    problem, lines = fit.problem, []
    groups = [*_measured(problem)]
    if surest := min((pair for group in groups for pair in _contradictions(problem, group)), default=None):
        _, slow, fast, difference = surest
        faster, slower = _with_velocity(problem, fast), _with_velocity(problem, slow)
        lines.append(
            f"{faster} is {difference} than {slower}. A faster stroke is louder and brighter. Check the measured "
            "velocities."
        )
    given = sorted(v for v in problem.measured_velocity if v is not None)
    if given and given[-1] > PIANIST_VELOCITY_RATIO * given[0]:
        lines.append(
            f"The measured velocities, {given[0]:g} to {given[-1]:g} m/s, differ by more than a factor of "
            f"{PIANIST_VELOCITY_RATIO:g}, the range of a pianist. Check them and their unit, m/s."
        )
    compared = any(len({v for v, _ in group}) > 1 for group in groups)
    return lines or (_implausible_exponent(fit, given) if compared else [])


def _measured(problem: FitProblem) -> Iterator[list[tuple[float, int]]]:
    """For each output path: velocity, m/s, and index of its recordings with a measured velocity, slowest first."""
    layout = problem.structure
    for group in sorted(set(layout.group)):
        speeds = [(problem.measured_velocity[s], i) for i, s in enumerate(layout.stroke) if layout.group[i] == group]
        yield sorted((v, i) for v, i in speeds if v is not None)


def _contradictions(problem: FitProblem, group: Sequence[tuple[float, int]]) -> Iterator[tuple[float, int, int, str]]:
    """Neighbouring strokes of a path group whose sounds contradict the order of their velocities.

    Yields a score (lowest for the surest), the indices of the slower and the faster recording, and the difference.
    """
    for (v, slow), (w, fast) in pairwise(group):
        slope, error, mean = brightening(problem.analyses[slow], problem.analyses[fast])
        is_duller = slope < min(DULLER_SLOPE, -DULLER_STANDARD_ERRORS * error)
        words = [f"duller (by {-slope:.1f} dB an octave)"] * is_duller
        words += [f"fainter (by {-mean:.1f} dB)"] * (mean < FAINTER_DB)
        if v < w and words:
            yield slope / error + mean, slow, fast, " and ".join(words)


def _with_velocity(problem: FitProblem, recording: int) -> str:
    speed = problem.measured_velocity[problem.structure.stroke[recording]]
    return f"{_name(problem.recordings[recording])} ({speed:g} m/s)"


def _implausible_exponent(fit: InferenceResult, given: Sequence[float]) -> list[str]:
    """A warning about a felt exponent outside the range of felts, which a wrong ratio of velocities explains."""
    u = fit.problem.parametrisation
    if u.force_and_exponent_index is None or not u.free[exponent := u.force_and_exponent_index[1]]:
        return []
    z_score = float(fit.estimate.theta[exponent] - u.mean[exponent]) / float(u.sd[exponent])
    if abs(z_score) < LITERATURE_Z:
        return []
    side, differ = ("above", "less") if z_score > 0 else ("below", "more")
    return [
        f"The felt exponent {u.names[exponent]} = {np.exp(fit.estimate.theta[exponent]):.2g} is {side} the range of "
        f"felts. The measured velocities, {given[0]:g} to {given[-1]:g} m/s, differ {differ} than the sound does. "
        "Check them."
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
