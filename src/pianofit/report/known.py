"""What the data fix and what they do not, in words; and the takes that were left out, made ready for a table.

Every function takes what came from a file and leaves out what it does not say. Text is plain; the page escapes it.
"""

from __future__ import annotations

import math
from typing import Any

from ..parameters import DEFAULT_LAW, FELT_LAWS
from .curves import Known
from .words import number

__all__ = ["felt_scale", "held_out_rows", "told"]

FELT = ("K_H", "mu", "p", "epsilon", "tau")
FIXED = "Fixed by the data, as far as the brackets say (95 %)"
WITHIN, OPEN = "Fixed only if the model and its path are all there is", "Not fixed by the data"
# Half of a 95 % interval, as a logarithm, up to which a combination counts as fixed at all: a factor of two.
LOOSE = math.log(2.0)


def told(fit: dict[str, Any], known: Known | None) -> list[tuple[str, list[str]]]:
    """(Heading, sentences): the combinations that are fixed, those that rest on the model, and what is not."""
    reach = {} if known is None else {name: reach for name, reach, _ in known.reaches}
    lists: dict[str, list[str]] = {FIXED: _string(fit, reach), WITHIN: [], OPEN: []}
    felt = _felt_force(fit, reach)
    if felt:
        lists[OPEN if reach["F"] > LOOSE else WITHIN if _doubted(fit) else FIXED].append(felt)
    mass = _ratio(fit, reach, "M_H/M_S", "Mass of the hammer over that of the string")
    if mass:
        lost = _status(fit, "M_H") == "not-identifiable"
        lists[OPEN if reach["M_H/M_S"] > LOOSE else WITHIN if lost else FIXED].append(mass)
    lists[FIXED] += _velocities(fit)
    lists[OPEN] += _not_told(fit)
    return [(heading, sentences) for heading, sentences in lists.items() if sentences]


def _status(fit: dict[str, Any], name: str) -> str:
    return (fit.get("parameters", {}).get(name) or {}).get("status") or ""


def _plain(name: Any) -> str:
    return {"kappa": "κ", "mu": "μ", "epsilon": "ε", "tau": "τ"}.get(str(name), str(name))


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _within(reach: float) -> str:
    """How far off: per cent while that is small, then a factor."""
    if reach < 0.2:
        return f"± {number(100 * reach, 2)} %"
    return f"to a factor of {float(f'{math.exp(reach):.2g}'):g}" if reach < 10 else "to many powers of ten"


def _string(fit: dict[str, Any], reach: dict[str, float]) -> list[str]:
    f0, B, said = fit.get("derived", {}).get("f0"), fit.get("derived", {}).get("B"), []
    if _is_number(f0) and "f0" in reach:
        said.append(f"Pitch: f₀ = {number(f0, 5)} Hz (± {number(1200 * reach['f0'] / math.log(2), 2)} cents).")
    if _is_number(B) and "B" in reach:
        said.append(f"Inharmonicity: B = {number(B, 3)} ({_within(reach['B'])}).")
    position = _ratio(fit, reach, "x0/L", "Strike position over the length of the string")
    return [*said, position] if position else said


def _ratio(fit: dict[str, Any], reach: dict[str, float], key: str, words: str) -> str:
    value = fit.get("derived", {}).get(key)
    return f"{words}: {key} = {number(value, 3)} ({_within(reach[key])})." if _is_number(value) and key in reach else ""


def _felt_force(fit: dict[str, Any], reach: dict[str, float]) -> str:
    """The felt's force at the largest compression: what a strike fixes of K_H and p."""
    force, depth = (fit.get("derived", {}).get(key) for key in ("felt_force_N", "max_compression_mm"))
    if not (_is_number(force) and _is_number(depth) and "F" in reach):
        return ""
    said = f"Static force of the felt at the largest compression, {number(depth, 3)} mm: {number(force, 3)} N "
    said += f"({_within(reach['F'])})"
    if reach.get("K_H", 0.0) > 1.2 * reach["F"]:
        said += f"; K_H alone, whose unit changes with p, is known {_within(reach['K_H'])}"
    return f"{said}. {felt_scale(fit)}".rstrip()


