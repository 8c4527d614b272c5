"""Every minimum as something that plays: string, hammer of a stroke, and the path that F integrated out."""

from __future__ import annotations

import numpy as np

from ..model.note import Note
from ..model.path import OutputPath
from .coordinates import STRING_SIZE
from .finish import Minima
from .observations import string_law
from .problem import Problem
from .reports import Latent, latent
from .string import string_residuals

__all__ = ["latents", "path_of", "note_of"]


def latents(minima: Minima, which: int) -> Latent:
    """What F integrated out, at one minimum."""
    people, descent = minima.people, minima.descents[which]
    return latent(descent.table, people.residual[which], people.phi[which], people.w[which])


def path_of(problem: Problem, minima: Minima, which: int, recording: int) -> OutputPath | None:
    """The posterior mean of a recording's path, dB, at the partials found through it, and decays over the law's.

    The partials stand where the minimum's string has them: real ones leave the law, but are known by their numbers.
    """
    if not problem.path:
        return None
    group, observed = problem.layout.group[recording], problem.observed
    mine = np.array(problem.layout.group) == group
    found = (np.asarray(observed.level.found) * mine[:, None]).any(axis=0)
    number = observed.number[found]
    frequency = string_law(minima.people.z[which, :STRING_SIZE], number, problem.start.geometry.length)[0][0]
    return OutputPath(frequency, latents(minima, which).common[group][found], _decays(problem, minima, which, number))


def _decays(problem: Problem, minima: Minima, which: int, number: np.ndarray) -> np.ndarray:
    """Decay rates of partials over the law's at a minimum, shrunk to it by what noise leaves open."""
    observed, string = problem.observed, minima.people.z[which, :STRING_SIZE]
    residual, slope = (x[1] for x in string_residuals(problem, string))
    law = slope[0].sum(axis=1)  # b1 + b2 β² over the reference's law: the law is linear in both
    own = np.diag(observed.decay.systematic) + np.exp(2 * minima.strings[which].phi[1][0])
    share = own / (own + np.asarray(observed.decay.variance)[0])
    ratio = 1 + share * residual[0] / np.where(law > 0, law, 1.0)
    by_number = np.ones(max(observed.string_number.max(), number.max()) + 1)
    by_number[observed.string_number] = np.maximum(ratio, 0.05)
    return by_number[number]


def note_of(problem: Problem, minima: Minima, which: int, recording: int) -> Note:
    """The fitted string, and the hammer at the velocity of a recording's stroke; without a gain."""
    u, z = problem.unknowns, minima.people.z[which]
    cents = 1200 * np.log2(problem.analyses[recording].f0 / problem.analyses[problem.reference].f0)
    string = u.string(z)
    string = string._replace(c=string.c * 2 ** (cents / 1200))
    hammer = u.hammer(z, problem.layout.stroke[recording])
    return Note(string, hammer, u.struck(z), problem.start.quantity, 1.0, path_of(problem, minima, which, recording))
