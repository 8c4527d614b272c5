"""What a fit can claim, said first and plainly: its identifiability statement, statuses and messages."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ..conversions import NORMAL
from ..inference import priors
from ..inference.parametrisation import STRING_SIZE
from ..inference.pipeline import InferenceResult
from ..inference.problem import FitProblem
from ..io.files import printable
from ..io.number_format import format_relative_uncertainty, with_half_interval
from ..recording.recording import Recording
from .remarks import remarks
from .serialise import unit_and_meaning
from .velocity_check import VELOCITIES, questioned

__all__ = [
    "AT_EDGE",
    "STATUSES",
    "STOPPED",
    "identifiability_statement",
    "correlated",
    "invariant_status",
    "warnings",
    "mixed_layouts",
    "velocity_assumption",
    "scaling",
    "statuses",
    "retracted",
    "velocity_statuses",
]

STATUSES = ("fitted", "scaled", "given", "assumed", "at-bound", "not-identifiable")
# A parameter whose posterior is this wide, over its prior, has learned next to nothing from the recording.
LEARNED = 0.7
# A standard deviation of log(value) above this is no knowledge.
LOOSE = 0.7
# A calibrated recording of the string described is met within hundredths of a decibel. An excess beyond this, dB, means
# that something acts that the model does not have, and the felt takes it up;
STRAINED = 0.1
# beyond this, dB, the hammer itself may be another.
POOR = 0.5
# Correlation of two logarithms beyond which they are named.
STRONG = 0.99
# A recording whose levels are so many times as far off as the others' is named.
FARTHER = 2.0
# A second minimum with this share of the posterior is named.
NAMED = 0.1
MIXED = {
    "laplace": "Intervals and predictions are those of the mixture.",
    "profile": "Predictions are those of the mixture, the parameters' intervals the first one's.",
    "posterior": "Predictions are those of the mixture; the parameters' intervals are the posterior's draws.",
}
STOPPED = "The search stopped before it converged; no value is a result."
AT_EDGE = "At a bound of the search, which decides the value, and what else is found holds with it there: {}."
WORSE = "The paper's criterion, which this fit does not minimise, is no lower than at the start: {}."
ONE_VELOCITY = (
    "One uncalibrated recording does not fix the felt: any hammer's spectrum can be traded for an output path, and a "
    "softer felt struck faster sounds the same through another gain. "
)
ONE_GAIN = (
    "One recording without a unit does not fix the felt: a softer one struck faster sounds the same through another "
    "gain. "
)
NOTHING_COMPARED = (
    "{} uncalibrated recordings, but none shares a path with a stroke of another velocity, which does not fix the "
    "felt: any hammer's spectrum can be traded for an output path. "
)
SEVERAL = (
    "{} uncalibrated recordings of one key: what changes from stroke to stroke is the hammer's doing, what they share "
    "is the path's. "
)


# --- in one word ------------------------------------------------------------------------------------------------------


def statuses(fit: InferenceResult) -> dict[str, str]:
    """One of `STATUSES` by parameter name."""
    u, start = fit.problem.unknowns, fit.problem.start
    bound, lost, moving = u.at_bound(fit.found.z), retracted(fit), scaling(fit)
    # Of the logarithms of values, before the recordings; of the string's no more is asked than that it be known.
    prior = np.linalg.norm(u.tangent(fit.found.z) * u.sd, axis=1)
    enough = np.where(np.arange(u.size) < STRING_SIZE, LOOSE, np.minimum(LEARNED * prior, LOOSE))

    def status(i: int, name: str) -> str:
        if not u.free[i]:
            return "assumed" if start.fixed.get(name) == "assumed" else "given"
        if bound[i]:
            return "at-bound"
        # Without a measured velocity what scales with it is known by its prior alone.
        posterior = fit.gauge_fixed if name in moving else fit.posterior
        if name in lost or posterior.spread(np.eye(u.size)[i]) > enough[i]:
            return "not-identifiable"
        return "scaled" if name in moving or start.assumptions.get(name) else "fitted"

    return {name: status(i, name) for i, name in enumerate(u.names)}


def scaling(fit: InferenceResult) -> tuple[str, ...]:
    """The felt's parameters that move with the common scale of the velocities, where that is open."""
    return fit.problem.unknowns.law.scaling("N m") if fit.problem.velocity_scale_free and _compared(fit) else ()


