"""What the data fix, in words. Text is plain; the page escapes it."""

from __future__ import annotations

import math
from typing import Any

from ..felt import LAWS
from ..io.number_format import format_relative_uncertainty, is_number, number, with_half_interval, with_interval
from ..result.quantities import MEANINGS
from .text import VELOCITY_RATIO

__all__ = ["is_power_law", "felt_scale", "half_interval", "identifiability_sections", "open_scale"]

FIXED = "Fixed by the data, as far as the brackets say (95 %)"
WITHIN, OPEN = "Fixed only if the model and its path are all there is", "Not fixed by the data"
# Half of a 95 % interval, as a logarithm, up to which what the statement takes back would else be known: a factor of 2.
LOOSE = math.log(2.0)
# What the statement may take back.
OF_THE_HAMMER = ("F/M_S", "M_H/M_S")


def identifiability_sections(fit: dict[str, Any]) -> list[tuple[str, list[str]]]:
    """(Heading, sentences): the combinations that are fixed, those that rest on the model, and those that are not."""
    says = {"f0": _pitch, "B": _invariant, "x0/L": _invariant, "F/M_S": _felt_force, "M_H/M_S": _invariant}
    lists: dict[str, list[str]] = {FIXED: [], WITHIN: [], OPEN: []}
    for name, say in says.items():
        half = half_interval(fit["invariants"].get(name))
        if half is not None:  # it was not given, and this fit has it
            lost = name in OF_THE_HAMMER and fit["invariants"][name]["status"] == "not-identifiable"
            lists[FIXED if not lost else WITHIN if half <= LOOSE else OPEN].append(say(fit, name, half))
    lists[FIXED] += _velocities(fit)
    return [(heading, sentences) for heading, sentences in lists.items() if sentences]


def half_interval(entry: Any) -> float | None:
    """Half of the 95 % interval of an entry's logarithm; None where there is none."""
    span = entry.get("interval") if isinstance(entry, dict) else None
    if not (isinstance(span, list | tuple) and len(span) == 2 and all(map(is_number, span)) and 0 < span[0] < span[1]):
        return None
    return 0.5 * math.log(span[1] / span[0])


def _pitch(fit: dict[str, Any], name: str, half: float) -> str:
    entry = fit["invariants"][name]
    value, _ = with_interval(entry["value"], entry["interval"])
    return f"Pitch: f₀ = {value} Hz (± {number(1200 * half / math.log(2), 2)} cents)."


def _invariant(fit: dict[str, Any], name: str, half: float) -> str:
    words = MEANINGS[name]
    return f"{words[0].upper()}{words[1:]}: {name} = {with_half_interval(fit['invariants'][name]['value'], half)}."


def _felt_force(fit: dict[str, Any], name: str, half: float) -> str:
    """The felt's force at the compression that strokes reach: what they fix of K_H and p."""
    entry = fit["invariants"][name]
    said = f"{entry['note'][0].upper()}{entry['note'][1:]}, over the mass of the string: {name} = "
    said += with_half_interval(entry["value"], half, "N/kg")
    alone = half_interval(fit["parameters"].get("K_H"))
    if alone is not None and alone > 1.2 * half:
        said += f"; K_H alone, whose unit changes with p, is known {format_relative_uncertainty(alone)}"
    return f"{said}. {felt_scale(fit)}".rstrip()


def open_scale(fit: dict[str, Any]) -> bool:
    """Whether velocities are known up to one common scale: neither one of them nor the gain was given."""
    status = fit["parameters"]["v_H0"]["status"]
    given = any("given" in (row["gain_status"], row["v_H0_status"]) for row in fit["recordings"])
    return status in ("scaled", "assumed") or (status == "not-identifiable" and not given)


def felt_scale(fit: dict[str, Any]) -> str:
    """On which assumptions newtons and millimetres of the felt rest; empty where both were given or measured."""
    mass, scale = fit["parameters"]["M_S"]["status"] == "assumed", open_scale(fit)
    if not scale:
        return "Newtons rest on the assumed mass of the string." if mass else ""
    which = "rest on the assumed mass of the string and, as millimetres do," if mass else "and millimetres rest"
    return f"Newtons {which} on the common scale of the velocities, which was not measured."


def _velocities(fit: dict[str, Any]) -> list[str]:
    """How well the strokes' velocities are known; without a measured one, their ratios."""
    if open_scale(fit):
        of = "Ratios of the strokes’ velocities"
        entries = [entry for name, entry in fit["invariants"].items() if name.startswith(VELOCITY_RATIO)]
    else:
        of = "Velocities of the strokes"
        entries = [{"interval": r["v_H0_interval"], "status": r["v_H0_status"]} for r in fit["recordings"]]
        entries = entries if len(entries) > 1 else []
    halves = [half_interval(entry) for entry in entries if entry["status"] != "not-identifiable"]
    known = [half for half in halves if half is not None]
    return [f"{of} (the least certain {format_relative_uncertainty(max(known))})."] if known else []


def is_power_law(fit: dict[str, Any]) -> bool:
    """Whether the felt's static force is K_H u^p; not told of a law from outside, which a file only names."""
    law = LAWS.get(fit["felt"])
    return law is not None and law.power is not None
