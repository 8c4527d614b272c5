"""Listening test in a browser: blinding, random order, keyboard, and answers as JSON."""

from __future__ import annotations

import base64
import hashlib
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from report_cases import Page

from pianofit.dsp.loudness import k_weighted_mean_square
from pianofit.listening.page import write_listening
from pianofit.listening.result import count_answers
from pianofit.listening.trials import ListeningSound, Question

sync_api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
CHROMIUM = shutil.which("chromium") or "/usr/bin/chromium"
if not Path(CHROMIUM).exists():
    pytest.skip("chromium is not installed (Debian: apt-get install chromium)", allow_module_level=True)

RATE, LEAD = 8000, 0.05
MEASURED = "measured"
NAMES = ("initial", "global criterion", "three bands")


def questions() -> list[Question]:
    asked = []
    for velocity in (0.6, 0.8):
        t, f = np.arange(RATE) / RATE, 2000 * velocity
        sounds = {
            name: ListeningSound(
                name,
                f"{velocity} m/s",
                np.pad((n + 1) * np.exp(-3 * t) * np.sin(f * (n + 1) * t), (400, 0)),
            )
            for n, name in enumerate((MEASURED, *NAMES))
        }
        reference, three = sounds[MEASURED], sounds["three bands"]
        asked += [Question(reference, (three, sounds[name])) for name in ("initial", "global criterion")]
        asked.append(Question(reference, (reference, sounds["initial"]), 1))
        asked.append(Question(reference, (reference, sounds["three bands"]), 3, "abx"))
    return asked


def write(path: Path, seed: int = 3, origin: str = "made-up") -> dict:
    """Write the page and return its key."""
    write_listening(
        path, questions(), RATE, LEAD, seed, program="pianofit listen", about="some sounds", origin=origin,
        key=path.with_suffix(".key"),
    )  # fmt: skip
    return json.loads(path.with_suffix(".key").read_text(encoding="utf-8"))


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    path = tmp_path_factory.mktemp("listening") / "listening.html"
    made = "made-up sounds </script><b>"
    write(path, origin=made)
    return path


@pytest.fixture(scope="module")
def browser():
    with sync_api.sync_playwright() as play:
        browser = play.chromium.launch(executable_path=CHROMIUM, args=["--headless", "--no-sandbox", "--disable-gpu"])
        yield browser
        browser.close()


@pytest.fixture
def page(browser, path):
    """Open the page. At the end it must not have made requests or printed errors."""
    page = browser.new_page(viewport={"width": 1280, "height": 800})
    complaints, requests = [], []
    page.on("console", lambda message: complaints.append(message.text))
    page.on("pageerror", lambda error: complaints.append(str(error)))
    page.on("request", lambda request: requests.append(request.url))
    page.goto(path.as_uri())
    yield page
    page.close()
    assert complaints == []
    assert [url for url in requests if not url.startswith(("data:", "blob:"))] == [path.as_uri()]


def contents(path) -> dict:
    text = path.read_text(encoding="utf-8")
    return json.loads(text.split('<script id="test" type="application/json">')[1].split("</script>")[0])


def answered(page, keys: str = "a") -> dict:
    """Take the whole test by keyboard and return the saved answers. `keys` are the answers, repeated."""
    page.locator("#begin").focus()
    page.keyboard.press("Enter")
    trials = page.evaluate("window.pianofitListening.trials")
    for n, trial in enumerate(trials):
        for key in "xab" if trial["kind"] == "abx" else "rab":
            page.keyboard.press(key)
        page.keyboard.press("ArrowLeft" if keys[n % len(keys)] == "a" else "ArrowRight")
    with page.expect_download() as download:
        page.keyboard.press("Enter")  # the save link has the focus
    assert download.value.suggested_filename == "listening.json"
    return json.loads(Path(download.value.path()).read_text(encoding="utf-8"))


