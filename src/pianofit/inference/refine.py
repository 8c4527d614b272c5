"""From the minima of the search to those of F itself: with the string free, and without the contact's step error."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ..errors import FitError
from .candidates import Candidates
from .multistart import NO_HAMMER, deduplicate
from .optimiser import Optimiser
from .problem import FitProblem

__all__ = ["Minima", "refine", "refine_minima"]

# Minima whose F is higher by more than this have no share: exp(-6) is a quarter of a percent.
WITHIN = 6.0
# A descent that in its last step gained more than this, F, and might gain as much again has not converged.
NEARLY = 1.0
# So many at most are finished.
MOST = 6
# A descent is over when the step error read off where it ended differs from that it went by by less than this share of
# the levels' standard deviations, rms,
LEFT = 0.05
# or after so many turns,
TURNS = 4
# of so many steps.
ITERATIONS = 25


class Minima(NamedTuple):
    """Minima of F, the one that is shown first; [B, ...]."""

    people: Candidates
    F: np.ndarray  # with everything
    converged: np.ndarray
    descent: Optimiser

    def take(self, which: np.ndarray) -> Minima:
        """Some of them, in this order."""
        return Minima(self.people.take(which), self.F[which], self.converged[which], self.descent)


def refine_minima(problem: FitProblem, found: Candidates, held: Optimiser, string: Candidates) -> Minima:
    """Every distinct minimum near the lowest, finished on F with all its unknowns.

    Parameters
    ----------
    found, held : minima with the string held, and the descent that found them.
    string : its own minimum.

    Raises `FitError` if the contact of none ends.
    """
    near = found.take(np.array(deduplicate(found, held.unknowns, held.total(found), WITHIN)[:MOST]))
    minima = refine(problem, near.theta, near.phi + string.phi, near.w + string.w)
    # Two that were distinct may have come to the same minimum: it counts once.
    return minima.take(np.array(deduplicate(minima.people, held.unknowns, minima.F, WITHIN)))


def refine(problem: FitProblem, z: np.ndarray, phi: Sequence[np.ndarray], w: Sequence[np.ndarray]) -> Minima:
    """Lower F from candidates, and take out each one's step error, in turn; without those whose contact does not end.

    Parameters
    ----------
    z, phi, w : where they are [B, size], and of every table, of all or of each, [4] and [R, K].

    Raises
    ------
    FitError
        If the contact of none ends.
    """
    descent = Optimiser(problem)
    table = descent.table

    def lowered(z: np.ndarray, phi: Sequence[np.ndarray], w: Sequence[np.ndarray]) -> Candidates:
        """Each with the step error that is read off where it is."""
        return descent.minimise(descent.initialise(z, phi, w, descent.discretisation_error_db(z)), 0.0, ITERATIONS)

    people = lowered(z, phi, w)
    if not len(people):
        raise FitError(NO_HAMMER)
    for _ in range(TURNS - 1):
        sd = np.sqrt(table.variance + np.exp(2 * people.level.phi[:, :1, None]))
        away = (descent.discretisation_error_db(people.theta) - people.offset) / sd
        moved = np.sqrt((away**2 * table.detected).sum(axis=(1, 2)) / max(table.detected.sum(), 1))
        on = np.flatnonzero(moved >= LEFT)
        if not len(on):
            break
        some = people.take(on)
        people = people.put(on, lowered(some.theta, some.phi, some.w))
    left = np.minimum(people.last_decrease, descent.predicted_decrease(people))
    return Minima(people, descent.total(people), left < NEARLY, descent)
