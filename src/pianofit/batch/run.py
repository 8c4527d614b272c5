"""The batch loop: it gives unfinished jobs to workers and writes the results.

The loop does not depend on the kind of workers (`process_pool.py`, `dask_pool.py`). Only this process writes: first the
folder of a key, in one step, then its ledger entry. If it is killed in between, the next run finds the folder complete
or missing, and the folder decides.
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
from .dask_pool import DaskPool
from .html_index import Index
from .job import Job, JobResult
from .job_records import Entry, entry_of, write_record
from .process_pool import ProcessPool, RunningJob, WorkerLost
from .state import summary, time_left
from .store import Store, locked, open_folder

__all__ = ["Progress", "plan_jobs", "run_batch"]

MAX_ATTEMPTS = 2  # for a job whose worker died
PROGRESS_INTERVAL_S = 0.5  # s, between two progress reports


class Progress(NamedTuple):
    """Progress of a batch."""

    total: int
    done: int
    failed: int
    running: tuple[tuple[str, str], ...]  # running keys, and the stage of each
    seconds_left: float | None  # s; None before it can be estimated
    event: str = ""  # one line, or empty


ProgressCallback = Callable[[Progress], None]
Workers = ProcessPool | DaskPool


def plan_jobs(jobs: Sequence[Job], folder: Path, retry_failed: bool = False) -> dict[str, str]:
    """Plan of a run by key: "done", "failed: REASON" (not repeated), or "to do: WHY". Nothing is written."""
    store = Store(folder)
    return {job.key: _job_status(job, store, retry_failed)[0] for job in jobs}


def _job_status(job: Job, store: Store, retry_failed: bool) -> tuple[str, Entry]:
    """Plan and entry of one job. The folder decides whether it is done, the ledger whether it failed."""
    record, fresh = store.read_record(job.key), Entry(job.key, job.note, job.hash, "waiting", len(job.sources))
    entry = entry_of(store, job.key, record)
    current = entry if entry is not None and entry.hash == job.hash else fresh
    if current.state == "done":
        return ("done", current) if store.verified_record(job.key) else ("to do: its folder was changed", fresh)
    if current.state == "failed":
        reason = current.reason
        return (f"to do: failed before ({reason})", fresh) if retry_failed else (f"failed: {reason}", current)
    if record is not None:
        before = record.get("parts", {})
        changed = [name for name, digest in job.parts.items() if before.get(name) != digest]
        return f"to do: {' and '.join(changed) or 'something'} changed", fresh
    return "to do: new", fresh


def run_batch(
    jobs: Sequence[Job],
    folder: Path,
    workers: Callable[[Store], contextlib.AbstractContextManager[Workers]],
    *,
    retry_failed: bool = False,
    tell: ProgressCallback = lambda _: None,
) -> dict[str, Any]:
    """Fit all jobs that are not done, into `folder`, and return their states as `status` does.

    `workers` creates the workers, after the folder is locked.

    Raises `OutputError` if the folder is in use, holds something else, or cannot be written to, or if the cluster is
    gone. Finished keys are kept, and the same call continues the batch.
    """
    store = open_folder(folder)
    with locked(folder):
        store.remove_partial()
        batch = _Batch(jobs, store, tell)
        batch.reconcile(retry_failed)
        if batch.queue:
            with workers(store) as pool:
                batch.run(pool)
        batch.index.close()
        strangers = sorted(store.finished() - {key for key, row in batch.rows.items() if row.state == "done"})
    return summary(folder, [*batch.rows.values()]) | {"strangers": strangers}


class _Batch:
    """The state of a run."""

    def __init__(self, jobs: Sequence[Job], store: Store, tell: ProgressCallback) -> None:
        self.jobs, self.store, self.tell = jobs, store, tell
        self.rows: dict[str, Entry] = {}
        self.queue: deque[Job] = deque()
        self.attempts: Counter[str] = Counter()
        self.index = Index(store)
        self.seconds: list[float] = []

    def reconcile(self, retry_failed: bool) -> None:
        """Make the ledger agree with the folders, and queue the jobs that are to do."""
        for job in self.jobs:
            plan, self.rows[job.key] = _job_status(job, self.store, retry_failed)
            if plan.startswith("to do"):
                self.queue.append(job)
            if plan.endswith("changed"):
                self._report(f"{job.key}: {plan.removeprefix('to do: ')}, so it is fitted again")
            write_record(self.store, self.rows[job.key])
        self.seconds = [r.seconds for r in self.rows.values() if r.state == "done" and r.seconds]

    def run(self, workers: Workers) -> None:
        """Run all queued jobs."""
        try:
            while self.queue or workers.pending():
                while self.queue and workers.has_capacity():
                    self._begin(workers, self.queue.popleft())
                for job, outcome in workers.finished(PROGRESS_INTERVAL_S):
                    self._end(job, outcome, workers)
                self._record_stages(workers.running())
                self._report("", workers)
                self.index.write_if_due()
        except BaseException:  # also Ctrl-C: no entry may stay "running"
            with contextlib.suppress(OutputError):
                for row in self.rows.values():
                    if row.state == "running":
                        write_record(self.store, row._replace(state="waiting", stage="", started=0.0))
                self.index.close()
            raise

    def _record_stages(self, running: dict[str, RunningJob]) -> None:
        """Write the current stage of each running key to the ledger."""
        for key, current in running.items():
            row = self.rows[key]
            if row.state == "running" and row.stage != current.stage:
                self.rows[key] = row._replace(stage=current.stage)
                write_record(self.store, self.rows[key])

    def _begin(self, workers: Workers, job: Job) -> None:
        self.attempts[job.key] += 1
        self._update(job, state="running", attempts=self.attempts[job.key], stage="", started=round(time.time(), 3))
        try:
            workers.submit(job)
        except RecordingError as error:
            self._end(job, JobResult({}, str(error)), workers)

    def _end(self, job: Job, outcome: JobResult | WorkerLost, workers: Workers) -> None:
        if isinstance(outcome, WorkerLost):
            if self.attempts[job.key] < MAX_ATTEMPTS:
                self._update(job, state="waiting", reason=outcome.reason)
                self.queue.append(job)
                self._report(f"{job.key}: {outcome.reason}; it is tried again", workers)
                return
            outcome = JobResult({}, f"{outcome.reason}, {MAX_ATTEMPTS} times")
        if outcome.stop:
            raise OutputError(f"{job.key}: {outcome.error}; finished keys are kept for the next run")
        facts = {"seconds": round(outcome.seconds, 3), "memory": outcome.memory, "left_out": outcome.left_out}
        if outcome.error:
            facts |= {"reason": outcome.error, "detected_note": outcome.detected_note, "detail": outcome.detail}
            self._update(job, state="failed", **facts)
            self._report(f"{job.key}: failed: {self.rows[job.key].failure_text}", workers)
            return
        self.store.commit(job.key, outcome.files, _record(job, outcome))
        self._update(job, state="done", reason="", **facts)
        self.seconds.append(outcome.seconds)
        without = (
            f", without {len(outcome.left_out)} of {counted(len(job.sources), 'recording')}" if outcome.left_out else ""
        )
        self._report(f"{job.key}: done in {outcome.seconds:.1f} s{without}", workers)

    def _update(self, job: Job, **facts: Any) -> None:
        if facts["state"] != "running":
            facts |= {"stage": "", "started": 0.0}
            self.index.changed()
        self.rows[job.key] = self.rows[job.key]._replace(**facts)
        write_record(self.store, self.rows[job.key])

    def _report(self, event: str, workers: Workers | None = None) -> None:
        count = Counter(r.state for r in self.rows.values())
        running = {} if workers is None else workers.running()
        waiting, slots = len(self.queue), 0 if workers is None else workers.slots
        left = time_left(self.seconds, waiting, [current.seconds for current in running.values()], slots)
        stages = tuple((key, current.stage) for key, current in running.items())
        self.tell(Progress(len(self.jobs), count["done"], count["failed"], stages, left, printable(event)))


def _record(job: Job, outcome: JobResult) -> dict[str, Any]:
    return {
        "key": job.key, "note": job.note, "hash": job.hash, "parts": job.parts, "versions": job.versions,
        "settings": job.settings._asdict(), "recordings": [s._asdict() for s in job.sources],
        "left_out": outcome.left_out,
        "seconds": round(outcome.seconds, 3), "memory": outcome.memory, "finished": round(time.time(), 3),
    }  # fmt: skip
