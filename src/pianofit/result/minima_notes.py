"""One `Note` for every minimum and recording: string, hammer, and the output path that F integrates out."""

from __future__ import annotations

import numpy as np

from ..inference import (
    STRING_SIZE,
    FitProblem,
    InferenceResult,
    LatentPosterior,
    Minima,
    scatter_by_number,
    string_law,
)
from ..inference.batched_model import DB
from ..inference.likelihood import ObservationTable, variance
from ..model.note import Note
from ..model.output_path import OutputPath, VelocityDiscrepancy
from .velocity_discrepancy import UNINFORMATIVE_ERROR, stroke_deviations

__all__ = ["notes_of"]


def notes_of(fit: InferenceResult, which: int) -> list[Note]:
    """The notes of one minimum for every recording, at the velocity of its stroke and without a gain."""
    problem, minima, latent = fit.problem, fit.estimate.minima, fit.latent(which)
    u, z, group = problem.parametrisation, minima.candidates.theta[which], problem.structure.group
    paths = [
        _path(problem, minima, which, index, latent) if problem.path else None
        for index in range(problem.structure.groups)
    ]
    f0, string = problem.analyses[problem.reference].f0, u.string(z)
    return [
        Note(
            string._replace(c=string.c * analysis.f0 / f0),
            u.hammer(z, stroke),
            u.geometry_at(z),
            problem.initial_values.quantity,
            1.0,
            paths[path],
        )
        for analysis, stroke, path in zip(problem.analyses, problem.structure.stroke, group, strict=True)
    ]


def _path(problem: FitProblem, minima: Minima, which: int, group: int, latent: LatentPosterior) -> OutputPath:
    """Posterior mean of a group's output path, dB, at its detected partials.

    Decay rates are relative to the string model. Frequencies are those of the string model, since
    partials are identified by number.
    """
    observed, candidates = problem.observed, minima.candidates
    recordings = np.flatnonzero(np.array(problem.structure.group) == group)
    detected = np.any(np.asarray(observed.level.detected)[recordings] > 0, axis=0)
    number = observed.number[detected]
    frequency = string_law(candidates.theta[which, :STRING_SIZE], number, problem.initial_values.geometry.length)[0][0]
    velocity = np.exp(candidates.theta[which, problem.parametrisation.shared :])[
        np.array(problem.structure.stroke)[recordings]
    ]
    residuals = _residuals(observed.level, candidates.level.phi[which], candidates.level.w[which], latent)
    residual, error, weight = (x[np.ix_(recordings, detected)] for x in residuals)
    velocities, db = stroke_deviations(residual / DB, error / DB, weight, velocity)
    return OutputPath(
        frequency, latent.path[group][detected], _decays(problem, minima, which, number),
        VelocityDiscrepancy(velocities, DB * db) if len(velocities) > 1 else None,
    )  # fmt: skip


def _residuals(
    table: ObservationTable, phi: np.ndarray, w: np.ndarray, latent: LatentPosterior
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Residual of every level, its standard error without the excess, and its weight in the output path [R, K]."""
    detected, total = np.asarray(table.detected) > 0, variance(table, phi, w)
    # Noise and interference. The small weight of an outlier adds variance beyond the excess, which stays in its error.
    error = np.sqrt(np.maximum(total - np.exp(2 * phi[0]), table.variance))
    return latent.residual, np.where(detected, error, UNINFORMATIVE_ERROR), np.where(detected, 1 / total, 0.0)


def _decays(problem: FitProblem, minima: Minima, which: int, number: np.ndarray) -> np.ndarray:
    """Decay rates relative to the string model at a minimum, shrunk towards 1 where the noise is large."""
    observed, decay = problem.observed, minima.candidates.parts[2]
    excess = np.diag(observed.decay.systematic) + np.exp(2 * decay.phi[which, 0])
    shrinkage = excess / (excess + np.asarray(observed.decay.variance)[0])
    return scatter_by_number(np.exp(shrinkage * decay.residual[which, 0]), observed.string_number, number, 1.0)
