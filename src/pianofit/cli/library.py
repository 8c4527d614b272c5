"""Command for recordings of a library: cut a long one at its strokes."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ..errors import ParameterError
from ..io.number_format import counted
from ..progress import progress_bar
from .options import Force, Json, text
from .terminal import print_result

# Columns of the list on screen.
HEADER = f"{'':>4}{'start, s':>10}{'length, s':>10}  {'note':5}{'cents':>7}{'dB':>7}  file, or why it is not written"


def cut(
    recording: Annotated[Path, typer.Argument(metavar="LONG.WAV", help="A recording of many single notes.")],
    out: Annotated[Path | None, text("DIR", "Folder for one FLAC a stroke, and strokes.csv.")] = None,
    pattern: Annotated[str, text("PATTERN", "Name of a file, with {note}, {layer} and {number}.")] = "{note}-L{layer}",
    dry_run: Annotated[bool, typer.Option("--dry-run", help="List the strokes and write nothing.")] = False,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Cut a long recording into one file a stroke, by onset, pitch and loudness. The recording is not changed."""
    from ..batch.cut_recording import cut_recording

    if dry_run == (out is not None):
        raise ParameterError("give either --out DIR, or --dry-run to list the strokes only")
    with progress_bar() as bar:
        listed = cut_recording(recording, out, pattern, force=force, progress=bar)
    lines = [HEADER]
    for stroke in listed:
        cents = "" if stroke.cents is None else f"{stroke.cents:+.0f}"
        times = f"{stroke.start_s:>10.3f}{stroke.end_s - stroke.start_s:>10.2f}"
        measured = f"{stroke.note:5}{cents:>7}{stroke.loudness_db:>7.1f}"
        lines.append(f"{stroke.number:>4}{times}  {measured}  {stroke.file or stroke.doubt}")
    sure = sum(bool(stroke.file) for stroke in listed)
    where = "nothing written" if out is None else f"written to {out}"
    lines.append(f"{counted(sure, 'stroke')}, {len(listed) - sure} unsure; {where}")
    print_result(listed, "\n".join(lines) + "\n", as_json)
