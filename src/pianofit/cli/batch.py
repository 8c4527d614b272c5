"""`pianofit batch` and `pianofit status`: a whole sample library, and how far it is.

Exit codes: 0 all keys are done, 1 the batch could not run or had to stop, 2 a command that cannot be understood, 3 some
keys failed and all others are done, 130 interrupted. What is finished stays, and the same command goes on.
"""

from __future__ import annotations

import contextlib
import shlex
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ..errors import PianofitError, SetupError, check_range
from ..io.files import printable
from ..io.number_format import columns, counted
from ..parameters import check_seed
from ..recording.recording import check_channel
from ..setup import load_setup, setup_from_dict
from ..threads import cores
from .options import Channel, Json, Seed, choice, number, whole
from .terminal import print_error, print_result

if TYPE_CHECKING:
    from ..batch import Job, Progress, Settings

__all__ = ["batch", "status"]

LISTED = 20  # failures spelt out where a person reads
NAMED = 4  # keys at work that a line names


@contextlib.contextmanager
def _resumable() -> Iterator[None]:
    """An interruption, and a request to end (SIGTERM) is one, tells how to go on."""
    before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        yield
    except KeyboardInterrupt:
        raise KeyboardInterrupt("what is finished is kept, and the same command goes on") from None
    finally:
        signal.signal(signal.SIGTERM, before)


def batch(
    manifest: Annotated[
        Path,
        typer.Argument(
            metavar="MANIFEST",
            help="A CSV with the columns file and note (and instrument, take or layer, velocity, v_H0, group, mic), an "
            "SFZ file, or a folder of recordings.",
        ),
    ],
    out: Annotated[
        Path,
        typer.Option(
            metavar="DIR",
            help="The folder of the batch: index.html, keys.csv, and keys/KEY/ for every key that is done.",
        ),
    ],
    pattern: Annotated[
        str | None,
        typer.Option(
            metavar="PATTERN",
            help="How the names of a folder's files are made: {note} and {instrument}, {layer}, {take}, {group}, "
            "{mic}, {velocity} (MIDI), {v_H0} (m/s), {*}; a part in [ ] may be missing. Guessed from the names if not "
            "given.",
        ),
    ] = None,
    root: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR",
            help="The folder that all recordings must lie in, links followed; if not given, the manifest's own.",
        ),
    ] = None,
    transpose: Annotated[
        int, typer.Option(parser=whole, metavar="N", help="Semitones added to every note name, such as 12 or -12.")
    ] = 0,
    setup: Annotated[
        Path | None,
        typer.Option(metavar="SETUP.TOML", help="What is known of all keys; without a list of recordings."),
    ] = None,
    channel: Channel = "average",
    seed: Seed = 0,
    page: Annotated[bool, typer.Option(help="Write a report.html for every key.")] = True,
    workers: Annotated[
        int | None, typer.Option(parser=whole, metavar="N", help="How many processes; one a core if not given.")
    ] = None,
    memory: Annotated[
        float, typer.Option(parser=number, metavar="GIB", help="Memory that each process may take (Linux).")
    ] = 4.0,
    time_limit: Annotated[
        float, typer.Option(parser=number, metavar="S", help="Seconds that a key may take in a process.")
    ] = 3600.0,
    scheduler: Annotated[
        str | None,
        typer.Option(metavar="ADDRESS", help="A dask.distributed scheduler, tcp://HOST:PORT, to work instead."),
    ] = None,
    files: Annotated[
        str,
        typer.Option(
            parser=choice("value", "shared"),
            metavar="value|shared",
            help="With --scheduler: send the recordings, or let the workers read them at the same paths.",
        ),
    ] = "value",
    retry: Annotated[
        str | None, typer.Option(parser=choice("failed"), metavar="failed", help="Try again what has failed before.")
    ] = None,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="List every file, what it is read as, and what would be done; do nothing.")
    ] = False,
    as_json: Json = False,
) -> None:
    """Fit every key of a sample library; run again, it goes on where it was."""
    with _resumable():
        _check(workers, memory, time_limit, seed, channel)
        from ..batch import check_cluster, mixtures, plan_jobs, read_keys, run_batch

        if scheduler is not None:
            check_cluster()
        keys, remarks = read_keys(manifest, pattern=pattern, root=root, transpose=transpose)
        units = _units(manifest, keys, _settings(setup, channel, seed, page))
        for remark in [*remarks, *mixtures(units)]:
            print_error(remark)
        if dry_run:
            _tell_planned(manifest, units, plan_jobs(units, out, retry == "failed"), as_json)
            return
        with _progress_printer() as progress:
            made = _workers(workers, memory, time_limit, scheduler, files == "value")
            found = run_batch(units, out, made, retry_failed=retry == "failed", tell=progress)
        print_result(found, _summary(found), as_json)
    if found["counts"]["failed"]:
        raise typer.Exit(3)


