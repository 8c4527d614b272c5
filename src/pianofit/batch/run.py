"""A batch: units that are not done, through workers, into the folder and the ledger. The loop is written once.

What the workers are (`local.py`, `cluster.py`) it does not know. Only this process writes: first a key's folder, in one
step, then its entry. Killed at any moment in between, the next run finds the folder whole or missing, and that is what
counts.
"""

from __future__ import annotations

import contextlib
import time
from collections import Counter, deque
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from ..errors import OutputError, RecordingError
from ..io.files import printable
from ..io.number_format import counted
from .dask_pool import Cluster
from .html_index import Index
from .job import Job, JobResult
from .job_records import Entry, entry_of, write_record
from .process_pool import Local, RunningJob, WorkerLost
from .state import document, time_left
from .store import Store, locked, open_folder

__all__ = ["Progress", "plan_jobs", "run_batch"]

ATTEMPTS = 2  # of a unit whose worker is lost
PROGRESS_INTERVAL_S = 0.5  # s between two looks at the clock


class Progress(NamedTuple):
    """How far a batch is."""

    total: int
    done: int
    failed: int
    running: tuple[tuple[str, str], ...]  # keys at work, and the stage of each
    left: float | None  # s, None before it can be told
    event: str = ""  # what just happened, a line; else empty


Tell = Callable[[Progress], None]
Workers = Local | Cluster


def plan_jobs(units: Sequence[Job], folder: Path, retry_failed: bool = False) -> dict[str, str]:
    """What a run would do, by key: "done", "failed: REASON" (which it leaves alone), or "to do: WHY".

    Nothing is written.
    """
    store = Store(folder)
    return {unit.key: _job_status(unit, store, retry_failed)[0] for unit in units}


def _job_status(unit: Job, store: Store, retry_failed: bool) -> tuple[str, Entry]:
    """Where a unit stands: the folder proves what is done, the ledger knows what has failed."""
    said, fresh = store.read_record(unit.key), Entry(unit.key, unit.note, unit.hash, "waiting", len(unit.sources))
    entry = entry_of(store, unit.key, said)
    known = entry if entry is not None and entry.hash == unit.hash else fresh
    if known.state == "done":
        return ("done", known) if store.record(unit.key) else ("to do: its folder was changed", fresh)
    if known.state == "failed":
        return (f"to do: failed before ({known.reason})", fresh) if retry_failed else (f"failed: {known.reason}", known)
    if said is not None:
        before = said.get("parts", {})
        changed = [name for name, digest in unit.parts.items() if before.get(name) != digest]
        return f"to do: {' and '.join(changed) or 'something'} changed", fresh
    return "to do: new", fresh


def run_batch(
    units: Sequence[Job],
    folder: Path,
    workers: Callable[[Store], contextlib.AbstractContextManager[Workers]],
    *,
    retry_failed: bool = False,
    tell: Tell = lambda _: None,
) -> dict[str, Any]:
    """Fit all units that are not done, into `folder`, and return what `status` says of them.

    `workers` makes the workers, once the folder is held.

    Raises `OutputError` if the folder is in use, is not a batch's, or cannot be written to, or the cluster is gone.
    What is finished stays, and the same call goes on.
    """
    store = open_folder(folder)
    with locked(folder):
        store.remove_partial()
        batch = _Batch(units, store, tell)
        batch.reconcile(retry_failed)
        if batch.queue:
            with workers(store) as at_work:
                batch.run(at_work)
        batch.index.close()
        strangers = sorted(store.finished() - {key for key, row in batch.rows.items() if row.state == "done"})
    return document(folder, [*batch.rows.values()]) | {"strangers": strangers}


