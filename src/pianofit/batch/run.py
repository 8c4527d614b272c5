"""A batch: units that are not done, through workers, into the folder and the ledger. The loop is written once.

What the workers are (`local.py`, `cluster.py`) it does not know. Only this process writes: first a key's folder, in one
step, then its row. Killed at any moment in between, the next run finds the folder whole or missing, and brings the
ledger in line with it.
"""

from __future__ import annotations

import contextlib
import json
import statistics
import time
from collections import Counter, deque
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple, Protocol

from ..errors import OutputError, RecordingError
from ..io import one_line
from .ledger import Entry, Ledger, read_ledger
from .local import Lost
from .store import LEDGER, Store, is_locked, locked, opened
from .units import Outcome, Unit

__all__ = ["Progress", "Workers", "plan", "run_batch", "status"]

ATTEMPTS = 2  # of a unit whose worker is lost
BEAT = 0.5  # s between two looks at the clock


class Workers(Protocol):
    """Who does the work."""

    slots: int

    def pending(self) -> int:
        """Count the units that were submitted and have not ended."""
        ...

    def running(self) -> dict[str, float]:
        """Keys at work and the seconds that each has taken."""
        ...

    def room(self) -> bool:
        """Tell whether another unit should be submitted."""
        ...

    def submit(self, unit: Unit) -> None:
        """Begin a unit; RecordingError if its recordings cannot be sent."""
        ...

    def finished(self, timeout: float) -> list[tuple[Unit, Outcome | Lost]]:
        """Units that ended, waiting up to `timeout` seconds for the first."""
        ...


class Progress(NamedTuple):
    """How far a batch is."""

    total: int
    done: int
    failed: int
    running: int
    left: float | None  # s, None before it can be told
    event: str = ""  # what just happened, a line; else empty


Tell = Callable[[Progress], None]


def plan(units: Sequence[Unit], folder: Path, retry_failed: bool = False) -> dict[str, str]:
    """What a run would do with every unit, and why; nothing is written.

    Returns
    -------
    dict
        By key: "done", "failed: REASON" (which a run leaves alone), or "to do: WHY".
    """
    entries: dict[str, Entry] = {}
    with contextlib.suppress(OutputError):  # none yet, or one that a run would renew
        entries = read_ledger(folder)
    store = Store(folder)
    return {u.key: _standing(u, store.record(u.key), entries.get(u.key), retry_failed) for u in units}


def _standing(unit: Unit, record: dict | None, entry: Entry | None, retry_failed: bool) -> str:
    """Where a unit stands: the folder proves what is done, the ledger knows what has failed."""
    if record is not None and record.get("hash") == unit.hash:
        return "done"
    if entry is not None and entry.state == "failed" and entry.hash == unit.hash:
        return f"to do: failed before ({entry.reason})" if retry_failed else f"failed: {entry.reason}"
    if record is not None:
        before = record.get("parts", {})
        changed = [name for name, digest in unit.parts.items() if before.get(name) != digest]
        return f"to do: {' and '.join(changed)} changed"
    if entry is not None and entry.state == "done" and entry.hash == unit.hash:
        return "to do: its folder is missing or was changed"
    return "to do: new"


def run_batch(
    units: Sequence[Unit],
    folder: Path,
    workers: Callable[[Store], contextlib.AbstractContextManager[Workers]],
    *,
    retry_failed: bool = False,
    tell: Tell = lambda _: None,
) -> dict[str, Any]:
    """Fit all units that are not done, into `folder`, and return what `status` says of them.

    Parameters
    ----------
    workers : makes the workers, once the folder is held.

    Raises
    ------
    OutputError
        If the folder is in use, is not a batch's, or cannot be written to, or the cluster is gone. What is finished
        stays, and the same call goes on.
    """
    store = opened(folder)
    with locked(folder), Ledger(folder / LEDGER) as ledger:
        store.tidy()
        if ledger.set_aside:
            tell(Progress(len(units), 0, 0, 0, None, ledger.set_aside))
        batch = _Batch(units, store, ledger, tell)
        batch.settle(retry_failed)
        if batch.queue:
            with workers(store) as at_work:
                batch.run(at_work)
        entries = ledger.entries()
        strangers = sorted(store.finished() - {u.key for u in units if entries[u.key].state == "done"})
    return _document(folder, [entries[u.key] for u in units]) | {"strangers": strangers}


