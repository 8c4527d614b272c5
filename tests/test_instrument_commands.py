"""The commands of an instrument as a user runs them, its page, and files that nobody should trust."""

from __future__ import annotations

import copy
import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import mido
import numpy as np
import pytest
import soundfile
from instrument_cases import ERRORS, document_of, fit_document, library, true_note, uneven_note, write_fit
from typer.testing import CliRunner, Result

from pianofit.cli import app
from pianofit.errors import FitError
from pianofit.instrument import (
    Instrument,
    build,
    build_instrument,
    find_fits,
    load_instrument,
    load_keys,
    write_instrument,
)
from pianofit.instrument.collect_fits import partial_decays
from pianofit.instrument.page import write_page
from pianofit.model.modal_response import ModalResponse
from pianofit.parameters import PARAMETERS

KEYS = [30, 42, 54, 66, 78]


def run(*words: object) -> Result:
    return CliRunner().invoke(app, [str(word) for word in words])


@pytest.fixture(scope="module")
def fits(tmp_path_factory) -> Path:
    return library(tmp_path_factory.mktemp("batch"), KEYS)


@pytest.fixture(scope="module")
def piano(fits) -> Instrument:
    return build_instrument(load_keys(find_fits([fits])), "twin")


@pytest.fixture(scope="module")
def document(piano) -> dict[str, Any]:
    return document_of(piano)


@pytest.fixture(scope="module")
def built(piano, tmp_path_factory) -> Path:
    file = tmp_path_factory.mktemp("built") / "instrument.json"
    write_instrument(file, piano)
    return file


@pytest.fixture
def melody(tmp_path) -> Path:
    track = mido.MidiTrack()
    for note in (60, 64, 67, 60):
        track += [mido.Message("note_on", note=note, velocity=80), mido.Message("note_off", note=note, time=120)]
    mido.MidiFile(tracks=[track]).save(tmp_path / "melody.mid")
    return tmp_path / "melody.mid"


def test_an_instrument_is_put_together(fits, document, tmp_path):
    """The same fits make the same instrument."""
    done = run("instrument", fits, "--out", tmp_path / "out")
    assert done.exit_code == 0, done.output
    assert sorted(file.name for file in (tmp_path / "out").iterdir()) == ["instrument.html", "instrument.json"]
    assert "twin: 5 keys" in done.output
    assert json.loads((tmp_path / "out" / "instrument.json").read_text()) == document
    again = run("instrument", fits, "--out", tmp_path / "out")
    assert again.exit_code == 1
    assert "the folder is not empty" in again.output
    files = sorted(fits.glob("keys/*/fit.json"))
    build.stroke_level.cache_clear()  # see conftest.py
    printed = run("instrument", *files, "--out", tmp_path / "other", "--no-page", "--json", "--name", "mine")
    assert json.loads(printed.stdout) == json.loads((tmp_path / "other" / "instrument.json").read_text())
    assert json.loads(printed.stdout) == document | {"name": "mine"}
    assert not (tmp_path / "other" / "instrument.html").exists()


def test_what_is_written_is_what_is_read(built, document):
    read = load_instrument(built)
    assert document_of(read) == document
    assert repr(read) == "Instrument('twin', 88 keys, 5 recorded)"


def test_a_page_shows_every_key_and_trusts_no_name(piano, tmp_path):
    hostile = replace(piano, name="<script>alert(1)</script>", warnings=("<img src=x>",))
    write_page(tmp_path / "instrument.html", hostile)
    page = (tmp_path / "instrument.html").read_text()
    assert "<script" not in page
    assert "<img src=x>" not in page
    assert "&lt;script&gt;alert(1)" in page
    assert "Mistuning" not in page
    assert len(re.findall(r'<tr><th scope="row">', page)) == 88
    assert page.count("<svg ") == 17
    assert not re.search(r'(src|href)="(?!data:|#)', page)
    assert "default-src 'none'" in page


