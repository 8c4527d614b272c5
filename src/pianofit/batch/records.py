"""The folder of a batch: `keys/KEY/` for every finished key, `ledger/` for all others, and the state of the whole.

The folder of a key is written elsewhere, flushed to the disk, and renamed. It is therefore complete or missing. Its
`record.json` has the hash of its job and the digest of every file. A folder thus proves that it is finished, and no
result is lost with the ledger. `ledger/KEY.json` records every other key: requested, running, or failed with a reason.
It is written atomically and removed when the key is done. A record that cannot be read counts as missing.
"""

from __future__ import annotations

import contextlib
import errno
import hashlib
import os
import shutil
import sqlite3
import statistics
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import msgspec

from ..analysis.note_names import note_to_midi
from ..errors import OutputError
from ..io.files import locked, printable, replace_file, write_error
from ..io.number_format import counted
from ..schema.decode import encode_json
from .job import Job, Settings, Source, UnusedFile

RECORD = "record.json"


@dataclass(frozen=True)
class Entry:
    """State of one key: its job, and what became of it."""

    key: str
    note: str
    hash: str
    state: str  # waiting, running, done or failed
    recordings: tuple[Source, ...] = ()
    settings: Settings = field(default_factory=Settings)
    versions: dict[str, str] = field(default_factory=dict)
    parts: dict[str, str] = field(default_factory=dict)  # hashes of the parts of the job
    attempts: int = 0
    reason: str = ""  # of a failure
    detected_note: str = ""
    detail: str = ""
    left_out: tuple[UnusedFile, ...] = ()
    seconds: float = 0.0  # of the fit
    memory: int = 0  # bytes
    stage: str = ""  # of the fit, while it is running
    started: float = 0.0  # start time, s since 1970, while it is running
    finished: float = 0.0  # s since 1970, if it is done
    files: dict[str, str] = field(default_factory=dict)  # SHA-256 of each result file, if it is done

    @classmethod
    def waiting(cls, job: Job) -> Entry:
        """A job that is to do."""
        return cls(job.key, job.note, job.hash, "waiting", job.sources, job.settings, job.versions, job.parts)

    def stopped(self) -> Entry:
        """The same key; a running one is waiting again."""
        return replace(self, state="waiting", stage="", started=0.0) if self.state == "running" else self

    @property
    def failure_text(self) -> str:
        """Reason of a failure, with the detected note."""
        complete = not self.detected_note or self.detected_note in self.reason
        return self.reason if complete else f"{self.reason}; it sounds like {self.detected_note}"


