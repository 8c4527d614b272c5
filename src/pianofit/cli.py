"""The command line: thin. Every command checks its arguments, calls one function, and prints what came of it.

Results go to stdout, progress and errors to stderr. Exit codes: 0 done, 1 an input that cannot be used, 2 a command
that cannot be understood, 130 interrupted.
"""

from __future__ import annotations

import contextlib
import functools
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from .errors import ParameterError, PianofitError

if TYPE_CHECKING:
    from .analysis import Analysis

__all__ = ["app", "main"]

app = typer.Typer(
    add_completion=False, pretty_exceptions_enable=False, rich_markup_mode=None,
    help="From recordings of struck strings to the physical parameters behind them, and back to sound.",
)  # fmt: skip

# What cannot be understood on a command line; typer keeps click's class in a place of its own.
UsageError: type[Exception] = typer.BadParameter.__mro__[1]


def _number(text: str | float) -> float:
    try:
        return float(text)
    except ValueError:
        raise typer.BadParameter(f"{text!r} is no number") from None


def _whole(text: str | int) -> int:
    try:
        return int(text)
    except ValueError:
        raise typer.BadParameter(f"{text!r} is no whole number") from None


File = Annotated[Path, typer.Argument(metavar="FILE", help="A recording of one struck note, WAV or FLAC.")]
Note = Annotated[str | None, typer.Option(help="The note's name, such as F#2; found by itself if not given.")]
Pitch = Annotated[
    float | None,
    typer.Option("--f0", parser=_number, metavar="HZ", help="The note's pitch in Hz, instead of its name."),
]
Channel = Annotated[str, typer.Option(help="average, left, right, or a channel's number.")]
Json = Annotated[bool, typer.Option("--json", help="Print JSON.")]
Force = Annotated[bool, typer.Option("--force", help="Replace what is there.")]
Velocity = Annotated[float | None, typer.Option(parser=_number, metavar="M/S", help="Hammer velocity in m/s.")]
Seed = Annotated[
    int,
    typer.Option(parser=_whole, metavar="N", help="Of everything random; the same seed gives the same result."),
]
Seconds = Annotated[float, typer.Option(parser=_number, metavar="S", help="Length of the sound.")]
Rate = Annotated[int | None, typer.Option(parser=_whole, metavar="HZ", help="Sample rate in Hz.")]


def _complain(message: str) -> None:
    """Say what is wrong, on one line whatever is in it."""
    words = " ".join(message.split())
    typer.echo("pianofit: " + "".join(c if c.isprintable() else repr(c)[1:-1] for c in words), err=True)


def _plainly(command: Callable) -> Callable:
    """A command whose errors are one line on stderr and an exit code."""

    @functools.wraps(command)
    def run(*args: Any, **kwargs: Any) -> None:
        try:
            command(*args, **kwargs)
            sys.stdout.flush()
        except PianofitError as error:
            _complain(str(error))
            raise typer.Exit(1) from None
        except KeyboardInterrupt:
            _complain("interrupted; nothing more is written")
            raise typer.Exit(130) from None
        except BrokenPipeError:  # whoever read our output has had enough
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            raise typer.Exit(0) from None

    return run


