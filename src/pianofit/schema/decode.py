"""Decoding of JSON and TOML into the frozen dataclasses of this package, and encoding of them.

msgspec checks types, required fields and limits (`Annotated[float, Meta(ge=...)]`). This module adds what it does not
do: NumPy arrays, types that are written in another form (`from_builtins` and `to_builtins`), and messages that name the
entry, its value and what is expected.
"""

import json
import os
import re
from dataclasses import fields, is_dataclass
from typing import Annotated, Any, Literal, TypeVar, get_args, get_origin, get_type_hints

import msgspec
import numpy as np
from msgspec import Meta

from ..conversions import MIDI_VELOCITIES
from ..errors import FitError, PianofitError
from ..io.files import json_text, printable, read_file, short_repr
from ..io.number_format import LARGEST

T = TypeVar("T")
# A finite number that can be squared without overflow.
Number = Annotated[float, Meta(ge=-LARGEST, le=LARGEST)]
MidiVelocity = Annotated[float, Meta(ge=MIDI_VELOCITIES[0], le=MIDI_VELOCITIES[1])]


# Words of a user for the names of types in the messages of msgspec.
WORDS = {
    "float": "a number",
    "int": "a whole number",
    "str": "a text",
    "bool": "true or false",
    "array": "a list",
    "object": "a table",
    "null": "null",
}
EXPECTED = re.compile(r"Expected `([^`]+)`(?:, got `[^`]+`| ([<>]=? \S+)| (of .+))?")
MISSING = re.compile(r"Object missing required field `(.+)`")


def load_json(
    path: str | os.PathLike[str], limit: int, what: str, hint: str, error: type[PianofitError] = FitError
) -> Any:
    """Return the content of a JSON file of at most `limit` bytes.

    An `error` names the file and `what` it should be, and ends with the `hint`.
    """
    data = read_file(path, limit, error)
    try:
        return msgspec.json.decode(data)
    except (msgspec.DecodeError, RecursionError, UnicodeDecodeError) as problem:
        reason = printable(str(problem).splitlines()[0])
        raise error(f"{printable(path)}: not {what} ({reason}); {hint}") from None


def load_record(
    path: str | os.PathLike[str],
    record: type[T],
    limit: int,
    what: str,
    hint: str,
    error: type[PianofitError] = FitError,
) -> T:
    """Read a JSON file as a `record`, whose kind and schema it must state; errors as of `load_json` and `convert`."""
    content = load_json(path, limit, what, hint, error)
    own = {name: getattr(record, name) for name in ("kind", "schema")}
    if not isinstance(content, dict) or own != {name: content.get(name) for name in own}:
        raise error(f"{printable(path)}: is not {what} of schema {own['schema']}; {hint}")
    return convert(content, record, printable(path), hint, error)


def convert(data: Any, kind: type[T], where: str, hint: str, error: type[PianofitError] = FitError) -> T:
    """Return dicts and lists as a `kind`. An `error` begins with `where` and the entry, and ends with the `hint`."""
    try:
        return msgspec.convert(data, kind, dec_hook=_decode)
    except (msgspec.ValidationError, RecursionError) as problem:
        raise error(f"{where}: {_message(str(problem), data, kind)}; {hint}") from None


def builtins_of(record: Any) -> Any:
    """Return a record as dicts, lists, numbers and texts, as a file has it."""
    return json.loads(_text(record))


def encode_json(record: Any) -> bytes:
    """Return a record as indented JSON without NaN."""
    return _text(record).encode()


def _text(record: Any) -> str:
    return json_text(msgspec.to_builtins(record, enc_hook=_encode))


def _encode(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, np.generic):
        return value.item()
    if hasattr(value, "to_builtins"):
        return value.to_builtins()
    raise NotImplementedError(f"{type(value).__name__} has no form in files")


def _decode(kind: Any, value: Any) -> Any:
    """Convert what msgspec does not know: arrays, and types with `from_builtins`."""
    if kind is np.ndarray:
        return _array(value)
    if hasattr(kind, "from_builtins"):
        return kind.from_builtins(value, _nested)
    raise NotImplementedError(f"{kind} has no form in files")


