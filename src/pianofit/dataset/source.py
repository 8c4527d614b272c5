"""The notes that a data set is drawn around: the literature's for each key, or those of a fit or an instrument."""

import hashlib
from functools import lru_cache
from numbers import Integral
from pathlib import Path
from typing import NamedTuple

from ..analysis.note_names import midi_to_note, note_to_midi
from ..conversions import HIGHEST_KEY, LOWEST_KEY, midi_of
from ..errors import AnalysisError, OutputError, ParameterError, check_range, check_type
from ..felt import law_of
from ..instrument import load_instrument
from ..instrument.key_quantities import literature_note
from ..io.files import path_name, printable, read_file, short_repr
from ..model.note import Note, check_render
from ..schema.dataset import NoteOptions
from ..schema.fit import fit_path
from ..schema.instrument import INSTRUMENT_FILE, LARGEST_INSTRUMENT, is_instrument
from ..schema.notes import load_note

# Largest number of layers: 128 MIDI velocities.
MAX_LAYERS = 128
MAX_SPREAD = 3.0  # of the priors, beyond which most draws end at a bound
MAX_NOISE_DB = 200.0  # dB below the note, below the rounding of 32 bit samples


class Source(NamedTuple):
    """Central notes of a data set by MIDI number, and the hash of their file."""

    notes: dict[int, Note]
    sha256: str | None = None  # None for the literature


def check_options(options: NoteOptions) -> None:
    """Raise a `ParameterError` for an option that is out of range or of the wrong type."""
    check_type("options=", options, NoteOptions, "a NoteOptions")
    check_type("rate=", options.rate, Integral, "a whole number of Hz")
    check_render(None, options.seconds, options.rate)
    check_type("layers=", options.layers, Integral, "a whole number")
    check_range("layers=", options.layers, 1, MAX_LAYERS)
    if options.keys is not None and not (isinstance(options.keys, tuple | list) and len(options.keys) == 2):
        raise ParameterError(f"keys={short_repr(options.keys)} must be the lowest and the highest key, ('C4', 'C5')")
    check_range("spread=", options.spread, 0.0, MAX_SPREAD)
    for name in ("path", "modal_response"):
        check_type(f"{name}=", getattr(options, name), bool, "True or False")
    low, high = noise_range(options) or (0.0, 0.0)
    check_range("noise_db=", low, 0.0, MAX_NOISE_DB, " dB")
    check_range("noise_db=", high, 0.0, MAX_NOISE_DB, " dB")
    if low > high:
        raise ParameterError(f"noise_db={options.noise_db!r} must have the lower level first")
    if options.modal_response and options.around is None:
        raise ParameterError("modal_response=True needs around=, a fit or an instrument with measured modes")


def noise_range(options: NoteOptions) -> tuple[float, float] | None:
    """Return the lowest and the highest level of the noise below the note, dB; None without noise."""
    noise = options.noise_db
    if noise is None:
        return None
    pair = noise if isinstance(noise, tuple | list) else (noise, noise)
    if len(pair) != 2:
        raise ParameterError(f"noise_db={noise!r} must be a level in dB, or the lowest and the highest level")
    return pair[0], pair[1]


def load_source(options: NoteOptions) -> Source:
    """Return the central notes of the keys that the options choose, after a check of all options."""
    check_options(options)
    around = Source(_literature()) if options.around is None else _read(path_name(options.around))
    own = around.notes
    if not (law := law_of(next(iter(own.values())).hammer)).has_contact:
        raise ParameterError(
            f"around={printable(options.around)}: is {law.words.verb}; give a struck string or a piano"
        )
    first, last = options.keys or (min(own), max(own))
    low, high = _midi(first), _midi(last)
    chosen = {midi: own[midi] for midi in range(low, high + 1) if midi in own}
    if not chosen:
        span = f"{midi_to_note(min(own))} to {midi_to_note(max(own))}"
        raise ParameterError(f"keys='{first}-{last}' must be from low to high, within {span}")
    if options.modal_response and (missing := [m for m, note in chosen.items() if note.modal_response is None]):
        name, count = printable(options.around), len(missing)
        raise ParameterError(
            f"modal_response=True: {count} of the keys of {name} have no modal response; choose others"
        )
    return Source(chosen, around.sha256)


def _midi(key: str | int) -> int:
    try:
        midi = note_to_midi(key)
    except AnalysisError as error:
        raise ParameterError(f"keys=: {error}") from None
    check_range("keys=", midi, LOWEST_KEY, HIGHEST_KEY, hint="; 60 is C4")
    return midi


@lru_cache(maxsize=1)
def _literature() -> dict[int, Note]:
    """Return the literature's notes of a piano."""
    return {midi: literature_note(midi) for midi in range(LOWEST_KEY, HIGHEST_KEY + 1)}


def _read(name: str) -> Source:
    """Read the notes of a fit or of an instrument."""
    path = Path(name).resolve()
    instrument = path / INSTRUMENT_FILE
    file = instrument if instrument.is_file() else fit_path(path)
    if path.is_dir() and not file.is_file():
        raise OutputError(f"{printable(path)}: has neither a fit.json nor an instrument.json; give such a folder")
    return _notes_of(file, hashlib.sha256(read_file(file, LARGEST_INSTRUMENT, ParameterError)).hexdigest())


@lru_cache(maxsize=1)  # a worker needs them for every block
def _notes_of(file: Path, digest: str) -> Source:
    """Return the notes of a file with this SHA-256."""
    if is_instrument(file, "give one of them"):
        return Source({midi: key.note for midi, key in load_instrument(file).keys.items()}, digest)
    note, _ = load_note(file)
    return Source({round(midi_of(float(note.f0))): note}, digest)
