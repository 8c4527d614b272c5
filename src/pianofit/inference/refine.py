"""Refinement of the search's minima to minima of the full F: the string is free, the discretisation error corrected."""

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

# Minima whose F is higher by more than this have no posterior weight: exp(-6) is a quarter of a percent.
WITHIN = 6.0
# A minimisation has not converged if its last step lowered F by more than this and as large a decrease is predicted.
NEARLY = 1.0
# Maximum number of minima that are refined.
MOST = 6
# A refinement ends when the discretisation error at its end differs from the one that it used by less than this
# fraction of the levels' standard deviations, rms,
LEFT = 0.05
# or after so many rounds,
TURNS = 4
# of so many steps.
ITERATIONS = 25


class Minima(NamedTuple):
    """Minima of F, the one with the largest posterior weight first; [B, ...]."""

    candidates: Candidates
    nll: np.ndarray  # of all tables and priors
    converged: np.ndarray
    optimiser: Optimiser

    def take(self, which: np.ndarray) -> Minima:
        """Select some, in this order."""
        return Minima(self.candidates.take(which), self.nll[which], self.converged[which], self.optimiser)


def refine_minima(problem: FitProblem, candidates: Candidates, fixed: Optimiser, string: Candidates) -> Minima:
    """Refine every distinct minimum near the lowest on F with all its parameters.

    Parameters
    ----------
    candidates, fixed : minima with a fixed string, and the optimiser that found them.
    string : the string's own minimum.

    Raises `FitError` if no contact ends.
    """
    distinct = deduplicate(candidates, fixed.unknowns, fixed.total(candidates), WITHIN)
    near = candidates.take(np.array(distinct[:MOST]))
    minima = refine(problem, near.theta, near.phi + string.phi, near.w + string.w)
    # Two distinct starts can end in the same minimum: it counts once.
    return minima.take(np.array(deduplicate(minima.candidates, fixed.unknowns, minima.nll, WITHIN)))


def refine(problem: FitProblem, theta: np.ndarray, phi: Sequence[np.ndarray], w: Sequence[np.ndarray]) -> Minima:
    """Minimise F and correct each candidate's discretisation error in turn; drop those whose contact does not end.

    Parameters
    ----------
    theta, phi, w : starts [B, size]; of every table, for all candidates or for each, [4] and [R, K].

    Raises
    ------
    FitError
        If no contact ends.
    """
    optimiser = Optimiser(problem)
    table = optimiser.table

    def minimised(theta: np.ndarray, phi: Sequence[np.ndarray], w: Sequence[np.ndarray]) -> Candidates:
        """Minimise each with the discretisation error at its start."""
        starts = optimiser.initialise(theta, phi, w, optimiser.discretisation_error_db(theta))
        return optimiser.minimise(starts, 0.0, ITERATIONS)

    candidates = minimised(theta, phi, w)
    if not len(candidates):
        raise FitError(NO_HAMMER)
    for _ in range(TURNS - 1):
        sd = np.sqrt(table.variance + np.exp(2 * candidates.level.phi[:, :1, None]))
        change = (optimiser.discretisation_error_db(candidates.theta) - candidates.offset) / sd
        rms = np.sqrt((change**2 * table.detected).sum(axis=(1, 2)) / max(table.detected.sum(), 1))
        active = np.flatnonzero(rms >= LEFT)
        if not len(active):
            break
        some = candidates.take(active)
        candidates = candidates.put(active, minimised(some.theta, some.phi, some.w))
    left = np.minimum(candidates.last_decrease, optimiser.predicted_decrease(candidates))
    return Minima(candidates, optimiser.total(candidates), left < NEARLY, optimiser)
