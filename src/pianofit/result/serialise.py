"""What `fit.json` holds, as every way of fitting writes it."""

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
from .quantities import UNITS, Covariance
from .result import FittedRecording

__all__ = [
    "to_document",
    "unit_and_meaning",
    "entry",
    "fixed_entry",
    "no_interval",
    "path_document",
    "recording_entry",
    "sizes",
    "wander_document",
]


def to_document(
    start: InitialValues,
    heard: Sequence[FittedRecording],
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
    """The whole document, in its order; what belongs to no recording alone is the `reference`'s."""
    first = heard[reference]
    return {
        "schema": FIT_SCHEMA, "program": "pianofit", "recipe": recipe, "felt": start.law.name, "seed": seed,
        "converged": converged, "claims": claims, "messages": list(messages),
        "invariants": invariants,
        "parameters": parameters,
        "recordings": list(rows),
        "pickup": {"quantity": start.quantity, "path": path_document(first.fitted.note.path)} | _paths(heard, rows),
        "minima": list(minima),
        "covariance": covariance.document(),
        "derived": _derived(first),
        "criterion": first.criterion,
        "levels": pool_level_errors([each.levels for each in heard]),
        "diagnostics": diagnostics,
        "versions": _versions(),
    }  # fmt: skip


def _paths(heard: Sequence[FittedRecording], rows: Sequence[dict]) -> dict:
    """The paths of all groups by number, where there are several."""
    found = {str(row["group"]): path_document(each.fitted.note.path) for each, row in zip(heard, rows, strict=True)}
    return {"paths": found} if len(found) > 1 else {}


def no_interval() -> dict:
    """Of what no fit searches."""
    return {"interval": None, "interval_by": None, "interval_open": []}


def entry(value: float, said: dict, status: str, initial: float, note: str = "", interval: dict | None = None) -> dict:
    """A row of `parameters`: `said` are its unit and meaning."""
    span = interval or no_interval()
    return {"value": value, **said, **span, "status": status, "initial": initial, "note": note}


def fixed_entry(value: float, name: str, status: str) -> dict:
    """What no fit searches."""
    return entry(float(value), {"unit": UNITS[name]}, status, float(value))


def sizes(start: InitialValues) -> dict[str, dict]:
    """The string's length and mass, and the pickup's position, as `parameters` has them."""
    g = start.geometry
    table = {
        name: fixed_entry(value, name, "assumed" if key in start.assumed else "given")
        for name, value, key in (("M_S", g.mass, "mass"), ("L", g.length, "length"))
    }
    if start.quantity in ("velocity", "displacement"):
        table["pickup"] = fixed_entry(g.pickup, "pickup", "given")
    return table


def unit_and_meaning(name: str, law: FeltLaw) -> dict[str, str]:
    """Unit of a parameter; and what it means, where only a law from outside says so."""
    if name not in law.parameters:
        return {"unit": UNITS[name]}
    return {"unit": law.parameters[name].unit} | ({} if is_builtin(law) else {"meaning": law.parameters[name].meaning})


def recording_entry(
    heard: FittedRecording, velocity: dict, calibrated: bool, *, first: bool = True, cents: float = 0.0, group: int = 0,
    stroke: int = 0,
) -> dict:  # fmt: skip
    """What one recording has of its own; `velocity` is the entry of its stroke's, `cents` are over the reference's."""
    recording = heard.recording
    return {
        "file": recording.path, "sha256": recording.sha256, "channel": recording.channel, "rate": recording.rate,
        "onset_s": recording.onset / recording.rate, "v_H0": velocity["value"], "v_H0_interval": velocity["interval"],
        "v_H0_status": velocity["status"], "v_H0_initial": velocity["initial"],
        "note": heard.analysis.note, "gain": heard.fitted.note.gain,
        "gain_status": "given" if calibrated else "fitted", "first": first, "cents": cents, "group": group,
        "stroke": stroke, "criterion": heard.criterion, "levels": heard.levels, "partials": _partials(heard),
    }  # fmt: skip


def _partials(heard: FittedRecording) -> dict[str, list]:
    """The levels that are compared, dB [partials]."""
    table = heard.partials
    return {
        "number": table.number.tolist(), "measured": heard.level.tolist(), "error": table.level_error.tolist(),
        "initial": heard.initial.level.tolist(), "fitted": heard.fitted.level.tolist(),
    }  # fmt: skip


def path_document(path: OutputPath | None) -> dict | None:
    """A path as `fit.json` holds it."""
    if path is None:
        return None
    columns = {"frequency": path.frequency.tolist(), "db": path.db.tolist()}
    columns |= {} if path.decay is None else {"decay": path.decay.tolist()}
    return columns | ({} if path.wander is None else {"wander": wander_document(path.wander)})


def wander_document(wander: VelocityDiscrepancy | None) -> dict | None:
    """What strokes have over a path as `fit.json` holds it; None where nothing is known of it."""
    return None if wander is None else {name: column.tolist() for name, column in wander._asdict().items()}


def _derived(heard: FittedRecording) -> dict:
    """What follows from the parameters, and what the stroke did."""
    note, simulation, analysis = heard.fitted.note, heard.fitted.simulation, heard.analysis
    pulse, g = simulation.pulse, note.geometry
    u = float(pulse.compression.max())
    return {
        "f0": float(note.f0), "B": float(note.B), "f1": float(note.f0 * np.sqrt(1 + note.B)),
        "M_H/M_S": float(note.hammer.M_H / g.mass),
        "x0/L": float(g.strike_position / g.length), "contact_ms": 1e3 * simulation.contact_time,
        "later_contacts": [again.document() for again in simulation.contacts[1:]],
        "max_force_N": float(pulse.force.max()), "max_compression_mm": 1e3 * u,
        "felt_force_N": float(law_of(note.hammer).force(u, 0.0, note.hammer)),
        "glide_cents": float(analysis.glide_cents),
        "glide": [{"start_s": a, "stop_s": b, "f0": f} for a, b, f in analysis.glide],
    }  # fmt: skip


def _versions() -> dict[str, str]:
    """Of the program and of everything the numbers depend on."""
    own = {"pianofit": __version__, "python": platform.python_version()}
    return own | {name: version(name) for name in ("jax", "numpy", "scipy")}