def test_a_page_shows_how_the_partials_of_keys_split_and_decay(fits, tmp_path):
    """A key whose first partial has two modes six cents apart, and whose second has one."""
    pole = np.array([-4.0 + 2j * np.pi * 200.0, -0.5 + 2j * np.pi * 200.0 * 2 ** (6 / 1200), -2.0 + 2j * np.pi * 400.0])
    ringing = ModalResponse(
        np.array([1, 1, 2]), pole, np.full(3, 0.1), np.array([[1.0, 0.05, 1.0]], complex), np.zeros((1, 0)), 44_100
    )
    keys = load_keys(find_fits([fits]))
    assert [key.summary.partials for key in keys] == [()] * 5
    one, two = partial_decays(ringing)
    assert (one.partial, two.partial) == (1, 2)
    assert one.split_cents == pytest.approx(6.0, rel=0.01)
    assert one.late_over_early > 4
    assert (two.split_cents, two.late_over_early) == (None, pytest.approx(1.0))
    keys[1] = replace(keys[1], summary=replace(keys[1].summary, partials=(one, two)))
    write_page(tmp_path / "instrument.html", build_instrument(keys, "twin"))
    page = (tmp_path / "instrument.html").read_text()
    assert page.count("<svg ") == 19
    assert page.count("Beating and double decay") == 2  # its heading, and that in the contents


def test_a_melody_is_played(built, melody, tmp_path):
    out = tmp_path / "melody.wav"
    done = run("play", built, melody, "--out", out, "--json")
    assert done.exit_code == 0, done.output
    told = json.loads(done.stdout)
    info = soundfile.info(out)
    assert (info.samplerate, info.subtype, info.channels) == (48_000, "PCM_24", 1)
    assert info.frames == round(told["seconds"] * 48_000)
    sound, _ = soundfile.read(out)
    assert 0.01 < np.abs(sound).max() <= 0.8914
    assert told["notes"] == told["strikes"] == 4
    assert told["on_moving_strings"] == 1
    before = out.read_bytes()
    refused = run("play", built, melody, "--out", out)
    assert refused.exit_code == 1
    assert "exists; give another --out" in refused.output
    replaced = run("play", built, melody, "--out", out, "--force")
    assert "4 notes, 1 of them on a string still sounding" in replaced.output
    assert out.read_bytes() == before  # the same in, the same out


def test_a_sampler_is_exported(built, tmp_path):
    done = run(
        "export", built, "--out", tmp_path / "sampler", "--velocity-layers", 2, "--keys", "F#3,A#3", "--seconds", 0.3
    )
    assert done.exit_code == 0, done.output
    assert "2 keys sampled, 1 of them a guess (never recorded); 15 transposed from them" in done.output
    assert len(list((tmp_path / "sampler" / "samples").iterdir())) == 2 * (2 + 1)
    assert (tmp_path / "sampler" / "twin.sfz").is_file()


def test_an_export_does_not_replace_the_working_folder(built, tmp_path, monkeypatch):
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    done = run("export", built, "--out", ".", "--keys", "F#3", "--seconds", 0.1, "--velocity-layers", 1)
    assert done.exit_code == 1
    assert "working folder" in done.output
    assert (tmp_path / "here").is_dir()


def test_the_options_of_pedals_choose_samples(built, tmp_path):
    asked = ("--velocity-layers", 2, "--keys", "F#3", "--seconds", 0.1)
    run("export", built, "--out", tmp_path / "more", *asked, "--una-corda", "--velocity-blend", "xfade")
    names = sorted(file.stem for file in (tmp_path / "more" / "samples").iterdir())
    endings = ["resonance", "v001", "v001-soft", "v127", "v127-soft"]
    assert [name.split("-", 2)[2] for name in names] == endings
    run("export", built, "--out", tmp_path / "fewer", *asked, "--no-resonance")
    assert len(list((tmp_path / "fewer" / "samples").iterdir())) == 2


def test_an_export_fills_gaps_and_names_silent_keys(built, tmp_path):
    asked = ("--velocity-layers", 1, "--keys", "C3,C5", "--seconds", 0.1)
    filled = run("export", built, "--out", tmp_path / "filled", *asked)
    assert "to fill gaps: C4" in filled.output
    assert "51 keys silent: A0 to F2, G5 to C8" in filled.output
    whole = run("export", built, "--out", tmp_path / "open", *asked, "--no-fill")
    assert "62 keys silent: A0 to F2, G3 to F4, G5 to C8" in whole.output


