"""Command for machine learning: labelled synthetic notes."""

from __future__ import annotations

import multiprocessing
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, cast

import typer

from ..errors import ParameterError
from ..io.files import cleanup_on_interrupt, printable
from ..io.number_format import counted
from ..threads import cores
from .options import RATE, Json, Seconds, Seed, choice, integer, real, text
from .terminal import print_result

if TYPE_CHECKING:
    from ..schema.dataset import SoundFormat

SEPARATOR = ".."


def dataset(
    out: Annotated[Path, text("DIR", "Folder of the data set. The same command again continues it.")],
    count: Annotated[int, integer("N", "Number of notes.")] = 1000,
    seed: Seed = 0,
    keys: Annotated[str | None, text("LOW..HIGH", "Keys, such as C2..C6. Default: all.")] = None,
    seconds: Seconds = 1.0,
    rate: Annotated[int, RATE] = 44_100,
    layers: Annotated[int, integer("N", "Velocities at which every note is rendered.")] = 1,
    around: Annotated[
        Path | None, text("FILE", "Draw around a fit.json or an instrument.json instead of the literature.")
    ] = None,
    spread: Annotated[float, real("X", "Factor of the priors' standard deviations, except of the velocity.")] = 1.0,
    path: Annotated[
        bool, typer.Option("--path", help="Filter every note by a random output path: soundboard, room and microphone.")
    ] = False,
    noise: Annotated[
        str | None, text("DB", "White noise, dB below the rms of the loudest layer, such as 60 or 40..70.")
    ] = None,
    modal_response: Annotated[
        bool, typer.Option("--modal-response", help="Render the measured modes of the fit or instrument of --around.")
    ] = False,
    form: Annotated[
        str, typer.Option("--format", parser=choice("flac", "wav", "npz"), metavar="FORMAT", help="flac, wav or npz.")
    ] = "flac",
    jobs: Annotated[int | None, integer("N", "Processes. Default: one a core.")] = None,
    as_json: Json = False,
) -> None:
    """Write labelled synthetic notes: sounds and one table of parameters."""
    from ..dataset import NoteOptions, write_dataset
    from ..model.program_cache import enable_program_cache

    enable_program_cache()
    options = NoteOptions(
        keys=None if keys is None else _pair(keys, "--keys", "C2..C6"),
        seconds=seconds,
        rate=rate,
        layers=layers,
        path=path,
        noise_db=None if noise is None else _noise(noise),
        modal_response=modal_response,
        around=None if around is None else str(around),
        spread=spread,
    )
    jobs = cores() if jobs is None else jobs
    with cleanup_on_interrupt(_end_workers):  # the same command continues
        made = write_dataset(out, count, seed=seed, options=options, format=cast("SoundFormat", form), jobs=jobs)
    there = f", {counted(made.notes - made.made, 'note')} were there before" if made.made < made.notes else ""
    words = (
        f"{printable(made.folder)}: {counted(made.notes, 'note')}, {counted(made.sounds, 'sound')}{there}; "
        f"{made.seconds:.1f} s\nnotes.csv has one row a sound, dataset.json its columns and units\n"
    )
    print_result(made, words, as_json)


def _end_workers() -> None:
    for worker in multiprocessing.active_children():
        worker.kill()
    for worker in multiprocessing.active_children():
        worker.join()


def _pair(given: str, option: str, example: str) -> tuple[str, str]:
    """Split a range at its two dots."""
    low, dots, high = given.partition(SEPARATOR)
    if not (dots and low and high):
        raise ParameterError(f"{option} {printable(given)}: write the lowest and the highest, such as {example}")
    return low.strip(), high.strip()


def _noise(given: str) -> float | tuple[float, float]:
    parts = _pair(given, "--noise", "40..70") if SEPARATOR in given else (given,)
    try:
        low, high = float(parts[0]), float(parts[-1])
    except ValueError:
        raise ParameterError(f"--noise {printable(given)}: write a level in dB, or a range such as 40..70") from None
    return (low, high) if len(parts) > 1 else low
