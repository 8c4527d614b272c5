"""The content of `fit.json` in words: notices, sentences, lines of tables, and numbers as a reader likes them.

Every function takes the whole fit and leaves out what it does not say. Text is plain; the page escapes it.
"""

from __future__ import annotations

import math
from pathlib import PurePath
from typing import Any

from ..felt import BOXES
from ..numbers import is_number, number, with_interval

__all__ = [
    "again_in_words", "bands", "comparison", "felt_names", "glide", "groups", "how_sure", "invariants", "minima",
    "notices", "ringing", "ringing_line", "rows", "tiles",
]  # fmt: skip

STATUS = {  # word -> mark, explanation
    "fitted": ("●", "fitted to the recording"),
    "scaled": ("◐", "fitted, in units that scale with a guess"),
    "given": ("■", "given, and held"),
    "assumed": ("◇", "held at a guess; other numbers scale with it"),
    "at-bound": ("▲", "stopped at the edge of its range"),
    "not-identifiable": ("✕", "the recording does not identify it"),
}
# Pages and pictures lower what follows the "_"; what is not here is a symbol as it is.
SYMBOLS = {
    "kappa": "κ", "mu": "μ", "epsilon": "ε", "tau": "τ", "b1": "b_1", "b2": "b_2", "x0": "x_0", "x0/L": "x_0/L",
    "f0": "f_0",
}  # fmt: skip
MEANINGS = {name: parameter.meaning for name, parameter in BOXES.items()} | {
    "b1": "loss, the same for all partials",
    "b2": "loss that grows with frequency",
    "M_S": "mass of the string",
    "L": "length of the string",
    "x0": "strike position",
    "width": "width of the contact",
    "pickup": "pickup position",
}
# What no assumed length, mass or velocity scale enters.
INVARIANTS = {
    "f0": "pitch of the flexible string",
    "B": "inharmonicity",
    "M_H/M_S": "mass of the hammer over that of the string",
    "x0/L": "strike position over the length of the string",
    "F/M_S": "static force of the felt over the mass of the string",
}
# Of the paper's criterion.
BANDS = {"band1": "band 1: fundamental", "band2": "band 2: partials 2 to 8", "band3": "band 3: partials from 9"}
VELOCITY_RATIO = "v/v_ref "
# What every fit has beside its felt.
BESIDE_THE_FELT = {"c", "kappa", "b1", "b2", "M_H", "v_H0", "x0", "width", "M_S", "L", "pickup"}
# What a key can ring by, as `fit.json` names it, and in words.
RINGS_BY = {"law": "the law", "modes": "modes", "modes and knock": "modes and knock"}
UNSETTLED = (
    "The search ended before it converged. Take every number on this page as a stage on the way, not as a result."
)


def felt_names(fit: dict[str, Any]) -> list[str]:
    """The parameters of the felt's law."""
    return [name for name in fit.get("parameters", {}) if name not in BESIDE_THE_FELT]


def rows(fit: dict[str, Any]) -> list[dict[str, str]]:
    """Put the table of parameters into text, a line each."""
    return [_row(name, entry) for name, entry in fit.get("parameters", {}).items()]


def _row(name: str, entry: dict[str, Any]) -> dict[str, str]:
    status = entry.get("status") or "fitted"
    return {
        "name": SYMBOLS.get(name, name),
        "meaning": str(entry.get("meaning") or MEANINGS.get(name, "")),
        **_measured(entry),
        "initial": number(entry.get("initial")),
        "status": status,
        "mark": STATUS.get(status, ("·", ""))[0],
        "note": "; ".join(text for text in (entry.get("note"), _unbounded(entry)) if text),
    }


def _measured(entry: dict[str, Any]) -> dict[str, str]:
    """Value, unit and interval in words."""
    value, interval = with_interval(entry.get("value"), entry.get("interval"))
    unit = entry.get("unit") or ""
    return {"value": value, "unit": "" if unit == "1" else unit.replace("^p", "ᵖ"), "interval": interval}


