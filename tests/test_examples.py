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


def test_plucks_are_fitted_and_their_places_found_again(monkeypatch, capsys, tmp_path):
    monkeypatch.chdir(tmp_path)
    text = printed("03_pluck.py", monkeypatch, capsys)
    rows = re.findall(r"^(\w+(?: \d)?) +(\S+) +(\S+) +(\S+)$", text, re.MULTILINE)
    assert [row[0] for row in rows] == ["c", "kappa", "b1", "b2", "pickup", "x0 1", "x0 2", "x0 3"]
    for name, *numbers in rows:
        true, low, high = map(float, numbers)
        assert low * (1 - 1e-5) <= true <= high * (1 + 1e-5), name
        assert high < 1.01 * low
    assert "width: not-identifiable" in text
    error, position = map(float, re.search(r"left out: (\S+) dB at x0 = (\S+) m", text).groups())
    assert error < 0.5
    assert position == pytest.approx(0.18, rel=0.005)
    samples, rate = soundfile.read("pluck-1.wav")
    assert len(samples) == pytest.approx(2.1 * rate, abs=1)
    assert Path("pluck/report.html").exists()


def test_the_model_is_differentiated_in_pytorch(monkeypatch, capsys):
    pytest.importorskip("torch")
    text = printed("08_pytorch.py", monkeypatch, capsys)
    assert "gradients agree with differences: True" in text
    losses = [float(x) for x in re.findall(r"^step +\d+: +(\S+) dB²$", text, re.MULTILINE)]
    assert losses[-1] < 0.01 * losses[0]


def test_pytorch_is_asked_for_where_it_is_missing(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "torch", None)
    with pytest.raises(SystemExit, match="pip install torch"):
        printed("08_pytorch.py", monkeypatch, capsys)


def test_a_network_learns_from_notes_and_starts_a_fit(monkeypatch, capsys):
    text = printed("09_train_a_network.py", monkeypatch, capsys)
    rows = re.findall(r"^(\w+) +spread (\S+), error (\S+) ", text, re.MULTILINE)
    spread, error = ({name: float(x[at]) for name, *x in rows} for at in (0, 1))
    assert error["b1"] < 0.5 * spread["b1"]
    assert error["M_H"] < 0.75 * spread["M_H"]
    assert error["v_H0"] < spread["v_H0"]
    low, high, true = map(float, re.search(r"fitted \S+ \((\S+), (\S+)\), true (\S+) kg$", text, re.M).groups())
    assert low < true < high


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
