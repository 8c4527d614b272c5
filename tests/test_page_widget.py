"""A playable note in a notebook: the data for anywidget, and the front end in a browser."""

from __future__ import annotations

import io
import json
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import soundfile as sf
from instrument_cases import uneven_note
from page_cases import early, error_db, node, ringing_note

from pianofit.errors import ParameterError
from pianofit.schema.notes import load_note
from pianofit.web import widget

RATE = 48_000
BLOCK = 128
EMPTY = "<!doctype html><meta charset='utf-8'><title>a notebook</title><div id='cell'></div>"
# As in anywidget: the module is loaded from a blob, and a model has the traits.
OPEN = """async ([code, instrument]) => {
  const module = await import(URL.createObjectURL(new Blob([code], { type: "text/javascript" })));
  const model = { get: (name) => ({ instrument })[name] };
  window.end = await module.default.render({ model, el: document.getElementById("cell") });
}"""


def test_a_note_is_a_widget_in_a_notebook():
    pytest.importorskip("anywidget", reason="needs the extra: pip install 'pianofit[widget]'")
    note = ringing_note(57)
    shown, pitch = note.play(), note.string.c / (2 * note.geometry.length)
    assert [(key["midi"], key["note"]) for key in shown.instrument["keys"]] == [(57, f"{pitch:.2f} Hz")]
    assert json.loads(json.dumps(shown.instrument)) == shown.instrument
    (data, *_) = shown._repr_mimebundle_()
    assert "application/vnd.jupyter.widget-view+json" in data
    assert shown._esm == widget.front_end()


def test_without_anywidget_it_says_what_to_install(monkeypatch):
    widget._widget_class.cache_clear()
    monkeypatch.setitem(sys.modules, "anywidget", None)
    with pytest.raises(ParameterError, match=r"anywidget.*pip install 'pianofit\[widget\]'"):
        uneven_note(60).play()


def test_the_front_end_is_a_module():
    command = [node(), "--input-type=module", "--check"]
    checked = subprocess.run(command, input=widget.front_end(), text=True, check=False, capture_output=True)
    assert checked.returncode == 0, checked.stderr


@pytest.fixture(scope="module")
def browser():
    sync_api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    chromium = shutil.which("chromium") or "/usr/bin/chromium"
    if not Path(chromium).exists():
        pytest.skip("chromium is not installed (Debian: apt-get install chromium)")
    with sync_api.sync_playwright() as play:
        browser = play.chromium.launch(executable_path=chromium, args=["--no-sandbox", "--disable-gpu"])
        yield browser
        browser.close()


@pytest.mark.parametrize("make", [uneven_note, ringing_note])
def test_what_is_struck_in_a_notebook_is_the_note(browser, tmp_path, make):
    note, (file, said, requests) = make(60), (tmp_path / "cell.html", [], [])
    file.write_text(EMPTY)
    page = browser.new_page(viewport={"width": 400, "height": 600})
    page.on("console", lambda message: said.append(message.text))
    page.on("pageerror", lambda error: said.append(str(error)))
    page.on("request", lambda request: requests.append(request.url))
    page.goto(file.as_uri())
    page.evaluate(OPEN, [widget.front_end(), widget.note_payload(note)])
    strike, wav, saved = (page.locator(".pianofit-note button").nth(i) for i in range(3))
    strike.focus()
    page.keyboard.press("Enter")
    page.locator(".pianofit-note p", has_text=" N").wait_for()
    velocity = float(page.locator(".pianofit-note output").first.inner_text().removesuffix(" m/s"))
    assert velocity == pytest.approx(note.hammer.v_H0, rel=0.02)
    with page.expect_download() as download:
        wav.click()
    download.value.save_as(tmp_path / "note.wav")
    sound, rate = sf.read(io.BytesIO((tmp_path / "note.wav").read_bytes()))
    with page.expect_download() as download:
        saved.click()
    download.value.save_as(tmp_path / "note.json")
    kept, _ = load_note(tmp_path / "note.json")
    assert rate == RATE
    expected = kept.render(seconds=2.0, rate=RATE, mono=False)
    peak = np.abs(expected).max()
    assert peak < 0.89  # below the threshold of the limiter
    assert error_db(sound.T[:, BLOCK + early(note) :], expected) < -80  # the output is a block late
    own = note.render(kept.hammer.v_H0, seconds=2.0, rate=RATE, mono=False)
    assert error_db(expected, own) < -80
    assert page.evaluate("document.documentElement.scrollWidth") <= 400
    page.evaluate("() => window.end()")
    page.close()
    assert said == []
    assert [url for url in requests if not url.startswith(("blob:", "data:"))] == [file.as_uri()]
