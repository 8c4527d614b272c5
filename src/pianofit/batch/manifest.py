"""Keys and their recordings, read from a CSV file, a folder or an SFZ file.

Each source is first read into rows. All rows are checked before anything starts, and every problem is listed with its
place. A key is an instrument and a note. After all links are followed, files must lie inside one folder, the root. A
manifest from an untrusted source therefore cannot make the program read other files.
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
from .guess import guess_pattern, midi_number_offset
from .paths import find_file

__all__ = ["Key", "Sample", "files_in", "first_problems", "manifest_text", "read_keys"]

COLUMNS = ("file", "note", "instrument", "take", "layer", "velocity", "v_H0", "group", "mic")
# Headers of a MIDI velocity, and of a measured one with its unit, such as "velocity (m/s)" or "velocity_m_s".
_MIDI_VELOCITY = re.compile(r"(?:midi\W*_?)?velocity(?:\W*_?midi\W*)?")
_MEASURED_VELOCITY = re.compile(r"v_h0\b.*|velocity\W*_?m(?:/|_| )?s(?:\W*|\^?-1\W*)")
# The remark if velocities are listed without a unit.
MIDI_VELOCITY_REMARK = (
    "velocity is read as MIDI velocity and names the layer; give measured hammer velocities, m/s, as v_H0"
)
MAX_BYTES = 2**24
MAX_ROWS = 100_000
MAX_RECORDINGS = 64  # recordings of one key: the memory of a joint fit grows with them
MAX_LISTED = 5  # problems listed in one message
RESULT_NAMES = {"fit.json", "ledger"}  # a folder with one of these holds results of fits
_FIELDS = {
    "note": r"[A-Ga-g](?:##|#|♯|bb|b|♭|s)?(?:-1|\d)|\d{1,3}",
    "velocity": r"\d+(?:\.\d+)?", "v_H0": r"\d+(?:\.\d+)?",
    "instrument": r"[^/]+?", "take": r"[^/]+?", "layer": r"[^/]+?", "group": r"[^/]+?",
    "mic": r"[^/]+?", "*": r"[^/]*?",
}  # fmt: skip


class Row(NamedTuple):
    """One recording as listed, all texts unchanged."""

    where: str  # such as "line 7"
    file: str
    note: str
    instrument: str = ""
    layer: str = ""
    velocity: str = ""  # MIDI velocity, or any other name of a layer
    v_H0: str = ""  # measured hammer velocity, m/s
    group: str = ""


class Sample(NamedTuple):
    """One recording of a key, checked."""

    file: Path  # absolute, links followed
    layer: str
    velocity: float | None  # m/s, measured
    group: str  # path group, such as a microphone
    stroke: str = ""  # equal for recordings of one stroke by several microphones


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
    """Read keys, in the order of their instruments and pitches, and remarks on files and columns that are not used.

    Parameters
    ----------
    source : a CSV file, an SFZ file, or a folder of recordings.
    pattern : for a folder, the pattern of its file names. It must contain `{note}`; parts in `[...]` are optional. If
        it is not given, it is guessed from the names and reported in a remark.
    root : the folder that all files must lie in; by default the folder of the manifest.
    transpose : semitones added to every note, for a library that numbers octaves differently.

    Raises `SetupError`, naming the manifest and every row (up to five) that cannot be used.
    """
    name = printable(source)
    if pattern is not None and not source.is_dir():
        raise SetupError(f"{name}: is not a folder, so --pattern {printable(pattern)!r} does not apply; leave it out")
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
    """Text of a manifest, which must be UTF-8 without zero bytes."""
    text = read_text(source, MAX_BYTES, SetupError)
    if "\0" in text:
        line = text.count("\n", 0, text.index("\0")) + 1
        raise SetupError(f"{printable(source)}: has a zero byte on line {line}; it is not a text file")
    return text


def _csv_rows(source: Path) -> tuple[list[Row], list[str]]:
    """Rows of a CSV file with a header, separated by commas, semicolons or tabs."""
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
    remarks = [f"columns that are not used: {', '.join(map(printable, ignored))}"] if ignored else []
    return rows, remarks + [MIDI_VELOCITY_REMARK] * ("velocity" in columns and "v_H0" not in columns)


def _column(header: str) -> str:
    """Name of a column, without case and unit."""
    name = header.strip().lower()
    return "v_H0" if _MEASURED_VELOCITY.fullmatch(name) else "velocity" if _MIDI_VELOCITY.fullmatch(name) else name


def _check_columns(name: str, columns: list[str]) -> None:
    for column in ("file", "note"):
        if column not in columns:
            raise SetupError(
                f"{name}: the header has no column {column!r} (it has {printable(', '.join(columns))[:80]!r}); "
                "give file and note, and optionally instrument, take or layer, velocity, v_H0, group or mic"
            )
    for column in columns:
        if column in COLUMNS and columns.count(column) > 1:
            raise SetupError(f"{name}: the header has the column {column!r} twice; remove one")


def _csv_row(where: str, cells: dict[str, str]) -> Row:
    cells = {name: value.strip() for name, value in cells.items()}
    layer = " ".join(filter(None, (cells.get("layer", ""), cells.get("take", ""))))
    group = " ".join(filter(None, (cells.get("group", ""), cells.get("mic", ""))))
    return Row(
        where, cells["file"], cells["note"], cells.get("instrument", ""), layer,
        cells.get("velocity", ""), cells.get("v_H0", ""), group,
    )  # fmt: skip


def _folder_rows(folder: Path, pattern: str | None) -> tuple[list[Row], list[str]]:
    """Rows of the files in `folder` whose names fit `pattern`, or a guessed pattern."""
    recordings, remarks = [file for file in files_in(folder) if is_sound(file)], []
    if not recordings:
        raise SetupError(f"{printable(folder)}: {_without_sound(folder)}")
    if pattern is None:
        pattern, remarks = _guessed(folder, recordings)
    expression, rows, others = _expression(pattern), [], []
    for path in recordings:
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
    if others:
        remarks = [*remarks, f"recordings that do not fit the pattern: {len(others)}, such as {printable(others[0])}"]
    return rows, remarks + [MIDI_VELOCITY_REMARK] * ("{velocity}" in pattern and "{v_H0}" not in pattern)


def files_in(folder: Path) -> list[str]:
    """Paths, relative to a folder, of all files in it, sorted. Hidden files and results of fits are excluded."""
    paths = []
    for place, inner, files in os.walk(folder):
        if Path(place) != folder and RESULT_NAMES & {*inner, *files}:
            inner.clear()
            continue
        inner[:] = [name for name in inner if not name.startswith(".")]
        paths += [(Path(place) / file).relative_to(folder).as_posix() for file in files if not file.startswith(".")]
    return sorted(paths)


def _stem(path: str) -> str:
    return path[: -len(Path(path).suffix)]


def _without_sound(folder: Path) -> str:
    """Reason why a folder has no recording, with the kinds of files that it holds."""
    endings = Counter(Path(file).suffix.lower() or "no ending" for file in files_in(folder))
    kinds = ", ".join(f"{printable(ending)} ({count})" for ending, count in endings.most_common(MAX_LISTED))
    content = f"holds no readable recording, only files with {kinds}" if kinds else "holds no files"
    return f"{content}; the formats are {readable_formats()}: convert the files to one of these"


def _guessed(folder: Path, recordings: Sequence[str]) -> tuple[str, list[str]]:
    """Pattern guessed from these names, and remarks on it."""
    stems = [*map(_stem, recordings)]
    pattern = guess_pattern(stems, _expression)
    if pattern is None:
        raise SetupError(f"{printable(folder)}: no pattern can be guessed, because no part of names such as "
                         f"{printable(recordings[0])!r} is clearly the note; {_give_pattern()}")  # fmt: skip
    remarks = [f"file names are read as --pattern {printable(shlex.quote(pattern))}"]
    if offset := midi_number_offset(stems):
        remarks.append(f"MIDI numbers in the names are {offset:+d} semitones from the note names, which are used; "
                       f"--transpose {offset} uses the numbers")  # fmt: skip
    return pattern, remarks


def _give_pattern() -> str:
    return "give --pattern, such as '{instrument}-{note}-{layer}.flac', or a manifest"


def _expression(pattern: str) -> re.Pattern[str]:
    """Regular expression of a file-name pattern."""
    parts, fields, depth = [], [], 0
    for field, other in re.findall(r"\{([a-zA-Z_0-9*]+)\}|(.)", pattern):
        if field and field not in _FIELDS:
            raise SetupError(f"--pattern {pattern!r}: {{{field}}} is not a field; use "
                             f"{', '.join('{' + f + '}' for f in _FIELDS)}")  # fmt: skip
        if field in fields and field != "*":
            raise SetupError(f"--pattern {pattern!r}: has {{{field}}} twice; use {{*}} for one of them")
        fields += [field] if field else []
        depth += (other == "[") - (other == "]")
        if depth not in (0, 1):
            raise SetupError(f"--pattern {pattern!r}: [ and ] must come in pairs and must not be nested")
        if field:
            parts.append(f"(?:{_FIELDS['*']})" if field == "*" else f"(?P<{field}>{_FIELDS[field]})")
        else:
            parts.append({"[": "(?:", "]": ")?"}.get(other) or re.escape(other))
    if "note" not in fields or depth:
        raise SetupError(f"--pattern {pattern!r}: must have {{note}}, and a ] for every [")
    return re.compile("".join(parts), re.IGNORECASE)


def _keys(name: str, rows: list[Row], base: Path, root: Path, transpose: int) -> list[Key]:
    """Collect rows into keys. All problems are raised together."""
    problems: list[str] = []
    keys: dict[str, tuple[str, int, list[Sample]]] = {}
    rows_of_files: dict[Path, str] = {}
    root_folder = root.resolve()
    for row in rows:
        try:
            row = row._replace(layer=_layer_name(row))
            sample, midi = _sample(row, base, root_folder), note_to_midi(row.note) + transpose
            if not 0 <= midi <= 127:
                raise SetupError(f"note {printable(row.note)!r} is MIDI {midi} with --transpose {transpose}, "
                                 "which must be 0 to 127")  # fmt: skip
            check_pitch(hertz_of(midi), f"note {midi_to_note(midi)}")
            if sample.file in rows_of_files:
                raise SetupError(f"{printable(row.file)} is also {rows_of_files[sample.file]}; list it once")
            rows_of_files[sample.file] = row.where
            folder = _folder_name(row.instrument, midi_to_note(midi))
            instrument, _, samples = keys.setdefault(folder.casefold(), (row.instrument, midi, []))
            if instrument != row.instrument:
                raise SetupError(
                    f"instruments {printable(instrument)!r} and {printable(row.instrument)!r} would share "
                    f"the folder {folder}; rename one"
                )
            if row.layer and any((s.layer, s.group) == (row.layer, row.group) for s in samples):
                raise SetupError(f"{folder} has a second {printable(f'{row.layer} {row.group}').strip()!r}; "
                                 "give them different layers, takes, groups or mics")  # fmt: skip
            other = next((s.velocity for s in samples if s.layer == row.layer and s.velocity is not None), None)
            if row.layer and None not in (other, sample.velocity) and other != sample.velocity:
                raise SetupError(
                    f"{folder} {printable(row.layer)!r} has velocity {sample.velocity:g} and {other:g}, but one stroke "
                    "has one velocity; correct it, or give each recording its own layer or take"
                )
            samples.append(sample)
        except (SetupError, AnalysisError) as problem:
            problems.append(f"{row.where}: {problem}")
    problems += [
        f"{k}: {len(s)} recordings, more than {MAX_RECORDINGS}"
        for k, (_, _, s) in keys.items()
        if len(s) > MAX_RECORDINGS
    ]
    if problems:
        raise SetupError(f"{name}: {first_problems(problems)}; nothing was started")
    if not keys:
        raise SetupError(f"{name}: lists no recording; add rows")
    ordered = sorted(keys.values(), key=lambda k: (k[0].casefold(), k[1]))
    return [Key(_folder_name(i, midi_to_note(m)), i, midi_to_note(m), _with_strokes(s)) for i, m, s in ordered]


def _with_strokes(samples: list[Sample]) -> tuple[Sample, ...]:
    """Samples of a key in the order of their paths. Samples of one layer, by different groups, are one stroke."""
    layers = [s.layer for s in samples if s.layer]
    with_strokes = (s._replace(stroke=s.layer if layers.count(s.layer) > 1 else "") for s in samples)
    return tuple(sorted(with_strokes, key=lambda s: s.file.as_posix()))


def first_problems(problems: Sequence[str]) -> str:
    """The first problems, and the number of further ones."""
    more = f"; and {len(problems) - MAX_LISTED} more" if len(problems) > MAX_LISTED else ""
    return "; ".join(problems[:MAX_LISTED]) + more


def _folder_name(instrument: str, note: str) -> str:
    """Name of a folder that every file system accepts."""
    safe = re.sub(r"[^\w.]+", "-", instrument).strip("-.")[:60]
    return f"{safe}-{note.replace('#', 's')}" if safe else note.replace("#", "s")


def _layer_name(row: Row) -> str:
    """Name of the layer of a recording. It ends with the MIDI velocity, such as "v064", or with another label."""
    if re.fullmatch(r"[\d.,]+", row.velocity) and not re.fullmatch(r"\d{1,3}", row.velocity, re.ASCII):
        raise SetupError(f"velocity {printable(row.velocity)!r} must be a MIDI velocity, a whole number; give "
                         "measured hammer velocities, m/s, as v_H0")  # fmt: skip
    velocity = f"v{int(row.velocity):03d}" if row.velocity.isdecimal() else row.velocity
    return " ".join(filter(None, (row.layer, velocity)))


def _sample(row: Row, base: Path, root: Path) -> Sample:
    """The sample of a row, whose file must lie inside the root."""
    if not row.file:
        raise SetupError("the file is empty; name a recording")
    return Sample(find_file(row.file, base, root), row.layer, _velocity(row.v_H0), row.group)


def _velocity(text: str) -> float | None:
    """Hammer velocity, m/s; None for an empty text."""
    if not text:
        return None
    bounds = PARAMETERS["v_H0"]
    try:
        value = float(text)
    except ValueError:
        value = float("nan")
    if not bounds.lower <= value <= bounds.upper:
        raise SetupError(f"v_H0 {printable(text)!r} must be a number from {bounds.lower:g} to {bounds.upper:g} m/s")
    return value
