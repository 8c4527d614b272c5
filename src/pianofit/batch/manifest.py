"""Keys and their recordings, read from a CSV file, a folder or an SFZ file.

Each source is first read into rows. All rows are checked before anything starts, and every problem is listed with its
place. A key is an instrument and a note. After all links are followed, files must lie inside one folder, the root. A
manifest from an untrusted source therefore cannot make the program read other files.
"""

import csv
import difflib
import io
import re
import shlex
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, cast, get_args

from ..analysis.note_names import midi_to_note, note_to_midi
from ..analysis.pitch import check_pitch
from ..conversions import MIDI_VELOCITIES, hertz_of
from ..errors import AnalysisError, SetupError
from ..io.containers import is_sound, readable_formats
from ..io.files import printable, read_text, safe_name
from ..io.number_format import counted, first_of
from ..parameters import PARAMETERS
from .library_files import MAX_RECORDINGS, Row, files_in, find_file
from .name_pattern import expression_of, guess_pattern, midi_number_offset, role_in
from .sfz import sfz_rows

COLUMNS = ("file", "note", "instrument", "take", "layer", "velocity", "v_H0", "group", "mic", "role")
# A stroke; a stroke whose damper falls within the file; a key that is let go while its string is silent.
Role = Literal["note", "damped", "release"]
# Headers of a MIDI velocity, and of a measured one with its unit, such as "velocity (m/s)" or "velocity_m_s".
_MIDI_VELOCITY = re.compile(r"(?:midi\W*_?)?velocity(?:\W*_?midi\W*)?")
_MEASURED_VELOCITY = re.compile(r"v_h0\b.*|velocity\W*_?m(?:/|_| )?s(?:\W*|\^?-1\W*)")
# The remark if velocities are listed without a unit.
MIDI_VELOCITY_REMARK = "velocity is read as MIDI velocity; give measured hammer velocities, m/s, as v_H0"
GIVE_PATTERN = "give --pattern, such as '{instrument}-{note}-{layer}.flac', or a manifest"
MAX_BYTES = 2**24
MAX_ROWS = 100_000


@dataclass(frozen=True)
class Sample:
    """One recording of a key, checked."""

    file: Path  # absolute, links followed
    layer: str
    velocity: float | None  # m/s, measured
    group: str  # path group, such as a microphone
    midi_velocity: float | None = None  # at which the library plays it
    stroke: str = ""  # equal for recordings of one stroke by several microphones
    role: Role = "note"


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
    base = source if source.is_dir() else source.parent
    if source.is_dir():
        rows, remarks = _folder_rows(source, pattern)
    elif source.suffix.lower() == ".sfz":
        rows, remarks = sfz_rows(source, root or base, transpose)
    else:
        rows, remarks = _csv_rows(source)
    return _keys(name, rows, base, (root or base).resolve(), transpose), remarks


def _csv_rows(source: Path) -> tuple[list[Row], list[str]]:
    """Rows of a CSV file with a header, separated by commas, semicolons or tabs."""
    name, text = printable(source), read_text(source, MAX_BYTES, SetupError)
    if "\0" in text:
        line = text.count("\n", 0, text.index("\0")) + 1
        raise SetupError(f"{name}: has a zero byte on line {line}; it is not a text file")
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
                count = f"{counted(len(cells), 'cell')}, the header {len(columns)}"
                raise SetupError(f"{name}: line {reader.line_num} has {count}; correct it")
            rows.append(_row(f"line {reader.line_num}", dict(zip(columns, cells, strict=True))))
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
                "give file and note, and optionally instrument, take or layer, velocity, v_H0, group or mic, role"
            )
    for column in columns:
        if column in COLUMNS and columns.count(column) > 1:
            raise SetupError(f"{name}: the header has the column {column!r} twice; remove one")


def _row(where: str, cells: dict[str, str]) -> Row:
    """The row of these cells. Layer and take together distinguish recordings; group and mic have one meaning."""

    def cell(*names: str) -> str:
        return " ".join(text for name in names if (text := cells.get(name, "").strip()))

    layer, group, velocities = cell("layer", "take"), cell("group", "mic"), (cell("velocity"), cell("v_H0"))
    return Row(where, cell("file"), cell("note"), cell("instrument"), layer, *velocities, group, cell("role"))


