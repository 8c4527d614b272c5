"""An instrument in words: what each quantity is called, how its keys came about, a summary for the terminal."""

from __future__ import annotations

from typing import Any

from ..io.number_format import counted

__all__ = ["STATES", "TITLES", "counts", "unrecorded_text", "summary"]

# name -> (title, unit of the axis)
TITLES = {
    "cents": ("tuning: f₀ against equal temperament", "cents"),
    "B": ("inharmonicity B", "1"),
    "b1": ("loss b₁, the same for all partials", "1/s"),
    "d2": ("loss d₂ = b₂π²/L², rising with k²", "1/s"),
    "M_H/M_S": ("hammer mass over string mass M_H/M_S", "1"),
    "K/M_S": ("felt's force where a stroke of 2 m/s presses it, over M_S", "N/kg"),
    "p": ("felt's exponent p", "1"),
    "mu": ("felt's loss μ", "s/m"),
    "x0/L": ("strike position x₀/L", "1"),
    "width/L": ("width of the contact over L", "1"),
    "L": ("string length L", "m"),
    "M_S/L": ("string mass per metre M_S/L", "kg/m"),
    "pickup/L": ("pickup position x_m/L", "1"),
    "gain": ("gain of the loudest recording (times M_S for the force on the bridge)", "1"),
}
STATES = {
    "fitted": "as its own fit has it",
    "pulled": "its own fit, drawn to its neighbours where that was uncertain",
    "outlier": "its own fit contradicts all others in what is named; there the law is played",
    "interpolated": "never recorded, between keys that were",
    "extrapolated": "never recorded, beyond the keys that were",
}


def counts(document: dict[str, Any]) -> dict[str, int]:
    """How many keys are in each state."""
    return {state: sum(key["state"] == state for key in document["keys"]) for state in STATES}


def unrecorded_text(between: int, beyond: int) -> str:
    """How many keys are guesses: of `Instrument.guesses`."""
    parts = [f"{n} {where}" for n, where in ((between, "between recorded keys"), (beyond, "beyond them")) if n]
    if not parts:
        return "none is a guess"
    return f"{between + beyond} {'is a guess' if between + beyond == 1 else 'are guesses'}: {', '.join(parts)}"


def summary(document: dict[str, Any]) -> str:
    """What was put together, in a few lines."""
    found = counts(document)
    known = sum(key["fit"] is not None for key in document["keys"])
    lines = [
        f"{document['name'] or 'instrument'}: {counted(known, 'key')} known, "
        + ", ".join(f"{n} {state}" for state, n in found.items() if n),
        "", f"{'':26}{'key to key':>14}{'smooth over':>12}   outliers",
    ]  # fmt: skip
    for name, law in document["laws"].items():
        scatter = f"{law['scatter']:.2g} cents" if name == "cents" else f"{100 * law['scatter']:.2g} %"
        label = "tuning" if name == "cents" else name
        lines.append(f"{label + (', ' + law['unit'] if law['unit'] not in ('', '1') else ''):26}{scatter:>14}"
                     f"{law['length_keys']:>7.0f} keys   {', '.join(law['outliers']) or '-'}")  # fmt: skip
    v = document["velocity"]
    lines += ["", f"MIDI velocity 64 is {v['at_64']:.3g} m/s, from the {v['from']}"]
    return "\n".join([*lines, *document["messages"]])