@pytest.mark.parametrize(("words", "message"), [
    (("export", "@", "--out", "x", "--velocity-blend", "xfade", "--format", "decent-sampler"), "-blend xfade must be"),
    (("export", "@", "--out", "x.mp3"), "x.mp3: is called like a file; give --out the name of a folder"),
    (("export", "@", "--out", "x", "--keys", "H4"), "--keys H4 must be"),
    (("export", "@", "--out", "x", "--velocity-layers", "0"), "--velocity-layers 0 must be from 1 to 127"),
    (("export", "@", "--out", "x", "--velocity-blend", "xfade", "--velocity-layers", "1"), "-layers 1 with"),
    (("export", "none.json", "--out", "x"), "none.json: no such file"),
    (("play", "@", "none.mid", "--out", "x.wav"), "none.mid: no such file"),
    (("play", "@", "melody.mid", "--out", "none/x.wav"), "does not exist"),
    (("play", "@", "melody.mid", "--out", "x.wav", "--rate", "1"), "--rate 1 Hz"),
    (("play", "melody.mid", "melody.mid", "--out", "x.wav"), "not an instrument.json"),
    (("instrument", "nowhere", "--out", "x"), "no such file or folder"),
    (("instrument", "melody.mid", "--out", "x"), "not a fit.json"),
    (("instrument", "@", "--out", "x"), "is not a fit.json"),
])  # fmt: skip
def test_bad_input_gets_one_line_and_nothing_is_written(words, message, built, melody, monkeypatch):
    monkeypatch.chdir(melody.parent)
    done = run(*(built if word == "@" else word for word in words))
    assert done.exit_code == 1
    assert re.search(message, done.output), done.output
    assert done.output.count("\n") == 1
    assert [file.name for file in melody.parent.iterdir()] == ["melody.mid"]


def test_a_hostile_fit_is_refused(tmp_path):
    good = fit_document(true_note(60), ERRORS)
    for change, message in (
        (
            {"recordings": [good["recordings"][0] | {"stroke_value": "fast"}]},
            r"recordings\[0\].stroke_value = 'fast' must be a number",
        ),
        ({"recordings": [good["recordings"][0] | {"stroke_value": -1.0}]}, r"recordings\[0\] has v_H0 = -1 m/s"),
        ({"recordings": [good["recordings"][0] | {"gain": 0.0}]}, r"recordings\[0\] has .* gain = 0"),
        ({"recordings": [good["recordings"][0] | {"gain": 1e-300}]}, r"recordings\[0\] has .* gain = 1e-300"),
    ):
        with pytest.raises(FitError, match=message):
            load_keys([write_fit(tmp_path, 60, good | change)])
    for entry, value in (("stroke_values", []), ("stroke_values", [-1.0]), ("parameters", {})):
        odd = copy.deepcopy(good)
        odd["minima"][0][entry] = value
        with pytest.raises(FitError, match=r"minima\[0\]"):
            load_keys([write_fit(tmp_path, 60, odd)])
    lossless = copy.deepcopy(good)
    lossless["minima"][0]["parameters"]["mu"] = 0.0
    assert len(load_keys([write_fit(tmp_path, 60, lossless)])) == 1
    odd = copy.deepcopy(good)
    odd["minima"][0]["parameters"]["M_H"] *= -1
    with pytest.raises(FitError, match=r"minima\[0\] must have .* above 0 of M_H"):
        load_keys([write_fit(tmp_path, 60, odd)])
    for change, message in (
        ({"mu": None}, "above 0 of mu"),
        ({"p": 1e300}, "far beyond the ranges of p"),
        ({"kappa": 1e300}, "far beyond the ranges of kappa"),
    ):
        odd = copy.deepcopy(good)
        values = odd["minima"][0]["parameters"] | change
        odd["minima"][0]["parameters"] = {name: value for name, value in values.items() if value is not None}
        with pytest.raises(FitError, match=rf"minima\[0\] .*{message}"):
            load_keys([write_fit(tmp_path, 60, odd)])
    odd = copy.deepcopy(good)  # a little beyond: the mean of a Gaussian may be
    odd["minima"][0]["parameters"]["p"] = 1.1 * PARAMETERS["p"].upper
    assert len(load_keys([write_fit(tmp_path, 60, odd)])) == 1
    odd["minima"][0]["parameters"]["p"] = 20 * PARAMETERS["p"].upper
    with pytest.raises(FitError, match="far beyond the ranges of p"):
        load_keys([write_fit(tmp_path, 60, odd)])
    odd = copy.deepcopy(good)
    odd["minima"][0]["stroke_values"] = [1e300]
    with pytest.raises(FitError, match=r"minima\[0\] is far beyond the ranges of v_H0"):
        load_keys([write_fit(tmp_path, 60, odd)])
    odd = copy.deepcopy(good)
    odd["minima"][0]["covariance"]["matrix"][0][0] = -1.0
    with pytest.raises(FitError, match=r"minima\[0\]\.covariance"):
        load_keys([write_fit(tmp_path, 60, odd)])
    it = true_note(60)
    short = it.geometry._replace(length=0.15, strike_position=0.02)
    high = it._replace(string=it.string._replace(c=1999.0), geometry=short)
    with pytest.raises(FitError, match="beyond a piano's A0 to C8"):
        load_keys([write_fit(tmp_path, 61, fit_document(high, ERRORS))])


