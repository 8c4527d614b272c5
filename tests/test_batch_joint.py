"""A batch in two passes: what has a prior, what is repeated, and what remains if a pass is interrupted."""

from __future__ import annotations

import contextlib
import shutil
import tomllib
from dataclasses import replace
from pathlib import Path

import pytest
from batch_cases import library, results
from joint_cases import note_work

from pianofit.batch import ProcessPool, plan_joint_jobs, run_batch, run_joint_batch
from pianofit.batch.job import Job
from pianofit.cli import main
from pianofit.errors import OutputError, SetupError
from pianofit.instrument import find_fits, load_keys, prior_of_key
from pianofit.schema.fit import read_fit
from pianofit.setup import Setup

TEXTS = ["one", "two", "three"]  # A0 to B0


@pytest.fixture(scope="module")
def pool(tmp_path_factory):
    """One worker, the same for all batches."""
    with ProcessPool(1, 2**31, 60.0, tmp_path_factory.mktemp("worker") / "scratch", work=note_work) as one:
        yield lambda _: contextlib.nullcontext(one)


def no_workers(_):
    pytest.fail("nothing was to do")


def prior_in(folder: Path, key: str):
    return read_fit(folder / "keys" / key / "fit.json").prior


@pytest.fixture(scope="module")
def whole(pool, tmp_path_factory):
    """A library, the folder of its batch in two passes, and the events."""
    place = tmp_path_factory.mktemp("joint")
    jobs, events = library(place / "in", TEXTS), []
    found = run_joint_batch(jobs, place / "out", pool, tell=lambda p: events.append((p.part, p.event)))
    assert found.counts == {"done": 3, "failed": 0, "running": 0, "waiting": 0}
    return place, jobs, events


def test_every_key_has_the_prior_of_the_first_fits_of_the_others(whole):
    place, _, events = whole
    alone = load_keys(find_fits([place / "out/alone"]))
    for key in alone:
        name = Path(key.summary.file).parent.name
        assert prior_in(place / "out/alone", name) is None
        assert prior_in(place / "out", name) == prior_of_key(alone, key.midi)
    passes = [part for part, event in events if "done in" in event]
    assert passes == ["pass 1 of 2"] * 3 + ["pass 2 of 2"] * 3


def test_the_same_call_does_nothing_more(whole):
    place, jobs, _ = whole
    before = results(place / "out")
    found = run_joint_batch(jobs, place / "out", no_workers)
    assert found.counts["done"] == 3
    assert results(place / "out") == before
    assert set(plan_joint_jobs(jobs, place / "out").values()) == {"done"}


def test_an_ordinary_batch_continues_with_a_second_pass(pool, whole, tmp_path):
    place, jobs, _ = whole
    run_batch(jobs, tmp_path / "out", pool)
    assert plan_joint_jobs(jobs, tmp_path / "out")["A0"] == "to do: second fit"
    events: list[tuple[str, str]] = []
    run_joint_batch(jobs, tmp_path / "out", pool, tell=lambda p: events.append((p.part, p.event)))
    assert {part for part, event in events if "done in" in event} == {"pass 2 of 2"}
    assert prior_in(tmp_path / "out", "A0") == prior_in(place / "out", "A0")


def test_an_interrupted_second_pass_keeps_first_fits_and_continues(pool, tmp_path):
    """The third key stops the batch: two keys have second fits then, and the third its first."""
    jobs = library(tmp_path / "in", ["one", "two", "stop"])
    with pytest.raises(OutputError):
        run_joint_batch(jobs, tmp_path / "out", pool)
    priors = {job.key: prior_in(tmp_path / "out", job.key) for job in jobs}
    assert priors["B0"] is None
    assert priors["A0"] is not None
    mended, events = _with_file(jobs, "B0", tmp_path / "in"), []
    run_joint_batch(mended, tmp_path / "out", pool, tell=lambda p: events.append((p.part, p.event)))
    assert prior_in(tmp_path / "out", "B0") is not None


def _with_file(jobs: list[Job], key: str, folder: Path) -> list[Job]:
    """The jobs after the recording of one key was replaced by a good one."""
    shutil.rmtree(folder)
    texts = ["one", "two", "good"]
    found = library(folder, texts)
    assert [job.key for job in found] == [job.key for job in jobs]
    assert found[-1].key == key
    return found


def test_a_changed_key_changes_the_priors_of_all_others(pool, whole, tmp_path):
    place, _, _ = whole
    shutil.copytree(place / "out", tmp_path / "out")
    jobs, events = library(tmp_path / "in", ["one", "two", "three 1.2"]), []
    run_joint_batch(jobs, tmp_path / "out", pool, tell=lambda p: events.append((p.part, p.event)))
    done = [(part, event.split(":")[0]) for part, event in events if "done in" in event]
    assert done == [("pass 1 of 2", "B0"), ("pass 2 of 2", "A0"), ("pass 2 of 2", "As0"), ("pass 2 of 2", "B0")]
    # Its own prior comes from the other keys alone.
    assert prior_in(tmp_path / "out", "B0") == prior_in(place / "out", "B0")
    assert prior_in(tmp_path / "out", "A0") != prior_in(place / "out", "A0")


def test_a_key_without_a_second_fit_keeps_its_first(pool, tmp_path):
    jobs = library(tmp_path / "in", ["one", "two", "no-second", "refuse is silent"])
    found = run_joint_batch(jobs, tmp_path / "out", pool)
    assert {entry.key: entry.state for entry in found.keys} == {
        "A0": "done", "As0": "done", "B0": "failed", "C1": "failed",
    }  # fmt: skip
    assert prior_in(tmp_path / "out", "B0") is None
    assert not (tmp_path / "out/keys/C1").exists()


def test_instruments_are_separate_and_a_single_key_keeps_its_first_fit(pool, tmp_path):
    jobs = library(tmp_path / "in", TEXTS)
    names = "grand", "grand", "upright"
    jobs = [replace(job, key=f"{name}-{job.key}") for job, name in zip(jobs, names, strict=True)]
    events: list[str] = []
    run_joint_batch(jobs, tmp_path / "out", pool, tell=lambda p: events.append(p.event))
    assert prior_in(tmp_path / "out", "grand-A0") is not None
    assert prior_in(tmp_path / "out", "upright-B0") is None
    assert any("upright-B0" in event for event in events if "done" not in event)
    with pytest.raises(SetupError, match="two keys"):
        run_joint_batch(jobs[1:], tmp_path / "other", pool)
    assert not (tmp_path / "other").exists()


def test_a_library_of_one_key_is_refused_in_one_line(tmp_path, capsys):
    from batch_cases import struck

    struck(tmp_path / "C4.wav", 60, 2.0)
    assert main(["batch", str(tmp_path), "--pattern", "{note}.wav", "--joint", "--out", str(tmp_path / "out")]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert "--joint" in line
    assert not (tmp_path / "out").exists()


def test_the_setup_of_a_job_has_its_prior(whole, tmp_path):
    place, jobs, _ = whole
    prior = prior_in(place / "out", "A0")
    assert prior is not None
    job = replace(jobs[0], prior=prior.to_toml(), settings=replace(jobs[0].settings, setup="string.length = 1.0\n"))
    assert Setup.from_dict(tomllib.loads(job.setup)).prior == prior
    assert job.hash != replace(job, prior="").hash
