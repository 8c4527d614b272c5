"""What may be said of each number of a fit, in one word."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from .coordinates import STRING_SIZE
from .infer import Inferred
from .problem import Problem

__all__ = ["POOR", "STATUSES", "STRAINED", "invariant_status", "statuses", "taken_back", "velocity_statuses"]

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


def statuses(fit: Inferred) -> dict[str, str]:
    """One of `STATUSES` by parameter name."""
    u, start = fit.problem.unknowns, fit.problem.start
    bound, lost, moving = u.at_bound(fit.found.z), taken_back(fit), scaling(fit.problem)
    # Of the logarithms of values, before the recordings; of the string's no more is asked than that it be known.
    prior = np.linalg.norm(u.tangent(fit.found.z) * u.sd, axis=1)
    enough = np.where(np.arange(u.size) < STRING_SIZE, LOOSE, np.minimum(LEARNED * prior, LOOSE))

    def status(i: int, name: str) -> str:
        if not u.free[i]:
            return "assumed" if start.fixed.get(name) == "assumed" else "given"
        if bound[i]:
            return "at-bound"
        # Without a measured velocity what scales with it is known by its prior alone.
        posterior = fit.gauged if name in moving else fit.posterior
        if name in lost or posterior.spread(np.eye(u.size)[i]) > enough[i]:
            return "not-identifiable"
        return "scaled" if name in moving or start.rests_on.get(name) else "fitted"

    return {name: status(i, name) for i, name in enumerate(u.names)}


def scaling(problem: Problem) -> tuple[str, ...]:
    """The felt's parameters that move with the common scale of the velocities, where that is open."""
    return problem.unknowns.law.scaling("N m") if problem.unscaled and problem.layout.compared else ()


def taken_back(fit: Inferred) -> tuple[str, ...]:
    """What the statement takes back, however narrow its interval."""
    problem = fit.problem
    felt = tuple(problem.unknowns.law.parameters)
    if problem.calibrated:
        return () if fit.excess <= STRAINED else felt if fit.excess <= POOR else (*felt, "M_H")
    return () if problem.layout.compared else (*felt, "M_H") if problem.path else felt


def invariant_status(states: Sequence[str], deviation: float) -> str:
    """Of a ratio or product of values with these statuses, whose logarithm has this standard deviation."""
    for lost in ("not-identifiable", "at-bound"):
        if lost in states:
            return lost
    if not deviation:
        return "assumed" if "assumed" in states else "given"
    return "not-identifiable" if deviation > LOOSE else "fitted"


def velocity_statuses(fit: Inferred) -> list[str]:
    """One of `STATUSES` for every stroke's velocity."""
    problem = fit.problem
    lost = fit.excess > POOR if problem.calibrated else not problem.layout.compared
    unknown = "not-identifiable" if lost else "scaled" if problem.unscaled else "fitted"
    return ["given" if v is not None else unknown for v in problem.speed]
