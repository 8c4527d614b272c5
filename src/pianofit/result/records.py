"""The records of a fit: its recordings, the output paths and values that follow from them, and the diagnostics."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from ..conversions import midi_of
from ..inference import KNOCK, FitProblem, InferenceResult
from ..literature import reference_compression
from ..schema.decode import convert
from ..schema.derived import Derived, GlideWindow, Recontact
from ..schema.diagnostics import Correlation, Diagnostics, ExcessSd, PathPrior, PosteriorDiagnostics, ProfileCurve
from ..schema.fit import PathEntry, Pickup, RecordingFit
from ..schema.quantities import Quantity
from .correlations import StrongCorrelation
from .fitted_recording import FittedRecording


def records_of(
    problem: FitProblem, recordings: Sequence[FittedRecording], velocities: Sequence[Quantity]
) -> tuple[RecordingFit, ...]:
    """The records of all recordings; `velocities` are those of the strokes."""
    layout, pitch = problem.structure, problem.observed.pitch
    return tuple(
        replace(
            record_of(recording, velocities[stroke], problem.calibrated),
            is_reference=i == problem.reference,
            pitch_offset_cents=float(pitch[i]),
            path_group=group,
            stroke=stroke,
            midi_velocity=problem.midi_velocity[i],
        )
        for i, (recording, stroke, group) in enumerate(zip(recordings, layout.stroke, layout.group, strict=True))
    )


def record_of(fitted: FittedRecording, velocity: Quantity, calibrated: bool) -> RecordingFit:
    """The record of a recording that is fitted alone; `velocity` is that of its stroke."""
    source = fitted.recording
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
        is_reference=True,
        pitch_offset_cents=0.0,
        path_group=0,
        stroke=0,
        criterion=fitted.criterion,
        levels=fitted.levels,
        partials=fitted.compared,
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


def diagnostics_of(fit: InferenceResult, correlated: Sequence[StrongCorrelation]) -> Diagnostics:
    """The diagnostics of a fit; `correlated` are the pairs that the recordings do not distinguish."""
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
