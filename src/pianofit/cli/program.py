"""The command line: thin. Every command checks its arguments, calls one function, and prints what came of it.

Results go to stdout, progress and errors to stderr. Exit codes: 0 done, 1 an input that cannot be used, 2 a command
that cannot be understood, 130 interrupted.
"""

from __future__ import annotations

import gc
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, NoReturn

import typer

from ..errors import check_range
from ..io.files import DISK_FULL, encode_wav, output_folder, replace_file
from ..parameters import check_seed
from ..progress import progress_bar
from . import batch, export, fits, instrument, listening, sounds
from .options import Force, Json, Seed, number
from .terminal import add, print_error, print_result

__all__ = ["app", "main", "run"]

# Columns that a help text fills, where the terminal has them; and of a description that a shell shows beside what it
# completes: a line each, which a narrow terminal would break in two, and fish would take the second for a command.
WIDEST, UNBROKEN = 120, 10_000

# Objects between two rounds of Python's collector. JAX and SciPy leave a million that are no garbage; by the 700 that
# are usual it goes through them so often that a fit of 4 s takes 0.2 s longer.
COLLECTED = 50_000

app = typer.Typer(
    pretty_exceptions_enable=False, rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": WIDEST},
    epilog="pianofit COMMAND --help says what a command needs, with an example.",
    help="From recordings of struck strings to the physical parameters behind them, and back to sound.",
)  # fmt: skip

# What cannot be understood on a command line; typer keeps click's class in a place of its own.
UsageError: type[Exception] = typer.BadParameter.__mro__[1]


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
    out: Annotated[Path, typer.Option(metavar="DIR", help="The folder to write to.")] = Path("pianofit-demo"),
    noise: Annotated[
        float,
        typer.Option(parser=number, metavar="DB", help="How far the noise lies below the first second's rms, dB."),
    ] = 60.0,
    seed: Seed = 0,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Make a measurement whose truth is known, fit it from the paper's initial values, and compare."""
    from .summary import comparison, summary

    check_seed(seed)
    check_range("noise=", noise, 0, 200, " dB")
    with output_folder(out, force) as folder, progress_bar() as progress:
        from ..bensa2005.laboratory import make_synthetic_recording, setup_text
        from ..fitting import fit
        from ..model.program_cache import enable_program_cache

        enable_program_cache()
        progress("making the twin", 0.0)
        twin = make_synthetic_recording(noise, seed)
        replace_file(folder / "twin.wav", encode_wav(twin.samples, twin.rate))
        replace_file(folder / "setup.toml", setup_text().encode())
        result = fit(folder / "twin.wav", setup=folder / "setup.toml", seed=seed, progress=progress)
        progress("page", 0.95)
        result.save(folder, force=True)
    words = (
        f"{comparison(result.document, twin.true)}\n{summary(result.document, folder)}"
        f"the page is {folder / 'report.html'}; the same fit from its files:\n"
        f"pianofit fit {folder / 'twin.wav'} --setup {folder / 'setup.toml'} --out another\n"
    )
    print_result(result.document | {"true": twin.true}, words, as_json)


def reproduce(
    out: Annotated[
        Path, typer.Option(metavar="DIR", help="The folder for the page, index.html, and the files behind it.")
    ],
    seed: Seed = 0,
    force: Force = False,
    quick: Annotated[bool, typer.Option("--quick", hidden=True)] = False,
) -> None:
    """Test the paper's tables, figures and claims on measurements of the program's own laboratory: one page."""
    check_seed(seed)
    with output_folder(out, force) as folder, progress_bar() as progress:
        from ..bensa2005.reproduce import FULL, QUICK
        from ..bensa2005.reproduce import reproduce as run

        claims = run(folder, seed, plan=QUICK if quick else FULL, progress=progress)
    for one in claims:
        instead = f" ({one.instead})" if one.instead else ""
        typer.echo(f"{one.word:17} {one.claim}{instead}")
    typer.echo(f"\nwritten to {folder}: open index.html, and listening.html for the blind test")


# In the order of the help, each with the example that ends its own.
COMMANDS = {
    fits.analyse: "pianofit analyse note.wav --note F#2",
    fits.fit: "pianofit fit soft.wav mezzo.wav loud.wav --note F#2 --out fitted",
    fits.predict: "pianofit predict fitted/fit.json other.wav --out predicted.wav",
    fits.crossval: "pianofit crossval soft.wav mezzo.wav loud.wav --note F#2 --out left-out",
    fits.compare: "pianofit compare soft-fit loud-fit --out felts.svg",
    batch.batch: "pianofit batch library.csv --out library",
    batch.status: "pianofit status library",
    instrument.instrument: "pianofit instrument library --prefix cp80 --out cp80",
    instrument.play: "pianofit play cp80/instrument.json song.mid --out song.wav",
    instrument.page: "pianofit page library --prefix cp80",
    export.export: "pianofit export cp80/instrument.json --format sfz --out sampler",
    sounds.simulate: "pianofit simulate --preset bensa-final --set p=3.0 --velocity 2 --out string.wav",
    sounds.render: "pianofit render fitted/fit.json --velocity 3 --out harder.wav",
    listening.listen: "pianofit listen recorded fitted --out test",
    demo: "pianofit demo --out demo",
    reproduce: "pianofit reproduce --out paper",
}
for command, example in COMMANDS.items():
    add(app, command, example)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line `arguments`, those of this process if None; the exit code."""
    arguments = sys.argv[1:] if arguments is None else arguments
    if "_PIANOFIT_COMPLETE" in os.environ:
        os.environ["COLUMNS"] = str(UNBROKEN)
    try:
        return app(args=list(arguments) or ["--help"], prog_name="pianofit", standalone_mode=False) or 0
    except UsageError as error:
        command = getattr(getattr(error, "ctx", None), "command_path", "pianofit")
        print_error(f"{error.format_message()}; {command} --help says what there is".replace(".;", ";"))  # pyright: ignore[reportAttributeAccessIssue]
        return 2
    except OSError as error:
        if error.errno not in DISK_FULL or error.filename is not None:
            raise
        # Of a file it would be an error of ours: it is what was to be printed, and what is left of it goes nowhere.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        print_error(f"standard output cannot be written ({error.strerror}); send it elsewhere")
        return 1


def _fill_streams() -> None:
    """Put the null device in the place of standard streams that are closed, or a file of ours would be opened there."""
    for name in ("stdin", "stdout", "stderr"):
        if getattr(sys, name) is None:
            os.open(os.devnull, os.O_RDWR)  # the lowest number that is free, and so this stream's own


def run() -> NoReturn:
    """`main` as a process of its own, which ends it: at the end nothing is searched for garbage."""
    _fill_streams()
    if sys.stdout is None:
        print_error("standard output is closed; send it to a file, or to /dev/null")
        sys.exit(1)
    gc.set_threshold(COLLECTED, *gc.get_threshold()[1:])
    code = main()
    gc.freeze()
    sys.exit(code)
