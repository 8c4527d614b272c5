"""The page in a real browser: it opens from a file, makes no requests, and plays."""

from __future__ import annotations

import io
import json
from pathlib import Path

import numpy as np
import pytest
import soundfile as sf
from instrument_cases import true_instrument
from page_browser_cases import CHROMIUM, LISTEN, at, sounding
from page_cases import ringing_note

from pianofit.instrument import load_instrument
from pianofit.playback import load_song
from pianofit.schema.instrument import KeyValue
from pianofit.schema.notes import load_note

sync_api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
if not Path(CHROMIUM).exists():
    pytest.skip("chromium is not installed (Debian: apt-get install chromium)", allow_module_level=True)
pytest_plugins = ("page_browser_fixtures",)


def test_a_pressed_key_sounds_and_is_damped(page):
    page.mouse.move(*at(page, 60))
    page.mouse.down()
    sounding(page, 1)
    page.evaluate(LISTEN)
    page.wait_for_function("() => window.lastSamples().some((x) => Math.abs(x) > 1e-4)")
    assert page.locator('.key[data-midi="60"]').evaluate("key => key.classList.contains('down')")
    page.mouse.up()
    sounding(page, 0)
    page.wait_for_function("() => window.lastSamples().every((x) => Math.abs(x) < 1e-6)")


