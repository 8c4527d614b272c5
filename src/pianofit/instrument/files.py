"""Instruments from `instrument.json` or from a folder of fits, and the file of an instrument."""

from __future__ import annotations

import os
from pathlib import Path

from ..analysis.note_names import midi_to_note
from ..errors import ParameterError
from ..io.files import printable, replace_file, short_repr
from ..schema.decode import encode_json
from ..schema.fit import package_versions
from ..schema.instrument import INSTRUMENT_FILE, InstrumentFile, KeyEntry, read_instrument_file
from .build import build_instrument
from .collect_fits import find_fits, instrument_name, load_keys
from .instrument import Instrument, Key
from .interpolate_keys import with_interpolated_responses

__all__ = ["instrument_record", "load_instrument", "write_instrument"]


def load_instrument(path: str | os.PathLike[str], prefix: str | None = None) -> Instrument:
    """Load an instrument from a file, or from a folder with an `instrument.json` or with fits.

    Parameters
    ----------
    path : an `instrument.json`, its folder, or a folder of fits, which are combined by `build_instrument`.
    prefix : name of the instrument, if a folder holds fits of several.

    Returns
    -------
    An `Instrument`.

    Raises
    ------
    FitError
        If an entry is missing, of the wrong type, or out of range; the message names the file and the entry. Also if a
        folder holds no fits, or fits of several instruments without a `prefix`.
    ParameterError
        If a `prefix` is given for a file.

    Examples
    --------
    >>> from pianofit.instrument import load_instrument
    >>> load_instrument("batch", prefix="cp80")
    Instrument('cp80', 88 keys, 2 recorded)
    """
    path = Path(path)
    file = path / INSTRUMENT_FILE if path.is_dir() else path
    if path.is_dir() and not file.is_file():
        files = find_fits([path], prefix)
        name = prefix or instrument_name(files[0]) or path.resolve().name
        return build_instrument(load_keys(files), printable(name))
    if prefix is not None:
        raise ParameterError(
            f"--prefix {short_repr(prefix)} chooses among a folder's fits, and {printable(path)} holds one instrument"
        )
    record = read_instrument_file(file)
    keys = {
        entry.midi: Key(
            note=entry.playable(record.quantity, f"{printable(file)}: keys[{i}]"),
            state=entry.state,
            values=entry.values,
            fit=entry.fit,
            changes=entry.changes,
            is_interpolated=entry.modal_response == "neighbours",
        )
        for i, entry in enumerate(record.keys)
    }
    keys = with_interpolated_responses(keys)
    return Instrument(printable(record.name), keys, record.velocity, record.laws, record.warnings)


def instrument_record(instrument: Instrument) -> InstrumentFile:
    """Return the content of the `instrument.json` of an instrument."""
    return InstrumentFile(
        name=instrument.name,
        quantity=instrument.quantity,  # pyright: ignore[reportArgumentType]
        velocity=instrument.velocity,
        laws=dict(instrument.laws),
        keys=tuple(
            KeyEntry.of(
                midi,
                key.note,
                is_interpolated=key.is_interpolated,
                note=midi_to_note(midi),
                state=key.state,
                values=dict(key.values),
                changes=None if key.changes is None else dict(key.changes),
                fit=key.fit,
            )
            for midi, key in sorted(instrument.keys.items())
        ),
        warnings=instrument.warnings,
        versions=package_versions(),
    )


def write_instrument(path: str | os.PathLike[str], instrument: Instrument) -> InstrumentFile:
    """Write an `instrument.json` completely, or not at all.

    The file holds knocks as FLAC of 16 bits. Their quantisation error lies 80 dB or more below the peak of a note.

    Parameters
    ----------
    path : file to write.
    instrument : as `build_instrument` or `load_instrument` return it.

    Returns
    -------
    The content of the file.

    Raises
    ------
    OutputError
        If the file cannot be written.

    Examples
    --------
    >>> from pianofit.instrument import load_instrument, write_instrument
    >>> record = write_instrument("instrument.json", load_instrument("batch", prefix="cp80"))
    >>> record.velocity == load_instrument("instrument.json").velocity
    True
    """
    record = instrument_record(instrument)
    replace_file(path, encode_json(record))
    return record