def test_policy_names_the_script_and_nothing_else(path):
    page = Page(path.read_text(encoding="utf-8"))
    policy = next(meta["content"] for meta in page.all("meta") if meta.get("http-equiv") == "Content-Security-Policy")
    script = base64.b64encode(hashlib.sha256(page.scripts[-1].encode()).digest()).decode()
    assert policy.startswith(f"default-src 'none'; script-src 'sha256-{script}';")
    assert "http" not in policy
    assert "</script><b>" in page.text  # escaped, not executed


def test_what_a_sound_is_cannot_be_read_on_the_page_nor_in_its_data(page, path):
    shown = [page.locator("body").inner_text()]
    page.locator("#begin").click()
    shown.append(page.locator("body").inner_text())
    test = contents(path)
    shown.append(json.dumps(test | {"sounds": [*test["sounds"]]}))
    assert not [name for name in (*NAMES, "hidden reference", "ABX:") for text in shown if name in text]
    # Names and order do not reveal the identity: names are random numbers, and the order is sorted.
    assert [*test["sounds"]] == [f"s{n:03d}" for n in range(8)]
    whats = [json.loads(path.with_suffix(".key").read_text())["sounds"][name]["what"] for name in test["sounds"]]
    assert whats not in ([*(MEASURED, *NAMES) * 2], sorted(whats))


def test_the_key_says_what_was_hidden(page, path):
    key = json.loads(path.with_suffix(".key").read_text(encoding="utf-8"))
    assert page.evaluate("window.pianofitListening.trials") == key["trials"]
    assert sorted({sound["what"] for sound in key["sounds"].values()}) == sorted((MEASURED, *NAMES))
    assert [trial["kind"] for trial in key["trials"]] == ["abx"] * 6 + ["nearer"] * 10
    for trial in key["trials"]:
        assert (trial["reference"] in (trial["a"], trial["b"])) == (not trial["condition"].startswith("nearer"))


def test_the_seed_draws_order_sides_and_x(path, tmp_path):
    """Fair to within six standard deviations over 60 seeds, and the same seed gives the same page."""
    keys = [write(tmp_path / "one.html", seed) for seed in range(60)]
    trials = [key["trials"] for key in keys]
    whats = [{name: sound["what"] for name, sound in key["sounds"].items()} for key in keys]
    assert len({json.dumps(one) for one in trials}) == 60
    spread = 6 * 0.5
    for kind, expected in (("abx", 6 * 60), ("nearer", 2 * 60)):
        measured = [
            what[t["a"]] == MEASURED for one, what in zip(trials, whats, strict=True) for t in one
            if t["kind"] == kind and MEASURED in (what[t["a"]], what[t["b"]])
        ]  # fmt: skip
        assert len(measured) == expected
        assert abs(np.mean(measured) - 0.5) < spread / np.sqrt(len(measured))
    x = [what[t["reference"]] == MEASURED for one, what in zip(trials, whats, strict=True) for t in one[:6]]
    assert abs(np.mean(x) - 0.5) < spread / np.sqrt(len(x))
    on_a = [t["reference"] == t["a"] for one in trials for t in one[:6]]
    assert abs(np.mean(on_a) - 0.5) < spread / np.sqrt(len(on_a))
    first = [key["sounds"][one[-1]["reference"]]["case"] == "0.6 m/s" for one, key in zip(trials, keys, strict=True)]
    assert abs(np.mean(first) - 0.5) < spread / np.sqrt(60)
    again = tmp_path / "again.html"
    assert write(again) == json.loads(path.with_suffix(".key").read_text())
    write(tmp_path / "page.html")
    assert again.read_bytes() == (tmp_path / "page.html").read_bytes()


def test_all_sounds_are_equally_loud(path):
    test = contents(path)
    assert len(test["sounds"]) == 8
    loudness = []
    for data in test["sounds"].values():
        samples = np.frombuffer(base64.b64decode(data)[44:], "<i2") / 32768
        loudness.append(10 * np.log10(k_weighted_mean_square(samples[:RATE], RATE)))
    assert max(loudness) - min(loudness) < 0.1


