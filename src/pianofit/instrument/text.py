"""Texts about an instrument: titles of quantities, states of keys, and a summary for the terminal."""

from __future__ import annotations

from typing import Any

from ..io.number_format import counted

__all__ = ["STATES", "TITLES", "counts", "unrecorded_text", "summary"]

# name -> (title, unit of the axis)
TITLES = {
    "cents": ("tuning: f₀ relative to equal temperament", "cents"),
    "B": ("inharmonicity B", "1"),
    "b1": ("loss parameter b₁, the same for all partials", "1/s"),
    "d2": ("loss d₂ = b₂π²/L², growing with k²", "1/s"),
    "M_H/M_S": ("hammer mass over string mass M_H/M_S", "1"),
    "K/M_S": ("felt force at the reference compression over string mass", "N/kg"),
    "p": ("felt exponent p", "1"),
    "mu": ("felt loss coefficient μ", "s/m"),
    "x0/L": ("strike position x₀/L", "1"),
    "width/L": ("width of the contact window over L", "1"),
    "L": ("string length L", "m"),
    "M_S/L": ("string mass per metre M_S/L", "kg/m"),
    "pickup/L": ("pickup position x_m/L", "1"),
    "gain": ("gain of the loudest recording (times M_S for bridge force and pressure)", "1"),
}
STATES = {
    "fitted": "values of its own fit",
    "pulled": "own fit combined with its neighbours, because some values were uncertain",
    "outlier": "disagrees with its neighbours in the listed parameters; the interpolated values are used",
    "interpolated": "never recorded, between recorded keys",
    "extrapolated": "never recorded, beyond the recorded keys",
}


def counts(document: dict[str, Any]) -> dict[str, int]:
    """Number of keys in each state."""
    return {state: sum(key["state"] == state for key in document["keys"]) for state in STATES}


def unrecorded_text(between: int, beyond: int) -> str:
    """Text on the `Instrument.unrecorded_counts`: their values are guesses."""
    parts = [f"{n} {where}" for n, where in ((between, "between recorded keys"), (beyond, "beyond them")) if n]
    if not parts:
        return "none is a guess"
    return f"{between + beyond} {'is a guess' if between + beyond == 1 else 'are guesses'}: {', '.join(parts)}"


def summary(document: dict[str, Any]) -> str:
    """Summary of an instrument in a few lines."""
    found = counts(document)
    recorded = sum(key["fit"] is not None for key in document["keys"])
    lines = [
        f"{document['name'] or 'instrument'}: {counted(recorded, 'key')} recorded: "
        + ", ".join(f"{n} {state}" for state, n in found.items() if n),
        "",
        f"{'':26}{'key scatter':>14}{'smooth over':>12}   outliers",
    ]
    for name, law in document["laws"].items():
        scatter = f"{law['scatter']:.2g} cents" if name == "cents" else f"{100 * law['scatter']:.2g} %"
        label = "tuning" if name == "cents" else name
        lines.append(
            f"{label + (', ' + law['unit'] if law['unit'] not in ('', '1') else ''):26}{scatter:>14}"
            f"{law['length_keys']:>7.0f} keys   {', '.join(law['outliers']) or '-'}"
        )
    v = document["velocity"]
    lines += ["", f"MIDI velocity 64 is {v['at_64']:.3g} m/s, from: {v['from']}"]
    return "\n".join([*lines, *document["messages"]])
