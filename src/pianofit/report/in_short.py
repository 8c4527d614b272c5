"""A fit in short, for readers who want its sound and not its physics: match, tuning, loudness, ring."""

import math
from collections.abc import Sequence

from ..analysis.note_names import midi_to_note
from ..conversions import midi_of
from ..io.number_format import number
from ..model.modal_response import PartialDecay
from ..result import Result
from .sound import Clip
from .text import COMPARED, glide

# Number of lowest partials whose ring is stated.
PARTIALS = 3
# Largest difference of loudness, dB, that is called equal: less is hardly audible.
EQUAL_DB = 0.5


def in_short(result: Result, clips: Sequence[Clip], decays: Sequence[PartialDecay]) -> list[tuple[str, str]]:
    """List (what, sentence) of a fit.

    Parameters
    ----------
    clips : the recorded sound and the fitted one, as the player has them.
    decays : decays of the partials of the modal response, if the key has one.
    """
    return [
        ("Match", _match(result)),
        ("Tuning", _tuning(result)),
        ("Loudness", _loudness(result, clips)),
        *([("Ring", _ring(decays))] if decays else []),
    ]


def _match(result: Result) -> str:
    fit = result.fit
    levels = (
        f"The levels of the partials in model and recording differ by {number(fit.levels.fitted_db, 2)} dB (rms; "
        f"{COMPARED})."
    )
    error = None if fit.modal_response is None else fit.modal_response.prediction_error_db
    if error is None:
        return levels
    return f"{levels} Recordings that are left out of the fit are predicted with a mean error of {number(error, 2)} dB."


def _tuning(result: Result) -> str:
    derived = result.fit.derived
    midi = midi_of(derived.f0)
    key, bend = round(midi), glide(result.fit)
    cents = f"{round(100 * (midi - key)):+d}".replace("-", "−")
    change = f" It {bend} while the note decays." if bend else ""
    return f"{number(derived.f0, 5)} Hz, {cents} cents from {midi_to_note(key)} at A4 = 440 Hz.{change}"


def _loudness(result: Result, clips: Sequence[Clip]) -> str:
    recorded, fitted = clips[0], next(clip for clip in clips if clip.name == "fitted")
    difference = recorded.gain_db - fitted.gain_db  # gains make both equally loud
    louder = f"{number(abs(difference), 2)} dB {'louder' if difference > 0 else 'softer'} than"
    own = f"The fitted note is {'as loud as' if abs(difference) < EQUAL_DB else louder} its recording."
    values = [row.stroke_value for row in result.fit.recordings]
    if not result.draw_set.law.has_contact or len(values) < 2:
        return own
    if result.fit.velocity_scale_open:
        return f"{own} The loudest hammer is {number(max(values) / min(values), 2)} times as fast as the softest."
    return f"{own} The estimated hammer velocities are {number(min(values), 2)} to {number(max(values), 2)} m/s."


def _ring(decays: Sequence[PartialDecay]) -> str:
    """Describe how the lowest partials decay by 60 dB, right after the stroke and later."""
    found = []
    for decay in decays[:PARTIALS]:
        times = [
            f"{number(t, 2)} s {when}"
            for t, when in ((decay.early, "at first"), (decay.late, "later"))
            if math.isfinite(t)
        ]
        beats = f", beats of {number(decay.beat_frequency, 2)} Hz" if math.isfinite(decay.beat_frequency) else ""
        if times:
            found.append(f"partial {decay.number}: {' and '.join(times)}{beats}")
    if not found:
        return "The decay times are too uncertain to state."
    return f"Time to fall by 60 dB: {'; '.join(found)}."
