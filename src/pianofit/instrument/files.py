"""Instruments from `instrument.json` or from a folder of fits, and the file of an instrument."""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ..analysis.note_names import midi_to_note
from ..errors import FitError, ParameterError, check_range
from ..excitation import OTHERS
from ..felt import SoftHammer, check_hammer, law_of, make_hammer
from ..io.files import as_path, check_ending, printable, replace_file, short_repr
from ..model.note import Note
from ..model.simulate import check_geometry
from ..parameters import HAMMER_NAMES, Geometry, String, check
from ..schema.decode import encode_json
from ..schema.fit import PathEntry, package_versions
from ..schema.instrument import (
    HINT,
    INSTRUMENT_FILE,
    GeometryEntry,
    HammerEntry,
    InstrumentFile,
    KeyEntry,
    StringEntry,
    read_instrument_file,
)
from ..schema.modal_response import ModalResponseEntry
from ..threads import numerical_settings
from .build import build_instrument
from .collect_fits import find_fits, instrument_name, instrument_title, load_extras, load_keys
from .guessed_responses import missing_laws, with_guessed_responses
from .instrument import Instrument, Key
from .release_noise import ReleaseNoise, release_entries


@numerical_settings()
def load_instrument(path: str | os.PathLike[str], prefix: str | None = None, even: float = 0.0) -> Instrument:
    """Load an instrument from a file, or from a folder with an `instrument.json` or with fits.

    Parameters
    ----------
    path : an `instrument.json`, its folder, or a folder of fits, which are combined by `build_instrument`.
    prefix : name of the instrument, if a folder holds fits of several.
    even : as for `build_instrument`, for a folder of fits.

    Returns
    -------
    An `Instrument`.

    Raises
    ------
    FitError
        If an entry is missing, of the wrong type, or out of range; the message names the file and the entry. Also if a
        folder holds no fits, or fits of several instruments without a `prefix`.
    ParameterError
        If a `prefix`, or `even` above 0, is given for a file. Also for a value of `even` beyond 0 to 1.

    Examples
    --------
    >>> import pianofit
    >>> pianofit.load_instrument("batch", prefix="cp80")
    Instrument('cp80', 88 keys, 2 recorded)
    """
    check_range("even=", even, 0.0, 1.0)
    path = as_path(path)
    file = path / INSTRUMENT_FILE if path.is_dir() else path
    if path.is_dir() and not file.is_file():
        return instrument_of_fits([path], prefix, even)
    if prefix is not None:
        raise ParameterError(f"prefix={short_repr(prefix)}: {printable(path)} is a finished instrument; leave it out")
    if even:
        raise ParameterError(f"even={even:g}: {printable(path)} is a finished instrument; give the folder of its fits")
    record, name = read_instrument_file(file), printable(file)
    keys = {entry.midi: _key(entry, record, f"{name}: keys[{i}]") for i, entry in enumerate(record.keys)}
    if missing := missing_laws(keys, record.laws):
        raise FitError(f"{name}: laws must have {', '.join(missing)}, which its guessed keys need; {HINT}")
    keys = with_guessed_responses(keys, record.laws)
    return Instrument(
        printable(record.name),
        keys,
        record.velocity,
        record.laws,
        record.warnings,
        record.even,
        record.dampers,
        _release(record, name),
        record.noise,
        record.bridge,
    )


def instrument_of_fits(
    paths: Sequence[Path], prefix: str | None = None, even: float = 0.0, name: str | None = None
) -> Instrument:
    """Build the instrument of the fits among `paths`, with what a batch measured beyond them; see `find_fits`.

    Its name is `name`, or follows from the `prefix` and the folders.
    """
    files = find_fits(paths, prefix)
    extras = load_extras(paths, instrument_name(files[0]))
    return build_instrument(load_keys(files), name or instrument_title(paths, files, prefix), even, extras)


def _release(record: InstrumentFile, name: str) -> ReleaseNoise | None:
    """Return the release noise of an instrument."""
    sounds, rates = {}, set()
    for i, entry in enumerate(record.releases):
        sounds[entry.midi], rate = entry.sound.samples(f"{name}: releases[{i}].sound")
        rates.add((rate, len(sounds[entry.midi])))
    if len(rates) > 1:
        raise FitError(f"{name}: releases must have one rate and one number of channels; {HINT}")
    return ReleaseNoise(sounds, rates.pop()[0]) if rates else None


