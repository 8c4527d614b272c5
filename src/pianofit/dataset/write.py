"""A data set as files: blocks of sounds, one table of parameters, and a record of seed and options.

    dataset.json          seed, options, version, and the columns of the table with their units
    notes.csv             one row a sound
    blocks/00000/         sounds of the first notes, and their rows; a block is there completely or not at all

A block is written to a folder with another name, which is then renamed. So an interrupted run goes on with the blocks
that are missing, and the result does not depend on interruptions or on the number of processes.
"""

import contextlib
import csv
import io
import os
import shutil
import time
from collections.abc import Iterator
from dataclasses import dataclass
from numbers import Integral
from pathlib import Path
from typing import Any, get_args

import numpy as np

from .. import __version__
from ..batch.fit_job import JobResult
from ..batch.process_pool import ProcessPool
from ..errors import FitError, OutputError, ParameterError, PianofitError, check_range, check_type
from ..io.files import encode_pcm, encode_wav, locked, path_name, printable, replace_file, write_error
from ..parameters import check_seed
from ..program_folder import enable_program_cache
from ..progress import Progress, progress_bar
from ..schema.dataset import DATASET_FILE, Column, DatasetFile, NoteOptions, SoundFormat, read_dataset_file
from ..schema.decode import encode_json
from ..threads import MAX_PROCESSES, MEMORY, TIME_LIMIT
from .labelled_note import LabelledNote, blocks, check_count, make_block
from .random_notes import PATH_FREQUENCIES, NotePrior
from .source import load_source
from .table import columns_of

TABLE, BLOCKS, ROWS, LOCK = "notes.csv", "blocks", "rows.csv", ".lock"
POLL = 0.5  # s between two reports of progress


@dataclass(frozen=True)
class DatasetSummary:
    """Result of `write_dataset`.

    Parameters
    ----------
    folder : folder of the data set.
    notes, sounds : number of notes, and of sounds, in the data set.
    made : number of notes that this run made. The others were there before.
    seconds : duration of this run, s.
    """

    folder: str
    notes: int
    sounds: int
    made: int
    seconds: float


@dataclass(frozen=True)
class _Block:
    """One block to make; a job of a process pool."""

    key: str
    numbers: range
    record: DatasetFile


def write_dataset(
    folder: str | os.PathLike[str],
    count: int,
    *,
    seed: int = 0,
    options: NoteOptions | None = None,
    format: SoundFormat = "flac",  # noqa: A002
    processes: int = 1,
    progress: Progress | bool | None = None,
) -> DatasetSummary:
    """Write labelled synthetic notes as sound files and one table of parameters.

    The same call again continues an interrupted run. A larger `count` extends a data set. The notes are those of
    `notes` with the same arguments, for any number of processes.

    Parameters
    ----------
    folder : folder of the data set; new, empty, or of the same data set.
    count : number of notes. Each has one sound for every layer of the options.
    seed : seed of all random numbers.
    options : see `NoteOptions`.
    format : "flac" (24 bit), "wav" (32 bit floats) or "npz" (float32, one archive a block).
    processes : number of processes. With more than one, call this function from the main module of a program.
    progress : called with a stage's name and the fraction done; False for none. If None, a bar in a terminal.

    Returns
    -------
    A `DatasetSummary`.

    Raises
    ------
    ParameterError
        For an argument or an option out of range, before anything is written.
    FitError
        If the file to draw around is not valid, or if no draw of a note has a contact that ends.
    OutputError
        If the folder holds something else or a data set of other options, is in use, or cannot be written.

    Examples
    --------
    >>> import pianofit
    >>> options = pianofit.NoteOptions(keys=("C4", "C5"), seconds=0.2)
    >>> pianofit.write_dataset("notes", 3, seed=1, options=options, progress=False).sounds
    3
    """
    began, options = time.monotonic(), options or NoteOptions()
    check_count(count)
    check_seed(seed)
    check_type("processes=", processes, Integral, "a whole number of processes")
    check_range("processes=", processes, 1, MAX_PROCESSES)
    if format not in (formats := get_args(SoundFormat)):
        raise ParameterError(f"format={format!r} must be one of {', '.join(formats)}")
    path_name(folder)
    path, source = Path(folder), load_source(options)
    record = DatasetFile(
        pianofit=__version__,
        seed=seed,
        count=count,
        format=format,
        options=options,
        around_sha256=source.sha256,
        path_frequencies_hz=tuple(PATH_FREQUENCIES.tolist()),
        columns=(Column("file", "", "sound, relative to the folder"), *columns_of(options, [*source.notes.values()])),
    )
    with progress_bar(progress) as report, _locked(path, record):
        replace_file(path / DATASET_FILE, encode_json(record))
        missing = [block for block in _blocks(record) if not _is_complete(path, block)]
        made = 0
        report("notes", 0.0)
        for block, files in _made(missing, processes, path):
            _commit(path, block.key, files)
            made += len(block.numbers)
            report("notes", 1 - (sum(len(b.numbers) for b in missing) - made) / count)
        _write_table(path, record)
    return DatasetSummary(str(path), count, count * options.layers, made, round(time.monotonic() - began, 3))


