"""The command line's arguments and options, each with its help, in one place."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

__all__ = [
    "Channel", "Evaluations", "Felt", "File", "Force", "Intervals", "Json", "Known", "Note", "Pitch",
    "Rate", "Recipe", "Seconds", "Seed", "Takes", "Velocity", "number",
]  # fmt: skip


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
    from ..parameters import FELT_LAWS

    if text not in FELT_LAWS:
        raise typer.BadParameter(f"{text!r} is none of {', '.join(FELT_LAWS)}")
    return text


File = Annotated[Path, typer.Argument(metavar="FILE", help="A recording of one struck note, WAV or FLAC.")]
Note = Annotated[str | None, typer.Option(help="The note's name, such as F#2; found by itself if not given.")]
Pitch = Annotated[
    float | None,
    typer.Option("--f0", parser=number, metavar="HZ", help="The note's pitch in Hz, instead of its name."),
]
Channel = Annotated[str, typer.Option(help="average, left, right, or a channel's number.")]
Takes = Annotated[
    list[Path], typer.Argument(metavar="TAKE...", help="Recordings of one key, WAV or FLAC; any order, soft to loud.")
]
Known = Annotated[Path | None, typer.Option(help="What was known beforehand, a setup.toml.")]
Json = Annotated[bool, typer.Option("--json", help="Print JSON.")]
Felt = Annotated[
    str | None,
    typer.Option(parser=_felt, metavar="LAW", help="The felt's law: hunt-crossley, power or stulov."),
]
Force = Annotated[bool, typer.Option("--force", help="Replace what is there.")]
Velocity = Annotated[float | None, typer.Option(parser=number, metavar="M/S", help="Hammer velocity in m/s.")]
Seed = Annotated[
    int,
    typer.Option(parser=whole, metavar="N", help="Of everything random; the same seed gives the same result."),
]
Recipe = Annotated[
    str,
    typer.Option(parser=_recipe, metavar="NAME", help="default, or, to compare, the paper's own: paper, or global."),
]
Evaluations = Annotated[
    int | None,
    typer.Option(parser=whole, metavar="N", help="Of the criterion by the recipe paper's annealing."),
]
Intervals = Annotated[
    str,
    typer.Option(
        parser=_intervals, metavar="MEANS",
        help="laplace, profile (seconds), or posterior, by NUTS (minutes; needs pianofit[bayes]).",
    ),
]  # fmt: skip
Seconds = Annotated[float, typer.Option(parser=number, metavar="S", help="Length of the sound.")]
Rate = Annotated[int | None, typer.Option(parser=whole, metavar="HZ", help="Sample rate in Hz.")]
