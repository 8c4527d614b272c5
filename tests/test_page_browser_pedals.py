"""Pedals and resonance of the page in a real browser."""

from __future__ import annotations

from pathlib import Path

import pytest
from page_browser_cases import CHROMIUM, LISTEN, at

sync_api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
if not Path(CHROMIUM).exists():
    pytest.skip("chromium is not installed (Debian: apt-get install chromium)", allow_module_level=True)
pytest_plugins = ("page_browser_fixtures",)


def test_pedals_move_on_screen_by_letters_and_by_midi(page):
    values = "() => [64, 66, 67].map((it) => window.pianofitKeyboard.player.pedals.get(it) ?? 0)"
    pressed = lambda: [page.locator(it).get_attribute("aria-pressed") for it in ("#pedal", "#sostenuto", "#soft")]  # noqa: E731
    page.keyboard.press("KeyC")
    page.locator("#sostenuto").click()
    assert page.evaluate(values) == [0, 127, 127]
    page.keyboard.press("KeyV")
    page.locator("#half").focus()
    page.keyboard.press("PageUp")
    value = page.evaluate(values)[0]
    assert 0 < value < 64
    assert (pressed(), page.evaluate(values)[1:]) == (["mixed", "false", "true"], [0, 127])
    page.evaluate("() => window.pianofitKeyboard._message([0xb0, 64, 50])")
    assert page.locator("#half").get_attribute("aria-valuetext") == "50, dampers half"
    page.locator("#range-high").fill("40")
    page.locator("#range-high").press("Enter")
    assert page.locator("#half-words").inner_text() == "50, dampers up"
    page.locator("#range-low").fill("90")  # above the other end
    page.locator("#range-low").press("Enter")
    assert page.evaluate("() => window.pianofitKeyboard.player.range") == {"low": 24, "high": 40}
    page.keyboard.press("Escape")
    page.locator("#half").press("Escape")
    assert page.evaluate(values) == [0, 0, 0]
    names = [page.get_by_role(role, name=name) for role, name in (("group", "Pedals"), ("slider", "Right pedal"))]
    assert [it.count() for it in names] == [1, 1]


def test_a_held_key_resonates_unless_it_is_switched_off(page):
    """C3 is held silently, and C4, which its second partial meets, is struck and let go."""
    page.wait_for_function("() => document.getElementById('loading').hidden")
    level = """async () => {
      const keys = window.pianofitKeyboard, { player } = keys, pause = (ms) => new Promise((go) => setTimeout(go, ms));
      await keys.play(48, 1);
      await pause(100);
      await keys.play(60, 120);
      await pause(400);
      keys.release(60);
      await pause(1100);
      const samples = window.lastSamples(), power = samples.reduce((sum, x) => sum + x * x, 0) / samples.length;
      keys.panic();
      await pause(300);
      return 10 * Math.log10(power + 1e-30);
    }"""
    page.mouse.click(*at(page, 72))
    page.wait_for_function("() => Boolean(window.pianofitKeyboard.player.context)")
    page.evaluate(LISTEN)
    page.wait_for_timeout(2000)  # responses are sent with pauses
    on = page.evaluate(level)
    page.locator("#resonance").uncheck()
    assert on > page.evaluate(level) + 0.3
