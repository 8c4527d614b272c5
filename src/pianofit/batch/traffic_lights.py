"""Traffic lights of a key: whether its levels match, its tuning, how it rings and its warnings, each at one glance.

A light is a number, a word and a colour, so that it can be read without the colour. The limits sort keys for a reader
and enter no computation.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

from ..analysis.note_names import note_to_hz
from ..errors import AnalysisError
from ..io.number_format import is_number
from ..report.text import SYMBOLS
from .job_records import Entry

__all__ = ["LIGHTS", "MATCH", "RING", "TUNING", "Light", "lights"]

# Levels of partials, rms, dB: people just notice a change of 1 dB; at 3 dB a partial has half or twice its energy.
MATCH = (1.0, 3.0)
# Pitch from equal temperament, cents: most of a piano's stretch lies within 25; past 50 the pitch is another note's.
TUNING = (25.0, 50.0)
# A layer that was left out against its recording, dB: the nearest other layer is some 3 dB from it (docs/modal-response.md).
RING = (3.0, 6.0)
# Column -> unit, in the order of `lights`.
LIGHTS = {"match": "dB", "tuning": "cents", "ring": "dB", "warnings": ""}
# A number that a fit which did not converge has in the column of warnings: more than any other's.
NOT_CONVERGED = 100


class Light(NamedTuple):
    """One cell of the table."""

    tone: str  # good, fair, poor, or none where there is nothing to judge
    word: str  # what the tone says; empty where the text says it
    text: str
    value: float | None  # to sort by


def lights(entry: Entry, fit: dict[str, Any]) -> list[Light]:
    """The lights of a key that is done, in the order of `LIGHTS`."""
    return [_match(fit), _tuning(entry.note, fit), _ring(fit), _warnings(entry, fit)]


def _graded(value: float, decimals: int, limits: tuple[float, float], sign: str = "") -> Light:
    """A light by the size of a deviation, as it is written."""
    value = round(value, decimals)
    text = f"{value:{sign}.{decimals}f}".replace("-", "−")
    tone = "good" if abs(value) <= limits[0] else "fair" if abs(value) <= limits[1] else "poor"
    return Light(tone, tone, text, value)


def _match(fit: dict[str, Any]) -> Light:
    value = fit.get("levels", {}).get("fitted_db")
    return _graded(value, 2, MATCH) if is_number(value) else Light("none", "no levels", "–", None)


def _tuning(note: str, fit: dict[str, Any]) -> Light:
    """How far the first partial is from the note's name."""
    pitch = fit.get("derived", {}).get("f1")
    try:
        named = note_to_hz(note)
    except AnalysisError:  # a damaged record
        named = math.nan
    if not (is_number(pitch) and pitch > 0 and named > 0):
        return Light("none", "no pitch", "–", None)
    cents = 1200 * math.log2(pitch / named)
    return _graded(cents, 0, TUNING, "+")


def _ring(fit: dict[str, Any]) -> Light:
    ringing = fit.get("ringing") or {}
    value: Any = (ringing.get("left_out_db") or {}).get(ringing.get("by"))
    return _graded(value, 1, RING) if is_number(value) else Light("none", "untested", "–", None)


def _warnings(entry: Entry, fit: dict[str, Any]) -> Light:
    """What makes the numbers of a key doubtful, the worst first."""
    bound = [str(SYMBOLS.get(n, n)) for n, one in fit.get("parameters", {}).items() if one.get("status") == "at-bound"]
    lost = len(entry.left_out)
    said = [f"at a bound: {', '.join(bound)}"] * bool(bound)
    said += [f"{lost} recording{'s' * (lost != 1)} left out"] * bool(lost)
    count = len(bound) + lost
    if not fit.get("converged", True):
        return Light("poor", "; ".join(["not converged", *said]), str(count + 1), NOT_CONVERGED + count)
    return Light("fair" if count else "good", "; ".join(said), str(count), count)
