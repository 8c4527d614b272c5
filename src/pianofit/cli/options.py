"""Arguments and options that several commands have, each with its help, and what reads a value of one."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import typer

from ..felt import LAWS
from ..recording.recording import readable_formats

__all__ = [
    "RATE", "Built", "Channel", "Felt", "Force", "Json", "Known", "Note", "Pitch", "Prefix", "Recordings", "Seconds",
    "Seed", "Sound", "Velocity", "number", "choice", "whole",
]  # fmt: skip


def parse_as(kind: Callable[[str], Any], words: str) -> Callable[[str], Any]:
    """What makes a number of a text, or a usage error that names it."""

    def parse(text: str) -> Any:
        try:
            return kind(text)
        except ValueError:
            raise typer.BadParameter(f"{text!r} is no {words}") from None

    return parse


number, whole = parse_as(float, "number"), parse_as(int, "whole number")


def choice(*words: str) -> Callable[[str], str]:
    """What takes one of the words, or makes a usage error of another."""

    def parse(text: str) -> str:
        if text not in words:
            raise typer.BadParameter(f"{text!r} is not {' or '.join(words)}")
        return text

    return parse


Built = Annotated[
    Path,
    typer.Argument(
        metavar="DIR|INSTRUMENT.JSON", help="What pianofit batch wrote, or the instrument.json of pianofit instrument."
    ),
]
Prefix = Annotated[
    str | None, typer.Option(metavar="PREFIX", help="Which instrument, if DIR holds several, such as cp80.")
]
Note = Annotated[
    str | None,
    typer.Option(
        metavar="NOTE", help="The note: F#2, Fs2, Gb2 or its MIDI number, 42; found from the recording if not given."
    ),
]
Pitch = Annotated[
    float | None, typer.Option("--f0", parser=number, metavar="HZ", help="The note's pitch in Hz, instead of its name.")
]
Channel = Annotated[
    str, typer.Option(metavar="CHANNEL", help="Which channel of a file: average, left, right, or a number from 1.")
]
Recordings = Annotated[
    list[Path],
    typer.Argument(
        metavar="RECORDING...", help=f"One or more recordings of one key, in any order: {readable_formats()}."
    ),
]
Known = Annotated[
    Path | None,
    typer.Option(
        metavar="SETUP.TOML",
        help="What was known beforehand, in SI units: [string] length, mass; [strike] position, width; "
        "[pickup] quantity, position, scale; [fixed], [initial], [bounds] by parameter (docs/files.md).",
    ),
]
Sound = Annotated[Path, typer.Option(metavar="FILE.WAV", help="The WAV file to write.")]
Json = Annotated[bool, typer.Option("--json", help="Print the result as JSON.")]
Felt = Annotated[
    str | None, typer.Option(parser=choice(*LAWS), metavar="LAW", help=f"The felt's law: {', '.join(LAWS)}.")
]
Force = Annotated[bool, typer.Option("--force", help="Replace what --out holds.")]
Velocity = Annotated[float | None, typer.Option(parser=number, metavar="M/S", help="Hammer velocity in m/s.")]
Seed = Annotated[
    int,
    typer.Option(parser=whole, metavar="N", help="Seed of all random numbers; the same seed gives the same result."),
]
Seconds = Annotated[float, typer.Option(parser=number, metavar="S", help="Length of the sound in seconds.")]
# Of an int, or of None where a fit knows its own.
RATE = typer.Option("--rate", parser=whole, metavar="HZ", help="Sample rate in Hz.")
