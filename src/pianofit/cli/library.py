"""Commands for recordings of a library: cut a long one at its strokes, mend those of a fitted library."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ..errors import ParameterError
from ..io.files import printable
from ..io.number_format import columns, counted
from ..progress import progress_bar
from .options import DryRun, Force, Json, Prefix, Root, Transpose, real, text
from .terminal import print_error, print_result

if TYPE_CHECKING:
    from ..mend import Change

# Files without a change that the summary names.
NAMED = 10
# Columns of the list on screen.
HEADER = f"{'':>4}{'start, s':>10}{'length, s':>10}  {'note':5}{'cents':>7}{'dB':>7}  file, or why it is not written"


def cut(
    recording: Annotated[Path, typer.Argument(metavar="RECORDING", help="A recording of many single notes.")],
    out: Annotated[Path | None, text("DIR", "Folder for one FLAC or WAV per stroke, and strokes.csv.")] = None,
    pattern: Annotated[str, text("PATTERN", "Name of a file, with {note}, {layer} and {number}.")] = "{note}-L{layer}",
    dry_run: DryRun = False,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Cut a long recording into one file per stroke, by onset, pitch and loudness. The recording is not changed."""
    from ..batch.cut_recording import cut_recording

    if dry_run == (out is not None):
        raise ParameterError("give either --out DIR, or --dry-run to list the strokes only")
    with progress_bar() as bar:
        listed = cut_recording(recording, out, pattern, force=force, progress=bar)
    lines = [HEADER]
    for stroke in listed:
        cents = "" if stroke.cents is None else f"{stroke.cents:+z.0f}"
        times = f"{stroke.start_s:>10.3f}{stroke.end_s - stroke.start_s:>10.2f}"
        measured = f"{stroke.note:5}{cents:>7}{stroke.loudness_db:>7.1f}"
        lines.append(f"{stroke.number:>4}{times}  {measured}  {stroke.file or stroke.doubt}")
    sure = sum(bool(stroke.file) for stroke in listed)
    where = "nothing written" if out is None else f"written to {printable(out)}"
    lines.append(f"{counted(sure, 'stroke')}, {len(listed) - sure} unsure; {where}")
    print_result(listed, "\n".join(lines) + "\n", as_json)


def mend(
    library: Annotated[
        Path, typer.Argument(metavar="LIBRARY", help="A CSV, an SFZ file or a folder, as for pianofit batch.")
    ],
    fits: Annotated[Path, text("DIR", "Folder that pianofit batch LIBRARY --out DIR wrote.")],
    out: Annotated[
        Path | None, text("DIR", "Folder for the mended recordings and changes.csv. Required without --dry-run.")
    ] = None,
    tails: Annotated[
        float,
        real("S", "Lengthen recordings to S seconds after the onset; 0 leaves them."),
    ] = 10.0,
    even_levels: Annotated[
        float,
        real("AMOUNT", "Move the levels, and nothing else, towards the keyboard law: 0 (as recorded) to 1 (wholly)."),
    ] = 0.0,
    onsets: Annotated[float, real("AMOUNT", "Remove surplus silence before onsets: 0 (none) to 1 (all).")] = 0.0,
    fill: Annotated[bool, typer.Option(help="Add layers and keys that were not recorded, in OUT/added.")] = True,
    keys: Annotated[
        str | None, text("KEYS", "Keys to fill, such as A0-C8.", default="from the lowest recorded to the highest")
    ] = None,
    pattern: Annotated[
        str | None, text("PATTERN", "Form of the file names, as for pianofit batch.", default="guessed from the names")
    ] = None,
    root: Root = None,
    transpose: Transpose = 0,
    prefix: Prefix = None,
    dry_run: DryRun = False,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Lengthen and level the recordings of a fitted library, and fill its gaps. Originals are never changed."""
    from ..analysis.note_names import parse_keys
    from ..mend import MendOptions, mend_library

    if dry_run == (out is not None):
        raise ParameterError("give either --out DIR, or --dry-run to list the changes only")
    options = MendOptions(tails, even_levels, onsets, fill, None if keys is None else tuple(parse_keys(keys)))
    with progress_bar() as bar:
        changes, remarks = mend_library(
            library,
            fits,
            out,
            options,
            pattern=pattern,
            root=root,
            transpose=transpose,
            prefix=prefix,
            force=force,
            progress=bar,
        )
    for remark in remarks:
        print_error(remark)
    lines = _every_change(changes) if dry_run else []
    print_result(changes, "\n".join([*lines, *_summary(changes, out)]) + "\n", as_json)


def _every_change(changes: list[Change]) -> list[str]:
    """Return one line per change."""
    rows = []
    for c in changes:
        numbers = ("" if x is None else f"{x:g}" for x in (c.before, c.after))
        rows.append([printable(c.file), c.change, *numbers, c.unit, printable(c.detail)])
    return columns(rows, right=-1)


def _summary(changes: list[Change], out: Path | None) -> list[str]:
    """Return the number of changes of each kind, and the first files without one."""
    count = {kind: [c for c in changes if c.change == kind] for kind in ("tail", "level", "onset", "added")}
    words = {"tail": "lengthened", "level": "with another level", "onset": "with an earlier onset", "added": "added"}
    parts = [f"{len(found)} {words[kind]}" for kind, found in count.items() if found]
    unchanged = [c for c in changes if c.change == "unchanged"]
    where = "nothing written" if out is None else f"written to {printable(out)}, with changes.csv"
    total = counted(len({c.file for c in changes}), "file")
    lines = [f"{total}: {', '.join([*parts, f'{len(unchanged)} unchanged'])}; {where}"]
    lines += [f"unchanged: {printable(c.file)}: {printable(c.detail)}" for c in unchanged[:NAMED]]
    return lines + [f"and {len(unchanged) - NAMED} more"] * (len(unchanged) > NAMED)
