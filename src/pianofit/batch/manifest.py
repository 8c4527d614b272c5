"""From a manifest, a folder or an SFZ file to keys: which recordings belong to which string.

Whatever names the files, it is first read into rows; then all rows are checked before anything starts, and what is
wrong is listed with its place. A key is an instrument and a note. Files must lie inside one folder, the root, after all
links are followed: a manifest that came from elsewhere cannot make the program read what it was not given.
"""

from __future__ import annotations

import csv
import io
import os
import re
import shlex
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from ..analysis.note_names import midi_to_note, note_to_midi
from ..analysis.pitch import check_pitch
from ..conversions import hertz_of
from ..errors import AnalysisError, SetupError
from ..io.files import printable, read_text
from ..io.number_format import counted
from ..parameters import PARAMETERS
from ..recording.recording import is_sound, readable_formats
from .guess import guess_pattern, numbers_off
from .paths import find_file

__all__ = ["Key", "Sample", "files_in", "listed", "manifest_text", "read_keys"]

COLUMNS = ("file", "note", "instrument", "take", "layer", "velocity", "v_H0", "group", "mic")
# Headers of a MIDI velocity, and of a measured one with its unit, such as "velocity (m/s)" or "velocity_m_s".
_MIDI = re.compile(r"(?:midi\W*_?)?velocity(?:\W*_?midi\W*)?")
_MEASURED = re.compile(r"v_h0\b.*|velocity\W*_?m(?:/|_| )?s(?:\W*|\^?-1\W*)")
# What is said where velocities are listed without a unit.
MIDI_VELOCITIES = (
    "velocity is read as the MIDI velocity of a layer, which names it; give measured hammer velocities, m/s, as v_H0"
)
MAX_BYTES = 2**24
MAX_ROWS = 100_000
MAX_TAKES = 64  # of one key: memory of a joint fit grows with them
NAMED = 5  # problems spelt out in one message
RESULTS = {"fit.json", "ledger"}  # a folder with one of these holds what fits have written
_FIELDS = {
    "note": r"[A-Ga-g](?:##|#|♯|bb|b|♭|s)?(?:-1|\d)|\d{1,3}",
    "velocity": r"\d+(?:\.\d+)?", "v_H0": r"\d+(?:\.\d+)?",
    "instrument": r"[^/]+?", "take": r"[^/]+?", "layer": r"[^/]+?", "group": r"[^/]+?",
    "mic": r"[^/]+?", "*": r"[^/]*?",
}  # fmt: skip


class Row(NamedTuple):
    """One recording as it was listed; texts as they stand."""

    where: str  # "line 7"
    file: str
    note: str
    instrument: str = ""
    layer: str = ""
    velocity: str = ""  # MIDI's, or any other name of a layer
    v_H0: str = ""  # hammer velocity, measured, m/s
    group: str = ""


class Sample(NamedTuple):
    """One recording of a key, checked."""

    file: Path  # absolute, links followed
    layer: str
    velocity: float | None  # m/s, measured
    group: str  # recordings of a group share one path, such as a microphone
    stroke: str = ""  # recordings of one hammer stroke, by several microphones


@dataclass(frozen=True)
class Key:
    """All recordings of one string."""

    name: str  # of its folder
    instrument: str
    note: str  # such as F#2
    samples: tuple[Sample, ...]


def read_keys(
    source: Path, *, pattern: str | None = None, root: Path | None = None, transpose: int = 0
) -> tuple[list[Key], list[str]]:
    """Keys in the order of their instruments and pitches, and remarks on what was left out.

    Parameters
    ----------
    source : a CSV file, an SFZ file, or a folder of recordings.
    pattern : for a folder, how its file names are made; `{note}` must be in it, `[...]` may be absent. It is guessed
        from the names if it is not given, and a remark says so.
    root : the folder that all files must lie in; by default that of the manifest.
    transpose : semitones added to every note, for a library that counts octaves otherwise.

    Raises `SetupError`, naming the manifest and every row (up to five) that cannot be used.
    """
    name = printable(source)
    if pattern is not None and not source.is_dir():
        raise SetupError(f"{name}: is no folder, so --pattern {printable(pattern)!r} has no meaning; leave it out")
    if source.is_dir():
        base = source
        rows, remarks = _folder_rows(source, pattern)
    elif source.suffix.lower() == ".sfz":
        from .sfz import sfz_rows

        base = source.parent
        rows, remarks = sfz_rows(source, root or base, transpose)
    else:
        base = source.parent
        rows, remarks = _csv_rows(source)
    return _keys(name, rows, base, (root or base), transpose), remarks