def changed(path: str, value: object) -> Callable[[dict], None]:
    """Set an entry such as keys.0.gain."""

    def change(document: dict) -> None:
        at: Any = document
        *way, last = path.split(".")
        for step in way:
            at = at[int(step)] if step.isdigit() else at[step]
        at[int(last) if last.isdigit() else last] = value

    return change


def discrepant(velocity: object, db: object) -> dict:
    """A path of one partial with a velocity discrepancy."""
    return {"frequency": [1.0], "db": [0.0], "velocity_discrepancy": {"velocity": velocity, "db": db}}


BAD_INSTRUMENTS = {
    "kind": (changed("kind", "fit"), "schema 8"),
    "schema": (changed("schema", 99), "schema 8"),
    "quantity": (changed("quantity", ["x" * 999]), r"quantity = \['xxx.*\.\.\. must be one of velocity, "),
    "keys": (changed("keys", {}), r"keys = \{\} must be a list"),
    "no keys": (changed("keys", []), r"keys = \[\] must be a list of length >= 1"),
    "key": (changed("keys.3", None), r"keys\[3\] = None must be a table"),
    "midi": (changed("keys.0.midi", 20), r"keys\[0\].midi = 20 must be a whole number of at least 21"),
    "midi true": (changed("keys.0.midi", True), r"keys\[0\].midi = True must be a whole number"),
    "twice": (changed("keys.1.midi", 21), "keys has two entries with midi = 21"),
    "string": (changed("keys.0.string", 1), r"keys\[0\].string = 1 must be a table"),
    "lacking": (changed("keys.0.string", {"c": 300.0}), r"keys\[0\].string.kappa is missing"),
    "text": (changed("keys.0.string.c", "fast"), r"keys\[0\].string.c = 'fast' must be a number"),
    "nan": (changed("keys.0.hammer.p", float("nan")), "not an instrument.json"),
    "huge": (changed("keys.0.gain", 10**400), "not an instrument.json|gain = 1000"),
    "no gain": (changed("keys.0.gain", 0), "gain must be at least 1e-12"),
    "silent": (changed("keys.0.gain", -1e-300), "gain must be at least 1e-12"),
    "range": (changed("keys.0.string.c", 1e9), r"keys\[0\]: c=1000000000.0 must be a number from 20"),
    "off the string": (changed("keys.0.geometry.strike_position", 99.0), r"keys\[0\].*99.0 m"),
    "gain": (changed("keys.5.gain", None), r"keys\[5\].gain = None must be a number"),
    "loud": (changed("keys.5.gain", -1e13), r"keys\[5\].gain = -1.*must be a number of at least -1e\+12"),
    "path": (changed("keys.0.path", [1]), r"keys\[0\].path = \[1\] must be a table"),
    "path falls": (changed("keys.0.path", {"frequency": [2.0, 1.0], "db": [0.0, 0.0]}), "path.*increasing frequencies"),
    "path uneven": (changed("keys.0.path", {"frequency": [1.0, 2.0], "db": [0.0]}), "path.*increasing frequencies"),
    "path text": (changed("keys.0.path", {"frequency": ["1"], "db": ["0"]}), "path.frequency.*finite numbers"),
    "path long": (changed("keys.0.path", {"frequency": [*range(1, 9999)], "db": [0.0] * 9998}), "at most 4096"),
    "path loud": (changed("keys.0.path", {"frequency": [1.0], "db": [1e4]}), r"db reaches 1e\+04 dB"),
    "path's strokes": (changed("keys.0.path", discrepant([2.0, 1.0], [[0.0], [0.0]])), "velocity_discrepancy.*256"),
    "path's partials": (changed("keys.0.path", discrepant([1.0], [[0.0, 0.0]])), "velocity_discrepancy.*partial"),
    "path differs by far": (changed("keys.0.path", discrepant([1.0], [[1e4]])), "velocity_discrepancy.*300 dB"),
    "path differs": (changed("keys.0.path", discrepant("fast", [[0.0]])), "velocity_discrepancy.velocity = 'fast'"),
    "velocity": (changed("velocity", None), "velocity = None must be a table"),
    "falling": (changed("velocity.rise", -1.0), "velocity.rise = -1.0 must be a number above 0"),
    "still": (changed("velocity.at_64", 0.0), "velocity.at_64 = 0.0 must be a number of at least 0.01"),
    "law": (changed("laws.B.low", [1.0]), r"laws\.B = .*a value for each of the 88 keys"),
    "value": (changed("keys.0.values.B.value", "high"), r"keys\[0\].values.B.value = 'high' must be a number"),
    "change": (changed("keys.1.changes", {"mass": None}), r"keys\[1\].changes.mass = None must be a number"),
    "state": (changed("keys.0.state", "new"), r"keys\[0\].state = 'new' must be one of recorded"),
}


