"""The pattern of file names, guessed from the names of a folder's recordings.

A name is divided at its separators. The note is the part that is a note name, or a MIDI number, in most names. A part
after the note that varies is a layer. A part before it is a layer if it consists of dynamics or numbers, and else
belongs to the instrument. A number that follows from the note is ignored.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

from ..analysis.note_names import note_to_midi
from ..analysis.pitch import check_pitch
from ..conversions import hertz_of
from ..errors import AnalysisError

__all__ = ["guess_pattern", "numbers_off"]

SEPARATOR = re.compile(r"((?:[^\w#♯♭]|_)+)")
_NAME = r"[A-Ga-g](?:##|#|♯|bb|b|♭|s)?\d(?!\d)"
# How a note stands in a part of a name: what is before it, the note, and what is after it.
FORMS = {
    "name": re.compile(rf"()({_NAME})()"),
    "name at the begin": re.compile(rf"()({_NAME})(\D\w*)"),
    "name at the end": re.compile(rf"(\w*(?:\d|[a-z](?=[A-G])))({_NAME})()"),
    "number": re.compile(r"()(\d{1,3})()", re.ASCII),
    "number at the end": re.compile(r"((?!(?:v|vel|velocity|vl|l|lay|layer|rr|take|t|mic)\d)[A-Za-z]+)(\d{1,3})()",
                                    re.ASCII | re.IGNORECASE),
}  # fmt: skip
# A number counts as the note only if it has so many times the values of any other number of the names, and note names
# are preferred up to so many times fewer files: velocities and indices are numbers too.
DISTINCT = 2
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

    before: str  # the separator before it
    values: tuple[str, ...]  # by name
    folder: bool  # whether it belongs to a folder's name
    after_note: bool

    @property
    def constant(self) -> bool:
        """True if all names have the same value."""
        return len({*self.values}) == 1

    def all_are(self, kind: re.Pattern[str]) -> bool:
        """True if all values match the expression."""
        return all(map(kind.fullmatch, self.values))


class Reading(NamedTuple):
    """Names of one shape, and where their note stands."""

    by_name: bool  # not by MIDI number
    notes: tuple[str, ...]
    names: tuple[str, ...]
    parts: tuple[Part, ...]  # in order, without the note
    separator: str  # before the note

    @property
    def distinct(self) -> int:
        """The number of different notes."""
        return len({note_to_midi(note) for note in self.notes})


def guess_pattern(names: Sequence[str], compiled: Callable[[str], re.Pattern[str]]) -> str | None:
    """The pattern that reads most of these names, or None where the note's place is not clear.

    Parameters
    ----------
    names : paths from the folder, without endings.
    compiled : makes the regular expression of a pattern.
    """
    readings = [(one, patterns) for one in _in_order([*_readings(names)]) if (patterns := _valid(one, compiled))]
    if not readings:
        return None
    likeliest = readings[0][0]
    candidates = [pattern for one, patterns in readings if one.by_name == likeliest.by_name for pattern in patterns]
    consistent = [pattern for pattern in candidates if _reads(compiled(pattern), likeliest)]
    return max(consistent, key=lambda one: sum(compiled(one).fullmatch(name) is not None for name in names))


def _valid(reading: Reading, compiled: Callable[[str], re.Pattern[str]]) -> list[str]:
    """Patterns that find the notes of a reading, the plainest first."""
    roles = _roles(reading)
    patterns = [] if roles is None else _patterns(reading, roles)
    return [pattern for pattern in patterns if _reads(compiled(pattern), reading)]


def numbers_off(names: Sequence[str]) -> int:
    """By how many semitones MIDI numbers in the names lie above the note names; 0 where they agree or are missing."""
    readings = [*_readings(names)]
    for named in (one for one in readings if one.by_name):
        for other in (one for one in readings if not one.by_name and {*one.names} >= {*named.names}):
            numbers = dict(zip(other.names, other.notes, strict=True))
            off = {int(numbers[x]) - note_to_midi(note) for x, note in zip(named.names, named.notes, strict=True)}
            if len(off) == 1 and named.distinct > 1:
                return off.pop()
    return 0


def _readings(names: Sequence[str]) -> Iterator[Reading]:
    """All places where notes can stand, each with the names that have one there."""
    shapes: dict[tuple[str, ...], list[str]] = {}
    for name in names:
        shapes.setdefault(tuple(SEPARATOR.split(name)[1::2]), []).append(name)
    for separators, members in shapes.items():
        for at in range(len(separators) + 1):
            for form, expression in FORMS.items():
                found = [(name, match) for name in members if (match := _note_at(name, at, expression))]
                if found:
                    yield _reading(form, at, separators, found)


def _note_at(name: str, at: int, expression: re.Pattern[str]) -> re.Match[str] | None:
    """The note in one part of a name, if a piano has it."""
    match = expression.fullmatch(SEPARATOR.split(name)[2 * at])
    try:
        if match:
            check_pitch(hertz_of(note_to_midi(match[2])), match[2])
    except AnalysisError:
        return None
    return match


def _reading(form: str, at: int, separators: Sequence[str], found: list[tuple[str, re.Match[str]]]) -> Reading:
    rows = [SEPARATOR.split(name)[::2] for name, _ in found]
    before, after = (tuple(match[group] or "" for _, match in found) for group in (1, 3))
    every = [*zip(["", *separators], zip(*rows, strict=True), strict=True)]
    folders = [any("/" in later for later in separators[i:]) for i in range(len(every))]
    parts = [Part(*one, folder, False) for one, folder in zip(every[:at], folders, strict=False)]
    parts += [Part(every[at][0], before, folders[at], False)] * any(before)
    parts += [Part("", after, folders[at], True)] * any(after)
    parts += [Part(*one, folder, True) for one, folder in zip(every[at + 1 :], folders[at + 1 :], strict=True)]
    return Reading(
        form.startswith("name"), tuple(match[2] for _, match in found), tuple(name for name, _ in found),
        tuple(parts), "" if any(before) else every[at][0],
    )  # fmt: skip


def _in_order(readings: list[Reading]) -> list[Reading]:
    """Readings from the most to the least likely; none where two are as likely and contradict each other."""

    def size(one: Reading) -> tuple[int, int]:
        return len(one.names) * (DISTINCT if one.by_name else 1), one.distinct

    ordered = sorted(readings, key=size, reverse=True)
    if len(ordered) > 1:
        first, second = ordered[:2]
        alike = (first.by_name, first.names) == (second.by_name, second.names) and not _agree(first, second)
        if alike and first.distinct < DISTINCT * second.distinct:
            return []
    return ordered


def _agree(one: Reading, other: Reading) -> bool:
    return [*map(note_to_midi, one.notes)] == [*map(note_to_midi, other.notes)]


def _reads(expression: re.Pattern[str], reading: Reading) -> bool:
    """True if an expression finds the note of every name."""
    matches = [expression.fullmatch(name) for name in reading.names]
    return all(match and match["note"] == note for match, note in zip(matches, reading.notes, strict=True))


def _roles(reading: Reading) -> list[str] | None:
    """The field of each part, empty for literal text; None where a part has no field left for it."""
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
    """The field of one part by itself."""
    if part.constant:
        if part.all_are(DYNAMICS) or (part.after_note and part.all_are(NUMBERED)):
            return "layer"
        named = not (part.after_note or part.folder) and re.search(r"[^\W\d_]", part.values[0])
        return "instrument" if named else ""
    if part.all_are(MICROPHONES):
        return "mic"
    if _follows(part, reading) and (not part.after_note or part.all_are(FORMS["name"])):
        return "*"
    if part.after_note:
        return "layer"
    return "layer" if part.all_are(DYNAMICS) or part.all_are(NUMBERED) else "instrument"


def _follows(part: Part, reading: Reading) -> bool:
    """True if numbers follow from the note, or only count the files."""
    if not all(map(re.compile(r".*\d").match, part.values)):
        return False
    counts = len({*part.values}) == len(part.values) and any(p.after_note and not p.constant for p in reading.parts)
    notes = [*map(note_to_midi, reading.notes)]
    return counts or len({*zip(notes, part.values, strict=True)}) == len({*notes})


def _with_one_instrument(parts: Sequence[Part], roles: list[str]) -> list[str] | None:
    """Roles with one run of parts as the instrument: that which varies, or the nearest to the note."""
    runs: list[list[int]] = []
    for at in (i for i, role in enumerate(roles) if role == "instrument"):
        if runs and runs[-1][-1] == at - 1 and "/" not in parts[at].before:
            runs[-1].append(at)
        else:
            runs.append([at])
    varying = [run for run in runs if any(not parts[at].constant for at in run)]
    if len(varying) > 1:
        return None
    kept = (varying or runs[-1:] or [[]])[0]
    return ["" if role == "instrument" and at not in kept else role for at, role in enumerate(roles)]


def _patterns(reading: Reading, roles: Sequence[str]) -> list[str]:
    """The pattern of a reading, and the same with an end that may be missing."""
    pieces, last = [], ""
    for part, role in zip(reading.parts, roles, strict=True):
        if not role:
            pieces.append(_literal(part.before) + _literal(part.values[0]))
        elif role != "instrument" or role != last:
            pieces.append(f"{_literal(part.before)}{{{role}}}")
        else:
            pieces.append("")  # one field stands for the whole run
        last = role
    where = sum(not part.after_note for part in reading.parts)
    pieces.insert(where, _literal(reading.separator) + "{note}")
    ends = range(where + 1, len(pieces))
    return ["".join(pieces), *("".join([*pieces[:at], "[", *pieces[at:], "]"]) for at in ends)]


def _literal(text: str) -> str:
    """Text as it stands in a pattern, where brackets have a meaning."""
    return "{*}" if any(bracket in text for bracket in "[]{}") else text