def test_answers_are_saved_as_json_with_what_was_hidden(page, path, tmp_path):
    page.locator("#listener").fill("a listener")
    saved = answered(page, "ab")
    key = json.loads(path.with_suffix(".key").read_text(encoding="utf-8"))
    what = {name: sound["what"] for name, sound in key["sounds"].items()}
    assert saved["schema"] == 2
    assert saved["program"] == "pianofit listen"
    assert saved["seed"] == 3
    assert saved["listener"] == "a listener"
    assert saved["asked"] == saved["answered"] == len(saved["trials"]) == 16
    for n, (trial, drawn) in enumerate(zip(saved["trials"], key["trials"], strict=True)):
        assert trial["number"] == n + 1
        assert trial["chosen"] == "ab"[n % 2]
        assert [trial[role] for role in ("reference", "a", "b")] == [what[drawn[r]] for r in ("reference", "a", "b")]
        assert trial["case"] in ("0.6 m/s", "0.8 m/s")
        assert trial["played"] == {"reference": 1, "a": 1, "b": 1}
        assert trial["seconds"] >= 0
        assert drawn[trial["hit"]] == drawn["hit"]
        right = "three bands" if trial["condition"].startswith("nearer") else trial["reference"]
        assert trial[trial["hit"]] == right
    rows = {row["condition"]: row for row in saved["conditions"]}
    assert rows.keys() == {
        "ABX: measured or three bands", "hidden reference: measured next to initial",
        "nearer to measured: three bands than initial", "nearer to measured: three bands than global criterion",
    }  # fmt: skip
    # The page and the program count alike.
    (tmp_path / "answers.json").write_text(json.dumps(saved))
    for count in count_answers([tmp_path / "answers.json"]):
        row = rows[count.condition]
        assert (row["hits"], row["of"], row["p"]) == (count.hits, count.of, pytest.approx(count.p))
    assert [rows[condition]["of"] for condition in sorted(rows)] == [6, 2, 4, 4]


def test_an_answer_waits_until_all_three_were_played(page):
    page.locator("#begin").click()
    assert page.locator("#asked").inner_text() == "Which is X?"
    page.keyboard.press("ArrowLeft")
    page.keyboard.press("r")
    page.keyboard.press("a")
    page.keyboard.press("ArrowRight")
    assert page.locator("#count").inner_text() == "Question 1 of 16"
    assert "first" in page.get_by_role("status").inner_text()
    page.keyboard.press("b")
    page.keyboard.press("ArrowRight")
    assert page.locator("#count").inner_text() == "Question 2 of 16"
    page.locator("#stop").click()
    assert page.evaluate("window.pianofitListening.results.answered") == 1


def test_each_button_plays_its_own_sound_from_the_start(page, path):
    page.locator("#begin").click()
    test, trial = contents(path), page.evaluate("window.pianofitListening.trials[0]")
    for key, role in zip("rab", ("reference", "a", "b"), strict=True):
        page.keyboard.press(key)
        playing = page.evaluate("""() => {
          const deck = window.pianofitListening.deck;
          return [deck.chosen, deck.now < 0.2, Array.from(deck.clips[deck.chosen].channels[0].slice(0, 3000))];
        }""")
        samples = np.frombuffer(base64.b64decode(test["sounds"][trial[role]])[44:], "<i2") / 32768
        assert playing[:2] == [("reference", "a", "b").index(role), True]
        np.testing.assert_allclose(playing[2], samples[:3000], atol=1e-6)
    page.keyboard.press("Space")
    assert not page.evaluate("window.pianofitListening.deck.playing")


def test_chance_is_that_of_a_fair_coin(page):
    found = page.evaluate(
        "[[0, 1], [2, 4], [4, 4], [1, 6], [9, 10]].map((x) => window.pianofitListening.binomial(...x))"
    )
    assert found == pytest.approx([1.0, 1.0, 2 / 16, 14 / 64, 22 / 1024])