def status(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="The folder of a batch.")], as_json: Json = False
) -> None:
    """Say how far a batch is, and why keys failed; also while it is at work."""
    from ..batch import status as run

    found = run(folder)
    print_result(found, _summary(found), as_json)


def _check(workers: int | None, memory: float, time_limit: float, seed: int, channel: str) -> None:

    check_range("--workers ", 1 if workers is None else workers, 1, 1024)
    check_range("--memory ", memory, 1, 4096, " GiB", "; a fit takes about 1.5")
    check_range("--time-limit ", time_limit, 1, 1e6, " s")
    check_seed(seed)
    check_channel(channel)


def _settings(setup: Path | None, channel: str, seed: int, page: bool) -> Settings:
    """What all keys share, the setup's text among it, checked."""
    from ..batch import Settings

    text = ""
    if setup is not None:
        if load_setup(setup).recordings:
            raise SetupError(
                f"{printable(setup)}: has a [[recording]]; the manifest names the recordings, with their velocities"
            )
        text = setup.read_text(encoding="utf-8-sig").rstrip() + "\n"
    return Settings(seed, channel, page, text)


def _units(manifest: Path, keys: list, settings: Settings) -> list[Job]:
    """All keys with their recordings read and hashed; what is wrong with any is said before anything starts."""
    import tomllib

    from ..batch import make_unit
    from ..batch.manifest import listed

    units, problems = [], []
    for key in keys:
        try:
            unit = make_unit(key, settings)
            setup_from_dict(tomllib.loads(unit.setup), key.name)
            units.append(unit)
        except PianofitError as error:
            problems.append(str(error))
    if problems:
        raise SetupError(f"{printable(manifest)}: {listed(problems)}; nothing was started")
    return units


def _workers(workers: int | None, memory: float, time_limit: float, scheduler: str | None, by_value: bool) -> Callable:
    """What makes the workers, once the folder is held."""
    from ..batch import Cluster, Local

    if scheduler is not None:
        return lambda _: Cluster(scheduler, by_value)
    return lambda store: Local(workers or cores(), int(memory * 2**30), time_limit, store.scratch)


def _line(p: Progress) -> str:
    """How far a batch is, on one line."""
    failed = f", {p.failed} failed" if p.failed else ""
    running = f"; {_at_work(p.running)}" if p.running else ""
    return f"{p.done} of {counted(p.total, 'key')} done{failed}{_left(p.total - p.done - p.failed, p.left)}{running}"


def _left(keys: int, seconds: float | None) -> str:
    if not keys:
        return ""
    return f", {_format_duration(seconds)} left" if seconds is not None else ", time left known once a key is done"


def _at_work(running: Sequence[tuple[str, str]]) -> str:
    """Keys and their stages, such as "cp80-C4: hammer"."""
    named = [f"{key}: {stage}" if stage else key for key, stage in running[:NAMED]]
    return ", ".join(named) + (f" and {len(running) - NAMED} more" if len(running) > NAMED else "")


def _format_duration(seconds: float) -> str:
    if seconds < 90:
        return f"about {max(round(seconds, -1), 10):.0f} s"
    return f"about {seconds / 60:.0f} min" if seconds < 5400 else f"about {seconds / 3600:.1f} h"


