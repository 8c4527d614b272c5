"""Arguments and options that several commands share, with their help texts and parsers.

A metavar is a noun in capitals. Two alternatives are joined by |, and FILE.WAV is a file of that kind. Help texts name
the unit. Defaults are those that typer shows.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import typer

from ..errors import check_range
from ..excitation import HAMMER, NAMES
from ..felt import DEFAULT_LAW, LAWS
from ..io.containers import readable_formats
from ..threads import MAX_PROCESSES, cores
from ..transducer import QUANTITIES
from .terminal import bare


def parse_as(kind: Callable[[str], Any], words: str) -> Callable[[str], Any]:
    """Return a parser that raises a usage error for an invalid text: it must be what the `words` say."""

    def parse(text: str) -> Any:
        try:
            return kind(text)
        except ValueError:
            raise typer.BadParameter(f"{bare(text)} must be {words}") from None

    return parse


def number_range(text: str) -> tuple[float, float]:
    """Return the ends of a range of numbers, such as 40-70."""
    low, _, high = text.partition("-")
    return float(low), float(high)


def one_or_range(text: str) -> float | tuple[float, float]:
    """Return a number, or the ends of a range of numbers. A hyphen at the beginning is a sign."""
    return number_range(text) if "-" in text[1:] else float(text)


number, whole = parse_as(float, "a number"), parse_as(int, "a whole number")


def text(metavar: str, words: str, *names: str, default: str = "", parser: Callable[[str], Any] | None = None) -> Any:
    """Return an option for a text, parsed if there is a `parser`, or for a path.

    The `words` are its help, and `default` says what its absence means.
    """
    return typer.Option(*names, parser=parser, metavar=metavar, help=words, show_default=default or True)


def real(metavar: str, words: str, *names: str, default: str = "") -> Any:
    """Return an option for a number."""
    return text(metavar, words, *names, default=default, parser=number)


def integer(metavar: str, words: str, *names: str, default: str = "") -> Any:
    """Return an option for a whole number."""
    return text(metavar, words, *names, default=default, parser=whole)


def choice(metavar: str, words: str, choices: tuple[str, ...], *names: str, default: str = "") -> Any:
    """Return an option that accepts only some words. Its help lists them."""
    listed = " or ".join([", ".join(choices[:-1]), choices[-1]])

    def member(text: str) -> str:
        if text not in choices:
            raise ValueError
        return text

    return text(metavar, f"{words}: {listed}.", *names, default=default, parser=parse_as(member, listed))


def flag(name: str, words: str) -> Any:
    """Return an option without a value, and without a form that negates it."""
    return typer.Option(name, help=words)


Built = Annotated[
    Path, typer.Argument(metavar="DIR|INSTRUMENT.JSON", help="The folder of a batch, or an instrument.json.")
]
Prefix = Annotated[str | None, text("NAME", "Instrument to use if the folder holds several, such as cp80.")]
Root = Annotated[
    Path | None,
    text("DIR", "Folder that must contain all recordings, after resolving links.", default="that of LIBRARY"),
]
Transpose = Annotated[int, integer("N", "Semitones added to every note name, such as 12 or -12.")]
Even = Annotated[
    float,
    real("AMOUNT", "Move recorded keys towards the laws in level, decay and brightness: 0 (as fitted) to 1 (wholly)."),
]
Note = Annotated[
    str | None, text("NOTE", "Note: F#2, Fs2, Gb2 or its MIDI number, 42.", default="detected in the recording")
]
Pitch = Annotated[float | None, real("HZ", "Pitch of the note in Hz, in place of --note, or with it.", "--f0")]
Channel = Annotated[str, text("CHANNEL", "Channel of the file: average, left, right, or a number from 1.")]
Recordings = Annotated[
    list[Path],
    typer.Argument(
        metavar="RECORDING...", help=f"One or more recordings of one key, in any order: {readable_formats()}."
    ),
]
SetupFile = Annotated[
    Path | None,
    text(
        "SETUP.TOML",
        "Given values in SI units: [string] length, mass; [strike] position, width; "
        "[pickup] quantity, position, scale; [fixed], [initial], [bounds] by parameter (docs/files.md).",
    ),
]
Sound = Annotated[Path, text("FILE.WAV", "WAV file to write.")]
Json = Annotated[bool, flag("--json", "Print the result as JSON.")]
# The default in brackets holds if neither an option nor the setup states the value.
Felt = Annotated[str | None, choice("LAW", "Felt law", tuple(LAWS), default=f"that of --setup, or {DEFAULT_LAW.name}")]
Excitation = Annotated[
    str | None, choice("KIND", "Excitation of the string", NAMES, default=f"that of --setup, or {HAMMER}")
]
Quantity = Annotated[
    str | None, choice("QUANTITY", "Recorded quantity", QUANTITIES, default="that of --setup, or pressure")
]
PICKUP = "Position of a pickup on the string, m from the agraffe."
Pickup = Annotated[float | None, real("M", PICKUP, default="that of --setup")]
Force = Annotated[bool, flag("--force", "Replace existing output in --out.")]
Seed = Annotated[int, integer("N", "Seed of all random numbers. The same seed gives the same result.")]
Seconds = Annotated[float, real("S", "Length of the sound in seconds.")]
Processes = Annotated[int | None, integer("N", "Number of processes.", default="one per core")]
DryRun = Annotated[bool, flag("--dry-run", "List what would be done, and write nothing.")]
# For an int, or for None where a fit has its own rate.
RATE = integer("HZ", "Sample rate in Hz.", "--rate")


def process_count(processes: int | None) -> int:
    """Return the number of processes, one per core by default, or raise a `ParameterError`."""
    check_range("processes=", 1 if processes is None else processes, 1, MAX_PROCESSES)
    return processes or cores()
