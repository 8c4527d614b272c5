"""Content of `fit.json`, in one form for all recipes."""

from __future__ import annotations

import platform
from collections.abc import Sequence
from importlib.metadata import version

import numpy as np

from .. import __version__
from ..felt import FeltLaw, is_builtin, law_of
from ..inference.initial_values import InitialValues
from ..io.files import FIT_SCHEMA
from ..model.output_path import OutputPath, VelocityDiscrepancy
from .comparison import pool_level_errors
from .fitted_recording import FittedRecording
from .quantities import UNITS, Covariance

__all__ = [
    "to_document",
    "unit_and_meaning",
    "parameter_row",
    "fixed_parameter_row",
    "no_interval",
    "path_document",
    "recording_row",
    "sizes",
    "velocity_discrepancy_document",
]


def to_document(
    start: InitialValues,
    recordings: Sequence[FittedRecording],
    reference: int,
    rows: Sequence[dict],
    covariance: Covariance,
    *,
    recipe: str,
    seed: int,
    converged: bool,
    claims: str,
    messages: Sequence[str],
    invariants: dict,
    parameters: dict,
    minima: Sequence[dict],
    diagnostics: dict,
) -> dict:
    """The document. `pickup`, `derived` and `criterion` are those of the `reference` recording."""
    first = recordings[reference]
    return {
        "schema": FIT_SCHEMA, "program": "pianofit", "recipe": recipe, "felt": start.law.name, "seed": seed,
        "converged": converged, "claims": claims, "messages": list(messages),
        "invariants": invariants,
        "parameters": parameters,
        "recordings": list(rows),
        "pickup": {"quantity": start.quantity, "path": path_document(first.fitted.note.path)}
        | _paths(recordings, rows),
        "minima": list(minima),
        "covariance": covariance.document(),
        "derived": _derived(first),
        "criterion": first.criterion,
        "levels": pool_level_errors([recording.levels for recording in recordings]),
        "diagnostics": diagnostics,
        "versions": _versions(),
    }  # fmt: skip


def _paths(recordings: Sequence[FittedRecording], rows: Sequence[dict]) -> dict:
    """Output paths by group number, if there are several groups."""
    paths = {
        str(row["group"]): path_document(recording.fitted.note.path)
        for recording, row in zip(recordings, rows, strict=True)
    }
    return {"paths": paths} if len(paths) > 1 else {}


def no_interval() -> dict:
    """The interval of a value that was not fitted."""
    return {"interval": None, "interval_by": None, "interval_open": []}


def parameter_row(
    value: float, description: dict, status: str, initial: float, note: str = "", interval: dict | None = None
) -> dict:
    """A row of `parameters`; `description` has its unit and meaning."""
    span = interval or no_interval()
    return {"value": value, **description, **span, "status": status, "initial": initial, "note": note}


def fixed_parameter_row(value: float, name: str, status: str) -> dict:
    """A row of `parameters` for a value that was not fitted."""
    return parameter_row(float(value), {"unit": UNITS[name]}, status, float(value))


def sizes(start: InitialValues) -> dict[str, dict]:
    """Rows of `parameters` for string length, string mass and pickup position."""
    g = start.geometry
    table = {
        name: fixed_parameter_row(value, name, "assumed" if key in start.assumed else "given")
        for name, value, key in (("M_S", g.mass, "mass"), ("L", g.length, "length"))
    }
    if start.quantity in ("velocity", "displacement"):
        table["pickup"] = fixed_parameter_row(g.pickup, "pickup", "given")
    return table


def unit_and_meaning(name: str, law: FeltLaw) -> dict[str, str]:
    """Unit of a parameter, and its meaning if the felt law is not built in."""
    if name not in law.parameters:
        return {"unit": UNITS[name]}
    return {"unit": law.parameters[name].unit} | ({} if is_builtin(law) else {"meaning": law.parameters[name].meaning})


def recording_row(
    recording: FittedRecording, velocity: dict, calibrated: bool, *, first: bool = True, cents: float = 0.0,
    group: int = 0, stroke: int = 0,
) -> dict:  # fmt: skip
    """A row of `recordings`. `velocity` is the entry of its stroke, `cents` the pitch relative to the reference."""
    source = recording.recording
    return {
        "file": source.path, "sha256": source.sha256, "channel": source.channel, "rate": source.rate,
        "onset_s": source.onset / source.rate, "v_H0": velocity["value"], "v_H0_interval": velocity["interval"],
        "v_H0_status": velocity["status"], "v_H0_initial": velocity["initial"],
        "note": recording.analysis.note, "gain": recording.fitted.note.gain,
        "gain_status": "given" if calibrated else "fitted", "first": first, "cents": cents, "group": group,
        "stroke": stroke, "criterion": recording.criterion, "levels": recording.levels,
        "partials": _partials(recording),
    }  # fmt: skip


def _partials(recording: FittedRecording) -> dict[str, list]:
    """Measured and modelled levels, dB [partials]."""
    table = recording.partials
    return {
        "number": table.number.tolist(), "measured": recording.level.tolist(), "error": table.level_error.tolist(),
        "initial": recording.initial.level.tolist(), "fitted": recording.fitted.level.tolist(),
    }  # fmt: skip


def path_document(path: OutputPath | None) -> dict | None:
    """The entry of an output path."""
    if path is None:
        return None
    columns = {"frequency": path.frequency.tolist(), "db": path.db.tolist()}
    columns |= {} if path.decay is None else {"decay": path.decay.tolist()}
    return columns | (
        {}
        if path.velocity_discrepancy is None
        else {"wander": velocity_discrepancy_document(path.velocity_discrepancy)}
    )


def velocity_discrepancy_document(wander: VelocityDiscrepancy | None) -> dict | None:
    """The entry of a velocity discrepancy; None if there is none."""
    return None if wander is None else {name: column.tolist() for name, column in wander._asdict().items()}


def _derived(recording: FittedRecording) -> dict:
    """Quantities computed from the parameters and from the simulated stroke."""
    note, simulation, analysis = recording.fitted.note, recording.fitted.simulation, recording.analysis
    pulse, g = simulation.pulse, note.geometry
    u = float(pulse.compression.max())
    return {
        "f0": float(note.f0), "B": float(note.B), "f1": float(note.f0 * np.sqrt(1 + note.B)),
        "M_H/M_S": float(note.hammer.M_H / g.mass),
        "x0/L": float(g.strike_position / g.length), "contact_ms": 1e3 * simulation.contact_time,
        "later_contacts": [contact.document() for contact in simulation.contacts[1:]],
        "max_force_N": float(pulse.force.max()), "max_compression_mm": 1e3 * u,
        "felt_force_N": float(law_of(note.hammer).force(u, 0.0, note.hammer)),
        "glide_cents": float(analysis.glide_cents),
        "glide": [{"start_s": a, "stop_s": b, "f0": f} for a, b, f in analysis.glide],
    }  # fmt: skip


def _versions() -> dict[str, str]:
    """Versions of the program and of the packages that its numbers depend on."""
    own = {"pianofit": __version__, "python": platform.python_version()}
    return own | {name: version(name) for name in ("jax", "numpy", "scipy")}
