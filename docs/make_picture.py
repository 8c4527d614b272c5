"""Make the README's picture from the demo's fit: `python docs/make_picture.py`."""

from __future__ import annotations

import tempfile
from pathlib import Path

from pianofit.cli.demo import run_demo
from pianofit.report.build import curves_of
from pianofit.report.figures import write_picture

PICTURE = Path(__file__).with_name("picture.png")


def main() -> None:
    """Fit the demo's measurement and draw it."""
    with tempfile.TemporaryDirectory() as folder:
        result, _ = run_demo(Path(folder), noise_db=60.0, seed=0, progress=lambda *_: None)
    write_picture(PICTURE, result.document, curves_of(result))


if __name__ == "__main__":
    main()