def _blocks(record: DatasetFile) -> list[_Block]:
    return [_Block(f"{i:05}", numbers, record) for i, numbers in enumerate(blocks(record.count, record.options))]


# --- folder -----------------------------------------------------------------------------------------------------------


def _check_folder(path: Path, record: DatasetFile) -> None:
    """Create the folder. Raise an `OutputError` if it holds anything but the same data set, of at most these notes."""
    name = printable(path)
    try:
        path.mkdir(parents=True, exist_ok=True)
        content = [file.name for file in path.iterdir() if file.name != LOCK]
    except OSError as error:
        raise write_error(path, error, "choose another --out") from None
    if not content:
        return
    if DATASET_FILE not in content:
        raise OutputError(f"{name}: the folder is not empty and holds no data set; give another --out")
    other = read_dataset_file(path / DATASET_FILE)
    if other.count > record.count:
        raise OutputError(f"{name}: holds {other.count} notes; ask for as many or more, or give another --out")
    ours, theirs = (_differences(one) for one in (record, other))
    if changed := [key for key in ours if ours[key] != theirs[key]]:
        key = changed[0]
        raise OutputError(
            f"{name}: holds a data set with {key}={theirs[key]!r}, not {ours[key]!r}; give another --out, or the same "
            "options"
        )


def _differences(record: DatasetFile) -> dict[str, Any]:
    """Return everything that decides the notes of a data set, except their number."""
    whole = {"pianofit": record.pianofit, "seed": record.seed, "format": record.format}
    options = {key: list(x) if isinstance(x, tuple) else x for key, x in vars(record.options).items()}
    return whole | options | {"around_sha256": record.around_sha256}


@contextlib.contextmanager
def _locked(path: Path, record: DatasetFile) -> Iterator[None]:
    """Check and lock the folder for one run, and remove unfinished blocks of an interrupted one."""
    _check_folder(path, record)
    try:
        (path / BLOCKS).mkdir(exist_ok=True)
        with locked(path / LOCK, f"{printable(path)}: another run writes this data set; wait for it"):
            for unfinished in (path / BLOCKS).glob(".*"):
                if unfinished.is_dir():  # file managers write hidden files
                    shutil.rmtree(unfinished)
            yield
    except OSError as error:
        raise write_error(path, error, "choose another --out") from None


def _is_complete(path: Path, block: _Block) -> bool:
    """Return whether a block is there with all its sounds: the last block of a smaller data set has fewer."""
    try:
        with (path / BLOCKS / block.key / ROWS).open(encoding="utf-8", newline="") as table:
            files = [row.get("file") or "" for row in csv.DictReader(table)]
    except OSError:
        return False
    expected = block.record.options.layers * len(block.numbers)
    return len(files) == expected and all((path / file).is_file() for file in {*files})


