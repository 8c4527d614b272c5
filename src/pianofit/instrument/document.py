"""Instruments from `instrument.json`, whose entries are all checked, or from a folder of fits."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

from ..analysis.note_names import midi_to_note
from ..errors import FitError, ParameterError
from ..fit_file import read_output_path
from ..io.files import load_json, printable, require_finite, require_table, short_repr
from ..io.number_format import is_number
from ..modal_response_file import read_modal_response
from ..model.modes import QUANTITIES
from ..model.note import Note
from ..model.simulate import check_geometry
from ..parameters import PARAMETERS, Geometry, Hammer, String, check
from .build import CHANGED, KEY_STATES, NEIGHBOURS, SCHEMA, build_instrument
from .collect_fits import HIGHEST_KEY, LOWEST_KEY, NAMES, Layer, find_fits, instrument_name, load_keys
from .interpolate_keys import interpolate_keys
from .velocity import hammer_velocity

__all__ = ["FILE", "Instrument", "load_instrument", "read_instrument"]

FILE = "instrument.json"

LARGEST_FILE = 2**25
LARGEST_GAIN = 1e12
LONGEST = 600.0  # s, of a recording
HINT = "give the instrument.json that pianofit instrument wrote"


class Instrument(NamedTuple):
    """The notes of a playable instrument."""

    name: str
    notes: dict[int, Note]  # by MIDI key
    velocity_at_64: float  # hammer velocity at MIDI velocity 64, m/s
    velocity_slope: float  # increase of its logarithm from 64 to 127
    recorded: frozenset[int] = frozenset()  # keys with a fit; the others follow from the laws
    # By key and law of `NAMES`: the value and both ends of its 95 % interval, if the document has them.
    values: Mapping[int, Mapping[str, tuple[float, float, float]]] = MappingProxyType({})
    layers: Mapping[int, tuple[Layer, ...]] = MappingProxyType({})  # recordings of the recorded keys, soft to loud
    states: Mapping[int, str] = MappingProxyType({})  # by key, one of `KEY_STATES` or `CHANGED`

    @property
    def channels(self) -> int:
        """Number of channels: the largest of all keys."""
        return max(1 if note.ringing is None else note.ringing.channels for note in self.notes.values())

    @property
    def changed(self) -> list[int]:
        """The keys that were changed by hand on the playable page."""
        return sorted(midi for midi, state in self.states.items() if state == CHANGED)

    def unrecorded_keys(self, keys: Iterable[int]) -> list[int]:
        """Those of these MIDI keys that were never recorded. They follow from the laws."""
        return sorted(set(keys) - self.recorded)

    @property
    def unrecorded_counts(self) -> tuple[int, int]:
        """Numbers of keys that were never recorded: between recorded keys, and beyond them."""
        unrecorded = self.unrecorded_keys(self.notes)
        between = sum(min(self.recorded) < midi < max(self.recorded) for midi in unrecorded) if self.recorded else 0
        return between, len(unrecorded) - between

    @property
    def pre_onset_s(self) -> float:
        """Longest time from the begin of a sound to its contact, s."""
        return max(note.pre_onset_s for note in self.notes.values())

    def note(self, midi: int, velocity: float) -> Note:
        """The key `midi` struck at MIDI velocity `velocity`, 1 to 127.

        Raises `ParameterError` if the instrument does not have this key.
        """
        if midi not in self.notes:
            span = f"{midi_to_note(min(self.notes))} to {midi_to_note(max(self.notes))}"
            raise ParameterError(f"key {midi} is not on this instrument; it has {span}")
        return self.notes[midi].with_velocity(hammer_velocity(velocity, self.velocity_at_64, self.velocity_slope))


def load_instrument(path: str | os.PathLike[str], prefix: str | None = None) -> Instrument:
    """Load an instrument from a file, or from a folder with an `instrument.json` or with fits.

    Parameters
    ----------
    prefix : name of the instrument, if a folder holds fits of several.

    Raises `FitError` with the file and the entry that is missing, of the wrong type, or out of range. It names the
    folder if that holds no fits, or fits of several instruments without a `prefix`.
    """
    path = Path(path)
    if path.is_dir() and not (path / FILE).is_file():
        files = find_fits([path], prefix)
        name = prefix or instrument_name(files[0]) or path.resolve().name
        return read_instrument(build_instrument(load_keys(files), printable(name)), printable(path))
    if prefix is not None:
        raise ParameterError(
            f"--prefix {short_repr(prefix)} chooses among a folder's fits, and {printable(path)} holds one instrument"
        )
    file = path / FILE if path.is_dir() else path
    return read_instrument(load_json(file, LARGEST_FILE, "an instrument.json", HINT), printable(file))


def read_instrument(document: Any, name: str = "instrument") -> Instrument:
    """The instrument in a document. Errors are those of `load_instrument` and begin with `name`."""
    kind, schema = map(document.get, ("kind", "schema")) if isinstance(document, dict) else (None, None)
    if kind != "instrument" or schema != SCHEMA:
        raise FitError(f"{name}: is not an instrument of schema {SCHEMA}; {HINT}")
    quantity = document.get("quantity")
    if quantity not in QUANTITIES:
        raise FitError(f"{name}: quantity={short_repr(quantity)} must be one of {', '.join(QUANTITIES)}")
    rows = document.get("keys")
    if not (isinstance(rows, list) and 0 < len(rows) <= HIGHEST_KEY - LOWEST_KEY + 1):
        raise FitError(f"{name}: keys must be a list of 1 to 88 keys; {HINT}")
    notes: dict[int, Note] = {}
    for i, row in enumerate(rows):
        midi, note = _key(row, quantity, f"{name}: keys[{i}]")
        if midi in notes:
            raise FitError(f"{name}: keys[{i}].midi={midi} occurs twice; {HINT}")
        notes[midi] = note
    notes |= interpolate_keys(notes, [row["midi"] for row in rows if row.get("ringing") == NEIGHBOURS])
    velocity = require_table(document, "velocity", name, HINT)
    at_64, rise = (require_finite(velocity.get(key), f"{name}: velocity.{key}", HINT) for key in ("at_64", "rise"))
    box = PARAMETERS["v_H0"]
    if not (box.lower <= at_64 <= box.upper and 0 < rise <= 10):
        raise FitError(f"{name}: velocity at_64={at_64:g} m/s, rise={rise:g} must be in range and rise; {HINT}")
    title = document.get("name")
    recorded = frozenset(row["midi"] for row in rows if isinstance(row.get("fit"), dict))
    values = {row["midi"]: _values(row.get("told")) for row in rows}
    layers = {row["midi"]: _layers(row["fit"].get("layers")) for row in rows if row["midi"] in recorded}
    states = {row["midi"]: row["state"] for row in rows if row.get("state") in (*KEY_STATES, CHANGED)}
    title = printable(title) if isinstance(title, str) else ""
    return Instrument(title, notes, at_64, rise, recorded, values, layers, states)


def _key(row: Any, quantity: str, where: str) -> tuple[int, Note]:
    if not isinstance(row, dict):
        raise FitError(f"{where} must be a table; {HINT}")
    midi = row.get("midi")
    if isinstance(midi, bool) or not isinstance(midi, int) or not LOWEST_KEY <= midi <= HIGHEST_KEY:
        raise FitError(f"{where}.midi={short_repr(midi)} must be a key from {LOWEST_KEY} to {HIGHEST_KEY}")
    parts = {}
    for name, kind in (("string", String), ("hammer", Hammer), ("geometry", Geometry)):
        table = require_table(row, name, where, HINT)
        fields = [field for field in kind._fields if field != "v_H0" and field not in kind._field_defaults]
        parts[name] = {field: require_finite(table.get(field), f"{where}.{name}.{field}", HINT) for field in fields}
    try:
        check(parts["string"] | parts["hammer"], where)
        geometry = Geometry(**parts["geometry"])
        check_geometry(geometry, quantity)
    except ParameterError as error:
        raise FitError(str(error) if str(error).startswith(where) else f"{where}: {error}") from None
    hammer = Hammer(**parts["hammer"], v_H0=2.0)
    gain = require_finite(row.get("gain"), f"{where}.gain", HINT)
    if not abs(gain) <= LARGEST_GAIN:
        raise FitError(f"{where}.gain={gain:g} must be from -{LARGEST_GAIN:g} to {LARGEST_GAIN:g}")
    path, entry = read_output_path(row.get("path"), f"{where}.path", HINT), row.get("ringing")
    ringing = None if entry == NEIGHBOURS else read_modal_response(entry, None, where)
    return midi, Note(String(**parts["string"]), hammer, geometry, quantity, gain, path, ringing)


def _layers(rows: Any) -> tuple[Layer, ...]:
    """The recordings of a key. Malformed rows are left out, because playing does not need them."""
    box, layers = PARAMETERS["v_H0"], []
    for row in rows if isinstance(rows, list) else ():
        match row:
            case {
                "file": str(file),
                "sha256": str(sha256),
                "contact": int() | float() as contact,
                "velocity": int() | float() as velocity,
            }:
                if abs(contact) < LONGEST and box.lower <= velocity <= box.upper:
                    layers.append(Layer(file, sha256, float(contact), float(velocity)))
    return tuple(layers)


def _values(table: Any) -> dict[str, tuple[float, float, float]]:
    """Values with their intervals. Malformed entries are left out, because they are only shown."""
    values = {}
    for name, entry in table.items() if isinstance(table, dict) else ():
        match entry:
            case {"value": int() | float() as value, "interval": [int() | float() as low, int() | float() as high]}:
                if name in NAMES and all(map(is_number, (value, low, high))):
                    values[name] = (float(value), float(low), float(high))
    return values