def _fastest_over_slowest(fit: InferenceResult, strokes: Sequence[int]) -> tuple[float, float, float]:
    """Logarithm of the ratio of their velocities, between the ends of its 95 % interval."""
    u, z = fit.problem.unknowns, fit.found.z
    at, change = u.shared + np.array(strokes), np.zeros(u.size)
    change[at[np.argmax(z[at])]] += 1
    change[at[np.argmin(z[at])]] -= 1
    apart = float(z @ change)
    low, high = fit.posterior.interval(change) or (apart, apart)
    return low, apart, high


def _compared(fit: InferenceResult) -> bool:
    """Whether any path was heard with two velocities that certainly differ: two like strokes say no more than one."""
    layout = fit.problem.layout
    paths = [
        sorted({s for s, g in zip(layout.stroke, layout.group, strict=True) if g == at}) for at in set(layout.group)
    ]
    return any(_fastest_over_slowest(fit, strokes)[0] > 0 for strokes in paths)


def retracted(fit: InferenceResult) -> tuple[str, ...]:
    """What the statement takes back, however narrow its interval."""
    problem = fit.problem
    felt = tuple(problem.unknowns.law.parameters)
    if problem.calibrated:
        return () if fit.excess <= STRAINED else felt if fit.excess <= POOR else (*felt, "M_H")
    if _compared(fit):
        return felt if _beyond_a_pianist(fit) else ()
    return (*felt, "M_H") if problem.path else felt


def invariant_status(states: Sequence[str], deviation: float) -> str:
    """Of a ratio or product of values with these statuses, whose logarithm has this standard deviation."""
    for lost in ("not-identifiable", "at-bound"):
        if lost in states:
            return lost
    if not deviation:
        return "assumed" if "assumed" in states else "given"
    return "not-identifiable" if deviation > LOOSE else "fitted"


def velocity_statuses(fit: InferenceResult) -> list[str]:
    """One of `STATUSES` for every stroke's velocity."""
    problem = fit.problem
    lost = fit.excess > POOR if problem.calibrated else not _compared(fit) or bool(_beyond_a_pianist(fit))
    unknown = "not-identifiable" if lost else "scaled" if problem.velocity_scale_free else "fitted"
    bound = problem.unknowns.at_bound(fit.found.z)[problem.unknowns.shared :]
    return [
        "given" if v is not None else "at-bound" if at else unknown
        for v, at in zip(problem.measured_velocity, bound, strict=True)
    ]


def _bound(fit: InferenceResult, states: dict[str, str]) -> list[str]:
    """What lies at a bound of the search."""
    names = [name for name, state in states.items() if state == "at-bound"]
    return names + ["v_H0"] * ("at-bound" in velocity_statuses(fit))


# --- in sentences -----------------------------------------------------------------------------------------------------


def identifiability_statement(fit: InferenceResult, states: dict[str, str], levels: dict) -> str:
    """The opening sentences: what kind of measurement this is, and what of it is identified."""
    problem = fit.problem
    if problem.calibrated:
        return f"Calibrated recording{_calibrated(fit, states)}."
    count = len(problem.recordings)
    several = SEVERAL if _compared(fit) else NOTHING_COMPARED
    text = (ONE_VELOCITY if problem.path else ONE_GAIN) if count == 1 else several.format(count)
    through = "path" if problem.path else "gain"
    text += (
        f"Partial levels: {levels['initial_db']:.1f} dB off at the start; {levels['path_only_db']:.1f} dB with the "
        f"{_initial(problem)} hammer at the velocities and through the {through} that suit it; "
        f"{levels['fitted_db']:.1f} dB with the fitted hammer."
    )
    if not _compared(fit):
        felt = any(problem.unknowns.free[problem.unknowns.index_of(name)] for name in problem.unknowns.law.parameters)
        under = f"the prior{' of the path' if problem.path else ''}"
        return text + f" The felt's values are one possibility under {under}, not a finding." * felt
    beyond = _beyond_a_pianist(fit)
    text += beyond
    if problem.velocity_scale_free and not beyond:
        moving = (name.replace("mu", "μ") for name in problem.unknowns.law.scaling("N m"))
        text += (
            f" No hammer velocity was measured: {_listed('velocities', *moving)} are known up to one common scale, "
            "and their intervals are the prior's. The ratios listed first do not depend on it, nor do f0 and B."
        )
    return text


def _initial(problem: FitProblem) -> str:
    """Whose hammer the search began with."""
    start = problem.start
    return "initial" if start.user_given or start.law.hammers is None else "literature's"


