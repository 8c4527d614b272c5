"""Three methods for intervals: Laplace's approximation (every result has it), profiles, and posterior samples."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from ..errors import ParameterError
from .map_estimate import Estimate, Progress
from .parametrisation import LOG_ABSENT_LOSS
from .problem import FitProblem

__all__ = [
    "METHODS",
    "Observations",
    "IntervalResult",
    "check_intervals",
    "parameter_indices",
    "unbounded_warnings",
    "reported_parameters",
    "compute_intervals",
]

METHODS = ("laplace", "profile", "posterior")


class Observations(NamedTuple):
    """Observations of one table [observations each]."""

    value: np.ndarray  # levels and bounds of censored partials, dB; cents and log decays over the string model
    recording: np.ndarray  # int, its place in the order given, from 1; 0 where a value is of all recordings
    partial: np.ndarray  # int, k


@dataclass(frozen=True)
class IntervalResult:
    """Intervals by a profile or by posterior samples."""

    method: str  # one of `MEANS`
    entries: dict[str, dict]  # by parameter: interval, interval_by, interval_open
    messages: tuple[str, ...] = ()
    diagnostics: dict = field(default_factory=dict)
    draws: dict[str, np.ndarray] | None = None  # values [chains, draws] of all searched parameters, by name
    # Log density of each observation given all others [chains, draws, observations], by table.
    log_likelihood: dict[str, np.ndarray] = field(default_factory=dict)
    observed: dict[str, Observations] = field(default_factory=dict)


def check_intervals(method: str) -> None:
    """Reject an unknown method, and a sampler that is not installed.

    Raises
    ------
    ParameterError
        Naming the argument and its value.
    """
    if method not in METHODS:
        raise ParameterError(f"intervals={method!r} must be one of {', '.join(METHODS)}")
    if method == "posterior":
        from .nuts import check_sampler

        check_sampler()


def compute_intervals(
    problem: FitProblem, estimate: Estimate, method: str, seed: int, progress: Progress
) -> IntervalResult | None:
    """Intervals by the `method` asked for; None for Laplace's approximation, which every estimate contains."""
    if method == "profile":
        from .profile import profiles

        progress("profiles", 0.9)
        return profiles(problem, estimate)
    if method == "posterior":
        from .nuts import sample_posterior

        progress("posterior", 0.9)
        return sample_posterior(problem, estimate, seed)
    return None


def reported_parameters(problem: FitProblem) -> dict[str, int]:
    """Indices in θ, by name, of the free shared parameters and of the reference stroke's velocity."""
    u = problem.parametrisation
    return {name: i for i, name in (*enumerate(u.names), (problem.reference_velocity_index, "v_H0")) if u.free[i]}


def parameter_indices(problem: FitProblem) -> dict[str, int]:
    """Indices in θ, by name, of the parameters of the felt law and of every velocity.

    `v_H0` is the velocity of the reference stroke, `v_H0 N` that of stroke N.
    """
    u = problem.parametrisation
    shared = {name: u.index_of(name) for name in u.reported if u.mean[u.index_of(name)] > LOG_ABSENT_LOSS}
    strokes = range(u.shared, u.size)
    return shared | {
        "v_H0" if at == problem.reference_velocity_index else f"v_H0 {at - u.shared + 1}": at for at in strokes
    }


def unbounded_warnings(entries: dict[str, dict]) -> list[str]:
    """Messages that name the intervals with an end at a search bound."""
    both = [name for name, entry in entries.items() if len(entry["interval_open"]) == 2]
    messages = (
        [f"The recordings do not bound {', '.join(both)}: the interval is the whole search range."] if both else []
    )
    for word, which in (("low", "below"), ("high", "above")):
        names = [name for name, entry in entries.items() if entry["interval_open"] == [word]]
        if names:
            messages.append(
                f"The recordings do not bound {', '.join(names)} {which}: the interval ends at the search bound."
            )
    return messages
