"""Make the README's picture of the page to play: `python docs/make_page_picture.py`. It needs Chromium."""

from __future__ import annotations

import shutil
from pathlib import Path
from tempfile import TemporaryDirectory

from playwright.sync_api import sync_playwright

import pianofit as pf

PICTURE = Path(__file__).with_name("piano.png")
RECORDED = ("C2", "C3", "C4", "F#4", "C5", "C6")
CHORD = "ADGK"  # letters of the computer's keyboard: C4, E4, G4, C5
WIDTH, HEIGHT = 1200, 700  # pixels


def main() -> None:
    """Fit synthetic recordings of some keys, build the instrument, and photograph its page with a chord held."""
    with TemporaryDirectory() as folder:
        for number, name in enumerate(RECORDED):
            it = pf.typical(name)
            made = pf.synthetic_recording(
                it.string, it.hammer, it.geometry, quantity="bridge-force", noise_db=60.0, seed=number, scale=20.0
            )
            pf.fit(made.recording, setup=made.setup, note=name).save(Path(folder, "fits", name), page=False)
        piano = pf.build_instrument(pf.load_keys(pf.find_fits([Path(folder, "fits")])), "Six keys to 88")
        page = Path(folder, "piano.html")
        pf.write_playable_page(page, piano)
        PICTURE.write_bytes(photograph(page))


def photograph(page: Path) -> bytes:
    """Return a PNG of a page to play, with a chord held."""
    with sync_playwright() as play:
        browser = play.chromium.launch(executable_path=shutil.which("chromium"), args=["--no-sandbox"])
        view = browser.new_page(viewport={"width": WIDTH, "height": HEIGHT})
        view.goto(page.as_uri())
        view.wait_for_selector("#loading", state="hidden", timeout=120_000)
        for letter in CHORD:
            view.keyboard.down(letter)
        view.wait_for_timeout(500)
        picture = view.screenshot()
        browser.close()
    return picture


if __name__ == "__main__":
    main()
