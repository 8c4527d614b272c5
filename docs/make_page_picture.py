"""Make the README's picture of the page to play: `python docs/make_page_picture.py`. It needs Chromium."""

from __future__ import annotations

import shutil
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

from playwright.sync_api import sync_playwright

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "website"))
from playable import playable_files  # noqa: E402

PICTURE = Path(__file__).with_name("piano.png")
CHORD = "ADGK"  # letters of the computer's keyboard: C4, E4, G4, C5
WIDTH, HEIGHT = 1200, 700  # pixels


def main() -> None:
    """Photograph the page to play of the site with a chord held."""
    with TemporaryDirectory() as folder:
        for uri, content in playable_files(ROOT).items():
            Path(folder, uri).write_bytes(content)
            PICTURE.write_bytes(photograph(Path(folder, uri)))


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