@contextlib.contextmanager
def _progress_printer() -> Iterator[Callable[[Progress], None]]:
    """Progress on stderr: a line for every event, and in a terminal one below them that changes."""
    if not sys.stderr.isatty():
        yield _tell_event
        return
    from rich.console import Console

    console = Console(stderr=True, highlight=False)
    with console.status("starting") as line:

        def tell(p: Progress) -> None:
            if p.event:
                console.print(p.event, markup=False)
            line.update(_line(p))

        yield tell


def _tell_event(p: Progress) -> None:
    """One line of a log: how many keys have ended, what happened, and the time left."""
    if p.event:
        left = f" ({_format_duration(p.left)} left)" if p.left and p.done + p.failed < p.total else ""
        typer.echo(f"{p.done + p.failed} of {counted(p.total, 'key')}: {p.event}{left}", err=True)


def _tell_planned(manifest: Path, units: list[Job], standing: dict[str, str], as_json: bool) -> None:
    """Print what a run would do: every file with what it was read as, and every file that was not read."""
    from ..batch import listing, unread

    folder, missed = manifest if manifest.is_dir() else manifest.parent, unread(manifest, units)
    rows = [
        {"key": u.key, "note": u.note, "hash": u.hash, "standing": standing[u.key],
         "recordings": [s._asdict() for s in u.sources]}
        for u in units
    ]  # fmt: skip
    lines = []
    for unit in units:
        lines.append(f"{unit.key}: {unit.note}, {counted(len(unit.sources), 'recording')}, {standing[unit.key]}")
        lines += [f"  {line}" for line in columns(listing(unit, folder), right=-1)]
    lines += ["not read:"] * bool(missed)
    lines += [f"  {line}" for line in columns([[file.file, file.reason] for file in missed], right=-1)]
    todo = sum(s.startswith("to do") for s in standing.values())
    lines.append(f"{todo} of {counted(len(units), 'key')} to do; nothing was written")
    print_result({"keys": rows, "unread": [file._asdict() for file in missed]}, "\n".join(lines) + "\n", as_json)


def _summary(found: dict[str, Any]) -> str:
    """What became of the keys, in a screenful."""
    from ..batch.job_records import Entry

    count = {state: n for state, n in found["counts"].items() if n}
    left = _left(count.get("running", 0) + count.get("waiting", 0), found.get("seconds_left"))
    at_work = (
        "" if "at_work" not in found else f"; a batch is at work{left}" if found["at_work"] else "; no batch is at work"
    )
    lines = [
        ", ".join(f"{n} {state}" for state, n in count.items()) + f" of {counted(len(found['keys']), 'key')}{at_work}"
    ]
    if found["median_seconds"]:
        lines.append(f"median {found['median_seconds']:.1f} s a key, at most {found['largest_memory'] / 2**30:.2f} GiB "
                     "a process")  # fmt: skip
    if running := [(k["key"], k["stage"]) for k in found["keys"] if k["state"] == "running"]:
        lines.append(f"at work: {_at_work(running)}")
    bad = [k for k in found["keys"] if k["state"] == "failed"]
    lines += [f"failed: {key['key']}: {printable(Entry(**key).why)}" for key in bad[:LISTED]]
    if len(bad) > LISTED:
        lines.append(f"and {len(bad) - LISTED} more failed; --json lists all")
    for key in found["keys"]:
        lines += [f"left out: {key['key']}: {printable(x['reason'])}" for x in key["left_out"][:LISTED]]
    lines += found["suggestions"][:LISTED]
    if found.get("strangers"):
        lines.append(f"also in keys/, of an earlier run: {', '.join(found['strangers'][:LISTED])}")
    if count.get("done"):
        lines.append(f"{found['folder']}: index.html shows every key, keys.csv has the numbers, keys/KEY/ all of each")
        lines.append(f"to play them: pianofit page {printable(shlex.quote(found['folder']))}")
    return "\n".join(lines) + "\n"
