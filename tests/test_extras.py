"""What needs an extra says so in one line where it is missing, before anything is read or written."""

from __future__ import annotations

import re
import sys
import tomllib
from pathlib import Path

import pytest

from pianofit.cli import main

FIT = ["fit", "note.wav", "--note", "F3", "--intervals", "posterior", "--out", "out"]
BATCH = ["batch", "library", "--pattern", "{instrument}-{note}.wav", "--scheduler", "tcp://127.0.0.1:9", "--out", "out"]


@pytest.mark.parametrize(
    ("package", "extra", "command"), [("blackjax", "bayes", FIT), ("distributed", "cluster", BATCH)]
)
def test_a_command_names_the_extra_that_it_lacks(package, extra, command, tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, package, None)
    monkeypatch.chdir(tmp_path)
    library = tmp_path / "library"
    library.mkdir()
    for file in (tmp_path / "note.wav", library / "one-F3.wav"):
        file.write_bytes(b"")  # never read
    assert main(command) == 1
    said = capsys.readouterr()
    assert not said.out
    (line,) = said.err.splitlines()
    assert line.endswith(f"which is not installed; pip install 'pianofit[{extra}]'")
    assert not (tmp_path / "out").exists()


def test_every_extra_of_a_message_exists():
    root = Path(__file__).parents[1]
    extras = tomllib.loads((root / "pyproject.toml").read_text(encoding="utf-8"))["project"]["optional-dependencies"]
    code = "".join(file.read_text(encoding="utf-8") for file in (root / "src").rglob("*.py"))
    named = set(re.findall(r'optional\(.*"(\w+)", ParameterError\)', code))
    assert {*named, "notebook"} == set(extras) - {"bench", "dev", "docs", "release", "test"}
