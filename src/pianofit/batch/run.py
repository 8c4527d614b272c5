"""The batch loop: it gives unfinished jobs to workers and writes the results.

The loop does not depend on the kind of workers (`process_pool.py`, `dask_pool.py`). Only this process writes: first the
folder of a key, in one step, then its ledger entry. If it is killed in between, the next run finds the folder complete
or missing, and the folder decides.
"""

import contextlib
import time
from collections import Counter, deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from ..errors import OutputError, RecordingError
from ..io.files import printable
from ..io.number_format import counted
from .dask_pool import DaskPool
from .fit_job import JobResult
from .html_index import Index
from .job import Job
from .process_pool import ProcessPool
from .records import Entry, Status, Store, summary, time_left

MAX_ATTEMPTS = 2  # for a job whose worker died
PROGRESS_INTERVAL_S = 0.5  # s, between two progress reports


@dataclass(frozen=True)
class Progress:
    """Progress of a batch."""

    total: int
    done: int
    failed: int
    running: tuple[tuple[str, str], ...]  # running keys, and the stage of each
    seconds_left: float | None  # s; None before it can be estimated
    event: str = ""  # one line, or empty
    part: str = ""  # name of the pass; empty if there is one


Workers = ProcessPool | DaskPool


def plan_jobs(jobs: Sequence[Job], folder: Path, retry_failed: bool = False) -> dict[str, str]:
    """Plan of a run by key: "done", "failed: REASON" (not repeated), or "to do: WHY". Nothing is written."""
    return {job.key: _plan(job, Store(folder), retry_failed)[0] for job in jobs}


def _plan(job: Job, store: Store, retry_failed: bool) -> tuple[str, Entry]:
    """Plan and entry of one job. The folder decides whether it is done, the ledger whether it failed."""
    fresh, entry = Entry.waiting(job), store.entry(job.key)
    if entry is not None and entry.hash == job.hash:
        if entry.state == "done":
            return ("done", entry) if store.is_intact(entry) else ("to do: its folder was changed", fresh)
        if entry.state == "failed":
            reason = entry.reason
            return (f"to do: failed before ({reason})", fresh) if retry_failed else (f"failed: {reason}", entry)
    record = store.record(job.key)
    if record is None:
        return "to do: new", fresh
    changed = [name for name in {**job.parts, **record.parts} if record.parts.get(name) != job.parts.get(name)]
    if changed == ["prior"] and "prior" not in record.parts:
        return "to do: second fit", fresh
    return f"to do: {' and '.join(changed) or 'something'} changed", fresh


def run_batch(
    jobs: Sequence[Job],
    folder: Path,
    workers: Callable[[Store], contextlib.AbstractContextManager[Workers]],
    *,
    retry_failed: bool = False,
    tell: Callable[[Progress], None] = lambda _: None,
) -> Status:
    """Fit all jobs of a library that are not done. Finished keys are kept, and the same call continues the batch.

    Parameters
    ----------
    jobs : one for each key, from `pianofit.batch.make_job`.
    folder : folder of the batch.
    workers : creates the workers, after the folder is locked, from the store of the batch.
    retry_failed : fit keys again that failed before.
    tell : called with the progress.

    Returns
    -------
    The state of every key.

    Raises
    ------
    OutputError
        If the folder is in use, holds something else, or cannot be written to, or if the cluster is gone.
    """
    store = Store(folder)
    store.open()
    with store.locked():
        batch = _Batch(jobs, store, tell)
        batch.reconcile(retry_failed)
        if batch.queue:
            with workers(store) as pool:
                batch.run(pool)
        batch.index.close()
        entries = [*batch.entries.values()]
        strangers = sorted(store.finished() - {entry.key for entry in entries if entry.state == "done"})
    return replace(summary(folder, entries), strangers=strangers)


