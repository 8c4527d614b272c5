"""Traffic lights of a key: the match of its levels, its tuning, the prediction of other layers, and its warnings.

A light is a number, a word and a colour, so it can be read without the colour. The limits sort keys for a reader and
are not used in any computation.
"""

import math
from typing import NamedTuple

from ..analysis.note_names import cents_above, note_to_hz
from ..errors import AnalysisError
from ..io.number_format import counted
from ..report.text import SYMBOLS
from ..schema.fit import Fit
from .records import Entry

# Levels of partials, rms, dB: people just notice a change of 1 dB. At 3 dB a partial has half or twice its energy.
MATCH_LIMITS = (1.0, 3.0)
# Deviation from equal temperament, cents: most pianos are stretched by less than 25. Above 50 another note is nearer.
TUNING_LIMITS = (25.0, 50.0)
# Predicted layer against its recording, dB: the nearest other layer differs by about 3 dB (docs/modal-response.md).
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


def lights(entry: Entry, fit: Fit | None) -> list[Light]:
    """Lights of a finished key, in the order of `LIGHTS`; `fit` is None if its file was changed."""
    return [_match(fit), _tuning(entry.note, fit), _ring(fit), _warnings(entry, fit)]


def _graded(value: float, decimals: int, limits: tuple[float, float], sign: str = "") -> Light:
    """Light for the size of a deviation, rounded as displayed."""
    value = round(value, decimals)
    text = f"{value:{sign}z.{decimals}f}".replace("-", "−")
    tone = "good" if abs(value) <= limits[0] else "fair" if abs(value) <= limits[1] else "poor"
    return Light(tone, tone, text, value)


def _match(fit: Fit | None) -> Light:
    return Light("none", "no levels", "–", None) if fit is None else _graded(fit.levels.fitted_db, 2, MATCH_LIMITS)


def _tuning(note: str, fit: Fit | None) -> Light:
    """Light for the first partial against the note name."""
    try:
        nominal = note_to_hz(note)
    except AnalysisError:  # a damaged record
        nominal = math.nan
    if fit is None or not (fit.derived.f1 > 0 and nominal > 0):
        return Light("none", "no pitch", "–", None)
    return _graded(cents_above(fit.derived.f1, nominal), 0, TUNING_LIMITS, "+")


def _ring(fit: Fit | None) -> Light:
    error = None if fit is None or fit.modal_response is None else fit.modal_response.prediction_error_db
    return Light("none", "untested", "–", None) if error is None else _graded(error, 1, RING_LIMITS)


def _warnings(entry: Entry, fit: Fit | None) -> Light:
    """Light for parameters at a bound, recordings left out, and convergence."""
    parameters = {} if fit is None else fit.parameters
    bound = [str(SYMBOLS.get(name, name)) for name, quantity in parameters.items() if quantity.status == "at-bound"]
    left_out = len(entry.left_out)
    warnings = [f"at a bound: {', '.join(bound)}"] * bool(bound)
    warnings += [f"{counted(left_out, 'recording')} left out"] * bool(left_out)
    count = len(bound) + left_out
    if fit is not None and not fit.converged:
        return Light("poor", "; ".join(["not converged", *warnings]), str(count + 1), NOT_CONVERGED_OFFSET + count)
    return Light("fair" if count else "good", "; ".join(warnings), str(count), count)
