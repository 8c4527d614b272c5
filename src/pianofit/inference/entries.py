"""Entries of `fit.json` that every way of fitting writes alike."""

from __future__ import annotations

import platform

import numpy as np

from .. import __version__
from ..analysis import Analysis
from ..felt import FeltLaw, is_own, law_of
from ..model import Simulation
from ..model.note import Note
from ..model.path import OutputPath, Wander
from .quantities import UNITS
from .start import Start

__all__ = ["absent", "derived", "described", "given", "path_document", "sizes", "versions", "wander_document"]


def versions() -> dict[str, str]:
    """Of the program and of everything the numbers depend on."""
    import jax
    import scipy

    return {
        "pianofit": __version__, "python": platform.python_version(), "jax": jax.__version__,
        "numpy": np.__version__, "scipy": scipy.__version__,
    }  # fmt: skip


def given(value: float, name: str, status: str) -> dict:
    """What no fit searches."""
    return {
        "value": float(value), "unit": UNITS[name], "interval": None, "interval_by": None, "interval_open": [],
        "status": status, "initial": float(value), "note": "",
    }  # fmt: skip


def sizes(start: Start) -> dict[str, dict]:
    """The string's length and mass, and the pickup's position, as `parameters` has them."""
    g = start.geometry
    table = {
        name: given(value, name, "assumed" if key in start.assumed else "given")
        for name, value, key in (("M_S", g.mass, "mass"), ("L", g.length, "length"))
    }
    if start.quantity in ("velocity", "displacement"):
        table["pickup"] = given(g.pickup, "pickup", "given")
    return table


def derived(note: Note, simulation: Simulation, analysis: Analysis) -> dict:
    """What follows from the parameters, and what the stroke did."""
    pulse, g = simulation.pulse, note.geometry
    f0 = note.string.c / (2 * g.length)
    B = (note.string.kappa * np.pi / (note.string.c * g.length)) ** 2
    u = float(pulse.compression.max())
    return {
        "f0": float(f0), "B": float(B), "f1": float(f0 * np.sqrt(1 + B)), "M_H/M_S": float(note.hammer.M_H / g.mass),
        "x0/L": float(g.strike / g.length), "contact_ms": 1e3 * simulation.contact_time,
        "later_contacts": [again.document() for again in simulation.contacts[1:]],
        "max_force_N": float(pulse.force.max()), "max_compression_mm": 1e3 * u,
        "felt_force_N": float(law_of(note.hammer).force(u, 0.0, note.hammer)),
        "glide_cents": float(analysis.glide_cents),
        "glide": [{"start_s": a, "stop_s": b, "f0": f} for a, b, f in analysis.glide],
    }  # fmt: skip


def path_document(path: OutputPath | None) -> dict | None:
    """A path as `fit.json` holds it."""
    if path is None:
        return None
    columns = {"frequency": path.frequency.tolist(), "db": path.db.tolist()}
    columns |= {} if path.decay is None else {"decay": path.decay.tolist()}
    return columns | ({} if path.wander is None else {"wander": wander_document(path.wander)})


def wander_document(wander: Wander | None) -> dict | None:
    """What strokes have over a path as `fit.json` holds it; None where nothing is known of it."""
    return None if wander is None else {name: column.tolist() for name, column in wander._asdict().items()}


def absent(name: str, felt: str) -> dict:
    """A loss that the felt's law does not have."""
    return given(0.0, name, "given") | {"note": f"the felt's law, {felt}, has none"}


def described(name: str, law: FeltLaw) -> dict[str, str]:
    """Unit of a parameter; and what it means, where only a law from outside says so."""
    if name not in law.parameters:
        return {"unit": UNITS[name]}
    return {"unit": law.parameters[name].unit} | ({} if is_own(law) else {"meaning": law.parameters[name].meaning})
