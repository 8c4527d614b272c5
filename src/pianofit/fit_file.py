"""A `fit.json` read back: the note that it describes, at its best minimum or at all of them.

The file holds all that a note needs: string, hammer, geometry, what was heard, gain and path. Nothing in it is trusted
before it was checked.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np

from .errors import FitError, ParameterError
from .felt import BOXES, LAWS, FeltLaw, check_hammer, make_hammer
from .io.audio import RATES
from .io.files import (
    FIT_SCHEMA,
    LARGEST_FIT,
    array_of,
    is_increasing,
    load_json,
    path_name,
    printable,
    reference_of,
    require_finite,
    short_repr,
    table_of,
)
from .io.number_format import is_number
from .modal_response_file import MOST_STROKES, read_ringing
from .model.modes import QUANTITIES
from .model.note import Note
from .model.output_path import OutputPath, VelocityDiscrepancy
from .model.simulate import check_geometry
from .parameters import HAMMER_NAMES, STRING_NAMES, Geometry, String, check

__all__ = ["fit_path", "load_note", "gains_of", "mixture_of", "note_of", "read_fit", "read_path"]

# Points of a path at the most: far more than a string has partials.
MOST_POINTS = 4096
# Of a path, dB, at the most: beyond, amplitudes are lost in rounding.
LARGEST_DB = 300.0
# A partial's decay over its law's, at the least and at the most: beyond, it is no partial.
DECAYS = (1e-3, 1e3)
WAY_OUT = "give the file that pianofit fit wrote"


def fit_path(path: str | os.PathLike[str]) -> Path:
    """The `fit.json` in a folder, or the file itself."""
    path_name(path)
    return Path(path) / "fit.json" if Path(path).is_dir() else Path(path)


def read_fit(path: str | os.PathLike[str]) -> dict[str, Any]:
    """What a `fit.json` holds, of this schema or an older one; a `FitError` that names the file, if it is none."""
    document = load_json(path, LARGEST_FIT, "a fit.json", WAY_OUT)
    if not isinstance(document, dict) or document.get("schema") not in range(1, FIT_SCHEMA + 1):
        found = document.get("schema") if isinstance(document, dict) else type(document).__name__
        raise FitError(
            f"{printable(path)}: schema {found!r} is not 1 to {FIT_SCHEMA}; fit again with this version of pianofit"
        )
    return _renamed(document)


def _renamed(document: dict[str, Any]) -> dict[str, Any]:
    """A document of an older schema, up to 3, by today's names."""
    if document["schema"] < FIT_SCHEMA and "takes" in document:
        document["recordings"] = document.pop("takes")
        for row in document["recordings"] if isinstance(document["recordings"], list) else ():
            if isinstance(row, dict) and "strike" in row:
                row["stroke"] = row.pop("strike")
    return document


def load_note(path: str | os.PathLike[str], felt: FeltLaw | None = None) -> tuple[Note, int]:
    """The note that a `fit.json` describes at its best minimum, and the rate of the recording it was fitted to, Hz.

    A file of the first schema has the same note. Of a fit with a felt law of your own, which a file only names, `felt`
    is that law.

    Parameters
    ----------
    path : of a `fit.json`, or the folder it is in, written by `pianofit fit` or `Result.save`.
    felt : the law of the felt, if it is one of your own.

    Returns
    -------
    A `Note`, and the rate, Hz.

    Raises
    ------
    FitError
        Naming the file and the entry that is missing, of another kind, or out of range.

    Examples
    --------
    With the folder that the example of `fit` saves:

    >>> import pianofit
    >>> note, rate = pianofit.load_note("fit/fit.json")
    >>> note.render(3.0, seconds=0.5, rate=rate).shape
    (22050,)
    """
    return note_of(read_fit(fit_path(path)), fit_path(path), felt)


def note_of(document: dict[str, Any], path: Path, felt: FeltLaw | None = None) -> tuple[Note, int]:
    """`load_note` of what the file at `path` held."""
    name = printable(path)
    table, law = table_of(document, "parameters", name, WAY_OUT), _law_of(document, name, felt)
    needed = (*STRING_NAMES, *(HAMMER_NAMES if law is None or law.hammers else law.boxes))
    values = {key: _number(table, key, name) for key in needed}
    values |= {key: _number(table, key, name) for key in BOXES if key in table and key not in values}
    string, hammer = _struck(values, name, law)
    pickup = table_of(document, "pickup", name, WAY_OUT)
    quantity = pickup.get("quantity")
    if quantity not in QUANTITIES:
        raise FitError(f"{name}: pickup.quantity={quantity!r} must be one of {', '.join(QUANTITIES)}")
    at, row = reference_of(document.get("recordings"))
    if not row:
        raise FitError(f"{name}: recordings is empty; {WAY_OUT}")
    gain, rate = (require_finite(row.get(key), f"{name}: recordings[{at}].{key}", WAY_OUT) for key in ("gain", "rate"))
    if not RATES[0] <= rate <= RATES[1]:
        raise FitError(f"{name}: recordings[{at}].rate={rate:g} Hz must be from {RATES[0]} to {RATES[1]}")
    note = Note(
        string, hammer, _geometry(table, quantity, name), quantity, gain,
        read_path(pickup.get("path"), f"{name}: pickup.path", WAY_OUT),
        read_ringing(document.get("ringing"), path.parent, name),
    )  # fmt: skip
    return note, int(rate)