def manifest_text(source: Path) -> str:
    """The text of a manifest, which must be UTF-8 without zero bytes."""
    text = read_text(source, MAX_BYTES, SetupError)
    if "\0" in text:
        line = text.count("\n", 0, text.index("\0")) + 1
        raise SetupError(f"{printable(source)}: has a zero byte on line {line}; it is no text file")
    return text


def _csv_rows(source: Path) -> tuple[list[Row], list[str]]:
    """Rows of a CSV, separated by commas, semicolons or tabs, with a header."""
    name, text = printable(source), manifest_text(source)
    header = text.split("\n", 1)[0].strip().split
    delimiter = next((d for d in ",;\t" if "file" in [c.strip(' "').lower() for c in header(d)]), ",")
    reader = csv.reader(io.StringIO(text, newline=""), delimiter=delimiter, strict=True)
    rows: list[Row] = []
    try:
        columns = [_column(c) for c in next(reader, [])]
        _check_columns(name, columns)
        for cells in reader:
            if not any(c.strip() for c in cells):
                continue
            if len(cells) != len(columns):
                raise SetupError(
                    f"{name}: line {reader.line_num} has {counted(len(cells), 'cell')}, the header {len(columns)}; "
                    "correct it"
                )
            rows.append(_csv_row(f"line {reader.line_num}", dict(zip(columns, cells, strict=True))))
            if len(rows) > MAX_ROWS:
                raise SetupError(f"{name}: has more than {MAX_ROWS} rows; split it")
    except csv.Error as problem:
        raise SetupError(f"{name}: line {reader.line_num}: {problem}; correct that line") from None
    ignored = [c for c in columns if c not in COLUMNS]
    remarks = [f"columns that have no meaning here: {', '.join(map(printable, ignored))}"] if ignored else []
    return rows, remarks + [MIDI_VELOCITIES] * ("velocity" in columns and "v_H0" not in columns)


def _column(header: str) -> str:
    """The name of a column, whatever its case and the unit it is given with."""
    name = header.strip().lower()
    return "v_H0" if _MEASURED.fullmatch(name) else "velocity" if _MIDI.fullmatch(name) else name


def _check_columns(name: str, columns: list[str]) -> None:
    for column in ("file", "note"):
        if column not in columns:
            raise SetupError(
                f"{name}: the header has no column {column!r} (it has {printable(', '.join(columns))[:80]!r}); "
                "give file and note, and if you like instrument, take or layer, velocity, v_H0, group or mic"
            )
    for column in columns:
        if column in COLUMNS and columns.count(column) > 1:
            raise SetupError(f"{name}: the column {column!r} is there twice; remove one")


def _csv_row(where: str, cells: dict[str, str]) -> Row:
    cells = {name: value.strip() for name, value in cells.items()}
    layer = " ".join(filter(None, (cells.get("layer", ""), cells.get("take", ""))))
    group = " ".join(filter(None, (cells.get("group", ""), cells.get("mic", ""))))
    return Row(
        where, cells["file"], cells["note"], cells.get("instrument", ""), layer,
        cells.get("velocity", ""), cells.get("v_H0", ""), group,
    )  # fmt: skip


def _folder_rows(folder: Path, pattern: str | None) -> tuple[list[Row], list[str]]:
    """Rows of the files in `folder` whose names fit `pattern`, or the pattern that is guessed."""
    found, remarks = [file for file in files_in(folder) if is_sound(file)], []
    if not found:
        raise SetupError(f"{printable(folder)}: {_without_sound(folder)}")
    if pattern is None:
        pattern, remarks = _guessed(folder, found)
    expression, rows, others = _expression(pattern), [], []
    for path in found:
        match = expression.fullmatch(path if is_sound(pattern) else _stem(path))
        if match is None:
            others.append(path)
            continue
        cells = {k: v or "" for k, v in match.groupdict().items()}
        rows.append(_csv_row(printable(path), {"file": path, "note": ""} | cells))
    if not rows:
        raise SetupError(
            f"{printable(folder)}: none of {counted(len(others), 'recording')}, such as "
            f"{printable(others[0])!r}, fits the pattern {pattern!r}; {_give_pattern()}"
        )
    left = f"recordings that do not fit the pattern: {len(others)}, such as {printable(others[0])}" if others else ""
    remarks = [*remarks, left] if left else remarks
    return rows, remarks + [MIDI_VELOCITIES] * ("{velocity}" in pattern and "{v_H0}" not in pattern)


