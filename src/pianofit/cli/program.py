"""Command line. Every command checks its arguments, calls one function and prints its result.

Results go to stdout, progress and errors to stderr. Exit codes: 0 done, 1 invalid input, 2 invalid command line, 130
interrupted.
"""

from __future__ import annotations

import gc
import io
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NoReturn

import typer

from ..errors import check_range
from ..io.files import DISK_FULL, encode_wav, output_folder, printable, replace_file
from ..io.number_format import format_like, format_with_interval
from ..parameters import check_seed
from ..progress import progress_bar
from . import batch, dataset, export, fits, instrument, library, listening, sounds, tuning
from .options import Force, Json, Seed, real
from .terminal import Commands, UsageError, add, print_error, print_result, usage_message

if TYPE_CHECKING:
    from ..result import Result

# Columns of a help text, if the terminal has them; and of the descriptions that a shell completes. A description must
# stay on one line: fish reads a second line as another command.
WIDEST, UNBROKEN = 120, 10_000

# Allocations between two runs of Python's garbage collector. JAX and SciPy keep a million objects alive. With the
# default of 700, scanning them adds 0.2 s to a fit of 4 s.
COLLECTED = 50_000

app = typer.Typer(
    cls=Commands,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": WIDEST},
    epilog="pianofit COMMAND --help lists the arguments of a command, with an example.",
    help="Estimate physical parameters of struck strings from recordings, and synthesise sound from them.",
)


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


def demo(
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder to write to.")] = Path("pianofit-demo"),
    noise: Annotated[float, real("DB", "White noise, dB below the rms of the first second.")] = 60.0,
    seed: Seed = 0,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Fit a synthetic recording, starting from the initial values of the paper, and compare with the true values.

    Writes report.html, synthetic.wav and setup.toml. Takes about a minute.
    """
    check_seed(seed)
    check_range("noise=", noise, 0, 200, " dB")
    with output_folder(out, force) as folder, progress_bar() as progress:
        from ..fitting import fit
        from ..synthetic import demo_recording, setup_text

        progress("synthesis", 0.0)
        synthetic = demo_recording(noise, seed)
        replace_file(folder / "synthetic.wav", encode_wav(synthetic.samples, synthetic.rate))
        replace_file(folder / "setup.toml", setup_text(synthetic.setup).encode())
        result = fit(folder / "synthetic.wav", setup=folder / "setup.toml", seed=seed, progress=progress)
        progress("page", 0.95)
        result.save(folder, force=True)
    words = (
        f"{_true_and_fitted(result, synthetic.true)}\n{result.summary()}\nwritten to {printable(folder)}\n"
        f"the page is {printable(folder / 'report.html')}; the same fit from its files:\n"
        f"pianofit fit {printable(folder / 'synthetic.wav')} --setup {printable(folder / 'setup.toml')} --out another\n"
    )
    print_result(result.to_dict() | {"true": synthetic.true}, words, as_json)


def _true_and_fitted(result: Result, true: dict[str, float]) -> str:
    """Table of true and fitted values."""
    lines = [f"{'':8}{'initial':>12}{'true':>14}{'fitted':>14}{'error':>11}   95 % interval, and true value inside"]
    for name, value in true.items():
        p = result.parameters[name]
        fitted, span = format_with_interval(p.value, p.interval)
        holds = "-" if p.interval is None else "yes" if p.interval[0] <= value <= p.interval[1] else "NO"
        note = "" if p.status == "fitted" else f", {p.status}"
        truth, error = format_like(value, p.value, p.interval), 100 * (p.value / value - 1)
        lines.append(f"{name:8}{p.initial:12.5g}{truth:>14}{fitted:>14}{error:+9.1g} %   {span} {holds}{note}")
    return "\n".join(lines) + "\n"


# By heading of the help and in its order, each command with the example of its own help.
COMMANDS = {
    "One note": {
        fits.analyse: "pianofit analyse note.wav --note F#2",
        fits.fit: "pianofit fit soft.wav mezzo.wav loud.wav --note F#2 --out fitted",
        fits.predict: "pianofit predict fitted/fit.json other.wav --out predicted.wav",
        fits.cross_validate: "pianofit cross-validate soft.wav mezzo.wav loud.wav --note F#2 --out left-out",
        fits.compare: "pianofit compare soft-fit loud-fit --out felts.svg",
        sounds.render: "pianofit render fitted/fit.json --velocity 3 --out harder.wav",
    },
    "A library": {
        library.cut: "pianofit cut session.wav --out library",
        library.mend: "pianofit mend library.csv --fits library --out mended",
        batch.batch: "pianofit batch library.csv --out library",
        batch.status: "pianofit status library",
    },
    "An instrument": {
        instrument.instrument: "pianofit instrument library --prefix cp80 --out cp80",
        instrument.play: "pianofit play cp80/instrument.json song.mid --out song.wav",
        instrument.page: "pianofit page library --prefix cp80",
        export.export: "pianofit export cp80/instrument.json --format sfz --out sampler",
        tuning.tuning: "pianofit tuning library --a4 442 --octave 4:2 --out tuned",
    },
    "Synthesis and data": {
        sounds.simulate: "pianofit simulate --preset bensa-final --set p=3.0 --velocity 2 --out string.wav",
        dataset.dataset: "pianofit dataset --out notes --count 10000 --seed 1 --keys C2-C6 --path --noise 40-70",
    },
    "Tests": {
        listening.listen: "pianofit listen recorded fitted --out test",
        demo: "pianofit demo --out demo",
    },
}
for heading, commands in COMMANDS.items():
    for command, example in commands.items():
        add(app, command, example, heading)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line `arguments`, or those of this process, and return the exit code."""
    arguments = sys.argv[1:] if arguments is None else arguments
    if "_PIANOFIT_COMPLETE" in os.environ:
        os.environ["COLUMNS"] = str(UNBROKEN)
    try:
        return app(args=list(arguments) or ["--help"], prog_name="pianofit", standalone_mode=False) or 0
    except UsageError as error:
        print_error(usage_message(error))
        return 2
    except OSError as error:
        if error.errno not in DISK_FULL or error.filename is not None:
            raise
        # Standard output is full. Python would fail again when it flushes the rest at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        print_error(f"standard output cannot be written ({error.strerror}); send it elsewhere")
        return 1


def _fill_streams() -> None:
    """Open the null device in place of closed standard streams, so that no output file gets their numbers."""
    for name in ("stdin", "stdout", "stderr"):
        if getattr(sys, name) is None:
            os.open(os.devnull, os.O_RDWR)  # takes the lowest free number, that of this stream


def _replace_unencodable() -> None:
    """Write characters that an output stream cannot encode as question marks."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")


def run() -> NoReturn:
    """Run `main` and end the process, without a final garbage collection."""
    _fill_streams()
    if sys.stdout is None:
        print_error("standard output is closed; send it to a file, or to /dev/null")
        sys.exit(1)
    _replace_unencodable()
    gc.set_threshold(COLLECTED, *gc.get_threshold()[1:])
    code = main()
    gc.freeze()
    sys.exit(code)
