"""The page in a browser: it loads nothing, and its sound output is compared sample by sample."""

from __future__ import annotations

import base64
import io
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
import soundfile as sf
from report_cases import (
    NAMES,
    example_fit,
    example_held_out,
    example_result,
    example_strokes,
    fit_of_recordings,
    response_content,
)

from pianofit.dsp.loudness import k_weighted_mean_square
from pianofit.report.page import report_bytes

sync_api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
CHROMIUM = shutil.which("chromium") or "/usr/bin/chromium"
if not Path(CHROMIUM).exists():
    pytest.skip("chromium is not installed (Debian: apt-get install chromium)", allow_module_level=True)

ARGUMENTS = (
    "--headless --no-sandbox --disable-gpu --disable-quic --no-first-run --disable-background-networking "
    "--disable-component-update --disable-sync"
)
# Original width of each picture and its width on the page, px. One point is 4/3 px.
SIZES = """[...document.querySelectorAll(".drawing svg")].map((svg) =>
  [svg.viewBox.baseVal.width * 4 / 3, svg.getBoundingClientRect().width])"""
RATE, CAPTURED = 8000, 32768  # Hz; number of samples in the analyser, four seconds

# An analyser at the output of the player contains the last samples that were played; `captured` returns them.
LISTEN = f"""(which) => {{
  const player = window.pianofitPlayers[which];
  window.analyser = new AnalyserNode(player.context, {{ fftSize: {CAPTURED} }});
  player.output.connect(window.analyser);
  window.captured = () => {{
    const samples = new Float32Array({CAPTURED});
    window.analyser.getFloatTimeDomainData(samples);
    return Array.from(samples);
  }};
}}"""


@pytest.fixture(scope="module")
def browser():
    with sync_api.sync_playwright() as play:
        browser = play.chromium.launch(executable_path=CHROMIUM, args=ARGUMENTS.split())
        yield browser
        browser.close()


def sounds_of(path, player):
    """Return the samples of the WAV files of one player in the page, by name."""
    pattern = rf'data-player="{player}" data-name="([^"]+)" [^>]*href="data:audio/wav;base64,([^"]+)"'
    links = re.findall(pattern, path.read_text(encoding="utf-8"))
    return {name: sf.read(io.BytesIO(base64.b64decode(data)))[0] for name, data in links}