def invariants(fit: dict[str, Any]) -> list[dict[str, str]]:
    """Put what rests on no assumed size or velocity into text, a line each."""
    return [_invariant(name, entry) for name, entry in (fit.get("invariants") or {}).items()]


def _invariant(name: str, entry: dict[str, Any]) -> dict[str, str]:
    note = str(entry.get("note") or "")
    if name.startswith(VELOCITY_RATIO):
        symbol, meaning, note = "v/v_ref", "velocity of a stroke over that of the reference", PurePath(note).name
    else:
        symbol, meaning = SYMBOLS.get(name, name), INVARIANTS.get(name, "")
    status = str(entry.get("status") or "fitted")
    return {"name": symbol, "meaning": meaning, **_measured(entry), "status": status,
            "mark": STATUS.get(status, ("·", ""))[0], "note": note}  # fmt: skip


def minima(fit: dict[str, Any]) -> dict[str, Any] | None:
    """Put the minima of the objective into text, the columns being what differs; None where there is only one."""
    found = [entry for entry in fit.get("minima") or () if isinstance(entry, dict)]
    if len(found) < 2:
        return None
    values = [entry.get("parameters") or {} for entry in found]
    # What tells one minimum's hammer from another's.
    names = [name for name in (*felt_names(fit), "M_H", "x0") if len({v.get(name) for v in values}) > 1]
    units = {name: str((fit.get("parameters", {}).get(name) or {}).get("unit") or "") for name in names}
    best = min((entry["F"] for entry in found if is_number(entry.get("F"))), default=None)
    return {
        "names": [
            (SYMBOLS.get(name, name), "" if units[name] == "1" else units[name].replace("^p", "ᵖ")) for name in names
        ],
        "rows": [
            {
                "share": _share(entry.get("share")),
                "above": number(entry["F"] - best, 2) if is_number(entry.get("F")) and is_number(best) else "–",
                "values": [number(v.get(name), 4) for name in names],
                "velocities": ", ".join(number(x, 3) for x in entry.get("velocities") or ()),
            }
            for entry, v in zip(found, values, strict=True)
        ],
    }


def _share(value: Any) -> str:
    if not is_number(value):
        return "–"
    return "< 1 %" if value < 0.005 else f"{100 * value:.0f} %"


def _unbounded(entry: dict[str, Any]) -> str:
    """Say which ends of the interval are the range's and not the recording's."""
    ends = entry.get("interval_open") or []
    if len(ends) == 2:
        return "bounded by its range alone"
    return f"{'below' if 'low' in ends else 'above'}, bounded by its range alone" if ends else ""


def how_sure(fit: dict[str, Any]) -> str:
    """Say how the intervals were found, if not by Laplace's approximation."""
    told = fit.get("diagnostics") or {}
    if told.get("profile"):
        return (
            "The intervals are profiles: each parameter was held on both sides of its value while all others followed. "
            "The felt’s band and the correlations below are those of Laplace’s approximation."
        )
    if not (posterior := told.get("posterior")):
        return ""
    each = posterior["parameters"].values()
    rhat, draws = max(x["rhat"] for x in each), min(min(x["ess_bulk"], x["ess_tail"]) for x in each)
    return (
        f"The intervals are those of the posterior: {posterior['chains']} chains of {posterior['draws']} draws, as "
        f"good as {draws:.0f} independent ones or more; R-hat is {rhat:.3f} at most (1 when the chains agree)."
    )


