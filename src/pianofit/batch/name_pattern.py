"""Patterns of file names, such as `{instrument}-{note}-{layer}[-{mic}]`, and their guess from the names in a folder.

A name is divided at its separators. The note is the part that is a note name, or a MIDI number, in most names. A part
after the note that varies is a layer. A part before the note is a layer if it consists of dynamics or numbers.
Otherwise it belongs to the instrument. A number that follows from the note is ignored.
"""

import functools
import re
from collections.abc import Iterator, Sequence
from typing import NamedTuple

from ..analysis.note_names import note_to_midi
from ..analysis.pitch import check_pitch
from ..conversions import hertz_of
from ..errors import AnalysisError, SetupError

# Fields of any text, and the shortest text of each.
FREE = {**dict.fromkeys(("instrument", "take", "layer", "group", "mic", "role"), r"[^/]"), "*": ""}
FIELDS = {
    "note": r"[A-Ga-g](?:##|#|♯|bb|b|♭|s)?(?:-1|\d)|\d{1,3}",
    **dict.fromkeys(("velocity", "v_H0"), r"\d+(?:\.\d+)?"),
    **{name: r"[^/]+?" if shortest else r"[^/]*?" for name, shortest in FREE.items()},
}
# Words in a file name that give the role of the recording.
ROLE_WORDS = {
    "release": re.compile(r"(?i)(?<![a-z])(?:(?:key|note)?[-_. ]?releases?|rel|(?:key|note)[-_. ]?off)(?![a-z])"),
    "damped": re.compile(r"(?i)(?<![a-z])damped(?![a-z])"),
}
SEPARATOR = re.compile(r"((?:[^\w#♯♭]|_)+)")
_NAME = r"[A-Ga-g](?:##|#|♯|bb|b|♭|s)?\d(?!\d)"
_NO_NOTE = r"(?i:v|vel|velocity|vl|l|lay|layer|rr|take|t|mic)"  # words before the number of a layer or a take
# Forms of a note in a part of a name. Groups: text before the note, the note, text after it.
FORMS = {
    "name": re.compile(rf"()({_NAME})()"),
    "name at the begin": re.compile(rf"()({_NAME})(\D\w*)"),
    "name at the end": re.compile(rf"(\w*(?:\d|[a-z](?=[A-G])))({_NAME})()"),
    "number": re.compile(r"()(\d{1,3})()", re.ASCII),
    "number at the end": re.compile(rf"((?!{_NO_NOTE}\d)[A-Za-z]+)(\d{{1,3}})()", re.ASCII),
}
# A number counts as the note only if it has at least this many times the values of any other number in the names:
# velocities and indices are numbers too. Note names are preferred to numbers in up to this many times more files.
MIN_VALUE_RATIO = 2
DYNAMICS = re.compile(
    r"(?i)p{1,5}|f{1,5}|mp|mf|sfz|soft\w*|quiet\w*|med|medium|mid|mezzo\w*|forte|fortissimo|pianissimo|loud\w*|hard\w*|"
    r"low|high|light|heavy|normal"
)
NUMBERED = re.compile(r"(?i)[a-z]{0,5}\d+|\d+[a-z]?")
MICROPHONES = re.compile(
    r"(?i)(?:close|near|far|room|hall|amb\w*|stereo|mono|left|right|side|player|audience|decca|ab|xy|ms|ortf|"
    r"over\w*|under\w*|inside|outside|mic|binaural)\d*|[lr]"  # L1 is a layer, and R1 a round robin
)


@functools.cache
def expression_of(pattern: str) -> re.Pattern[str]:
    """Regular expression of a pattern.

    Raises `SetupError` if the pattern has an unknown field, a field twice, no note, or brackets that do not match.
    """
    parts, fields, depth = [], [], 0
    # The first of three brackets that open begins an optional part. The other two are a bracket of the name.
    tokens = re.findall(r"\{([a-zA-Z_0-9*]+)\}|(\[\[(?=(?:\[\[)*(?!\[))|\]\]|.)", pattern)
    for (field, other), (following, _) in zip(tokens, [*tokens[1:], ("", "")], strict=True):
        depth += (other == "[") - (other == "]")
        if depth not in (0, 1):
            raise SetupError(f"--pattern {pattern!r}: [ and ] must come in pairs and must not be nested")
        if not field:
            parts.append({"[": "(?:", "]": ")?", "[[": r"\[", "]]": r"\]"}.get(other) or re.escape(other))
            continue
        if field not in FIELDS:
            allowed = ", ".join(f"{{{name}}}" for name in FIELDS)
            raise SetupError(f"--pattern {pattern!r}: {{{field}}} is not a field; use {allowed}")
        if field in fields and field != "*":
            raise SetupError(f"--pattern {pattern!r}: has {{{field}}} twice; use {{*}} for one of them")
        fields.append(field)
        # Two free fields share a text in many ways. The first match is that in which the first field is shortest.
        form = FREE[field] if field in FREE and following in FREE else FIELDS[field]
        parts.append(f"(?:{form})" if field == "*" else f"(?P<{field}>{form})")
    if "note" not in fields or depth:
        raise SetupError(f"--pattern {pattern!r}: must have {{note}}, and a ] for every [")
    return re.compile("".join(parts), re.IGNORECASE)


