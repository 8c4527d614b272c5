"""Every minimum as something that plays: string, hammer of a stroke, and the path that F integrated out."""

from __future__ import annotations

import numpy as np

from ..inference.coordinates import STRING_SIZE
from ..inference.finish import Minima
from ..inference.lanes import DB
from ..inference.likelihood import Table, variance
from ..inference.observations import placed, string_law
from ..inference.problem import Problem
from ..inference.reports import Latent, latent
from ..model.note import Note
from ..model.path import OutputPath, Wander
from .walks import NOTHING, between_strokes

__all__ = ["latents", "notes_of"]


def latents(minima: Minima, which: int) -> Latent:
    """What F integrated out, at one minimum."""
    level = minima.people.level
    return latent(minima.descent.table, level.residual[which], level.phi[which], level.w[which])


def notes_of(problem: Problem, minima: Minima, which: int) -> list[Note]:
    """One minimum's string, and its hammer at the velocity of every recording's stroke; without gains."""
    u, z, group = problem.unknowns, minima.people.z[which], problem.layout.group
    left = latents(minima, which)
    paths = [
        _path(problem, minima, which, each, left) if problem.path else None for each in range(problem.layout.groups)
    ]
    f0, string = problem.analyses[problem.reference].f0, u.string(z)
    return [
        Note(string._replace(c=string.c * analysis.f0 / f0), u.hammer(z, stroke), u.struck(z), problem.start.quantity,
             1.0, paths[path])
        for analysis, stroke, path in zip(problem.analyses, problem.layout.stroke, group, strict=True)
    ]  # fmt: skip


def _path(problem: Problem, minima: Minima, which: int, group: int, left: Latent) -> OutputPath:
    """The posterior mean of a group's path, dB, at the partials found through it, and decays over the law's.

    The partials stand where the minimum's string has them: real ones leave the law, but are known by their numbers.
    """
    observed, people = problem.observed, minima.people
    mine = np.flatnonzero(np.array(problem.layout.group) == group)
    found = np.any(np.asarray(observed.level.found)[mine] > 0, axis=0)
    number = observed.number[found]
    frequency = string_law(people.z[which, :STRING_SIZE], number, problem.start.geometry.length)[0][0]
    velocity = np.exp(people.z[which, problem.unknowns.shared :])[np.array(problem.layout.stroke)[mine]]
    seen, error, weight = (
        x[np.ix_(mine, found)] for x in _left(observed.level, people.level.phi[which], people.level.w[which], left)
    )
    known, db = between_strokes(seen / DB, error / DB, weight, velocity)
    return OutputPath(
        frequency, left.common[group][found], _decays(problem, minima, which, number),
        Wander(known, DB * db) if len(known) > 1 else None,
    )  # fmt: skip


def _left(table: Table, phi: np.ndarray, w: np.ndarray, left: Latent) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """What the fit leaves of every level, dB, its errors beside the excess, and its weight in the path [R, K]."""
    there, whole = np.asarray(table.found) > 0, variance(table, phi, w)
    # Noise and other sounds; of an outlier also what of the excess its small weight adds.
    error = np.sqrt(np.maximum(whole - np.exp(2 * phi[0]), table.variance))
    return left.own, np.where(there, error, NOTHING), np.where(there, 1 / whole, 0.0)


def _decays(problem: Problem, minima: Minima, which: int, number: np.ndarray) -> np.ndarray:
    """Decay rates of partials over the law's at a minimum, shrunk to it by what noise leaves open."""
    observed, decay = problem.observed, minima.people.parts[2]
    own = np.diag(observed.decay.systematic) + np.exp(2 * decay.phi[which, 0])
    share = own / (own + np.asarray(observed.decay.variance)[0])
    return placed(np.exp(share * decay.residual[which, 0]), observed.string_number, number, 1.0)