class _Batch:
    """The state of a run."""

    def __init__(self, units: Sequence[Unit], store: Store, ledger: Ledger, tell: Tell) -> None:
        self.units, self.store, self.ledger, self.tell = units, store, ledger, tell
        self.rows: dict[str, Entry] = {}
        self.queue: deque[Unit] = deque()
        self.attempts: Counter[str] = Counter()
        self.seconds: list[float] = []

    def settle(self, retry_failed: bool) -> None:
        """Bring the ledger in line with the folders, and queue what is to do."""
        held = self.ledger.entries()
        for unit in self.units:
            record, entry = self.store.record(unit.key), held.get(unit.key)
            standing = _standing(unit, record, entry, retry_failed)
            known = entry if entry is not None and entry.hash == unit.hash else _fresh(unit)
            if standing == "done" and record is not None:
                known = known._replace(state="done", reason="", sounds_like="", detail="", **_measured(record))
            elif not standing.startswith("failed"):
                known = _fresh(unit)
                self.queue.append(unit)
            if entry is not None and entry.state == "done" and known.state != "done":
                self._say(f"{unit.key}: {standing.removeprefix('to do: ')}, so it is fitted anew")
            self.rows[unit.key] = known
        self.seconds = [r.seconds for r in self.rows.values() if r.state == "done" and r.seconds]
        self.ledger.write(*(r for r in self.rows.values() if held.get(r.key) != r))

    def run(self, workers: Workers) -> None:
        """Work until nothing is left."""
        try:
            while self.queue or workers.pending():
                while self.queue and workers.room():
                    self._begin(workers, self.queue.popleft())
                for unit, outcome in workers.finished(BEAT):
                    self._end(unit, outcome, workers)
                self._say("", workers)
        except BaseException:  # also Ctrl-C: nothing stays "running"
            with contextlib.suppress(OutputError):
                self.ledger.write(*(r._replace(state="waiting") for r in self.rows.values() if r.state == "running"))
            raise

    def _begin(self, workers: Workers, unit: Unit) -> None:
        self.attempts[unit.key] += 1
        self._row(unit, state="running", attempts=self.attempts[unit.key])
        try:
            workers.submit(unit)
        except RecordingError as error:
            self._end(unit, Outcome({}, str(error)), workers)

    def _end(self, unit: Unit, outcome: Outcome | Lost, workers: Workers) -> None:
        if isinstance(outcome, Lost):
            if self.attempts[unit.key] < ATTEMPTS:
                self._row(unit, state="waiting", reason=outcome.reason)
                self.queue.append(unit)
                self._say(f"{unit.key}: {outcome.reason}; it is tried again", workers)
                return
            outcome = Outcome({}, f"{outcome.reason}, {ATTEMPTS} times")
        if outcome.stop:
            full = "No space" in outcome.error or "full" in outcome.error
            hint = "make room and run the same command" if full else "then run the same command"
            raise OutputError(f"{unit.key}: {outcome.error}; what is finished is kept: {hint}")
        left_out = json.dumps(outcome.left_out)
        facts = {"seconds": round(outcome.seconds, 3), "memory": outcome.memory, "left_out": left_out}
        if outcome.error:
            facts |= {"reason": outcome.error, "sounds_like": outcome.sounds_like, "detail": outcome.detail}
            self._row(unit, state="failed", **facts)
            self._say(f"{unit.key}: failed: {_reason(self.rows[unit.key])}", workers)
            return
        self.store.install(unit.key, outcome.files, _record(unit, outcome))
        self._row(unit, state="done", reason="", **facts)
        self.seconds.append(outcome.seconds)
        without = f", without {len(outcome.left_out)} of {len(unit.sources)} recordings" if outcome.left_out else ""
        self._say(f"{unit.key}: done in {outcome.seconds:.1f} s{without}", workers)

    def _row(self, unit: Unit, **facts: Any) -> None:
        self.rows[unit.key] = self.rows[unit.key]._replace(**facts)
        self.ledger.write(self.rows[unit.key])

    def _say(self, event: str, workers: Workers | None = None) -> None:
        count = Counter(r.state for r in self.rows.values())
        running = {} if workers is None else workers.running()
        waiting, slots = len(self.queue), 0 if workers is None else workers.slots
        left = time_left(self.seconds, waiting, list(running.values()), slots)
        self.tell(Progress(len(self.units), count["done"], count["failed"], len(running), left, one_line(event)))


