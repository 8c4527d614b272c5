"""The command line: thin. Every command checks its arguments, calls one function, and prints what came of it.

Results go to stdout, progress and errors to stderr. Exit codes: 0 done, 1 an input that cannot be used, 2 a command
that cannot be understood, 130 interrupted.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ..errors import ParameterError
from .batch import register as register_batch
from .instrument import register as register_instrument
from .options import (
    Channel,
    Evaluations,
    Felt,
    File,
    Force,
    Intervals,
    Json,
    Known,
    Note,
    Pitch,
    Rate,
    Recipe,
    Seconds,
    Seed,
    Takes,
    Velocity,
    number,
)
from .terminal import complain, plainly, progress_bar

if TYPE_CHECKING:
    from ..analysis import Analysis

__all__ = ["app", "main"]

app = typer.Typer(
    add_completion=False, pretty_exceptions_enable=False, rich_markup_mode=None,
    help="From recordings of struck strings to the physical parameters behind them, and back to sound.",
)  # fmt: skip

# What cannot be understood on a command line; typer keeps click's class in a place of its own.
UsageError: type[Exception] = typer.BadParameter.__mro__[1]


def _checked(velocity: float | None, seed: int = 0) -> None:
    from ..parameters import PARAMETERS

    box = PARAMETERS["v_H0"]
    if velocity is not None and not box.lower <= velocity <= box.upper:
        raise ParameterError(f"velocity={velocity} m/s must be from {box.lower:g} to {box.upper:g}")
    if seed < 0:
        raise ParameterError(f"seed={seed} must not be negative")


def _version(wanted: bool) -> None:
    if wanted:
        from .. import __version__

        typer.echo(f"pianofit {__version__}")
        raise typer.Exit


@app.callback()
def _all(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version and stop.")
    ] = False,
) -> None:
    pass


@app.command()
@plainly
def analyse(
    file: File, note: Note = None, f0: Pitch = None, channel: Channel = "average", as_json: Json = False
) -> None:
    """Read pitch, inharmonicity, losses and partials off a recording, without a hammer."""
    from ..analysis import analyse as run
    from ..analysis import as_dict
    from ..io import json_text
    from ..recording import load_recording

    found = run(load_recording(file, channel=channel), note=note, f0=f0)
    typer.echo(json_text(as_dict(found)) if as_json else _table(found), nl=False)


def _table(found: Analysis) -> str:
    """The string's laws, then a line for every partial."""
    from ..analysis import COLUMNS, rows

    note = f"{found.note}, " if found.note else ""
    lines = [
        f"f0 {found.f0:.3f} ± {found.f0_error:.3f} Hz ({note}B {found.B:.4g} ± {found.B_error:.2g})",
        f"b1 {found.b1:.3g} ± {found.b1_error:.2g} 1/s, rising with k² by {found.d2:.3g} ± {found.d2_error:.2g} 1/s",
        f"the pitch falls by {found.glide_cents:.1f} cents; partials scatter by {found.scatter_cents:.2f} cents",
        "",
        " ".join(f"{f'{name}, {unit}' if unit else name:>14}" for name, unit, _ in COLUMNS),
    ]
    digits = [places for _, _, places in COLUMNS]
    lines += [" ".join(f"{x:14.{d}f}" for x, d in zip(row, digits, strict=True)) for row in rows(found)]
    return "\n".join([*lines, *found.warnings]) + "\n"


@app.command()
@plainly
def fit(
    takes: Takes,
    out: Annotated[Path, typer.Option(help="The folder for fit.json, the sounds and the page.")],
    note: Note = None,
    f0: Pitch = None,
    setup: Known = None,
    velocity: Velocity = None,
    channel: Channel = "average",
    felt: Felt = None,
    recipe: Recipe = "default",
    evaluations: Evaluations = None,
    intervals: Intervals = "laplace",
    seed: Seed = 0,
    force: Force = False,
    page: Annotated[bool, typer.Option(help="Write report.html.")] = True,
    as_json: Json = False,
) -> None:
    """Find the string's and the hammer's parameters behind one recording, or behind several of one key."""
    from ..io import json_text, output_folder
    from ..workflow import fit_files
    from .summary import summary

    _checked(velocity, seed)
    with output_folder(out, force) as folder, progress_bar() as progress:
        result = fit_files(
            takes, folder, note=note, f0=f0, setup=setup, velocity=velocity, channel=channel, felt=felt, recipe=recipe,
            evaluations=evaluations, intervals=intervals, seed=seed, report=page, progress=progress,
        )  # fmt: skip
    typer.echo(json_text(result.document) if as_json else summary(result.document, folder), nl=False)


