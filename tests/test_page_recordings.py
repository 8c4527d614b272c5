"""Comparison of keys and recordings on the page: selection, loudness and alignment."""

from __future__ import annotations

import base64
import hashlib
import io
import json
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import soundfile as sf
from instrument_cases import (
    ERRORS,
    fit_document,
    notes_of,
    piano_of,
    true_instrument,
    true_note,
    uneven_note,
    write_fit,
)
from page_cases import SCRIPTS, node, ringing_note

from pianofit.cli import main
from pianofit.dsp.loudness import k_weighted_mean_square
from pianofit.errors import FitError, ParameterError
from pianofit.instrument import Instrument, load_instrument
from pianofit.io.files import encode_wav
from pianofit.schema.instrument import FitSummary, Layer
from pianofit.web import write_playable_page
from pianofit.web.recordings import recorded_layers

RATE = 48_000
CONTACT = 0.06  # s, in the recordings
VELOCITIES = (1.0, 3.0)


@pytest.fixture(scope="module")
def piano(tmp_path_factory) -> Instrument:
    """Two keys, a string model and a modal response in stereo, each with recordings of itself at another gain."""
    folder, layers = tmp_path_factory.mktemp("recorded"), {}
    notes = {60: uneven_note(60), 64: ringing_note(64)}
    for midi, note in notes.items():
        for velocity in VELOCITIES:
            sound = note.render(velocity, seconds=2.5, rate=RATE, mono=False)
            sound = np.pad(sound, ((0, 0), (round((CONTACT - note.pre_onset_s) * RATE), 0)))
            file = folder / f"{midi} at {velocity}.wav"
            file.write_bytes(encode_wav(0.3 * sound / np.abs(sound).max(), RATE))
            digest = hashlib.sha256(file.read_bytes()).hexdigest()
            layers.setdefault(midi, []).append(Layer(str(file), digest, CONTACT, velocity))
    return with_layers(piano_of(notes_of(true_instrument(range(60, 66))) | notes), layers)


def with_layers(piano: Instrument, layers: dict[int, list[Layer]]) -> Instrument:
    """The instrument with these recordings, and no others."""
    fits = {midi: FitSummary(layers=tuple(found)) for midi, found in layers.items()}
    return replace(piano, keys={midi: replace(key, fit=fits.get(midi)) for midi, key in piano.keys.items()})


def test_a_layer_begins_with_its_key_and_keeps_its_shape(piano):
    for midi, found in recorded_layers(piano).items():
        for layer in found:
            sound, rate = sf.read(io.BytesIO(base64.b64decode(layer["flac"])), always_2d=True)
            own = piano.keys[midi].note.render(layer["velocity"], seconds=2.0, rate=rate, mono=False)
            sound = sound.T[:, : own.shape[-1]]
            assert sound.shape == own.shape
            assert np.abs(sound / np.abs(sound).max() - own / np.abs(own).max()).max() < 2e-3


def test_recordings_that_are_gone_or_others_are_named(piano, tmp_path):
    layer = piano.keys[60].fit.layers[0]
    gone = replace(layer, file=str(tmp_path / "gone.wav"))
    with pytest.raises(Exception, match=r"gone\.wav: "):
        recorded_layers(with_layers(piano, {60: [gone]}))
    with pytest.raises(FitError, match=r"60 at 1\.0\.wav: .*pianofit batch"):
        recorded_layers(with_layers(piano, {60: [replace(layer, sha256="0")]}))
    with pytest.raises(FitError, match=r"--recordings: .*pianofit batch"):
        recorded_layers(with_layers(piano, {}))


def test_recordings_are_shortened_before_they_are_too_much(piano, monkeypatch):
    whole = sum(len(layer["flac"]) for layers in recorded_layers(piano).values() for layer in layers)
    monkeypatch.setattr("pianofit.web.recordings.LENGTHS", (4.0, 1.0))
    monkeypatch.setattr("pianofit.web.recordings.ROOM", whole - 1)
    found = recorded_layers(piano)
    assert sf.info(io.BytesIO(base64.b64decode(found[60][0]["flac"]))).frames == RATE
    monkeypatch.setattr("pianofit.web.recordings.ROOM", 1000)
    with pytest.raises(ParameterError, match=r"--recordings: 1 s .* 0 MB"):
        recorded_layers(piano)


def test_the_layers_of_a_fit_come_with_its_instrument(tmp_path, capsys):
    document = fit_document(true_note(60), ERRORS)
    for i, row in enumerate(document["recordings"]):
        row |= {"file": f"/take {i}.wav", "sha256": str(i), "onset_s": 0.1}
    layers = [{"file": "/take 0.wav", "contact_s": 0.002}]
    document["modal_response"] = {"render_model": "string model", "layers": layers}
    write_fit(tmp_path, 60, document)
    layers = load_instrument(tmp_path).keys[60].fit.layers
    assert [(layer.file, layer.contact) for layer in layers] == [
        ("/take 0.wav", pytest.approx(0.102)), ("/take 1.wav", 0.1), ("/take 2.wav", 0.1),
    ]  # fmt: skip
    # The keyboard moves the scale of all velocities, and with one key hardly.
    ratios = [layer.velocity / row["stroke_value"] for layer, row in zip(layers, document["recordings"], strict=True)]
    assert ratios == pytest.approx([ratios[0]] * 3, rel=1e-9)
    assert layers[-1].velocity == pytest.approx(4.0, rel=0.05)
    assert main(["page", str(tmp_path), "--recordings"]) == 1
    assert "/take 0.wav: " in capsys.readouterr().err
    assert not (tmp_path / "piano.html").exists()