def time_left(seconds: Sequence[float], waiting: int, running: Sequence[float], slots: int) -> float | None:
    """Seconds until all is done: the median of finished units for each that waits, shared among the workers.

    A unit at work is given what it lacks of the median, and never less than a quarter of what it has taken: one that
    is over its time is not about to end.

    Parameters
    ----------
    seconds : of the units that are done.
    running : seconds that each running unit has taken so far.
    """
    if not seconds or not slots:
        return None
    each = statistics.median(seconds)
    rest = [max(each - r, r / 4) for r in running]
    return max((waiting * each + sum(rest)) / slots, max(rest, default=0.0))


def _fresh(unit: Unit) -> Entry:
    return Entry(unit.key, unit.note, unit.hash, "waiting", takes=len(unit.sources))


def _measured(record: dict) -> dict[str, Any]:
    """What a folder's record says of the fit that made it."""
    left_out = json.dumps([[x["file"], x["reason"]] for x in record.get("left_out", [])])
    return {"left_out": left_out, "seconds": record.get("seconds", 0.0), "memory": record.get("memory", 0)}


def _record(unit: Unit, outcome: Outcome) -> dict[str, Any]:
    return {
        "key": unit.key, "note": unit.note, "hash": unit.hash, "parts": unit.parts, "versions": unit.versions,
        "settings": unit.settings._asdict(), "recordings": [s._asdict() for s in unit.sources],
        "left_out": [{"file": f, "reason": r} for f, r in outcome.left_out],
        "seconds": round(outcome.seconds, 3), "memory": outcome.memory, "finished": round(time.time(), 3),
    }  # fmt: skip


def _reason(entry: Entry) -> str:
    """Why a key failed, with what its pitch suggests."""
    told = not entry.sounds_like or entry.sounds_like in entry.reason
    return entry.reason if told else f"{entry.reason} (it sounds like {entry.sounds_like})"


def status(folder: Path) -> dict[str, Any]:
    """What the ledger in `folder` says, with whether a batch is at work there.

    Raises
    ------
    OutputError
        If there is no ledger.
    """
    entries, at_work = list(read_ledger(folder).values()), is_locked(folder)
    if not at_work:  # what a killed batch was at is not running any more
        entries = [e._replace(state="waiting") if e.state == "running" else e for e in entries]
    return _document(folder, entries) | {"at_work": at_work}


def _document(folder: Path, entries: Sequence[Entry]) -> dict[str, Any]:
    count = Counter(e.state for e in entries)
    seconds = [e.seconds for e in entries if e.state == "done"]
    return {
        "folder": str(folder),
        "counts": {state: count[state] for state in ("done", "failed", "running", "waiting")},
        "median_seconds": round(statistics.median(seconds), 3) if seconds else None,
        "largest_memory": max((e.memory for e in entries), default=0),
        "suggestions": suggestions(entries),
        "keys": [e.document() for e in entries],
    }


def suggestions(entries: Sequence[Entry]) -> list[str]:
    """What the pitches say about the names of the notes."""
    from ..analysis.notes import note_to_midi

    wrong = [e for e in entries if e.sounds_like]
    offset = Counter(note_to_midi(e.sounds_like) - note_to_midi(e.note) for e in wrong)
    if not offset:
        return []
    semitones, times = offset.most_common(1)[0]
    if times > 2 and 2 * times > len(entries):
        return [
            f"{times} of {len(entries)} keys sound {abs(semitones)} semitones {'above' if semitones > 0 else 'below'} "
            f"their names: the library counts otherwise; run with --transpose {semitones} and another --out"
        ]
    return [f"{e.key}: its name says {e.note}, its pitch {e.sounds_like}; correct its note" for e in wrong]
