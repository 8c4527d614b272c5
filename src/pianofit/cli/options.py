"""The command line's arguments and options, each with its help, in one place."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ..errors import ParameterError
from ..felt import LAWS

__all__ = [
    "Built", "Channel", "Evaluations", "Felt", "File", "Force", "Intervals", "Json", "Known", "Note", "Pitch", "Prefix",
    "Rate", "Recipe", "Recordings", "Seconds", "Seed", "Sound", "Velocity", "check_common", "number", "whole",
]  # fmt: skip


def check_common(velocity: float | None, seed: int = 0) -> None:
    """Refuse a velocity, m/s, or a seed outside its range.

    Raises
    ------
    ParameterError
        Naming the argument, its value and its range.
    """
    from ..parameters import check_velocity

    check_velocity(velocity)
    if seed < 0:
        raise ParameterError(f"seed={seed} must not be negative")


def number(text: str | float) -> float:
    """A number, or a usage error."""
    try:
        return float(text)
    except ValueError:
        raise typer.BadParameter(f"{text!r} is no number") from None


def whole(text: str | int) -> int:
    """A whole number, or a usage error."""
    try:
        return int(text)
    except ValueError:
        raise typer.BadParameter(f"{text!r} is no whole number") from None


def _recipe(text: str) -> str:
    if text == "default":
        return text
    from ..paper.recipes import RECIPES

    if text not in RECIPES:
        raise typer.BadParameter(f"{text!r} is none of {', '.join(RECIPES)}")
    return text


def _intervals(text: str) -> str:
    if text == "laplace":
        return text
    from ..inference.views import MEANS

    if text not in MEANS:
        raise typer.BadParameter(f"{text!r} is none of {', '.join(MEANS)}")
    return text


def _felt(text: str) -> str:
    if text not in LAWS:
        raise typer.BadParameter(f"{text!r} is none of {', '.join(LAWS)}")
    return text


Built = Annotated[
    Path,
    typer.Argument(
        metavar="DIR|INSTRUMENT.JSON", help="What pianofit batch wrote, or the instrument.json of pianofit instrument."
    ),
]
Prefix = Annotated[
    str | None, typer.Option(metavar="PREFIX", help="Which instrument, if DIR holds several, such as cp80.")
]
File = Annotated[Path, typer.Argument(metavar="FILE", help="A recording of one struck note, WAV or FLAC.")]
Note = Annotated[
    str | None,
    typer.Option(
        metavar="NOTE",
        help="The note: F#2, Fs2, Gb2 or its MIDI number, 42; found from the recording if not given.",
    ),
]
Pitch = Annotated[
    float | None,
    typer.Option("--f0", parser=number, metavar="HZ", help="The note's pitch in Hz, instead of its name."),
]
Channel = Annotated[
    str, typer.Option(metavar="CHANNEL", help="Which channel of a file: average, left, right, or a number from 1.")
]
Recordings = Annotated[
    list[Path],
    typer.Argument(metavar="RECORDING...", help="One or more recordings of one key, WAV or FLAC, in any order."),
]
Known = Annotated[
    Path | None,
    typer.Option(metavar="SETUP.TOML", help="What was known beforehand: lengths, masses, velocities, the pickup."),
]
Sound = Annotated[Path, typer.Option(metavar="FILE.WAV", help="The WAV file to write.")]
Json = Annotated[bool, typer.Option("--json", help="Print the result as JSON.")]
Felt = Annotated[
    str | None,
    typer.Option(parser=_felt, metavar="LAW", help=f"The felt's law: {', '.join(LAWS)}."),
]
Force = Annotated[bool, typer.Option("--force", help="Replace what --out holds.")]
Velocity = Annotated[float | None, typer.Option(parser=number, metavar="M/S", help="Hammer velocity in m/s.")]
Seed = Annotated[
    int,
    typer.Option(parser=whole, metavar="N", help="Seed of all random numbers; the same seed gives the same result."),
]
Recipe = Annotated[
    str,
    typer.Option(parser=_recipe, metavar="NAME", help="default; or, for comparison, the paper's own: paper or global."),
]
Evaluations = Annotated[
    int | None,
    typer.Option(parser=whole, metavar="N", help="Evaluations of the criterion by the annealing of --recipe paper."),
]
Intervals = Annotated[
    str,
    typer.Option(
        parser=_intervals, metavar="METHOD",
        help="How intervals are found: laplace; profile, which takes some seconds more; or posterior, sampled by NUTS, "
        "which takes minutes and needs the extra bayes.",
    ),
]  # fmt: skip
Seconds = Annotated[float, typer.Option(parser=number, metavar="S", help="Length of the sound in seconds.")]
Rate = Annotated[int | None, typer.Option(parser=whole, metavar="HZ", help="Sample rate in Hz.")]
