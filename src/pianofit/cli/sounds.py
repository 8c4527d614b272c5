"""The commands from parameters to a sound file: simulate and render."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ..errors import ParameterError
from ..felt import BOXES, make_hammer
from ..io import CEILING, check_sound_target, encode_wav, limited, write_file
from ..parameters import check
from .options import RATE, Force, Seconds, Sound, Velocity, number
from .summary import contact_of

__all__ = ["render", "simulate"]


def simulate(
    preset: Annotated[
        str,
        typer.Option(
            metavar="NAME", help="A published string and hammer, such as bensa-final; a wrong name lists all."
        ),
    ],
    out: Sound,
    change: Annotated[
        list[str],
        typer.Option("--set", metavar="NAME=NUMBER", help="A parameter to change; may be given several times."),
    ] = [],  # noqa: B006
    velocity: Velocity = None,
    seconds: Seconds = 3.0,
    rate: Annotated[int, RATE] = 44_100,
    quantity: Annotated[
        str, typer.Option(metavar="QUANTITY", help="What is heard: velocity, displacement or bridge-force.")
    ] = "bridge-force",
    force: Force = False,
) -> None:
    """Strike a published string and write its sound, its peak at -1 dBFS."""
    check_sound_target(out, force)
    from ..model.cache import keep_programs
    from ..model.note import check_render

    check_render(velocity, seconds, rate)
    keep_programs()
    samples, strike = _struck(preset, change, velocity, seconds, rate, quantity)
    write_file(out, encode_wav(samples, rate), force)
    typer.echo(f"{out}: {seconds:g} s, largest force {float(strike.pulse.force.max()):.3g} N, {contact_of(strike)}")


def _struck(preset: str, change: list[str], velocity: float | None, seconds: float, rate: int, quantity: str):
    from ..model import simulate as run
    from ..published import preset as find

    it = find(preset)
    changed = _assignments(change)
    if velocity is not None and "v_H0" in changed:
        raise ParameterError(f"velocity={velocity} and --set v_H0={changed['v_H0']} are both given; remove one of them")
    values = it.string._asdict() | it.hammer._asdict() | changed
    if velocity is not None:
        values["v_H0"] = velocity
    check({name: value for name, value in values.items() if (name, value) != ("mu", 0.0)}, "--set", BOXES)
    string = it.string._replace(**{k: values[k] for k in it.string._fields})
    hammer = make_hammer(values, "--set")
    strike = run(string, hammer, it.geometry, rate=rate, quantity=quantity)
    samples = strike.waveform(rate, round(seconds * rate))
    return samples * (CEILING / max(abs(samples).max(), 1e-300)), strike


def _assignments(change: list[str]) -> dict[str, float]:
    values = {}
    for text in change:
        name, _, number = (part.strip() for part in text.partition("="))
        if name in values:
            raise ParameterError(f"--set {text!r}: {name} is set twice; remove one of them")
        try:
            values[name] = float(number)
        except ValueError:
            raise ParameterError(f"--set {text!r} must be NAME=NUMBER, such as c=304.1") from None
    return values


def render(
    fit_json: Annotated[Path, typer.Argument(metavar="FIT.JSON", help="What pianofit fit wrote.")],
    velocity: Annotated[float, typer.Option(parser=number, metavar="M/S", help="Hammer velocity in m/s.")],
    out: Sound,
    seconds: Seconds = 6.0,
    rate: Annotated[int | None, RATE] = None,
    force: Force = False,
) -> None:
    """Play a fitted string and hammer at any velocity, through its gain and path."""
    check_sound_target(out, force)
    from ..fit_file import load_note
    from ..model.cache import keep_programs
    from ..model.note import check_render

    check_render(velocity, seconds, 44_100 if rate is None else rate)
    note, own_rate = load_note(fit_json)
    rate = own_rate if rate is None else rate
    keep_programs()
    played = note._replace(hammer=note.hammer._replace(v_H0=velocity))
    strike = played.strike(rate)
    samples, gain = limited(played.frames(strike, rate, round(seconds * rate), round(played.lead * rate)))
    write_file(out, encode_wav(samples[0] if len(samples) == 1 else samples, rate), force)
    turned = f", brought down by a factor {gain:.3g} to stay below full scale" if gain < 1 else ""
    typer.echo(f"{out}: {seconds:g} s at {velocity:g} m/s, {contact_of(strike)}{turned}")