def page_of(result, title, held_out=None, strokes=None):
    """Return the page with these sounds of the velocity slider."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("pianofit.report.sound.strokes_of", lambda _: strokes or ({}, False))
        return report_bytes(result, title, held_out)


@pytest.fixture(scope="module")
def report(tmp_path_factory):
    path = tmp_path_factory.mktemp("page") / "a page #1?.html"
    path.write_bytes(page_of(example_result(rate=RATE, seconds=5.0), "</script>'\""))
    sounds = sounds_of(path, "note")
    assert tuple(sounds) == NAMES
    return path, sounds


@pytest.fixture
def page(browser, report):
    """Open the page. Afterwards check that it made no requests and reported no errors."""
    page = browser.new_page(viewport={"width": 1280, "height": 800})
    errors, requests = [], []
    page.on("console", lambda message: errors.append(message.text))
    page.on("pageerror", lambda error: errors.append(str(error)))
    page.on("request", lambda request: requests.append(request.url))
    page.goto(report[0].as_uri())
    page.evaluate(LISTEN, 0)
    yield page
    page.close()
    assert errors == []
    assert [url[:60] for url in requests if not url.startswith("data:")] == [report[0].as_uri()[:60]]


def state(page):
    return page.evaluate("window.pianofitPlayer.state")


# Let a player play on to a position, s, and stop its clock there.
PLAY_TO = """([name, position]) => {
  const player = window.pianofitPlayers.find((one) => one.root.id === name);
  const reached = player.state.position >= position;
  if (reached) player.context.suspend(); else player.context.resume();
  return reached;
}"""


def play_to(page, position, player="note"):
    """Play on to a position, s, and stop the clock, so that a slow machine reaches no later position or the end."""
    page.wait_for_function(PLAY_TO, arg=[player, position], polling=10)


def let_run(page):
    """Start the clock of the first player again."""
    page.evaluate("window.pianofitPlayer.context.resume()")


def captured(page):
    return np.array(page.evaluate("window.captured()"))


def locate(block, sound):
    """Return the position of `block` in `sound` by least squares, and the largest difference."""
    product = np.fft.irfft(np.fft.rfft(sound, 2**18) * np.conj(np.fft.rfft(block, 2**18)))[: len(sound) - len(block)]
    energy = np.cumsum(np.concatenate([[0.0], sound**2]))
    at = int(np.argmin(energy[len(block) : -1] - energy[: -len(block) - 1] - 2 * product))
    return at, np.max(np.abs(sound[at : at + len(block)] - block))


def test_page_opens_at_a_laptops_width_and_shows_its_pictures(page):
    assert page.evaluate("document.documentElement.scrollWidth") <= 1280
    sizes = page.evaluate(SIZES)
    assert len(sizes) == 14
    assert all(natural > 500 and shown > 500 for natural, shown in sizes)
    assert page.locator("h1").inner_text() == "</script>'\""
    assert page.evaluate("getComputedStyle(document.body).backgroundColor") == "rgb(255, 255, 255)"
    page.emulate_media(color_scheme="dark")
    paper, ink = (
        np.array([int(x) for x in re.findall(r"\d+", page.evaluate(f"getComputedStyle(document.body).{what}"))])
        for what in ("backgroundColor", "color")
    )
    assert paper.max() < 64 < 192 < ink.min()


def test_the_physics_is_hidden_on_request(page):
    """By key. The summary, the player and the provenance remain."""
    box, physics = page.get_by_label("Hide the physics"), page.locator("#parameters, #evidence, #identifiability")
    visible = [physics.nth(i).is_visible() for i in range(physics.count())]
    assert visible
    assert all(visible)
    box.focus()
    page.keyboard.press("Space")
    assert not any(physics.nth(i).is_visible() for i in range(physics.count()))
    assert page.locator("#in-short").is_visible()
    assert page.locator("#note").is_visible()
    assert page.locator("#provenance").is_visible()


def test_policy_keeps_the_page_from_the_network(browser, report):
    page, asked = browser.new_page(), []
    page.goto(report[0].as_uri())
    page.route("**/*", lambda route: (asked.append(route.request.url), route.fulfill(body="x")))
    blocked = page.evaluate("""async () => {
      const blocked = [];
      addEventListener("securitypolicyviolation", (event) => blocked.push(event.effectiveDirective));
      await fetch("http://127.0.0.1:9/a").catch(() => 0);
      const image = new Image(), script = document.createElement("script");
      const tried = new Promise((done) => { image.onerror = done; });
      image.src = "http://127.0.0.1:9/b.png";
      script.textContent = "window.ran = true";
      document.body.append(script);
      await tried;
      return [...blocked.sort(), String(window.ran)];
    }""")
    page.close()
    assert blocked == ["connect-src", "img-src", "script-src-elem", "undefined"]
    assert asked == []


def test_each_sound_is_played_as_it_is_and_equally_loud(page, report):
    loudness = {}
    for key, name in enumerate(NAMES, start=1):
        page.keyboard.press(str(key))
        page.keyboard.press("Space")
        play_to(page, 1.4)
        played = captured(page)
        at, difference = locate(played[-9000:], report[1][name])
        assert difference < 1e-6, name  # the 16-bit samples as float32
        first_second = played[CAPTURED - 9000 - at :][:RATE]
        np.testing.assert_allclose(first_second, report[1][name][:RATE], atol=1e-6)
        loudness[name] = 10 * np.log10(k_weighted_mean_square(first_second, RATE))
        page.keyboard.press("Space")
        page.keyboard.press("Home")
    assert max(loudness.values()) - min(loudness.values()) < 0.1


def test_switching_in_mid_play_goes_on_from_the_same_place(page, report):
    page.keyboard.press("Space")
    play_to(page, 0.8)
    page.keyboard.press("3")
    switched = state(page)["position"]
    play_to(page, switched + 0.5)
    played = captured(page)
    original, fitted = report[1]["original"], report[1]["fitted"]
    at, difference = locate(played[-3000:], fitted)
    assert difference < 1e-6
    assert np.max(np.abs(played[-3000:] - original[at : at + 3000])) > 0.01
    start = CAPTURED - 3000 - at  # start of the note, if the position was kept
    played_note = played[start:]
    length = len(played_note)
    is_original = np.abs(played_note - original[:length]) < 1e-6
    is_fitted = np.abs(played_note - fitted[:length]) < 1e-6
    last_original, first_fitted = np.argmin(is_original), length - np.argmin(is_fitted[::-1])
    assert last_original / RATE == pytest.approx(switched, abs=0.25)
    assert 0.005 * RATE < first_fitted - last_original < 0.03 * RATE  # a crossfade of 20 ms without a gap
    blend = slice(last_original, first_fitted)
    low, high = np.minimum(original, fitted)[blend], np.maximum(original, fitted)[blend]
    assert np.all((played_note[blend] >= low - 1e-6) & (played_note[blend] <= high + 1e-6))


def pressed(page):
    return [button.get_attribute("aria-pressed") for button in page.locator("button.choice").all()]


def test_everything_by_keyboard(page):
    said, play = page.get_by_role("status"), page.get_by_role("button", name=re.compile("Play|Pause"))
    reached, before = [], page.locator("nav a").count()
    for _ in range(before + 5):
        page.keyboard.press("Tab")
        reached.append(page.evaluate("document.activeElement.dataset.name || document.activeElement.id"))
    assert reached[before:] == ["play", *NAMES, "seek"]

    page.keyboard.press("Space")  # also on the slider
    assert (state(page)["playing"], play.inner_text(), said.inner_text()) == (True, "❚❚ Pause", "Playing original")
    page.keyboard.press("2")
    assert (pressed(page), said.inner_text()) == (["false", "true", "false"], "Playing initial")
    page.keyboard.press("Space")
    assert (state(page)["playing"], play.inner_text(), said.inner_text()) == (False, "▶ Play", "Paused")

    page.keyboard.press("Home")
    assert state(page)["position"] == 0
    for _ in range(3):
        page.keyboard.press("ArrowRight")
    page.keyboard.press("ArrowLeft")
    assert state(page)["position"] == pytest.approx(1.0)
    slider = page.get_by_role("slider")
    assert float(slider.input_value()) == pytest.approx(1.0)
    assert slider.get_attribute("aria-valuetext") == "1.0 of 5.0 seconds"

    page.locator("button.choice").nth(2).focus()
    page.keyboard.press("Space")  # presses the focused button
    assert (pressed(page), state(page)["playing"]) == (["false", "false", "true"], False)
    page.keyboard.press("Space")  # plays when the button is already pressed
    assert (pressed(page), state(page)["playing"]) == (["false", "false", "true"], True)
    page.keyboard.press("ArrowRight")
    assert 1.5 <= state(page)["position"] < 2.5
    page.keyboard.press("1")
    page.keyboard.press("Space")  # the focus follows the choice
    assert (pressed(page), state(page)["playing"]) == (["true", "false", "false"], False)
    page.keyboard.press("Control+2")  # a key of the browser
    assert state(page)["chosen"] == "original"


def test_pause_keeps_the_place_and_the_end_returns_to_the_start(page, report):
    page.keyboard.press("3")
    page.evaluate("window.pianofitPlayer.seek(3.0)")
    page.get_by_role("button", name="Play").click()
    play_to(page, 3.3)
    page.get_by_role("button", name="Pause").click()
    place = state(page)["position"]
    let_run(page)
    page.wait_for_timeout(150)
    assert state(page)["position"] == place
    assert not captured(page)[-512:].any()
    page.keyboard.press("Space")  # the button has the focus; the key must act once
    assert state(page)["playing"]
    play_to(page, place + 0.2)
    _, difference = locate(captured(page)[-1500:], report[1]["fitted"][round(place * RATE) :])
    assert difference < 1e-6
    let_run(page)
    page.evaluate("window.pianofitPlayer.seek(4.8)")
    page.wait_for_function("() => !window.pianofitPlayer.state.playing")
    assert state(page)["position"] == 0
    assert page.get_by_role("status").inner_text() == "Ended"


# ---- several recordings ----

VELOCITIES = (3.2, 0.6, 1.5)


@pytest.fixture(scope="module")
def report_of_recordings(tmp_path_factory):
    result = example_result(fit_of_recordings(), rate=RATE, seconds=4.0)
    strokes = example_strokes(VELOCITIES, rate=RATE, seconds=4.0)
    path = tmp_path_factory.mktemp("recordings") / "report.html"
    path.write_bytes(page_of(result, "three recordings", example_held_out(), strokes))
    return path


@pytest.fixture
def recordings_page(browser, report_of_recordings):
    """Open the page of three recordings. Afterwards check that it reported no errors."""
    page, errors = browser.new_page(viewport={"width": 1280, "height": 800}), []
    page.on("console", lambda message: errors.append(message.text))
    page.on("pageerror", lambda error: errors.append(str(error)))
    page.goto(report_of_recordings.as_uri())
    yield page
    page.close()
    assert errors == []


def states(page):
    """Return the state of each player, by its name."""
    return page.evaluate("Object.fromEntries(window.pianofitPlayers.map((one) => [one.root.id, one.state]))")


@pytest.mark.parametrize("width", [1280, 400])
def test_page_of_recordings_fits_and_shows_all_its_pictures(recordings_page, width):
    recordings_page.set_viewport_size({"width": width, "height": 800})
    assert recordings_page.evaluate("document.documentElement.scrollWidth") <= width
    sizes = recordings_page.evaluate(SIZES)
    assert len(sizes) == 19
    # The text of a picture is 13 pixels high, and at least two thirds of that on a telephone.
    assert all(shown > 0.65 * natural > 325 for natural, shown in sizes)
    assert recordings_page.locator("#seek").bounding_box()["y"] < 800, "the player is on the first screen"


def test_slider_strikes_the_velocity_it_is_moved_to(recordings_page, report_of_recordings):
    sounds = sounds_of(report_of_recordings, "strokes")
    names = list(sounds)
    assert (len(names), names[0], names[-1]) == (7, "0.6 m/s", "3.2 m/s")
    recordings_page.evaluate(LISTEN, 1)
    slider = recordings_page.get_by_label("hammer velocity")
    slider.focus()
    assert (slider.input_value(), slider.get_attribute("aria-valuetext")) == ("6", "3.2 m/s")
    recordings_page.keyboard.press("Home")
    recordings_page.keyboard.press("ArrowRight")
    play_to(recordings_page, 1.0, "strokes")
    assert states(recordings_page)["strokes"] | {"position": 0} == {"playing": True, "chosen": names[1], "position": 0}
    assert slider.get_attribute("aria-valuetext") == names[1] == recordings_page.locator(".velocity").inner_text()
    played = captured(recordings_page)
    recordings_page.keyboard.press("Space")
    assert not states(recordings_page)["strokes"]["playing"]
    assert recordings_page.locator("#strokes .said").inner_text() == "Paused"
    at, difference = locate(played[-6000:], sounds[names[1]])
    assert difference < 1e-6
    np.testing.assert_allclose(
        played[CAPTURED - 6000 - at :][:RATE], sounds[names[1]][:RATE], atol=1e-6
    )  # from its attack
    peaks = [np.abs(sound).max() for sound in sounds.values()]
    assert np.all(np.diff(peaks) > 0)
    assert peaks[0] / peaks[-1] == pytest.approx(0.6 / 3.2, rel=0.1)


def test_each_recording_is_played_and_only_one_player_at_a_time(recordings_page, report_of_recordings):
    sounds = sounds_of(report_of_recordings, "recording-3")
    recordings_page.keyboard.press("Space")  # the player of the reference recording is active first
    recordings_page.get_by_label("Player: recording 3").get_by_role("button", name="Fitted").click()
    assert states(recordings_page)["note"]["playing"]
    recordings_page.evaluate(LISTEN, 3)
    recordings_page.get_by_label("Player: recording 3").get_by_role("button", name="Play").click()
    play_to(recordings_page, 1.0, "recording-3")
    now = states(recordings_page)
    assert {name: one["playing"] for name, one in now.items()} == {
        "note": False, "strokes": False, "recording-2": False, "recording-3": True,
    }  # fmt: skip
    assert now["recording-3"]["chosen"] == "fitted"
    assert recordings_page.get_by_role("button", name="Play").count() == 3
    _, difference = locate(captured(recordings_page)[-6000:], sounds["fitted"])
    assert difference < 1e-6
    recordings_page.keyboard.press("1")  # keys go to the player last used
    now = states(recordings_page)
    assert (now["recording-3"]["chosen"], now["note"]["chosen"]) == ("original", "original")
    play_to(recordings_page, now["recording-3"]["position"] + 0.5, "recording-3")
    _, difference = locate(captured(recordings_page)[-2000:], sounds["original"])
    assert difference < 1e-6
    recordings_page.keyboard.press("3")  # it has no third sound
    assert states(recordings_page)["recording-3"]["chosen"] == "original"


# ---- a key with modes ----


@pytest.fixture(scope="module")
def report_of_ringing(tmp_path_factory):
    path = tmp_path_factory.mktemp("ringing") / "report.html"
    fit = example_fit(modal_response=response_content())
    path.write_bytes(page_of(example_result(fit, rate=RATE, seconds=5.0, modes=True), "a key that rings"))
    return path


@pytest.mark.parametrize(("width", "scheme"), [(1600, "light"), (400, "dark")])
def test_a_key_that_rings_is_shown_and_heard_in_both_channels(browser, report_of_ringing, width, scheme):
    page = browser.new_page(viewport={"width": width, "height": 800}, color_scheme=scheme)
    errors, requests = [], []
    page.on("console", lambda message: errors.append(message.text))
    page.on("pageerror", lambda error: errors.append(str(error)))
    page.on("request", lambda request: requests.append(request.url[:5]))
    page.goto(report_of_ringing.as_uri())
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    sizes = page.evaluate(SIZES)
    assert len(sizes) == 23
    assert all(shown > 0.65 * natural > 325 for natural, shown in sizes)
    assert max(shown for *_, shown in sizes) - min(shown for *_, shown in sizes) <= 1
    page.evaluate(LISTEN, 0)
    page.keyboard.press("2")
    page.keyboard.press("Space")
    assert page.get_by_role("status").inner_text() == "Playing fitted"
    play_to(page, 1.0)
    fitted = sounds_of(report_of_ringing, "note")["fitted"]
    assert fitted.shape[1] == 2
    # An analyser captures the mean of the channels.
    _, difference = locate(captured(page)[-6000:], fitted.mean(axis=1))
    assert difference < 1e-6
    page.keyboard.press("3")
    assert page.get_by_role("status").inner_text() == "Playing string model"
    page.close()
    assert errors == []
    assert {*requests} <= {"file:", "data:"}


# ---- pictures ----


def test_a_picture_is_enlarged_by_keyboard_and_its_text_can_be_selected(page):
    page.evaluate("document.querySelectorAll('.drawing')[2].scrollIntoView()")
    panel = page.locator(".panel").nth(2)
    button = panel.get_by_role("button")
    small = panel.locator("svg").bounding_box()["width"]
    button.focus()
    page.keyboard.press("Space")  # presses the focused button; the player stays silent
    assert not state(page)["playing"]
    dialog = page.get_by_role("dialog")
    shown = dialog.locator("svg")
    whole = shown.bounding_box()["width"]
    assert whole > 1.3 * small
    page.keyboard.press("+")
    assert shown.bounding_box()["width"] == pytest.approx(1.25 * whole, rel=0.01)
    page.mouse.move(640, 400)
    page.mouse.wheel(0, -100)
    page.wait_for_function("() => document.querySelector('dialog .scale').textContent === '156 %'")
    shown.locator("text", has_text="fitted").first.dblclick()
    assert page.evaluate("getSelection().toString().trim()") == "fitted"
    page.keyboard.press("Escape")
    assert dialog.count() == 0
    assert panel.locator("svg").bounding_box()["width"] == pytest.approx(small, abs=1)
    assert page.evaluate("document.activeElement.className") == "zoom"


def test_swatches_and_lines_have_one_colour_in_both_modes(page):
    def colours(scheme):
        page.emulate_media(color_scheme=scheme)
        return page.evaluate("""() => ["measured", "initial", "fitted"].map((name) => {
          const line = [...document.querySelectorAll(".drawing svg path")].find((one) =>
            one.getAttribute("style")?.includes(`stroke: var(--${name})`));
          const swatch = document.querySelector(name === "measured" ? ".swatch" : `.swatch.${name}`);
          return [getComputedStyle(line).stroke, getComputedStyle(swatch).borderTopColor];
        })""")

    light, dark = colours("light"), colours("dark")
    assert all(line == swatch for line, swatch in (*light, *dark))
    assert all(one != other for (one, _), (other, _) in zip(light, dark, strict=True))