def files_in(folder: Path) -> list[str]:
    """Paths of all files below a folder, from there, in order; without hidden ones and what fits have written."""
    found = []
    for place, inner, files in os.walk(folder):
        if Path(place) != folder and RESULTS & {*inner, *files}:
            inner.clear()
            continue
        inner[:] = [name for name in inner if not name.startswith(".")]
        found += [(Path(place) / file).relative_to(folder).as_posix() for file in files if not file.startswith(".")]
    return sorted(found)


def _stem(path: str) -> str:
    return path[: -len(Path(path).suffix)]


def _without_sound(folder: Path) -> str:
    """Why a folder has no recording: what is there instead."""
    endings = Counter(Path(file).suffix.lower() or "no ending" for file in files_in(folder))
    seen = ", ".join(f"{printable(ending)} ({count})" for ending, count in endings.most_common(NAMED))
    there = f"holds no recording that is read, only files with {seen}" if seen else "holds no files"
    return f"{there}; the formats are {readable_formats()}: convert the files to one of these"


def _guessed(folder: Path, found: Sequence[str]) -> tuple[str, list[str]]:
    """The pattern of these names, and remarks on it."""
    stems = [*map(_stem, found)]
    pattern = guess_pattern(stems, _expression)
    if pattern is None:
        raise SetupError(f"{printable(folder)}: no pattern can be guessed, because no part of names such as "
                         f"{printable(found[0])!r} is clearly the note; {_give_pattern()}")  # fmt: skip
    remarks = [f"file names are read as --pattern {printable(shlex.quote(pattern))}"]
    if off := numbers_off(stems):
        remarks.append(f"MIDI numbers in the names are {off:+d} semitones from the note names, which are used; "
                       f"--transpose {off} uses the numbers")  # fmt: skip
    return pattern, remarks


def _give_pattern() -> str:
    return "give --pattern, such as '{instrument}-{note}-{layer}.flac', or a manifest"


def _expression(pattern: str) -> re.Pattern[str]:
    """A file-name pattern as a regular expression."""
    parts, seen, depth = [], [], 0
    for field, other in re.findall(r"\{([a-zA-Z_0-9*]+)\}|(.)", pattern):
        if field and field not in _FIELDS:
            raise SetupError(f"--pattern {pattern!r}: {{{field}}} is not known; there are "
                             f"{', '.join('{' + f + '}' for f in _FIELDS)}")  # fmt: skip
        if field in seen and field != "*":
            raise SetupError(f"--pattern {pattern!r}: {{{field}}} is there twice; use {{*}} for one of them")
        seen += [field] if field else []
        depth += (other == "[") - (other == "]")
        if depth not in (0, 1):
            raise SetupError(f"--pattern {pattern!r}: [ and ] must come in pairs, and not one in another")
        if field:
            parts.append(f"(?:{_FIELDS['*']})" if field == "*" else f"(?P<{field}>{_FIELDS[field]})")
        else:
            parts.append({"[": "(?:", "]": ")?"}.get(other) or re.escape(other))
    if "note" not in seen or depth:
        raise SetupError(f"--pattern {pattern!r}: must hold {{note}}, and a ] for every [")
    return re.compile("".join(parts), re.IGNORECASE)


