"""`pianofit.fit`: recordings and a setup in any form, invalid arguments, and progress."""

from __future__ import annotations

import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import pianofit
from pianofit import bensa2005
from pianofit.errors import AnalysisError, FitError, ParameterError, PianofitError, RecordingError, SetupError
from pianofit.progress import progress_bar

RATE = 44_100
TIME = np.arange(RATE) / RATE
PARTIALS = sum(np.exp(-3 * TIME) * np.sin(2 * np.pi * 440.0 * k * TIME) / k for k in range(1, 9))
NOISE = 1e-4 * np.random.default_rng(0).standard_normal(RATE + 4410)
# Rounded to 32 bit floats, as in a file.
SAMPLES = (np.pad(0.3 * PARTIALS, (4410, 0)) + NOISE).astype(np.float32).astype(float)
TABLES = {"string": {"length": 0.4}, "fixed": {"M_H": 5e-3}, "recording": [{"v_H0": 2.0}]}
TEXT = "[string]\nlength = 0.4\n[fixed]\nM_H = 5e-3\n[[recording]]\nv_H0 = 2.0\n"


@pytest.fixture
def asked(monkeypatch) -> list[SimpleNamespace]:
    """Arguments of the inference, which is not run."""
    calls: list[SimpleNamespace] = []

    def estimator(recordings, analyses, setup, **more: Any) -> str:
        calls.append(SimpleNamespace(recordings=recordings, analyses=analyses, setup=setup, **more))
        return "fitted"

    monkeypatch.setattr("pianofit.inference.run_inference", estimator)
    monkeypatch.setattr("pianofit.result.build_result", lambda found: found)
    monkeypatch.setattr("pianofit.modal_response.fit_modal_response", lambda found, _: found)
    return calls


@pytest.fixture
def file(tmp_path) -> Path:
    (tmp_path / "a.wav").write_bytes(pianofit.encode_wav(SAMPLES, RATE))
    return tmp_path / "a.wav"


def test_a_recording_comes_in_any_form(asked, file):
    for source in (file, str(file), (SAMPLES, RATE), pianofit.load_recording(file)):
        assert pianofit.fit(source, note="A4") == "fitted"
    first, *others = asked
    for other in others:
        np.testing.assert_array_equal(other.recordings[0].samples, first.recordings[0].samples)
        np.testing.assert_array_equal(other.analyses[0].partials.level, first.analyses[0].partials.level)
        assert other.analyses[0].f0 == first.analyses[0].f0


def test_an_analysis_takes_what_a_fit_takes(file):
    first, *others = (
        pianofit.analyse(source, note="A4")
        for source in (file, str(file), (SAMPLES, RATE), pianofit.load_recording(file))
    )
    assert {other.f0 for other in others} == {first.f0}
    with pytest.raises(ParameterError, match=r"recording = 3\.0 must be a path"):
        pianofit.analyse(3.0, note="A4")  # pyright: ignore[reportArgumentType]


def test_several_come_together_and_analyses_may_be_given(asked, file):
    recording = pianofit.load_recording(file)
    analysis = pianofit.analyse(recording, f0=440.0)
    pianofit.fit(file, recording, (0.5 * SAMPLES, RATE), analyses=[analysis] * 3, seed=3, intervals="profile")
    (call,) = asked
    assert [r.path for r in call.recordings] == [str(file), str(file), "recording 3"]
    assert all(a is analysis for a in call.analyses)
    assert (call.seed, call.intervals, call.velocity) == (3, "profile", None)


def test_what_was_known_comes_in_any_form(asked, file):
    path = file.with_name("setup.toml")
    path.write_text(TEXT)
    same = pianofit.Setup(length=0.4, fixed={"M_H": 5e-3}, recordings=(pianofit.RecordingInfo(v_H0=2.0),))
    for setup in (path, str(path), TABLES, same):
        pianofit.fit(file, note="A4", setup=setup)
    pianofit.fit(file, note="A4")
    assert [call.setup for call in asked] == [same] * 4 + [pianofit.Setup()]