def _folder_rows(folder: Path, pattern: str | None) -> tuple[list[Row], list[str]]:
    """Rows of the files in `folder` whose names fit `pattern`, or a guessed pattern."""
    files = files_in(folder)
    recordings, remarks = [file for file in files if is_sound(file)], []
    if not recordings:
        raise SetupError(f"{printable(folder)}: {_without_sound(files)}")
    if pattern is None:
        pattern, remarks = _guessed(folder, recordings)
    expression, rows, others = expression_of(pattern), [], []
    for path in recordings:
        match = expression.fullmatch(path if is_sound(pattern) else _stem(path))
        if match is None:
            others.append(path)
        else:
            cells = {"role": role_in(path)} | {k: v or "" for k, v in match.groupdict().items()} | {"file": path}
            rows.append(_row(printable(path), cells))
    if not rows:
        count = f"{counted(len(others), 'recording')}, such as {printable(others[0])!r}"
        raise SetupError(f"{printable(folder)}: none of {count}, fits the pattern {pattern!r}; {GIVE_PATTERN}")
    if others:
        remarks = [*remarks, f"recordings that do not fit the pattern: {len(others)}, such as {printable(others[0])}"]
    return rows, remarks + [MIDI_VELOCITY_REMARK] * ("{velocity}" in pattern and "{v_H0}" not in pattern)


def _stem(path: str) -> str:
    return path[: -len(Path(path).suffix)]


def _without_sound(files: Sequence[str]) -> str:
    """Reason why a folder with these files has no recording."""
    endings = Counter(Path(file).suffix.lower() or "no ending" for file in files)
    kinds = ", ".join(f"{printable(ending)} ({count})" for ending, count in endings.most_common(5))
    content = f"holds no readable recording, only files with {kinds}" if kinds else "holds no files"
    return f"{content}; the formats are {readable_formats()}: convert the files to one of these"


def _guessed(folder: Path, recordings: Sequence[str]) -> tuple[str, list[str]]:
    """Pattern guessed from these names, and remarks on it."""
    stems = [*map(_stem, recordings)]
    pattern = guess_pattern(stems)
    if pattern is None:
        unclear = f"no part of names such as {printable(recordings[0])!r} is clearly the note"
        raise SetupError(f"{printable(folder)}: no pattern can be guessed, because {unclear}; {GIVE_PATTERN}")
    remarks = [f"file names are read as --pattern {printable(shlex.quote(pattern))}"]
    if offset := midi_number_offset(stems):
        remarks.append(
            f"MIDI numbers in the names are {offset:+d} semitones from the note names, which are used; "
            f"--transpose {offset} uses the numbers"
        )
    return pattern, remarks


def _keys(name: str, rows: Sequence[Row], base: Path, root: Path, transpose: int) -> list[Key]:
    """Collect rows into keys. All problems are raised together."""
    problems: list[str] = []
    keys: dict[str, tuple[str, int, list[Sample]]] = {}  # instrument, MIDI number and samples by folder
    rows_of_files: dict[Path, str] = {}
    for row in rows:
        try:
            sample, midi = _sample(row, base, root), _midi(row.note, transpose)
            if sample.file in rows_of_files:
                raise SetupError(f"{printable(row.file)} is also {rows_of_files[sample.file]}; list it once")
            rows_of_files[sample.file] = row.where
            folder = _folder_name(row.instrument, midi_to_note(midi))
            instrument, _, samples = keys.setdefault(folder.casefold(), (row.instrument, midi, []))
            if instrument != row.instrument:
                both = f"{printable(instrument)!r} and {printable(row.instrument)!r}"
                raise SetupError(f"instruments {both} would share the folder {folder}; rename one")
            _check_layer(folder, sample, samples)
            samples.append(sample)
        except (SetupError, AnalysisError) as problem:
            problems.append(f"{row.where}: {problem}")
    crowded = {folder: len(samples) for folder, (_, _, samples) in keys.items() if len(samples) > MAX_RECORDINGS}
    problems += [f"{folder}: {count} recordings, more than {MAX_RECORDINGS}" for folder, count in crowded.items()]
    if problems:
        raise SetupError(f"{name}: {first_of(problems, '; ')}; nothing was started")
    if not keys:
        raise SetupError(f"{name}: lists no recording; add rows")
    ordered = sorted(keys.values(), key=lambda key: (key[0].casefold(), key[1]))
    return [Key(_folder_name(i, midi_to_note(m)), i, midi_to_note(m), _with_strokes(s)) for i, m, s in ordered]


