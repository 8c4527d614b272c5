"""Assembly of a `Result` from an inference: sounds, quantities and sentences."""

from ..inference import InferenceResult
from ..schema.fit import Fit, package_versions
from ..threads import numerical_settings
from .comparison import compare_recordings, pool_level_errors
from .correlations import strong_correlations
from .derived_table import with_derived
from .draws import draws_of
from .estimates import invariants, parameters, stroke_velocities
from .minima import minima_of, notes_of
from .records import derived_of, diagnostics_of, pickup_of, records_of
from .result import Result
from .statement import identifiability_statement
from .statuses import statuses
from .warnings import fit_warnings


@numerical_settings()
def build_result(fit: InferenceResult) -> Result:
    """Build sounds, quantities and sentences from an inference; a `FitError` if a contact does not end."""
    problem, initial, found = fit.problem, fit.problem.initial_values, fit.estimate.minima
    by_minimum = [notes_of(fit, which) for which in range(len(found.nll))]
    minima = minima_of(fit, by_minimum)
    recordings = compare_recordings(fit, by_minimum[0])
    notes = tuple(
        tuple(note._replace(gain=recording.fitted.note.gain) for note, recording in zip(own, recordings, strict=True))
        for own in by_minimum
    )
    reference, levels = recordings[problem.reference], pool_level_errors([own.levels for own in recordings])
    states, correlated = statuses(fit), strong_correlations(fit)
    velocities = stroke_velocities(fit, states)
    records = records_of(problem, recordings, velocities)
    record = Fit(
        recipe="default",
        excitation=initial.law.kind,  # pyright: ignore[reportArgumentType]
        felt=initial.law.name,
        seed=fit.seed,
        converged=bool(found.converged[0]),
        recordings=records,
        pickup=pickup_of(initial.quantity, recordings, records),
        derived=derived_of(reference),
        identifiability_statement=identifiability_statement(fit, states, levels, correlated),
        warnings=fit_warnings(fit, states, correlated, recordings),
        invariants=invariants(fit, states),
        parameters=parameters(fit, states, velocities[problem.structure.stroke[problem.reference]]),
        minima=minima,
        criterion=reference.criterion,
        levels=levels,
        diagnostics=diagnostics_of(fit, correlated),
        prior=problem.key_prior,
        versions=package_versions(),
    )
    return with_derived(Result(record, recordings, notes, draws_of(fit, record)))
