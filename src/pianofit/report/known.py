"""What the data fix, in words; and the recordings that were left out, made ready for a table.

Text is plain; the page escapes it.
"""

from __future__ import annotations

import math
from typing import Any

from ..felt import LAWS
from ..numbers import is_number, number, off_by, with_half_interval, with_interval
from ..result.quantities import MEANINGS
from .words import VELOCITY_RATIO

__all__ = ["a_power", "felt_scale", "half_interval", "held_out_rows", "identified", "open_scale"]

FIXED = "Fixed by the data, as far as the brackets say (95 %)"
WITHIN, OPEN = "Fixed only if the model and its path are all there is", "Not fixed by the data"
# Half of a 95 % interval, as a logarithm, up to which what the statement takes back would else be known: a factor of 2.
LOOSE = math.log(2.0)


def identified(fit: dict[str, Any]) -> list[tuple[str, list[str]]]:
    """(Heading, sentences): the combinations that are fixed, those that rest on the model, and those that are not."""
    lists: dict[str, list[str]] = {FIXED: [*_pitch(fit), *_invariant(fit, "B"), *_invariant(fit, "x0/L")]}
    lists |= {WITHIN: [], OPEN: []}
    for name, said in (("F/M_S", _felt_force(fit)), ("M_H/M_S", _invariant(fit, "M_H/M_S"))):
        half = _half(fit, name)
        if half is not None:
            lost = fit["invariants"][name]["status"] == "not-identifiable"
            lists[FIXED if not lost else WITHIN if half <= LOOSE else OPEN] += said
    lists[FIXED] += _velocities(fit)
    return [(heading, sentences) for heading, sentences in lists.items() if sentences]


def half_interval(entry: Any) -> float | None:
    """Half of the 95 % interval of an entry's logarithm; None where there is none."""
    span = entry.get("interval") if isinstance(entry, dict) else None
    if not (isinstance(span, list | tuple) and len(span) == 2 and all(map(is_number, span)) and 0 < span[0] < span[1]):
        return None
    return 0.5 * math.log(span[1] / span[0])


def _half(fit: dict[str, Any], name: str) -> float | None:
    """Of an invariant; None of one that was given, or that the fit does not have."""
    return half_interval(fit["invariants"].get(name))


def _pitch(fit: dict[str, Any]) -> list[str]:
    half = _half(fit, "f0")
    if half is None:
        return []
    entry = fit["invariants"]["f0"]
    value, _ = with_interval(entry["value"], entry["interval"])
    return [f"Pitch: f₀ = {value} Hz (± {number(1200 * half / math.log(2), 2)} cents)."]


def _invariant(fit: dict[str, Any], name: str) -> list[str]:
    half, words = _half(fit, name), MEANINGS[name]
    if half is None:
        return []
    return [f"{words[0].upper()}{words[1:]}: {name} = {with_half_interval(fit['invariants'][name]['value'], half)}."]


def _felt_force(fit: dict[str, Any]) -> list[str]:
    """The felt's force at the compression that strokes reach: what they fix of K_H and p."""
    half = _half(fit, "F/M_S")
    if half is None:
        return []
    entry = fit["invariants"]["F/M_S"]
    said = f"{entry['note'][0].upper()}{entry['note'][1:]}, over the mass of the string: F/M_S = "
    said += with_half_interval(entry["value"], half, "N/kg")
    alone = half_interval(fit["parameters"].get("K_H"))
    if alone is not None and alone > 1.2 * half:
        said += f"; K_H alone, whose unit changes with p, is known {off_by(alone)}"
    return [f"{said}. {felt_scale(fit)}".rstrip()]


def open_scale(fit: dict[str, Any]) -> bool:
    """Whether velocities are known up to one common scale: neither one of them nor the gain was given."""
    status = fit["parameters"]["v_H0"]["status"]
    given = any("given" in (row["gain_status"], row["v_H0_status"]) for row in fit["recordings"])
    return status in ("scaled", "assumed") or (status == "not-identifiable" and not given)


def felt_scale(fit: dict[str, Any]) -> str:
    """On which assumptions newtons and millimetres of the felt rest; empty where both were given or measured."""
    mass, scale = fit["parameters"]["M_S"]["status"] == "assumed", open_scale(fit)
    if mass and scale:
        return (
            "Newtons rest on the assumed mass of the string and, as millimetres do, on the common scale of the "
            "velocities, which was not measured."
        )
    if mass:
        return "Newtons rest on the assumed mass of the string."
    return (
        "Newtons and millimetres rest on the common scale of the velocities, which was not measured." if scale else ""
    )


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
    return [f"{of} (the least certain {off_by(max(known))})."] if known else []


def a_power(fit: dict[str, Any]) -> bool:
    """Whether the felt's static force is K_H u^p; not told of a law from outside, which a file only names."""
    law = LAWS.get(fit["felt"])
    return law is not None and law.power is not None


def held_out_rows(held_out: dict[str, Any] | None) -> dict[str, Any] | None:
    """What `predict.cross_validate` returned, for the page; None without."""
    if held_out is None:
        return None
    median, worst = held_out["median_inner_db"], held_out["worst_inner_db"]
    return held_out | {"median": "" if median is None else number(median, 3), "worst": number(worst, 3)}
