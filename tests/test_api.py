"""What `help()` and the API reference say: complete, its examples run, its references lead somewhere."""

from __future__ import annotations

import dataclasses
import doctest
import inspect
import io
import pydoc
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import mido
import numpy as np
import pytest
import soundfile
from instrument_cases import ERRORS, fit_document, true_note, write_fit

import pianofit

ROOT = Path(__file__).parent.parent
FUNCTIONS = [name for name in pianofit.__all__ if inspect.isfunction(getattr(pianofit, name))]
CLASSES = [name for name in pianofit.__all__ if inspect.isclass(getattr(pianofit, name))]
# What takes minutes is run elsewhere, in `tests/test_fit_recordings.py` and `tests/test_batch_fit.py`.
TOO_LONG = {"cross_validate", "fit_library"}
# `word`, `Word.word`; file names, which end as these do, are none.
REFERENCE = re.compile(r"(?<!`)`([A-Za-z_]\w*(?:\.[A-Za-z_]\w*)*)`(?!`)")
FILES = ("json", "toml", "wav", "html")


def documented() -> Iterator[tuple[str, str]]:
    """Public objects and their public members, with their docstrings."""
    for name in FUNCTIONS + CLASSES:
        thing = getattr(pianofit, name)
        yield name, inspect.getdoc(thing) or ""
        for member, value in vars(thing).items() if inspect.isclass(thing) else ():
            code = value.fget if isinstance(value, property) else getattr(value, "__func__", value)
            if not member.startswith("_") and inspect.isfunction(code):
                yield f"{name}.{member}", inspect.getdoc(code) or ""


DOCUMENTED = dict(documented())


def sections(text: str) -> dict[str, str]:
    """A docstring's sections, in NumPy's form, by their titles."""
    parts = re.split(r"^(\w+)\n-+\n", text, flags=re.MULTILINE)
    return dict(zip(parts[1::2], parts[2::2], strict=True))


def test_everything_public_has_a_docstring():
    assert [name for name, text in DOCUMENTED.items() if not text] == []


@pytest.mark.parametrize("name", FUNCTIONS)
def test_help_gives_arguments_returns_errors_and_an_example(name):
    found = sections(DOCUMENTED[name])
    assert set(found) >= {"Parameters", "Returns", "Raises", "Examples"}
    assert ">>>" in found["Examples"]
    listed = {
        word.strip()
        for line in re.findall(r"^(\w[\w, ]*) :", found["Parameters"], re.MULTILINE)
        for word in line.split(",")
    }
    assert listed == set(inspect.signature(getattr(pianofit, name)).parameters)
    assert {*re.findall(r"^(\w+)$", found["Raises"], re.MULTILINE)} <= {*CLASSES, "PianofitError"}


def test_the_examples_run(tmp_path, monkeypatch):
    """In one folder with a batch of two keys and a song; others go on from what `fit` and `write_instrument` save."""
    monkeypatch.chdir(tmp_path)
    for midi in (60, 64):
        write_fit(Path("batch"), midi, fit_document(true_note(midi), ERRORS), "cp80")
    track = mido.MidiTrack()
    for note in (60, 64, 67, 60):
        track += [mido.Message("note_on", note=note, velocity=80), mido.Message("note_off", note=note, time=120)]
    mido.MidiFile(tracks=[track]).save("melody.mid")
    runner = doctest.DocTestRunner()
    first = ["fit", "write_instrument"]
    order = [*first, *(name for name in DOCUMENTED if name not in {*first, *TOO_LONG})]
    ran = []
    for name in order:
        test = doctest.DocTestParser().get_doctest(DOCUMENTED[name], {}, name, None, None)
        if test.examples:
            assert runner.run(test).failed == 0, name
            ran.append(name)
    assert {*FUNCTIONS} - TOO_LONG <= {*ran}


@pytest.mark.parametrize("samples", [np.zeros((44, 2)), np.zeros((1, 2, 3)), [1, 2]])
def test_what_is_no_row_of_floats_is_no_sound(samples):
    with pytest.raises(pianofit.ParameterError, match=r"samples of shape .* must be floats \[samples\]"):
        pianofit.encode_wav(np.array(samples), 44_100)


def test_every_channel_is_written():
    samples = np.random.default_rng(0).uniform(-2.0, 2.0, (2, 100))
    read, rate = soundfile.read(io.BytesIO(pianofit.encode_wav(samples, 48_000)))
    assert rate == 48_000
    np.testing.assert_array_equal(read.T, samples.astype(np.float32))


def leads_somewhere(reference: str, of: str) -> bool:
    """Whether a reference in the docstring `of` names something public, an argument, a field, a module or a value."""
    first, *rest = reference.split(".")
    if first in pianofit.__all__:
        return all(has(getattr(pianofit, first), name) for name in rest)
    return has(getattr(pianofit, of.partition(".")[0]), first) or pydoc.locate(reference) is not None


def has(thing: Any, name: str) -> bool:
    """Whether a class has a member or a field of that name."""
    fields = dataclasses.fields(thing) if dataclasses.is_dataclass(thing) else ()
    return hasattr(thing, name) or name in {field.name for field in fields}


@pytest.mark.parametrize("name", DOCUMENTED)
def test_references_lead_somewhere(name):
    """Names of classes, of members, and what "see" points at; other words in backticks may be arguments and values."""
    text = DOCUMENTED[name]
    pointed = set(re.findall(r"\b(?:[Ss]ee|as in|[Aa]s) `(\w+)`", text))
    found = [
        word
        for word in REFERENCE.findall(text)
        if "." in word or word in pointed or (word[:1].isupper() and word[1:2].islower())
    ]
    broken = [word for word in found if word.rpartition(".")[2] not in FILES and not leads_somewhere(word, name)]
    assert broken == []
