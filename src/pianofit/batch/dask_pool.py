"""Workers of a running dask.distributed cluster. They run the same jobs as local processes, through a scheduler.

If a worker is lost, the scheduler detects it and gives the job to another worker. If the scheduler is lost, the batch
stops and keeps all finished results. Only as many jobs are sent ahead as keep the workers busy. Recordings sent by
value therefore do not accumulate in the scheduler.
"""

from __future__ import annotations

import gc
import logging
import queue
import secrets
import time

from ..errors import OutputError, ParameterError, RecordingError
from ..io.files import printable, read_file
from ..io.table_output import require_optional
from ..recording.recording import MAX_BYTES
from .fit_job import JobResult, Work, fit_job
from .job import Job
from .process_pool import one_thread

TIMEOUT_S = 10.0  # s, for the scheduler to answer
JOBS_PER_THREAD = 2  # jobs sent for every thread
TOPIC = "pianofit-batch"  # of the events by which workers report their stages


def check_cluster() -> None:
    """Raise `ParameterError`, naming the package to install, if dask.distributed is missing."""
    require_optional("distributed", "--scheduler", "cluster", ParameterError)


class DaskPool:
    """Workers of the scheduler at `address`, such as tcp://10.0.0.1:8786, which run `work` on each job.

    With `by_value`, recordings are sent with the job. Otherwise workers read them at the same paths.

    Raises `ParameterError` if dask.distributed is missing, or if no scheduler answers.
    """

    def __init__(self, address: str, by_value: bool, work: Work = fit_job) -> None:
        check_cluster()
        from dask import config
        from distributed import Client

        self._by_value, self._work, self._address = by_value, work, printable(address)
        logging.getLogger("distributed").setLevel(logging.CRITICAL)  # its errors are reported here, in one line
        # Recordings are part of the task: the scheduler keeps them, so they survive the loss of a worker.
        config.set({"distributed.admin.large-graph-warning-threshold": "1 GiB"})
        reason = None
        try:
            self._client = Client(address, timeout=TIMEOUT_S, set_as_default=False, name="pianofit-batch")
        except (OSError, ValueError, TimeoutError) as error:
            reason = printable(error)[:100]
        if reason is not None:
            gc.collect()  # ends the rest of the client now: collected while a later client starts, it would deadlock
            answer = f"no scheduler answers there ({reason})"
            raise ParameterError(f"--scheduler {self._address}: {answer}; check the address")
        self._begun: dict = {}  # future -> (job, start time, s)
        self._stage: dict[str, str] = {}  # by hash of the job
        self._client.subscribe_topic(TOPIC, lambda event: self._stage.update([event[1]]))  # (time, (hash, stage))
        self._ended: queue.Queue = queue.Queue()
        self._count()

    def __enter__(self) -> DaskPool:
        return self

    def __exit__(self, *_: object) -> None:
        if self._client.status == "running":
            self._client.cancel(list(self._begun))
        self._client.close(timeout=5)

    def _count(self) -> None:
        """Count the threads of the cluster, whose number changes."""
        workers = self._client.scheduler_info(n_workers=-1)["workers"].values()
        self.slots = sum(worker["nthreads"] for worker in workers)
        self.capacity = max(JOBS_PER_THREAD * self.slots, 1)

    @property
    def pending(self) -> int:
        """Number of jobs that were sent and have not ended."""
        return len(self._begun)

    def running(self) -> dict[str, tuple[float, str]]:
        """Running keys with seconds since they were sent, and stage. Jobs sent ahead are not included."""
        now, oldest = time.monotonic(), list(self._begun.values())[: self.slots]
        return {job.key: (now - since, self._stage.get(job.hash, "")) for job, since in oldest}

    def submit(self, job: Job) -> None:
        """Send a job.

        Raises `RecordingError` if a recording to be sent cannot be read, `OutputError` if the scheduler is gone.
        """
        self._check_scheduler()
        contents = None
        if self._by_value:
            contents = [read_file(source.path, MAX_BYTES, RecordingError) for source in job.sources]
        key = f"pianofit-{job.key}-{job.hash[:8]}-{secrets.token_hex(8)}"
        self._stage.pop(job.hash, None)  # of an earlier attempt
        future = self._client.submit(_run, self._work, job, contents, key=key, pure=False)
        self._begun[future] = job, time.monotonic()
        future.add_done_callback(self._ended.put)

    def finished(self, timeout: float) -> list[tuple[Job, JobResult]]:
        """Wait up to `timeout` seconds for a job to end, and return the jobs that ended.

        Raises `OutputError` if the scheduler is gone.
        """
        try:
            future = self._ended.get(timeout=timeout)
        except queue.Empty:
            future = None
        self._check_scheduler(future is not None and future.status == "cancelled")
        self._count()
        if future is None:
            return []
        if future.status == "lost":  # its worker died before the result was fetched: it is computed again
            future.add_done_callback(self._ended.put)
            return []
        job, _ = self._begun[future]
        try:
            return [(job, self._result(future))]
        finally:
            del self._begun[future]
            self._stage.pop(job.hash, None)
            future.release()

    def _result(self, future) -> JobResult:
        from distributed import CancelledError, KilledWorker

        try:
            return future.result(timeout=60 * TIMEOUT_S)
        except KilledWorker:
            return JobResult({}, "every worker that started it died, possibly of too little memory; see their logs")
        except (CancelledError, OSError, TimeoutError) as error:  # the connection, not the fit
            self._check_scheduler(isinstance(error, CancelledError))
            return JobResult({}, f"its result did not arrive ({printable(error)[:100]})", lost=True)
        except Exception as error:
            reason = printable(f"the workers cannot run it ({type(error).__name__}: {error})")[:300]
            return JobResult({}, f"{reason}; install the same pianofit there", stop=True)

    def _check_scheduler(self, lost: bool = False) -> None:
        """Raise `OutputError` if the scheduler is gone, also if a task was lost."""
        if lost or self._client.status != "running":
            hint = "finished keys are kept: start a scheduler and run the same command again"
            raise OutputError(f"--scheduler {self._address}: the scheduler is gone; {hint}") from None


def _run(work: Work, job: Job, contents: list[bytes] | None) -> JobResult:
    """Run a job on a worker of the cluster, in the scratch folder of that worker."""
    from distributed import get_worker

    worker = get_worker()
    with one_thread():  # for libraries that are imported only now
        return work(job, contents, worker.local_directory, lambda stage: worker.log_event(TOPIC, (job.hash, stage)))