def role_in(name: str) -> str:
    """Return the role that a word in a file name gives; empty for a note."""
    return next((role for role, words in ROLE_WORDS.items() if words.search(name)), "")


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
    def midi(self) -> list[int]:
        """MIDI numbers of the notes."""
        return [*map(note_to_midi, self.notes)]

    @property
    def distinct(self) -> int:
        """Number of different notes."""
        return len({*self.midi})

    def agrees_with(self, pattern: str) -> bool:
        """True if a pattern finds the note of every name."""
        matches = map(expression_of(pattern).fullmatch, self.names)
        return all(match and match["note"] == note for match, note in zip(matches, self.notes, strict=True))


def guess_pattern(names: Sequence[str]) -> str | None:
    """The pattern that matches most of these names, or None if the position of the note is not clear.

    The names are paths relative to the folder, without endings.
    """
    ordered = _by_likelihood([*_readings(names)])
    readings = [(reading, patterns) for reading in ordered if (patterns := _patterns(reading))]
    if not readings:
        return None
    likeliest = readings[0][0]
    candidates = [pattern for reading, group in readings if reading.by_name == likeliest.by_name for pattern in group]
    consistent = filter(likeliest.agrees_with, candidates)
    return max(consistent, key=lambda pattern: sum(map(bool, map(expression_of(pattern).fullmatch, names))))


def midi_number_offset(names: Sequence[str]) -> int:
    """Semitones by which MIDI numbers in the names exceed the note names; 0 if they agree or are missing."""
    readings = [*_readings(names)]
    for by_name in (r for r in readings if r.by_name):
        for by_number in (r for r in readings if not r.by_name and {*r.names} >= {*by_name.names}):
            numbers = dict(zip(by_number.names, by_number.notes, strict=True))
            offsets = {int(numbers[n]) - midi for n, midi in zip(by_name.names, by_name.midi, strict=True)}
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
                    yield _reading(form.startswith("name"), index, separators, matches)


def _note_at(name: str, index: int, expression: re.Pattern[str]) -> re.Match[str] | None:
    """The note in one part of a name, if a piano has that note."""
    match = expression.fullmatch(SEPARATOR.split(name)[2 * index])
    try:
        if match:
            check_pitch(hertz_of(note_to_midi(match[2])), match[2])
    except AnalysisError:
        return None
    return match


def _reading(by_name: bool, index: int, separators: Sequence[str], matches: list[tuple[str, re.Match]]) -> Reading:
    names = tuple(name for name, _ in matches)
    before, notes, after = (tuple(match[group] or "" for _, match in matches) for group in (1, 2, 3))
    columns = zip(("", *separators), zip(*(SEPARATOR.split(name)[::2] for name in names), strict=True), strict=True)
    parts, note_separator = [], ""
    for i, (separator, values) in enumerate(columns):
        folder = any("/" in later for later in separators[i:])
        if i != index:
            parts.append(Part(separator, values, folder, i > index))
            continue
        note_separator = "" if any(before) else separator
        parts += [Part(separator, before, folder, False)] * any(before) + [Part("", after, folder, True)] * any(after)
    return Reading(by_name, notes, names, tuple(parts), note_separator)


def _by_likelihood(readings: list[Reading]) -> list[Reading]:
    """Readings from the most to the least likely. Empty if two are equally likely and contradict each other."""

    def size(reading: Reading) -> tuple[int, int]:
        return len(reading.names) * (MIN_VALUE_RATIO if reading.by_name else 1), reading.distinct

    ordered = sorted(readings, key=size, reverse=True)
    if len(ordered) > 1:
        first, second = ordered[:2]
        same_names = (first.by_name, first.names) == (second.by_name, second.names)
        if same_names and first.midi != second.midi and first.distinct < MIN_VALUE_RATIO * second.distinct:
            return []
    return ordered


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
    return "layer" if part.after_note or part.all_are(DYNAMICS) or part.all_are(NUMBERED) else "instrument"


def _follows(part: Part, reading: Reading) -> bool:
    """True if the numbers of a part follow from the note, or only count the files."""
    if not all(re.match(r".*\d", value) for value in part.values):
        return False
    counts = len({*part.values}) == len(part.values) and any(p.after_note and not p.constant for p in reading.parts)
    return counts or len({*zip(reading.midi, part.values, strict=True)}) == reading.distinct


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


def _patterns(reading: Reading) -> list[str]:
    """Patterns that find the notes of a reading: the simplest, and the same with an optional end."""
    roles = _roles(reading)
    if roles is None:
        return []
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
    patterns = ["".join(pieces), *("".join([*pieces[:end], "[", *pieces[end:], "]"]) for end in ends)]
    return [*filter(reading.agrees_with, patterns)]


def _literal(text: str) -> str:
    """Literal text of a pattern, with brackets doubled. Text with braces becomes `{*}`."""
    return "{*}" if "{" in text or "}" in text else text.replace("[", "[[").replace("]", "]]")
