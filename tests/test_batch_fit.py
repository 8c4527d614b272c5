"""Batches of real fits through the command line, with one key for each kind of error in a library."""

from __future__ import annotations

import json
import tomllib
from pathlib import Path

import numpy as np
import pytest
from batch_cases import CLI, python, results, struck

from pianofit.batch import Job, ProcessPool, Settings, make_job, read_keys
from pianofit.batch.fit_job import JobResult, _of_another_key, _wrong_note
from pianofit.cli import main
from pianofit.cli.fits import setup_of_options
from pianofit.errors import SetupError
from pianofit.io.files import encode_wav
from pianofit.library import fit_library, library_settings
from pianofit.setup import Setup

PATTERN = "{instrument}-{note}-{layer}.wav"


def in_a_worker(job: Job, folder: Path) -> JobResult:
    """Fit in a process with one thread, as a batch does."""
    with ProcessPool(1, 2**32, 300.0, folder / "scratch") as worker:
        worker.submit(job)
        while not (found := worker.finished(1.0)):
            pass
    assert isinstance(found[0][1], JobResult)
    return found[0][1]


@pytest.fixture
def run_here(capsys):
    """Run the command line in this process."""

    def run_here(*arguments: object) -> tuple[int, str, str]:
        code = main([str(argument) for argument in arguments])
        return code, *capsys.readouterr()

    return run_here


def run(*arguments: object) -> tuple[int, str, str]:
    process = python(CLI, *arguments)
    output, errors = process.communicate(timeout=300)
    return process.returncode, output, errors


@pytest.fixture(scope="module")
def batch(tmp_path_factory):
    """A batch with a good key, a key under a wrong name, and a key of noise."""
    place = tmp_path_factory.mktemp("batch")
    (place / "in").mkdir()
    for velocity, layer in ((1.0, "p"), (3.0, "f")):
        struck(place / f"in/grand-C4-{layer}.wav", 60, velocity)
        struck(place / f"in/grand-F4-{layer}.wav", 69, velocity)
    noise = np.random.default_rng(1).normal(0.0, 0.1, 30_000)
    (place / "in/grand-D4-noise.wav").write_bytes(encode_wav(noise, 22_050))
    command = ("batch", place / "in", "--pattern", PATTERN, "--out", place / "out", "--no-page", "--processes", 1)
    return place, command, run(*command)


def test_what_went_wrong_is_told_and_the_rest_is_done(batch):
    place, _, (code, output, errors) = batch
    assert code == 3, errors
    lines = output.splitlines()
    assert lines[0] == "1 done, 2 failed of 3 keys"
    failed = {line.split(": ")[1]: line for line in lines if line.startswith("failed: ")}
    assert ": grand-D4-noise.wav: " in failed["grand-D4"]
    assert "none of its 2 recordings" in failed["grand-F4"]
    assert "A4" in failed["grand-F4"]
    assert any(line.startswith("grand-F4: ") and "A4" in line for line in lines)
    # Without a terminal, one line for every key that ends.
    assert [line.split(": ")[:2] for line in errors.splitlines()] == [
        ["1 of 3 keys", "grand-C4"], ["2 of 3 keys", "grand-D4"], ["3 of 3 keys", "grand-F4"]
    ]  # fmt: skip
    for name in ("keys.csv", "index.html"):
        assert str(place) not in (place / "out" / name).read_text(encoding="utf-8")
    assert set(results(place / "out")) == {"grand-C4"}
    assert {"fit.json", "fitted.wav", "initial.wav"} <= set(results(place / "out")["grand-C4"])


def test_the_same_command_finds_nothing_to_do(batch, run_here):
    place, command, _ = batch
    before = (place / "out/keys/grand-C4/fit.json").stat().st_mtime_ns
    code, output, errors = run_here(*command, "--json")
    document = json.loads(output)
    assert (code, errors) == (3, "")
    assert document["counts"] == {"done": 1, "failed": 2, "running": 0, "waiting": 0}
    assert (place / "out/keys/grand-C4/fit.json").stat().st_mtime_ns == before


