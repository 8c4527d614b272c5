"""Commands for a sample library: `batch` fits all its keys, `status` shows the progress.

Exit codes: 0 all keys are done, 1 the batch could not run or had to stop, 2 invalid command line, 3 some keys failed
and all others are done, 130 interrupted. Finished keys are kept, and the same command continues the batch.
"""

from __future__ import annotations

import contextlib
import shlex
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ..errors import check_range
from ..io.files import printable
from ..io.number_format import columns, counted
from ..parameters import check_seed
from ..recording.measurements import checked_channel
from ..threads import MEMORY, TIME_LIMIT
from . import options
from .fits import setup_of_options
from .options import choice, flag, process_count, real, text
from .terminal import print_error, print_result

if TYPE_CHECKING:
    from ..batch import Job, Progress, Status

LISTED = 20  # failures in the printed summary
NAMED = 4  # running keys on a progress line


@contextlib.contextmanager
def _resumable() -> Iterator[None]:
    """Raise Ctrl-C and SIGTERM as an exception, because workers must end, and say how to continue."""
    before = {number: signal.signal(number, signal.default_int_handler) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    except KeyboardInterrupt:
        raise KeyboardInterrupt("finished keys are kept; run the same command to continue") from None
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def batch(
    library: Annotated[
        Path,
        typer.Argument(
            metavar="LIBRARY",
            help="A CSV with the columns file and note (and instrument, take or layer, velocity, v_H0, group, mic), an "
            "SFZ file, or a folder of recordings.",
        ),
    ],
    out: Annotated[
        Path, text("DIR", "Folder of the batch: index.html, keys.csv, and keys/KEY/ for every finished key.")
    ],
    pattern: Annotated[
        str | None,
        text(
            "PATTERN",
            "Form of the file names in a folder: {note} and {instrument}, {layer}, {take}, {group}, {mic}, "
            "{velocity} (MIDI), {v_H0} (m/s), {*}; a part in [ ] may be missing, [[ and ]] are brackets.",
            default="guessed from the names",
        ),
    ] = None,
    root: options.Root = None,
    transpose: options.Transpose = 0,
    setup: Annotated[Path | None, text("SETUP.TOML", "Setup for all keys, without [[recording]].")] = None,
    felt: options.Felt = None,
    excitation: options.Excitation = None,
    quantity: options.Quantity = None,
    channel: options.Channel = "average",
    seed: options.Seed = 0,
    page: Annotated[bool, typer.Option(help="Write a report.html for every key.")] = True,
    processes: options.Processes = None,
    memory: Annotated[float, real("GIB", "Memory limit of each process in GiB (Linux).")] = MEMORY,
    time_limit: Annotated[float, real("S", "Time limit for each key in seconds.")] = TIME_LIMIT,
    scheduler: Annotated[str | None, text("ADDRESS", "Use a dask.distributed scheduler, tcp://HOST:PORT.")] = None,
    files: Annotated[
        str,
        choice(
            "MODE",
            "With --scheduler: send the recordings, or let the workers read them from the same paths",
            ("value", "shared"),
        ),
    ] = "value",
    joint: Annotated[
        bool,
        flag(
            "--joint",
            "Fit every key twice: alone, then with the prior that the fits of all other keys of its instrument give. "
            "The first fits stay in DIR/alone.",
        ),
    ] = False,
    retry_failed: Annotated[bool, flag("--retry-failed", "Fit keys again that failed before.")] = False,
    dry_run: options.DryRun = False,
    as_json: options.Json = False,
) -> None:
    """Fit every key of a sample library. The same command continues an interrupted batch."""
    with _resumable():
        count = process_count(processes)
        check_range("memory=", memory, 1, 4096, " GiB", "; a fit takes about 1.5")
        check_range("time_limit=", time_limit, 1, 1e6, " s")
        check_seed(seed)
        checked_channel(channel)
        from ..batch import (
            check_cluster,
            layout_remarks,
            plan_jobs,
            plan_joint_jobs,
            read_keys,
            run_batch,
            run_joint_batch,
        )
        from ..library import library_jobs, library_settings

        if scheduler is not None:
            check_cluster()
        keys, remarks = read_keys(library, pattern=pattern, root=root, transpose=transpose)
        options = setup_of_options(setup, felt, excitation, quantity, None)
        settings = library_settings(options, printable(setup or ""), joint, seed, channel, page)
        jobs = library_jobs(library, keys, settings)
        for remark in [*remarks, *layout_remarks(jobs)]:
            print_error(remark)
        if dry_run:
            plan = plan_joint_jobs if joint else plan_jobs
            _print_plan(library, jobs, plan(jobs, out, retry_failed), as_json)
            return
        with _progress_printer() as progress:
            make_workers = _workers(count, memory, time_limit, scheduler, files == "value")
            run = run_joint_batch if joint else run_batch
            result = run(jobs, out, make_workers, retry_failed=retry_failed, tell=progress)
        print_result(result, _summary(result), as_json)
    if result.counts["failed"]:
        raise typer.Exit(3)


def status(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Folder of a batch.")], as_json: options.Json = False
) -> None:
    """Show the progress of a batch and why keys failed, also while it is running."""
    from ..batch import status as run

    result = run(folder)
    print_result(result, _summary(result), as_json)


def _workers(processes: int, memory: float, time_limit: float, scheduler: str | None, by_value: bool) -> Callable:
    """Return the function that starts the workers. The batch calls it after locking the folder."""
    from ..batch import DaskPool, ProcessPool

    if scheduler is not None:
        return lambda _: DaskPool(scheduler, by_value)
    return lambda store: ProcessPool(processes, int(memory * 2**30), time_limit, store.scratch)


def _line(p: Progress) -> str:
    """Progress of a batch on one line."""
    failed = f", {p.failed} failed" if p.failed else ""
    running = f"; {_running_keys(p.running)}" if p.running else ""
    left = _format_time_left(p.total - p.done - p.failed, p.seconds_left)
    return f"{_part(p)}{p.done} of {counted(p.total, 'key')} done{failed}{left}{running}"


def _part(p: Progress) -> str:
    return f"{p.part}: " if p.part else ""


def _format_time_left(keys: int, seconds: float | None) -> str:
    if not keys:
        return ""
    return f", {_format_duration(seconds)} left" if seconds is not None else ", time left known once a key is done"


def _running_keys(running: Sequence[tuple[str, str]]) -> str:
    """Keys and their stages, such as "cp80-C4: hammer"."""
    named = [f"{key}: {stage}" if stage else key for key, stage in running[:NAMED]]
    return ", ".join(named) + (f" and {len(running) - NAMED} more" if len(running) > NAMED else "")


def _format_duration(seconds: float) -> str:
    if seconds < 90:
        return f"about {max(round(seconds, -1), 10):.0f} s"
    return f"about {seconds / 60:.0f} min" if seconds < 5400 else f"about {seconds / 3600:.1f} h"


@contextlib.contextmanager
def _progress_printer() -> Iterator[Callable[[Progress], None]]:
    """Print progress on stderr: a line for every event, and in a terminal a changing line below them."""
    if not sys.stderr.isatty():
        yield _print_event
        return
    from rich.console import Console

    console = Console(stderr=True, highlight=False)
    with console.status("starting") as line:

        def print_progress(p: Progress) -> None:
            if p.event:
                console.print(_part(p) + p.event, markup=False)
            line.update(_line(p))

        yield print_progress


def _print_event(p: Progress) -> None:
    """Print a log line: number of finished keys, event and time left."""
    if p.event:
        left = f" ({_format_duration(p.seconds_left)} left)" if p.seconds_left and p.done + p.failed < p.total else ""
        typer.echo(f"{_part(p)}{p.done + p.failed} of {counted(p.total, 'key')}: {p.event}{left}", err=True)


def _print_plan(manifest: Path, jobs: list[Job], standing: dict[str, str], as_json: bool) -> None:
    """Print the keys with their files, and the files that would not be read."""
    from ..batch import unused_files

    folder, missed = manifest if manifest.is_dir() else manifest.parent, unused_files(manifest, jobs)
    lines, rows = [], []
    for job in jobs:
        rows.append({"key": job.key, "note": job.note, "hash": job.hash, "standing": standing[job.key]})
        rows[-1]["recordings"] = job.sources
        lines.append(f"{job.key}: {job.note}, {counted(len(job.sources), 'recording')}, {standing[job.key]}")
        lines += [f"  {line}" for line in columns([source.row(folder) for source in job.sources], right=-1)]
    lines += ["not read:"] * bool(missed)
    lines += [f"  {line}" for line in columns([[file.file, file.reason] for file in missed], right=-1)]
    todo = sum(s.startswith("to do") for s in standing.values())
    lines.append(f"{todo} of {counted(len(jobs), 'key')} to do; nothing was written")
    print_result({"keys": rows, "unread": missed}, "\n".join(lines) + "\n", as_json)


def _summary(result: Status) -> str:
    """Summary of all keys for a terminal."""
    count = {state: n for state, n in result.counts.items() if n}
    at_work = ""
    if result.at_work is not None:
        left = _format_time_left(count.get("running", 0) + count.get("waiting", 0), result.seconds_left)
        at_work = f"; a batch is at work{left}" if result.at_work else "; no batch is at work"
    states = ", ".join(f"{n} {state}" for state, n in count.items())
    lines = [f"{states} of {counted(len(result.keys), 'key')}{at_work}"]
    if result.median_seconds:
        memory = f"at most {result.largest_memory / 2**30:.2f} GiB per process"
        lines.append(f"median {result.median_seconds:.1f} s per key, {memory}")
    if running := [(entry.key, entry.stage) for entry in result.keys if entry.state == "running"]:
        lines.append(f"at work: {_running_keys(running)}")
    failed = [entry for entry in result.keys if entry.state == "failed"]
    lines += [f"failed: {entry.key}: {printable(entry.failure_text)}" for entry in failed[:LISTED]]
    if len(failed) > LISTED:
        lines.append(f"and {len(failed) - LISTED} more failed; --json lists all")
    for entry in result.keys:
        lines += [f"left out: {entry.key}: {printable(unused.reason)}" for unused in entry.left_out[:LISTED]]
    lines += result.suggestions[:LISTED]
    if result.strangers:
        lines.append(f"also in keys/, from an earlier run: {', '.join(result.strangers[:LISTED])}")
    if count.get("done"):
        lines.append(f"{result.folder}: index.html shows all keys, keys.csv has the numbers, keys/KEY/ has the fit")
        lines.append(f"play them with: pianofit page {printable(shlex.quote(result.folder))}")
    return "\n".join(lines) + "\n"
