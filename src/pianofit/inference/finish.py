"""From the minima of the search to those of F itself: with the string free, and without the contact's step error."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from .coordinates import STRING_SIZE
from .descent import Descent
from .population import Population
from .problem import Problem
from .search import distinct
from .string import StringState, hyper_step, string_report

__all__ = ["Finished", "Minima", "finish", "finished"]

# Minima whose F is higher by more than this have no share: exp(-6) is a quarter of a percent.
WITHIN = 6.0
# A descent that in its last step gained more than this, F, and might gain as much again has not converged.
NEARLY = 1.0
# So many at most are finished.
MOST = 4
# The step error is read off again while it still moves the levels by this share of a standard deviation, rms,
LEFT = 0.05
# and so often at the most.
READINGS = 4
# Steps of each descent between.
ITERATIONS = 25


class Minima(NamedTuple):
    """Minima of F, the one that is shown first; [B, ...]."""

    people: Population
    F: np.ndarray  # with everything
    descents: list[Descent]  # with the string free: each has its minimum's step error
    strings: list[StringState]
    converged: np.ndarray

    @property
    def descent(self) -> Descent:
        """Of the first."""
        return self.descents[0]

    def take(self, which: np.ndarray) -> Minima:
        """Some of them, in this order."""
        descents, strings = ([x[i] for i in which] for x in (self.descents, self.strings))
        return Minima(self.people.take(which), self.F[which], descents, strings, self.converged[which])


def finished(problem: Problem, found: Population, held: Descent, strings: StringState) -> Minima:
    """Every distinct minimum near the lowest, finished on F with all its unknowns."""
    scores = held.total(found.z, found.report)
    chosen = distinct(found, held.unknowns, scores, WITHIN)[:MOST]
    ends = [finish(problem, found.take(np.array([i])), strings) for i in chosen]
    people = ends[0].people
    for end in ends[1:]:
        people = people.join(end.people)
    F = np.array([end.F for end in ends])
    # Two that were distinct may have come to the same minimum: it counts once.
    every = Minima(
        people, F, [end.descent for end in ends], [end.strings for end in ends],
        np.array([end.converged for end in ends]),
    )  # fmt: skip
    return every.take(np.array(distinct(people, held.unknowns, F, WITHIN)))


class Finished(NamedTuple):
    """One minimum of F with all its unknowns."""

    descent: Descent
    people: Population  # it alone
    F: float
    converged: bool
    strings: StringState


def finish(problem: Problem, one: Population, strings: StringState) -> Finished:
    """Lower F from one candidate with the string free and the contact's step error taken out, in turn."""
    string, state = one.z[0, :STRING_SIZE], strings
    descent = Descent(problem, string, state)
    converged = False
    for _ in range(READINGS):
        before = descent.offset
        descent.offset = descent.step_error(one.z[0])
        one = descent.begun(one.z, one.phi[0], one.w[0])
        one = descent.descend(one, 0.0, ITERATIONS)
        converged = bool(min(one.gained[0], descent.promised(one)[0]) < NEARLY)
        string = one.z[0, :STRING_SIZE]
        state, _ = hyper_step(problem, string, state, string_report(problem, string, state))
        descent.strings = state
        sd = np.sqrt(np.asarray(descent.table.variance) + np.exp(2 * one.phi[0, 0]))
        moved = (descent.offset - before) / sd * np.asarray(descent.table.found)
        if np.sqrt((moved**2).sum() / max(np.asarray(descent.table.found).sum(), 1)) < LEFT:
            break
    return Finished(descent, one, float(descent.total(one.z, one.report)[0]), converged, state)
