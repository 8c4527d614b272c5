"""What a fit can claim, said first and plainly: its identifiability statement, statuses and messages."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ..io import one_line
from ..numbers import off_by, with_half_interval
from ..units import NORMAL
from . import priors
from .coordinates import STRING_SIZE
from .estimate import Estimate
from .posterior import Posterior
from .problem import Problem

__all__ = [
    "STATUSES", "claims", "correlated", "invariant_status", "messages", "presumed", "statuses", "taken_back",
    "velocity_statuses",
]  # fmt: skip

STATUSES = ("fitted", "scaled", "given", "assumed", "at-bound", "not-identifiable")
# A parameter whose posterior is this wide, over its prior, has learned next to nothing from the recording.
LEARNED = 0.7
# A standard deviation of log(value) above this is no knowledge.
LOOSE = 0.7
# Correlation of two logarithms beyond which they are named.
STRONG = 0.99
# A calibrated recording of the string described is met within hundredths of a decibel. An excess beyond this, dB, means
# that something acts that the model does not have, and the felt takes it up;
STRAINED = 0.1
# beyond this, dB, the hammer itself may be another.
POOR = 0.5
# Hammer velocities of a pianist, fortissimo over pianissimo: 6 over 0.3 m/s (Askenfelt and Jansson 1991).
VELOCITIES = 20.0
# A second minimum with this share of the posterior is named.
NAMED = 0.1
MIXED = {
    "laplace": "Intervals and predictions are those of the mixture.",
    "profile": "Predictions are those of the mixture, the parameters' intervals the first one's.",
    "posterior": "Predictions are those of the mixture; the parameters' intervals are the posterior's draws.",
}
WORSE = "The paper's criterion, which this fit does not minimise, is no lower than at the start: {}."
ONE_VELOCITY = (
    "One uncalibrated recording does not fix the felt: any hammer's spectrum can be traded for an output path, and a "
    "softer felt struck faster sounds the same through another gain. "
)
NOTHING_COMPARED = (
    "{} uncalibrated recordings, but none shares a path with a recording of another stroke, which does not fix the "
    "felt: any hammer's spectrum can be traded for an output path. "
)
SEVERAL = (
    "{} uncalibrated recordings of one key: what changes from stroke to stroke is the hammer's doing, what they share "
    "is the path's. "
)


def prior_spread(problem: Problem, z: np.ndarray) -> np.ndarray:
    """Standard deviations that the logarithms of values have before the recordings [size]."""
    u = problem.unknowns
    tangent = u.tangent(z)
    return np.sqrt(np.diag(tangent @ np.diag(u.sd**2) @ tangent.T))


def statuses(problem: Problem, found: Estimate) -> dict[str, str]:
    """One of `STATUSES` by parameter name."""
    u, start = problem.unknowns, problem.start
    bound = u.at_bound(found.z)
    prior = prior_spread(problem, found.z)
    result = {}
    for i, name in enumerate(u.names):
        change = np.eye(u.size)[i]
        if not u.free[i]:
            result[name] = "assumed" if start.fixed.get(name) == "assumed" else "given"
        elif bound[i]:
            result[name] = "at-bound"
        else:
            sd = found.posterior.spread(change)
            vague = sd > (LOOSE if i < STRING_SIZE else min(LEARNED * prior[i], LOOSE))
            result[name] = "not-identifiable" if vague else "scaled" if start.rests_on.get(name) else "fitted"
    for name in taken_back(problem, found):
        if result.get(name) in ("fitted", "scaled"):
            result[name] = "not-identifiable"
    # Without a measured velocity what scales with it is known by its prior alone.
    if not problem.calibrated and all(v is None for v in problem.speed):
        for name in u.law.scaling("N m"):
            if problem.layout.compared and result[name] in ("fitted", "scaled", "not-identifiable"):
                gauge = _at_reference(problem, found.posterior)
                sd = gauge.spread(np.eye(u.size)[u.at(name)])
                result[name] = "scaled" if sd < min(LEARNED * prior[u.at(name)], LOOSE) else "not-identifiable"
    return result


def taken_back(problem: Problem, found: Estimate) -> tuple[str, ...]:
    """What the statement takes back, however narrow its interval."""
    felt = tuple(problem.unknowns.law.parameters)
    if problem.calibrated:
        excess = float(np.exp(found.minima.people.phi[0, 0]))
        return () if excess <= STRAINED else felt if excess <= POOR else (*felt, "M_H")
    return () if problem.layout.compared else (*felt, "M_H") if problem.path else felt


def invariant_status(states: Sequence[str], deviation: float) -> str:
    """Of a ratio or product of values with these statuses, whose logarithm has this standard deviation."""
    for lost in ("not-identifiable", "at-bound"):
        if lost in states:
            return lost
    if not deviation:
        return "assumed" if "assumed" in states else "given"
    return "not-identifiable" if deviation > LOOSE else "fitted"


def velocity_statuses(problem: Problem, found: Estimate) -> list[str]:
    """One of `STATUSES` for every stroke's velocity."""
    known = [v is not None for v in problem.speed]
    if problem.calibrated:
        excess = float(np.exp(found.minima.people.phi[0, 0]))
        return ["given" if k else "not-identifiable" if excess > POOR else "fitted" for k in known]
    unknown = "fitted" if any(known) else "scaled"
    if not problem.layout.compared:
        unknown = "not-identifiable"
    return ["given" if k else unknown for k in known]