def notices(fit: dict[str, Any]) -> list[tuple[str, str, str]]:
    """List (tone, heading, text) of what the page says first: the claims, what went wrong, or that nothing did."""
    measured = all(entry.get("status") in ("fitted", "given") for entry in fit.get("parameters", {}).values())
    overall = fit.get("criterion", {}).get("global") or {}
    initial, final = overall.get("initial"), overall.get("final")
    worse = initial is not None and final is not None and final > initial
    converged = fit.get("converged", True)
    notices = []
    if fit.get("claims"):
        tone = ("good", "✓") if converged and measured and not worse else ("warn", "⚠")
        notices.append((tone[0], f"{tone[1]} Read this first", fit["claims"]))
    if not converged:
        notices.append(("warn", "⚠ Not converged", UNSETTLED))
    if worse:
        text = f"By the paper’s criterion the spectrum ends further off, {final:.3g}, than it began, {initial:.3g}."
        if fit.get("recipe") == "default":
            text += (
                " That is reported and not minimised: what was fitted are levels, frequencies and decays of partials."
            )
        notices.append(("warn", "⚠ Higher on the paper’s criterion", text))
    if not notices and "converged" in fit:
        mind = "" if measured else " Not every number below is measured: mind the marks beside them."
        notices.append(("good", "✓ Converged", "The search converged." + mind))
    return notices


def _change(initial: Any, final: Any) -> str:
    """How a criterion (a relative squared error) changed: as a factor, and in dB."""
    if not (is_number(initial) and is_number(final) and initial > 0 and final > 0):
        return "–"
    ratio = initial / final
    if abs(ratio - 1) < 5e-4:
        return "no change"
    words = f"{number(ratio, 3)} times smaller" if ratio > 1 else f"{number(1 / ratio, 3)} times larger"
    return f"{words} ({-10 * math.log10(ratio):+.1f} dB)".replace("-", "−")


def bands(fit: dict[str, Any]) -> list[dict[str, Any]]:
    """Put the table of the criterion into text: all bands together, then each, the dropped ones named."""
    criterion = fit.get("criterion", {})
    names = {"global": "all bands together"} | BANDS
    lines = []
    for name, label in names.items():
        entry, dropped = criterion.get(name) or {}, name in (criterion.get("dropped") or ())
        if entry or dropped:
            initial, final = entry.get("initial"), entry.get("final")
            change = "left out: no partial of it stands above the noise" if dropped else _change(initial, final)
            lines.append({"label": label, "initial": number(initial, 3), "final": number(final, 3), "change": change})
    return lines


def tiles(fit: dict[str, Any]) -> list[tuple[str, str, str]]:
    """List (what, number, explanation) of the few figures to see first, without those that are missing."""
    levels, derived, criterion = (fit.get(key, {}) for key in ("levels", "derived", "criterion"))
    overall = criterion.get("global") or {}
    moves, count, start = glide(fit), levels.get("partials", "all"), overall.get("initial")
    again = again_in_words(derived.get("later_contacts"))
    force, depth = number(derived.get("max_force_N"), 3), number(derived.get("max_compression_mm"), 3)
    tiles = (
        ("Error of the partials’ levels", levels.get("fitted_db"), 2, "dB",
         f"{number(levels.get('initial_db'), 2)} dB at the start; rms over {count} partials"),
        ("Criterion", overall.get("final"), 3, "",
         f"{number(start, 3)} at the start, {_change(start, overall.get('final'))}"),
        ("Pitch f₀", derived.get("f0"), 5, "Hz",
         f"inharmonicity B = {number(derived.get('B'), 3)}" + (f"; it {moves} as the note decays" if moves else "")),
        ("Contact of the hammer", derived.get("contact_ms"), 3, "ms",
         f"up to {force} N, felt pressed in by {depth} mm" + (f"; {again}" if again else "")),
    )  # fmt: skip
    return [
        (what, f"{number(value, digits)} {unit}", explanation)
        for what, value, digits, unit, explanation in tiles
        if is_number(value)
    ]


def again_in_words(contacts: Any) -> str:
    """Say how often, when and how hard the hammer touches the string after its first contact; empty if it does not."""
    found = [c for c in contacts or () if isinstance(c, dict) and all(map(is_number, c.values()))]
    if not found:
        return ""
    first, last = found[0], found[-1]
    hardest = number(max(c["max_force_N"] for c in found), 2)
    if len(found) == 1:
        end = number(first["start_ms"] + first["duration_ms"], 3)
        return f"touches again from {number(first['start_ms'], 3)} to {end} ms, with up to {hardest} N"
    return (
        f"touches again {len(found)} times, from {number(first['start_ms'], 3)} ms to "
        f"{number(last['start_ms'] + last['duration_ms'], 3)} ms, with up to {hardest} N"
    )


