"""The folder of a batch: `keys/KEY/` for every finished key, `ledger/` for all else, and nothing half-written.

A key's folder is written in another place, flushed to the disk, and renamed: it is there whole or not at all. Its
`record.json` holds the hash of the unit it is the result of and the digest of every file, so that a folder proves by
itself that it is finished; the ledger can be lost and nothing is.
"""

from __future__ import annotations

import contextlib
import errno
import hashlib
import json
import os
import shutil
import sqlite3
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from ..errors import OutputError
from ..io.files import DISK_FULL, printable

__all__ = ["LEDGER", "RECORD", "Store", "is_locked", "locked", "open_folder", "write_error"]

LEDGER, KEYS, RECORD = "ledger", "keys", "record.json"
LOCK = "lock"  # in the ledger's folder, as are these, of the workers and of this process, which are gone after a run
SCRATCH, UNFINISHED = "scratch", "unfinished"


class Store:
    """The keys' folders under `folder`."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.keys = folder / KEYS
        self.ledger = folder / LEDGER
        self.scratch = self.ledger / SCRATCH
        self._unfinished = self.ledger / UNFINISHED

    def remove_partial(self) -> None:
        """Take away what an interrupted run left unfinished."""
        for left in (self.scratch, self._unfinished):
            shutil.rmtree(left, ignore_errors=True)
        for file in self.ledger.glob(".*.tmp"):
            file.unlink(missing_ok=True)

    def commit(self, key: str, files: dict[str, bytes], record: dict[str, Any]) -> None:
        """Make `files` and their record the folder of `key`, in one step.

        Raises `OutputError` if they cannot be written; nothing is left behind.
        """
        digests = {name: hashlib.sha256(content).hexdigest() for name, content in files.items()}
        content = json.dumps(record | {"files": digests}, indent=2).encode() + b"\n"
        new, old = self._unfinished / "new", self._unfinished / "old"
        try:
            new.mkdir(parents=True)
            for name, data in {**files, RECORD: content}.items():
                with (new / name).open("xb") as file:
                    file.write(data)
                    file.flush()
                    os.fsync(file.fileno())
            _flush(new)
            with contextlib.suppress(FileNotFoundError):
                (self.keys / key).rename(old)
            new.rename(self.keys / key)
            _flush(self.keys)
        except OSError as error:
            raise write_error(self.folder, error) from error
        finally:
            shutil.rmtree(self._unfinished, ignore_errors=True)

    def read_record(self, key: str) -> dict[str, Any] | None:
        """The record of a finished key, as its folder says it; None if there is none."""
        try:
            record = json.loads((self.keys / key / RECORD).read_bytes())
            return record if isinstance(record["hash"], str) and isinstance(record["files"], dict) else None
        except (OSError, ValueError, KeyError, TypeError, RecursionError):
            return None

    def content(self, key: str, name: str) -> bytes | None:
        """A file of a finished key; None if it is missing or not what the record says."""
        record = self.read_record(key) or {"files": {}}
        with contextlib.suppress(OSError):
            data = (self.keys / key / Path(name).name).read_bytes()
            return data if hashlib.sha256(data).hexdigest() == record["files"].get(name) else None
        return None

    def record(self, key: str) -> dict[str, Any] | None:
        """The record of a finished key; None if its folder is missing or is not what its record says."""
        record = self.read_record(key)
        whole = record is not None and all(self.content(key, name) is not None for name in record["files"])
        return record if whole else None

    def finished(self) -> set[str]:
        """Names of the folders that are there."""
        return {p.name for p in self.keys.iterdir() if (p / RECORD).is_file()}


def _flush(folder: Path) -> None:
    """Bring a folder's entries to the disk, where the system can."""
    with contextlib.suppress(PermissionError):  # Windows opens no folders
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        except OSError as error:
            if error.errno != errno.EINVAL:  # a file system without
                raise
        finally:
            os.close(handle)


def write_error(folder: Path, error: Exception) -> OutputError:
    """What to tell of a folder that does not let itself be written."""
    name, full = printable(folder), "full" in str(error)
    if full or getattr(error, "errno", None) in DISK_FULL:
        return OutputError(f"{name}: the disk is full; what is finished is kept: make room and run the same command")
    reason = getattr(error, "strerror", None) or error
    return OutputError(f"{name}: cannot be written to ({reason}); choose a folder that is yours, then run it again")


def open_folder(folder: Path) -> Store:
    """The folder of a new batch or of one to be continued, made if need be.

    Raises `OutputError` if it cannot be made or written to, or holds something else than a batch.
    """
    name = printable(folder)
    if folder.exists() and not folder.is_dir():
        raise OutputError(f"{name}: is a file; give a folder as --out")
    try:
        held = {p.name for p in folder.iterdir()} if folder.is_dir() else set()
        if held and not held & {LEDGER, KEYS}:
            raise OutputError(f"{name}: the folder is not empty and holds no batch; give another --out")
        for place in (folder / KEYS, folder / LEDGER):
            place.mkdir(parents=True, exist_ok=True)
            if not os.access(place, os.W_OK | os.X_OK):
                raise PermissionError(errno.EACCES, "it is read-only, or another's")
    except OSError as error:
        raise write_error(folder, error) from error
    return Store(folder)


@contextlib.contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Hold the folder for one batch. The lock is SQLite's on an empty file: the system frees it with the process.

    Raises `OutputError` if another batch holds it.
    """
    lock = folder / LEDGER / LOCK
    lock.parent.mkdir(exist_ok=True)
    connection = sqlite3.connect(lock, isolation_level=None, timeout=1.0)
    try:
        try:
            connection.execute("BEGIN EXCLUSIVE")
        except sqlite3.OperationalError as error:
            if "locked" in str(error):
                raise OutputError(
                    f"{printable(folder)}: another batch is at work in this folder; wait for it, or give another --out"
                ) from None
            raise write_error(folder, error) from error
        except sqlite3.DatabaseError as error:
            raise OutputError(f"{printable(lock)}: is not the lock of a batch ({error}); remove it") from None
        yield
    finally:
        connection.close()


def is_locked(folder: Path) -> bool:
    """Tell whether a batch is at work in `folder`."""
    lock = folder / LEDGER / LOCK
    if not lock.exists():
        return False
    connection = sqlite3.connect(lock.resolve().as_uri() + "?mode=ro", uri=True, timeout=0.0)
    try:
        connection.execute("SELECT count(*) FROM sqlite_master").fetchone()
    except sqlite3.OperationalError as error:
        return "locked" in str(error)
    except sqlite3.DatabaseError:
        return False
    finally:
        connection.close()
    return False
