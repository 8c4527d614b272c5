"""The commands from recordings to parameters: analyse, fit, predict, crossval."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ..progress import progress_bar
from ..units import NORMAL
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
    Recipe,
    Recordings,
    Seed,
    Velocity,
    check_common,
)
from .terminal import add, tell

if TYPE_CHECKING:
    from ..analysis import Analysis
    from ..setup import Setup

__all__ = ["register"]


def register(app: typer.Typer) -> None:
    """Add the commands to `app`."""
    add(app, analyse, "pianofit analyse note.wav --note F#2")
    add(app, fit, "pianofit fit soft.wav mezzo.wav loud.wav --note F#2 --out fitted")
    add(app, predict, "pianofit predict fitted/fit.json other.wav --out predicted.wav")
    add(app, crossval, "pianofit crossval soft.wav mezzo.wav loud.wav --note F#2 --out left-out")


def analyse(
    file: File, note: Note = None, f0: Pitch = None, channel: Channel = "average", as_json: Json = False
) -> None:
    """Read pitch, inharmonicity, losses and partials off a recording, without a hammer."""
    from ..analysis import analyse as run
    from ..analysis import as_dict
    from ..recording import load_recording

    recording = load_recording(file, channel=channel)
    found = run(recording, note=note, f0=f0)
    found = replace(found, warnings=recording.warnings + found.warnings)
    tell(as_dict(found), _table(found), as_json)


def _table(found: Analysis) -> str:
    """The string's laws with 95 % intervals, then a line for every partial with standard errors."""
    from ..analysis import COLUMNS, rows
    from ..numbers import bracketed, columns, with_standard_error

    laws = (
        ("f0", found.f0, found.f0_error, "Hz", ""),
        ("B", found.B, found.B_error, "", ""),
        ("b1", found.b1, found.b1_error, "1/s", "decay rate of partial k: b1 + d2 k²"),
        ("d2", found.d2, found.d2_error, "1/s", ""),
    )
    cells = []
    for name, value, error, unit, note in laws:
        text, span = bracketed(value, (value - NORMAL * error, value + NORMAL * error))
        cells.append((name, text, unit, span, note))
    lines = [found.note] if found.note else []
    lines += [
        *columns(cells, right=1),
        f"partials scatter by {found.scatter_cents:.2f} cents",
        "",
        "In brackets 95 % intervals, after ± one standard error.",
        " ".join(f"{f'{column.name}, {column.unit}' if column.unit else column.name:>{column.width}}"
                 for column in COLUMNS),
    ]  # fmt: skip
    for row in rows(found):
        cells = []
        for at, column in enumerate(COLUMNS):
            if COLUMNS[at + 1 : at + 2] and COLUMNS[at + 1].error:
                cells += with_standard_error(row[at], row[at + 1])
            elif not column.error:
                cells.append(f"{row[at]:.{column.digits}f}")
        lines.append(" ".join(f"{cell:>{column.width}}" for cell, column in zip(cells, COLUMNS, strict=True)))
    return "\n".join([*lines, *found.warnings]) + "\n"


def fit(
    recordings: Recordings,
    out: Annotated[Path, typer.Option(metavar="DIR", help="The folder for fit.json, the sounds and the page.")],
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
    from ..fitting import fit as run
    from ..io import output_folder
    from ..model.cache import keep_programs
    from .summary import summary

    check_common(velocity, seed)
    with output_folder(out, force) as folder, progress_bar() as progress:
        known = _known(setup, felt)
        keep_programs()
        result = run(
            *recordings, setup=known, note=note, f0=f0, velocity=velocity, channel=channel, recipe=recipe,
            evaluations=evaluations, intervals=intervals, seed=seed, progress=progress,
        )  # fmt: skip
        progress("page", 0.95)
        result.save(folder, force=True, page=page)
    tell(result.document, summary(result.document, folder), as_json)


def _known(setup: Path | None, felt: str | None) -> Setup:
    """What was known beforehand, with the felt's law that the command names."""
    from ..setup import Setup, load_setup

    return Setup(felt=felt) if setup is None else load_setup(setup, felt)


def predict(
    fit: Annotated[Path, typer.Argument(metavar="FIT.JSON", help="What pianofit fit wrote, or its folder.")],
    recording: Annotated[Path, typer.Argument(metavar="RECORDING", help="A recording of the same key.")],
    out: Annotated[Path | None, typer.Option(metavar="FILE.WAV", help="The predicted sound, if wanted.")] = None,
    channel: Channel = "average",
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Predict a recording that took no part in the fit: only velocity, gain and pitch are free."""
    from ..workflow import predict_file

    found = predict_file(fit, recording, out, channel=channel, force=force)
    end = ", an end of the range searched: the velocity is not found" if found["v_H0_at_end"] else ""
    words = (
        f"{found['predicted_db']:.2f} dB over {found['partials']} partials, {found['cents']:+.2f} cents from the fit, "
        f"at {found['v_H0']:.3g} m/s{end}\n"
    )
    if found["was_fitted"]:
        words += "This recording took part in the fit: how near it comes is no prediction.\n"
    tell(found, words, as_json)


def crossval(
    recordings: Recordings,
    out: Annotated[
        Path | None, typer.Option(metavar="DIR", help="A folder for the fit of all recordings and its page, if wanted.")
    ] = None,
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
    from ..io import output_folder
    from ..workflow import cross_validate_files
    from .summary import cross_validation

    check_common(None, seed)
    with nullcontext() if out is None else output_folder(out, force) as folder, progress_bar() as progress:
        found = cross_validate_files(
            recordings, folder, _known(setup, felt), note=note, f0=f0, channel=channel, seed=seed, progress=progress
        )
    tell(found, cross_validation(found), as_json)
