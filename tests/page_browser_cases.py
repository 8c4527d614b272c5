"""Helpers of the tests of the page in a browser; the fixtures are in `page_browser_fixtures.py`."""

from __future__ import annotations

import shutil

CHROMIUM = shutil.which("chromium") or "/usr/bin/chromium"
WINDOW = 32768  # samples of an analyser: 0.7 s

# An analyser after the engine holds the last samples; `lastSamples` returns them.
LISTEN = f"""() => {{
  const {{ player }} = window.pianofitKeyboard;
  const analyser = new AnalyserNode(player.context, {{ fftSize: {WINDOW} }});
  player.node.connect(analyser);
  window.lastSamples = () => {{
    const samples = new Float32Array({WINDOW});
    analyser.getFloatTimeDomainData(samples);
    return Array.from(samples);
  }};
}}"""


def sounding(page, count):
    page.wait_for_function("n => window.pianofitKeyboard.player.sounding === n", arg=count, timeout=60_000)


def at(page, midi):
    key = page.locator(f'.key[data-midi="{midi}"]')
    key.scroll_into_view_if_needed()
    box = key.bounding_box()
    return box["x"] + box["width"] / 2, box["y"] + 0.9 * box["height"]
