"""The ledger: one row a key, what became of it and why. SQLite in WAL, written by the batch alone.

What is finished is proved by the keys' folders (`store.py`); the ledger adds what no folder can hold, failures with
their reasons, attempts and times, and answers `pianofit status` while a batch is at work. A ledger of an older version,
or one that cannot be read, is set aside, and the folders are taken into a new one.
"""

from __future__ import annotations

import contextlib
import json
import sqlite3
import time
from pathlib import Path
from typing import Any, NamedTuple

from ..errors import OutputError
from ..io import one_line
from .store import unwritable

__all__ = ["Entry", "Ledger", "SCHEMA", "read_ledger"]

SCHEMA = 1
# Entries of the fields of `Entry`, in its order.
_TABLE = """
CREATE TABLE keys (
  key TEXT PRIMARY KEY, note TEXT NOT NULL, hash TEXT NOT NULL,
  state TEXT NOT NULL CHECK (state IN ('waiting', 'running', 'done', 'failed')),
  takes INTEGER NOT NULL DEFAULT 0, attempts INTEGER NOT NULL DEFAULT 0,
  reason TEXT NOT NULL DEFAULT '', sounds_like TEXT NOT NULL DEFAULT '', detail TEXT NOT NULL DEFAULT '',
  left_out TEXT NOT NULL DEFAULT '[]', seconds REAL NOT NULL DEFAULT 0, memory INTEGER NOT NULL DEFAULT 0,
  at REAL NOT NULL DEFAULT 0
) STRICT"""


class Entry(NamedTuple):
    """A row of the ledger."""

    key: str
    note: str
    hash: str
    state: str
    takes: int = 0  # recordings
    attempts: int = 0
    reason: str = ""
    sounds_like: str = ""
    detail: str = ""
    left_out: str = "[]"  # JSON, pairs of file and reason
    seconds: float = 0.0  # of the fit
    memory: int = 0  # bytes
    at: float = 0.0  # s since 1970, of the last change

    def document(self) -> dict[str, Any]:
        """The row as JSON says it."""
        return self._asdict() | {"left_out": [{"file": f, "reason": r} for f, r in json.loads(self.left_out)]}


class Ledger:
    """The ledger at `path`, open for writing; whoever opens it holds the folder's lock."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.set_aside = self._make_way()
        with self._errors():
            self._db = sqlite3.connect(path, isolation_level=None)
            self._db.execute("PRAGMA journal_mode = WAL")
            self._db.execute("PRAGMA synchronous = FULL")
            if not self._db.execute("SELECT count(*) FROM sqlite_master").fetchone()[0]:
                self._db.execute("BEGIN")
                self._db.execute(_TABLE)
                self._db.execute(f"PRAGMA user_version = {SCHEMA}")
                self._db.execute("COMMIT")

    def __enter__(self) -> Ledger:
        return self

    def __exit__(self, *_: object) -> None:
        with contextlib.suppress(sqlite3.Error):
            self._db.close()

    def _make_way(self) -> str:
        """Set aside what is at `path` if it is no ledger of this version; return what to tell of it."""
        if not self.path.exists():
            return ""
        version = _version(self.path)
        if version in (SCHEMA, None):
            return ""
        if version > SCHEMA:
            raise OutputError(
                f"{one_line(self.path)}: was written by a newer pianofit (version {version}, this one writes "
                f"{SCHEMA}); use that one, or give another --out"
            )
        number = 1
        while (aside := self.path.with_name(f"{self.path.name}.old-{number}")).exists():
            number += 1
        try:
            self.path.rename(aside)
            for suffix in ("-wal", "-shm"):
                self.path.with_name(self.path.name + suffix).unlink(missing_ok=True)
        except OSError as error:
            raise unwritable(self.path.parent, error) from error
        what = "cannot be read" if version < 0 else f"is of an older version ({version}, now {SCHEMA})"
        return f"{one_line(self.path)}: {what} and was set aside as {aside.name}; finished keys are taken over"

    @contextlib.contextmanager
    def _errors(self):
        try:
            yield
        except sqlite3.Error as error:
            raise unwritable(self.path.parent, error) from error

    def entries(self) -> dict[str, Entry]:
        """All rows by key."""
        with self._errors():
            return _entries(self._db)

    def write(self, *entries: Entry) -> None:
        """Put rows in, all or none, in place of those of the same keys.

        Raises
        ------
        OutputError
            If the disk is full or the folder cannot be written to.
        """
        fields, marks = ", ".join(Entry._fields), ", ".join("?" * len(Entry._fields))
        renewed = ", ".join(f"{name} = excluded.{name}" for name in Entry._fields)  # keeps the row in its place
        statement = f"INSERT INTO keys ({fields}) VALUES ({marks}) ON CONFLICT (key) DO UPDATE SET {renewed}"  # noqa: S608
        now = time.time()
        with self._errors():
            self._db.execute("BEGIN IMMEDIATE")
            try:
                self._db.executemany(statement, [tuple(e._replace(at=now)) for e in entries])
                self._db.execute("COMMIT")
            except BaseException:
                with contextlib.suppress(sqlite3.Error):
                    self._db.execute("ROLLBACK")
                raise


def _entries(db: sqlite3.Connection) -> dict[str, Entry]:
    fields = ", ".join(Entry._fields)
    rows = db.execute(f"SELECT {fields} FROM keys ORDER BY rowid")  # noqa: S608
    return {row[0]: Entry(*row) for row in rows}


def _version(path: Path) -> int | None:
    """Version of the ledger at `path`; None if it is empty, -1 if it is no ledger."""
    connection = sqlite3.connect(path)
    try:
        version = int(connection.execute("PRAGMA user_version").fetchone()[0])
        tables = {name for (name,) in connection.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}
        if not tables:
            return None
        if connection.execute("PRAGMA quick_check(1)").fetchone()[0] != "ok":
            return -1
        if version == SCHEMA:
            _entries(connection)
    except sqlite3.DatabaseError as error:
        if "locked" in str(error) or "unable to open" in str(error):
            raise unwritable(path.parent, error) from error
        return -1
    finally:
        connection.close()
    return version


def read_ledger(folder: Path) -> dict[str, Entry]:
    """The rows of the ledger in `folder`, while a batch may be writing it; nothing is changed.

    Raises
    ------
    OutputError
        If there is no ledger of this version.
    """
    path = folder / "ledger"
    if not path.is_file():
        raise OutputError(f"{one_line(folder)}: holds no ledger, so no batch was run there; check the path")
    for mode in ("mode=ro", "immutable=1"):  # the second where the folder cannot be written and no batch can be at work
        try:
            connection = sqlite3.connect(f"{path.resolve().as_uri()}?{mode}", uri=True, timeout=5.0)
            try:
                version = int(connection.execute("PRAGMA user_version").fetchone()[0])
                if version == SCHEMA:
                    return _entries(connection)
            finally:
                connection.close()
        except sqlite3.OperationalError:
            continue
        except sqlite3.DatabaseError as error:
            raise OutputError(f"{one_line(path)}: cannot be read ({error}); run the batch again to renew it") from None
        raise OutputError(
            f"{one_line(path)}: is of version {version}, this program reads {SCHEMA}; run the batch again to renew it"
        )
    raise OutputError(f"{one_line(path)}: cannot be opened; check the folder")
