"""The ledger: one small file for every key that is not done.

A finished key is recorded by its folder (`store.py`). `ledger/KEY.json` records all other keys: requested, running, or
failed with a reason. The file is written atomically and removed when the key is done. If it cannot be read, the key
is fitted again. A lost ledger therefore loses no result.
"""

from __future__ import annotations

import json
from typing import Any, NamedTuple

from ..errors import OutputError
from ..io.files import json_text, printable, replace_file
from .store import Store, write_error

__all__ = ["Entry", "read_records", "entry_of", "write_record"]


class Entry(NamedTuple):
    """State of one key."""

    key: str
    note: str
    hash: str
    state: str  # waiting, running, done or failed
    recordings: int = 0
    attempts: int = 0
    reason: str = ""
    detected_note: str = ""
    detail: str = ""
    left_out: tuple[dict[str, str], ...] = ()  # file and reason of each
    seconds: float = 0.0  # of the fit
    memory: int = 0  # bytes
    stage: str = ""  # of the fit, while it is running
    started: float = 0.0  # start time, s since 1970, while it is running

    @property
    def failure_text(self) -> str:
        """Reason of a failure, with the detected note."""
        complete = not self.detected_note or self.detected_note in self.reason
        return self.reason if complete else f"{self.reason}; it sounds like {self.detected_note}"


def entry_of(store: Store, key: str, record: dict[str, Any] | None) -> Entry | None:
    """State of a key whose folder has this record. It is done, unless the ledger has a request with another hash."""
    in_ledger = _ledger_entry(store, key)
    if record is None or (in_ledger is not None and in_ledger.hash != record["hash"]):
        return in_ledger
    return Entry(
        key, str(record.get("note", "")), record["hash"], "done", len(record.get("recordings", ())),
        left_out=tuple(record.get("left_out", ())), seconds=record.get("seconds", 0.0),
        memory=record.get("memory", 0),
    )  # fmt: skip


def _ledger_entry(store: Store, key: str) -> Entry | None:
    try:
        table = json.loads((store.ledger / f"{key}.json").read_bytes())
        entry = Entry(**table | {"left_out": tuple(table["left_out"])})
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return None
    return entry if entry.key == key and entry.state in ("waiting", "running", "failed") else None


def read_records(store: Store) -> list[Entry]:
    """States of all keys that were ever requested in this folder, in the order of their names.

    Raises `OutputError` if the folder does not hold a batch.
    """
    if not store.ledger.is_dir() and not store.keys.is_dir():
        raise OutputError(f"{printable(store.folder)}: holds no batch; check the path")
    names = store.finished() | {file.stem for file in store.ledger.glob("*.json")}
    entries = (entry_of(store, key, store.read_record(key)) for key in sorted(names))
    return [entry for entry in entries if entry is not None]


def write_record(store: Store, entry: Entry) -> None:
    """Replace the ledger entry of a key, or remove it if the key is done.

    Raises `OutputError` if the disk is full or the folder cannot be written to.
    """
    file = store.ledger / f"{entry.key}.json"
    try:
        if entry.state == "done":
            file.unlink(missing_ok=True)
        else:
            replace_file(file, json_text(entry._asdict()).encode())
    except (OSError, OutputError) as error:
        reason = error.__cause__ if isinstance(error.__cause__, OSError) else error
        raise write_error(store.folder, reason) from error
