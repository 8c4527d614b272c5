"""What the data fix and what they do not, in words; and the recordings that were left out, made ready for a table.

Every function takes what came from a file and leaves out what it does not say. Text is plain; the page escapes it.
"""

from __future__ import annotations

import math
from typing import Any

from ..felt import DEFAULT_LAW, LAWS, FeltLaw
from ..numbers import is_number, number
from .words import INVARIANTS, SYMBOLS, VELOCITY_RATIO

__all__ = ["a_power", "felt_scale", "half_interval", "held_out_rows", "identified", "open_scale"]

FIXED = "Fixed by the data, as far as the brackets say (95 %)"
WITHIN, OPEN = "Fixed only if the model and its path are all there is", "Not fixed by the data"
# Half of a 95 % interval, as a logarithm, up to which what the statement takes back would else be known: a factor of 2.
LOOSE = math.log(2.0)


def identified(fit: dict[str, Any]) -> list[tuple[str, list[str]]]:
    """(Heading, sentences): the combinations that are fixed, those that rest on the model, and what is not."""
    lists: dict[str, list[str]] = {FIXED: _string(fit), WITHIN: [], OPEN: []}
    for name, said in (("F/M_S", _felt_force(fit)), ("M_H/M_S", _ratio(fit, "M_H/M_S"))):
        if said:
            lost = (fit["invariants"][name].get("status") or "") == "not-identifiable"
            lists[FIXED if not lost else WITHIN if _reach(fit, name) <= LOOSE else OPEN].append(said)
    lists[FIXED] += _velocities(fit)
    lists[OPEN] += _not_told(fit)
    return [(heading, sentences) for heading, sentences in lists.items() if sentences]


def _status(fit: dict[str, Any], name: str) -> str:
    return (fit.get("parameters", {}).get(name) or {}).get("status") or ""


def _plain(name: Any) -> str:
    """A symbol in running text."""
    return SYMBOLS[name].replace("_", "") if name in SYMBOLS else str(name)


def half_interval(entry: Any) -> float | None:
    """Half of the 95 % interval of an entry's logarithm; None where there is none."""
    span = entry.get("interval") if isinstance(entry, dict) else None
    if not (isinstance(span, list | tuple) and len(span) == 2 and all(map(is_number, span)) and 0 < span[0] < span[1]):
        return None
    return 0.5 * math.log(span[1] / span[0])


def _reach(fit: dict[str, Any], name: str) -> float:
    """Of an invariant; infinite where there is none."""
    reach = half_interval((fit.get("invariants") or {}).get(name))
    return math.inf if reach is None else reach


def _value(fit: dict[str, Any], name: str) -> Any:
    return ((fit.get("invariants") or {}).get(name) or {}).get("value")


def _shown(fit: dict[str, Any], name: str) -> bool:
    """Whether an invariant was fitted: what was given has no interval."""
    return is_number(_value(fit, name)) and math.isfinite(_reach(fit, name))


def _within(reach: float) -> str:
    """How far off: per cent while that is small, then a factor."""
    if reach < 0.2:
        return f"± {number(100 * reach, 2)} %"
    return f"to a factor of {float(f'{math.exp(reach):.2g}'):g}" if reach < 10 else "to many powers of ten"


def _string(fit: dict[str, Any]) -> list[str]:
    said = []
    if _shown(fit, "f0"):
        cents = 1200 * _reach(fit, "f0") / math.log(2)
        said.append(f"Pitch: f₀ = {number(_value(fit, 'f0'), 5)} Hz (± {number(cents, 2)} cents).")
    if _shown(fit, "B"):
        said.append(f"Inharmonicity: B = {number(_value(fit, 'B'), 3)} ({_within(_reach(fit, 'B'))}).")
    position = _ratio(fit, "x0/L")
    return [*said, position] if position else said


def _ratio(fit: dict[str, Any], name: str) -> str:
    if not _shown(fit, name):
        return ""
    words = INVARIANTS[name]
    return f"{words[0].upper()}{words[1:]}: {name} = {number(_value(fit, name), 3)} ({_within(_reach(fit, name))})."


