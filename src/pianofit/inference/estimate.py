"""A fit from its recordings to the posterior: the string, the search, every minimum finished, Laplace."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..progress import Progress
from .coordinates import STRING_SIZE
from .descent import LEVELS, STRINGS, Descent
from .finish import Minima, finished
from .population import Population
from .posterior import Posterior, laplace
from .problem import Problem
from .search import searched

__all__ = ["Estimate", "Progress", "estimate", "string_minimum"]

# Steps of the string's own descent at the most, and the gain at which it ends, F: clean strings are read to 1e-8.
STRING_STEPS, STRING_GAIN = 40, 1e-6
# Minima nearer than this in every unknown, in standard deviations of the lower one, are one.
SAME = 1.0


class Estimate(NamedTuple):
    """What a search of F found."""

    minima: Minima
    posterior: Posterior
    lanes: int  # strikes of the model

    @property
    def z(self) -> np.ndarray:
        """The heaviest minimum, which is shown [size]."""
        return self.minima.people.z[0]


def estimate(problem: Problem, seed: int = 0, progress: Progress = lambda *_: None) -> Estimate:
    """Search F, and describe the posterior about its minima.

    Raises
    ------
    FitError
        If no hammer gives a finite sound.
    """
    progress("string", 0.05)
    string = string_minimum(problem)
    progress("hammer", 0.15)
    held = Descent(problem, string.z[0, :STRING_SIZE], LEVELS)
    found = searched(held, seed, beginning(problem, held.string), progress)
    progress("string and hammer", 0.75)
    minima = finished(problem, found, held, string)
    progress("intervals", 0.88)
    return Estimate(*_apart(minima, laplace(problem, minima)), held.lanes + minima.descent.lanes)


def string_minimum(problem: Problem) -> Population:
    """c, κ, b1 and b2 by frequencies, decays and the prior alone, before any hammer is known."""
    descent = Descent(problem, tables=STRINGS)
    begun = descent.begun(problem.unknowns.mean[None], [np.asarray(table.prior[0]) for table in descent.tables])
    return descent.descend(begun, 0.0, STRING_STEPS, STRING_GAIN)


def _apart(minima: Minima, posterior: Posterior) -> tuple[Minima, Posterior]:
    """Without minima that lie within the width of a lower one, whose parabola has their weight; the heaviest first.

    The lowest need not be the heaviest: a needle has little of the posterior. In the treble needles are lobes of the
    pulse's spectrum, where a few levels can be met to a tenth of a dB at a velocity that nobody played.
    """
    sd = np.sqrt(np.maximum(np.einsum("bii->bi", posterior.covariance), 0.0))
    kept: list[int] = []
    for i in np.argsort(minima.F, kind="stable"):
        away = [
            (np.abs(posterior.mean[i] - posterior.mean[j]) / np.where(sd[j] > 0, sd[j], np.inf)).max() for j in kept
        ]
        if min(away, default=np.inf) > SAME:
            kept.append(int(i))
    at = np.array(kept)[np.argsort(-posterior.share[kept], kind="stable")]
    share = posterior.share[at] / posterior.share[at].sum()
    return minima.take(at), Posterior(posterior.mean[at], posterior.covariance[at], share)


def beginning(problem: Problem, string: np.ndarray) -> np.ndarray:
    """The point that a setup's starting values give, and the prior's means where it says nothing [size]."""
    u, start = problem.unknowns, problem.start
    z = u.mean.copy()
    for i, name in enumerate(u.names):
        if u.free[i]:
            z[i] = np.log(start.initial[name])
    if u.power and u.free[u.power[0]]:
        z[u.power[0]] += np.exp(z[u.power[1]]) * u.log_u
    z[:STRING_SIZE] = string
    reference = u.shared + problem.layout.stroke[problem.reference]
    if u.free[reference]:
        z[reference] = np.log(start.initial["v_H0"])
    return u.project(z)
