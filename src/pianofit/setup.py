"""What was known before the recordings, checked when it is made: in Python, in a dict, or in a `setup.toml`.

A measured length that is mistyped must not silently become an assumed one. So every table, key, type, unit range and
contradiction is checked by `Setup` itself, and what is wrong is named with the key, the value and the way out, in the
words of the file. All values are in SI units; a length in centimetres or a mass in grams falls outside its range.
"""

from __future__ import annotations

import difflib
import os
import tomllib
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field, fields
from numbers import Real
from pathlib import Path
from typing import Any

from .errors import SetupError, check_type
from .felt import BOXES, DEFAULT_LAW, LAWS, FeltLaw, is_builtin
from .io.files import path_name, printable, read_text
from .io.number_format import filled
from .parameters import Parameter

__all__ = ["PICKUPS", "RecordingInfo", "Setup", "recording_info_for", "load_setup", "setup_from_dict"]

PICKUPS = ("velocity", "displacement", "bridge-force", "pressure")
ON_THE_STRING = ("velocity", "displacement")  # pickups that need a position
MAX_BYTES = 2**20

# Lower, upper, unit. A piano's strings are 0.05 to 2.3 m long and weigh 0.1 to 300 g.
RANGES: dict[str, tuple[float, float, str]] = {
    "length": (0.01, 5.0, "m"),
    "mass": (1e-6, 1.0, "kg"),
    "position": (1e-4, 5.0, "m"),
    "width": (1e-5, 1.0, "m"),
    "scale": (1e-12, 1e12, "units at digital full scale"),
}
# What belongs to the felt of some law.
FELT_NAMES = {name for law in LAWS.values() for name in law.parameters}
# What older files call the table of recordings, and the stroke in its entries.
OLDER_TABLE, OLDER_STROKE = "take", "strike"
# Where the attributes of a `Setup` stand in a file; the others have tables of their own.
PLACES = {
    "length": ("string", "length"), "mass": ("string", "mass"),
    "strike_position": ("strike", "position"), "strike_width": ("strike", "width"),
    "pickup_quantity": ("pickup", "quantity"), "pickup_position": ("pickup", "position"),
    "pickup_scale": ("pickup", "scale"), "felt": ("felt", "law"),
}  # fmt: skip


@dataclass(frozen=True, repr=False)
class RecordingInfo:
    """One recording of the note; checked by the `Setup` that it is given to."""

    file: str | None = None
    v_H0: float | None = None  # m/s, measured
    group: str | None = None  # recordings of a group share one output path
    gain_group: str | None = None  # recordings of a gain group share one gain
    stroke: str | None = None  # recordings of one hammer stroke at several microphones have one

    def __repr__(self) -> str:
        return filled(self)


# The tables of a file, and what each may hold.
KEYS: dict[str, tuple[str, ...]] = {
    **{table: tuple(key for other, key in PLACES.values() if other == table) for table, _ in PLACES.values()},
    **dict.fromkeys(("fixed", "initial", "bounds"), tuple(BOXES)),
    "recording": tuple(entry.name for entry in fields(RecordingInfo)),
}


@dataclass(frozen=True, repr=False)
class Setup:
    """What was known beforehand, SI units; None or empty where nothing was said.

    Raises
    ------
    SetupError
        Naming table and key as a `setup.toml` has them, the value, and the way out.
    """

    length: float | None = None  # m
    mass: float | None = None  # kg
    strike_position: float | None = None  # m, from the agraffe
    strike_width: float | None = None  # m, full width of the contact window
    pickup_quantity: str = "pressure"  # one of PICKUPS
    pickup_position: float | None = None  # m, from the agraffe
    pickup_scale: float | None = None  # units (m/s, m or N) at digital full scale; None = uncalibrated
    fixed: dict[str, float] = field(default_factory=dict)  # measured, held fixed
    initial: dict[str, float] = field(default_factory=dict)  # starting values
    bounds: dict[str, tuple[float, float]] = field(default_factory=dict)
    recordings: tuple[RecordingInfo, ...] = ()
    felt: str | FeltLaw | None = None  # the name of one of `felt.LAWS`, or a law of your own

    def __repr__(self) -> str:
        return filled(self)

    def __post_init__(self) -> None:
        checked: dict[str, Any] = {}
        for name, (table, key) in PLACES.items():
            if key in RANGES and getattr(self, name) is not None:
                checked[name] = _number(getattr(self, name), key, *RANGES[key], f"[{table}]")
        _one_of(self.pickup_quantity, PICKUPS, "[pickup] quantity")
        _law(self.felt)
        boxes = BOXES | self.law.boxes
        for name, check in (("fixed", _parameter), ("initial", _parameter), ("bounds", _pair)):
            table = _table(name, getattr(self, name), tuple(boxes))
            checked[name] = {key: check(value, key, f"[{name}]", boxes[key]) for key, value in table.items()}
        if not isinstance(self.recordings, list | tuple):
            raise SetupError(f"recordings = {_show(self.recordings)} must be a list of Layer")
        checked["recordings"] = tuple(_layer(entry, n) for n, entry in enumerate(self.recordings, 1))
        for name, value in checked.items():
            object.__setattr__(self, name, value)  # the numbers as floats; frozen from here on
        for contradictions in (_strike, _pickup, _values, _velocities, _strokes):
            for contradiction in contradictions(self):
                raise SetupError(contradiction)

    @property
    def law(self) -> FeltLaw:
        """The felt's law."""
        return self.felt if isinstance(self.felt, FeltLaw) else LAWS.get(self.felt or "", DEFAULT_LAW)


