"""The machine's own processes as workers: spawned, one thread each, watched one by one.

A worker that dies takes nothing with it but the unit it was at, and that is known: every worker has a pipe of its own.
Memory is bounded three ways: the system refuses a worker more than its share (RLIMIT_DATA, on Linux), a worker is
replaced after `RECYCLE` units, because JAX keeps every program it has compiled, and results wait in no queue. A worker
that outlives its batch ends itself.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import shutil
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from multiprocessing import connection
from pathlib import Path
from typing import Any, NamedTuple

from .job import Job, JobResult, fit_unit

__all__ = ["RunningJob", "Local", "WorkerLost", "Work"]

RECYCLE = 16  # units
# One thread for each library that would take all cores; read when it is first imported.
ONE_THREAD = dict.fromkeys(
    ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS", "NPROC"), "1"
)
XLA_FLAG = "--xla_cpu_multi_thread_eigen=false"

# Of a unit, its recordings' bytes, a scratch folder, and a function that is told the stages.
Work = Callable[[Job, list[bytes] | None, str | None, Callable[[str], None]], JobResult]


class WorkerLost(NamedTuple):
    """A unit whose worker is gone."""

    reason: str


class RunningJob(NamedTuple):
    """A unit that is being fitted."""

    seconds: float  # since it began
    stage: str  # what is done of it now; empty if that is not known


@dataclass
class _Worker:
    process: Any
    pipe: connection.Connection
    unit: Job | None = None
    since: float = 0.0
    stage: str = ""
    served: int = 0


class Local:
    """So many workers on this machine, which do `work` with each unit, and have `scratch` for temporary files.

    Each may take so much `memory`, bytes, and a unit so much time, s.
    """

    def __init__(self, workers: int, memory: int, time_limit: float, scratch: Path, work: Work = fit_unit) -> None:
        self.slots, self._memory, self._limit, self._work = workers, memory, time_limit, work
        scratch.mkdir(exist_ok=True)
        self._scratch = scratch
        self._workers: list[_Worker] = []
        self._context = multiprocessing.get_context("spawn")

    def __enter__(self) -> Local:
        return self

    def __exit__(self, *_: object) -> None:
        for worker in self._workers:
            worker.process.kill()
        for worker in self._workers:
            worker.process.join()
            worker.pipe.close()
        shutil.rmtree(self._scratch, ignore_errors=True)

    def pending(self) -> int:
        """Count the units that were begun and have not ended."""
        return sum(w.unit is not None for w in self._workers)

    def running(self) -> dict[str, RunningJob]:
        """Keys at work, the seconds each has taken, and its stage."""
        now = time.monotonic()
        return {w.unit.key: RunningJob(now - w.since, w.stage) for w in self._workers if w.unit is not None}

    def has_capacity(self) -> bool:
        """Tell whether another unit can be begun."""
        return self.pending() < self.slots

    def submit(self, unit: Job) -> None:
        """Begin a unit on a worker that is free, or on a new one."""
        worker = next((w for w in self._workers if w.unit is None), None) or self._start()
        worker.unit, worker.since, worker.stage = unit, time.monotonic(), ""
        with contextlib.suppress(OSError):  # a worker that is gone is found by its end
            worker.pipe.send((unit, None, str(self._scratch)))

    def finished(self, timeout: float) -> list[tuple[Job, JobResult | WorkerLost]]:
        """Units that ended, waiting up to `timeout` seconds for the first."""
        busy = [w for w in self._workers if w.unit is not None]
        ready = set(connection.wait([x for w in busy for x in (w.pipe, w.process.sentinel)], timeout))
        found = []
        for worker in busy:
            unit, outcome = worker.unit, None
            if worker.pipe in ready or worker.process.sentinel in ready:
                outcome = self._collect(worker, gone=worker.process.sentinel in ready)
            if outcome is None and time.monotonic() - worker.since > self._limit:
                self._retire(worker, 0.0)
                reason = f"took more than {self._limit:g} s and was stopped; give --time-limit more if it may"
                outcome = JobResult({}, reason, seconds=self._limit)
            if unit is not None and outcome is not None:
                worker.unit = None
                found.append((unit, outcome))
        return found

    def _collect(self, worker: _Worker, gone: bool) -> JobResult | WorkerLost | None:
        """What a worker has said: the end of its unit, or None where that goes on and only a stage was told."""
        try:
            while worker.pipe.poll():
                said = worker.pipe.recv()
                if isinstance(said, JobResult):
                    worker.served += 1
                    if worker.served >= RECYCLE:
                        self._retire(worker)
                    return said
                worker.stage = said
        except (EOFError, OSError):
            gone = True
        return WorkerLost(self._retire(worker)) if gone else None

    def _retire(self, worker: _Worker, patience: float = 5.0) -> str:
        """Take a worker away and say how it ended."""
        worker.pipe.close()  # one that waits for work ends at this
        worker.process.join(patience)
        worker.process.kill()
        worker.process.join()
        self._workers.remove(worker)
        code = worker.process.exitcode or 0
        if code >= 0:
            return f"its worker ended with exit code {code}"
        name = signal.Signals(-code).name if -code in signal.valid_signals() else f"signal {-code}"
        share = f"{self._memory / 2**30:g} GiB"
        return f"its worker was ended by {name}, perhaps for want of memory (each may take {share})"

    def _start(self) -> _Worker:
        ours, theirs = self._context.Pipe()
        process = self._context.Process(target=_serve, args=(theirs, self._work, self._memory), daemon=True)
        with one_thread():
            process.start()
        theirs.close()
        self._workers.append(_Worker(process, ours))
        return self._workers[-1]


@contextlib.contextmanager
def one_thread() -> Iterator[None]:
    """For processes started meanwhile: one thread for numbers."""
    flags = f"{os.environ.get('XLA_FLAGS', '')} {XLA_FLAG}".strip()
    before = {name: os.environ.get(name) for name in (*ONE_THREAD, "XLA_FLAGS", "JAX_PLATFORMS")}
    os.environ.update(ONE_THREAD | {"XLA_FLAGS": flags})
    os.environ.setdefault("JAX_PLATFORMS", "cpu")
    try:
        yield
    finally:
        for name, value in before.items():
            os.environ.pop(name)
            if value is not None:
                os.environ[name] = value


def _serve(pipe: connection.Connection, work: Work, memory: int) -> None:
    """A worker's life: units in, outcomes out, until the pipe closes."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the batch's, which ends its workers
    threading.Thread(target=_end_with_parent, daemon=True).start()
    if sys.platform == "linux":
        import resource

        _, hard = resource.getrlimit(resource.RLIMIT_DATA)
        share = memory if hard == resource.RLIM_INFINITY else min(memory, hard)
        resource.setrlimit(resource.RLIMIT_DATA, (share, hard))
    while True:
        try:
            unit, contents, scratch = pipe.recv()
        except EOFError:
            return
        pipe.send(work(unit, contents, scratch, pipe.send))


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
