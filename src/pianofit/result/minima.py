"""The minima of a fit, and their notes: string, hammer, and the output path that F integrates out.

The velocity discrepancy of a path is the posterior mean of F's random walk over log velocity. Between strokes it is
linear in log velocity, beyond them constant.
"""

from collections.abc import Sequence

import numpy as np

from ..dsp.knock_band import centre
from ..inference import KNOCK, LOG_ABSENT_LOSS, STRING_SIZE, FitProblem, InferenceResult, LatentPosterior, string_law
from ..model.note import Note
from ..model.output_path import OutputPath, VelocityDiscrepancy
from ..schema.fit import Minimum, PathEntry
from ..schema.quantities import Covariance


def notes_of(fit: InferenceResult, which: int) -> list[Note]:
    """The notes of one minimum for every recording, at the velocity of its stroke and without a gain."""
    problem, z, latent = fit.problem, fit.estimate.minima.candidates.theta[which], fit.latent(which)
    layout = problem.structure
    paths = [_path(problem, z, i, latent) if problem.has_unknown_path else None for i in range(layout.groups)]
    strokes = zip(problem.observed.pitch.tolist(), layout.stroke, layout.group, strict=True)
    return [note_at(problem, z, stroke, paths[group]).with_cents(cents) for cents, stroke, group in strokes]


def note_at(problem: FitProblem, z: np.ndarray, stroke: int, path: OutputPath | None = None) -> Note:
    """The note of a stroke at parameters `z` [size], at the pitch of the reference recording and without a gain."""
    u = problem.parametrisation
    return Note(u.string(z), u.hammer(z, stroke), u.geometry_at(z, stroke), problem.initial_values.quantity, 1.0, path)


def _path(problem: FitProblem, theta: np.ndarray, group: int, latent: LatentPosterior) -> OutputPath:
    """Posterior mean of a group's output path, dB, at its detected partials, for the parameters `theta` [size].

    Frequencies are those of the string model, since partials are identified by number.
    """
    observed, u = problem.observed, problem.parametrisation
    recordings = np.flatnonzero(np.array(problem.structure.group) == group)
    detected = np.any(np.asarray(observed.level.detected)[recordings] > 0, axis=0)
    number = observed.number[detected]
    string = u.model_entries(theta)[:STRING_SIZE]
    frequency = string_law(string, np.maximum(number, 1), problem.initial_values.geometry.length)[0][0]
    f0 = float(np.exp(string[0])) / (2 * problem.initial_values.geometry.length)
    frequency = np.where(number == KNOCK, centre(f0), frequency)
    order = np.argsort(frequency)
    velocity = np.exp(observed.level.velocity[recordings] @ theta)
    velocities, first = np.unique(velocity, return_index=True)
    return OutputPath(
        frequency[order],
        latent.path[group][detected][order],
        VelocityDiscrepancy(velocities, latent.discrepancy[np.ix_(recordings[first], detected)][:, order])
        if len(velocities) > 1
        else None,
    )


def minima_of(fit: InferenceResult, notes: Sequence[Sequence[Note]]) -> tuple[Minimum, ...]:
    """Every minimum; output paths are those of the reference recording."""
    u, minima, records = fit.problem.parametrisation, fit.estimate.minima, []
    for b, weight in enumerate(fit.posterior.weight):
        log = dict(zip(u.names, fit.posterior.mean[b], strict=False))
        path = PathEntry.of(notes[b][fit.problem.reference].path)
        records.append(
            Minimum(
                weight=float(weight),
                negative_log_posterior=float(minima.nll[b]),
                parameters={n: u.value(n, log[n]) for n in u.reported if log[n] > LOG_ABSENT_LOSS},
                stroke_values=np.exp(minima.candidates.theta[b, u.velocities]),
                path_db=None if path is None else path.db,
                path_velocity_discrepancy=None if path is None else path.velocity_discrepancy,
                covariance=covariance_of(fit, b),
            )
        )
    return tuple(records)


def covariance_of(fit: InferenceResult, minimum: int) -> Covariance:
    """Covariance of the logarithms of the parameters and velocities at a minimum, by name."""
    names = fit.problem.parameter_indices
    return Covariance(tuple(names), fit.posterior.covariance[minimum][np.ix_([*names.values()], [*names.values()])])