def _calibrated(fit: InferenceResult, states: dict[str, str]) -> str:
    """How the opening sentence goes on, of a calibrated recording."""
    if fit.excess > STRAINED:
        what = "something acts that the model does not have. The felt's"
        if fit.excess > POOR:
            what = "another hammer may explain it better, or the setup is not this string's. The hammer's"
        missed = f"the model misses its levels by {fit.excess:.2f} dB beyond the noise"
        return f", but {missed}: {what} values are no finding"
    lost = [n for n, state in states.items() if state == "not-identifiable" and n != "width"]
    if lost:
        return f". Not identifiable from it: {', '.join(lost)}"
    together = "; ".join(f"{a} and {b} mostly together, as {_identified(fit, a, b)}" for a, b, _ in correlated(fit))
    return ": all free parameters are identified" + (f", {together}" if together else "")


def _beyond_a_pianist(fit: InferenceResult) -> str:
    """That the strokes' velocities differ by more than a pianist's, where that is certain."""
    logs = _fastest_over_slowest(fit, range(fit.problem.unknowns.size - fit.problem.unknowns.shared))
    if logs[0] <= np.log(VELOCITIES):
        return ""
    low, most, high = np.exp(logs)
    return (
        f" The fastest stroke is found {most:.3g} times ({low:.3g} to {high:.3g}) as fast as the slowest, and a "
        f"pianist's differ by {VELOCITIES:.0f} times: these layers differ by something that the model does not have, "
        "and felt and velocities, which take it up, are no finding."
    )


def _listed(*names: str) -> str:
    return " and ".join(filter(None, (", ".join(names[:-1]), names[-1])))


def correlated(fit: InferenceResult) -> list[tuple[str, str, float]]:
    """Pairs of parameters that the recordings do not tell apart, with their correlation."""
    names, cov = fit.problem.unknowns.names, fit.posterior.covariance[0]
    sd = np.sqrt(np.diag(cov))
    return [
        (names[j], names[i], float(r))
        for i in range(len(names))
        for j in range(i)
        if sd[i] > 0 and sd[j] > 0 and abs(r := cov[i, j] / (sd[i] * sd[j])) > STRONG
    ]


def _identified(fit: InferenceResult, a: str, b: str) -> str:
    """The combination of two correlated parameters that is known best, and how well.

    With log b known, log a − s log b has the least variance at s = cov(a, b)/var(b). Of K_H and p it is the felt's
    static force K_H u^p, at the compression u where that is known best: d log(K_H u^p) = d log K_H + log(u) p d log p.
    """
    i, j = (fit.problem.unknowns.index_of(name) for name in (a, b))
    cov, mean = fit.posterior.covariance[0], fit.posterior.mean[0]
    slope = cov[i, j] / cov[j, j]
    half = NORMAL * float(np.sqrt(max(cov[i, i] - slope * cov[i, j], 0.0)))
    if (a, b) == fit.problem.unknowns.law.power:
        p = float(np.exp(mean[j]))
        u = float(np.exp(-slope / p))
        force = with_half_interval(float(np.exp(mean[i]) * u**p), half, "N")
        return f"the felt's force at {1e3 * u:.4g} mm, {a} u^{b} = {force}"
    return f"the product {a} · {b}^{-slope:.2g} ({format_relative_uncertainty(half)})"


def warnings(fit: InferenceResult, states: dict[str, str], worse: Sequence[str], errors: Sequence[float]) -> list[str]:
    """Plain sentences on what to beware of, the weightiest first.

    Parameters
    ----------
    worse : bands of eq. 19 that ended no lower than they began.
    errors : of every recording's levels, dB.
    """
    problem, bound = fit.problem, _bound(fit, states)
    said = [] if fit.found.minima.converged[0] else [STOPPED]
    said += questioned(fit)
    said += _mixture(fit)
    said += _out_of_line(fit, errors)
    said += [WORSE.format(", ".join(worse))] if worse else []
    said += [AT_EDGE.format(", ".join(bound))] if bound else []
    said += [
        f"{a} and {b} are strongly correlated ({r:+.3f}): better identified than either is {_identified(fit, a, b)}."
        for a, b, r in correlated(fit)
    ]
    said += [
        f'[[recording]] file = "{printable(one)}" is none of the recordings, and says nothing of {printable(other)}: is '
        "it misspelt?"
        for one, other in problem.unmatched_entries
    ]
    said += [*velocity_assumption(problem), *_assumed(fit), _excess_warning(fit), *mixed_layouts(problem.recordings)]
    said += remarks(problem.recordings, problem.analyses)
    return said + ([] if fit.view is None else [*fit.view.messages])