def test_a_damper_does_not_click(page):
    """After the stroke, the second difference in 4 ms spans never exceeds the preceding three by a third."""
    page.mouse.click(*at(page, 60))  # the audio thread starts
    page.wait_for_function("() => Boolean(window.pianofitKeyboard.player.context)")
    page.evaluate(LISTEN)
    page.wait_for_function("() => window.lastSamples().every((x) => Math.abs(x) < 1e-6)")
    page.evaluate("""async () => {
      const keys = window.pianofitKeyboard;
      await keys.play(55, 90);
      const { context } = keys.player, begin = context.currentTime;
      while (context.currentTime < begin + 0.25) await new Promise((go) => setTimeout(go, 5));
      keys.release(55);
      while (context.currentTime < begin + 0.45) await new Promise((go) => setTimeout(go, 5));
    }""")
    sound = np.array(page.evaluate("() => window.lastSamples()"))
    bend = np.abs(np.diff(sound, 2))
    spans = bend[: len(bend) // 192 * 192].reshape(-1, 192).max(axis=1)
    struck = int(np.argmax(spans)) + 5
    before = np.max([spans[struck + i : len(spans) - 3 + i] for i in range(3)], axis=0)  # the largest of three
    assert len(before) > 60
    assert spans[-1] < 0.1 * spans[struck]  # it was damped
    assert np.max(spans[struck + 3 :] / before) < 1.3


def test_letters_play_and_what_was_played_is_saved(page, tmp_path):
    page.keyboard.press("Space")
    assert page.locator("#pedal").get_attribute("aria-pressed") == "true"
    page.keyboard.down("KeyA")
    sounding(page, 1)
    page.keyboard.up("KeyA")
    page.keyboard.press("KeyD")  # E4, which has its own ringing
    sounding(page, 2)
    page.keyboard.press("Space")
    sounding(page, 0)
    with page.expect_download() as download:
        page.locator("#save").click()
    download.value.save_as(tmp_path / "piano.wav")
    sound, rate = sf.read(io.BytesIO((tmp_path / "piano.wav").read_bytes()))
    assert rate == 48_000
    assert 1e-3 < np.abs(sound).max() <= 0.892
    assert np.abs(sound[-rate:]).max() < 1e-6  # the dampers have fallen


def test_keys_are_named_and_reached_without_a_mouse(page):
    names = page.locator(".key").evaluate_all("keys => keys.map((key) => key.getAttribute('aria-label'))")
    assert len(names) == 25
    assert (names[12], names[13]) == ("C4, recorded", "C sharp 4, a guess")
    assert page.locator(".key[tabindex='0']").count() == 1
    page.locator(".key[tabindex='0']").focus()
    page.keyboard.press("ArrowRight")
    page.keyboard.down("Enter")
    sounding(page, 1)
    assert page.locator("#which").inner_text() == "C#4"
    page.keyboard.up("Enter")
    sounding(page, 0)
    page.keyboard.press("Escape")


def test_a_midi_keyboard_plays_with_velocity_and_pedal(page):
    page.mouse.click(*at(page, 48))  # sound needs a gesture
    page.wait_for_function("() => Boolean(window.pianofitKeyboard.player.context)")
    sounding(page, 0)
    send = "(messages) => messages.forEach((bytes) => window.pianofitKeyboard._message(bytes))"
    page.evaluate(send, [[0xB0, 64, 127], [0x90, 62, 20], [0x90, 67, 120], [0x80, 62, 0], [0x90, 67, 0]])
    sounding(page, 2)
    assert page.locator("#pedal").get_attribute("aria-pressed") == "true"
    speeds = page.evaluate(
        "() => window.pianofitKeyboard.player.record.events.map((it) => it.velocity).filter(Boolean)"
    )
    assert speeds[1:] == pytest.approx([1.3 * np.exp(1.5 * (velocity - 64) / 63) for velocity in (20, 120)])
    page.evaluate(send, [[0xB0, 64, 0], [0x90, 20, 64]])  # a key that the instrument does not have does nothing
    sounding(page, 0)


def test_a_slider_changes_one_key_or_all_and_is_taken_back(page):
    page.mouse.click(*at(page, 60))
    page.wait_for_function("() => !document.getElementById('workbench').hidden")
    masses = "() => [60, 62].map((midi) => window.pianofitKeyboard.player.now[midi].hammer.M_H)"
    own = page.evaluate(masses)
    page.locator("#change-mass").focus()
    page.keyboard.press("End")
    assert page.evaluate(masses) == pytest.approx([4 * own[0], own[1]])
    page.locator("#for-all").check()
    page.locator("#change-mass").focus()
    page.keyboard.press("Home")
    assert page.evaluate(masses) == pytest.approx([own[0] / 4, own[1] / 4])
    page.locator("#undo").click()
    assert page.evaluate(masses) == pytest.approx([4 * own[0], own[1]])
    page.locator("#reset").click()
    assert page.evaluate(masses) == pytest.approx(own)
    drawn = page.locator("#pulse").evaluate(
        "c => c.getContext('2d').getImageData(0, 0, c.width, c.height).data.some((x) => x)"
    )
    assert drawn
    page.locator("#change-strike").focus()  # a new table, while the key sounds on
    page.mouse.move(*at(page, 60))
    page.mouse.down()
    sounding(page, 1)
    page.locator("#change-strike").press("End")
    page.mouse.up()
    page.mouse.click(*at(page, 60))
    sounding(page, 0)


def test_a_slider_shows_the_interval_where_it_is_known(page):
    page.mouse.click(*at(page, 60))
    page.locator("#change-mass").wait_for()
    shown = """name => {
      const input = document.getElementById(`change-${name}`), band = input.previousElementSibling;
      const [a, b] = [input, band].map((it) => it.getBoundingClientRect());
      return [(b.left - a.left - 8) / (a.width - 16), (b.right - a.left - 8) / (a.width - 16)];
    }"""
    assert page.evaluate(shown, "mass") == pytest.approx([0.25, 0.75], abs=0.01)  # 1/2 and 2 of 1/4 to 4
    assert page.evaluate(shown, "p") == pytest.approx([0.45, 0.6], abs=0.01)
    mass = 1e3 * true_instrument(range(60, 61)).keys[60].note.hammer.M_H
    words = page.locator("label", has=page.locator("#change-mass")).locator("small").inner_text()
    assert [float(x) for x in words.removeprefix("95 %: ").removesuffix(" g").split(" to ")] == pytest.approx(
        [0.5 * mass, 2 * mass], rel=5e-3
    )
    page.mouse.click(*at(page, 62))
    page.wait_for_function("() => document.getElementById('which').textContent === 'D4'")
    assert not page.locator(".sliders small:visible").count()


def test_a_key_is_saved_as_a_note_that_render_reads(page, tmp_path):
    page.mouse.click(*at(page, 64))
    page.locator("#change-mass").wait_for()  # the workbench is there once the key has sounded
    page.locator("#change-mass").focus()
    page.keyboard.press("End")
    with page.expect_download() as download:
        page.locator("#save-note").click()
    assert download.value.suggested_filename == "note.json"
    download.value.save_as(tmp_path / "note.json")
    note, rate = load_note(tmp_path / "note.json")
    own = ringing_note(64)
    assert rate == 48_000
    assert pytest.approx(4 * own.hammer.M_H) == note.hammer.M_H
    assert own.modal_response is not None
    assert note.modal_response is not None
    np.testing.assert_array_equal(note.modal_response.partial, own.modal_response.partial)
    origin = json.loads((tmp_path / "note.json").read_text())["origin"]
    assert origin.startswith("E4 of </script>'\", recorded, as the page plays it, changed by hand.")


def test_an_instrument_is_saved_with_all_that_was_set(page, written, tmp_path):
    page.mouse.click(*at(page, 64))
    page.locator("#change-mass").wait_for()
    page.locator("#change-mass").press("End")
    page.locator("#for-all").check()
    page.locator("#change-p").press("Home")
    page.locator("#for-all").uncheck()
    page.locator("#reset").focus()
    page.locator("#undo").click()
    page.locator("#volume").press("End")
    with page.expect_download() as download:
        page.locator("#save-instrument").click()
    assert download.value.suggested_filename == "instrument.json"
    download.value.save_as(tmp_path / "instrument.json")
    found, own = load_instrument(tmp_path / "instrument.json"), true_instrument(range(48, 73))
    assert found.name == "</script>'\""
    assert found.changed == [64]
    assert found.recorded == [60, 64]
    assert pytest.approx(4 * own.keys[64].note.hammer.M_H) == found.keys[64].note.hammer.M_H
    assert found.keys[62].note.hammer.M_H == own.keys[62].note.hammer.M_H
    gains = [found.keys[midi].note.gain / own.keys[midi].note.gain for midi in (50, 62)]
    assert gains == pytest.approx([10**1.5] * 2)
    assert found.keys[60].values == {"M_H/M_S": KeyValue(1.0, (0.5, 2.0)), "p": KeyValue(2.0, (1.9, 2.2))}


DROP = """([name, bytes]) => {
  const files = new DataTransfer();
  files.items.add(new File([new Uint8Array(bytes)], name));
  const how = { dataTransfer: files, bubbles: true, cancelable: true };
  for (const kind of ["dragover", "drop"]) document.body.dispatchEvent(new DragEvent(kind, how));
}"""
# E4 and G4 for a second each, and a note that this instrument does not have.
SONG = bytes.fromhex(
    "4d546864 00000006 0000 0001 01e0 4d54726b 00000022 00b0407f 00904050 00901e50 8740804040 00904360 00b04000"
    "8740804340 00ff2f00"
)
# E4 and the pedal, held for a minute and a half.
HELD = bytes.fromhex("4d546864 00000006 0000 0001 0010 4d54726b 00000011 00b0407f 00904050 9600ff0100 00ff2f00")


def test_a_dropped_song_plays_and_what_was_played_is_saved(page, tmp_path):
    page.evaluate(DROP, ["<b>song.mid", list(SONG)])
    page.wait_for_function("() => document.getElementById('said').textContent.includes('1 note is beyond')")
    assert page.locator("#song-name").inner_text() == "<b>song.mid, 2 notes"
    assert page.locator("#song-name b").count() == 0
    page.locator("#song-play").press("Enter")
    page.wait_for_function("() => document.querySelector('.key[data-midi=\"64\"]').classList.contains('down')")
    page.wait_for_function("() => document.getElementById('song-bar').value > 0")
    page.wait_for_function("() => document.querySelector('.key[data-midi=\"67\"]').classList.contains('down')")
    page.wait_for_function("() => document.getElementById('song-play').textContent.includes('Play')")
    sounding(page, 0)
    assert page.locator(".key.down").count() == 0
    files = {}
    for button, name in (("#save-midi", "piano.mid"), ("#save", "piano.wav")):
        with page.expect_download() as download:
            page.locator(button).click()
        assert download.value.suggested_filename == name
        files[name] = tmp_path / name
        download.value.save_as(files[name])
    song = load_song(files["piano.mid"])
    assert [[velocity for _, velocity in song.keys[key]] for key in (64, 67)] == [[80, 0], [96, 0]]
    assert song.keys[67][0][0] == pytest.approx(1.0, abs=0.002)
    assert [value for _, value in song.pedal] == [127, 0]
    assert np.abs(sf.read(files["piano.wav"])[0]).max() > 1e-3


def test_a_song_is_stopped_and_its_keys_are_let_go(page):
    page.set_input_files("#song-file", {"name": "held.mid", "mimeType": "audio/midi", "buffer": HELD})
    page.locator("#song-play:enabled").click()
    sounding(page, 1)
    page.keyboard.press("Escape")
    sounding(page, 0)
    assert page.locator("#song-play").inner_text() == "▶ Play"
    assert page.locator("#pedal").get_attribute("aria-pressed") == "false"
    assert page.locator(".key.down").count() == 0


def test_a_dropped_file_that_is_no_song_is_refused_in_a_line(page):
    for data in (b"", b"no song", SONG[:20]):
        page.evaluate("() => { document.getElementById('said').textContent = ''; }")
        page.evaluate(DROP, ["<i>x</i>.txt", list(data)])
        page.wait_for_function("() => document.getElementById('said').textContent.includes('MIDI')")
        said = page.locator("#said").inner_text()
        assert said.startswith("<i>x</i>.txt: ")
        assert "\n" not in said
        assert page.locator("#song-play").is_disabled()


def test_what_loads_is_labelled(page):
    page.wait_for_function("() => /25 of 25 keys/.test(document.getElementById('ready-words').textContent)")
    assert page.locator("#ready").get_attribute("aria-labelledby") == "ready-words"
    page.wait_for_function("() => document.getElementById('loading').hidden")


@pytest.mark.parametrize("width", [400, 1400])
def test_sliders_of_a_row_are_aligned(page, width):
    """Also where one label takes two lines, or has an interval below."""
    page.set_viewport_size({"width": width, "height": 900})
    page.evaluate("() => window.pianofitKeyboard.play(60, 80)")
    page.locator("#change-mass").wait_for()
    boxes = [box.bounding_box() for box in page.locator(".sliders input").all()]
    columns = sorted({round(box["x"]) for box in boxes})
    assert len(columns) == (1 if width == 400 else 4)
    for first in range(0, len(boxes), len(columns)):
        row = boxes[first : first + len(columns)]
        assert [round(box["x"]) for box in row] == columns[: len(row)]
        assert {round(box["y"], 1) for box in row} == {round(row[0]["y"], 1)}
        assert {round(box["width"], 1) for box in row} == {round(row[0]["width"], 1)}


def test_the_page_fits_its_width(page):
    assert page.locator("h1").inner_text() == "</script>'\""
    for width in (1600, 400):
        page.set_viewport_size({"width": width, "height": 900})
        assert page.evaluate("document.documentElement.scrollWidth") <= width
        box = page.locator('.key[data-midi="60"]').bounding_box()
        assert box["width"] >= 28
        assert 0 <= box["x"] < width - 28


def test_where_the_audio_thread_is_forbidden_the_page_says_why(browser, written, tmp_path):
    strict = tmp_path / "strict.html"
    html = written.read_text().replace(" blob: data:;", " blob:;")
    strict.write_text(html)
    page = browser.new_page()
    page.goto(strict.as_uri())
    page.wait_for_function("() => Boolean(window.pianofitKeyboard)")
    page.mouse.click(*at(page, 60))
    page.locator("#refused").wait_for(state="visible")
    assert "No sound: " in page.locator("#refused").inner_text()
    page.close()
