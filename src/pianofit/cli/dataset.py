"""Command for machine learning: labelled synthetic notes."""

from __future__ import annotations

import multiprocessing
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, cast

from ..errors import ParameterError
from ..io.files import printable
from ..io.interrupts import cleanup_on_interrupt
from ..io.number_format import counted
from . import options
from .options import choice, flag, integer, one_or_range, parse_as, process_count, real, text
from .terminal import print_result

if TYPE_CHECKING:
    from ..schema.dataset import SoundFormat


def dataset(
    out: Annotated[Path, text("DIR", "Folder of the data set. The same command again continues it.")],
    count: Annotated[int, integer("N", "Number of notes.")] = 1000,
    seed: options.Seed = 0,
    keys: Annotated[str | None, text("LOW-HIGH", "Range of keys, such as C2-C6.", default="all")] = None,
    seconds: options.Seconds = 1.0,
    rate: Annotated[int, options.RATE] = 44_100,
    layers: Annotated[int, integer("N", "Velocities at which every note is rendered.")] = 1,
    around: Annotated[
        Path | None,
        text("FIT.JSON|INSTRUMENT.JSON", "Draw around a fit or an instrument.", default="around the literature"),
    ] = None,
    spread: Annotated[float, real("FACTOR", "Widen all priors but that of the velocity by this factor.")] = 1.0,
    path: Annotated[
        bool, flag("--path", "Filter every note by a random output path: soundboard, room and microphone.")
    ] = False,
    noise_db: Annotated[
        Any,
        text(
            "DB|LOW-HIGH",
            "White noise, dB below the rms of the loudest layer, such as 60, or random in a range such as 40-70.",
            "--noise",
            default="none",
            parser=parse_as(one_or_range, "a number of dB, such as 60, or a range, such as 40-70"),
        ),
    ] = None,
    modal_response: Annotated[
        bool, flag("--modal-response", "Render the measured modes of the fit or instrument of --around.")
    ] = False,
    format: Annotated[  # noqa: A002
        str, choice("FORMAT", "Format of the sounds", ("flac", "wav", "npz"), "--sample-format")
    ] = "flac",
    processes: options.Processes = None,
    as_json: options.Json = False,
) -> None:
    """Write labelled synthetic notes: sounds and one table of parameters."""
    from ..dataset import NoteOptions, write_dataset

    note = NoteOptions(
        keys=None if keys is None else _ends(keys),
        seconds=seconds,
        rate=rate,
        layers=layers,
        path=path,
        noise_db=noise_db,
        modal_response=modal_response,
        around=None if around is None else str(around),
        spread=spread,
    )
    workers = process_count(processes)
    with cleanup_on_interrupt(_end_workers):  # the same command continues
        kind = cast("SoundFormat", format)
        made = write_dataset(out, count, seed=seed, options=note, format=kind, processes=workers)
    there = f", {counted(made.notes - made.made, 'note')} were there before" if made.made < made.notes else ""
    words = (
        f"{printable(made.folder)}: {counted(made.notes, 'note')}, {counted(made.sounds, 'sound')}{there}; "
        f"{made.seconds:.1f} s\nnotes.csv has one row per sound, dataset.json its columns and units\n"
    )
    print_result(made, words, as_json)


def _end_workers() -> None:
    for worker in multiprocessing.active_children():
        worker.kill()
    for worker in multiprocessing.active_children():
        worker.join()


def _ends(keys: str) -> tuple[str, str]:
    """Return the lowest and the highest key of a range."""
    from ..analysis.note_names import midi_to_note, parse_keys

    high = keys.partition("-")[2]
    if not high or "," in keys:
        raise ParameterError(f"keys={keys!r} must be one range, such as C2-C6")
    chosen = parse_keys(keys)
    return midi_to_note(chosen[0]), midi_to_note(chosen[-1])