def _at_reference(problem: Problem, posterior: Posterior) -> Posterior:
    """Gauge-fixed: the reference stroke's velocity held."""
    return posterior.given(
        np.eye(problem.unknowns.size)[problem.unknowns.shared + problem.layout.stroke[problem.reference]]
    )


def claims(problem: Problem, found: Estimate, states: dict[str, str], levels: dict) -> str:
    """The opening sentences: what kind of measurement this is, and what of it is identified."""
    excess = float(np.exp(found.minima.people.phi[0, 0]))
    if problem.calibrated:
        if excess > STRAINED:
            what = "another hammer may explain it better, or the setup is not this string's. The hammer's"
            what = what if excess > POOR else "something acts that the model does not have. The felt's"
            missed = f"the model misses its levels by {excess:.2f} dB beyond the noise"
            return f"Calibrated recording, but {missed}: {what} values are no finding."
        lost = [n for n, state in states.items() if state == "not-identifiable" and n != "width"]
        pairs = correlated(problem, found.posterior)
        if lost:
            return f"Calibrated recording. Not identifiable from it: {', '.join(lost)}."
        if pairs:
            together = "; ".join(f"{a} and {b} mostly together, as {_identified(problem, found.posterior, a, b)}"
                                 for a, b, _ in pairs)  # fmt: skip
            return f"Calibrated recording: all free parameters are identified, {together}."
        return "Calibrated recording: all free parameters are identified."
    count = len(problem.recordings)
    text = ONE_VELOCITY if count == 1 else (SEVERAL if problem.layout.compared else NOTHING_COMPARED).format(count)
    through = "path" if problem.path else "gain"
    text += (
        f"Partial levels: {levels['initial_db']:.1f} dB off at the start; {levels['path_only_db']:.1f} dB with the "
        f"literature's hammer through the {through} that suits it; {levels['fitted_db']:.1f} dB with the fitted hammer."
    )
    if not problem.layout.compared:
        return text + " The felt's values are one possibility under the prior of the path, not a finding."
    text += _beyond_a_pianist(problem, found)
    if all(v is None for v in problem.speed):
        moving = (name.replace("mu", "μ") for name in problem.unknowns.law.scaling("N m"))
        text += (
            f" No hammer velocity was measured: {_listed('velocities', *moving)} are known up to one common scale, "
            "and their intervals are the prior's. The ratios listed first do not depend on it, nor do f0 and B."
        )
    return text


def _beyond_a_pianist(problem: Problem, found: Estimate) -> str:
    """That the strokes' velocities differ by more than a pianist's, where that is certain."""
    u = problem.unknowns
    log_v = found.z[u.shared : u.shared + problem.layout.strokes]
    change = np.zeros(u.size)
    change[u.shared + np.argmax(log_v)] += 1
    change[u.shared + np.argmin(log_v)] -= 1
    interval = found.posterior.interval(change)
    if interval is None or interval[0] <= np.log(VELOCITIES):
        return ""
    low, most, high = np.exp([interval[0], float(found.z @ change), interval[1]])
    return (
        f" The fastest stroke is found {most:.3g} times ({low:.3g} to {high:.3g}) as fast as the slowest, and a "
        f"pianist's differ by {VELOCITIES:.0f} times: these layers differ by something that the model does not have, "
        "and the felt takes it up."
    )


def _listed(*names: str) -> str:
    return " and ".join(filter(None, (", ".join(names[:-1]), names[-1])))


def correlated(problem: Problem, posterior: Posterior) -> list[tuple[str, str, float]]:
    """Pairs of parameters that the recordings do not tell apart, with their correlation."""
    names, cov = problem.unknowns.names, posterior.covariance[0]
    sd = np.sqrt(np.diag(cov))
    return [
        (names[j], names[i], float(r))
        for i in range(len(names))
        for j in range(i)
        if sd[i] > 0 and sd[j] > 0 and abs(r := cov[i, j] / (sd[i] * sd[j])) > STRONG
    ]


