"""The blind test in a real browser: hidden, random, by keyboard alone, and its answers as JSON."""

from __future__ import annotations

import base64
import hashlib
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from report_cases import Page

from pianofit.report.listening import Heard, Question, write_listening
from pianofit.report.sound import k_weighted_mean_square

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
        t = np.arange(RATE) / RATE
        sounds = {
            name: Heard(
                name, velocity, np.pad((n + 1) * np.exp(-3 * t) * np.sin(2000 * velocity * (n + 1) * t), (400, 0))
            )
            for n, name in enumerate((MEASURED, *NAMES))
        }
        reference, three = sounds[MEASURED], sounds["three bands"]
        asked += [Question(reference, (three, sounds[name])) for name in ("initial", "global criterion")]
        asked.append(Question(reference, (reference, sounds["initial"]), 1))
    return asked


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    path = tmp_path_factory.mktemp("listening") / "listening.html"
    made = "made-up sounds </script><b>"
    write_listening(path, questions(), RATE, LEAD, 3, program="pianofit reproduce", about="some sounds", origin=made)
    return path


@pytest.fixture(scope="module")
def browser():
    with sync_api.sync_playwright() as play:
        browser = play.chromium.launch(executable_path=CHROMIUM, args=["--headless", "--no-sandbox", "--disable-gpu"])
        yield browser
        browser.close()


@pytest.fixture
def page(browser, path):
    """Open the page, which by the end must have asked for nothing and complained of nothing."""
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
    """Take the whole test by keyboard and return what is saved; `keys` is how to answer, again and again."""
    page.locator("#begin").focus()
    page.keyboard.press("Enter")
    count = len(page.evaluate("window.pianofitListening.trials"))
    for n in range(count):
        for key in "rab":
            page.keyboard.press(key)
        page.keyboard.press("ArrowLeft" if keys[n % len(keys)] == "a" else "ArrowRight")
    with page.expect_download() as download:
        page.keyboard.press("Enter")  # the link to save has the focus
    assert download.value.suggested_filename == "listening.json"
    return json.loads(Path(download.value.path()).read_text(encoding="utf-8"))


def test_policy_names_the_script_and_nothing_else(path):
    page = Page(path.read_text(encoding="utf-8"))
    policy = next(meta["content"] for meta in page.all("meta") if meta.get("http-equiv") == "Content-Security-Policy")
    script = base64.b64encode(hashlib.sha256(page.scripts[-1].encode()).digest()).decode()
    assert policy.startswith(f"default-src 'none'; script-src 'sha256-{script}';")
    assert "http" not in policy
    assert "</script><b>" in page.text  # escaped, so that it is read, not obeyed


def test_what_a_sound_is_cannot_be_read_on_the_page_nor_in_its_data(page, path):
    shown = [page.locator("body").inner_text()]
    page.locator("#begin").click()
    shown.append(page.locator("body").inner_text())
    test = contents(path)
    shown.append(json.dumps({name: test[name] for name in ("questions", "key")} | {"sounds": [*test["sounds"]]}))
    assert not [name for name in NAMES for text in shown if name in text]
    pairs = [set(question["pair"]) for question in test["questions"]]
    assert all(len(pair) == 2 for pair in pairs)


def test_all_sounds_are_equally_loud(path):
    test = contents(path)
    assert len(test["sounds"]) == 8
    loudness = []
    for data in test["sounds"].values():
        samples = np.frombuffer(base64.b64decode(data)[44:], "<i2") / 32768
        loudness.append(10 * np.log10(k_weighted_mean_square(samples[:RATE], RATE)))
    assert max(loudness) - min(loudness) < 0.1


def test_answers_are_saved_as_json_with_what_was_hidden(page):
    page.locator("#listener").fill("a listener")
    saved = answered(page, "ab")
    assert saved["schema"] == 1
    assert saved["program"] == "pianofit reproduce"
    assert saved["seed"] == 3
    assert saved["listener"] == "a listener"
    assert saved["asked"] == saved["answered"] == len(saved["trials"]) == 10
    assert saved["control"]["of"] == 2
    for n, trial in enumerate(saved["trials"]):
        assert trial["number"] == n + 1
        assert trial["chosen"] == trial["ab"[n % 2]]
        assert trial["reference"] == MEASURED
        assert trial["velocity"] in (0.6, 0.8)
        assert trial["played"] == {"reference": 1, "a": 1, "b": 1}
        assert trial["seconds"] >= 0
    rows = {(row["first"], row["second"]): row for row in saved["comparisons"]}
    assert set(rows) == {("three bands", "initial"), ("three bands", "global criterion")}
    for (first, second), row in rows.items():
        own = [t for t in saved["trials"] if {t["a"], t["b"]} == {first, second}]
        assert row["of"] == len(own) == 4
        assert row["first_nearer"] == sum(t["chosen"] == first for t in own)


def test_an_answer_waits_until_all_three_were_heard(page):
    page.locator("#begin").click()
    page.keyboard.press("ArrowLeft")
    page.keyboard.press("r")
    page.keyboard.press("a")
    page.keyboard.press("ArrowRight")
    assert page.locator("#count").inner_text() == "Question 1 of 10"
    assert "first" in page.get_by_role("status").inner_text()
    page.keyboard.press("b")
    page.keyboard.press("ArrowRight")
    assert page.locator("#count").inner_text() == "Question 2 of 10"
    page.locator("#stop").click()
    assert page.evaluate("window.pianofitListening.results.answered") == 1


def test_each_button_plays_its_own_sound_from_the_start(page, path):
    page.locator("#begin").click()
    test, trial = contents(path), page.evaluate("window.pianofitListening.trials[0]")
    for key, role in zip("rab", ("reference", "a", "b"), strict=True):
        page.keyboard.press(key)
        heard = page.evaluate("""() => {
          const deck = window.pianofitListening.deck;
          return [deck.chosen, deck.now < 0.2, Array.from(deck.clips[deck.chosen].channels[0].slice(0, 3000))];
        }""")
        samples = np.frombuffer(base64.b64decode(test["sounds"][trial[role]])[44:], "<i2") / 32768
        assert heard[:2] == [("reference", "a", "b").index(role), True]
        np.testing.assert_allclose(heard[2], samples[:3000], atol=1e-6)
    page.keyboard.press("Space")
    assert not page.evaluate("window.pianofitListening.deck.playing")


def test_sides_and_order_are_drawn_anew(page):
    drawn = page.evaluate("""() => {
      const begin = document.getElementById("begin"), seen = [];
      for (let n = 0; n < 200; n++) { begin.click(); seen.push(window.pianofitListening.trials); }
      return seen;
    }""")
    first = [trials[0]["reference"] for trials in drawn]
    orders = {json.dumps(trials) for trials in drawn}
    assert len(orders) == 200
    # Fair to within six standard deviations.
    share = np.mean([reference == max(first) for reference in first])
    assert abs(share - 0.5) < 6 * 0.5 / np.sqrt(200)
    sides = [trial["a"] < trial["b"] for trials in drawn for trial in trials]
    assert abs(np.mean(sides) - 0.5) < 6 * 0.5 / np.sqrt(len(sides))


def test_chance_is_that_of_a_fair_coin(page):
    found = page.evaluate(
        "[[0, 1], [2, 4], [4, 4], [1, 6], [9, 10]].map((x) => window.pianofitListening.binomial(...x))"
    )
    assert found == pytest.approx([1.0, 1.0, 2 / 16, 14 / 64, 22 / 1024])
