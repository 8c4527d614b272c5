"""The examples run and print what they should, and public names lead somewhere. The site runs the gallery."""

from __future__ import annotations

import re
import runpy
import subprocess
import sys
from pathlib import Path

import pytest
import soundfile

import pianofit

# Rooms that an example or a page of the gallery is about.
ROOMS = ("instrument", "playback", "synthetic")
ROOT = Path(__file__).parent.parent
EXAMPLES = ROOT / "examples"
PROGRAMS = sorted([*EXAMPLES.glob("*.py"), *(ROOT / "docs" / "gallery").glob("*.py")])


def printed(name: str, monkeypatch, capsys, *arguments: str) -> str:
    """What an example prints, run as a program."""
    monkeypatch.setattr(sys, "argv", [name, *arguments])
    runpy.run_path(str(EXAMPLES / name), run_name="__main__")
    return capsys.readouterr().out


def test_every_example_is_tested():
    here = Path(__file__).read_text(encoding="utf-8")
    assert all(f'"{file.name}"' in here for file in EXAMPLES.glob("*.py"))


def test_a_pluck_is_heard_and_its_point_found_again(monkeypatch, capsys, tmp_path):
    monkeypatch.chdir(tmp_path)
    text = printed("03_pluck.py", monkeypatch, capsys)
    rows = re.findall(r"^(\w+) +(\S+) +(\S+) m$", text, re.MULTILINE)
    assert [row[0] for row in rows] == ["pluck", "width"]
    for (_, true, found), off in zip(rows, (0.001, 0.05), strict=True):
        assert float(found) == pytest.approx(float(true), rel=off)
    samples, rate = soundfile.read("pluck.wav")
    assert len(samples) == pytest.approx(3.1 * rate, abs=1)
    assert 0.4 < abs(samples).max() <= 0.5


@pytest.mark.parametrize("file", PROGRAMS, ids=lambda file: file.name)
def test_examples_use_public_names_only(file):
    text = file.read_text(encoding="utf-8")
    inner = set(re.findall(r"^(?:from|import) (pianofit\.\S+)", text, re.MULTILINE))
    assert inner <= {f"pianofit.{room}" for room in ROOMS}
    assert {*re.findall(r"\bpianofit\.(\w+)", text)} - {room.split(".")[0] for room in ROOMS} <= {*pianofit.__all__}


def test_a_prelude_is_played(monkeypatch, capsys, tmp_path):
    monkeypatch.chdir(tmp_path)
    text = printed("04_play.py", monkeypatch, capsys)
    assert re.search(r"^192 notes, 1\d\d of them on a string that still sounds$", text, re.MULTILINE)
    assert abs(soundfile.read("prelude.wav")[0]).max() <= 10 ** (-1 / 20) + 1e-6


@pytest.mark.parametrize("name", pianofit.__all__)
def test_a_public_name_leads_somewhere(name):
    value = getattr(pianofit, name)
    assert value is getattr(pianofit, name)
    assert name in dir(pianofit)
    if hasattr(value, "__module__"):
        assert value.__module__.startswith("pianofit.")
        assert value.__name__ == name
        assert value.__doc__


def test_names_that_are_not_public_are_refused():
    with pytest.raises(AttributeError, match="has no attribute 'fit_everything'"):
        _ = pianofit.fit_everything  # type: ignore[attr-defined]


def test_every_error_is_public():
    from pianofit import errors

    kinds = {name for name, value in vars(errors).items() if name.endswith("Error") and isinstance(value, type)}
    assert len(kinds) > 5
    assert kinds <= set(pianofit.__all__)


def test_the_door_opens_without_jax():
    code = "import sys, pianofit as p; p.load_recording, p.preset, p.Setup.from_toml; print('jax' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "False\n"
