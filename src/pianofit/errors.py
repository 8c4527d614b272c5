"""All errors that an input can cause.

Each message is one line. It names the file or the argument, its value, and what to do.
The command line prints the message without a traceback and exits with 1.
"""

from numbers import Integral, Real
from typing import Any

# Whole ends of ranges from here on have commas, up to where a power of ten is easier to read.
GROUPED, SCIENTIFIC = 10_000, 1e10


class PianofitError(Exception):
    """Base class of all errors that the input causes."""


class RecordingError(PianofitError):
    """An audio file that cannot be used: missing, truncated, silent, of another format."""


class SetupError(PianofitError):
    """A `setup.toml` with an unknown key, a wrong unit or range, or settings that contradict each other."""


class ParameterError(PianofitError, ValueError):
    """A physical parameter or an argument outside its range."""


class AnalysisError(PianofitError):
    """A recording in which the note, or enough partials of it, cannot be detected."""


class WrongNoteError(AnalysisError):
    """A recording that does not contain the requested note, or contains no note."""


class FitError(PianofitError):
    """A model or a fit that cannot be computed, such as a contact that does not end."""


class OutputError(PianofitError):
    """An output that cannot be made or written, or that would replace an existing file."""


def check_range(name: str, value: float, low: float, high: float, unit: str = "", hint: str = "") -> None:
    """Raise a `ParameterError` if `value` is not a number in the range. Messages begin with `name`, as "layers="."""
    if isinstance(value, bool) or not (isinstance(value, Real) and low <= value <= high):
        raise ParameterError(f"{name}{_short(value)}{unit} must be from {_bound(low)} to {_bound(high)}{hint}")


def check_type(name: str, value: Any, kinds: Any, expected: str) -> None:
    """Raise a `ParameterError` if `value` is not of these `kinds`. True and False do not count as numbers."""
    numbers = {Real, Integral} & {*(kinds if isinstance(kinds, tuple) else (kinds,))}
    if not isinstance(value, kinds) or (numbers and isinstance(value, bool)):
        raise ParameterError(f"{name}{_short(value)} must be {expected}")


def _bound(value: float) -> str:
    """Return the end of a range: a large whole number with commas, any other number with six digits."""
    return f"{value:,.0f}" if value == round(value) and GROUPED <= abs(value) < SCIENTIFIC else f"{value:g}"


def _short(value: Any) -> str:
    """Return a value as one line of at most 60 characters."""
    text = " ".join((str(value) if isinstance(value, Real) else repr(value)).split())
    return text if len(text) <= 60 else text[:57] + "..."