def recording_info_for(setup: Setup, file: str, alone: bool) -> RecordingInfo:
    """What a setup says of one recording, the only one of its fit if `alone`: the entry of its name, or without any."""
    named = [entry for entry in setup.recordings if entry.file and Path(entry.file).name == Path(file).name]
    nameless = [entry for entry in setup.recordings if alone and not entry.file]
    return next(iter([*named, *nameless]), RecordingInfo())


def load_setup(path: str | os.PathLike[str], felt: str | None = None) -> Setup:
    """Read a `setup.toml`.

    Parameters
    ----------
    path : of the file; its tables and keys, with units, are those of docs/files.md.
    felt : the felt's law, for a file that names none.

    Returns
    -------
    A `Setup`, all values in SI units.

    Raises
    ------
    SetupError
        Naming the file, the key, the value, and the way out.

    Examples
    --------
    >>> import pianofit
    >>> from pathlib import Path
    >>> _ = Path("setup.toml").write_text("string.length = 0.96")
    >>> pianofit.load_setup("setup.toml").length
    0.96
    """
    name = path_name(path)
    try:
        table = tomllib.loads(read_text(path, MAX_BYTES, SetupError))
    except (ValueError, RecursionError) as problem:  # RecursionError: brackets nested without end
        raise SetupError(f"{name}: not valid TOML: {printable(problem)[:200]}; correct that place") from None
    if felt is None:
        return setup_from_dict(table, name)
    said = table.get("felt", {})
    setup = setup_from_dict(table | {"felt": {"law": felt} | said if isinstance(said, dict) else said}, name)
    if setup.law.name != felt:  # the file's own law was checked with the rest of it
        raise SetupError(f'{name}: [felt] law = "{setup.law.name}" contradicts felt={felt!r}; remove one of them')
    return setup


def setup_from_dict(data: Mapping[str, Any], where: str) -> Setup:
    """Make a setup of nested dicts.

    Parameters
    ----------
    data : tables and keys as in a `setup.toml`, SI units.
    where : what every error begins with.

    Returns
    -------
    A `Setup`.

    Raises
    ------
    SetupError
        As `load_setup`.

    Examples
    --------
    >>> import pianofit
    >>> pianofit.setup_from_dict({"string": {"length": 0.96}, "fixed": {"M_H": 0.0087}}, "my grand").fixed
    {'M_H': 0.0087}
    """
    try:
        tables = {name: _entries(name, content) for name, content in _renamed(data).items()}
        said = {name: tables[table][key] for name, (table, key) in PLACES.items() if key in tables.get(table, ())}
        said |= {name: tables[name] for name in ("fixed", "initial", "bounds") if name in tables}
        return Setup(**said, recordings=tuple(tables.get("recording", ())))
    except SetupError as error:
        raise SetupError(f"{where}: {error}") from None


def _renamed(data: Mapping[str, Any]) -> dict[str, Any]:
    """An older file's tables and keys by today's names."""
    check_type("setup=", data, Mapping, "a Setup, tables as in a setup.toml, or the path of one")
    tables = dict(data)
    if OLDER_TABLE in tables:
        older, newer = tables.pop(OLDER_TABLE), tables.get("recording", [])
        tables["recording"] = [*newer, *older] if isinstance(older, list) and isinstance(newer, list) else older
    if isinstance(tables.get("recording"), list):
        tables["recording"] = [
            {"stroke" if key == OLDER_STROKE else key: value for key, value in entry.items()}
            if isinstance(entry, Mapping) and "stroke" not in entry else entry
            for entry in tables["recording"]
        ]  # fmt: skip
    return tables


