"""The command of the study: `python -m studies.bensa2005 --out DIR`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from pianofit.cli.options import Force, Seed
from pianofit.cli.terminal import add
from pianofit.io.files import output_folder
from pianofit.parameters import check_seed
from pianofit.progress import progress_bar

app = typer.Typer(
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    add_completion=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)


def reproduce(
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder for the page, index.html, and its files.")],
    seed: Seed = 0,
    force: Force = False,
    quick: Annotated[bool, typer.Option("--quick", hidden=True)] = False,
) -> None:
    """Test the tables, figures and claims of the paper on synthetic recordings, and write one page."""
    check_seed(seed)
    with output_folder(out, force) as folder, progress_bar() as progress:
        from .findings import FULL, QUICK
        from .page import reproduce as run

        claims = run(folder, seed, plan=QUICK if quick else FULL, progress=progress)
    for claim in claims:
        read = f" (string read: {claim.read.word})" if claim.read else ""
        typer.echo(f"{claim.verdict.word:17} {claim.text}{read}")
    typer.echo(f"\nwritten to {folder}: open index.html, and listening.html for the blind test")


add(app, reproduce, "python -m studies.bensa2005 --out reproduced")

if __name__ == "__main__":
    app()
