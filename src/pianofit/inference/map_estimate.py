"""From recordings to the posterior: fit of the string, search, refinement of every minimum, Laplace's approximation."""

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

# Maximum number of steps of the string's optimisation, and the decrease of F at which it ends. Strings of clean
# recordings are determined to 1e-8.
STRING_STEPS, STRING_GAIN = 40, 1e-6
# Minima are the same if every parameter agrees within this, in standard deviations of the lower one.
SAME = 1.0


class Estimate(NamedTuple):
    """Result of a search of F."""

    minima: Minima
    posterior: Posterior
    n_strokes_computed: int  # number of strokes that the model computed

    @property
    def theta(self) -> np.ndarray:
        """θ of the minimum with the largest posterior weight, which is reported first [size]."""
        return self.minima.candidates.theta[0]


def map_estimate(problem: FitProblem, seed: int = 0, progress: Progress = lambda *_: None) -> Estimate:
    """Search F, and describe the posterior at its minima.

    Raises
    ------
    FitError
        If no hammer gives a finite sound.
    """
    progress("string", 0.05)
    string = fit_string(problem)
    progress("hammer", 0.15)
    fixed = Optimiser(problem, string.theta[0, :STRING_SIZE], LEVELS)
    candidates = multistart(fixed, seed, initial_point(problem, fixed.string), progress)
    progress("string and hammer", 0.75)
    minima = refine_minima(problem, candidates, fixed, string)
    progress("intervals", 0.88)
    return Estimate(
        *_deduplicate(minima, laplace(problem, minima)), fixed.n_strokes_computed + minima.optimiser.n_strokes_computed
    )


def fit_string(problem: FitProblem) -> Candidates:
    """Fit c, κ, b1 and b2 to frequencies, decays and the prior alone, before any hammer is known."""
    optimiser = Optimiser(problem, tables=STRINGS)
    phi = [np.asarray(table.prior[0]) for table in optimiser.tables]
    return optimiser.minimise(
        optimiser.initialise(problem.parametrisation.mean[None], phi), 0.0, STRING_STEPS, STRING_GAIN
    )


def _deduplicate(minima: Minima, posterior: Posterior) -> tuple[Minima, Posterior]:
    """Remove minima within the width of a lower one, whose Gaussian contains them; sort by posterior weight.

    The lowest minimum need not have the largest weight, because a narrow one holds little of the posterior. In the
    treble, narrow minima are lobes of the pulse's spectrum. There a few levels can agree to a tenth of a dB at a wrong
    velocity.
    """
    sd = np.sqrt(np.maximum(np.einsum("bii->bi", posterior.covariance), 0.0))
    kept: list[int] = []
    for i in np.argsort(minima.nll, kind="stable"):
        distances = [
            (np.abs(posterior.mean[i] - posterior.mean[j]) / np.where(sd[j] > 0, sd[j], np.inf)).max() for j in kept
        ]
        if min(distances, default=np.inf) > SAME:
            kept.append(int(i))
    order = np.array(kept)[np.argsort(-posterior.weight[kept], kind="stable")]
    weight = posterior.weight[order] / posterior.weight[order].sum()
    return minima.take(order), Posterior(posterior.mean[order], posterior.covariance[order], weight)


def initial_point(problem: FitProblem, string: np.ndarray) -> np.ndarray:
    """θ of the setup's initial values, and of the prior means for all others [size]."""
    u, start = problem.parametrisation, problem.initial_values
    theta = u.mean.copy()
    for i, name in enumerate(u.names):
        if u.free[i]:
            theta[i] = np.log(start.initial[name])
    if u.force_and_exponent_index and u.free[u.force_and_exponent_index[0]]:
        force, p = u.force_and_exponent_index
        theta[force] += np.exp(theta[p]) * u.log_reference_compression
    theta[:STRING_SIZE] = string
    reference = u.shared + problem.structure.stroke[problem.reference]
    if u.free[reference]:
        theta[reference] = np.log(start.initial["v_H0"])
    return u.project(theta)