def _nested(value: Any, kind: type[T], where: str) -> T:
    """Convert an entry of a type with `from_builtins`. The message of an error names `where` it is."""
    try:
        return msgspec.convert(value, kind, dec_hook=_decode)
    except msgspec.ValidationError as problem:
        text, path = _split(str(problem))
        raise ValueError(f"{text} - at `$.{where}{path}`") from None


def _array(value: Any) -> np.ndarray:
    try:
        array = np.array(value)
    except ValueError:  # rows of different lengths
        array = np.array(None)
    if not isinstance(value, list) or array.dtype.kind not in "iuf" or not (np.abs(array) <= LARGEST).all():
        raise ValueError("Expected lists of finite numbers of one length")
    return array.astype(float)


# --- messages ---------------------------------------------------------------------------------------------------------


def _split(problem: str) -> tuple[str, str]:
    """Return the text of msgspec's message and the path of the entry, such as `.recordings[0].gain`."""
    text, *paths = re.split(r" - at `\$(.*?)`", problem)
    return text, "".join(path for path in reversed(paths) if path)


def _message(problem: str, data: Any, kind: Any) -> str:
    """Return a message with the entry, its value and what is expected."""
    text, path = _split(problem)
    path = _with_names(path, data, kind)
    if missing := MISSING.match(text):
        return f"{(path + '.' + missing[1]).lstrip('.')} is missing"
    entry = path.lstrip(".") or "the content"
    shown = f"{entry} = {short_repr(_value_at(data, path))}" if path else entry
    if choices := _choices(kind, path):
        return f"{shown} must be one of {', '.join(map(str, choices))}"
    if expected := EXPECTED.match(text):
        name, limit, length = expected.groups()
        words = " or ".join(WORDS.get(part, part) for part in name.split(" | "))
        return f"{shown} must be {words}{_limit_in_words(limit)}{f' {length}' * bool(length)}"
    return f"{shown}: {text[:1].lower() + text[1:]}"


def _with_names(path: str, data: Any, kind: Any) -> str:
    """Return a path with the name of the entry of a table, which msgspec writes as `[...]`."""
    before, dots, _ = path.partition("[...]")
    if not dots:
        return path
    whole = _kind_at(kind, before)
    entry_kind = next(get_args(part)[1] for part in (whole, *get_args(whole)) if get_origin(part) is dict)
    for name, entry in _value_at(data, before).items():
        try:
            msgspec.convert(entry, entry_kind, dec_hook=_decode)
        except msgspec.ValidationError as problem:
            return f"{before}.{name}{_with_names(_split(str(problem))[1], entry, entry_kind)}"
    return path


def _limit_in_words(limit: str | None) -> str:
    """Return words for a limit of msgspec, such as `>= 0.5`."""
    if limit is None:
        return ""
    sign, value = limit.split()
    if abs(float(value)) >= LARGEST:
        return " that is finite"
    words = {">=": "of at least", "<=": "of at most", ">": "above", "<": "below"}
    return f" {words[sign]} {float(value):g}"


def _steps(path: str) -> list[str | int]:
    """Return the keys and indices of a path."""
    return [int(index) if index else name for name, index in re.findall(r"\.([^.\[]+)|\[(\d+)\]", path)]


def _value_at(data: Any, path: str) -> Any:
    """Return the value at a path; None where there is none."""
    for step in _steps(path):
        try:
            data = data[step]
        except (KeyError, IndexError, TypeError):
            return None
    return data


def _kind_at(kind: Any, path: str) -> Any:
    """Return the type of the entry at a path. Entries of lists and tables have the type of the whole."""
    for step in _steps(path):
        for part in _parts(kind):
            part = getattr(part, "entry_type", part)
            if is_dataclass(part) and step in {field.name for field in fields(part)}:
                kind = get_type_hints(part, include_extras=True)[step]
    return kind


def _parts(kind: Any) -> list[Any]:
    """Return the types that a type is made of, without None."""
    if get_origin(kind) is Literal or not get_args(kind):
        return [] if kind is type(None) else [kind]
    return [part for inner in get_args(kind) for part in _parts(inner)]


def _choices(kind: Any, path: str) -> tuple[Any, ...]:
    """Return the values that a `Literal` at a path allows; empty for other types."""
    parts = _parts(_kind_at(kind, path))
    return get_args(parts[0]) if len(parts) == 1 and get_origin(parts[0]) is Literal else ()
