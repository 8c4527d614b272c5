"""Three views of F: Laplace's, which every result has; profiles; and draws by the No-U-Turn sampler."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from ..errors import ParameterError
from .map_estimate import Estimate, Progress
from .parametrisation import ABSENT
from .problem import FitProblem

__all__ = [
    "MEANS",
    "Observations",
    "IntervalResult",
    "check_intervals",
    "named",
    "unbounded_warnings",
    "reported_parameters",
    "compute_intervals",
]

MEANS = ("laplace", "profile", "posterior")


class Observations(NamedTuple):
    """What one table holds [observations each]."""

    value: np.ndarray  # levels, and bounds of absent partials, dB; frequencies, cents, and log decays over their laws
    recording: np.ndarray  # int, its place in the order given, from 1; 0 where a value is of all recordings
    partial: np.ndarray  # int, k


@dataclass(frozen=True)
class IntervalResult:
    """What a profile or a posterior's draws say."""

    method: str  # of `MEANS`
    entries: dict[str, dict]  # by parameter: interval, interval_by, interval_open
    messages: tuple[str, ...] = ()
    diagnostics: dict = field(default_factory=dict)
    draws: dict[str, np.ndarray] | None = None  # values [chains, draws] by name, of all that is searched
    # Logarithms of the density of each observation given all others [chains, draws, observations], by table.
    log_likelihood: dict[str, np.ndarray] = field(default_factory=dict)
    observed: dict[str, Observations] = field(default_factory=dict)


def check_intervals(means: str, recipe: str = "default") -> None:
    """Refuse a means that does not exist, a recipe that has none, and a sampler that is not installed.

    Raises
    ------
    ParameterError
        Naming the argument and its value.
    """
    if means not in MEANS:
        raise ParameterError(f"intervals={means!r} must be one of {', '.join(MEANS)}")
    if means != MEANS[0] and recipe != "default":
        raise ParameterError(f"intervals={means!r} are those of the default recipe; recipe={recipe!r} gives none")
    if means == "posterior":
        from .nuts import check_sampler

        check_sampler()


def compute_intervals(
    problem: FitProblem, found: Estimate, means: str, seed: int, progress: Progress
) -> IntervalResult | None:
    """Intervals by the `means` asked for; None for Laplace's, which are there anyway."""
    if means == "profile":
        from .profile import profiles

        progress("profiles", 0.9)
        return profiles(problem, found)
    if means == "posterior":
        from .nuts import sample_posterior

        progress("posterior", 0.9)
        return sample_posterior(problem, found, seed)
    return None


def reported_parameters(problem: FitProblem) -> dict[str, int]:
    """What is free and shared, and the reference stroke's velocity: places in z by name."""
    u = problem.unknowns
    return {name: i for i, name in (*enumerate(u.names), (problem.velocity, "v_H0")) if u.free[i]}


def named(problem: FitProblem) -> dict[str, int]:
    """Places in z by name, of what the felt's law has and of every velocity.

    `v_H0` is the velocity of the reference's stroke, `v_H0 N` that of stroke N.
    """
    u = problem.unknowns
    shared = {name: u.index_of(name) for name in u.reported if u.mean[u.index_of(name)] > ABSENT}
    strokes = range(u.shared, u.size)
    return shared | {"v_H0" if at == problem.velocity else f"v_H0 {at - u.shared + 1}": at for at in strokes}


def unbounded_warnings(entries: dict[str, dict]) -> list[str]:
    """Name the intervals that end at the box and not where F says."""
    both = [name for name, entry in entries.items() if len(entry["interval_open"]) == 2]
    said = [f"Not bounded by the recording, so the interval is the whole box: {', '.join(both)}."] if both else []
    for word, which in (("low", "below"), ("high", "above")):
        one = [name for name, entry in entries.items() if entry["interval_open"] == [word]]
        if one:
            said.append(f"Not bounded {which} by the recording, so the interval ends at the box: {', '.join(one)}.")
    return said
