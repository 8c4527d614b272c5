"""Fixtures of the tests with a browser, loaded as a plugin: the browser, a written page, and the open page."""

from __future__ import annotations

from dataclasses import replace

import pytest
from instrument_cases import notes_of, piano_of, true_instrument, uneven_note
from page_browser_cases import CHROMIUM
from page_cases import ringing_note

from pianofit.schema.instrument import KeyValue
from pianofit.web import write_playable_page

ARGUMENTS = (
    "--headless --no-sandbox --disable-gpu --disable-quic --no-first-run --disable-background-networking "
    "--disable-component-update --disable-sync"
)


@pytest.fixture(scope="module")
def browser():
    from playwright.sync_api import sync_playwright

    with sync_playwright() as play:
        browser = play.chromium.launch(executable_path=CHROMIUM, args=ARGUMENTS.split())
        yield browser
        browser.close()


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    notes = notes_of(true_instrument(range(48, 73))) | {60: uneven_note(60), 64: ringing_note(64)}
    piano = piano_of(notes, recorded=(60, 64), name="</script>'\"")
    path = tmp_path_factory.mktemp("page") / "a piano #1?.html"
    values = {"M_H/M_S": KeyValue(1.0, (0.5, 2.0)), "p": KeyValue(2.0, (1.9, 2.2))}
    write_playable_page(path, replace(piano, keys={**piano.keys, 60: replace(piano.keys[60], values=values)}))
    return path


@pytest.fixture
def page(browser, written):
    """The open page, which must make no requests and log nothing."""
    page = browser.new_page(viewport={"width": 1280, "height": 900})
    complaints, requests = [], []
    page.on("console", lambda message: complaints.append(message.text))
    page.on("pageerror", lambda error: complaints.append(str(error)))
    page.on("request", lambda request: requests.append(request.url))
    page.goto(written.as_uri())
    page.wait_for_function("() => Boolean(window.pianofitKeyboard)")
    yield page
    page.close()
    assert complaints == []
    elsewhere = [url for url in requests if not url.startswith(("blob:", "data:"))]
    assert elsewhere == [written.as_uri()]
