"""Workers as processes of this machine: spawned, one thread each, monitored one by one.

Every worker has its own pipe. If a worker dies, only its current job is lost, and the batch knows which. Memory is
bounded in three ways. The system limits each worker (RLIMIT_DATA, on Linux). A worker is replaced after
`MAX_JOBS_PER_WORKER` jobs, because JAX keeps every compiled program. Results do not wait in a queue. A worker that
outlives its batch ends itself.
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
from typing import Any

from .fit_job import JobResult, fit_job

# A worker grows with its jobs: to 0.85 GB after 16 keys of five recordings (benchmarks/library.py).
MAX_JOBS_PER_WORKER = 16  # jobs
# Longest time for a new worker to start Python and to import what it needs, s. A job's time limit begins afterwards.
LONGEST_START = 120.0
# First message of a worker about each job: it has the job, and its time begins.
TAKEN = ""
# One thread for each library that would use all cores. They read these when they are first imported.
ONE_THREAD = dict.fromkeys(
    ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS", "NPROC"), "1"
)
# One arena of glibc, read when a process starts. Each thread of XLA would have its own, and keep what it has freed.
ONE_ARENA = {"MALLOC_ARENA_MAX": "1"}


@dataclass
class _Worker:
    process: Any
    pipe: connection.Connection
    job: Any = None
    since: float = 0.0  # when it took the job; until then, when the job was sent
    taken: bool = False
    stage: str = ""
    served: int = 0


class ProcessPool:
    """Processes on this machine that run `work` on each job: any object with a `key`.

    Parameters
    ----------
    workers : number of processes.
    memory : limit for each process, bytes.
    time_limit : limit for each job, s.
    scratch : folder for temporary files.
    work : function of a job, None, the scratch folder, and a function that receives each stage.
    """

    def __init__(
        self,
        workers: int,
        memory: int,
        time_limit: float,
        scratch: Path,
        work: Callable[..., JobResult] = fit_job,
    ) -> None:
        self.slots = self.capacity = workers
        self._memory, self._limit, self._scratch, self._work = memory, time_limit, scratch, work
        scratch.mkdir(exist_ok=True)
        self._workers: list[_Worker] = []
        self._context = multiprocessing.get_context("spawn")

    def __enter__(self) -> ProcessPool:
        return self

    def __exit__(self, *_: object) -> None:
        for worker in self._workers:
            worker.process.kill()
        for worker in self._workers:
            worker.process.join()
            worker.pipe.close()
        shutil.rmtree(self._scratch, ignore_errors=True)

    @property
    def pending(self) -> int:
        """Number of jobs that were started and have not ended."""
        return sum(w.job is not None for w in self._workers)

    def running(self) -> dict[str, tuple[float, str]]:
        """Running keys with seconds since their start, and stage."""
        now = time.monotonic()
        return {w.job.key: (now - w.since, w.stage) for w in self._workers if w.job is not None}

    def submit(self, job: Any) -> None:
        """Start a job on a free worker, or on a new one."""
        worker = next((w for w in self._workers if w.job is None), None) or self._start()
        worker.job, worker.since, worker.taken, worker.stage = job, time.monotonic(), False, ""
        with contextlib.suppress(OSError):  # a dead worker is detected by its sentinel
            worker.pipe.send(job)

    def finished(self, timeout: float) -> list[tuple[Any, JobResult]]:
        """Wait up to `timeout` seconds for a job to end, and return the jobs that ended."""
        busy = [w for w in self._workers if w.job is not None]
        ready = set(connection.wait([x for w in busy for x in (w.pipe, w.process.sentinel)], timeout))
        ended = []
        for worker in busy:
            job, outcome = worker.job, None
            if worker.pipe in ready or worker.process.sentinel in ready:
                outcome = self._collect(worker, dead=worker.process.sentinel in ready)
            limit = self._limit + (0.0 if worker.taken else LONGEST_START)
            if outcome is None and time.monotonic() - worker.since > limit:
                self._retire(worker, 0.0)
                reason = (
                    f"took more than {self._limit:g} s and was stopped; increase --time-limit, and add --retry-failed"
                )
                outcome = JobResult({}, reason, seconds=self._limit)
            if job is not None and outcome is not None:
                worker.job = None
                ended.append((job, outcome))
        return ended

    def _collect(self, worker: _Worker, dead: bool) -> JobResult | None:
        """Result of the job of a worker, or None while the job goes on. Stages are stored on the way."""
        try:
            while worker.pipe.poll():
                message = worker.pipe.recv()
                if isinstance(message, JobResult):
                    worker.served += 1
                    if worker.served >= MAX_JOBS_PER_WORKER:
                        self._retire(worker)
                    return message
                if message == TAKEN:
                    worker.taken, worker.since = True, time.monotonic()
                worker.stage = message
        except (EOFError, OSError):
            dead = True
        return JobResult({}, self._retire(worker), lost=True) if dead else None

    def _retire(self, worker: _Worker, patience: float = 5.0) -> str:
        """Remove a worker and return how it ended."""
        worker.pipe.close()  # a worker that waits for a job ends at this
        worker.process.join(patience)
        worker.process.kill()
        worker.process.join()
        self._workers.remove(worker)
        code = worker.process.exitcode or 0
        if code >= 0:
            return f"its worker ended with exit code {code}"
        name = signal.Signals(-code).name if -code in signal.valid_signals() else f"signal {-code}"
        limit = f"{self._memory / 2**30:g} GiB"
        return f"its worker was ended by {name}, possibly of too little memory (limit {limit} each)"

    def _start(self) -> _Worker:
        ours, theirs = self._context.Pipe()
        given = (theirs, self._work, self._memory, str(self._scratch))
        worker = _Worker(self._context.Process(target=_serve, args=given, daemon=True), ours)
        with one_thread(), uninterrupted():
            worker.process.start()
            self._workers.append(worker)
        theirs.close()
        return worker


@contextlib.contextmanager
def uninterrupted() -> Iterator[None]:
    """Hold Ctrl-C back. A process whose start is interrupted would print a traceback."""
    if threading.current_thread() is not threading.main_thread():  # only this one is interrupted
        yield
        return
    came: list[int] = []
    before = signal.signal(signal.SIGINT, lambda number, _: came.append(number))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
    if came:
        signal.raise_signal(signal.SIGINT)


@contextlib.contextmanager
def one_thread() -> Iterator[None]:
    """Give processes started in this context one thread for numerical libraries, and one arena of memory."""
    flags = f"{os.environ.get('XLA_FLAGS', '')} --xla_cpu_multi_thread_eigen=false".strip()
    settings = ONE_THREAD | ONE_ARENA | {"XLA_FLAGS": flags}
    before = {name: os.environ.get(name) for name in (*settings, "JAX_PLATFORMS")}
    os.environ.update(settings)
    os.environ.setdefault("JAX_PLATFORMS", "cpu")
    try:
        yield
    finally:
        for name, value in before.items():
            os.environ.pop(name)
            if value is not None:
                os.environ[name] = value


def _serve(pipe: connection.Connection, work: Callable[..., JobResult], memory: int, scratch: str) -> None:
    """Run jobs from the pipe until it closes."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the batch handles Ctrl-C and ends its workers
    threading.Thread(target=_end_with_parent, daemon=True).start()
    if sys.platform == "linux":
        import resource

        _, hard = resource.getrlimit(resource.RLIMIT_DATA)
        limit = memory if hard == resource.RLIM_INFINITY else min(memory, hard)
        resource.setrlimit(resource.RLIMIT_DATA, (limit, hard))
    while True:
        try:
            job = pipe.recv()
        except EOFError:
            return
        pipe.send(TAKEN)
        pipe.send(work(job, None, scratch, pipe.send))


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
