"""Every minimum as something that plays: string, hammer of a stroke, and the path that F integrated out."""

from __future__ import annotations

import numpy as np

from ..inference.batched_model import DB
from ..inference.derivatives import LatentPosterior, latent_posterior
from ..inference.likelihood import ObservationTable, variance
from ..inference.observation_tables import scatter_by_number, string_law
from ..inference.parametrisation import STRING_SIZE
from ..inference.problem import FitProblem
from ..inference.refine import Minima
from ..model.note import Note
from ..model.output_path import OutputPath, VelocityDiscrepancy
from .velocity_discrepancy import NOTHING, stroke_deviations

__all__ = ["latent_means", "notes_of"]


def latent_means(minima: Minima, which: int) -> LatentPosterior:
    """What F integrated out, at one minimum."""
    level = minima.people.level
    return latent_posterior(minima.descent.table, level.residual[which], level.phi[which], level.w[which])


def notes_of(problem: FitProblem, minima: Minima, which: int) -> list[Note]:
    """One minimum's string, and its hammer at the velocity of every recording's stroke; without gains."""
    u, z, group = problem.unknowns, minima.people.theta[which], problem.layout.group
    left = latent_means(minima, which)
    paths = [
        _path(problem, minima, which, each, left) if problem.path else None for each in range(problem.layout.groups)
    ]
    f0, string = problem.analyses[problem.reference].f0, u.string(z)
    return [
        Note(
            string._replace(c=string.c * analysis.f0 / f0),
            u.hammer(z, stroke),
            u.geometry_at(z),
            problem.start.quantity,
            1.0,
            paths[path],
        )
        for analysis, stroke, path in zip(problem.analyses, problem.layout.stroke, group, strict=True)
    ]


def _path(problem: FitProblem, minima: Minima, which: int, group: int, left: LatentPosterior) -> OutputPath:
    """The posterior mean of a group's path, dB, at the partials found through it, and decays over the law's.

    The partials stand where the minimum's string has them: real ones leave the law, but are known by their numbers.
    """
    observed, people = problem.observed, minima.people
    mine = np.flatnonzero(np.array(problem.layout.group) == group)
    found = np.any(np.asarray(observed.level.detected)[mine] > 0, axis=0)
    number = observed.number[found]
    frequency = string_law(people.theta[which, :STRING_SIZE], number, problem.start.geometry.length)[0][0]
    velocity = np.exp(people.theta[which, problem.unknowns.shared :])[np.array(problem.layout.stroke)[mine]]
    seen, error, weight = (
        x[np.ix_(mine, found)] for x in _residuals(observed.level, people.level.phi[which], people.level.w[which], left)
    )
    known, db = stroke_deviations(seen / DB, error / DB, weight, velocity)
    return OutputPath(
        frequency, left.common[group][found], _decays(problem, minima, which, number),
        VelocityDiscrepancy(known, DB * db) if len(known) > 1 else None,
    )  # fmt: skip


def _residuals(
    table: ObservationTable, phi: np.ndarray, w: np.ndarray, left: LatentPosterior
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """What the fit leaves of every level, dB, its errors beside the excess, and its weight in the path [R, K]."""
    there, whole = np.asarray(table.detected) > 0, variance(table, phi, w)
    # Noise and other sounds; of an outlier also what of the excess its small weight adds.
    error = np.sqrt(np.maximum(whole - np.exp(2 * phi[0]), table.variance))
    return left.own, np.where(there, error, NOTHING), np.where(there, 1 / whole, 0.0)


def _decays(problem: FitProblem, minima: Minima, which: int, number: np.ndarray) -> np.ndarray:
    """Decay rates of partials over the law's at a minimum, shrunk to it by what noise leaves open."""
    observed, decay = problem.observed, minima.people.parts[2]
    own = np.diag(observed.decay.systematic) + np.exp(2 * decay.phi[which, 0])
    share = own / (own + np.asarray(observed.decay.variance)[0])
    return scatter_by_number(np.exp(share * decay.residual[which, 0]), observed.string_number, number, 1.0)
