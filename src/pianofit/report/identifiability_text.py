"""Sentences on which quantities the data determine.

Each combination of parameters goes to one of three lists, by the width of its interval and by its status. Text is
plain; the page escapes it.
"""

from __future__ import annotations

import math
from typing import Any

from ..felt import LAWS
from ..io.number_format import format_relative_uncertainty, is_number, number, with_half_interval, with_interval
from ..result.quantities import MEANINGS
from .text import VELOCITY_RATIO

__all__ = ["felt_scale", "half_interval", "identifiability_sections", "is_power_law", "open_scale"]

DETERMINED = "Determined by the data, with 95 % uncertainty in parentheses"
CONDITIONAL = "Determined only if the model and its output path are correct"
UNDETERMINED = "Not determined by the data"
# Half of a 95 % interval, as a logarithm: up to a factor of 2, a quantity that is reported as not identifiable would
# be determined if the model were correct.
LARGEST_CONDITIONAL = math.log(2.0)
# Invariants that can be reported as not identifiable.
HAMMER_INVARIANTS = ("F/M_S", "M_H/M_S")


def identifiability_sections(fit: dict[str, Any]) -> list[tuple[str, list[str]]]:
    """Return (heading, sentences): combinations that are determined, conditional on the model, and undetermined."""
    writers = {"f0": _pitch, "B": _invariant, "x0/L": _invariant, "F/M_S": _felt_force, "M_H/M_S": _invariant}
    sections: dict[str, list[str]] = {DETERMINED: [], CONDITIONAL: [], UNDETERMINED: []}
    for name, write in writers.items():
        half = half_interval(fit["invariants"].get(name))
        if half is None:  # given, or not part of this fit
            continue
        not_identifiable = name in HAMMER_INVARIANTS and fit["invariants"][name]["status"] == "not-identifiable"
        heading = DETERMINED
        if not_identifiable:
            heading = CONDITIONAL if half <= LARGEST_CONDITIONAL else UNDETERMINED
        sections[heading].append(write(fit, name, half))
    sections[DETERMINED] += _velocities(fit)
    return [(heading, sentences) for heading, sentences in sections.items() if sentences]


def half_interval(entry: Any) -> float | None:
    """Return half of the 95 % interval of the logarithm of an entry; None if it has no interval."""
    span = entry.get("interval") if isinstance(entry, dict) else None
    if not (isinstance(span, list | tuple) and len(span) == 2 and all(map(is_number, span)) and 0 < span[0] < span[1]):
        return None
    return 0.5 * math.log(span[1] / span[0])


def _pitch(fit: dict[str, Any], name: str, half: float) -> str:
    entry = fit["invariants"][name]
    value, _ = with_interval(entry["value"], entry["interval"])
    return f"Pitch: f₀ = {value} Hz (± {number(1200 * half / math.log(2), 2)} cents)."


def _invariant(fit: dict[str, Any], name: str, half: float) -> str:
    meaning = MEANINGS[name]
    return f"{meaning[0].upper()}{meaning[1:]}: {name} = {with_half_interval(fit['invariants'][name]['value'], half)}."


def _felt_force(fit: dict[str, Any], name: str, half: float) -> str:
    """Return the force of the felt at the compression of the strokes, which determine it rather than K_H and p."""
    entry = fit["invariants"][name]
    note = f"{entry['note'][0].upper()}{entry['note'][1:]}"
    text = f"{note}, divided by the mass of the string: {name} = {with_half_interval(entry['value'], half, 'N/kg')}."
    half_of_stiffness = half_interval(fit["parameters"].get("K_H"))
    if half_of_stiffness is not None and half_of_stiffness > 1.2 * half:
        uncertainty = format_relative_uncertainty(half_of_stiffness)
        text += f" K_H alone is known {uncertainty}. Its unit depends on p."
    return f"{text} {felt_scale(fit)}".rstrip()


def open_scale(fit: dict[str, Any]) -> bool:
    """Return whether the common scale of the velocities is unknown: neither a velocity nor the gain was given."""
    status = fit["parameters"]["v_H0"]["status"]
    given = any("given" in (row["gain_status"], row["v_H0_status"]) for row in fit["recordings"])
    return status in ("scaled", "assumed") or (status == "not-identifiable" and not given)


def felt_scale(fit: dict[str, Any]) -> str:
    """Return the assumptions on which force and compression of the felt depend; empty if there are none."""
    is_mass_assumed, is_scale_open = fit["parameters"]["M_S"]["status"] == "assumed", open_scale(fit)
    if not is_scale_open:
        return "Forces scale with the assumed mass of the string." if is_mass_assumed else ""
    text = "Forces and compressions scale with the velocities, whose common scale was not measured."
    return text + (" Forces also scale with the assumed mass of the string." if is_mass_assumed else "")


def _velocities(fit: dict[str, Any]) -> list[str]:
    """Return how well the hammer velocities are determined; only their ratios if none was measured."""
    if open_scale(fit):
        noun = "Ratios of the hammer velocities"
        entries = [entry for name, entry in fit["invariants"].items() if name.startswith(VELOCITY_RATIO)]
    else:
        noun = "Hammer velocities"
        entries = [{"interval": r["v_H0_interval"], "status": r["v_H0_status"]} for r in fit["recordings"]]
        entries = entries if len(entries) > 1 else []
    halves = [half_interval(entry) for entry in entries if entry["status"] != "not-identifiable"]
    widths = [half for half in halves if half is not None]
    return [f"{noun} (the least certain {format_relative_uncertainty(max(widths))})."] if widths else []


def is_power_law(fit: dict[str, Any]) -> bool:
    """Return whether the static force of the felt is K_H u^p; False for a user law, which the file only names."""
    law = LAWS.get(fit["felt"])
    return law is not None and law.power is not None
