"""Files of a listening test: the key, which has the identity of every sound, and the answers that a page saves."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from ..errors import ParameterError
from ..io.files import printable, short_repr
from .decode import convert, load_json

ANSWERS_SCHEMA = 2
# Largest file of answers, bytes. Thousands of trials need less.
LARGEST_ANSWERS = 2**24
HINT = "give a file that a page of pianofit listen saved"


@dataclass(frozen=True)
class SoundIdentity:
    """A sound: the name of its set, and the note or stroke."""

    what: str
    case: str


@dataclass(frozen=True)
class TrialEntry:
    """A trial with the names of its sounds; `hit` is the answer that is counted."""

    condition: str
    kind: Literal["abx", "nearer"]
    reference: str
    a: str
    b: str
    hit: str


@dataclass(frozen=True, kw_only=True)
class ListeningKey:
    """The key of a test: its sounds by name, and its trials in their order."""

    schema: int = ANSWERS_SCHEMA
    program: str
    version: str
    seed: int
    sounds: dict[str, SoundIdentity]
    trials: tuple[TrialEntry, ...]


@dataclass(frozen=True)
class Answer:
    """One answer: the side that was chosen, and the side that counts as a hit."""

    condition: str
    chosen: Literal["a", "b"]
    hit: Literal["a", "b"]


@dataclass(frozen=True, kw_only=True)
class Answers:
    """The answers of one listener. A page saves more, which is not needed here."""

    trials: tuple[Answer, ...]


def read_answers(path: Path) -> tuple[Answers, Any]:
    """Read the answers of one listener, and the whole content of the file; raise a `ParameterError` without answers."""
    content = load_json(path, LARGEST_ANSWERS, "answers of a listening test", HINT, ParameterError)
    schema = content.get("schema") if isinstance(content, dict) else "none"
    if schema != ANSWERS_SCHEMA:
        found = schema if schema == "none" else short_repr(schema)
        raise ParameterError(
            f"{printable(path)}: not answers of a listening test (schema {found}, must be {ANSWERS_SCHEMA}); {HINT}"
        )
    answers = convert(content, Answers, printable(path), HINT, ParameterError)
    if not answers.trials:
        raise ParameterError(f"{printable(path)}: has no answers; {HINT}")
    return answers, content
