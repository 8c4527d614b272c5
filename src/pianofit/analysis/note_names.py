"""Note names and frequencies in equal temperament, A4 = 440 Hz = MIDI 69."""

import math
import re
from numbers import Integral

from ..conversions import HIGHEST_KEY, LOWEST_KEY, hertz_of, midi_of
from ..errors import AnalysisError, ParameterError, check_type

# Largest difference in pitch between recordings of one key, cents; the next key is 100 away.
SAME_KEY_CENTS = 40.0
HIGHEST_MIDI = 127  # highest note number of the MIDI standard
_NAMES = ("C", "C#", "D", "D#", "E", "F", "F#", "G", "G#", "A", "A#", "B")
_NOTE = re.compile(r"([A-Ga-g])(##|#|♯|s|bb|b|♭|)(-1|\d)")
_EVERY = re.compile(r"every\s+([1-9]\d?)")
_NUMBER = re.compile(r"\d{1,3}", re.ASCII)
_SHIFT = {"": 0, "#": 1, "♯": 1, "s": 1, "##": 2, "b": -1, "♭": -1, "bb": -2}


def note_to_midi(name: str | int) -> int:
    """MIDI number of a note such as "F#2", "Fs2", "Bb3" or "C4" (middle C is C4 = 60); "42" and 42 are 42.

    Raises
    ------
    AnalysisError
        If `name` is not a note.
    ParameterError
        If it is neither text nor a whole number.
    """
    check_type("note=", name, str | Integral, "a name such as 'F#2', or a MIDI number")
    text = str(name).strip()
    if _NUMBER.fullmatch(text) and int(text) <= HIGHEST_MIDI:
        return int(text)
    match = _NOTE.fullmatch(text)
    if match is None:
        raise AnalysisError(
            f"note {name!r} is not a note name; write a letter, # or b, and an octave, such as F#2, or a MIDI number "
            f"from 0 to {HIGHEST_MIDI}"
        )
    letter, shift, octave = match.groups()
    return 12 * (int(octave) + 1) + _NAMES.index(letter.upper()) + _SHIFT[shift]


def note_to_hz(name: str | int) -> float:
    """Frequency of a note in Hz, A4 = 440 Hz."""
    return hertz_of(note_to_midi(name))


def hz_to_note(frequency: float) -> str:
    """Name of the note nearest to `frequency` (Hz)."""
    return midi_to_note(round(midi_of(frequency)))


def cents_above(frequency: float, reference: float) -> float:
    """Interval from `reference` up to `frequency`, both in Hz, in cents."""
    return 1200 * math.log2(frequency / reference)


def nearest_note(frequency: float) -> str:
    """The note nearest to `frequency` (Hz) and the distance from it: "F#2 -4 cents"."""
    name = hz_to_note(frequency)
    return f"{name} {cents_above(frequency, note_to_hz(name)):+z.0f} cents"


def midi_to_note(midi: int) -> str:
    """Name of a MIDI number: "F#2" for 42."""
    return f"{_NAMES[midi % 12]}{midi // 12 - 1}"


def parse_keys(text: str) -> list[int]:
    """Keys of a piano in words.

    Parameters
    ----------
    text : A0-C8, C2,E2,G2, "every 3" (semitones from A0), or a comma-separated mixture.

    Returns
    -------
    MIDI keys, ascending.

    Raises
    ------
    ParameterError
        If a part is not a key or a range within A0 to C8, lower key first.

    Examples
    --------
    >>> from pianofit.analysis.note_names import parse_keys
    >>> parse_keys("C2,E2-G2")
    [36, 40, 41, 42, 43]
    """
    keys: set[int] = set()
    for part in (piece.strip() for piece in text.split(",")):
        every = _EVERY.fullmatch(part)
        try:
            found = range(LOWEST_KEY, HIGHEST_KEY + 1, int(every[1])) if every else _key_range(part)
        except AnalysisError:
            found = range(0)
        if not found or found[0] < LOWEST_KEY or found[-1] > HIGHEST_KEY:
            raise ParameterError(
                f"keys={text!r} must be keys from A0 to C8, such as A0-C8, C2,E2,G2 or 'every 3' (semitones), and the "
                "lower key of a range comes first"
            )
        keys.update(found)
    return sorted(keys)


def _key_range(text: str) -> range:
    """Keys of a range such as A0-C8, or of one note."""
    low, hyphen, high = text.partition("-")
    return range(note_to_midi(low), note_to_midi(high if hyphen else low) + 1)
