"""Reading of a `fit.json`: the notes of its minima.

The file has all values of a note: string, hammer, geometry, pickup, gain and output path. Each is checked before use.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np

from .errors import FitError, ParameterError
from .felt import ALL_PARAMETERS, LAWS, FeltLaw, check_hammer, make_hammer
from .io.audio import RATES
from .io.files import (
    FIT_SCHEMA,
    MAX_FIT_BYTES,
    array_of,
    is_increasing,
    load_json,
    path_name,
    printable,
    reference_row,
    require_finite,
    require_table,
    short_repr,
)
from .io.number_format import is_number
from .modal_response_file import MOST_STROKES, read_modal_response
from .model.modes import QUANTITIES
from .model.note import Note
from .model.output_path import OutputPath, VelocityDiscrepancy
from .model.simulate import check_geometry
from .parameters import HAMMER_NAMES, STRING_NAMES, Geometry, String, check

__all__ = [
    "fit_path",
    "load_note",
    "relative_gains",
    "notes_of_minima",
    "note_from_document",
    "read_fit",
    "read_output_path",
]

# Largest number of points of an output path, far more than a string has partials.
MOST_POINTS = 4096
# Largest level of an output path, dB. Amplitudes beyond it are lost in rounding.
LARGEST_DB = 300.0
# Range of the decay rate of a partial relative to the string model.
DECAY_RATIO_RANGE = (1e-3, 1e3)
HINT = "give the file that pianofit fit wrote"


def fit_path(path: str | os.PathLike[str]) -> Path:
    """The `fit.json` in a folder, or the file itself."""
    path_name(path)
    return Path(path) / "fit.json" if Path(path).is_dir() else Path(path)


def read_fit(path: str | os.PathLike[str]) -> dict[str, Any]:
    """The content of a `fit.json`.

    Raises
    ------
    FitError
        If the file is not a `fit.json` of this schema; the message names it.
    """
    document = load_json(path, MAX_FIT_BYTES, "a fit.json", HINT)
    if not isinstance(document, dict) or document.get("schema") != FIT_SCHEMA:
        schema = document.get("schema") if isinstance(document, dict) else type(document).__name__
        raise FitError(
            f"{printable(path)}: schema {schema!r} is not {FIT_SCHEMA}; fit again with this version of pianofit"
        )
    return document


def load_note(path: str | os.PathLike[str], felt: FeltLaw | None = None) -> tuple[Note, int]:
    """The note of a `fit.json` at its best minimum, and the sample rate of its reference recording, Hz.

    Parameters
    ----------
    path : a `fit.json`, or its folder, written by `pianofit fit` or `Result.save`.
    felt : the felt law of the fit, if it is your own. The file has only its name.

    Returns
    -------
    A `Note`, and the rate, Hz.

    Raises
    ------
    FitError
        If an entry is missing, of another type, or out of range; the message names file and entry.

    Examples
    --------
    With the folder that the example of `fit` saves:

    >>> import pianofit
    >>> note, rate = pianofit.load_note("fit/fit.json")
    >>> note.render(3.0, seconds=0.5, rate=rate).shape
    (22050,)
    """
    return note_from_document(read_fit(fit_path(path)), fit_path(path), felt)


def note_from_document(document: dict[str, Any], path: Path, felt: FeltLaw | None = None) -> tuple[Note, int]:
    """`load_note` from the content of the file at `path`."""
    name = printable(path)
    table, law = require_table(document, "parameters", name, HINT), _law_of(document, name, felt)
    needed = (*STRING_NAMES, *(HAMMER_NAMES if law is None or law.hammers else law.hammer_parameters))
    values = {key: _number(table, key, name) for key in needed}
    values |= {key: _number(table, key, name) for key in ALL_PARAMETERS if key in table and key not in values}
    string, hammer = _string_and_hammer(values, name, law)
    pickup = require_table(document, "pickup", name, HINT)
    quantity = pickup.get("quantity")
    if quantity not in QUANTITIES:
        raise FitError(f"{name}: pickup.quantity={quantity!r} must be one of {', '.join(QUANTITIES)}")
    index, row = reference_row(document.get("recordings"))
    if not row:
        raise FitError(f"{name}: recordings is empty; {HINT}")
    gain, rate = (require_finite(row.get(key), f"{name}: recordings[{index}].{key}", HINT) for key in ("gain", "rate"))
    if not RATES[0] <= rate <= RATES[1]:
        raise FitError(f"{name}: recordings[{index}].rate={rate:g} Hz must be from {RATES[0]} to {RATES[1]}")
    note = Note(
        string, hammer, _geometry(table, quantity, name), quantity, gain,
        read_output_path(pickup.get("path"), f"{name}: pickup.path", HINT),
        read_modal_response(document.get("ringing"), path.parent, name),
    )  # fmt: skip
    return note, int(rate)


def _law_of(document: dict[str, Any], name: str, felt: FeltLaw | None) -> FeltLaw | None:
    """The felt law that a file names; a law from outside the package must be given as `felt`."""
    named = document.get("felt")
    if felt is not None and named != felt.name:
        raise FitError(f"{name}: its felt law is {named!r}, not {felt.name!r}; give the law of the fit")
    if felt is None and named is not None and named not in LAWS:
        raise FitError(
            f"{name}: its felt law, {short_repr(named)}, is not part of pianofit; give it "
            "as load_note(path, felt=law), or Result.load(folder, felt=law)"
        )
    return LAWS.get(str(named)) if felt is None else felt


def relative_gains(document: dict[str, Any], index: int | None = None) -> tuple[float, ...]:
    """Gains of all recordings in the path group of one, dB relative to it: the reference recording, or row `index`."""
    rows = [row for row in document.get("recordings") or () if isinstance(row, dict)]
    row = reference_row(rows)[1] if index is None else rows[index]
    values = [row.get("gain"), *(other.get("gain") for other in rows if other.get("group") == row.get("group"))]
    size = [abs(float(gain)) if is_number(gain) and gain else np.nan for gain in values]
    gains = 20 * np.log10(np.array(size[1:]) / size[0])
    return tuple(gains[np.isfinite(gains)].tolist()) or (0.0,)


def notes_of_minima(document: dict[str, Any], path: Path, felt: FeltLaw | None = None) -> list[tuple[float, Note]]:
    """Pairs of posterior weight and note for all minima, the best first; errors as in `load_note`.

    Only the best note has the modal response.
    """
    (note, _), name = note_from_document(document, path, felt), printable(path)
    law = _law_of(document, name, felt)
    minima = document.get("minima")
    if not isinstance(minima, list) or len(minima) < 2:
        return [(1.0, note)]
    mixture = []
    for index, entry in enumerate(minima):
        where = f"{name}: minima[{index}]"
        if not isinstance(entry, dict) or not isinstance(entry.get("parameters"), dict):
            raise FitError(f"{where} has no parameters; {HINT}")
        weight = require_finite(entry.get("share"), f"{where}.share", HINT)
        other = _note_of_minimum(note, entry, where, law)
        mixture.append((weight, other._replace(ringing=None) if index else other))
    return mixture


def _note_of_minimum(note: Note, entry: dict, where: str, law: FeltLaw | None) -> Note:
    """`note` with string, hammer, strike position and output path of one minimum."""
    values = {n: require_finite(x, f"{where}.parameters.{n}", HINT) for n, x in entry["parameters"].items()}
    values = {"mu": 0.0, "v_H0": float(note.hammer.v_H0)} | values
    try:
        string, hammer = _string_and_hammer(values, where, law)
        geometry = note.geometry._replace(strike_position=values["x0"], width=values["width"])
        check_geometry(geometry, note.quantity)
    except KeyError as missing:
        raise FitError(f"{where}.parameters lacks {missing}; {HINT}") from None
    except ParameterError as error:
        raise FitError(str(error)) from None
    path = note.path
    if path is not None:
        columns = {"frequency": path.frequency.tolist(), "db": entry.get("path_db")}
        columns |= {} if path.decay is None else {"decay": path.decay.tolist()}
        columns |= {"wander": entry.get("path_wander")}
        path = read_output_path(columns, f"{where}.path", HINT)
    return note._replace(string=string, hammer=hammer, geometry=geometry, path=path)


def _string_and_hammer(values: dict[str, float], where: str, law: FeltLaw | None) -> tuple[String, Any]:
    """String and hammer with `values`, checked against their ranges."""
    try:
        hammer = make_hammer(values, where, law)
        check_hammer(hammer, where)
        return String(**check({name: values[name] for name in STRING_NAMES}, where)), hammer
    except ParameterError as error:
        raise FitError(str(error)) from None


def _geometry(table: dict[str, Any], quantity: str, name: str) -> Geometry:
    length, mass, strike, width = (_number(table, key, name) for key in ("L", "M_S", "x0", "width"))
    pickup = _number(table, "pickup", name) if quantity in ("velocity", "displacement") else 0.5 * length
    geometry = Geometry(length, mass, strike, width, pickup)
    try:
        check_geometry(geometry, quantity)
    except ParameterError as error:
        raise FitError(f"{name}: L, M_S, x0, width and pickup are not consistent: {error}") from None
    return geometry


def _number(table: dict, key: str, name: str) -> float:
    entry = table.get(key)
    value = entry.get("value") if isinstance(entry, dict) else None
    return require_finite(value, f"{name}: parameters.{key}", HINT)


def read_output_path(entry: Any, where: str, hint: str) -> OutputPath | None:
    """Read an output path or None. Errors begin with `where` and end with `hint`."""
    if entry is None:
        return None
    table: dict[str, Any] = entry if isinstance(entry, dict) else {}
    names = ("frequency", "db", *(["decay"] if "decay" in table else []))
    columns = array_of([table.get(name) for name in names], None, None)
    if not (0 < columns.shape[1] <= MOST_POINTS and is_increasing(columns[0])):
        raise FitError(
            f"{where} needs increasing frequencies and as many values of db and decay, at most {MOST_POINTS}; {hint}"
        )
    frequency, db, decay = (*columns, np.ones(columns.shape[1]))[:3]
    if not ((decay >= DECAY_RATIO_RANGE[0]) & (decay <= DECAY_RATIO_RANGE[1])).all():
        raise FitError(
            f"{where}.decay must hold factors from {DECAY_RATIO_RANGE[0]:g} to {DECAY_RATIO_RANGE[1]:g}; {hint}"
        )
    if np.abs(db).max() > LARGEST_DB:
        raise FitError(f"{where}.db reaches {np.abs(db).max():.3g} dB but must be at most {LARGEST_DB:g}; {hint}")
    return OutputPath(frequency, db, decay, _read_discrepancy(table.get("wander"), len(db), f"{where}.wander", hint))


def _read_discrepancy(entry: Any, partials: int, where: str, hint: str) -> VelocityDiscrepancy | None:
    if entry is None:
        return None
    table: dict[str, Any] = entry if isinstance(entry, dict) else {}
    velocity, db = array_of(table.get("velocity"), None), array_of(table.get("db"), None, partials)
    valid = is_increasing(velocity) and len(velocity) == len(db) <= MOST_STROKES
    if not (valid and np.abs(db).max() <= LARGEST_DB):
        raise FitError(
            f"{where} needs 1 to {MOST_STROKES} increasing velocities above 0, m/s, and for each one level of at most "
            f"{LARGEST_DB:g} dB for every partial; {hint}"
        )
    return VelocityDiscrepancy(velocity, db)