class _Batch:
    """The state of a run."""

    def __init__(self, jobs: Sequence[Job], store: Store, tell: Callable[[Progress], None]) -> None:
        self.jobs, self.store, self.tell = jobs, store, tell
        self.entries: dict[str, Entry] = {}
        self.queue: deque[Job] = deque()
        self.attempts: Counter[str] = Counter()
        self.index = Index(store)
        self.seconds: list[float] = []

    def reconcile(self, retry_failed: bool) -> None:
        """Make the ledger agree with the folders and the jobs, and queue the jobs that are to do."""
        asked = {job.key for job in self.jobs}
        for entry in self.store.entries():
            if entry.key not in asked and entry.state != "done":
                self.store.forget(entry.key)
                self.index.changed()
        for job in self.jobs:
            plan, entry = _plan(job, self.store, retry_failed)
            self._set(entry)
            if plan.startswith("to do"):
                self.queue.append(job)
                if plan.endswith("changed"):
                    self._report(f"{job.key}: {plan.removeprefix('to do: ')}, so it is fitted again")
        self.seconds = [e.seconds for e in self.entries.values() if e.state == "done" and e.seconds]

    def run(self, workers: Workers) -> None:
        """Run all queued jobs."""
        try:
            while self.queue or workers.pending:
                while self.queue and workers.pending < workers.capacity:
                    self._begin(workers, self.queue.popleft())
                for job, outcome in workers.finished(PROGRESS_INTERVAL_S):
                    self._end(job, outcome, workers)
                for key, (_, stage) in workers.running().items():
                    if self.entries[key].stage != stage:
                        self._set(replace(self.entries[key], stage=stage))
                self._report("", workers)
                self.index.write_if_due()
        except BaseException:  # also Ctrl-C: no entry may stay "running"
            with contextlib.suppress(OutputError):
                for entry in self.entries.values():
                    if entry.state == "running":
                        self.store.write(entry.stopped())
                self.index.close()
            raise

    def _begin(self, workers: Workers, job: Job) -> None:
        self.attempts[job.key] += 1
        self._update(job, "running", attempts=self.attempts[job.key], started=round(time.time(), 3))
        try:
            workers.submit(job)
        except RecordingError as error:
            self._end(job, JobResult({}, str(error)), workers)

    def _end(self, job: Job, outcome: JobResult, workers: Workers) -> None:
        if outcome.lost and self.attempts[job.key] < MAX_ATTEMPTS:
            self._update(job, "waiting", reason=outcome.error)
            self.queue.append(job)
            self._report(f"{job.key}: {outcome.error}; it is tried again", workers)
            return
        if outcome.stop:
            raise OutputError(f"{job.key}: {outcome.error}; finished keys are kept for the next run")
        facts: dict[str, Any] = {
            "seconds": round(outcome.seconds, 3),
            "memory": outcome.memory,
            "left_out": outcome.left_out,
        }
        if outcome.error:
            reason = f"{outcome.error}, {MAX_ATTEMPTS} times" if outcome.lost else outcome.error
            failure = {"reason": reason, "detected_note": outcome.detected_note, "detail": outcome.detail}
            self._update(job, "failed", **facts, **failure)
            self._report(f"{job.key}: failed: {self.entries[job.key].failure_text}", workers)
            return
        entry = replace(self.entries[job.key], reason="", stage="", started=0.0, **facts)
        self._set(self.store.commit(entry, outcome.files))
        self.index.changed()
        self.seconds.append(outcome.seconds)
        total = counted(len(job.sources), "recording")
        without = f", without {len(outcome.left_out)} of {total}" if outcome.left_out else ""
        self._report(f"{job.key}: done in {outcome.seconds:.1f} s{without}", workers)

    def _update(self, job: Job, state: str, **facts: Any) -> None:
        """Change the entry of a job. A key that is not running has no stage and no start time."""
        self._set(replace(self.entries[job.key], state=state, **({"stage": "", "started": 0.0} | facts)))
        if state != "running":
            self.index.changed()

    def _set(self, entry: Entry) -> None:
        self.entries[entry.key] = entry
        self.store.write(entry)

    def _report(self, event: str, workers: Workers | None = None) -> None:
        count = Counter(entry.state for entry in self.entries.values())
        running, slots = ({}, 0) if workers is None else (workers.running(), workers.slots)
        left = time_left(self.seconds, len(self.queue), [seconds for seconds, _ in running.values()], slots)
        stages = tuple((key, stage) for key, (_, stage) in running.items())
        self.tell(Progress(len(self.jobs), count["done"], count["failed"], stages, left, printable(event)))