@pytest.mark.parametrize("name", BAD_INSTRUMENTS)
def test_a_hostile_instrument_is_refused(name, document, tmp_path):
    change, message = BAD_INSTRUMENTS[name]
    bad = copy.deepcopy(document)
    change(bad)
    file = tmp_path / "bad.json"
    file.write_text(json.dumps(bad))
    with pytest.raises(FitError, match=message) as caught:
        load_instrument(file)
    assert "bad.json: " in str(caught.value)
    assert len(str(caught.value)) < 400


@pytest.mark.parametrize("content", [b"", b"{", b"[1]", b"\xff\xfe", b"[" * 100_000, b'"text"', b"1" * 5000])
def test_what_is_no_document_is_refused(content, tmp_path):
    file = tmp_path / "bad.json"
    file.write_bytes(content)
    with pytest.raises(FitError, match=r"bad\.json: "):
        load_instrument(file)


def test_other_laws_of_the_felt(tmp_path):
    power = fit_document(true_note(60), ERRORS)
    power["parameters"]["mu"] |= {"value": 0.0, "interval": None}
    assert len(build_instrument(load_keys([write_fit(tmp_path, 60, power)])).keys) == 88
    stulov = fit_document(true_note(60), ERRORS) | {"felt": "stulov"}
    stulov["parameters"] |= {
        name: power["parameters"]["p"] | {"value": value} for name, value in (("epsilon", 0.5), ("tau", 1e-5))
    }
    with pytest.raises(FitError, match="relaxing felt"):
        load_keys([write_fit(tmp_path, 60, stulov)])


def test_partials_keep_their_own_levels(tmp_path):
    note = uneven_note(60)
    content = fit_document(note, ERRORS)
    keys = load_keys([write_fit(tmp_path, 60, content)])
    write_instrument(tmp_path / "instrument.json", build_instrument(keys))
    path = load_instrument(tmp_path / "instrument.json").keys[60].note.path
    assert [column.tolist() for column in path[:2]] == [column.tolist() for column in note.path[:2]]


def test_a_document_may_lack_what_is_only_reported(document, tmp_path):
    bare = {name: document[name] for name in ("kind", "schema", "quantity", "velocity")}
    wanted = ("midi", "string", "hammer", "geometry", "gain")
    bare["keys"] = [{name: key[name] for name in wanted} for key in document["keys"][:3]]
    (tmp_path / "instrument.json").write_text(json.dumps(bare))
    read = load_instrument(tmp_path)
    assert sorted(read.keys) == [21, 22, 23]
    assert read.keys[21].note.path is None
