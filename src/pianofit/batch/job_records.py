"""The ledger: what no finished key's folder can prove, a small file for every key that is not done.

A finished key is its folder (`store.py`). Of the others somebody has to remember which were asked for, what failed and
why, and which are being fitted: `ledger/KEY.json` says so, written whole or not at all, and goes when the key is done.
A file that cannot be read says nothing, and its key is fitted anew; so a lost ledger loses no result.
"""

from __future__ import annotations

import json
from typing import Any, NamedTuple

from ..errors import OutputError
from ..io.files import json_text, printable, replace_file
from .store import Store, write_error

__all__ = ["Entry", "read_records", "entry_of", "write_record"]


class Entry(NamedTuple):
    """What became of a key."""

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
    began: float = 0.0  # when, s since 1970, while it is running

    @property
    def why(self) -> str:
        """Why it failed, with what its pitch suggests."""
        told = not self.detected_note or self.detected_note in self.reason
        return self.reason if told else f"{self.reason}; it sounds like {self.detected_note}"


def entry_of(store: Store, key: str, record: dict[str, Any] | None) -> Entry | None:
    """What is known of a key whose folder has this record: it is done, unless something newer is wanted of it."""
    kept = _kept(store, key)
    if record is None or (kept is not None and kept.hash != record["hash"]):
        return kept
    return Entry(
        key, str(record.get("note", "")), record["hash"], "done", len(record.get("recordings", ())),
        left_out=tuple(record.get("left_out", ())), seconds=record.get("seconds", 0.0),
        memory=record.get("memory", 0),
    )  # fmt: skip


def _kept(store: Store, key: str) -> Entry | None:
    try:
        table = json.loads((store.ledger / f"{key}.json").read_bytes())
        entry = Entry(**table | {"left_out": tuple(table["left_out"])})
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return None
    return entry if entry.key == key and entry.state in ("waiting", "running", "failed") else None


def read_records(store: Store) -> list[Entry]:
    """Of all keys that were ever asked for in this folder, by name.

    Raises `OutputError` if it is no batch's.
    """
    if not store.ledger.is_dir() and not store.keys.is_dir():
        raise OutputError(f"{printable(store.folder)}: holds no batch; check the path")
    names = store.finished() | {file.stem for file in store.ledger.glob("*.json")}
    found = (entry_of(store, key, store.read_record(key)) for key in sorted(names))
    return [entry for entry in found if entry is not None]


def write_record(store: Store, entry: Entry) -> None:
    """Keep an entry in place of the key's last; that of a key that is done goes.

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