def _key(entry: KeyEntry, record: InstrumentFile, where: str) -> Key:
    """Return the key of an entry, without a guessed modal response. Its values are checked."""
    string, geometry = vars(entry.string), Geometry(**vars(entry.geometry))
    hammer, quantity = _hammer(entry, record.excitation), record.quantity
    try:
        check(string, where)
        check_hammer(hammer, where)
        check_geometry(geometry, quantity)
    except ParameterError as error:
        raise FitError(str(error) if str(error).startswith(where) else f"{where}: {error}") from None
    response = entry.modal_response
    note = Note(
        String(**string),
        hammer,
        geometry,
        quantity,
        entry.gain,
        None if entry.path is None else entry.path.output_path,
        response.response(None, where) if isinstance(response, ModalResponseEntry) else None,
    )
    return Key(note, entry.state, entry.values, entry.fit, entry.changes, response == "guess")


def _hammer(entry: KeyEntry, excitation: str) -> Any:
    """Return what excites the string of a key. Each stroke sets its own size."""
    if entry.hammer is None:
        return OTHERS[excitation].make_hammer({})
    felt = vars(entry.hammer) | {"v_H0": 2.0}
    return make_hammer(felt if entry.hammer.skin else {name: felt[name] for name in HAMMER_NAMES})


def instrument_record(instrument: Instrument) -> InstrumentFile:
    """Return the content of the `instrument.json` of an instrument."""
    return InstrumentFile(
        name=instrument.name,
        quantity=instrument.quantity,  # pyright: ignore[reportArgumentType]
        excitation=instrument.law.kind,  # pyright: ignore[reportArgumentType]
        velocity=instrument.velocity,
        laws=dict(instrument.laws),
        keys=tuple(_entry(midi, key, instrument.even) for midi, key in sorted(instrument.keys.items())),
        warnings=instrument.warnings,
        even=instrument.even,
        bridge=instrument.bridge,
        dampers=instrument.dampers,
        releases=release_entries(instrument.release),
        noise=instrument.noise,
        versions=package_versions(),
    )


def _entry(midi: int, key: Key, even: float) -> KeyEntry:
    """Return the entry of a key. Guesses do not follow from evened keys, so they are then written out."""
    hammer, path, response = key.note.hammer, key.note.path, key.note.modal_response
    is_guess = key.is_guessed and not even
    modal_response = "guess" if is_guess else None
    if response is not None and not is_guess:
        modal_response = ModalResponseEntry.of(response, embed_knock=True)
    return KeyEntry(
        midi=midi,
        note=midi_to_note(midi),
        state=key.state,
        string=StringEntry(*map(float, key.note.string)),
        hammer=_hammer_entry(hammer),
        geometry=GeometryEntry(*map(float, key.note.geometry)),
        gain=float(key.note.gain),
        path=None if path is None else PathEntry(path.frequency, path.db),
        modal_response=modal_response,
        values=dict(key.values),
        changes=None if key.changes is None else dict(key.changes),
        fit=key.fit,
    )


def _hammer_entry(hammer: Any) -> HammerEntry | None:
    if not law_of(hammer).key_quantities:
        return None
    skin = hammer.skin if isinstance(hammer, SoftHammer) else 0.0
    return HammerEntry(*map(float, (hammer.K_H, hammer.mu, hammer.p, hammer.M_H, skin)))


def write_instrument(path: str | os.PathLike[str], instrument: Instrument) -> InstrumentFile:
    """Write an `instrument.json` completely, or not at all.

    The file holds knocks as FLAC of 24 bits, as `fit.json` does, so that keys are guessed alike from both.

    Parameters
    ----------
    path : file to write, whose name ends in .json.
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
    >>> import pianofit
    >>> record = pianofit.write_instrument("instrument.json", pianofit.load_instrument("batch", prefix="cp80"))
    >>> record.velocity == pianofit.load_instrument("instrument.json").velocity
    True
    """
    check_ending(path, ".json")
    record = instrument_record(instrument)
    replace_file(path, encode_json(record))
    return record
