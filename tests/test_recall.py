"""A loaded fit: its content without the recording, and all of it with the original file."""

from __future__ import annotations

import dataclasses
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from twin_cases import FIRST, record_model

import pianofit
from pianofit.errors import FitError
from pianofit.schema.decode import builtins_of


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> tuple[pianofit.Result, Path]:
    """The fit of a file, with a modal response, and the folder that it was saved to."""
    place = tmp_path_factory.mktemp("recall")
    recording = record_model(FIRST, quantity="bridge-force", seconds=1.5)
    (place / "note.wav").write_bytes(pianofit.encode_wav(recording.samples, recording.rate))
    setup = pianofit.Setup(length=FIRST.geometry.length, mass=FIRST.geometry.mass)
    result = pianofit.fit(place / "note.wav", setup=setup, progress=False)
    return result, result.save(place / "fit", page=False)


def copied(folder: Path, name: str, document: dict) -> Path:
    """A copy of the folder with another document."""
    place = shutil.copytree(folder, folder.with_name(name), dirs_exist_ok=True)
    (place / "fit.json").write_text(json.dumps(document))
    return place


def alike(one: np.ndarray, other: np.ndarray, share: float = 1e-9) -> None:
    """Compare relative to the largest value."""
    np.testing.assert_allclose(one, other, atol=share * np.nanmax(np.abs(other)), rtol=1e-9)


def test_what_needs_no_recording_is_shown_without_it(made, monkeypatch):
    plt = pytest.importorskip("matplotlib.pyplot")
    plt.switch_backend("Agg")
    result, folder = made
    back = pianofit.Result.load(folder)
    monkeypatch.setattr("pianofit.result.result.reload_recordings", None)  # not to be called
    for name in ("force", "levels", "felt", "correlations"):
        mine, fresh = (getattr(one.plot, name)() for one in (back, result))
        assert mine.has_data()
        for line, other in zip(mine.lines, fresh.lines, strict=True):
            alike(np.array(line.get_ydata()), np.array(other.get_ydata()))
        for image, other in zip(mine.images, fresh.images, strict=True):
            alike(image.get_array(), other.get_array())
    plt.close("all")


def test_with_its_recording_it_is_the_result_that_was_saved(made):
    result, folder = made
    back = pianofit.Result.load(folder)
    assert back.recordings == ()
    whole = back.with_recordings()
    assert whole.with_recordings() is whole
    one, other = whole.reference, result.reference
    for name in ("samples", "frames"):
        np.testing.assert_array_equal(getattr(one.recording, name), getattr(other.recording, name))
    for field in dataclasses.fields(one.analysis.partials):
        np.testing.assert_array_equal(getattr(one.partials, field.name), getattr(other.partials, field.name))
    for mine, theirs in ((one.initial, other.initial), (one.fitted, other.fitted), (one.final, other.final)):
        alike(mine.samples, theirs.samples, 1e-6)
    for field in dataclasses.fields(one.compared):
        alike(getattr(one.compared, field.name), getattr(other.compared, field.name))
    assert (one.criterion, one.levels) == (other.criterion, other.levels)
    assert builtins_of(whole.fit) == builtins_of(result.fit)
    assert (one.with_modes is None) == (other.with_modes is None)
    assert back.recording is back.recording, "read once"
    assert back.plot.spectrum().has_data()
    # A moved file is accepted. An array of its samples is not, since its SHA-256 differs.
    moved = Path(other.recording.path).with_name("moved.wav")
    moved.write_bytes(Path(other.recording.path).read_bytes())
    assert back.with_recordings(moved).recording.path == str(moved)
    with pytest.raises(FitError, match="SHA-256"):
        back.with_recordings((other.recording.samples, other.recording.rate))
    with pytest.raises(FitError, match="2 recordings"):
        back.with_recordings(moved, moved)


def test_a_file_that_is_missing_or_was_changed_is_named(made):
    result, folder = made
    path = Path(result.recording.path)
    data = path.read_bytes()
    try:
        path.write_bytes(data[:-400] + bytes(400))
        with pytest.raises(FitError, match=r"note\.wav: .*SHA-256"):
            pianofit.Result.load(folder).plot.spectrum()
        path.unlink()
        back = pianofit.Result.load(folder)
        for call in (back.plot.envelopes, lambda: back.report(folder), lambda: back.save(folder / "new")):
            with pytest.raises(FitError, match=r"note\.wav: no such file"):
                call()
        assert back.plot.force().has_data()
        again = back.save(folder.with_name("copied"), page=False)
        assert {f.name: f.read_bytes() for f in again.iterdir()} == {f.name: f.read_bytes() for f in folder.iterdir()}
    finally:
        path.write_bytes(data)


def test_a_fit_that_was_read_back_is_saved_with_its_page(made):
    _, folder = made
    again = pianofit.Result.load(folder).save(folder.with_name("page"))
    assert (again / "fit.json").read_bytes() == (folder / "fit.json").read_bytes()
    assert (again / "report.html").stat().st_size > 1e5
    one, other = (pianofit.load_recording(place / "fitted.wav").samples for place in (again, folder))
    alike(one, other, 1e-5)


def test_missing_levels_and_initial_values_are_named(made):
    _, folder = made
    document = json.loads((folder / "fit.json").read_text())
    (row,) = document["recordings"]
    with pytest.raises(FitError, match=r"recordings\[0\]\.partials = None must be a table"):
        pianofit.Result.load(copied(folder, "incomplete", document | {"recordings": [{**row, "partials": None}]}))
    row["stroke_initial"] = None
    back = pianofit.Result.load(copied(folder, "incomplete", document))
    with pytest.raises(FitError, match="initial v_H0"):
        back.plot.force()


def test_a_minimum_without_a_parameter_is_refused(made):
    _, folder = made
    document = json.loads((folder / "fit.json").read_text())
    best = document["minima"][0]
    other = best | {"parameters": {name: x for name, x in best["parameters"].items() if name != "c"}}
    with pytest.raises(FitError, match=r"minima\[1\]\.parameters\.c is missing"):
        pianofit.Result.load(copied(folder, "lacking", document | {"minima": [best, other]}))


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("stroke_value", "fast"),
        ("stroke_value", 1e9),
        ("pitch_offset_cents", 1e6),
        ("gain", None),
        ("pitch_offset_cents", 1e200),
    ],
)
def test_a_hostile_row_is_refused(made, key, value):
    _, folder = made
    document = json.loads((folder / "fit.json").read_text())
    (row,) = document["recordings"]
    document["recordings"].append(row | {"is_reference": False, key: value})
    place = copied(folder, "hostile", document)
    with pytest.raises(FitError, match=r"fit\.json: recordings\[1\]"):
        pianofit.Result.load(place)
