"""A running dask.distributed cluster as workers: the same units, sent to a scheduler, results back to the one batch.

A worker that is lost is the scheduler's to notice; it gives the unit to another. A scheduler that is lost ends the
batch with what is finished kept. No more units are sent ahead than keep the workers busy, so that recordings sent by
value do not pile up in the scheduler.
"""

from __future__ import annotations

import gc
import logging
import queue
import secrets
import time
from pathlib import Path

from ..errors import OutputError, ParameterError, RecordingError
from ..io.files import printable, read_file
from ..io.table_output import require_optional
from ..recording.recording import MAX_BYTES
from .job import Job, JobResult, fit_unit
from .process_pool import RunningJob, Work, WorkerLost, one_thread

__all__ = ["Cluster", "check_cluster"]

PATIENCE = 10.0  # s, for the scheduler to answer
AHEAD = 2  # units sent for every thread
TOPIC = "pianofit-batch"  # of the events by which workers tell their stages


def check_cluster() -> None:
    """Refuse where dask.distributed is not installed: `ParameterError`, saying what to install."""
    require_optional("distributed", "--scheduler", "cluster", ParameterError)


class Cluster:
    """Workers of the scheduler at `address`, such as tcp://10.0.0.1:8786, which do `work` with each unit.

    Recordings are sent along if `by_value`; else workers read them at the same paths.

    Raises `ParameterError` if dask.distributed is missing, or there is no scheduler.
    """

    def __init__(self, address: str, by_value: bool, work: Work = fit_unit) -> None:
        check_cluster()
        from dask import config
        from distributed import Client

        self._by_value, self._work, self._address = by_value, work, printable(address)
        logging.getLogger("distributed").setLevel(logging.CRITICAL)  # what it would say is said here in one line
        # Recordings sent along are part of the task: kept by the scheduler, they outlive any worker.
        config.set({"distributed.admin.large-graph-warning-threshold": "1 GiB"})
        reason = None
        try:
            self._client = Client(address, timeout=PATIENCE, set_as_default=False, name="pianofit-batch")
        except (OSError, ValueError, TimeoutError) as error:
            reason = printable(error)[:100]
        if reason is not None:
            gc.collect()  # ends what is left of the client; collected while a later one starts it would lock up both
            raise ParameterError(
                f"--scheduler {self._address}: no scheduler answers there ({reason}); check the address"
            )
        self._begun: dict = {}  # future -> (unit, when)
        self._stage: dict[str, str] = {}  # by the unit's hash
        self._client.subscribe_topic(TOPIC, self._on_progress_event)
        self._ended: queue.Queue = queue.Queue()
        self._token = secrets.token_hex(4)
        self.slots = 0
        self._count()

    def __enter__(self) -> Cluster:
        return self

    def __exit__(self, *_: object) -> None:
        if self._client.status == "running":
            self._client.cancel(list(self._begun))
        self._client.close(timeout=5)

    def _count(self) -> None:
        """Count the cluster's threads, which come and go."""
        workers = self._client.scheduler_info(n_workers=-1)["workers"].values()
        self.slots = sum(w["nthreads"] for w in workers)

    def pending(self) -> int:
        """Count the units that were sent and have not ended."""
        return len(self._begun)

    def running(self) -> dict[str, RunningJob]:
        """Keys at work, the seconds since each was sent, and its stage; those sent ahead are not counted."""
        now = time.monotonic()
        oldest = list(self._begun.values())[: self.slots]
        return {unit.key: RunningJob(now - since, self._stage.get(unit.hash, "")) for unit, since in oldest}

    def _on_progress_event(self, event) -> None:
        """A worker's stage: (when, (hash of its unit, stage))."""
        _, (digest, stage) = event
        self._stage[digest] = stage

    def has_capacity(self) -> bool:
        """Tell whether another unit should be sent."""
        return len(self._begun) < max(AHEAD * self.slots, 1)

    def submit(self, unit: Job) -> None:
        """Send a unit.

        Raises `RecordingError` if a recording that is to be sent cannot be read; `OutputError` if the scheduler is
        gone.
        """
        if self._client.status != "running":
            raise self._worker_lost()
        contents = None
        if self._by_value:
            contents = [read_file(s.path, MAX_BYTES, RecordingError) for s in unit.sources]
        key = f"pianofit-{unit.key}-{unit.hash[:8]}-{self._token}-{len(self._begun)}-{time.monotonic_ns()}"
        future = self._client.submit(on_worker, self._work, unit, contents, key=key, pure=False)
        self._stage.pop(unit.hash, None)  # of an attempt before
        self._begun[future] = unit, time.monotonic()
        future.add_done_callback(self._ended.put)

    def finished(self, timeout: float) -> list[tuple[Job, JobResult | WorkerLost]]:
        """Units that ended, waiting up to `timeout` seconds for the first.

        Raises `OutputError` if the scheduler is gone.
        """
        try:
            future = self._ended.get(timeout=timeout)
        except queue.Empty:
            future = None
        if self._client.status != "running" or (future is not None and future.status in ("cancelled", "lost")):
            raise self._worker_lost()
        self._count()
        if future is None:
            return []
        unit, _ = self._begun[future]
        try:
            outcome = self._result(future)
        finally:
            del self._begun[future]
            self._stage.pop(unit.hash, None)
            future.release()
        return [(unit, outcome)]

    def _result(self, future) -> JobResult | WorkerLost:
        from distributed import CancelledError, KilledWorker

        try:
            return future.result(timeout=60 * PATIENCE)
        except KilledWorker:
            return JobResult({}, "every worker that began it died, perhaps for want of memory; see the workers' logs")
        except (CancelledError, OSError, TimeoutError) as error:  # the connection, not the fit
            if self._client.status != "running" or isinstance(error, CancelledError):
                raise self._worker_lost() from None
            return WorkerLost(f"its result did not arrive ({printable(error)[:100]})")
        except Exception as error:
            reason = printable(f"the workers cannot run it ({type(error).__name__}: {error})")[:300]
            return JobResult({}, f"{reason}; install the same pianofit there", stop=True)

    def _worker_lost(self) -> OutputError:
        return OutputError(
            f"--scheduler {self._address}: the scheduler is gone; what is finished is kept: start one and run the same "
            "command again"
        )


def on_worker(work: Work, unit: Job, contents: list[bytes] | None) -> JobResult:
    """Run a unit on a worker of the cluster, in the worker's own scratch folder."""
    from distributed import get_worker

    worker = get_worker()
    with one_thread():  # for what is imported only now
        return work(
            unit, contents, str(Path(worker.local_directory)),
            lambda stage: worker.log_event(TOPIC, (unit.hash, stage)),
        )  # fmt: skip