def _keys(name: str, rows: list[Row], base: Path, root: Path, transpose: int) -> list[Key]:
    """Collect rows into keys; refuse all together what is wrong with any."""
    problems: list[str] = []
    keys: dict[str, tuple[str, int, list[Sample]]] = {}
    seen: dict[Path, str] = {}
    root_folder = root.resolve()
    for row in rows:
        try:
            row = row._replace(layer=_layer(row))
            sample, midi = _sample(row, base, root_folder), note_to_midi(row.note) + transpose
            if not 0 <= midi <= 127:
                raise SetupError(f"note {printable(row.note)!r} is MIDI {midi} with --transpose {transpose}, "
                                 "must be 0 to 127")  # fmt: skip
            check_pitch(hertz_of(midi), f"note {midi_to_note(midi)}")
            if sample.file in seen:
                raise SetupError(f"{printable(row.file)} is also {seen[sample.file]}; list it once")
            seen[sample.file] = row.where
            folder = _folder_name(row.instrument, midi_to_note(midi))
            instrument, _, samples = keys.setdefault(folder.casefold(), (row.instrument, midi, []))
            if instrument != row.instrument:
                raise SetupError(
                    f"instruments {printable(instrument)!r} and {printable(row.instrument)!r} would share "
                    f"the folder {folder}; rename one"
                )
            if row.layer and any((s.layer, s.group) == (row.layer, row.group) for s in samples):
                raise SetupError(f"{folder} has a second {printable(f'{row.layer} {row.group}').strip()!r}; "
                                 "tell them apart by layer, take, group or mic")  # fmt: skip
            told = next((s.velocity for s in samples if s.layer == row.layer and s.velocity is not None), None)
            if row.layer and None not in (told, sample.velocity) and told != sample.velocity:
                raise SetupError(
                    f"{folder} {printable(row.layer)!r} has velocity {sample.velocity:g} and {told:g}; "
                    "one stroke has one: correct it, or give each its own layer or take"
                )
            samples.append(sample)
        except (SetupError, AnalysisError) as problem:
            problems.append(f"{row.where}: {problem}")
    problems += [
        f"{k}: {len(s)} recordings, more than {MAX_TAKES}" for k, (_, _, s) in keys.items() if len(s) > MAX_TAKES
    ]
    if problems:
        raise SetupError(f"{name}: {listed(problems)}; nothing was started")
    if not keys:
        raise SetupError(f"{name}: lists no recording; add rows")
    ordered = sorted(keys.values(), key=lambda k: (k[0].casefold(), k[1]))
    return [Key(_folder_name(i, midi_to_note(m)), i, midi_to_note(m), _with_strokes(s)) for i, m, s in ordered]


def _with_strokes(samples: list[Sample]) -> tuple[Sample, ...]:
    """Samples of a key by name; those of one layer are one stroke, which the groups tell apart."""
    layers = [s.layer for s in samples if s.layer]
    told = (s._replace(stroke=s.layer if layers.count(s.layer) > 1 else "") for s in samples)
    return tuple(sorted(told, key=lambda s: s.file.as_posix()))


def listed(problems: Sequence[str]) -> str:
    """The first of many problems, and how many more there are."""
    more = f"; and {len(problems) - NAMED} more" if len(problems) > NAMED else ""
    return "; ".join(problems[:NAMED]) + more


def _folder_name(instrument: str, note: str) -> str:
    """A folder's name that any file system takes."""
    safe = re.sub(r"[^\w.]+", "-", instrument).strip("-.")[:60]
    return f"{safe}-{note.replace('#', 's')}" if safe else note.replace("#", "s")


def _layer(row: Row) -> str:
    """The name of a recording's layer, with its MIDI velocity, such as "v064", or another text that stands for it."""
    if re.fullmatch(r"[\d.,]+", row.velocity) and not re.fullmatch(r"\d{1,3}", row.velocity, re.ASCII):
        raise SetupError(f"velocity {printable(row.velocity)!r} must be a MIDI velocity, a whole number; give a "
                         "measured hammer velocity, m/s, as v_H0")  # fmt: skip
    velocity = f"v{int(row.velocity):03d}" if row.velocity.isdecimal() else row.velocity
    return " ".join(filter(None, (row.layer, velocity)))


def _sample(row: Row, base: Path, root: Path) -> Sample:
    """A row with its file found inside the root."""
    if not row.file:
        raise SetupError("no file is named")
    return Sample(find_file(row.file, base, root), row.layer, _measured(row.v_H0), row.group)


def _measured(text: str) -> float | None:
    """A hammer velocity in m/s."""
    if not text:
        return None
    box = PARAMETERS["v_H0"]
    try:
        value = float(text)
    except ValueError:
        value = float("nan")
    if not box.lower <= value <= box.upper:
        raise SetupError(f"v_H0 {printable(text)!r} must be a number from {box.lower:g} to {box.upper:g} m/s")
    return value