def test_python_finds_the_same_library_done(batch):
    """The jobs of `fit_library` are those of the command, so that nothing is left to do."""
    place, _, _ = batch
    before, events = (place / "out/keys/grand-C4/fit.json").stat().st_mtime_ns, []
    found = fit_library(place / "in", place / "out", pattern=PATTERN, page=False, processes=1, tell=events.append)
    assert found.counts == {"done": 1, "failed": 2, "running": 0, "waiting": 0}
    assert (place / "out/keys/grand-C4/fit.json").stat().st_mtime_ns == before
    with pytest.raises(SetupError, match="does not apply"):
        fit_library(place / "in/grand-C4-p.wav", place / "other", pattern=PATTERN)
    assert not (place / "other").exists()


def test_its_status_and_its_plan(batch, run_here):
    place, command, _ = batch
    code, output, _ = run_here("status", place / "out", "--json")
    document = json.loads(output)
    assert code == 0
    assert (document["at_work"], document["counts"]["failed"]) == (False, 2)
    assert [k["detected_note"] for k in document["keys"]] == ["", "", "A4"]
    code, output, _ = run_here(*command, "--dry-run", "--retry-failed", "--seed", 3)
    assert code == 0
    key, *files = output.splitlines()[:3]
    assert key == "grand-C4: C4, 2 recordings, to do: settings changed"
    assert [file.split() for file in files] == [
        [f"grand-C4-{layer}.wav", "layer", layer, "1", "channel,", "22050", "Hz"] for layer in "fp"
    ]
    assert "3 of 3 keys to do; nothing was written" in output


def test_recordings_that_cannot_be_used_are_left_out_and_told(batch, tmp_path):
    place, _, _ = batch
    for layer in "pf":
        (tmp_path / f"grand-C4-{layer}.wav").write_bytes((place / f"in/grand-C4-{layer}.wav").read_bytes())
    (tmp_path / "grand-C4-noise.wav").write_bytes((place / "in/grand-D4-noise.wav").read_bytes())
    (tmp_path / "grand-C4-text.wav").write_bytes(b"not a sound")
    struck(tmp_path / "grand-C4-sharp.wav", 61, 2.0)  # a semitone off
    struck(tmp_path / "grand-C4-octave.wav", 72, 2.0)
    (key,), _ = read_keys(tmp_path, pattern=PATTERN)
    outcome = in_a_worker(make_job(key, Settings(page=False)), tmp_path)
    assert outcome.error == ""
    reasons = {Path(row.file).stem.rpartition("-")[2]: row.reason for row in outcome.left_out}
    assert set(reasons) == {"noise", "text", "sharp", "octave"}
    assert "is text" in reasons["text"]
    assert "C#4" in reasons["sharp"]
    assert "C5" in reasons["octave"]
    assert not any(str(tmp_path) in reason for reason in reasons.values())
    document = json.loads(outcome.files["fit.json"])
    assert [t["file"] for t in document["recordings"]] == [str(tmp_path / f"grand-C4-{x}.wav") for x in "fp"]
    alone = json.loads((place / "out/keys/grand-C4/fit.json").read_bytes())
    assert document["parameters"] == alone["parameters"]  # the same numbers in another process
    assert "scratch" not in outcome.files["fit.json"].decode()  # the name of that folder differs in every run


@pytest.mark.parametrize(
    ("cents", "left_out"),
    [
        ([0, 2, -3], []),
        ([0, 2, -100], [2]),
        ([-100, 0], [0]),  # of two recordings, the one that agrees with the name is used
        ([0, 1, 99, 101], [2, 3]),
        ([0, 100, 100, 101], [1, 2, 3]),  # most recordings are of another key
        ([-45, -46, 55], [2]),  # a flat piano, and a layer of its next key within the tolerance of the name
        ([-55, -57, -61], []),  # on both sides of the tolerance, but one string
        ([100, 101, 99], []),  # all are of another key: the key fails, and no recording is left out
        ([0], []),
        ([], []),
    ],
)
def test_a_recording_of_another_key_is_the_one_that_most_others_contradict(cents, left_out):
    pitches = {Path(str(i)): 440.0 * 2 ** (c / 1200) for i, c in enumerate(cents)}
    assert sorted(int(path.name) for path in _of_another_key(pitches, "A4")) == left_out


def test_a_batch_leaves_out_what_a_fit_refuses():
    from pianofit.batch import fit_job
    from pianofit.inference import problem

    assert fit_job.MIN_PARTIALS == problem.FEWEST