def test_what_is_no_layer_in_an_instrument_is_named(tmp_path):
    good = {"file": "a.wav", "sha256": "0", "contact": 0.1, "velocity": 2.0}
    bad = {
        r"layers\[1\] = None must be a table": None,
        r"layers\[1\]\.file is missing": {},
        r"layers\[1\]\.file = 1 must be a text": good | {"file": 1},
        r"layers\[1\]\.contact = 'soon' must be a number": good | {"contact": "soon"},
        r"layers\[1\]\.velocity = 1000000000.0 must be a number of at most 20": good | {"velocity": 1e9},
        r"layers\[1\]\.velocity = -1 must be a number of at least 0.01": good | {"velocity": -1},
    }
    write_fit(tmp_path, 60, fit_document(true_note(60), ERRORS))
    assert main(["instrument", str(tmp_path), "--out", str(tmp_path / "out"), "--no-page"]) == 0
    file = tmp_path / "out/instrument.json"
    document = json.loads(file.read_text())
    fit = next(key for key in document["keys"] if key["fit"])["fit"]
    fit["layers"] = [good]
    file.write_text(json.dumps(document))
    assert load_instrument(file).keys[60].fit.layers == (Layer("a.wav", "0", 0.1, 2.0),)
    for message, layer in bad.items():
        fit["layers"] = [good, layer]
        file.write_text(json.dumps(document))
        with pytest.raises(FitError, match=message):
            load_instrument(file)


def test_the_pages_loudness_is_that_of_the_reports():
    random = np.random.default_rng(0)
    sound = random.normal(size=(2, RATE)) * np.exp(-np.arange(RATE) / 9000)
    code = """
      import { readFileSync } from "node:fs";
      const { kWeighted } = await import(`${process.argv[1]}/loudness.js`);
      const sound = JSON.parse(readFileSync(0, "utf8")).map((x) => Float64Array.from(x));
      console.log(kWeighted(sound, 48000));
    """
    command = [node(), "--input-type=module", "-e", code, str(SCRIPTS)]
    done = subprocess.run(command, input=json.dumps(sound.tolist()), capture_output=True, text=True, check=True)
    assert float(done.stdout) == pytest.approx(k_weighted_mean_square(sound, RATE), rel=1e-3)


# Loudness of every clip, dB; largest difference of instrument and recording of every layer, relative to the peak.
MEASURE = """() => {
  const { deck, player } = window.pianofitKeyboard.compare, { clips } = deck;
  const apart = ([a, b]) => b.channels.reduce((most, y, c) => {
    const x = a.channels[c % a.channels.length], n = 48000;
    const peak = y.slice(0, n).reduce((p, v) => Math.max(p, Math.abs(v)), 0);
    return Math.max(most, y.slice(0, n).reduce((d, v, i) => Math.max(d, Math.abs(v - x[i])), 0) / peak);
  }, 0);
  return [clips.map((clip) => 10 * Math.log10(player.kWeighted(clip.channels, clip.rate))),
    [clips.slice(0, 2), clips.slice(2, 4)].map(apart)];
}"""


def test_recording_and_instrument_are_switched_while_they_sound(piano, tmp_path):
    sync_api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    chromium = shutil.which("chromium") or "/usr/bin/chromium"
    if not Path(chromium).exists():
        pytest.skip("chromium is not installed (Debian: apt-get install chromium)")
    done = write_playable_page(tmp_path / "piano.html", piano, recordings=True)
    assert done.layers == 4
    said, requests = [], []
    with sync_api.sync_playwright() as play:
        browser = play.chromium.launch(executable_path=chromium, args=["--no-sandbox", "--disable-gpu"])
        page = browser.new_page(viewport={"width": 1280, "height": 900})
        page.on("console", lambda message: said.append(message.text))
        page.on("pageerror", lambda error: said.append(str(error)))
        page.on("request", lambda request: requests.append(request.url))
        page.goto((tmp_path / "piano.html").as_uri())
        page.wait_for_function("() => Boolean(window.pianofitKeyboard)")
        state = "() => { const { deck } = window.pianofitKeyboard.compare; return [deck.playing, deck.chosen]; }"
        for midi in (60, 64):
            page.evaluate("midi => window.pianofitKeyboard.play(midi, 80)", midi)
            page.locator("#compare").wait_for()
            page.evaluate("midi => window.pianofitKeyboard.release(midi)", midi)
            page.locator("#compare-play").click()
            page.wait_for_function("() => window.pianofitKeyboard.compare.deck?.playing")
            page.locator("#compare-layers button").nth(1).click()
            page.keyboard.press("2")
            assert page.evaluate(state) == [True, 3]
            page.keyboard.press("1")
            assert page.evaluate(state) == [True, 2]
            loud, apart = page.evaluate(MEASURE)
            assert loud == pytest.approx([loud[0]] * 4, abs=0.01)
            assert max(apart) < 2e-3
            page.locator("#change-mass").focus()
            page.keyboard.press("End")
            page.evaluate("() => window.pianofitKeyboard.compare.deck.start(0)")
            page.locator("#compare-ways button").nth(1).click()  # rendered anew
            page.wait_for_function("() => window.pianofitKeyboard.compare.deck.playing")
            loud, apart = page.evaluate(MEASURE)
            assert loud == pytest.approx([loud[0]] * 4, abs=0.01)
            assert min(apart) > 0.05
            page.evaluate("() => window.pianofitKeyboard.compare.deck.start(0)")
            page.locator("#compare-play").click()
            assert page.evaluate(state) == [False, 3]
            page.locator("#reset").click()
        page.evaluate("() => window.pianofitKeyboard.play(62, 80)")
        page.locator("#compare").wait_for(state="hidden")
        browser.close()
    assert said == []
    assert [url for url in requests if not url.startswith(("blob:", "data:"))] == [(tmp_path / "piano.html").as_uri()]
