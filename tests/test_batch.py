"""The batch loop with real processes and quick work. No result is lost if a worker dies, hangs or grows too large."""

from __future__ import annotations

import contextlib
import json
import os
import random
import shlex
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest
from batch_cases import DRIVE, TESTS, killed, library, python, quick_work, results

from pianofit.batch import ProcessPool, plan_jobs, run_batch, status
from pianofit.batch.fit_job import JobResult
from pianofit.batch.records import Entry, Store, summary, time_left
from pianofit.errors import OutputError
from pianofit.threads import cores

TEXTS = [f"note {i}" for i in range(8)]


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """Run batches on the same two workers."""
    with ProcessPool(2, 2**31, 60.0, tmp_path_factory.mktemp("workers") / "scratch", work=quick_work) as pool:
        yield lambda jobs, out, **more: run_batch(jobs, out, lambda _: contextlib.nullcontext(pool), **more)


def run_alone(jobs, out: Path, *, workers: int = 2, memory: int = 2**31, limit: float = 60.0):
    return run_batch(jobs, out, lambda s: ProcessPool(workers, memory, limit, s.scratch, work=quick_work))


def no_workers(_):
    pytest.fail("nothing was to do")


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A library, and its results from an uninterrupted batch."""
    place = tmp_path_factory.mktemp("whole")
    jobs = library(place / "in", TEXTS)
    found = run_alone(jobs, place / "out")
    assert found.counts == {"done": 8, "failed": 0, "running": 0, "waiting": 0}
    return place, jobs, results(place / "out")


def test_the_folder_is_exactly_what_it_is_said_to_be(whole):
    place, jobs, found = whole
    assert {p.name for p in (place / "out").iterdir()} == {"index.html", "keys", "keys.csv", "ledger"}
    assert {p.name for p in (place / "out/ledger").iterdir()} == {"lock"}, "what is done needs no ledger"
    assert list(found) == sorted(u.key for u in jobs)
    assert set(found["A0"]) == {"fit.json", "fitted.wav", "record"}
    for job in jobs:
        expected = quick_work(job).files
        assert {n: found[job.key][n] for n in expected} == expected


def test_what_is_done_is_skipped_and_what_changed_is_not(run, whole, tmp_path):
    place, jobs, found = whole
    shutil.copytree(place / "out", tmp_path / "out")
    run_batch(jobs, tmp_path / "out", no_workers)
    assert set(plan_jobs(jobs, tmp_path / "out").values()) == {"done"}
    other = library(tmp_path / "in", ["another", *TEXTS[1:]])
    (tmp_path / "out/keys/As0/fitted.wav").write_bytes(b"by hand")
    shutil.rmtree(tmp_path / "out/keys/B0")
    other[3] = replace(other[3], settings=replace(jobs[3].settings, seed=4))
    assert [plan_jobs(other, tmp_path / "out")[u.key] for u in other[:5]] == [
        "to do: inputs changed", "to do: its folder was changed", "to do: new", "to do: settings changed", "done",
    ]  # fmt: skip
    events = []
    run(other, tmp_path / "out", tell=lambda p: events.append(p.event))
    again = results(tmp_path / "out")
    assert [k for k in again if again[k]["fit.json"] != found[k]["fit.json"]] == ["A0"]
    assert any(event.startswith("A0: inputs changed") for event in events)


def test_a_lost_ledger_loses_no_key(whole, tmp_path):
    place, jobs, _ = whole
    shutil.copytree(place / "out", tmp_path / "out")
    shutil.rmtree(tmp_path / "out/ledger")
    run_batch(jobs, tmp_path / "out", no_workers)
    assert status(tmp_path / "out").counts["done"] == 8


@pytest.mark.parametrize("content", ["", "[]", '{"key": "As0"}', "{" * 5000])
def test_an_entry_that_cannot_be_read_has_its_key_fitted_anew(run, tmp_path, content):
    jobs = library(tmp_path / "in", ["one", "refuse is silent"])
    run(jobs, tmp_path / "out")
    entry = tmp_path / "out/ledger/As0.json"
    assert json.loads(entry.read_text())["reason"] == "is silent"
    entry.write_text(content)
    assert plan_jobs(jobs, tmp_path / "out") == {"A0": "done", "As0": "to do: new"}
    assert status(tmp_path / "out").counts == {"done": 1, "failed": 0, "running": 0, "waiting": 0}


def test_a_failed_key_that_left_the_library_leaves_the_ledger(run, tmp_path):
    jobs = library(tmp_path / "in", ["one", "refuse is silent"])
    run(jobs, tmp_path / "out")
    assert status(tmp_path / "out").counts["failed"] == 1
    run(jobs[:1], tmp_path / "out")
    assert status(tmp_path / "out").counts == {"done": 1, "failed": 0, "running": 0, "waiting": 0}
    assert "As0" not in (tmp_path / "out/keys.csv").read_text()


def test_a_key_that_was_installed_when_the_batch_was_killed_is_done(run, tmp_path):
    """The folder is written before its entry, so the folder decides."""
    jobs = library(tmp_path / "in", ["refuse is silent"])
    run(jobs, tmp_path / "out")
    document = json.loads((tmp_path / "out/ledger/A0.json").read_text())
    (tmp_path / "out/ledger/A0.json").write_text(json.dumps(document | {"state": "running"}))
    Store(tmp_path / "out").commit(Entry.waiting(jobs[0]), {"fit.json": b"1"})
    assert status(tmp_path / "out").counts["done"] == 1
    assert plan_jobs(jobs, tmp_path / "out") == {"A0": "done"}


# --- failures ---------------------------------------------------------------------------------------------------------


def test_failures_are_told_kept_and_tried_again_when_asked(run, tmp_path):
    jobs = library(tmp_path / "in", ["one", "refuse is silent", "three"])
    found = run(jobs, tmp_path / "out")
    assert found.counts == {"done": 2, "failed": 1, "running": 0, "waiting": 0}
    assert [k.reason for k in found.keys] == ["", "is silent", ""]
    again = run_batch(jobs, tmp_path / "out", no_workers)
    assert again.keys[1].reason == "is silent"
    assert plan_jobs(jobs, tmp_path / "out")["As0"] == "failed: is silent"
    events = []
    run(jobs, tmp_path / "out", retry_failed=True, tell=lambda p: events.append(p.event))
    assert [e for e in events if e] == ["As0: failed: is silent"]
    mended = library(tmp_path / "in", ["one", "two", "three"])
    assert run(mended, tmp_path / "out").counts["done"] == 3


def test_a_worker_that_dies_takes_only_its_unit_with_it(run, tmp_path):
    texts = ["one", "die", "three", f"die-once {tmp_path / 'marker'}", "five", "six"]
    jobs = library(tmp_path / "in", texts)
    events = []
    found = run(jobs, tmp_path / "out", tell=lambda p: events.append(p.event))
    assert found.counts == {"done": 5, "failed": 1, "running": 0, "waiting": 0}
    dead = found.keys[1]
    assert "SIGKILL" in dead.reason
    assert "memory" in dead.reason
    assert dead.reason.endswith("2 times")
    assert found.keys[3].attempts == 2
    assert sum("it is tried again" in e for e in events) == 2


def test_a_fit_without_end_and_one_without_bounds_are_stopped(tmp_path):
    jobs = library(tmp_path / "in", ["hang", "swell", "three"])
    found = run_alone(jobs, tmp_path / "out", limit=1.5, memory=2**30)
    assert [k.state for k in found.keys] == ["failed", "failed", "done"]
    assert "1.5 s" in found.keys[0].reason
    assert "--time-limit" in found.keys[0].reason
    assert "memory" in found.keys[1].reason


def test_a_worker_is_replaced_before_it_has_grown_old(tmp_path, monkeypatch):
    monkeypatch.setattr("pianofit.batch.process_pool.MAX_JOBS_PER_WORKER", 2)
    processes = []
    with ProcessPool(1, 2**31, 60.0, tmp_path / "scratch", work=quick_work) as worker:
        for job in library(tmp_path / "in", TEXTS[:4]):
            worker.submit(job)
            while not (found := worker.finished(1.0)):
                pass
            processes.append(found[0][1].detail)
    first, second, third, fourth = processes
    assert first == second != third == fourth


def count_threads(job, *_) -> JobResult:
    from pianofit.inference.batched_model import thread_pool

    return JobResult({}, detail=f"{cores()} {thread_pool()._max_workers}")


def test_a_worker_has_one_thread(tmp_path):
    with ProcessPool(1, 2**31, 60.0, tmp_path / "scratch", work=count_threads) as worker:
        worker.submit(library(tmp_path / "in", ["one"])[0])
        while not (found := worker.finished(1.0)):
            pass
    assert found[0][1].detail == "1 1"


@pytest.mark.parametrize(("setting", "expected"), [("3", 3), ("", None), ("0", None), ("all", None)])
def test_the_number_of_threads_is_that_of_the_environment(monkeypatch, setting, expected):
    monkeypatch.setenv("NPROC", setting)
    machine = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    assert cores() == (expected or machine)


def test_results_of_an_earlier_run_are_reported(run, tmp_path):
    run(library(tmp_path / "in", ["one", "two"]), tmp_path / "out")
    found = run(library(tmp_path / "in", ["refuse is silent"]), tmp_path / "out")
    assert found.strangers == ["A0", "As0"]


def test_a_recording_that_changes_meanwhile_is_not_fitted_as_the_old_one(tmp_path):
    from pianofit.batch.fit_job import fit_job

    (job,) = library(tmp_path / "in", ["one"])
    (tmp_path / "in/A0.wav").write_text("two")
    error = fit_job(job).error
    assert "A0.wav" in error
    assert "changed" in error


def test_a_worker_with_another_version_stops_the_batch(tmp_path):
    from pianofit.batch.fit_job import fit_job

    (job,) = library(tmp_path / "in", ["one"])
    outcome = fit_job(replace(job, versions=job.versions | {"jax": "0.0.1"}))
    assert outcome.stop
    assert "jax" in outcome.error
    assert "0.0.1" in outcome.error


# --- folders ----------------------------------------------------------------------------------------------------------


def test_a_second_batch_in_the_folder_refuses(run, tmp_path):
    jobs = library(tmp_path / "in", ["one"])
    (tmp_path / "out").mkdir()
    with Store(tmp_path / "out").locked(), pytest.raises(OutputError, match="another batch"):
        run(jobs, tmp_path / "out")
    assert run(jobs, tmp_path / "out").counts["done"] == 1


def test_folders_that_are_no_batchs(run, tmp_path):
    jobs = library(tmp_path / "in", ["one"])
    (tmp_path / "file").touch()
    with pytest.raises(OutputError, match="is a file"):
        run(jobs, tmp_path / "file")
    with pytest.raises(OutputError, match="not empty"):
        run(jobs, tmp_path / "in")
    with pytest.raises(OutputError, match="/proc/batch"):
        run(jobs, Path("/proc/batch"))
    with pytest.raises(OutputError, match="no batch"):
        status(tmp_path / "in")


def mounted(code: str, folder: Path, size: str, *options: str) -> subprocess.CompletedProcess:
    """Run `code` with a small disk mounted at `folder`, if the system allows that."""
    tool = shutil.which("unshare")
    if tool is None or subprocess.run([tool, "-m", "true"], capture_output=True, check=False).returncode:
        pytest.skip("no private mounts here")
    folder.mkdir()
    script = f"mount -t tmpfs -o size={size} none {folder} && {code}"
    return subprocess.run([tool, "-m", "sh", "-c", script], capture_output=True, text=True, check=False)


def shell(code: str, *arguments: object) -> str:
    """Command line of a driver for a shell."""
    where = os.pathsep.join([str(TESTS), os.environ.get("PYTHONPATH", "")])
    return f"PYTHONPATH={shlex.quote(where)} " + shlex.join([sys.executable, "-c", code, *map(str, arguments)])


def test_a_full_disk_stops_the_batch_and_the_next_run_goes_on(whole, tmp_path):
    place, _, found = whole
    out, kept = tmp_path / "disk", tmp_path / "kept"
    grow = f"mount -o remount,size=64m none {out}"
    drive = shell(DRIVE, place / "in", out)
    done = mounted(
        f"({drive}; echo code $?; ls -A {out}/ledger {out}/keys; {grow}; {drive}; cp -r {out} {kept})", out, "300k"
    )
    assert "make room" in done.stderr
    first, _, second = done.stdout.partition("code 1")
    assert "done in" in first
    assert "unfinished" not in second
    assert sum("done in" in line for line in (first + second).splitlines()) == 8
    assert results(kept) == found


def test_a_read_only_folder_is_named(whole, tmp_path):
    place, _, _ = whole
    out = tmp_path / "disk"
    done = mounted(f"mount -o remount,ro none {out} && {shell(DRIVE, place / 'in', out)}", out, "1m")
    assert str(out) in done.stderr
    assert "Read-only file system" in done.stderr


def test_no_room_for_a_workers_scratch_stops_the_batch(tmp_path):
    jobs = library(tmp_path / "in", ["one", "full", "three"])
    with pytest.raises(OutputError, match="No space left on device"):
        run_alone(jobs, tmp_path / "out", workers=1)
    assert [k.state for k in status(tmp_path / "out").keys] == ["done", "waiting", "waiting"]


def test_a_folder_is_replaced_whole_or_not_at_all(tmp_path, monkeypatch):
    store = Store(tmp_path)
    store.open()
    first, second = (Entry("C4", "C4", digest, "running") for digest in "ab")
    store.commit(first, {"fit.json": b"1"})
    real = os.fsync

    def refuse(handle):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", refuse)
    with pytest.raises(OutputError, match="make room"):
        store.commit(second, {"fit.json": b"2"})
    monkeypatch.setattr(os, "fsync", real)
    assert (store.entry("C4").hash, store.is_intact(store.record("C4"))) == ("a", True)
    assert [p.name for p in (tmp_path / "keys").iterdir()] == ["C4"]
    store.commit(second, {"fit.json": b"2"})
    assert (store.entry("C4").hash, store.is_intact(store.record("C4"))) == ("b", True)


# --- the end at any moment --------------------------------------------------------------------------------------------


def check_remains(out: Path) -> set[str]:
    """Check after a kill that the folder of every key is complete, and return the names of these keys."""
    if not (out / "keys").is_dir():
        return set()
    store = Store(out)
    keys = store.finished()
    assert all((record := store.record(key)) is not None and store.is_intact(record) for key in keys)
    return keys


def test_killed_at_random_moments_a_batch_goes_on_and_ends_the_same(whole, tmp_path):
    place, jobs, found = whole
    moments = random.Random(7)  # noqa: S311
    before: set[str] = set()
    stamps = {}
    for _ in range(4):
        process = python(DRIVE, place / "in", tmp_path / "out")
        time.sleep(moments.uniform(0.3, 1.6))
        killed(process)
        after = check_remains(tmp_path / "out")
        assert before <= after, "a finished key was lost"
        new = {k: (tmp_path / "out/keys" / k).stat().st_mtime_ns for k in after}
        assert {k: new[k] for k in stamps} == stamps, "a finished key was fitted again"
        before, stamps = after, new
    last = python(DRIVE, place / "in", tmp_path / "out")
    output, errors = last.communicate(timeout=60)
    assert last.returncode == 0, errors
    assert json.loads(output.splitlines()[-1])["done"] == len(jobs)
    assert results(tmp_path / "out") == found
    assert {p.name for p in (tmp_path / "out").iterdir()} == {"index.html", "keys", "keys.csv", "ledger"}


def children(pid: int) -> list[int]:
    """Processes whose parent is `pid`."""
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            parent = int((folder / "stat").read_text().rpartition(")")[2].split()[1])
        except (OSError, ValueError):
            continue
        found += [int(folder.name)] if parent == pid else []
    return found


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="needs Linux's /proc")
def test_workers_end_with_a_batch_that_was_killed(tmp_path):
    library(tmp_path / "in", ["hang", "hang"])
    process = python(DRIVE, tmp_path / "in", tmp_path / "out")
    deadline = time.monotonic() + 30
    while time.monotonic() < deadline and len(workers := children(process.pid)) < 3:  # two, and Python's own helper
        time.sleep(0.05)
    time.sleep(0.5)
    killed(process)
    while time.monotonic() < deadline and any(Path(f"/proc/{pid}").exists() for pid in workers):
        time.sleep(0.05)
    assert not any(Path(f"/proc/{pid}").exists() for pid in workers)
    state = status(tmp_path / "out")
    assert (state.at_work, state.counts["running"], state.counts["waiting"]) == (False, 0, 2)


def test_interrupted_it_leaves_nothing_running(tmp_path):
    library(tmp_path / "in", ["hang", "two"])
    process = python(DRIVE, tmp_path / "in", tmp_path / "out")
    assert process.stdout is not None
    assert "done in" in process.stdout.readline()
    assert status(tmp_path / "out").at_work
    process.send_signal(signal.SIGINT)
    process.communicate(timeout=30)
    state = status(tmp_path / "out")
    assert not state.at_work
    assert state.counts == {"done": 1, "failed": 0, "running": 0, "waiting": 1}
    assert not (tmp_path / "out/ledger/scratch").exists()


# --- reports ----------------------------------------------------------------------------------------------------------


def test_time_left_is_of_what_waits_and_what_runs():
    assert time_left([], 5, [], 2) is None
    assert time_left([10.0, 30.0, 11.0], 4, [5.0, 20.0], 2) == pytest.approx((4 * 11 + 6 + 5) / 2)
    assert time_left([10.0], 0, [2.0], 4) == pytest.approx(8.0)
    assert time_left([10.0], 0, [], 4) == 0


def test_wrong_names_are_suggested_one_by_one_or_all_together(tmp_path):
    def entry(note: str, like: str) -> Entry:
        return Entry(note, note, "", "failed", detected_note=like)

    (suggestion,) = summary(tmp_path, [entry("C4", ""), entry("D4", "E4")]).suggestions
    assert suggestion.startswith("D4: ")
    assert "E4" in suggestion
    wrong = [entry("C3", "C4"), entry("D3", "D4"), entry("E3", "E4"), entry("F3", "")]
    (suggestion,) = summary(tmp_path, wrong).suggestions
    assert suggestion.startswith("3 of 4 keys")
    assert "--transpose 12" in suggestion