@contextlib.contextmanager
def _progress() -> Iterator[Callable[[str, float], None]]:
    """A bar on stderr when that is a terminal, else nothing."""
    if not sys.stderr.isatty():
        yield lambda *_: None
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    columns = (TextColumn("{task.description:<18}"), BarColumn(), TimeElapsedColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("starting", total=1.0)
        yield lambda stage, done: bar.update(task, description=stage, completed=done)


def _checked(velocity: float | None, seed: int = 0) -> None:
    from .parameters import PARAMETERS

    box = PARAMETERS["v_H0"]
    if velocity is not None and not box.lower <= velocity <= box.upper:
        raise ParameterError(f"velocity={velocity} m/s must be from {box.lower:g} to {box.upper:g}")
    if seed < 0:
        raise ParameterError(f"seed={seed} must not be negative")


def _version(wanted: bool) -> None:
    if wanted:
        from . import __version__

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
@_plainly
def analyse(
    file: File, note: Note = None, f0: Pitch = None, channel: Channel = "average", as_json: Json = False
) -> None:
    """Read pitch, inharmonicity, losses and partials off a recording, without a hammer."""
    from .analysis import analyse as run
    from .analysis import as_dict
    from .recording import load_recording
    from .workflow import json_text

    found = run(load_recording(file, channel=channel), note=note, f0=f0)
    typer.echo(json_text(as_dict(found)) if as_json else _table(found), nl=False)


def _table(found: Analysis) -> str:
    """The string's laws, then a line for every partial."""
    from .analysis import COLUMNS, rows

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
@_plainly
def fit(
    file: File,
    out: Annotated[Path, typer.Option(help="The folder for fit.json, the sounds and the page.")],
    note: Note = None,
    f0: Pitch = None,
    setup: Annotated[Path | None, typer.Option(help="What was known beforehand, a setup.toml.")] = None,
    velocity: Velocity = None,
    channel: Channel = "average",
    seed: Seed = 0,
    force: Force = False,
    page: Annotated[bool, typer.Option(help="Write report.html.")] = True,
    as_json: Json = False,
) -> None:
    """Find the string's and the hammer's parameters behind a recording."""
    from .workflow import fit_file, json_text, output_folder

    _checked(velocity, seed)
    with output_folder(out, force) as folder, _progress() as progress:
        result = fit_file(
            file, folder, note=note, f0=f0, setup=setup, velocity=velocity, channel=channel, seed=seed, report=page,
            progress=progress,
        )  # fmt: skip
    typer.echo(json_text(result.document) if as_json else _summary(result.document, folder), nl=False)


@app.command()
@_plainly
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
    from .render import check_render, encode_wav

    check_render(velocity, seconds, rate or 44_100)
    from .model.cache import keep_programs
    from .workflow import check_target, write_file

    check_target(out, force)
    keep_programs()
    samples, strike = _struck(preset, change, velocity, seconds, rate or 44_100, quantity)
    write_file(out, encode_wav(samples, rate or 44_100), force)
    typer.echo(
        f"{out}: {seconds:g} s, contact {1e3 * strike.contact_time:.2f} ms, "
        f"largest force {float(strike.pulse.force.max()):.3g} N"
    )


def _struck(preset: str, change: list[str], velocity: float | None, seconds: float, rate: int, quantity: str):
    from .model import simulate as run
    from .parameters import check
    from .published import preset as find
    from .render import CEILING

    it = find(preset)
    values = it.string._asdict() | it.hammer._asdict() | _assignments(change)
    if velocity is not None:
        values["v_H0"] = velocity
    check(values, "--set")
    string = it.string._replace(**{k: values[k] for k in it.string._fields})
    hammer = it.hammer._replace(**{k: values[k] for k in it.hammer._fields})
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
@_plainly
def render(
    fit_json: Annotated[Path, typer.Argument(metavar="FIT.JSON", help="What pianofit fit wrote.")],
    velocity: Annotated[float, typer.Option(parser=_number, metavar="M/S", help="Hammer velocity in m/s.")],
    out: Annotated[Path, typer.Option(help="The WAV file to write.")],
    seconds: Seconds = 6.0,
    rate: Rate = None,
    force: Force = False,
) -> None:
    """Play a fitted string and hammer at any velocity, through its gain and path."""
    from .render import check_render, encode_wav, limited, load_voice

    check_render(velocity, seconds, rate or 44_100)
    voice, own_rate = load_voice(fit_json)
    rate = rate or own_rate
    from .model.cache import keep_programs
    from .workflow import check_target, write_file

    check_target(out, force)
    keep_programs()
    played = voice._replace(hammer=voice.hammer._replace(v_H0=velocity))
    samples, strike = played.play(rate, round(seconds * rate))
    samples, gain = limited(samples)
    write_file(out, encode_wav(samples, rate), force)
    turned = f", brought down by a factor {gain:.3g} to stay below full scale" if gain < 1 else ""
    typer.echo(f"{out}: {seconds:g} s at {velocity:g} m/s, contact {1e3 * strike.contact_time:.2f} ms{turned}")


@app.command()
@_plainly
def demo(
    out: Annotated[Path, typer.Option(help="The folder to write to.")] = Path("pianofit-demo"),
    noise: Annotated[
        float,
        typer.Option(parser=_number, metavar="DB", help="How far the noise lies below the first second's rms, dB."),
    ] = 60.0,
    no_noise: Annotated[bool, typer.Option("--no-noise", help="Without any noise.")] = False,
    seed: Seed = 0,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Make a measurement whose truth is known, fit it from the paper's initial values, and compare."""
    from .workflow import json_text, output_folder

    _checked(None, seed)
    if not 0 <= noise <= 200:
        raise ParameterError(f"noise={noise} dB must be from 0 to 200")
    with output_folder(out, force) as folder, _progress() as progress:
        from .demo import run_demo

        result, true = run_demo(folder, None if no_noise else noise, seed, progress)
    if as_json:
        typer.echo(json_text(result.document | {"true": true}), nl=False)
        return
    typer.echo(_comparison(result.document, true))
    typer.echo(_summary(result.document, folder), nl=False)


def _comparison(document: dict, true: dict[str, float]) -> str:
    lines = [f"{'':8}{'initial':>12}{'true':>12}{'found':>12}{'off by':>10}   95 % interval"]
    for name, value in true.items():
        p = document["parameters"][name]
        span = "[{:.5g}, {:.5g}]".format(*p["interval"]) if p["interval"] else "-"
        off = 100 * (p["value"] / value - 1)
        note = "" if p["status"] == "free" else f"  {p['status']}"
        lines.append(f"{name:8}{p['initial']:12.5g}{value:12.5g}{p['value']:12.5g}{off:+9.3f} %  {span}{note}")
    return "\n".join(lines) + "\n"


def _summary(document: dict, folder: Path) -> str:
    """What was found, in a screenful."""
    lines = [document["verdict"], ""] if document["verdict"] else []
    lines.append(f"{'':8}{'value':>12}  {'unit':8}{'95 % interval':26}status")
    for name, p in document["parameters"].items():
        span = "[{:.5g}, {:.5g}]".format(*p["interval"]) if p["interval"] else "-"
        lines.append(f"{name:8}{p['value']:12.5g}  {p['unit']:8}{span:26}{p['status']}")
    d, levels = document["derived"], document["levels"]
    lines += ["", f"f0 {d['f0']:.3f} Hz, B {d['B']:.4g}, contact {d['contact_ms']:.2f} ms"]
    only = "" if levels["path_only_db"] is None else f", path alone {levels['path_only_db']:.1f} dB"
    lines.append(f"levels of {levels['partials']} partials: start {levels['initial_db']:.2f} dB{only}, "
                 f"fitted {levels['fitted_db']:.2f} dB")  # fmt: skip
    for name in ("global", "band1", "band2", "band3"):
        if name in document["criterion"]:
            c = document["criterion"][name]
            lines.append(f"criterion, {name:7} {c['initial']:10.4g} -> {c['final']:.4g}")
    if document["criterion"]["dropped"]:
        lines.append(f"dropped, no partial above the noise: {', '.join(document['criterion']['dropped'])}")
    lines += ["" if document["converged"] else "NOT CONVERGED", *document["messages"], "", f"written to {folder}"]
    return "\n".join(lines) + "\n"


def main(arguments: Sequence[str] | None = None) -> int:
    """The program's entry point: run the command line `arguments` and return the exit code."""
    arguments = sys.argv[1:] if arguments is None else arguments
    try:
        return app(args=list(arguments) or ["--help"], prog_name="pianofit", standalone_mode=False) or 0
    except UsageError as error:
        command = getattr(getattr(error, "ctx", None), "command_path", "pianofit")
        _complain(f"{error.format_message()}; {command} --help says what there is".replace(".;", ";"))  # pyright: ignore[reportAttributeAccessIssue]
        return 2
    except KeyboardInterrupt:
        _complain("interrupted; nothing more is written")
        return 130
