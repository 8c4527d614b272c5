"""The content of `fit.json` as text for the page: notices, sentences, rows of tables and formatted numbers.

Every function takes the content of a `fit.json` of this version. The recipes of the paper leave some entries empty.
Text is plain; the page escapes it.
"""

from __future__ import annotations

import math
from pathlib import PurePath
from typing import TYPE_CHECKING, Any

from ..io.number_format import counted, number, with_interval

if TYPE_CHECKING:
    from ..result.quantities import Quantity

__all__ = [
    "bands", "comparison", "format_unit", "glide", "groups", "interval_method_text", "minima", "modal_response_text",
    "notices", "recontact_text", "modal_response_line", "rows", "summary_tiles",
]  # fmt: skip

STATUS = {  # status -> mark, explanation
    "fitted": ("●", "estimated from the recording"),
    "scaled": ("◐", "estimated, but scales with an assumed value"),
    "given": ("■", "fixed at the given value"),
    "assumed": ("◇", "fixed at an assumed value; other values scale with it"),
    "at-bound": ("▲", "at a search bound, which sets the value"),
    "not-identifiable": ("✕", "the recording does not determine it"),
}
# Name -> symbol, where they differ. Pages and pictures set the part after "_" as an index.
SYMBOLS = {
    "kappa": "κ", "mu": "μ", "epsilon": "ε", "tau": "τ", "b1": "b_1", "b2": "b_2", "x0": "x_0", "x0/L": "x_0/L",
    "f0": "f_0",
}  # fmt: skip
# Bands of the criterion of Bensa et al. (2005).
BANDS = {"band1": "band 1: fundamental", "band2": "band 2: partials 2 to 8", "band3": "band 3: partials from 9"}
VELOCITY_RATIO = "v/v_ref "
# Parameters that do not belong to the felt.
NOT_FELT = {"c", "kappa", "b1", "b2", "M_H", "v_H0", "x0", "width", "M_S", "L", "pickup"}
# Render model in `fit.json` -> label.
RENDER_LABELS = {"law": "string model alone", "modes": "modes", "modes and knock": "modes and knock"}
NOT_CONVERGED = "The search stopped before it converged. Do not use the numbers on this page as results."


def rows(table: dict[str, Any]) -> list[dict[str, str]]:
    """Return the table of parameters or invariants as text, one row a quantity."""
    from ..result.quantities import Quantities

    return [_row(quantity) for quantity in Quantities.of(table).values()]


def _row(quantity: Quantity) -> dict[str, str]:
    value, interval = with_interval(quantity.value, quantity.interval)
    is_ratio = quantity.name.startswith(VELOCITY_RATIO)
    note = PurePath(quantity.note).name if is_ratio else quantity.note
    return {
        "name": "v/v_ref" if is_ratio else SYMBOLS.get(quantity.name, quantity.name),
        "meaning": quantity.meaning,
        "value": value,
        "unit": format_unit(quantity.unit),
        "interval": interval,
        "initial": number(quantity.initial),
        "status": quantity.status,
        "mark": STATUS[quantity.status][0],
        "note": "; ".join(filter(None, (note, _unbounded(quantity)))),
    }


def format_unit(unit: str) -> str:
    """Return a unit for the page: empty for a pure number, with a superscript p."""
    return "" if unit == "1" else unit.replace("^p", "ᵖ")


def minima(fit: dict[str, Any]) -> dict[str, Any] | None:
    """Return the table of the minima, with the parameters that differ as columns; None if there is only one."""
    entries = fit["minima"]
    if len(entries) < 2:
        return None
    felt = [name for name in fit["parameters"] if name not in NOT_FELT]
    names = [name for name in (*felt, "M_H", "x0") if len({entry["parameters"].get(name) for entry in entries}) > 1]
    lowest = min(entry["F"] for entry in entries)
    return {
        "names": [(SYMBOLS.get(name, name), format_unit(fit["parameters"][name]["unit"])) for name in names],
        "rows": [
            {
                "weight": _percent(entry["share"]),
                "above": number(entry["F"] - lowest, 2),
                "values": [number(entry["parameters"].get(name), 4) for name in names],
                "velocities": ", ".join(number(velocity, 3) for velocity in entry["velocities"]),
            }
            for entry in entries
        ],
    }


def _percent(weight: float) -> str:
    return "< 1 %" if weight < 0.005 else f"{100 * weight:.0f} %"