class Store:
    """Folders of the keys, and the ledger, in `folder`."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.keys, self.ledger = folder, folder / "keys", folder / "ledger"
        # The last two, of the workers and of this process, exist only during a run.
        self._lock, self.scratch, self._unfinished = (self.ledger / name for name in ("lock", "scratch", "unfinished"))

    def open(self) -> None:
        """Create the folder if it does not exist.

        Raises `OutputError` if it cannot be created or written to, or holds something other than a batch.
        """
        name = printable(self.folder)
        if self.folder.exists() and not self.folder.is_dir():
            raise OutputError(f"{name}: is a file; give a folder as --out")
        with self._writing():
            if self.folder.is_dir() and any(self.folder.iterdir()) and not self._holds_batch():
                raise OutputError(f"{name}: the folder is not empty and holds no batch; give another --out")
            for place in (self.keys, self.ledger):
                place.mkdir(parents=True, exist_ok=True)
                if not os.access(place, os.W_OK | os.X_OK):
                    raise PermissionError(errno.EACCES, "read-only, or owned by another user")

    def _holds_batch(self) -> bool:
        return self.keys.is_dir() or self.ledger.is_dir()

    @contextlib.contextmanager
    def locked(self) -> Iterator[None]:
        """Lock the folder for one batch, and remove unfinished files of an interrupted run.

        Raises `OutputError` if another batch holds the lock.
        """
        self.ledger.mkdir(exist_ok=True)
        other = f"{printable(self.folder)}: another batch is running in this folder"
        with locked(self._lock, f"{other}; wait for it, or give another --out"):
            for partial in (self.scratch, self._unfinished):
                shutil.rmtree(partial, ignore_errors=True)
            for file in self.ledger.glob(".*.tmp"):
                file.unlink(missing_ok=True)
            yield

    def is_locked(self) -> bool:
        """True if a batch is running in the folder."""
        lock = f"{self._lock.resolve().as_uri()}?mode=ro"
        try:
            with contextlib.closing(sqlite3.connect(lock, uri=True, timeout=0.0)) as connection:
                connection.execute("SELECT count(*) FROM sqlite_master").fetchone()
        except sqlite3.DatabaseError as error:
            return "locked" in str(error)
        return False

    def commit(self, entry: Entry, files: dict[str, bytes]) -> Entry:
        """Write `files` and their record as the folder of a key, in one step, and return the record.

        Raises `OutputError` if they cannot be written. Partial files are removed.
        """
        digests = {name: _digest(content) for name, content in files.items()}
        record = replace(entry, state="done", files=digests, finished=round(time.time(), 3))
        new, old, folder = self._unfinished / "new", self._unfinished / "old", self.keys / entry.key
        try:
            with self._writing():
                new.mkdir(parents=True)
                for name, content in {**files, RECORD: encode_json(record)}.items():
                    with (new / name).open("xb") as file:
                        file.write(content)
                        file.flush()
                        os.fsync(file.fileno())
                _flush(new)
                with contextlib.suppress(FileNotFoundError):
                    folder.rename(old)
                new.rename(folder)
                _flush(self.keys)
            return record
        finally:
            shutil.rmtree(self._unfinished, ignore_errors=True)

    def record(self, key: str) -> Entry | None:
        """Record in the folder of a key, without a check of the files. None if it is missing or damaged."""
        entry = _read(self.keys / key / RECORD)
        return entry and replace(entry, key=key, state="done")  # a folder may be renamed

    def verified_content(self, record: Entry, name: str) -> bytes | None:
        """Content of a file of a finished key. None if it is missing or its digest differs from the record."""
        with contextlib.suppress(OSError):
            content = (self.keys / record.key / Path(name).name).read_bytes()
            return content if _digest(content) == record.files.get(name) else None
        return None

    def is_intact(self, record: Entry) -> bool:
        """True if all files of a finished key agree with its record."""
        return all(self.verified_content(record, name) is not None for name in record.files)

    def finished(self) -> set[str]:
        """Names of the keys that have a folder with a record."""
        return {file.parent.name for file in self.keys.glob(f"*/{RECORD}")}

    def entry(self, key: str) -> Entry | None:
        """State of a key. A key with a record is done, unless the ledger has a request with another hash."""
        record, entry = self.record(key), _read(self.ledger / f"{key}.json")
        if entry is None or entry.key != key or entry.state not in ("waiting", "running", "failed"):
            return record
        return record if record is not None and record.hash == entry.hash else entry

    def entries(self) -> list[Entry]:
        """States of all keys that were ever requested in this folder, in the order of their names.

        Raises `OutputError` if the folder does not hold a batch.
        """
        if not self._holds_batch():
            raise OutputError(f"{printable(self.folder)}: holds no batch; check the path")
        names = self.finished() | {file.stem for file in self.ledger.glob("*.json")}
        return [entry for key in sorted(names) if (entry := self.entry(key)) is not None]

    def forget(self, key: str) -> None:
        """Remove the ledger entry of a key that is not in the library any more."""
        (self.ledger / f"{key}.json").unlink(missing_ok=True)

    def write(self, entry: Entry) -> None:
        """Replace the ledger entry of a key, or remove it if the key is done.

        Raises `OutputError` if the disk is full or the folder cannot be written to.
        """
        file = self.ledger / f"{entry.key}.json"
        with self._writing():
            if entry.state == "done":
                file.unlink(missing_ok=True)
            else:
                replace_file(file, encode_json(entry))

    @contextlib.contextmanager
    def _writing(self) -> Iterator[None]:
        """Raise an `OutputError` that names the folder if it cannot be written to."""
        try:
            yield
        except OSError as error:
            raise write_error(self.folder, error, "choose another folder, then run the command again") from error


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


def _read(file: Path) -> Entry | None:
    """The entry in a file; None if it is missing or damaged."""
    try:
        return msgspec.json.decode(file.read_bytes(), type=Entry)
    except (OSError, ValueError, RecursionError):
        return None


def _flush(folder: Path) -> None:
    """Flush the entries of a folder to the disk, if the system supports that."""
    with contextlib.suppress(PermissionError):  # Windows cannot open folders
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        except OSError as error:
            if error.errno != errno.EINVAL:  # a file system without fsync of folders
                raise
        finally:
            os.close(handle)


@dataclass(frozen=True)
class Status:
    """State of a batch."""

    folder: str
    counts: dict[str, int]  # number of keys by state
    median_seconds: float | None  # of a fit; None before the first key is done
    largest_memory: int  # of a process, bytes
    suggestions: list[str]  # corrections of note names
    keys: list[Entry]
    at_work: bool | None = None  # whether a batch is running there; None at the end of a run
    seconds_left: float | None = None
    strangers: Sequence[str] = ()  # finished keys in the folder that a run did not ask for


def status(folder: Path) -> Status:
    """State of the batch in `folder`, also while it is running.

    Raises `OutputError` if the folder does not hold a batch.
    """
    store = Store(folder)
    entries, at_work = store.entries(), store.is_locked()
    if not at_work:  # keys that a killed batch was fitting are not running any more
        entries = [entry.stopped() for entry in entries]
    running = [max(time.time() - e.started, 0.0) for e in entries if e.state == "running"]
    done = [e.seconds for e in entries if e.state == "done" and e.seconds]
    left = time_left(done, sum(e.state == "waiting" for e in entries), running, len(running))
    return replace(summary(folder, entries), at_work=at_work, seconds_left=left)


def summary(folder: Path, entries: Sequence[Entry]) -> Status:
    """State of a batch with these entries."""
    count = Counter(e.state for e in entries)
    seconds = [e.seconds for e in entries if e.state == "done"]
    return Status(
        str(folder),
        {state: count[state] for state in ("done", "failed", "running", "waiting")},
        round(statistics.median(seconds), 3) if seconds else None,
        max((e.memory for e in entries), default=0),
        _suggestions(entries),
        [*entries],
    )


def time_left(seconds: Sequence[float], waiting: int, running: Sequence[float], slots: int) -> float | None:
    """Estimated remaining time of a batch, s. None before the first job is done, or without workers.

    A waiting job takes the median time of the finished jobs. A running job takes the rest of that median, but at least
    a quarter of its elapsed time. A job past the median is not about to end.

    Parameters
    ----------
    seconds : times of the finished jobs.
    waiting : number of waiting jobs.
    running : elapsed times of the running jobs, s.
    slots : number of workers.
    """
    if not seconds or not slots:
        return None
    median = statistics.median(seconds)
    remaining = [max(median - elapsed, elapsed / 4) for elapsed in running]
    return max((waiting * median + sum(remaining)) / slots, max(remaining, default=0.0))


def _suggestions(entries: Sequence[Entry]) -> list[str]:
    """Corrections of note names that the detected pitches suggest."""
    wrong = [e for e in entries if e.detected_note]
    offsets = Counter(note_to_midi(e.detected_note) - note_to_midi(e.note) for e in wrong)
    ((semitones, times),) = offsets.most_common(1) or [(0, 0)]
    if times > 2 and 2 * times > len(entries):
        keys = f"{times} of {len(entries)} keys sound {counted(abs(semitones), 'semitone')}"
        where = f"{'above' if semitones > 0 else 'below'} their names: the library numbers octaves differently"
        return [f"{keys} {where}; run with --transpose {semitones} and another --out"]
    return [f"{e.key}: its name says {e.note}, its pitch {e.detected_note}; correct its note" for e in wrong]
