"""Records of a fit that all recipes build in one way: recordings, output paths, sizes and derived quantities."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..felt import law_of
from ..inference import InitialValues
from ..schema.fit import Derived, GlideWindow, PartialLevels, PathEntry, Pickup, Recontact, RecordingFit
from ..schema.quantities import UNITS, Quantity, Status, meaning_of
from .fitted_recording import FittedRecording

__all__ = ["derived_of", "fixed_quantity", "pickup_of", "record_of", "sizes"]


def fixed_quantity(name: str, value: float, status: Status) -> Quantity:
    """A parameter that was not fitted."""
    return Quantity(name, float(value), UNITS[name], None, status, meaning_of(name), initial=float(value))


def sizes(start: InitialValues) -> list[Quantity]:
    """String mass, string length, and the position of the pickup if it is on the string."""
    g = start.geometry
    table = [
        fixed_quantity(name, value, "assumed" if key in start.assumed else "given")
        for name, value, key in (("M_S", g.mass, "mass"), ("L", g.length, "length"))
    ]
    on_string = start.quantity in ("velocity", "displacement")
    return [*table, fixed_quantity("pickup", g.pickup, "given")] if on_string else table


def record_of(
    fitted: FittedRecording,
    velocity: Quantity,
    calibrated: bool,
    *,
    is_reference: bool = True,
    pitch_offset_cents: float = 0.0,
    path_group: int = 0,
    stroke: int = 0,
) -> RecordingFit:
    """The record of one recording; `velocity` is that of its stroke."""
    source, table = fitted.recording, fitted.partials
    return RecordingFit(
        file=source.path,
        sha256=source.sha256,
        channel=source.channel,
        rate=source.rate,
        onset_s=source.onset / source.rate,
        v_H0=velocity.value,
        v_H0_interval=velocity.interval,
        v_H0_status=velocity.status,
        v_H0_initial=velocity.initial,
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
    )


def pickup_of(quantity: str, recordings: Sequence[FittedRecording], records: Sequence[RecordingFit]) -> Pickup:
    """What was recorded, with the output paths of the reference recording and, if there are several, of all groups."""
    paths = {record.path_group: fitted.fitted.note.path for fitted, record in zip(recordings, records, strict=True)}
    reference = next(record for record in records if record.is_reference)
    groups = {str(group): PathEntry.of(path) for group, path in paths.items()} if len(paths) > 1 else {}
    return Pickup(
        quantity,  # pyright: ignore[reportArgumentType]
        PathEntry.of(paths[reference.path_group]),
        {group: path for group, path in groups.items() if path is not None},
    )


def derived_of(fitted: FittedRecording) -> Derived:
    """Quantities computed from the parameters and from the simulated stroke."""
    note, simulation, analysis = fitted.fitted.note, fitted.fitted.simulation, fitted.analysis
    compression = float(simulation.pulse.compression.max())
    return Derived(
        f0=float(note.f0),
        B=float(note.B),
        f1=float(note.f0 * np.sqrt(1 + note.B)),
        contact_ms=1e3 * simulation.contact_time,
        recontacts=tuple(
            Recontact(1e3 * contact.start, 1e3 * (contact.stop - contact.start), contact.force)
            for contact in simulation.contacts[1:]
        ),
        max_force_N=float(simulation.pulse.force.max()),
        max_compression_mm=1e3 * compression,
        felt_force_N=float(law_of(note.hammer).force(compression, 0.0, note.hammer)),
        glide_cents=float(analysis.glide_cents),
        glide=tuple(GlideWindow(*window) for window in analysis.glide),
    )
