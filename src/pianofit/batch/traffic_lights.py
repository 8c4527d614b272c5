"""Traffic lights of a key: the match of its levels, its tuning, the prediction of other layers, and its warnings.

A light is a number, a word and a colour, so it can be read without the colour. The limits sort keys for a reader and
are not used in any computation.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

from ..analysis.note_names import note_to_hz
from ..errors import AnalysisError
from ..io.number_format import is_number
from ..report.text import SYMBOLS
from .records import Entry

__all__ = ["LIGHTS", "MATCH_LIMITS", "RING_LIMITS", "TUNING_LIMITS", "Light", "lights"]

# Levels of partials, rms, dB: people just notice a change of 1 dB. At 3 dB a partial has half or twice its energy.
MATCH_LIMITS = (1.0, 3.0)
# Deviation from equal temperament, cents: most pianos are stretched by less than 25. Above 50 another note is nearer.
TUNING_LIMITS = (25.0, 50.0)
# Predicted layer against its recording, dB: the nearest other layer differs by about 3 dB (docs/ringing.md).
RING_LIMITS = (3.0, 6.0)
# Column -> unit, in the order of `lights`.
LIGHTS = {"match": "dB", "tuning": "cents", "ring": "dB", "warnings": ""}
# Added to the number of warnings for sorting, if a fit did not converge. It exceeds the number of any other fit.
NOT_CONVERGED_OFFSET = 100


class Light(NamedTuple):
    """One cell of the table."""

    tone: str  # good, fair or poor; none without a value
    word: str  # explanation of the tone; may be empty
    text: str
    value: float | None  # for sorting


def lights(entry: Entry, fit: dict[str, Any]) -> list[Light]:
    """Lights of a finished key, in the order of `LIGHTS`."""
    return [_match(fit), _tuning(entry.note, fit), _ring(fit), _warnings(entry, fit)]


def _graded(value: float, decimals: int, limits: tuple[float, float], sign: str = "") -> Light:
    """Light for the size of a deviation, rounded as displayed."""
    value = round(value, decimals)
    text = f"{value:{sign}.{decimals}f}".replace("-", "−")
    tone = "good" if abs(value) <= limits[0] else "fair" if abs(value) <= limits[1] else "poor"
    return Light(tone, tone, text, value)


def _match(fit: dict[str, Any]) -> Light:
    value = fit.get("levels", {}).get("fitted_db")
    return _graded(value, 2, MATCH_LIMITS) if is_number(value) else Light("none", "no levels", "–", None)


def _tuning(note: str, fit: dict[str, Any]) -> Light:
    """Light for the first partial against the note name."""
    pitch = fit.get("derived", {}).get("f1")
    try:
        nominal = note_to_hz(note)
    except AnalysisError:  # a damaged record
        nominal = math.nan
    if not (is_number(pitch) and pitch > 0 and nominal > 0):
        return Light("none", "no pitch", "–", None)
    cents = 1200 * math.log2(pitch / nominal)
    return _graded(cents, 0, TUNING_LIMITS, "+")


def _ring(fit: dict[str, Any]) -> Light:
    ringing = fit.get("ringing") or {}
    value: Any = (ringing.get("left_out_db") or {}).get(ringing.get("by"))
    return _graded(value, 1, RING_LIMITS) if is_number(value) else Light("none", "untested", "–", None)


def _warnings(entry: Entry, fit: dict[str, Any]) -> Light:
    """Light for parameters at a bound, recordings left out, and convergence."""
    parameters = fit.get("parameters", {}).items()
    bound = [str(SYMBOLS.get(name, name)) for name, p in parameters if p.get("status") == "at-bound"]
    left_out = len(entry.left_out)
    warnings = [f"at a bound: {', '.join(bound)}"] * bool(bound)
    warnings += [f"{left_out} recording{'s' * (left_out != 1)} left out"] * bool(left_out)
    count = len(bound) + left_out
    if not fit.get("converged", True):
        return Light("poor", "; ".join(["not converged", *warnings]), str(count + 1), NOT_CONVERGED_OFFSET + count)
    return Light("fair" if count else "good", "; ".join(warnings), str(count), count)
