"""The records of the recordings of a fit, and what follows from them: the output paths and the derived values."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ..analysis import cents_above
from ..conversions import midi_of
from ..inference import FitProblem
from ..literature import reference_compression
from ..schema.derived import Derived, GlideWindow, Recontact
from ..schema.fit import PartialLevels, PathEntry, Pickup, RecordingFit
from ..schema.quantities import Quantity
from .fitted_recording import FittedRecording


def records_of(
    problem: FitProblem, recordings: Sequence[FittedRecording], velocities: Sequence[Quantity]
) -> tuple[RecordingFit, ...]:
    """The records of all recordings; `velocities` are those of the strokes."""
    layout, f0 = problem.structure, problem.analyses[problem.reference].f0
    return tuple(
        replace(
            record_of(recording, velocities[stroke], problem.calibrated),
            is_reference=i == problem.reference,
            pitch_offset_cents=cents_above(recording.analysis.f0, f0),
            path_group=group,
            stroke=stroke,
            midi_velocity=problem.midi_velocity[i],
        )
        for i, (recording, stroke, group) in enumerate(zip(recordings, layout.stroke, layout.group, strict=True))
    )


def record_of(fitted: FittedRecording, velocity: Quantity, calibrated: bool) -> RecordingFit:
    """The record of a recording that is fitted alone; `velocity` is that of its stroke."""
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
        is_reference=True,
        pitch_offset_cents=0.0,
        path_group=0,
        stroke=0,
        criterion=fitted.criterion,
        levels=fitted.levels,
        partials=PartialLevels(
            table.number, fitted.level, table.level_error, fitted.initial.level, fitted.fitted.level
        ),
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
