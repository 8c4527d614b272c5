"""Guess of a file-name pattern from the names of the recordings in a folder.

A name is divided at its separators. The note is the part that is a note name, or a MIDI number, in most names. A part
after the note that varies is a layer. A part before the note is a layer if it consists of dynamics or numbers.
Otherwise it belongs to the instrument. A number that follows from the note is ignored.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

from ..analysis.note_names import note_to_midi
from ..analysis.pitch import check_pitch
from ..conversions import hertz_of
from ..errors import AnalysisError

__all__ = ["guess_pattern", "midi_number_offset"]

SEPARATOR = re.compile(r"((?:[^\w#♯♭]|_)+)")
_NAME = r"[A-Ga-g](?:##|#|♯|bb|b|♭|s)?\d(?!\d)"
# Forms of a note in a part of a name. Groups: text before the note, the note, text after it.
FORMS = {
    "name": re.compile(rf"()({_NAME})()"),
    "name at the begin": re.compile(rf"()({_NAME})(\D\w*)"),
    "name at the end": re.compile(rf"(\w*(?:\d|[a-z](?=[A-G])))({_NAME})()"),
    "number": re.compile(r"()(\d{1,3})()", re.ASCII),
    "number at the end": re.compile(r"((?!(?:v|vel|velocity|vl|l|lay|layer|rr|take|t|mic)\d)[A-Za-z]+)(\d{1,3})()",
                                    re.ASCII | re.IGNORECASE),
}  # fmt: skip
# A number counts as the note only if it has at least this many times the values of any other number in the names:
# velocities and indices are numbers too. Note names are preferred to numbers in up to this many times more files.
MIN_VALUE_RATIO = 2
DYNAMICS = re.compile(
    r"p{1,5}|f{1,5}|mp|mf|sfz|soft\w*|quiet\w*|med|medium|mid|mezzo\w*|forte|fortissimo|pianissimo|loud\w*|hard\w*|low|"
    r"high|light|heavy|normal", re.IGNORECASE,
)  # fmt: skip
NUMBERED = re.compile(r"[a-z]{0,5}\d+|\d+[a-z]?", re.IGNORECASE)
MICROPHONES = re.compile(
    r"(?:close|near|far|room|hall|amb\w*|stereo|mono|left|right|[lr]|side|player|audience|decca|ab|xy|ms|ortf|over\w*|"
    r"under\w*|inside|outside|mic|binaural)\d*", re.IGNORECASE,
)  # fmt: skip


class Part(NamedTuple):
    """One part of all names of one shape."""

    before: str  # separator before the part
    values: tuple[str, ...]  # one for each name
    folder: bool  # True if the part belongs to the name of a folder
    after_note: bool

    @property
    def constant(self) -> bool:
        """True if all names have the same value."""
        return len({*self.values}) == 1

    def all_are(self, kind: re.Pattern[str]) -> bool:
        """True if all values match the expression."""
        return all(map(kind.fullmatch, self.values))


class Reading(NamedTuple):
    """Names of one shape, and the position of their note."""

    by_name: bool  # False if the note is a MIDI number
    notes: tuple[str, ...]
    names: tuple[str, ...]
    parts: tuple[Part, ...]  # in order, without the note
    separator: str  # before the note

    @property
    def distinct(self) -> int:
        """Number of different notes."""
        return len({note_to_midi(note) for note in self.notes})


def guess_pattern(names: Sequence[str], compiled: Callable[[str], re.Pattern[str]]) -> str | None:
    """The pattern that matches most of these names, or None if the position of the note is not clear.

    Parameters
    ----------
    names : paths relative to the folder, without endings.
    compiled : returns the regular expression of a pattern.
    """
    ordered = _by_likelihood([*_readings(names)])
    readings = [(reading, patterns) for reading in ordered if (patterns := _valid(reading, compiled))]
    if not readings:
        return None
    likeliest = readings[0][0]
    candidates = [pattern for reading, group in readings if reading.by_name == likeliest.by_name for pattern in group]
    consistent = [pattern for pattern in candidates if _reads(compiled(pattern), likeliest)]
    return max(consistent, key=lambda pattern: sum(compiled(pattern).fullmatch(name) is not None for name in names))


def _valid(reading: Reading, compiled: Callable[[str], re.Pattern[str]]) -> list[str]:
    """Patterns that find the notes of a reading, the simplest first."""
    roles = _roles(reading)
    patterns = [] if roles is None else _patterns(reading, roles)
    return [pattern for pattern in patterns if _reads(compiled(pattern), reading)]


def midi_number_offset(names: Sequence[str]) -> int:
    """Semitones by which MIDI numbers in the names exceed the note names; 0 if they agree or are missing."""
    readings = [*_readings(names)]
    for by_name in (r for r in readings if r.by_name):
        for by_number in (r for r in readings if not r.by_name and {*r.names} >= {*by_name.names}):
            numbers = dict(zip(by_number.names, by_number.notes, strict=True))
            notes = zip(by_name.names, by_name.notes, strict=True)
            offsets = {int(numbers[name]) - note_to_midi(note) for name, note in notes}
            if len(offsets) == 1 and by_name.distinct > 1:
                return offsets.pop()
    return 0


def _readings(names: Sequence[str]) -> Iterator[Reading]:
    """All possible positions of the note, each with the names that have a note there."""
    shapes: dict[tuple[str, ...], list[str]] = {}
    for name in names:
        shapes.setdefault(tuple(SEPARATOR.split(name)[1::2]), []).append(name)
    for separators, members in shapes.items():
        for index in range(len(separators) + 1):
            for form, expression in FORMS.items():
                matches = [(name, match) for name in members if (match := _note_at(name, index, expression))]
                if matches:
                    yield _reading(form, index, separators, matches)


def _note_at(name: str, index: int, expression: re.Pattern[str]) -> re.Match[str] | None:
    """The note in one part of a name, if a piano has that note."""
    match = expression.fullmatch(SEPARATOR.split(name)[2 * index])
    try:
        if match:
            check_pitch(hertz_of(note_to_midi(match[2])), match[2])
    except AnalysisError:
        return None
    return match


def _reading(form: str, index: int, separators: Sequence[str], matches: list[tuple[str, re.Match[str]]]) -> Reading:
    rows = [SEPARATOR.split(name)[::2] for name, _ in matches]
    before, after = (tuple(match[group] or "" for _, match in matches) for group in (1, 3))
    columns = [*zip(["", *separators], zip(*rows, strict=True), strict=True)]
    folders = [any("/" in later for later in separators[i:]) for i in range(len(columns))]
    parts = [Part(*column, folder, False) for column, folder in zip(columns[:index], folders, strict=False)]
    parts += [Part(columns[index][0], before, folders[index], False)] * any(before)
    parts += [Part("", after, folders[index], True)] * any(after)
    later = zip(columns[index + 1 :], folders[index + 1 :], strict=True)
    parts += [Part(*column, folder, True) for column, folder in later]
    return Reading(
        form.startswith("name"), tuple(match[2] for _, match in matches), tuple(name for name, _ in matches),
        tuple(parts), "" if any(before) else columns[index][0],
    )  # fmt: skip


def _by_likelihood(readings: list[Reading]) -> list[Reading]:
    """Readings from the most to the least likely. Empty if two are equally likely and contradict each other."""

    def size(reading: Reading) -> tuple[int, int]:
        return len(reading.names) * (MIN_VALUE_RATIO if reading.by_name else 1), reading.distinct

    ordered = sorted(readings, key=size, reverse=True)
    if len(ordered) > 1:
        first, second = ordered[:2]
        conflict = (first.by_name, first.names) == (second.by_name, second.names) and not _agree(first, second)
        if conflict and first.distinct < MIN_VALUE_RATIO * second.distinct:
            return []
    return ordered


def _agree(a: Reading, b: Reading) -> bool:
    return [*map(note_to_midi, a.notes)] == [*map(note_to_midi, b.notes)]


def _reads(expression: re.Pattern[str], reading: Reading) -> bool:
    """True if an expression finds the note of every name."""
    matches = [expression.fullmatch(name) for name in reading.names]
    return all(match and match["note"] == note for match, note in zip(matches, reading.notes, strict=True))


def _roles(reading: Reading) -> list[str] | None:
    """The field of each part, empty for literal text. None if there are more parts than fields."""
    roles: list[str] = []
    free = ["layer", "take"]
    for part in reading.parts:
        role = _role(part, reading)
        if role == "mic" and role in roles:
            role = "layer"
        if role == "layer":
            if not free:
                return None
            role = free.pop(0)
        roles.append(role)
    return _with_one_instrument(reading.parts, roles)


def _role(part: Part, reading: Reading) -> str:
    """The field of one part, without regard to the others."""
    if part.constant:
        if part.all_are(DYNAMICS) or (part.after_note and part.all_are(NUMBERED)):
            return "layer"
        is_name = not (part.after_note or part.folder) and re.search(r"[^\W\d_]", part.values[0])
        return "instrument" if is_name else ""
    if part.all_are(MICROPHONES):
        return "mic"
    if _follows(part, reading) and (not part.after_note or part.all_are(FORMS["name"])):
        return "*"
    if part.after_note:
        return "layer"
    return "layer" if part.all_are(DYNAMICS) or part.all_are(NUMBERED) else "instrument"


def _follows(part: Part, reading: Reading) -> bool:
    """True if the numbers of a part follow from the note, or only count the files."""
    if not all(map(re.compile(r".*\d").match, part.values)):
        return False
    counts = len({*part.values}) == len(part.values) and any(p.after_note and not p.constant for p in reading.parts)
    notes = [*map(note_to_midi, reading.notes)]
    return counts or len({*zip(notes, part.values, strict=True)}) == len({*notes})


def _with_one_instrument(parts: Sequence[Part], roles: list[str]) -> list[str] | None:
    """Roles with one run of parts as the instrument: the run that varies, or the run nearest to the note."""
    runs: list[list[int]] = []
    for index in (i for i, role in enumerate(roles) if role == "instrument"):
        if runs and runs[-1][-1] == index - 1 and "/" not in parts[index].before:
            runs[-1].append(index)
        else:
            runs.append([index])
    varying = [run for run in runs if any(not parts[index].constant for index in run)]
    if len(varying) > 1:
        return None
    kept = (varying or runs[-1:] or [[]])[0]
    return ["" if role == "instrument" and index not in kept else role for index, role in enumerate(roles)]


def _patterns(reading: Reading, roles: Sequence[str]) -> list[str]:
    """The pattern of a reading, and the same pattern with an optional end."""
    pieces, last = [], ""
    for part, role in zip(reading.parts, roles, strict=True):
        if not role:
            pieces.append(_literal(part.before) + _literal(part.values[0]))
        elif role != "instrument" or role != last:
            pieces.append(f"{_literal(part.before)}{{{role}}}")
        else:
            pieces.append("")  # one field stands for the whole run
        last = role
    note_index = sum(not part.after_note for part in reading.parts)
    pieces.insert(note_index, _literal(reading.separator) + "{note}")
    ends = range(note_index + 1, len(pieces))
    return ["".join(pieces), *("".join([*pieces[:end], "[", *pieces[end:], "]"]) for end in ends)]


def _literal(text: str) -> str:
    """Literal text of a pattern. Text with brackets becomes `{*}`, because brackets have a meaning there."""
    return "{*}" if any(bracket in text for bracket in "[]{}") else text
