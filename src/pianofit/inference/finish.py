"""From the minima of the search to those of F itself: with the string free, and without the contact's step error."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ..errors import FitError
from .descent import Descent
from .population import Population
from .problem import Problem
from .search import NO_HAMMER, distinct

__all__ = ["Minima", "finish", "finished"]

# Minima whose F is higher by more than this have no share: exp(-6) is a quarter of a percent.
WITHIN = 6.0
# A descent that in its last step gained more than this, F, and might gain as much again has not converged.
NEARLY = 1.0
# So many at most are finished.
MOST = 6
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
    descents: list[Descent]  # each has its minimum's step error
    converged: np.ndarray

    @property
    def descent(self) -> Descent:
        """Of the first."""
        return self.descents[0]

    def take(self, which: np.ndarray) -> Minima:
        """Some of them, in this order."""
        return Minima(self.people.take(which), self.F[which], [self.descents[i] for i in which], self.converged[which])

    def join(self, other: Minima) -> Minima:
        """Both."""
        return Minima(
            self.people.join(other.people), np.append(self.F, other.F), self.descents + other.descents,
            np.append(self.converged, other.converged),
        )  # fmt: skip


def finished(problem: Problem, found: Population, held: Descent, string: Population) -> Minima:
    """Every distinct minimum near the lowest, finished on F with all its unknowns.

    Parameters
    ----------
    found, held : minima with the string held, and the descent that found them.
    string : its own minimum.

    Raises
    ------
    FitError
        If the contact of none ends.
    """
    near = distinct(found, held.unknowns, held.total(found), WITHIN)[:MOST]
    each = [found.take(np.array([i])) for i in near]
    ends = [finish(problem, one.z, one.phi + string.phi, one.w + string.w) for one in each]
    every = functools.reduce(Minima.join, ends)
    if not len(every.F):
        raise FitError(NO_HAMMER)
    # Two that were distinct may have come to the same minimum: it counts once.
    return every.take(np.array(distinct(every.people, held.unknowns, every.F, WITHIN)))


def finish(problem: Problem, z: np.ndarray, phi: Sequence[np.ndarray], w: Sequence[np.ndarray]) -> Minima:
    """Lower F from one candidate, and take out the contact's step error, in turn; empty if its contact does not end.

    Parameters
    ----------
    z, phi, w : where it is [1, size], and of every table [1, 4] and [1, R, K].
    """
    descent = Descent(problem)
    variance, there = np.asarray(descent.table.variance), np.asarray(descent.table.found)
    readings = 0
    while True:
        readings += 1
        before, descent.offset = descent.offset, descent.step_error(z[0])
        one = descent.descend(descent.begun(z, phi, w), 0.0, ITERATIONS)
        sd = np.sqrt(variance + np.exp(2 * one.phi[0][:, :1, None]))
        moved = np.sqrt((((descent.offset - before) / sd) ** 2 * there).sum() / max(there.sum(), 1))
        if moved < LEFT or readings == READINGS:
            break
        z, phi, w = one.z, one.phi, one.w
    left = np.minimum(one.gained, descent.promised(one))
    return Minima(one, descent.total(one), [descent] * len(one), left < NEARLY)
