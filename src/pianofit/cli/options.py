"""Arguments and options that several commands share, with their help texts and parsers."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import typer

from ..excitation import NAMES
from ..felt import LAWS
from ..recording.recording import readable_formats
from ..transducer import QUANTITIES


def parse_as(kind: Callable[[str], Any], words: str) -> Callable[[str], Any]:
    """Return a parser that raises a usage error for an invalid text."""

    def parse(text: str) -> Any:
        try:
            return kind(text)
        except ValueError:
            raise typer.BadParameter(f"{text!r} is not a {words}") from None

    return parse


number, whole = parse_as(float, "number"), parse_as(int, "whole number")


def text(metavar: str, words: str, *names: str) -> Any:
    """Return an option for a text or a path, with its help `words`."""
    return typer.Option(*names, metavar=metavar, help=words)


def real(metavar: str, words: str, *names: str) -> Any:
    """Return an option for a number."""
    return typer.Option(*names, parser=number, metavar=metavar, help=words)


def integer(metavar: str, words: str, *names: str) -> Any:
    """Return an option for a whole number."""
    return typer.Option(*names, parser=whole, metavar=metavar, help=words)


def choice(*words: str) -> Callable[[str], str]:
    """Return a parser that accepts only these words."""

    def parse(text: str) -> str:
        if text not in words:
            raise typer.BadParameter(f"{text!r} is not {' or '.join(words)}")
        return text

    return parse


Built = Annotated[
    Path, typer.Argument(metavar="DIR|INSTRUMENT.JSON", help="The folder of a batch, or an instrument.json.")
]
Prefix = Annotated[str | None, text("PREFIX", "Which instrument, if DIR has several, such as cp80.")]
Even = Annotated[
    float, real("0...1", "Move recorded keys towards the laws in level, decay and brightness: 0 as fitted, 1 wholly.")
]
Note = Annotated[
    str | None, text("NOTE", "Note: F#2, Fs2, Gb2 or its MIDI number, 42. Default: detected in the recording.")
]
Pitch = Annotated[float | None, real("HZ", "Pitch of the note in Hz, instead of --note.", "--f0")]
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
Json = Annotated[bool, typer.Option("--json", help="Print the result as JSON.")]
Felt = Annotated[str | None, typer.Option(parser=choice(*LAWS), metavar="LAW", help=f"Felt law: {', '.join(LAWS)}.")]
Excitation = Annotated[
    str | None,
    typer.Option(parser=choice(*NAMES), metavar="KIND", help=f"Excitation of the string: {' or '.join(NAMES)}."),
]
Quantity = Annotated[
    str | None,
    typer.Option(parser=choice(*QUANTITIES), metavar="QUANTITY", help=f"Recorded quantity: {', '.join(QUANTITIES)}."),
]
Pickup = Annotated[
    float | None, real("M", "Position of a pickup on the string, m from the end that the strike position counts from.")
]
Force = Annotated[bool, typer.Option("--force", help="Replace existing output in --out.")]
Velocity = Annotated[float | None, real("M/S", "Hammer velocity in m/s.")]
Seed = Annotated[int, integer("N", "Seed of all random numbers. The same seed gives the same result.")]
Seconds = Annotated[float, real("S", "Length of the sound in seconds.")]
# For an int, or for None where a fit has its own rate.
RATE = integer("HZ", "Sample rate in Hz.", "--rate")
