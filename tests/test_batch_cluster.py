"""A batch through a real dask.distributed cluster. Processes are killed, and the results are those of local workers."""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from batch_cases import DRIVE, TESTS, killed, library, python, quick_work, results

from pianofit.batch import DaskPool, ProcessPool, run_batch, status
from pianofit.batch.process_pool import ONE_THREAD
from pianofit.errors import OutputError, ParameterError, PianofitError

pytest.importorskip("distributed", reason="needs the extra: pip install 'pianofit[cluster]'")


class Machines:
    """A scheduler and workers, each a process that can be killed."""

    def __init__(self, folder: Path, workers: int) -> None:
        folder.mkdir(exist_ok=True)
        self.folder = folder
        self.scheduler = self._start("scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard")
        file = folder / "scheduler.json"
        wait(lambda: file.exists() and file.read_text().endswith("}"))  # the scheduler writes it in pieces
        self.address = json.loads(file.read_text())["address"]
        self.workers = [self.add() for _ in range(workers)]

    def _start(self, what: str, *options: str) -> subprocess.Popen:
        file = str(self.folder / "scheduler.json")
        path = os.pathsep.join([str(TESTS), os.environ.get("PYTHONPATH", "")])
        return subprocess.Popen(
            [sys.executable, "-m", "dask", what, "--scheduler-file", file, *options], cwd=self.folder,
            env=os.environ | ONE_THREAD | {"PYTHONPATH": path}, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip

    def add(self) -> subprocess.Popen:
        """Start a worker of one thread, without a nanny, which would start it again."""
        options = ("--nthreads", "1", "--no-nanny", "--no-dashboard", "--host", "127.0.0.1")
        return self._start("worker", *options, "--local-directory", str(self.folder))

    def end(self) -> None:
        """Kill all processes."""
        for process in (*self.workers, self.scheduler):
            killed(process)


def wait(condition, seconds: float = 60.0) -> None:
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, "the condition was not met in time"
        time.sleep(0.05)


@contextlib.contextmanager
def cluster(folder: Path, workers: int) -> Iterator[Machines]:
    made = Machines(folder, workers)
    try:
        yield made
    finally:
        made.end()


TEXTS = [f"slow {0.3 + 0.01 * i}" for i in range(8)]


@pytest.fixture(scope="module")
def local(tmp_path_factory):
    """A library, its jobs, and their results from local processes."""
    place = tmp_path_factory.mktemp("own")
    jobs = library(place / "in", TEXTS)
    run_batch(jobs, place / "out", lambda s: ProcessPool(2, 2**31, 60.0, s.scratch, work=quick_work))
    return place / "in", jobs, results(place / "out")


@pytest.fixture(scope="module")
def machines(tmp_path_factory):
    """The cluster of the tests that do not kill its scheduler. Who kills a worker adds another."""
    with cluster(tmp_path_factory.mktemp("dask"), 2) as made:
        yield made


@pytest.mark.parametrize("by_value", [True, False])
def test_a_worker_is_killed_in_mid_fit_and_nothing_changes(machines, local, tmp_path, by_value):
    (_, jobs, expected), events = local, []

    def tell(progress):
        if progress.event:
            events.append(progress.event)
            if len(events) == 1:  # the other worker is in the middle of a job
                killed(machines.workers.pop(0))

    found = run_batch(jobs, tmp_path / "out", lambda _: DaskPool(machines.address, by_value, quick_work), tell=tell)
    machines.workers.append(machines.add())
    assert found.counts == {"done": 8, "failed": 0, "running": 0, "waiting": 0}
    assert results(tmp_path / "out") == expected


def test_the_driver_and_then_the_scheduler_are_killed_and_the_batch_goes_on(machines, local, tmp_path):
    folder, jobs, expected = local
    out = tmp_path / "out"
    with cluster(tmp_path / "dask", 2) as others:
        process = python(DRIVE, folder, out, others.address)
        assert process.stdout is not None
        assert "done in" in process.stdout.readline()
        killed(process)
        first = {p.name for p in (out / "keys").iterdir() if not p.name.startswith(".")}
        assert first

        def tell(progress):
            if "done in" in progress.event:
                killed(others.scheduler)

        with pytest.raises(OutputError, match="scheduler is gone"):
            run_batch(jobs, out, lambda _: DaskPool(others.address, True, quick_work), tell=tell)
        kept = status(out).counts
        assert kept["done"] > len(first)
        assert kept["done"] + kept["waiting"] == 8
    run_batch(jobs, out, lambda _: DaskPool(machines.address, True, quick_work))
    assert results(out) == expected


def test_a_result_that_is_lost_with_its_worker_is_computed_again(machines, tmp_path):
    (job,) = library(tmp_path / "in", ["one"])
    ended = []
    with DaskPool(machines.address, True, quick_work) as pool:
        pool.submit(job)
        (future,) = pool._begun
        wait(lambda: future.status == "finished")
        while machines.workers:
            killed(machines.workers.pop())
        wait(lambda: future.status == "lost")
        machines.workers.append(machines.add())
        wait(lambda: ended.extend(pool.finished(0.5)) or ended)
        assert pool.pending == 0
    assert [(job, result.files) for job, result in ended] == [(job, quick_work(job).files)]


def test_what_fails_on_a_worker_is_told_here(machines, tmp_path):
    jobs = library(tmp_path / "in", ["one", "refuse is silent", "three"])
    found = run_batch(jobs, tmp_path / "out", lambda _: DaskPool(machines.address, True, quick_work))
    (tmp_path / "in/A0.wav").unlink()
    gone = run_batch(jobs[:1], tmp_path / "out2", lambda _: DaskPool(machines.address, True, quick_work))
    assert [k.reason for k in found.keys] == ["", "is silent", ""]
    assert "A0.wav: no such file" in gone.keys[0].reason


def test_no_scheduler_is_one_clear_message(monkeypatch):
    monkeypatch.setattr("pianofit.batch.dask_pool.TIMEOUT_S", 0.5)
    with pytest.raises(ParameterError, match=r"--scheduler tcp://127\.0\.0\.1:9: no scheduler answers there"):
        DaskPool("tcp://127.0.0.1:9", True)
    with pytest.raises(PianofitError, match="no scheduler answers there"):
        DaskPool("nonsense", True)