def _entries(name: str, content: object) -> Any:
    """A table of a file, or the list of its entries, with no key that has no meaning."""
    if name not in KEYS:
        raise SetupError(f"{_show(name)} is not known; {_suggest(name, tuple(KEYS))}")
    if name in ("fixed", "initial", "bounds"):
        return content  # by the felt's law, which another table names
    if name != "recording":
        return _table(name, content)
    if not isinstance(content, list):
        raise SetupError(f"{name} = {_show(content)} must be a list; begin each entry with a line [[{name}]]")
    return [_table(name, entry) for entry in content]


def _table(name: str, content: object, keys: tuple[str, ...] = ()) -> Mapping[str, Any]:
    """A table whose keys all have a meaning: of `keys`, or of those that a file's table of this name has."""
    allowed = keys or KEYS[name]
    if not isinstance(content, Mapping):
        header = f"[[{name}]]" if name == "recording" else f"[{name}]"
        raise SetupError(f"{name} = {_show(content)} must be a table; begin it with a line {header}")
    for key in content:
        if key not in allowed:
            raise SetupError(f"[{name}] {_show(key)} is not known; {_suggest(key, allowed)}")
    return content


def _suggest(key: object, allowed: tuple[str, ...]) -> str:
    """Name the nearest allowed key, the table the key belongs to, or all that is allowed."""
    lower = {name.lower(): name for name in allowed}
    near = difflib.get_close_matches(str(key).lower(), lower, 1, 0.7)
    if near:
        return f"did you mean {lower[near[0]]}?"
    homes = [f"[{table}]" for table, keys in KEYS.items() if key in keys]
    return f"it belongs in {' or '.join(homes)}" if homes else f"known here: {', '.join(allowed)}"


def _show(value: object) -> str:
    """Return a value as one short line."""
    text = printable(value if isinstance(value, str) else repr(value))
    text = text if len(text) <= 60 else text[:57] + "..."
    return f'"{text}"' if isinstance(value, str) else text


def _number(value: Any, key: str, lower: float, upper: float, unit: str, where: str) -> float:
    """Return a number within its range; comparing first keeps integers too large for a float out."""
    if not _is_number(value) or not lower <= value <= upper:
        unit = "" if unit == "1" else f" {unit}"
        quotes = " (no quotes)" if isinstance(value, str) else ""
        raise SetupError(f"{where} {key} = {_show(value)} must be a number from {lower:g} to {upper:g}{unit}{quotes}")
    return float(value)


def _is_number(value: object) -> bool:
    return isinstance(value, Real) and not isinstance(value, bool)  # NumPy's numbers are real ones


def _one_of(value: object, allowed: tuple[str, ...], where: str) -> None:
    if not isinstance(value, str) or value not in allowed:
        raise SetupError(f"{where} = {_show(value)} must be one of {', '.join(allowed)}")


def _law(felt: object) -> None:
    """Refuse what is no law, and a law from outside by the name of one of the package's."""
    if felt is None:
        return
    if not isinstance(felt, FeltLaw):
        _one_of(felt, tuple(LAWS), "[felt] law")
    elif felt.name in LAWS and not is_builtin(felt):
        raise SetupError(f"[felt] law = {_show(felt.name)} is one of the package's own; give yours another name")


def _parameter(value: object, key: str, where: str, box: Parameter) -> float:
    return _number(value, key, box.lower, box.upper, box.unit, where)


def _pair(pair: object, key: str, where: str, box: Parameter) -> tuple[float, float]:
    if not isinstance(pair, list | tuple) or len(pair) != 2:
        raise SetupError(f"{where} {key} = {_show(pair)} must be two numbers, [lower, upper]")
    lower, upper = (_parameter(value, key, where, box) for value in pair)
    if lower >= upper:
        raise SetupError(f"{where} {key} = {_show([*pair])}: lower must be below upper; to hold a value, use [fixed]")
    return lower, upper


def _layer(entry: object, number: int) -> RecordingInfo:
    where = f"[[recording]] {number}"
    said = asdict(entry) if isinstance(entry, RecordingInfo) else _table("recording", entry)
    table = {key: value for key, value in said.items() if value is not None}
    for key, value in table.items():
        if key == "v_H0":
            table[key] = _parameter(value, key, where, BOXES[key])
        elif not (isinstance(value, str) and value.strip()):
            raise SetupError(f"{where} {key} = {_show(value)} must be a text in quotes, not empty")
    if not table:
        raise SetupError(f"{where} is empty; give its file or v_H0, or remove it")
    return RecordingInfo(**table)


