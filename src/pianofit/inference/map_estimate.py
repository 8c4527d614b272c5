"""A fit from its recordings to the posterior: the string, the search, every minimum finished, Laplace."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..progress import Progress
from .candidates import Candidates
from .laplace import Posterior, laplace
from .multistart import multistart
from .optimiser import LEVELS, STRINGS, Optimiser
from .parametrisation import STRING_SIZE
from .problem import FitProblem
from .refine import Minima, refine_minima

__all__ = ["Estimate", "Progress", "map_estimate", "fit_string"]

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
        return self.minima.people.theta[0]


def map_estimate(problem: FitProblem, seed: int = 0, progress: Progress = lambda *_: None) -> Estimate:
    """Search F, and describe the posterior about its minima.

    Raises
    ------
    FitError
        If no hammer gives a finite sound.
    """
    progress("string", 0.05)
    string = fit_string(problem)
    progress("hammer", 0.15)
    held = Optimiser(problem, string.theta[0, :STRING_SIZE], LEVELS)
    found = multistart(held, seed, initial_point(problem, held.string), progress)
    progress("string and hammer", 0.75)
    minima = refine_minima(problem, found, held, string)
    progress("intervals", 0.88)
    return Estimate(*_deduplicate(minima, laplace(problem, minima)), held.lanes + minima.descent.lanes)


def fit_string(problem: FitProblem) -> Candidates:
    """c, κ, b1 and b2 by frequencies, decays and the prior alone, before any hammer is known."""
    descent = Optimiser(problem, tables=STRINGS)
    begun = descent.initialise(problem.unknowns.mean[None], [np.asarray(table.prior[0]) for table in descent.tables])
    return descent.minimise(begun, 0.0, STRING_STEPS, STRING_GAIN)


def _deduplicate(minima: Minima, posterior: Posterior) -> tuple[Minima, Posterior]:
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


def initial_point(problem: FitProblem, string: np.ndarray) -> np.ndarray:
    """The point that a setup's starting values give, and the prior's means where it says nothing [size]."""
    u, start = problem.unknowns, problem.start
    z = u.mean.copy()
    for i, name in enumerate(u.names):
        if u.free[i]:
            z[i] = np.log(start.initial[name])
    if u.force_and_exponent_index and u.free[u.force_and_exponent_index[0]]:
        z[u.force_and_exponent_index[0]] += np.exp(z[u.force_and_exponent_index[1]]) * u.log_reference_compression
    z[:STRING_SIZE] = string
    reference = u.shared + problem.layout.stroke[problem.reference]
    if u.free[reference]:
        z[reference] = np.log(start.initial["v_H0"])
    return u.project(z)