def _law_of(document: dict[str, Any], name: str, felt: FeltLaw | None) -> FeltLaw | None:
    """The law that a file names, which for one from outside of the package must be handed in."""
    named = document.get("felt")
    if felt is not None and named != felt.name:
        raise FitError(f"{name}: its felt's law is {named!r}, not {felt.name!r}; give the law it was fitted with")
    if felt is None and named is not None and named not in LAWS:
        raise FitError(
            f"{name}: its felt's law, {short_repr(named)}, is not the package's; hand it in, "
            "as load_note(path, felt=law), or Result.load(folder, felt=law)"
        )
    return LAWS.get(str(named)) if felt is None else felt


def gains_of(document: dict[str, Any], at: int | None = None) -> tuple[float, ...]:
    """Gains of the recordings through one recording's path, dB over its own: the reference's, or that of row `at`."""
    rows = [row for row in document.get("recordings") or () if isinstance(row, dict)]
    row = reference_of(rows)[1] if at is None else rows[at]
    own = [row.get("gain"), *(other.get("gain") for other in rows if other.get("group") == row.get("group"))]
    size = [abs(float(gain)) if is_number(gain) and gain else np.nan for gain in own]
    gains = 20 * np.log10(np.array(size[1:]) / size[0])
    return tuple(gains[np.isfinite(gains)].tolist()) or (0.0,)


def mixture_of(document: dict[str, Any], path: Path, felt: FeltLaw | None = None) -> list[tuple[float, Note]]:
    """The notes of all minima in the document of `path`, with their shares, the best first; errors as of `load_note`.

    Only the best note rings by the key's modes, see `ringing`.
    """
    (note, _), name = note_of(document, path, felt), printable(path)
    law = _law_of(document, name, felt)
    minima = document.get("minima")
    if not isinstance(minima, list) or len(minima) < 2:
        return [(1.0, note)]
    mixture = []
    for at, entry in enumerate(minima):
        where = f"{name}: minima[{at}]"
        if not isinstance(entry, dict) or not isinstance(entry.get("parameters"), dict):
            raise FitError(f"{where} has no parameters; {WAY_OUT}")
        own = _of_minimum(note, entry, where, law)
        mixture.append(
            (require_finite(entry.get("share"), f"{where}.share", WAY_OUT), own._replace(ringing=None) if at else own)
        )
    return mixture


def _of_minimum(note: Note, entry: dict, where: str, law: FeltLaw | None) -> Note:
    """`note` with one minimum's string, hammer, strike position and path."""
    values = {n: require_finite(x, f"{where}.parameters.{n}", WAY_OUT) for n, x in entry["parameters"].items()}
    values = {"mu": 0.0, "v_H0": float(note.hammer.v_H0)} | values
    try:
        string, hammer = _struck(values, where, law)
        geometry = note.geometry._replace(strike_position=values["x0"], width=values["width"])
        check_geometry(geometry, note.quantity)
    except KeyError as missing:
        raise FitError(f"{where}.parameters lacks {missing}; {WAY_OUT}") from None
    except ParameterError as error:
        raise FitError(str(error)) from None
    path = note.path
    if path is not None:
        own = {"frequency": path.frequency.tolist(), "db": entry.get("path_db")}
        own |= {} if path.decay is None else {"decay": path.decay.tolist()}
        own |= {"wander": entry.get("path_wander")}
        path = read_path(own, f"{where}.path", WAY_OUT)
    return note._replace(string=string, hammer=hammer, geometry=geometry, path=path)


def _struck(values: dict[str, float], where: str, law: FeltLaw | None) -> tuple[String, Any]:
    """String and hammer of `values`, within their boxes."""
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
        raise FitError(f"{name}: L, M_S, x0, width and pickup make no string: {error}") from None
    return geometry


def _number(table: dict, key: str, name: str) -> float:
    entry = table.get(key)
    value = entry.get("value") if isinstance(entry, dict) else None
    return require_finite(value, f"{name}: parameters.{key}", WAY_OUT)


def read_path(entry: Any, where: str, way_out: str) -> OutputPath | None:
    """An output path as files have it, or None; a `FitError` that begins with `where` if it is neither."""
    if entry is None:
        return None
    table: dict[str, Any] = entry if isinstance(entry, dict) else {}
    names = ("frequency", "db", *(["decay"] if "decay" in table else []))
    columns = array_of([table.get(name) for name in names], None, None)
    if not (0 < columns.shape[1] <= MOST_POINTS and is_increasing(columns[0])):
        raise FitError(
            f"{where} needs frequency, rising, db and decay, above 0, as many, at most {MOST_POINTS}; {way_out}"
        )
    frequency, db, decay = (*columns, np.ones(columns.shape[1]))[:3]
    if not ((decay >= DECAYS[0]) & (decay <= DECAYS[1])).all():
        raise FitError(f"{where}.decay must hold factors from {DECAYS[0]:g} to {DECAYS[1]:g}; {way_out}")
    if np.abs(db).max() > LARGEST_DB:
        raise FitError(f"{where}.db reaches {np.abs(db).max():.3g} dB, at most {LARGEST_DB:g}; {way_out}")
    return OutputPath(frequency, db, decay, _wander(table.get("wander"), len(db), f"{where}.wander", way_out))


def _wander(entry: Any, partials: int, where: str, way_out: str) -> VelocityDiscrepancy | None:
    if entry is None:
        return None
    table: dict[str, Any] = entry if isinstance(entry, dict) else {}
    velocity, db = array_of(table.get("velocity"), None), array_of(table.get("db"), None, partials)
    known = is_increasing(velocity) and len(velocity) == len(db) <= MOST_STROKES
    if not (known and np.abs(db).max() <= LARGEST_DB):
        raise FitError(
            f"{where} needs 1 to {MOST_STROKES} velocities, m/s, that rise from above 0, and for each up to "
            f"{LARGEST_DB:g} dB for every partial; {way_out}"
        )
    return VelocityDiscrepancy(velocity, db)