def felt_scale(fit: dict[str, Any]) -> str:
    """On which assumptions newtons and millimetres of the felt rest; empty where both were given or measured."""
    mass, velocity = (_status(fit, name) == "assumed" for name in ("M_S", "v_H0"))
    if mass and velocity:
        return "Newtons rest on the assumed mass of the string and the assumed velocity, millimetres on the velocity."
    if mass:
        return "Newtons rest on the assumed mass of the string."
    return "Newtons and millimetres rest on the assumed hammer velocity." if velocity else ""


def _doubted(fit: dict[str, Any]) -> bool:
    """Whether the verdict takes back what the intervals say of the felt: then nothing of it counts as told."""
    parameters = fit.get("parameters", {})
    states = [_status(fit, name) for name in FELT if (parameters.get(name) or {}).get("interval")]
    return bool(states) and all(state == "not-identifiable" for state in states)


def _velocities(fit: dict[str, Any]) -> list[str]:
    """How well the takes' velocities are known; with one assumed, these are ratios to it."""
    spans = [take.get("v_H0_interval") for take in fit.get("takes") or ()]
    ratios = [high / low for low, high in filter(None, spans) if _is_number(low) and _is_number(high) and low > 0]
    if len(spans) < 2 or not ratios:
        return []
    reach = 0.5 * math.log(max(ratios))
    of = "Ratios of the takes’ velocities" if _status(fit, "v_H0") == "assumed" else "Velocities of the takes"
    return [f"{of} (the least certain {_within(reach)})."] if reach <= LOOSE else []


def _not_told(fit: dict[str, Any]) -> list[str]:
    """What the recording leaves open: single values, values of the box, pairs, scales."""
    said = []
    for status, words in (
        ("not-identifiable", "Not identifiable by themselves: {}."),
        ("at-bound", "At the edge of their range, so the range’s value and not the data’s: {}."),
    ):
        names = [_plain(name) for name in fit.get("parameters", {}) if _status(fit, name) == status]
        said += [words.format(", ".join(names))] if names else []
    for entry in fit.get("diagnostics", {}).get("correlated") or ():
        pair, r = entry.get("pair") or (), entry.get("correlation")
        if len(pair) == 2 and _is_number(r):
            way = "together" if r > 0 else "against each other"
            a, b = map(_plain, pair)
            said.append(f"{a} and {b} apart: they can move {way} (correlation {r:+.4f}).".replace("-", "−"))
    if _status(fit, "v_H0") == "assumed":
        loses = "mu" in FELT_LAWS.get(fit.get("felt", ""), FELT_LAWS[DEFAULT_LAW])
        also, stay = (", μ", "K_H v_H0ᵖ⁻¹ and μ v_H0 stay") if loses else ("", "K_H v_H0ᵖ⁻¹ stays")
        said.append(
            f"The hammer velocity: with another one K_H{also} and the gain change along, so that {stay}, and nothing "
            "sounds different."
        )
    assumed = [words for name, words in (("L", "length"), ("M_S", "mass")) if _status(fit, name) == "assumed"]
    if assumed:
        them = "them" if len(assumed) > 1 else "it"
        said.append(f"The string’s {' and '.join(assumed)}: only ratios to {them} are heard.")
    return said


def held_out_rows(held_out: dict[str, Any] | None) -> dict[str, Any] | None:
    """What `predict.cross_validate` returned, for the page; None without takes."""
    takes = [take for take in (held_out or {}).get("takes") or () if isinstance(take, dict)]
    if held_out is None or not takes:
        return None
    numbers = ("v_H0", "predicted_v_H0", "partials", "predicted_db", "nearest_db", "blend_db")
    median, worst = (held_out.get(key) for key in ("median_inner_db", "worst_inner_db"))
    shown = _is_number(median) and _is_number(worst)
    return {
        "takes": [
            {"file": str(take.get("file") or "")}
            | {n: take.get(n) if _is_number(take.get(n)) else None for n in numbers}
            for take in takes
        ],
        "messages": [str(message) for message in held_out.get("messages") or ()],
        "median": number(median, 3) if shown else "",
        "worst": number(worst, 3) if shown else "",
    }
