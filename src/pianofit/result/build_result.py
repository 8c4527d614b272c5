"""Assembly of a `Result` from an inference: sounds, quantities and sentences."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from ..analysis import cents_above
from ..conversions import midi_of
from ..felt.law import scale_velocity
from ..inference import KNOCK, LOG_ABSENT_LOSS, InferenceResult, IntervalResult
from ..literature import reference_compression
from ..model.note import Note
from ..schema.decode import convert
from ..schema.derived import Derived, GlideWindow, Recontact
from ..schema.diagnostics import Correlation, Diagnostics, ExcessSd, PathPrior, PosteriorDiagnostics, ProfileCurve
from ..schema.fit import (
    Fit,
    Minimum,
    PartialLevels,
    PathEntry,
    Pickup,
    RecordingFit,
    VelocityDiscrepancyEntry,
    package_versions,
)
from ..schema.quantities import Quantity
from ..threads import one_blas_thread
from .comparison import compare_recordings, pool_level_errors, worse_bands
from .correlations import StrongCorrelation, covariance_of, strong_correlations
from .derived_table import derived_quantities, with_force_interval
from .draws import Draws
from .estimates import invariants, parameters, stroke_velocities
from .fitted_recording import FittedRecording
from .notes import notes_of
from .result import Result
from .statement import identifiability_statement
from .statuses import statuses
from .warnings import fit_warnings


@one_blas_thread()
def build_result(fit: InferenceResult) -> Result:
    """Build sounds, quantities and sentences from an inference.

    Raises
    ------
    FitError
        If an initial or a final contact does not end.
    """
    problem, found = fit.problem, fit.estimate
    by_minimum = [notes_of(fit, which) for which in range(len(found.minima.nll))]
    recordings = compare_recordings(fit, by_minimum[0])
    notes = tuple(
        tuple(note._replace(gain=recording.fitted.note.gain) for note, recording in zip(own, recordings, strict=True))
        for own in by_minimum
    )
    reference, errors = recordings[problem.reference], [recording.levels.fitted_db for recording in recordings]
    levels, worse = pool_level_errors([recording.levels for recording in recordings]), worse_bands(reference.criterion)
    states, velocities, correlated = statuses(fit), stroke_velocities(fit), strong_correlations(fit)
    records = _records(fit, recordings, velocities)
    record = Fit(
        recipe="default",
        excitation=problem.initial_values.law.kind,  # pyright: ignore[reportArgumentType]
        felt=problem.initial_values.law.name,
        seed=fit.seed,
        converged=bool(found.minima.converged[0]),
        identifiability_statement=identifiability_statement(fit, states, levels, correlated),
        warnings=fit_warnings(fit, states, correlated, worse, errors),
        invariants=invariants(fit, states),
        parameters=parameters(fit, states, velocities[problem.structure.stroke[problem.reference]]),
        recordings=records,
        pickup=pickup_of(problem.initial_values.quantity, recordings, records),
        minima=_minima(fit, notes),
        derived=derived_of(reference),
        criterion=reference.criterion,
        levels=levels,
        diagnostics=_diagnostics(fit, correlated),
        prior=problem.key_prior,
        versions=package_versions(),
    )
    draws = None if fit.alternative is None or fit.alternative.draws is None else _draws(fit, record, fit.alternative)
    return with_derived(Result(record, recordings, notes, draws))


def with_derived(result: Result) -> Result:
    """Return a result with its derived quantities, and with the same draws for the interval of the felt force."""
    fit, draws = result.fit, result.draw_set
    derived = replace(fit.derived, quantities=derived_quantities(draws))
    return replace(result, fit=replace(fit, derived=derived, invariants=with_force_interval(draws)))


def _records(
    fit: InferenceResult, recordings: Sequence[FittedRecording], velocities: Sequence[Quantity]
) -> tuple[RecordingFit, ...]:
    problem, layout = fit.problem, fit.problem.structure
    f0 = problem.analyses[problem.reference].f0
    return tuple(
        record_of(
            recording,
            velocities[stroke],
            problem.calibrated,
            is_reference=i == problem.reference,
            pitch_offset_cents=cents_above(recording.analysis.f0, f0),
            path_group=group,
            stroke=stroke,
            midi_velocity=problem.midi_velocity[i],
        )
        for i, (recording, stroke, group) in enumerate(zip(recordings, layout.stroke, layout.group, strict=True))
    )


def _minima(fit: InferenceResult, notes: Sequence[Sequence[Note]]) -> tuple[Minimum, ...]:
    """Every minimum; output paths are those of the reference recording."""
    u, minima, records = fit.problem.parametrisation, fit.estimate.minima, []
    for b, weight in enumerate(fit.posterior.weight):
        log = dict(zip(u.names, fit.posterior.mean[b], strict=False))
        path = notes[b][fit.problem.reference].path
        records.append(
            Minimum(
                weight=float(weight),
                negative_log_posterior=float(minima.nll[b]),
                parameters={n: u.value(n, log[n]) for n in u.reported if log[n] > LOG_ABSENT_LOSS},
                stroke_values=np.exp(minima.candidates.theta[b, u.velocities]),
                path_db=None if path is None else path.db,
                path_velocity_discrepancy=VelocityDiscrepancyEntry.of(path and path.velocity_discrepancy),
                covariance=covariance_of(fit, b),
            )
        )
    return tuple(records)


def _diagnostics(fit: InferenceResult, correlated: Sequence[StrongCorrelation]) -> Diagnostics:
    problem, minima = fit.problem, fit.estimate.minima
    (sigma, smooth, octaves, floor, walk), *strings = (np.exp(x[0]).tolist() for x in minima.candidates.phi)
    cents, decay = (float(np.hypot(*hyper[:2])) for hyper in strings)
    other: dict[str, Any] = {} if fit.alternative is None else fit.alternative.diagnostics
    where = ("diagnostics", "this is an error in pianofit")
    return Diagnostics(
        evaluations=fit.estimate.n_strokes_computed,
        partials=int(np.asarray(problem.observed.level.detected)[:, problem.observed.number != KNOCK].sum()),
        correlated=tuple(Correlation((pair.first, pair.second), pair.correlation) for pair in correlated),
        negative_log_posterior=float(minima.nll[0]),
        censored=len(problem.observed.level.censored),
        contact_rate_Hz=float(problem.model_inputs.rate),
        modes=problem.cfg.n_modes,
        steps=int(problem.model_inputs.steps),
        excess_sd=ExcessSd(frequency_cents=cents, decay_relative=decay, level_db=sigma),
        path=PathPrior(smooth, octaves) if problem.has_unknown_path else None,
        interference_ratio=floor,
        velocity_discrepancy_db=walk if len({*problem.structure.stroke}) > 1 else None,
        profile=convert(other["profile"], dict[str, ProfileCurve], *where) if "profile" in other else None,
        posterior=convert(other["posterior"], PosteriorDiagnostics, *where) if "posterior" in other else None,
    )


def _draws(fit: InferenceResult, record: Fit, view: IntervalResult) -> Draws:
    """The posterior draws, with those of the invariants that vary."""
    draws, u = view.draws or {}, fit.problem.parametrisation

    def drawn(name: str) -> np.ndarray:
        return np.asarray(draws[name] if name in draws else record.parameters[name].value)

    length, mass = drawn("L"), drawn("M_S")
    table = {"f0": drawn("c") / (2 * length), "B": (drawn("kappa") * np.pi / (drawn("c") * length)) ** 2}
    if u.law.has_contact:
        table |= {"M_H/M_S": drawn("M_H") / mass}
        strokes = {f"v/v_ref {n}": f"v_H0 {n}" for n in range(1, u.strokes + 1)}
        table |= {name: draws[own] / drawn("v_H0") for name, own in strokes.items() if own in draws}
    places = [name for name in (*record.parameters, *draws) if name.partition(" ")[0] in ("x0", "width", "pickup")]
    for name in places:
        of, _, number = name.partition(" ")
        table[f"{of}/L {number}".rstrip()] = drawn(name) / length
    if "F/M_S" in record.invariants:
        # At the reference velocity shown, if a common scale of the velocities is unknown.
        scale = record.parameters["v_H0"].value / drawn("v_H0") if fit.problem.velocity_scale_free else 1.0
        felt = scale_velocity({name: drawn(name) for name in u.law.parameters}, u.law, scale)
        stiffness, p = (felt[u.names[i]] for i in u.force_and_exponent_index or ())
        table["F/M_S"] = stiffness * u.law.power_base(u.reference_compression, felt) ** p / mass
    varying = {name: table[name] for name in record.invariants if name in table and np.ptp(table[name]) > 0}
    return Draws({**draws, **varying}, tuple(varying), view.log_likelihood, view.observed)


# --- records that the paper's recipes share ---------------------------------------------------------------------------


def record_of(
    fitted: FittedRecording,
    velocity: Quantity,
    calibrated: bool,
    *,
    is_reference: bool = True,
    pitch_offset_cents: float = 0.0,
    path_group: int = 0,
    stroke: int = 0,
    midi_velocity: float | None = None,
) -> RecordingFit:
    """The record of one recording; `velocity` is that of its stroke."""
    source, table = fitted.recording, fitted.partials
    return RecordingFit(
        file=source.path,
        sha256=source.sha256,
        channel=source.channel,
        rate=source.rate,
        onset_s=source.onset / source.rate,
        stroke_value=velocity.value,
        stroke_interval=velocity.interval,
        stroke_status=velocity.status,
        stroke_initial=velocity.initial,
        note=fitted.analysis.note,
        gain=fitted.fitted.note.gain,
        gain_status="given" if calibrated else "fitted",
        is_reference=is_reference,
        pitch_offset_cents=pitch_offset_cents,
        path_group=path_group,
        stroke=stroke,
        criterion=fitted.criterion,
        levels=fitted.levels,
        partials=PartialLevels(
            table.number, fitted.level, table.level_error, fitted.initial.level, fitted.fitted.level
        ),
        midi_velocity=midi_velocity,
    )


def pickup_of(quantity: str, recordings: Sequence[FittedRecording], records: Sequence[RecordingFit]) -> Pickup:
    """The recorded quantity, with the output path of the reference recording, and those of several groups."""
    pairs = zip(recordings, records, strict=True)
    paths = {str(record.path_group): PathEntry.of(fitted.fitted.note.path) for fitted, record in pairs}
    reference = next(str(record.path_group) for record in records if record.is_reference)
    several = {group: path for group, path in paths.items() if path is not None and len(paths) > 1}
    return Pickup(quantity, paths[reference], several)  # pyright: ignore[reportArgumentType]


def derived_of(fitted: FittedRecording) -> Derived:
    """Facts that follow from the parameters and from the simulated stroke."""
    note, simulation, analysis = fitted.fitted.note, fitted.fitted.simulation, fitted.analysis
    return Derived(
        f0=float(note.f0),
        B=float(note.B),
        f1=float(note.f0 * np.sqrt(1 + note.B)),
        reference_compression_mm=1e3 * reference_compression(midi_of(note.f0)),
        recontacts=tuple(map(Recontact.of, simulation.contacts[1:])),
        glide_cents=float(analysis.glide_cents),
        glide=tuple(GlideWindow(*window) for window in analysis.glide),
    )