# What of a setup cannot be true together, each with the way out.


def _strike(setup: Setup) -> Iterator[str]:
    """A contact window that does not lie on the string."""
    position, length = setup.strike_position, setup.length
    half = (setup.strike_width or 0.0) / 2
    if position is not None and position < half:
        yield (f"[strike] width = {2 * half:g} m reaches past the agraffe from position = {position:g} m; narrow it or "
               "correct the position")  # fmt: skip
    if length is not None and (position or half) + half > length:
        yield (f"[strike] reaches {(position or half) + half:g} m from the agraffe, past the string's length = "
               f"{length:g} m; correct position, width or [string] length")  # fmt: skip


def _pickup(setup: Setup) -> Iterator[str]:
    """A position or a scale that means nothing with the quantity."""
    quantity, position, scale = setup.pickup_quantity, setup.pickup_position, setup.pickup_scale
    if quantity in ON_THE_STRING and position is None:
        yield f'[pickup] quantity = "{quantity}" needs a position in m from the agraffe; add it'
    if quantity not in ON_THE_STRING and position is not None:
        yield (f'[pickup] position = {position:g} has no meaning with quantity = "{quantity}"; say velocity or '
               "displacement, or remove the position")  # fmt: skip
    if quantity == "pressure" and scale is not None:
        yield (f'[pickup] scale = {scale:g} has no meaning with quantity = "pressure", which comes through an unknown '
               "path; say velocity, displacement or bridge-force, or remove the scale")  # fmt: skip
    if position is not None and setup.length is not None and position >= setup.length:
        yield (f"[pickup] position = {position:g} m is not on the string of length = {setup.length:g} m; correct one "
               "of them")  # fmt: skip


def _values(setup: Setup) -> Iterator[str]:
    """A value both known and free, one that the felt's law does not have, or a start outside its bounds."""
    law = setup.law
    for name in setup.fixed:
        for table, given in (("initial", setup.initial), ("bounds", setup.bounds)):
            if name in given:
                yield f"{name} is in [fixed], held fixed, and in [{table}]; remove one of them"
    for name in (*setup.fixed, *setup.initial, *setup.bounds):
        if name in FELT_NAMES and name not in law.parameters:
            has = ", ".join(law.parameters)
            yield f"{name} is no parameter of the felt's law, {law.name}, which has {has}; remove it"
    for name, (lower, upper) in setup.bounds.items():
        if not lower <= (value := setup.initial.get(name, lower)) <= upper:
            yield f"[initial] {name} = {value:g} is outside its [bounds] {lower:g} to {upper:g}; correct one"


def _velocities(setup: Setup) -> Iterator[str]:
    """A second velocity for a recording, or a file named twice."""
    lower, upper = setup.bounds.get("v_H0", (0.0, float("inf")))
    files: set[str] = set()
    for number, layer in enumerate(setup.recordings, 1):
        entry, velocity = f"[[recording]] {number}", layer.v_H0
        if layer.file in files:
            yield f'{entry} file = "{printable(layer.file)}" is there twice; remove one'
        if velocity is not None and "v_H0" in setup.fixed:
            yield f"{entry} v_H0 = {velocity:g} is also in [fixed]; remove one of them"
        if velocity is not None and not lower <= velocity <= upper:
            yield f"{entry} v_H0 = {velocity:g} is outside its [bounds] {lower:g} to {upper:g}; correct one"
        files |= {layer.file} if layer.file else set()


def _strokes(setup: Setup) -> Iterator[str]:
    """One stroke with two velocities, or observed twice by one microphone."""
    observed: dict[tuple[str, str | None], int] = {}
    struck: dict[str, float] = {}
    for number, layer in enumerate(setup.recordings, 1):
        if layer.stroke is None:
            continue
        entry = f'[[recording]] {number} stroke = "{printable(layer.stroke)}"'
        other = observed.setdefault((layer.stroke, layer.group), number)
        if other != number:
            group = "neither has a group" if layer.group is None else f'both have group = "{printable(layer.group)}"'
            yield (f"{entry} is that of [[recording]] {other}, and {group}; a microphone observes a stroke once: give "
                   "each its own group, or another stroke")  # fmt: skip
        if layer.v_H0 is not None and (first := struck.setdefault(layer.stroke, layer.v_H0)) != layer.v_H0:
            yield f"{entry} has v_H0 = {layer.v_H0:g} and {first:g}; one stroke has one velocity: correct one"