def _sample(row: Row, base: Path, root: Path) -> Sample:
    """The sample of a row. Its file must lie inside the root."""
    if re.fullmatch(r"[\d.,]+", row.velocity) and not re.fullmatch(r"\d{1,3}", row.velocity, re.ASCII):
        raise SetupError(
            f"velocity {printable(row.velocity)!r} must be a MIDI velocity, a whole number; give measured hammer "
            "velocities, m/s, as v_H0"
        )
    velocity = f"v{int(row.velocity):03d}" if row.velocity.isdecimal() else row.velocity
    if not row.file:
        raise SetupError("the file is empty; name a recording")
    file, layer = find_file(row.file, base, root), f"{row.layer} {velocity}".strip()
    return Sample(file, layer, _velocity(row.v_H0), row.group, _midi_velocity(row), role=_role(row.role))


def _midi_velocity(row: Row) -> float | None:
    """MIDI velocity of a row, or the middle of its range; None for an empty text or another name."""
    if not row.velocity.isdecimal():
        return row.midi_velocity
    value = int(row.velocity)
    if not MIDI_VELOCITIES[0] <= value <= MIDI_VELOCITIES[1]:
        raise SetupError(f"velocity {value} is a MIDI velocity and must be from 1 to 127")
    return float(value)


def _role(text: str) -> Role:
    """The role in a cell; text after a colon is a remark."""
    name, roles = text.partition(":")[0].strip().lower() or "note", get_args(Role)
    if name in roles:
        return cast(Role, name)
    nearest = difflib.get_close_matches(name, roles, 1, 0.0)[0]
    raise SetupError(f"role {printable(text)!r} must be {', '.join(roles)}; the nearest is {nearest}")


def _midi(note: str, transpose: int) -> int:
    """MIDI number of a note name, transposed, which must be that of a piano key."""
    midi = note_to_midi(note) + transpose
    if not 0 <= midi <= 127:
        raise SetupError(
            f"note {printable(note)!r} is MIDI {midi} with --transpose {transpose}, which must be 0 to 127"
        )
    check_pitch(hertz_of(midi), f"note {midi_to_note(midi)}")
    return midi


def _check_layer(folder: str, sample: Sample, samples: Sequence[Sample]) -> None:
    """Raise `SetupError` if another sample of the layer has the same group, or another velocity."""
    others = [other for other in samples if sample.layer and (other.layer, other.role) == (sample.layer, sample.role)]
    if any(other.group == sample.group for other in others):
        name = printable(f"{sample.layer} {sample.group}").strip()
        raise SetupError(f"{folder} has a second {name!r}; give them different layers, takes, groups or mics")
    velocity = next((other.velocity for other in others if other.velocity is not None), sample.velocity)
    if sample.velocity not in (None, velocity):
        raise SetupError(
            f"{folder} {printable(sample.layer)!r} has velocity {sample.velocity:g} and {velocity:g}, but one stroke "
            "has one velocity; correct it, or give each recording its own layer or take"
        )


def _with_strokes(samples: list[Sample]) -> tuple[Sample, ...]:
    """Samples of a key in the order of their paths. Samples of one layer, by different groups, are one stroke."""
    count = Counter((s.layer, s.role) for s in samples)
    with_strokes = [replace(s, stroke=s.layer if s.layer and count[s.layer, s.role] > 1 else "") for s in samples]
    return tuple(sorted(with_strokes, key=lambda s: s.file.as_posix()))


def _folder_name(instrument: str, note: str) -> str:
    """Name of a folder that every file system accepts."""
    return "-".join(filter(None, [safe_name(instrument), note.replace("#", "s")]))


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
