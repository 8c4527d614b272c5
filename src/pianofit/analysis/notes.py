"""Note names and frequencies in equal temperament, A4 = 440 Hz = MIDI 69."""

from __future__ import annotations

import math
import re

from ..errors import AnalysisError

__all__ = ["hz_to_note", "note_to_hz", "note_to_midi"]

_STEPS = {"C": 0, "D": 2, "E": 4, "F": 5, "G": 7, "A": 9, "B": 11}
_NAMES = ("C", "C#", "D", "D#", "E", "F", "F#", "G", "G#", "A", "A#", "B")
_NOTE = re.compile(r"([A-Ga-g])(##|#|♯|bb|b|♭|)(-1|\d)")
_SHIFT = {"": 0, "#": 1, "♯": 1, "##": 2, "b": -1, "♭": -1, "bb": -2}


def note_to_midi(name: str) -> int:
    """MIDI number of a note such as "F#2", "Bb3" or "C4" (middle C is C4 = 60).

    Raises
    ------
    AnalysisError
        When `name` is no note.
    """
    match = _NOTE.fullmatch(name.strip()) if isinstance(name, str) else None
    if match is None:
        raise AnalysisError(f"note {name!r} is not a note name; write a letter, # or b, and an octave, such as F#2")
    letter, shift, octave = match.groups()
    return 12 * (int(octave) + 1) + _STEPS[letter.upper()] + _SHIFT[shift]


def note_to_hz(name: str) -> float:
    """Frequency of a note in Hz, A4 = 440 Hz."""
    return 440.0 * 2.0 ** ((note_to_midi(name) - 69) / 12)


def hz_to_note(frequency: float) -> str:
    """Name of the note nearest to `frequency` (Hz)."""
    midi = round(69 + 12 * math.log2(frequency / 440.0))
    return f"{_NAMES[midi % 12]}{midi // 12 - 1}"
