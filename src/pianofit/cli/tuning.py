"""Command for piano tuners."""

from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, cast

import typer

from ..conversions import A4
from ..io.files import output_folder, printable
from .options import Force, Json, Prefix, choice, real, text
from .terminal import print_result

if TYPE_CHECKING:
    from ..schema.tuning import OctaveType


def tuning(
    paths: Annotated[
        list[Path],
        typer.Argument(
            metavar="DIR|FIT.JSON...", help="The folder of a batch, single fits, or one instrument.json or its folder."
        ),
    ],
    out: Annotated[Path | None, text("DIR", "Folder for page, CSV, JSON and the file of Entropy Piano Tuner.")] = None,
    prefix: Prefix = None,
    a4: Annotated[float, real("HZ", "Frequency of partial 1 of A4 in Hz.", "--a4")] = A4,
    octave: Annotated[
        str,
        choice("TYPE", "Octave type of the target", ("2:1", "4:2", "6:3")),
    ] = "4:2",
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Show the tuning of a piano: pitch, inharmonicity, tuning curves and beats of all 88 keys."""
    from ..tuner.save import tuning_summary, write_tuning
    from ..tuner.tuning import tuning as measure

    options = {"prefix": prefix, "a4": a4, "octave": cast("OctaveType", octave)}
    with nullcontext() if out is None else output_folder(out, force) as folder:
        found = measure(paths, **options)
        if folder is not None:
            write_tuning(folder, found)
    written = "" if out is None else f"written to {printable(out)}\n"
    print_result(found, tuning_summary(found) + written, as_json)