def test_a_plan_names_every_file_and_why_one_was_not_read(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "in").mkdir()
    tone = 0.5 * np.sin(np.arange(22_050) / 10)
    for name, sound in {"C4_p": tone, "C4_f": np.stack([tone, tone]), "D4_p": np.stack([0.9 * tone, tone])}.items():
        (tmp_path / f"in/{name}.wav").write_bytes(encode_wav(sound, 22_050))
    (tmp_path / "in/E4_p.wav").write_bytes(encode_wav(tone, 44_100)[:-2])
    for name in ("noise.wav", "notes.txt"):
        (tmp_path / "in" / name).write_bytes(b"x")
    assert main(["batch", "in", "--out", "out", "--dry-run"]) == 0
    output, errors = capsys.readouterr()
    assert "{note}_{layer}" in errors
    mono = next(line for line in errors.splitlines() if "mono" in line)
    assert "C4_p.wav" in mono
    assert "C4_f.wav" not in mono
    assert "E4" not in mono
    lines = {line.split()[0]: line for line in output.splitlines()}
    assert "2 channels" in lines["C4_f.wav"]
    assert "truncated" in lines["E4_p.wav"]
    assert "pattern" in lines["noise.wav"]
    assert "AIFF" in lines["notes.txt"]
    assert "3 of 3 keys" in output
    assert not (tmp_path / "out").exists()
    main(["batch", "in", "--out", "out", "--dry-run", "--json"])
    document = json.loads(capsys.readouterr().out)
    assert [row["file"] for row in document["unread"]] == ["noise.wav", "notes.txt"]
    assert main(["batch", "in", "--out", "out", "--dry-run", "--channel", "1"]) == 0
    assert "mono" not in capsys.readouterr().err  # one channel of each recording is not a mixture


def test_a_name_is_wrong_from_a_semitone_on():
    c4 = 261.6256
    assert _wrong_note("C4", c4 * 2 ** (45 / 1200)) == ""
    assert _wrong_note("C4", c4 / 2 ** (55 / 1200)) == ""
    assert "+100 cents from it: C#4" in _wrong_note("C4", c4 * 2 ** (1 / 12))
    assert "-1200 cents from it: C3" in _wrong_note("C4", c4 / 2)


@pytest.mark.parametrize(
    ("arguments", "code", "named"),
    [
        (["--processes", "0"], 1, "--processes 0"),
        (["--memory", "0.1"], 1, "--memory 0.1"),
        (["--files", "post"], 2, "--files post"),
        (["--seed", "-1"], 1, "--seed -1"),
        (["--pattern", "{note}"], 1, "--pattern"),
        (["--setup", "takes.toml"], 1, "[[recording]]"),
        (["--scheduler", "nonsense"], 1, "--scheduler nonsense"),
    ],
)
def test_options_that_cannot_be_meant(tmp_path, monkeypatch, capsys, arguments, code, named):
    if "--scheduler" in arguments:
        pytest.importorskip("distributed")
    monkeypatch.chdir(tmp_path)
    (tmp_path / "a.wav").write_bytes(b"a")
    (tmp_path / "takes.toml").write_text('[[recording]]\nfile = "a.wav"\nv_H0 = 1.0\n')
    (tmp_path / "m.csv").write_text("file,note\na.wav,C4\n")
    assert main(["batch", "m.csv", "--out", "out", *arguments]) == code
    captured = capsys.readouterr()
    assert named in captured.err
    assert captured.err.count("\n") == 1
    assert captured.out == ""


def test_options_and_setup_make_one_setup(tmp_path):
    file = tmp_path / "setup.toml"
    assumed = ("power", "hammer", "bridge-force")

    def settings() -> Settings:
        return library_settings(setup_of_options(file, *assumed, None), str(file), joint=False)

    for text in ("[string]\nlength = 1.0\n", '[felt]\nlaw = "power"\n[string]\nlength = 1.0\n'):
        file.write_text(text)
        whole = Setup.from_dict(tomllib.loads(settings().setup))
        assert (whole.felt, whole.excitation, whole.pickup_quantity) == assumed
    file.write_text('[felt]\nlaw = "stulov"\n')
    with pytest.raises(SetupError, match=r"stulov.* contradicts .*power"):
        settings()
    file.write_text("[felt]\n")
    whole = Setup.from_dict(tomllib.loads(settings().setup))
    assert (whole.felt, whole.excitation, whole.pickup_quantity) == assumed
