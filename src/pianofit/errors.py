"""Every error a user can meet.

Each message is one line that names the thing (a file, an argument), the value found there, and what to do about it.
The command line prints the message and exits with 1; it never shows a traceback for these.
"""

from numbers import Real
from typing import Any

__all__ = [
    "PianofitError", "RecordingError", "SetupError", "ParameterError", "AnalysisError", "FitError", "OutputError",
    "WrongNoteError", "check_range", "check_type",
]  # fmt: skip


class PianofitError(Exception):
    """Base of all errors that are the input's, not the program's."""


class RecordingError(PianofitError):
    """An audio file that cannot be used: missing, truncated, silent, of another format."""


class SetupError(PianofitError):
    """A `setup.toml` with an unknown key, a wrong unit or range, or settings that contradict each other."""


class ParameterError(PianofitError, ValueError):
    """A physical parameter or an argument outside its range."""


class AnalysisError(PianofitError):
    """A recording in which the note, or enough of its partials, cannot be found."""


class WrongNoteError(AnalysisError):
    """A recording in which the note that was asked for is not, or no note is."""


class FitError(PianofitError):
    """A model or a fit that cannot be computed, such as a contact that does not end."""


class OutputError(PianofitError):
    """A place that cannot be written to, or that holds something which would be lost."""


def check_range(what: str, value: float, low: float, high: float, unit: str = "", hint: str = "") -> None:
    """Refuse a `value` out of its range, or no number, by a `ParameterError`; `what` stands before it, as "layers="."""
    if not (isinstance(value, Real) and low <= value <= high):
        raise ParameterError(f"{what}{_short(value)}{unit} must be from {low:g} to {high:g}{hint}")


def check_type(what: str, value: Any, kinds: Any, must: str) -> None:
    """Refuse by a `ParameterError` a `value` of none of these `kinds`; True and False are no numbers."""
    if not isinstance(value, kinds) or (kinds is Real and isinstance(value, bool)):
        raise ParameterError(f"{what}{_short(value)} must be {must}")


def _short(value: Any) -> str:
    """A value on one line: of a long one its begin."""
    text = " ".join((str(value) if isinstance(value, Real) else repr(value)).split())
    return text if len(text) <= 60 else text[:57] + "..."