def glide(fit: dict[str, Any]) -> str:
    """Say how the pitch moves while the note decays; empty where that is not known, or is nothing."""
    cents = fit.get("derived", {}).get("glide_cents")
    if not is_number(cents) or f"{abs(cents):.1f}" == "0.0":
        return ""
    return f"{'falls' if cents >= 0 else 'rises'} by {abs(cents):.1f} cents"


def groups(fit: dict[str, Any]) -> list[tuple[str, str, str, list[str]]]:
    """List (status, mark, explanation, symbols) of each status that occurs."""
    found = [(str(SYMBOLS.get(name, name)), entry.get("status")) for name, entry in fit.get("parameters", {}).items()]
    groups = [(word, *STATUS[word], [symbol for symbol, status in found if status == word]) for word in STATUS]
    return [group for group in groups if group[-1]]


def comparison(fit: dict[str, Any]) -> str:
    """Set the fit beside what an unknown path can do without it; empty where that was not tried."""
    path, fitted = (fit.get("levels", {}).get(key) for key in ("path_only_db", "fitted_db"))
    if not (is_number(path) and is_number(fitted)):
        return ""
    if path > fitted + 0.1:
        meaning = "The fitted hammer explains more of the levels than a path alone."
    else:
        meaning = "A path alone does as well: these levels say nothing for the fitted hammer."
    return (
        f"A smooth output path alone, with a hammer from the literature, would leave an error of {path:.1f} dB in the "
        f"partials’ levels; the fit leaves {fitted:.1f} dB. {meaning}"
    )


def ringing(fit: dict[str, Any]) -> str:
    """Say what the key rings by, and how that was decided; empty where nothing is said of it."""
    said = fit.get("ringing") or {}
    by, away = said.get("by"), _left_out(said)
    if by not in RINGS_BY:
        return ""
    if away is None:
        return f"It rings by {_modes(said)}. One recording through its path: not tested on another stroke."
    law, modes, knock = (f"{x:.1f}" for x in away.values())
    tested = (
        f"Played with the patterns and the knock of the others, layers are {law} dB from their recordings by the "
        f"string’s law, {modes} by its modes, and {knock} by modes and knock"
    )
    if by == "law":
        return f"{tested}. What other layers show brings a layer no nearer to its recording, so it rings by the law."
    return f"{tested}; so it rings by {_modes(said)}."


def ringing_line(fit: dict[str, Any]) -> str:
    """Say the same in a line for a terminal."""
    said = fit.get("ringing") or {}
    by, away = said.get("by"), _left_out(said)
    if by not in RINGS_BY:
        return ""
    line = f"rings by {RINGS_BY[by] if by == 'law' else _modes(said)}"
    if away is None:
        return f"{line}; one recording through its path: not tested on another stroke"
    others = ", ".join(f"{x:.1f} by {RINGS_BY[name]}" for name, x in away.items() if name != by)
    return f"{line}: {away[by]:.1f} dB from layers left out ({others})"


def _modes(said: dict[str, Any]) -> str:
    """How many modes, with the knock if there is one."""
    found = said.get("modes")
    count = len(found.get("partial") or ()) if isinstance(found, dict) else 0
    return f"{count} modes" + (" and a knock" if said.get("by") == "modes and knock" else "")


def _left_out(said: dict[str, Any]) -> dict[str, float] | None:
    """Distances of layers left out, dB, by what they ring by; None where none was left out."""
    away = said.get("left_out_db")
    if not (isinstance(away, dict) and all(is_number(away.get(name)) for name in RINGS_BY)):
        return None
    return {name: away[name] for name in RINGS_BY}