def _identified(problem: Problem, posterior: Posterior, a: str, b: str) -> str:
    """The combination of two correlated parameters that is known best, and how well.

    With log b known, log a − s log b has the least variance at s = cov(a, b)/var(b). Of K_H and p it is the felt's
    static force K_H u^p, at the compression u where that is known best: d log(K_H u^p) = d log K_H + log(u) p d log p.
    """
    i, j = problem.unknowns.at(a), problem.unknowns.at(b)
    cov, mean = posterior.covariance[0], posterior.mean[0]
    slope = cov[i, j] / cov[j, j]
    half = NORMAL * float(np.sqrt(max(cov[i, i] - slope * cov[i, j], 0.0)))
    if (a, b) == problem.unknowns.law.power:
        p = float(np.exp(mean[j]))
        u = float(np.exp(-slope / p))
        force = with_half_interval(float(np.exp(mean[i]) * u**p), half, "N")
        return f"the felt's force at {1e3 * u:.4g} mm, {a} u^{b} = {force}"
    return f"the product {a} · {b}^{-slope:.2g} ({off_by(half)})"


def messages(
    problem: Problem, found: Estimate, states: dict[str, str], worse: Sequence[str], means: str = "laplace"
) -> list[str]:
    """Plain sentences on what to beware of, the weightiest first; `means` is that of the parameters' intervals."""
    said = []
    if not found.minima.converged[0]:
        said.append("The search stopped before it converged; no value is a result.")
    said += _mixture(problem, found, means)
    if worse:
        said.append(WORSE.format(", ".join(worse)))
    bound = [n for n, s in states.items() if s == "at-bound"]
    if bound:
        said.append(f"At the edge of the box, so their values are the box's: {', '.join(bound)}.")
    said += [
        f"{a} and {b} are strongly correlated ({r:+.3f}): better identified than either is "
        f"{_identified(problem, found.posterior, a, b)}."
        for a, b, r in correlated(problem, found.posterior)
    ]
    said += presumed(problem)
    rests = sorted({x for names in problem.start.rests_on.values() for x in names})
    if rests:
        said.append(
            f"The string's {' and '.join(rests)} {'was' if len(rests) == 1 else 'were'} not given and taken from the "
            "literature for this key; "
            f"the SI values of {', '.join(problem.start.rests_on)} scale with them."
        )
    if problem.unknowns.free[width := problem.unknowns.at("width")]:
        said.append(
            "The shape of the contact's window is not known, so its width is fitted along: an effective "
            f"{1e3 * np.exp(found.z[width]):.2f} mm (given or assumed: {1e3 * problem.start.geometry.width:.2f} mm)."
        )
    phi, strings = np.exp(found.minima.people.phi[0]), found.minima.strings[0]
    said.append(
        f"Beyond the noise, partials scatter about the model by {np.exp(strings.phi[0][0]):.2f} cents (more from the "
        f"{priors.LAW_REACH:.0f}th on), {100 * np.exp(strings.phi[1][0]):.0f} % in decay and {phi[0]:.2f} dB in level; "
        "the intervals include it as if each partial did so by itself."
    )
    for recording, analysis in zip(problem.recordings, problem.analyses, strict=True):
        about = f"{one_line(Path(recording.path).name)}: " if len(problem.recordings) > 1 else ""
        seen = "; ".join((*recording.warnings, *analysis.warnings))
        said += [about + seen] if seen else []
    return said


def presumed(problem: Problem) -> list[str]:
    """Whose velocity that in [known] is taken for, where it could be of several."""
    if not problem.presumed:
        return []
    at = problem.reference
    return [
        f"[known] v_H0 = {problem.speed[problem.layout.stroke[at]]:g} m/s is taken for the stroke of "
        f"{one_line(Path(problem.recordings[at].path).name)}, the brightest of these recordings; a [[recording]] says "
        "of each which velocity was measured."
    ]


def _mixture(problem: Problem, found: Estimate, means: str) -> list[str]:
    """How much weight the heaviest minimum has, and another hammer about as probable."""
    share = found.posterior.share
    if len(share) == 1 or share[0] > 1 - NAMED:
        return []
    u, people = problem.unknowns, found.minima.people
    other = 1 + int(np.argmax(share[1:]))
    apart = np.abs(found.posterior.mean[other] - found.posterior.mean[0])
    if u.power:
        apart[u.power[0]] = abs(people.z[other, u.power[0]] - people.z[0, u.power[0]])
    at = int(np.argmax(np.where(u.free[: u.shared], apart[: u.shared], 0.0)))
    name = u.names[at]
    values = np.exp(found.posterior.mean[[0, other], at])
    return [
        f"The minimum that is shown has the largest share of the posterior, {100 * share[0]:.0f} %. Another hammer, "
        f"with {100 * share[other]:.0f} %, differs most in {name}: {values[1]:.4g} instead of {values[0]:.4g}. "
        + MIXED[means]
    ]