class _Batch:
    """The state of a run."""

    def __init__(self, units: Sequence[Job], store: Store, tell: Tell) -> None:
        self.units, self.store, self.tell = units, store, tell
        self.rows: dict[str, Entry] = {}
        self.queue: deque[Job] = deque()
        self.attempts: Counter[str] = Counter()
        self.index = Index(store)
        self.seconds: list[float] = []

    def reconcile(self, retry_failed: bool) -> None:
        """Bring the ledger in line with the folders, and queue what is to do."""
        for unit in self.units:
            standing, self.rows[unit.key] = _job_status(unit, self.store, retry_failed)
            if standing.startswith("to do"):
                self.queue.append(unit)
            if standing.endswith("changed"):
                self._say(f"{unit.key}: {standing.removeprefix('to do: ')}, so it is fitted anew")
            write_record(self.store, self.rows[unit.key])
        self.seconds = [r.seconds for r in self.rows.values() if r.state == "done" and r.seconds]

    def run(self, workers: Workers) -> None:
        """Work until nothing is left."""
        try:
            while self.queue or workers.pending():
                while self.queue and workers.has_capacity():
                    self._begin(workers, self.queue.popleft())
                for unit, outcome in workers.finished(PROGRESS_INTERVAL_S):
                    self._end(unit, outcome, workers)
                self._stages(workers.running())
                self._say("", workers)
                self.index.show()
        except BaseException:  # also Ctrl-C: nothing stays "running"
            with contextlib.suppress(OutputError):
                for row in self.rows.values():
                    if row.state == "running":
                        write_record(self.store, row._replace(state="waiting", stage="", began=0.0))
                self.index.close()
            raise

    def _stages(self, running: dict[str, RunningJob]) -> None:
        """Let the ledger know what is done of each key now."""
        for key, at in running.items():
            row = self.rows[key]
            if row.state == "running" and row.stage != at.stage:
                self.rows[key] = row._replace(stage=at.stage)
                write_record(self.store, self.rows[key])

    def _begin(self, workers: Workers, unit: Job) -> None:
        self.attempts[unit.key] += 1
        self._row(unit, state="running", attempts=self.attempts[unit.key], stage="", began=round(time.time(), 3))
        try:
            workers.submit(unit)
        except RecordingError as error:
            self._end(unit, JobResult({}, str(error)), workers)

    def _end(self, unit: Job, outcome: JobResult | WorkerLost, workers: Workers) -> None:
        if isinstance(outcome, WorkerLost):
            if self.attempts[unit.key] < ATTEMPTS:
                self._row(unit, state="waiting", reason=outcome.reason)
                self.queue.append(unit)
                self._say(f"{unit.key}: {outcome.reason}; it is tried again", workers)
                return
            outcome = JobResult({}, f"{outcome.reason}, {ATTEMPTS} times")
        if outcome.stop:
            raise OutputError(f"{unit.key}: {outcome.error}; what is finished is kept for the next run")
        facts = {"seconds": round(outcome.seconds, 3), "memory": outcome.memory, "left_out": outcome.left_out}
        if outcome.error:
            facts |= {"reason": outcome.error, "sounds_like": outcome.sounds_like, "detail": outcome.detail}
            self._row(unit, state="failed", **facts)
            self._say(f"{unit.key}: failed: {self.rows[unit.key].why}", workers)
            return
        self.store.commit(unit.key, outcome.files, _record(unit, outcome))
        self._row(unit, state="done", reason="", **facts)
        self.seconds.append(outcome.seconds)
        without = (
            f", without {len(outcome.left_out)} of {counted(len(unit.sources), 'recording')}"
            if outcome.left_out
            else ""
        )
        self._say(f"{unit.key}: done in {outcome.seconds:.1f} s{without}", workers)

    def _row(self, unit: Job, **facts: Any) -> None:
        if facts["state"] != "running":
            facts |= {"stage": "", "began": 0.0}
            self.index.changed()
        self.rows[unit.key] = self.rows[unit.key]._replace(**facts)
        write_record(self.store, self.rows[unit.key])

    def _say(self, event: str, workers: Workers | None = None) -> None:
        count = Counter(r.state for r in self.rows.values())
        running = {} if workers is None else workers.running()
        waiting, slots = len(self.queue), 0 if workers is None else workers.slots
        left = time_left(self.seconds, waiting, [at.seconds for at in running.values()], slots)
        stages = tuple((key, at.stage) for key, at in running.items())
        self.tell(Progress(len(self.units), count["done"], count["failed"], stages, left, printable(event)))


def _record(unit: Job, outcome: JobResult) -> dict[str, Any]:
    return {
        "key": unit.key, "note": unit.note, "hash": unit.hash, "parts": unit.parts, "versions": unit.versions,
        "settings": unit.settings._asdict(), "recordings": [s._asdict() for s in unit.sources],
        "left_out": outcome.left_out,
        "seconds": round(outcome.seconds, 3), "memory": outcome.memory, "finished": round(time.time(), 3),
    }  # fmt: skip
