"""The content of `fit.json` in words: notices, sentences, lines of tables, and numbers as a reader likes them.

Every function takes what this version writes; the paper's recipes leave some of it empty. Text is plain; the page
escapes it.
"""

from __future__ import annotations

import math
from pathlib import PurePath
from typing import TYPE_CHECKING, Any

from ..io.number_format import counted, number, with_interval

if TYPE_CHECKING:
    from ..result.quantities import Quantity

__all__ = [
    "recontact_text", "bands", "comparison", "glide", "groups", "interval_method_text", "minima", "notices",
    "ringing", "ringing_line", "rows", "summary_tiles", "unit_in_words",
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


def rows(table: dict[str, Any]) -> list[dict[str, str]]:
    """Put parameters or invariants into text, a line each."""
    from ..result.quantities import Quantities

    return [_row(quantity) for quantity in Quantities.of(table).values()]


def _row(it: Quantity) -> dict[str, str]:
    value, interval = with_interval(it.value, it.interval)
    ratio = it.name.startswith(VELOCITY_RATIO)
    note = PurePath(it.note).name if ratio else it.note
    return {
        "name": "v/v_ref" if ratio else SYMBOLS.get(it.name, it.name), "meaning": it.meaning,
        "value": value, "unit": unit_in_words(it.unit), "interval": interval, "initial": number(it.initial),
        "status": it.status, "mark": STATUS[it.status][0], "note": "; ".join(filter(None, (note, _unbounded(it)))),
    }  # fmt: skip


def unit_in_words(unit: str) -> str:
    """A unit for a reader: empty for a pure number, p raised."""
    return "" if unit == "1" else unit.replace("^p", "ᵖ")


def minima(fit: dict[str, Any]) -> dict[str, Any] | None:
    """Put the minima of the objective into text, the columns being what differs; None where there is only one."""
    found = fit["minima"]
    if len(found) < 2:
        return None
    # What tells one minimum's hammer from another's.
    felt = [name for name in fit["parameters"] if name not in BESIDE_THE_FELT]
    names = [n for n in (*felt, "M_H", "x0") if len({one["parameters"].get(n) for one in found}) > 1]
    best = min(one["F"] for one in found)
    return {
        "names": [(SYMBOLS.get(name, name), unit_in_words(fit["parameters"][name]["unit"])) for name in names],
        "rows": [
            {
                "share": _share(one["share"]),
                "above": number(one["F"] - best, 2),
                "values": [number(one["parameters"].get(name), 4) for name in names],
                "velocities": ", ".join(number(x, 3) for x in one["velocities"]),
            }
            for one in found
        ],
    }


def _share(value: float) -> str:
    return "< 1 %" if value < 0.005 else f"{100 * value:.0f} %"


def _unbounded(it: Quantity) -> str:
    """Say which ends of the interval are the range's and not the recording's."""
    open_at = it.interval_open
    where = "" if len(open_at) == 2 else "below, " if "low" in open_at else "above, "
    return f"{where}bounded by its range alone" if open_at else ""


def interval_method_text(fit: dict[str, Any]) -> str:
    """Say how the intervals were found, if not by Laplace's approximation."""
    told = fit["diagnostics"]
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
    measured = all(entry["status"] in ("fitted", "given") for entry in fit["parameters"].values())
    initial, final = (fit["criterion"]["global"][at] for at in ("initial", "final"))
    worse, converged = final > initial, fit["converged"]
    notices = []
    if fit["claims"]:
        tone = ("good", "✓") if converged and measured and not worse else ("warn", "⚠")
        notices.append((tone[0], f"{tone[1]} Read this first", fit["claims"]))
    if not converged:
        notices.append(("warn", "⚠ Not converged", UNSETTLED))
    if worse:
        text = f"By the paper’s criterion the spectrum ends further off, {final:.3g}, than it began, {initial:.3g}."
        if fit["recipe"] == "default":
            text += (
                " That is reported and not minimised: what was fitted are levels, frequencies and decays of partials."
            )
        notices.append(("warn", "⚠ Higher on the paper’s criterion", text))
    if not notices:
        mind = "" if measured else " Not every number below is measured: mind the marks beside them."
        notices.append(("good", "✓ Converged", "The search converged." + mind))
    return notices


def _change(initial: float, final: float) -> str:
    """How a criterion (a relative squared error) changed: as a factor, and in dB."""
    if not (initial > 0 and final > 0):
        return "–"
    ratio = initial / final
    if abs(ratio - 1) < 5e-4:
        return "no change"
    words = f"{number(ratio, 3)} times smaller" if ratio > 1 else f"{number(1 / ratio, 3)} times larger"
    return f"{words} ({-10 * math.log10(ratio):+.1f} dB)".replace("-", "−")


def bands(fit: dict[str, Any]) -> list[dict[str, Any]]:
    """Put the table of the criterion into text: all bands together, then each, the dropped ones named."""
    criterion, lines = fit["criterion"], []
    for name, label in ({"global": "all bands together"} | BANDS).items():
        entry = criterion.get(name)
        if entry is not None:
            initial, final = entry["initial"], entry["final"]
            lines.append({"label": label, "initial": number(initial, 3), "final": number(final, 3),
                          "change": _change(initial, final)})  # fmt: skip
        elif name in criterion["dropped"]:
            change = "left out: no partial of it stands above the noise"
            lines.append({"label": label, "initial": "–", "final": "–", "change": change})
    return lines


def summary_tiles(fit: dict[str, Any]) -> list[tuple[str, str, str]]:
    """List (what, number, explanation) of the few figures to see first."""
    levels, derived, overall = fit["levels"], fit["derived"], fit["criterion"]["global"]
    moves, count = glide(fit), len(fit["recordings"])
    again = recontact_text(derived["later_contacts"])
    force, depth = number(derived["max_force_N"], 3), number(derived["max_compression_mm"], 3)
    return [
        ("Error of the partials’ levels", f"{number(levels['fitted_db'], 2)} dB",
         f"{number(levels['initial_db'], 2)} dB at the start; rms over {levels['partials']} levels of partials"
         + (f" in {count} recordings" if count > 1 else "")),
        ("Criterion", number(overall["final"], 3),
         f"{number(overall['initial'], 3)} at the start, {_change(overall['initial'], overall['final'])}"),
        ("Pitch f₀", f"{number(derived['f0'], 5)} Hz",
         f"inharmonicity B = {number(derived['B'], 3)}" + (f"; it {moves} as the note decays" if moves else "")),
        ("Contact of the hammer", f"{number(derived['contact_ms'], 3)} ms",
         f"up to {force} N, felt pressed in by {depth} mm" + (f"; {again}" if again else "")),
    ]  # fmt: skip


def recontact_text(found: list[dict[str, float]]) -> str:
    """Say how often, when and how hard the hammer touches the string after its first contact; empty if it does not."""
    if not found:
        return ""
    start, end = number(found[0]["start_ms"], 3), number(found[-1]["start_ms"] + found[-1]["duration_ms"], 3)
    times = f"from {start}" if len(found) == 1 else f"{len(found)} times, from {start} ms"
    hardest = number(max(contact["max_force_N"] for contact in found), 2)
    return f"touches again {times} to {end} ms, with up to {hardest} N"


def glide(fit: dict[str, Any]) -> str:
    """Say how the pitch moves while the note decays; empty where that is nothing."""
    cents = fit["derived"]["glide_cents"]
    if f"{abs(cents):.1f}" == "0.0":
        return ""
    return f"{'falls' if cents >= 0 else 'rises'} by {abs(cents):.1f} cents"


def groups(fit: dict[str, Any]) -> list[tuple[str, str, str, list[str]]]:
    """List (status, mark, explanation, symbols) of each status that occurs."""
    found = [(SYMBOLS.get(name, str(name)), entry["status"]) for name, entry in fit["parameters"].items()]
    groups = [(word, *STATUS[word], [symbol for symbol, status in found if status == word]) for word in STATUS]
    return [group for group in groups if group[-1]]


def comparison(fit: dict[str, Any]) -> str:
    """Set the fit beside what velocities and an unknown path can do without it; empty where that was not tried."""
    path, fitted = (fit["levels"][key] for key in ("path_only_db", "fitted_db"))
    if path is None:
        return ""
    meaning = "It does as well: these levels say nothing for the fitted hammer."
    if path > fitted + 0.1:
        meaning = "The fitted hammer explains more of the levels."
    return (
        f"The initial hammer, at velocities and through a gain and path that suit it, leaves an error of "
        f"{path:.1f} dB in the partials’ levels; the fitted one leaves {fitted:.1f} dB. {meaning}"
    )


def ringing(said: dict[str, Any]) -> str:
    """Say what the key rings by, and how that was decided."""
    away = said["left_out_db"]
    if away is None:
        return f"It rings by {_modes(said)}. One recording through its path: not tested on another stroke."
    law, modes, knock = (f"{away[name]:.1f}" for name in RINGS_BY)
    tested = (
        f"Played with the patterns and the knock of the others, layers are {law} dB from their recordings by the "
        f"string’s law, {modes} by its modes, and {knock} by modes and knock"
    )
    if said["by"] == "law":
        return f"{tested}. What other layers show brings a layer no nearer to its recording, so it rings by the law."
    return f"{tested}; so it rings by {_modes(said)}."


def ringing_line(said: dict[str, Any]) -> str:
    """Say the same in a line for a terminal."""
    by, away = said["by"], said["left_out_db"]
    line = f"rings by {RINGS_BY[by] if by == 'law' else _modes(said)}"
    if away is None:
        return f"{line}; one recording through its path: not tested on another stroke"
    others = ", ".join(f"{away[name]:.1f} by {words}" for name, words in RINGS_BY.items() if name != by)
    return f"{line}: {away[by]:.1f} dB from layers left out ({others})"


def _modes(said: dict[str, Any]) -> str:
    """How many modes, with the knock if there is one."""
    return counted(len(said["modes"]["partial"]), "mode") + (" and a knock" if said["by"] == "modes and knock" else "")