def _felt_force(fit: dict[str, Any]) -> str:
    """The felt's force at the compression that strokes reach: what they fix of K_H and p."""
    if not _shown(fit, "F/M_S"):
        return ""
    reach, entry = _reach(fit, "F/M_S"), fit["invariants"]["F/M_S"]
    where = str(entry.get("note") or "").removeprefix("static force of the felt ")
    said = f"Static force of the felt{f' {where}' if where else ''}, over the mass of the string: F/M_S = "
    said += f"{number(entry['value'], 3)} N/kg ({_within(reach)})"
    alone = half_interval(fit.get("parameters", {}).get("K_H"))
    if alone is not None and alone > 1.2 * reach:
        said += f"; K_H alone, whose unit changes with p, is known {_within(alone)}"
    return f"{said}. {felt_scale(fit)}".rstrip()


def open_scale(fit: dict[str, Any]) -> bool:
    """Whether velocities are known up to one common scale: neither one of them nor the gain was given."""
    if _status(fit, "v_H0") in ("scaled", "assumed"):
        return True
    recordings = fit.get("recordings") or ()
    given = any("given" in (recording.get("gain_status"), recording.get("v_H0_status")) for recording in recordings)
    return _status(fit, "v_H0") == "not-identifiable" and not given


def felt_scale(fit: dict[str, Any]) -> str:
    """On which assumptions newtons and millimetres of the felt rest; empty where both were given or measured."""
    mass, scale = _status(fit, "M_S") == "assumed", open_scale(fit)
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
        entries = [entry for name, entry in (fit.get("invariants") or {}).items() if name.startswith(VELOCITY_RATIO)]
    else:
        of = "Velocities of the strokes"
        recordings = fit.get("recordings") or ()
        entries = [{"interval": r.get("v_H0_interval"), "status": r.get("v_H0_status")} for r in recordings]
        entries = entries if len(entries) > 1 else []
    entries = [entry for entry in entries if entry.get("status") != "not-identifiable"]
    reaches = [reach for entry in entries if (reach := half_interval(entry)) is not None]
    return [f"{of} (the least certain {_within(max(reaches))})."] if reaches else []


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
        if len(pair) == 2 and is_number(r):
            way = "together" if r > 0 else "against each other"
            a, b = map(_plain, pair)
            said.append(f"{a} and {b} apart: they can move {way} (correlation {r:+.4f}).".replace("-", "−"))
    if open_scale(fit):
        said.append(
            f"The common scale of the velocities: with all of them faster, {_scaled(fit)}, and nothing sounds "
            "different. The intervals of these are those of the prior."
        )
    assumed = [words for name, words in (("L", "length"), ("M_S", "mass")) if _status(fit, name) == "assumed"]
    if assumed:
        them = "them" if len(assumed) > 1 else "it"
        said.append(f"The string’s {' and '.join(assumed)}: only ratios to {them} are heard.")
    return said


def _law(fit: dict[str, Any]) -> FeltLaw | None:
    """The felt's law; None for one from outside, which a file only names."""
    return LAWS.get(str(fit.get("felt") or DEFAULT_LAW.name))


def a_power(fit: dict[str, Any]) -> bool:
    """Whether the felt's static force is K_H u^p."""
    law = _law(fit)
    return law is not None and law.power is not None


def _scaled(fit: dict[str, Any]) -> str:
    """What follows a common scale of the velocities."""
    law = _law(fit)
    if law is None or law.power is None:
        return "the gain changes along, as does every parameter of the felt with m or N in its unit"
    also, stay = (", μ", "K_H vᵖ⁻¹ and μ v stay") if "mu" in law.parameters else ("", "K_H vᵖ⁻¹ stays")
    return f"K_H{also} and the gain change along, so that {stay}"


def held_out_rows(held_out: dict[str, Any] | None) -> dict[str, Any] | None:
    """What `predict.cross_validate` returned, for the page; None without recordings."""
    recordings = [recording for recording in (held_out or {}).get("recordings") or () if isinstance(recording, dict)]
    if held_out is None or not recordings:
        return None
    numbers = ("v_H0", "predicted_v_H0", "partials", "predicted_db", "nearest_db", "blend_db")
    median, worst = (held_out.get(key) for key in ("median_inner_db", "worst_inner_db"))
    shown = is_number(median) and is_number(worst)
    return {
        "recordings": [
            {"file": str(recording.get("file") or "")}
            | {n: recording.get(n) if is_number(recording.get(n)) else None for n in numbers}
            for recording in recordings
        ],
        "messages": [str(message) for message in held_out.get("messages") or ()],
        "median": number(median, 3) if shown else "",
        "worst": number(worst, 3) if shown else "",
    }
