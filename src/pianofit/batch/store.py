"""The folder of a batch: `keys/KEY/` for every finished key, and `ledger/` for everything else.

The folder of a key is written elsewhere, flushed to the disk, and renamed. It is therefore complete or missing. Its
`record.json` holds the hash of its job and the digest of every file. A folder thus proves that it is finished, and no
result is lost with the ledger.
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
# All three lie in the folder of the ledger. The last two, of the workers and of this process, exist only during a run.
LOCK, SCRATCH, UNFINISHED = "lock", "scratch", "unfinished"


class Store:
    """Folders of the keys, and the ledger, in `folder`."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.keys = folder / KEYS
        self.ledger = folder / LEDGER
        self.scratch = self.ledger / SCRATCH
        self._unfinished = self.ledger / UNFINISHED

    def remove_partial(self) -> None:
        """Remove unfinished files of an interrupted run."""
        for partial in (self.scratch, self._unfinished):
            shutil.rmtree(partial, ignore_errors=True)
        for file in self.ledger.glob(".*.tmp"):
            file.unlink(missing_ok=True)

    def commit(self, key: str, files: dict[str, bytes], record: dict[str, Any]) -> None:
        """Write `files` and their record as the folder of `key`, in one step.

        Raises `OutputError` if they cannot be written. Partial files are removed.
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
        """Record in the folder of a key, without a check of the files. None if it is missing or damaged."""
        try:
            record = json.loads((self.keys / key / RECORD).read_bytes())
            return record if isinstance(record["hash"], str) and isinstance(record["files"], dict) else None
        except (OSError, ValueError, KeyError, TypeError, RecursionError):
            return None

    def verified_content(self, key: str, name: str) -> bytes | None:
        """Content of a file of a finished key. None if it is missing or its digest differs from the record."""
        record = self.read_record(key) or {"files": {}}
        with contextlib.suppress(OSError):
            data = (self.keys / key / Path(name).name).read_bytes()
            return data if hashlib.sha256(data).hexdigest() == record["files"].get(name) else None
        return None

    def verified_record(self, key: str) -> dict[str, Any] | None:
        """Record of a finished key. None if its folder is missing, or a file differs from the record."""
        record = self.read_record(key)
        complete = record is not None and all(self.verified_content(key, name) is not None for name in record["files"])
        return record if complete else None

    def finished(self) -> set[str]:
        """Names of the keys that have a folder with a record."""
        return {p.name for p in self.keys.iterdir() if (p / RECORD).is_file()}


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


def write_error(folder: Path, error: Exception) -> OutputError:
    """Error for a folder that cannot be written to."""
    name, full = printable(folder), "full" in str(error)
    if full or getattr(error, "errno", None) in DISK_FULL:
        return OutputError(f"{name}: the disk is full; finished keys are kept: make room and run the same command")
    reason = getattr(error, "strerror", None) or error
    return OutputError(f"{name}: cannot be written to ({reason}); choose another folder, then run the command again")


def open_folder(folder: Path) -> Store:
    """Open the folder of a batch, and create it if it does not exist.

    Raises `OutputError` if it cannot be created or written to, or holds something other than a batch.
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
                raise PermissionError(errno.EACCES, "read-only, or owned by another user")
    except OSError as error:
        raise write_error(folder, error) from error
    return Store(folder)


@contextlib.contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Lock the folder for one batch, by an SQLite lock on an empty file. The system releases it with the process.

    Raises `OutputError` if another batch holds the lock.
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
                    f"{printable(folder)}: another batch is running in this folder; wait for it, or give another --out"
                ) from None
            raise write_error(folder, error) from error
        except sqlite3.DatabaseError as error:
            raise OutputError(f"{printable(lock)}: is not the lock of a batch ({error}); remove it") from None
        yield
    finally:
        connection.close()


def is_locked(folder: Path) -> bool:
    """True if a batch is running in `folder`."""
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