@app.command()
@plainly
def predict(
    fit: Annotated[Path, typer.Argument(metavar="FIT", help="The fit.json of a fit.")],
    recording: Annotated[Path, typer.Argument(metavar="RECORDING", help="A recording of the same key.")],
    out: Annotated[Path | None, typer.Option(help="A WAV file for the predicted sound.")] = None,
    channel: Channel = "average",
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Predict a recording that the fit has not heard: only velocity, gain and pitch are free."""
    from ..io import check_target, json_text
    from ..workflow import predict_file

    if out is not None:
        check_target(out, force)
    found = predict_file(fit, recording, out, channel=channel, force=force)
    typer.echo(json_text(found) if as_json else f"{found['predicted_db']:.2f} dB over {found['partials']} partials, at "
               f"{found['v_H0']:.3g} m/s, {found['cents']:+.2f} cents\n", nl=False)  # fmt: skip


@app.command()
@plainly
def crossval(
    takes: Takes,
    out: Annotated[Path | None, typer.Option(help="A folder for the fit of all and its page.")] = None,
    note: Note = None,
    f0: Pitch = None,
    setup: Known = None,
    channel: Channel = "average",
    felt: Felt = None,
    seed: Seed = 0,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Leave out each recording of a key in turn, fit the others, and predict it."""
    from ..io import json_text, output_folder
    from ..workflow import cross_validate_files
    from .summary import cross_validation

    _checked(None, seed)
    with nullcontext() if out is None else output_folder(out, force) as folder, progress_bar() as progress:
        found = cross_validate_files(
            takes, folder, note=note, f0=f0, setup=setup, channel=channel, felt=felt, seed=seed, progress=progress
        )
    typer.echo(json_text(found) if as_json else cross_validation(found), nl=False)


@app.command()
@plainly
def simulate(
    preset: Annotated[str, typer.Option(help="A published string and hammer; a wrong name lists them.")],
    out: Annotated[Path, typer.Option(help="The WAV file to write.")],
    change: Annotated[list[str], typer.Option("--set", help="A parameter to change, such as c=304.1.")] = [],  # noqa: B006
    velocity: Velocity = None,
    seconds: Seconds = 3.0,
    rate: Rate = 44_100,
    quantity: Annotated[str, typer.Option(help="velocity, displacement or bridge-force.")] = "bridge-force",
    force: Force = False,
) -> None:
    """Strike a published string and write its sound, its peak at -1 dBFS."""
    from ..io import encode_wav
    from ..model.note import check_render

    check_render(velocity, seconds, rate or 44_100)
    from ..io import check_target, write_file
    from ..model.cache import keep_programs

    check_target(out, force)
    keep_programs()
    samples, strike = _struck(preset, change, velocity, seconds, rate or 44_100, quantity)
    write_file(out, encode_wav(samples, rate or 44_100), force)
    typer.echo(
        f"{out}: {seconds:g} s, contact {1e3 * strike.contact_time:.2f} ms, "
        f"largest force {float(strike.pulse.force.max()):.3g} N"
    )


def _struck(preset: str, change: list[str], velocity: float | None, seconds: float, rate: int, quantity: str):
    from ..model import simulate as run
    from ..parameters import check, make_hammer
    from ..published import preset as find
    from ..render import CEILING

    it = find(preset)
    values = it.string._asdict() | it.hammer._asdict() | _assignments(change)
    if velocity is not None:
        values["v_H0"] = velocity
    check({name: value for name, value in values.items() if (name, value) != ("mu", 0.0)}, "--set")
    string = it.string._replace(**{k: values[k] for k in it.string._fields})
    hammer = make_hammer(values, "--set")
    strike = run(string, hammer, it.geometry, rate=rate, quantity=quantity)
    samples = strike.waveform(rate, round(seconds * rate))
    return samples * (CEILING / max(abs(samples).max(), 1e-300)), strike


def _assignments(change: list[str]) -> dict[str, float]:
    values = {}
    for text in change:
        name, equals, number = text.partition("=")
        try:
            values[name.strip()] = float(number)
        except ValueError:
            raise ParameterError(f"--set {text!r} must be NAME=NUMBER, such as c=304.1") from None
        if not equals:
            raise ParameterError(f"--set {text!r} must be NAME=NUMBER, such as c=304.1")
    return values


@app.command()
@plainly
def render(
    fit_json: Annotated[Path, typer.Argument(metavar="FIT.JSON", help="What pianofit fit wrote.")],
    velocity: Annotated[float, typer.Option(parser=number, metavar="M/S", help="Hammer velocity in m/s.")],
    out: Annotated[Path, typer.Option(help="The WAV file to write.")],
    seconds: Seconds = 6.0,
    rate: Rate = None,
    force: Force = False,
) -> None:
    """Play a fitted string and hammer at any velocity, through its gain and path."""
    from ..io import encode_wav
    from ..model.note import check_render
    from ..render import limited, load_note

    check_render(velocity, seconds, rate or 44_100)
    note, own_rate = load_note(fit_json)
    rate = rate or own_rate
    from ..io import check_target, write_file
    from ..model.cache import keep_programs

    check_target(out, force)
    keep_programs()
    played = note.struck(velocity)
    samples, strike = played.play(rate, round(seconds * rate))
    samples, gain = limited(samples)
    write_file(out, encode_wav(samples, rate), force)
    turned = f", brought down by a factor {gain:.3g} to stay below full scale" if gain < 1 else ""
    typer.echo(f"{out}: {seconds:g} s at {velocity:g} m/s, contact {1e3 * strike.contact_time:.2f} ms{turned}")


@app.command()
@plainly
def demo(
    out: Annotated[Path, typer.Option(help="The folder to write to.")] = Path("pianofit-demo"),
    noise: Annotated[
        float,
        typer.Option(parser=number, metavar="DB", help="How far the noise lies below the first second's rms, dB."),
    ] = 60.0,
    no_noise: Annotated[bool, typer.Option("--no-noise", help="Without any noise.")] = False,
    seed: Seed = 0,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Make a measurement whose truth is known, fit it from the paper's initial values, and compare."""
    from ..io import json_text, output_folder
    from .summary import comparison, summary

    _checked(None, seed)
    if not 0 <= noise <= 200:
        raise ParameterError(f"noise={noise} dB must be from 0 to 200")
    with output_folder(out, force) as folder, progress_bar() as progress:
        from .demo import run_demo

        result, true = run_demo(folder, None if no_noise else noise, seed, progress)
    if as_json:
        typer.echo(json_text(result.document | {"true": true}), nl=False)
        return
    typer.echo(comparison(result.document, true))
    typer.echo(summary(result.document, folder), nl=False)


@app.command()
@plainly
def reproduce(
    out: Annotated[Path, typer.Option(help="The folder for the page, index.html, and the files behind it.")],
    seed: Seed = 0,
    force: Force = False,
    quick: Annotated[bool, typer.Option("--quick", hidden=True)] = False,
) -> None:
    """Test the paper's tables, figures and claims on measurements of the program's own laboratory: one page."""
    from ..io import output_folder

    _checked(None, seed)
    with output_folder(out, force) as folder, progress_bar() as progress:
        from ..reproduce import FULL, QUICK
        from ..reproduce import reproduce as run

        verdicts = run(folder, seed, plan=QUICK if quick else FULL, progress=progress)
    for verdict in verdicts:
        instead = f" ({verdict.instead})" if verdict.instead else ""
        typer.echo(f"{verdict.word:17} {verdict.claim}{instead}")
    typer.echo(f"\nwritten to {folder}: open index.html, and listening.html for the blind test")


register_batch(app)
register_instrument(app)


def main(arguments: Sequence[str] | None = None) -> int:
    """The program's entry point: run the command line `arguments` and return the exit code."""
    arguments = sys.argv[1:] if arguments is None else arguments
    try:
        return app(args=list(arguments) or ["--help"], prog_name="pianofit", standalone_mode=False) or 0
    except UsageError as error:
        command = getattr(getattr(error, "ctx", None), "command_path", "pianofit")
        complain(f"{error.format_message()}; {command} --help says what there is".replace(".;", ";"))  # pyright: ignore[reportAttributeAccessIssue]
        return 2
    except KeyboardInterrupt:
        complain("interrupted; nothing more is written")
        return 130
