"""The wheel holds the package and nothing else, and the files of a release agree with it."""

from __future__ import annotations

import importlib.util
import re
import zipfile
from pathlib import Path

import pytest

import pianofit

ROOT = Path(__file__).parent.parent


def contents():
    """Return the program that checks a release."""
    spec = importlib.util.spec_from_file_location("contents", ROOT / ".ci" / "contents.py")
    assert spec
    assert spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_wheel_holds_the_package_and_nothing_else(tmp_path):
    wheels = pytest.importorskip("hatchling.builders.wheel", reason="needs hatchling: pip install 'pianofit[test]'")
    (wheel,) = wheels.WheelBuilder(str(ROOT)).build(directory=str(tmp_path), versions=["standard"])
    names = zipfile.ZipFile(wheel).namelist()
    assert contents().differences(names) == []
    assert contents().differences([*names[1:], "tests/secret.py"]) == [
        "tests/secret.py is not part of the package",
        f"{names[0]} is missing in the wheel",
    ]


def test_the_citation_names_this_version():
    text = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    assert re.findall(r"^version: (\S+)$", text, re.MULTILINE) == [pianofit.__version__]