def _unbounded(quantity: Quantity) -> str:
    """Return which ends of the interval come from the range of the parameter and not from the recording."""
    ends = quantity.interval_open
    side = "" if len(ends) == 2 else "lower " if "low" in ends else "upper "
    return f"the recording sets no {side}limit; the interval ends at the bound of the parameter" if ends else ""


def interval_method_text(fit: dict[str, Any]) -> str:
    """Return how the intervals were computed; empty for Laplace's approximation."""
    diagnostics = fit["diagnostics"]
    if diagnostics.get("profile"):
        return (
            "The intervals are profile intervals: each parameter was fixed at values around its estimate, and all "
            "others were fitted again. The band of the felt and the correlations below use Laplace’s approximation."
        )
    if not (posterior := diagnostics.get("posterior")):
        return ""
    parameters = posterior["parameters"].values()
    rhat = max(entry["rhat"] for entry in parameters)
    effective_size = min(min(entry["ess_bulk"], entry["ess_tail"]) for entry in parameters)
    return (
        f"The intervals come from samples of the posterior: {posterior['chains']} chains of {posterior['draws']} "
        f"draws. They are as accurate as at least {effective_size:.0f} independent draws. "
        f"R-hat is at most {rhat:.3f} (1 when the chains agree)."
    )


def notices(fit: dict[str, Any]) -> list[tuple[str, str, str]]:
    """List (tone, heading, text) of the notices at the top: the claims, the problems, or that there are none."""
    all_measured = all(entry["status"] in ("fitted", "given") for entry in fit["parameters"].values())
    initial, final = (fit["criterion"]["global"][stage] for stage in ("initial", "final"))
    is_worse, converged = final > initial, fit["converged"]
    notices = []
    if fit["claims"]:
        tone, mark = ("good", "✓") if converged and all_measured and not is_worse else ("warn", "⚠")
        notices.append((tone, f"{mark} Read this first", fit["claims"]))
    if not converged:
        notices.append(("warn", "⚠ Not converged", NOT_CONVERGED))
    if is_worse:
        text = f"The fit increased the criterion of Bensa et al. (2005) from {initial:.3g} to {final:.3g}."
        if fit["recipe"] == "default":
            text += (
                " The fit does not minimise this criterion. It fits the levels, frequencies and decay rates of the "
                "partials."
            )
        notices.append(("warn", "⚠ Higher criterion", text))
    if not notices:
        hint = "" if all_measured else " Some numbers below were not measured. The mark next to each value shows this."
        notices.append(("good", "✓ Converged", "The search converged." + hint))
    return notices


def _change(initial: float, final: float) -> str:
    """Return the change of a criterion (a relative squared error) as a factor and in dB."""
    if not (initial > 0 and final > 0):
        return "–"
    ratio = initial / final
    if abs(ratio - 1) < 5e-4:
        return "no change"
    factor = f"{number(ratio, 3)} times smaller" if ratio > 1 else f"{number(1 / ratio, 3)} times larger"
    return f"{factor} ({-10 * math.log10(ratio):+.1f} dB)".replace("-", "−")


def bands(fit: dict[str, Any]) -> list[dict[str, Any]]:
    """Return the table of the criterion as text: all bands together, then each, with a reason for excluded ones."""
    criterion, rows = fit["criterion"], []
    for name, label in ({"global": "all bands together"} | BANDS).items():
        entry = criterion.get(name)
        if entry is not None:
            initial, final = entry["initial"], entry["final"]
            rows.append({"label": label, "initial": number(initial, 3), "final": number(final, 3),
                         "change": _change(initial, final)})  # fmt: skip
        elif name in criterion["dropped"]:
            reason = "excluded: none of its partials is above the noise"
            rows.append({"label": label, "initial": "–", "final": "–", "change": reason})
    return rows