@pytest.mark.parametrize(
    ("arguments", "options", "error", "named"),
    [
        ((), {}, ParameterError, "no recording"),
        (([(SAMPLES, RATE)],), {}, ParameterError, "recording 1 = "),
        ((3.0,), {}, ParameterError, "recording 1 = 3.0 must be a path"),
        (("none.wav",), {}, RecordingError, "none.wav: no such file"),
        (((SAMPLES.astype(int), RATE),), {}, RecordingError, "recording 1: int64"),
        (((SAMPLES, RATE),), {"note": "H9"}, PianofitError, "H9"),
        (((SAMPLES, RATE),), {"note": "A1"}, AnalysisError, "A1"),
        (((SAMPLES, RATE),), {"velocity": 1000}, ParameterError, "velocity=1000"),
        (((SAMPLES, RATE),) * 2, {"velocity": 1.0}, ParameterError, "[[recording]]"),
        (((SAMPLES, RATE),), {"seed": -1}, ParameterError, "seed=-1"),
        (((SAMPLES, RATE),), {"seed": 1.5}, ParameterError, "seed=1.5"),
        (((SAMPLES, RATE),), {"analyses": []}, ParameterError, "0 analyses"),
        (((SAMPLES, RATE),), {"intervals": "guess"}, ParameterError, "intervals='guess'"),
        (((SAMPLES, RATE),), {"setup": {"fixed": {"KH": 1e9}}}, SetupError, 'setup: [fixed] "KH" is not known'),
        (((SAMPLES, RATE),), {"setup": "none.toml"}, SetupError, "none.toml: no such file"),
        (((SAMPLES, RATE),), {"velocity": 3.0, "setup": {"bounds": {"v_H0": [1, 2]}}}, SetupError, "velocity=3.0"),
    ],
)
def test_what_cannot_be_used_is_refused(asked, arguments, options, error, named):
    with pytest.raises(error) as caught:
        pianofit.fit(*arguments, **options)
    assert named in str(caught.value)
    assert not asked


def test_the_papers_method_takes_the_velocity_of_the_recording_it_fits(file, monkeypatch):
    seen: list[float | None] = []

    def starting_values(_, __: pianofit.Setup, velocity: float | None) -> None:
        seen.append(velocity)
        raise FitError

    monkeypatch.setattr("pianofit.bensa2005.method.starting_values", starting_values)
    for name, given in (("a.wav", None), ("b.wav", None), (None, None), ("a.wav", 3.0)):
        setup = pianofit.Setup(recordings=(pianofit.RecordingInfo(name, v_H0=2.0),))
        with pytest.raises(FitError):
            bensa2005.fit(file, note="A4", setup=setup, velocity=given)
    assert seen == [2.0, None, 2.0, 3.0]


def test_progress_goes_where_it_is_asked_to(asked, file, capsys, monkeypatch):
    seen: list[str] = []
    pianofit.fit(file, note="A4", progress=lambda stage, _: seen.append(stage))
    assert seen == ["reading", "partials", "sounds"]
    pianofit.fit(file, note="A4")
    assert capsys.readouterr().err == "", "no output without a terminal or a notebook"
    monkeypatch.setitem(sys.modules, "ipykernel", SimpleNamespace())
    pianofit.fit(file, note="A4")
    assert "partials" in capsys.readouterr().err
    pianofit.fit(file, note="A4", progress=False)
    assert capsys.readouterr().err == ""


def test_a_terminal_has_a_bar(capsys, monkeypatch):
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    monkeypatch.setenv("TERM", "xterm")
    with progress_bar() as report:
        report("hammer", 0.5)
    assert "hammer" in capsys.readouterr().err


def test_a_record_with_numbers_of_numpy_has_a_repr():
    assert "v_H0" in repr(pianofit.RecordingInfo(v_H0=np.float64(2.0)))
