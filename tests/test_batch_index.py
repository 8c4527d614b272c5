"""Reports of a batch: its page and its table, its progress, and `status` while it is running."""

from __future__ import annotations

import base64
import csv
import functools
import hashlib
import io
import json
import re
import shutil
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from batch_cases import library, quick_work
from instrument_cases import ERRORS, fit_document, true_note

from pianofit.batch import ProcessPool, run_batch, status
from pianofit.batch.html_index import Index
from pianofit.batch.job import Source, UnusedFile
from pianofit.batch.records import Entry, Store
from pianofit.batch.traffic_lights import lights
from pianofit.cli import main
from pianofit.cli.batch import _line
from pianofit.dsp.loudness import k_weighted_mean_square
from pianofit.io.files import encode_wav
from pianofit.schema.decode import convert
from pianofit.schema.fit import Fit
from pianofit.schema.modal_response import FittedModalResponse
from pianofit.schema.quantities import Quantities

RATE = 22_050


@pytest.fixture
def store(tmp_path) -> Store:
    """Two finished keys, of which one still has its recording, and a failed key."""
    store = Store(tmp_path / "out")
    store.open()
    for midi, key in ((60, "grand-C4"), (42, "grand-Fs2")):
        note = true_note(midi)
        sound = np.pad(note.render(3.0, seconds=1.5, rate=RATE), (RATE // 20, 0))
        file = tmp_path / f"{key}.wav"
        file.write_bytes(encode_wav(0.5 * sound / np.abs(sound).max(), RATE))
        document = fit_document(note, ERRORS)
        span = [200.0, 300.0]
        document["invariants"] = {"f0": {"value": note.string.c / (2 * note.geometry.length), "interval": span}}
        document["derived"]["f1"] = float(midi)
        digest = hashlib.sha256(file.read_bytes()).hexdigest()
        own = {"file": str(file), "sha256": digest, "is_reference": True, "rate": RATE}
        document["recordings"] = [document["recordings"][0] | own]
        files = {"fit.json": json.dumps(document).encode(), "fitted.wav": encode_wav(0.1 * sound, RATE)}
        name = midi_name(midi)
        store.commit(Entry(key, name, key, "running", (Source(str(file), file.name, digest),), seconds=20.0), files)
    (tmp_path / "grand-Fs2.wav").unlink()
    store.write(Entry("grand-D4", "D4", "x", "failed", reason="<script>alert(1)</script>"))
    return store


def midi_name(midi: int) -> str:
    return {60: "C4", 42: "F#2"}[midi]


def test_the_table_has_the_numbers_of_every_key(store):
    Index(store).write()
    rows = list(csv.DictReader(io.StringIO((store.folder / "keys.csv").read_text(encoding="utf-8"))))
    assert [(row["key"], row["state"]) for row in rows] == [
        ("grand-Fs2", "done"), ("grand-C4", "done"), ("grand-D4", "failed"),
    ]  # fmt: skip
    assert rows[2]["reason"] == "<script>alert(1)</script>"
    assert rows[2]["c"] == ""
    for row in rows[:2]:
        fit = json.loads((store.keys / row["key"] / "fit.json").read_text())
        for name, entry in (fit["parameters"] | fit["invariants"]).items():
            assert float(row[name]) == entry["value"]
            ends = [float(x) if x else None for x in (row[f"{name} low"], row[f"{name} high"])]
            assert ends == (entry["interval"] or [None, None])
        assert row["K_H status"] == "scaled"


def test_the_page_shows_every_key_and_what_can_be_heard(store):
    Index(store).write()
    html = (store.folder / "index.html").read_text()
    assert "<script>alert(1)" not in html
    assert "&lt;script&gt;alert(1)" in html
    assert html.count('href="keys/grand-C4/fit.json"') == html.count('href="keys/grand-Fs2/fit.json"') == 1
    assert html.count("recording moved or changed") == 1  # the recording of F#2
    assert "200.0 to 300.0" in html or "200 to 300" in html
    clips = re.findall(r'data-name="(original|fitted)"[^>]*href="data:audio/wav;base64,([^"]+)"', html)
    assert [name for name, _ in clips] == ["original", "fitted"]
    loudness = []
    for _, text in clips:
        samples = np.frombuffer(base64.b64decode(text)[44:], "<i2") / 32768
        loudness.append(10 * np.log10(k_weighted_mean_square(samples[:RATE], RATE)))
    assert loudness[0] == pytest.approx(loudness[1], abs=0.02)  # their files differ by 14 dB


def test_a_damaged_record_hides_no_other_key(store):
    store.commit(Entry("odd", "H9", "x", "running"), {"fit.json": b"{}"})
    (store.keys / "odd/fit.json").write_bytes(b"[1, 2")
    Index(store).write()
    rows = list(csv.DictReader(io.StringIO((store.folder / "keys.csv").read_text(encoding="utf-8"))))
    assert [row["key"] for row in rows if row["c"]] == ["grand-Fs2", "grand-C4"]
    assert (store.folder / "index.html").read_text().count("keys/odd/fit.json") == 1


def test_a_recording_that_is_another_one_now_is_not_played(store, tmp_path):
    (tmp_path / "grand-C4.wav").write_bytes(encode_wav(np.random.default_rng(1).normal(0, 0.1, RATE), RATE))
    Index(store).write()
    assert (store.folder / "index.html").read_text().count("recording moved or changed") == 2


def test_the_page_asks_for_nothing_and_complains_of_nothing(store):
    sync_api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    chromium = shutil.which("chromium") or "/usr/bin/chromium"
    if not Path(chromium).exists():
        pytest.skip("chromium is not installed (Debian: apt-get install chromium)")
    Index(store).write()
    page_of = (store.folder / "index.html").as_uri()
    messages, requests = [], []
    with sync_api.sync_playwright() as play:
        browser = play.chromium.launch(executable_path=chromium, args=["--no-sandbox", "--disable-gpu"])
        page = browser.new_page(viewport={"width": 400, "height": 800})
        page.on("console", lambda message: messages.append(message.text))
        page.on("pageerror", lambda error: messages.append(str(error)))
        page.on("request", lambda request: requests.append(request.url))
        page.goto(page_of)
        assert page.evaluate("document.documentElement.scrollWidth") <= 400
        page.locator(".play").click()
        page.locator(".choice").nth(1).click()
        page.wait_for_function("() => pianofitPlayer.state.playing && pianofitPlayer.state.chosen === 'fitted'")
        browser.close()
    assert messages == []
    assert [url for url in requests if not url.startswith("data:")] == [page_of]


@functools.cache
def fitted() -> Fit:
    return convert(fit_document(true_note(69), ERRORS), Fit, "fit", "")


def tones(note="A4", **changes):
    return [light.tone for light in lights(Entry("k", note, "x", "done"), replace(fitted(), **changes))]


@pytest.mark.parametrize(("dB", "tone"), [(0.99, "good"), (1.02, "fair"), (2.99, "fair"), (3.02, "poor")])
def test_a_match_is_judged_by_what_people_notice(dB, tone):
    assert tones(levels=replace(fitted().levels, fitted_db=dB))[0] == tone


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize(("cents", "tone"), [(24, "good"), (27, "fair"), (49, "fair"), (52, "poor")])
def test_a_tuning_is_judged_by_the_notes_name(cents, tone, sign):
    assert tones(derived=replace(fitted().derived, f1=440.0 * 2 ** (sign * cents / 1200)))[1] == tone


@pytest.mark.parametrize(("dB", "tone"), [(2.9, "good"), (3.2, "fair"), (5.9, "fair"), (6.2, "poor")])
def test_ringing_is_judged_by_the_layers_left_out(dB, tone):
    response = FittedModalResponse(render_model="modes", leave_one_out_db={"string model": 9.0, "modes": dB})
    assert tones(modal_response=response)[2] == tone


def test_what_is_not_there_is_not_judged():
    assert tones(note="H9")[1:3] == ["none"] * 2
    assert tones(modal_response=FittedModalResponse(render_model="modes"))[2] == "none"
    assert [light.tone for light in lights(Entry("k", "A4", "x", "done"), None)][:3] == ["none"] * 3


def test_warnings_name_what_makes_a_key_doubtful():
    mu = replace(fitted().parameters.mu, status="at-bound")
    bound = replace(fitted(), parameters=Quantities(fitted().parameters.entries | {"mu": mu}))
    entry = Entry("k", "A4", "x", "done", left_out=(UnusedFile("a", "a: clipped"),))
    *_, light = lights(entry, bound)
    assert (light.tone, light.text, light.value) == ("fair", "2", 2)
    assert "μ" in light.word
    assert "1 recording left out" in light.word
    *_, worse = lights(entry, replace(bound, converged=False))
    assert worse.tone == "poor"
    assert worse.value > light.value
    assert tones()[3] == "good"


def test_the_table_is_sorted_by_keyboard_and_reads_without_colour(store):
    sync_api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    chromium = shutil.which("chromium") or "/usr/bin/chromium"
    if not Path(chromium).exists():
        pytest.skip("chromium is not installed (Debian: apt-get install chromium)")
    files = {"fit.json": json.dumps({"schema": 0}).encode()}
    store.commit(Entry("grand-Z", "C5", "z", "running", seconds=1.0), files)
    Index(store).write()
    with sync_api.sync_playwright() as play:
        browser = play.chromium.launch(executable_path=chromium, args=["--no-sandbox", "--disable-gpu"])
        page = browser.new_page(viewport={"width": 1400, "height": 800})
        page.goto((store.folder / "index.html").as_uri())
        overflow = page.evaluate("(([x]) => x.scrollWidth - x.clientWidth)(document.querySelectorAll('.keys-frame'))")
        keys = lambda: [text.split()[0] for text in page.locator(".keys-table tbody th").all_inner_texts()]  # noqa: E731
        head = page.locator("th", has=page.get_by_role("button", name="tuning"))
        orders = [(keys(), head.get_attribute("aria-sort"))]
        for _ in range(2):
            head.get_by_role("button").focus()
            page.keyboard.press("Enter")
            orders.append((keys(), head.get_attribute("aria-sort")))
        cents = page.locator(".keys-table tbody tr td:nth-child(3)").all_inner_texts()
        right = page.evaluate("getComputedStyle(document.querySelector('td.value')).textAlign")
        browser.close()
    assert overflow <= 0
    assert right == "right"
    assert {order[-1] for order, _ in orders[1:]} == {"grand-Z"}  # a key without a value is last in both orders
    assert orders[1][0][:2] == orders[2][0][:2][::-1]
    assert [sorting for _, sorting in orders] == ["none", "ascending", "descending"]
    assert all(re.search("good|fair|poor|no pitch", text) for text in cents)


def test_it_is_written_while_the_batch_goes_on_and_when_it_is_interrupted(tmp_path, monkeypatch):
    monkeypatch.setattr("pianofit.batch.html_index.WRITE_INTERVAL_S", 0.0)
    jobs, reports = library(tmp_path / "in", ["one", "two", "hang"]), []

    def tell(progress):
        page = tmp_path / "out/index.html"
        if page.exists() and progress.done == 2:
            reports.append((page.read_text(), status(tmp_path / "out"), progress))
            if progress.running and progress.running[0][1]:
                raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_batch(jobs, tmp_path / "out", lambda s: ProcessPool(1, 2**31, 60.0, s.scratch, work=quick_work), tell=tell)
    html, state, progress = reports[-1]
    assert "not finished" in html
    assert state.at_work
    (running,) = [key for key in state.keys if key.state == "running"]
    assert progress.running == (("B0", "hammer"),)
    assert (running.key, running.stage) == ("B0", "hammer")
    assert 0 <= time.time() - running.started < 60
    after = status(tmp_path / "out")
    assert [key.stage for key in after.keys] == ["", "", ""]
    assert after.seconds_left is None


def test_status_gives_the_time_left_and_names_keys_and_stages(tmp_path, monkeypatch, capsys):
    store = Store(tmp_path)
    store.open()
    store.commit(Entry("A0", "A0", "a", "running", seconds=100.0), {"fit.json": b"{}"})
    now = time.time()
    for key, state, stage, began in (("B0", "running", "hammer", now - 40), ("C1", "running", "", now - 10),
                                     ("D1", "waiting", "", 0.0), ("E1", "waiting", "", 0.0)):  # fmt: skip
        store.write(Entry(key, key, "x", state, stage=stage, started=began))
    monkeypatch.setattr(Store, "is_locked", lambda _: True)
    assert status(tmp_path).seconds_left == pytest.approx((2 * 100 + 60 + 90) / 2, abs=1.0)
    assert main(["status", str(tmp_path)]) == 0
    running = capsys.readouterr().out
    assert running.startswith("1 done, 2 running, 2 waiting of 5 keys")
    assert "3 min left" in running
    assert "B0: hammer, C1" in running
    monkeypatch.setattr(Store, "is_locked", lambda _: False)
    main(["status", str(tmp_path)])
    stopped = capsys.readouterr().out
    assert stopped.startswith("1 done, 4 waiting of 5 keys")
    assert "min left" not in stopped


def test_a_line_of_progress_names_the_first_keys():
    from pianofit.batch import Progress

    keys = tuple((f"C{i}", "hammer") for i in range(6))
    line = _line(Progress(9, 2, 1, keys, 300.0))
    assert line.startswith("2 of 9 keys done, 1 failed")
    assert "5 min left" in line
    assert line.endswith("C0: hammer, C1: hammer, C2: hammer, C3: hammer and 2 more")
    assert _line(Progress(9, 0, 0, (("C4", ""),), None)).endswith("; C4")
    assert _line(Progress(2, 2, 0, (), 0.0)) == "2 of 2 keys done"