def mixed_layouts(recordings: Sequence[Recording]) -> list[str]:
    """Remarks on recordings of a key that differ in their channels or sample rates."""
    kinds = (("channels", lambda one: len(one.frames), "The sound of the key is mono"),
             ("sample rates", lambda one: one.rate, "All are resampled to the highest"))  # fmt: skip
    said = []
    for what, value, follows in kinds:
        each = {printable(Path(one.path).name): value(one) for one in recordings}
        if len({*each.values()}) > 1:
            listed = ", ".join(f"{name} {value}" for name, value in each.items())
            said.append(f"The recordings differ in their {what} ({listed}). {follows}.")
    return said


def _out_of_line(fit: InferenceResult, errors: Sequence[float]) -> list[str]:
    """Recordings that the fit meets much worse than the others."""
    alone = (
        "it has a group of its own, so it may be another instrument's",
        "one of another microphone or instrument needs a group of its own, by a [[recording]] in the setup",
    )
    said = []
    for i, (recording, error) in enumerate(zip(fit.problem.recordings, errors, strict=True)):
        others = float(np.median([*errors[:i], *errors[i + 1 :]] or [np.inf]))
        if error > max(FARTHER * others, POOR):
            said.append(
                f"{printable(Path(recording.path).name)}: its levels are {error:.1f} dB off, the others' {others:.1f} "
                f"dB; {alone[fit.problem.layout.group.count(fit.problem.layout.group[i]) > 1]}."
            )
    return said


def velocity_assumption(problem: FitProblem) -> list[str]:
    """Whose velocity that in [fixed] is taken for, where it could be of several."""
    if not problem.assumed_velocity_of:
        return []
    at = problem.reference
    return [
        f"[fixed] v_H0 = {problem.measured_velocity[problem.layout.stroke[at]]:g} m/s is taken for the stroke of "
        f"{printable(Path(problem.recordings[at].path).name)}, the brightest of these recordings; a [[recording]] says "
        "of each which velocity was measured."
    ]


def _assumed(fit: InferenceResult) -> list[str]:
    """What rests on the literature's sizes, and on a window that is not known."""
    start, u, said = fit.problem.start, fit.problem.unknowns, []
    rests = sorted({x for names in start.assumptions.values() for x in names})
    if rests:
        said.append(
            f"The string's {' and '.join(rests)} {'was' if len(rests) == 1 else 'were'} not given and taken from the "
            f"literature for this key; the SI values of {', '.join(start.assumptions)} scale with them."
        )
    if u.free[width := u.index_of("width")]:
        said.append(
            "The shape of the contact's window is not known, so its width is fitted along: an effective "
            f"{1e3 * np.exp(fit.found.z[width]):.2f} mm (given or assumed: {1e3 * start.geometry.width:.2f} mm)."
        )
    return said


def _excess_warning(fit: InferenceResult) -> str:
    """By how much partials leave the model, beyond the noise."""
    frequency, decay = (np.exp(phi[0, 0]) for phi in fit.found.minima.people.phi[1:])
    return (
        f"Beyond the noise, partials scatter about the model by {frequency:.2f} cents (more from the "
        f"{priors.LAW_REACH:.0f}th on), {100 * decay:.0f} % in decay and {fit.excess:.2f} dB in level; "
        "the intervals include it as if each partial did so by itself."
    )


def _mixture(fit: InferenceResult) -> list[str]:
    """How much weight the heaviest minimum has, and another hammer about as probable."""
    share, z = fit.posterior.share, fit.found.minima.people.theta
    if len(share) == 1 or share[0] > 1 - NAMED:
        return []
    u, other = fit.problem.unknowns, 1 + int(np.argmax(share[1:]))
    # In standard deviations; of a felt with a power by its force, as it is searched: K_H says little without p.
    untangled = np.linalg.inv(u.tangent(z[0]))
    sd = np.sqrt(np.diag(untangled @ fit.posterior.covariance[0] @ untangled.T))
    apart = np.abs(z[other] - z[0]) / np.where(u.free, np.where(sd > 0, sd, u.sd), np.inf)
    at = int(np.argmax(apart[: u.shared]))
    forced = bool(u.force_and_exponent_index) and at == u.force_and_exponent_index[0]
    named = f"the felt's force at {1e3 * np.exp(u.log_reference_compression):.3g} mm" if forced else u.names[at]
    unit = "N" if forced else unit_and_meaning(u.names[at], u.law)["unit"]
    shown, second = np.exp(z[[0, other], at])
    return [
        f"The minimum that is shown has the largest share of the posterior, {100 * share[0]:.0f} %. Another hammer, "
        f"with {100 * share[other]:.0f} %, differs most in {named}: {second:.4g}{f' {unit}' * (unit != '1')} instead "
        f"of {shown:.4g}. " + MIXED["laplace" if fit.view is None else fit.view.method]
    ]