def _commit(path: Path, key: str, files: dict[str, bytes]) -> None:
    """Write the files of a block as one folder, in one step."""
    target, new, old = (path / BLOCKS / name for name in (key, f".{key}", f".{key}.old"))
    try:
        new.mkdir()
        for name, content in files.items():
            (new / name).write_bytes(content)
        if target.exists():
            target.rename(old)
        new.rename(target)
    finally:
        for unfinished in (new, old):
            shutil.rmtree(unfinished, ignore_errors=True)


def _write_table(path: Path, record: DatasetFile) -> None:
    """Join the rows of all blocks."""
    parts = [(path / BLOCKS / block.key / ROWS).read_bytes().split(b"\n", 1) for block in _blocks(record)]
    replace_file(path / TABLE, b"".join([parts[0][0], b"\n", *(rows for _, rows in parts)]))


# --- blocks -----------------------------------------------------------------------------------------------------------


def _made(missing: list[_Block], processes: int, path: Path) -> Iterator[tuple[_Block, dict[str, bytes]]]:
    """Yield every block with its files, as they are made: in this process, or in several."""
    if processes == 1:
        for block in missing:
            yield block, _files(block)
        return
    queue = missing[::-1]
    count, memory = min(processes, len(missing) or 1), int(MEMORY * 2**30)
    with ProcessPool(count, memory, TIME_LIMIT, path / BLOCKS / ".scratch", _work) as pool:
        while queue or pool.pending:
            while queue and pool.pending < pool.capacity:
                pool.submit(queue.pop())
            for block, result in pool.finished(POLL):
                if result.error:
                    raise FitError(f"block {block.key}: {result.error}")
                yield block, result.files


def _work(block: _Block, *_: object) -> JobResult:
    """Make a block in a worker. Errors are returned, not raised."""
    enable_program_cache()
    try:
        return JobResult(_files(block))
    except PianofitError as error:
        return JobResult({}, str(error))
    except Exception as error:
        return JobResult({}, f"{type(error).__name__}: {printable(error)}")


def _files(block: _Block) -> dict[str, bytes]:
    """Return the content of all files of a block by name."""
    record = block.record
    prior = NotePrior(record.options, load_source(record.options), record.seed)
    made = make_block(prior, block.numbers)
    names = [_name(one, record) for one in made]
    if record.format == "npz":
        files = {names[0]: _archive(made)}
    elif record.format == "wav":
        files = {name: encode_wav(one.samples, one.rate) for name, one in zip(names, made, strict=True)}
    else:
        files = {name: encode_pcm(one.samples[None], one.rate, "flac") for name, one in zip(names, made, strict=True)}
    text = io.StringIO()
    table = csv.DictWriter(text, [column.name for column in record.columns], lineterminator="\n")
    table.writeheader()
    folder = f"{BLOCKS}/{block.key}"
    table.writerows({"file": f"{folder}/{name}", **one.labels} for name, one in zip(names, made, strict=True))
    return files | {ROWS: text.getvalue().encode()}


def _name(one: LabelledNote, record: DatasetFile) -> str:
    """Return the name of the file of a sound."""
    if record.format == "npz":
        return "notes.npz"
    layer = f"-L{one.layer}" if record.options.layers > 1 else ""
    return f"{one.number:07}{layer}.{record.format}"


def _archive(made: list[LabelledNote]) -> bytes:
    """Return the sounds of a block as one archive: `samples` [sounds, samples], `number`, `layer` [sounds], `rate`."""
    stream = io.BytesIO()
    arrays = {
        "samples": np.array([one.samples for one in made], np.float32),
        "number": np.array([one.number for one in made]),
        "layer": np.array([one.layer for one in made]),
        "rate": np.array(made[0].rate),
    }
    np.savez(stream, **arrays)
    return stream.getvalue()