def summary_tiles(fit: dict[str, Any]) -> list[tuple[str, str, str]]:
    """List (name, number, explanation) of the figures at the top of the page."""
    levels, derived, overall = fit["levels"], fit["derived"], fit["criterion"]["global"]
    glide_text, count = glide(fit), len(fit["recordings"])
    recontacts = recontact_text(derived["later_contacts"])
    force, depth = number(derived["max_force_N"], 3), number(derived["max_compression_mm"], 3)
    return [
        ("Error of the partials’ levels", f"{number(levels['fitted_db'], 2)} dB",
         f"{number(levels['initial_db'], 2)} dB before the fit; rms over {levels['partials']} levels of partials"
         + (f" in {count} recordings" if count > 1 else "")),
        ("Criterion (spectral error)", number(overall["final"], 3),
         f"{number(overall['initial'], 3)} before the fit, {_change(overall['initial'], overall['final'])}"),
        ("Pitch f₀", f"{number(derived['f0'], 5)} Hz",
         f"inharmonicity B = {number(derived['B'], 3)}"
         + (f"; pitch {glide_text} as the note decays" if glide_text else "")),
        ("Hammer contact", f"{number(derived['contact_ms'], 3)} ms",
         f"largest force {force} N, largest compression {depth} mm" + (f"; {recontacts}" if recontacts else "")),
    ]  # fmt: skip


def recontact_text(contacts: list[dict[str, float]]) -> str:
    """Return how often, when and how hard the hammer touches the string after its first contact; empty if never."""
    if not contacts:
        return ""
    start = number(contacts[0]["start_ms"], 3)
    end = number(contacts[-1]["start_ms"] + contacts[-1]["duration_ms"], 3)
    times = f"from {start}" if len(contacts) == 1 else f"{len(contacts)} times, from {start} ms"
    hardest = number(max(contact["max_force_N"] for contact in contacts), 2)
    return f"touches again {times} to {end} ms, with up to {hardest} N"


def glide(fit: dict[str, Any]) -> str:
    """Return how the pitch changes while the note decays; empty if it does not."""
    cents = fit["derived"]["glide_cents"]
    if f"{abs(cents):.1f}" == "0.0":
        return ""
    return f"{'falls' if cents >= 0 else 'rises'} by {abs(cents):.1f} cents"


def groups(fit: dict[str, Any]) -> list[tuple[str, str, str, list[str]]]:
    """List (status, mark, explanation, symbols) of each status that occurs."""
    entries = [(SYMBOLS.get(name, str(name)), entry["status"]) for name, entry in fit["parameters"].items()]
    groups = [(status, *STATUS[status], [symbol for symbol, own in entries if own == status]) for status in STATUS]
    return [group for group in groups if group[-1]]


def comparison(fit: dict[str, Any]) -> str:
    """Compare the fit with the initial hammer at fitted velocities, gain and path; empty if that was not computed."""
    initial_hammer, fitted = (fit["levels"][key] for key in ("path_only_db", "fitted_db"))
    if initial_hammer is None:
        return ""
    conclusion = "The levels of the partials therefore do not support the fitted hammer over the initial one."
    if initial_hammer > fitted + 0.1:
        conclusion = "The fitted hammer explains more of the levels."
    return (
        f"With the best velocities, gain and output path, the initial hammer leaves an error of {initial_hammer:.1f} "
        f"dB in the levels of the partials. The fitted hammer leaves {fitted:.1f} dB. {conclusion}"
    )


def modal_response_text(entry: dict[str, Any]) -> str:
    """Return which render model the key uses, and the errors that decided it."""
    errors = entry["left_out_db"]
    if errors is None:
        return (
            f"This key is played with {_render_model(entry)}. This choice was not tested on another stroke, because "
            "only one recording was made through this output path."
        )
    law, modes, knock = (f"{errors[name]:.1f}" for name in RENDER_LABELS)
    tested = (
        "Each layer was predicted with modes and knock that were measured from the other layers. The distance from its "
        f"recording is {law} dB with the string model alone, {modes} dB with modes, and {knock} dB with modes and "
        "knock."
    )
    if entry["by"] == "law":
        return f"{tested} Modes did not improve the prediction, so the string model alone is used."
    return f"{tested} Therefore this key is played with {_render_model(entry)}."


def modal_response_line(entry: dict[str, Any]) -> str:
    """Return the same as one line for a terminal."""
    model, errors = entry["by"], entry["left_out_db"]
    line = f"played with {_render_model(entry)}"
    if errors is None:
        return f"{line}; one recording through its output path, so not tested on another stroke"
    others = ", ".join(f"{errors[name]:.1f} with {label}" for name, label in RENDER_LABELS.items() if name != model)
    return f"{line}: leave-one-out error {errors[model]:.1f} dB ({others})"


def _render_model(entry: dict[str, Any]) -> str:
    """Return the render model of a key, with the number of modes."""
    if entry["by"] == "law":
        return "the string model alone"
    modes = counted(len(entry["modes"]["partial"]), "mode")
    return modes + (" and a knock" if entry["by"] == "modes and knock" else "")
