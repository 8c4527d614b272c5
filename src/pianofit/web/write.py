"""Writer of the page: one HTML file with keyboard, engine and the tables of all keys, without external files."""

from __future__ import annotations

import os
import re
from typing import Any, NamedTuple

from ..instrument.document import Instrument
from ..instrument.text import unrecorded_text
from ..report import html
from .payload import KnockEncoding, encode_instrument
from .recordings import recorded_layers

__all__ = ["PAGE_BYTES", "PageSummary", "engine_source", "script_source", "write_page"]

# Bytes: small enough for an e-mail, and for a browser to open without delay.
PAGE_BYTES = 1_500_000
# Bytes reserved for scripts, styles and text: 131,000 today, with a margin.
SCRIPT_BYTES = 135_000
# Modules without a user interface. Joined into one, they are loaded by both the main and the audio thread.
ENGINE = (
    "signal.js", "contact.js", "engine.js", "prepare.js", "output.js", "change.js", "note.js", "instrument.js",
    "midi.js", "record.js", "loudness.js",
)  # fmt: skip
# Additional scripts for pages with recordings; the first is shared by all pages.
COMPARING = ("audio.js", "compare.js")
SCRIPTS = ("player.js", "workbench.js", "song.js", "keyboard.js")
IMPORT = re.compile(r'^import [^;]* from "\./\w+\.js";\n', re.MULTILINE)
PACKAGE = "pianofit.web"


class PageSummary(NamedTuple):
    """Contents of the written page."""

    keys: int
    recorded: int
    between: int  # keys that are guesses, between recorded keys
    beyond: int  # keys that are guesses, beyond the recorded range
    knocks: KnockEncoding | None  # encoding of knocks, if the instrument has any
    layers: int  # recordings in the page


def write_page(path: str | os.PathLike[str], instrument: Instrument, recordings: bool = False) -> PageSummary:
    """Write the page of an instrument, of at most 1.5 MB, completely or not at all.

    Parameters
    ----------
    recordings : include every recorded layer for comparison with its key, in addition to the 1.5 MB.

    Raises `ParameterError` for a felt law that a page cannot play, or an instrument or recordings that are too large.
    Raises `FitError` if requested recordings are missing, and `OutputError` if `path` cannot be written.
    """
    between, beyond = instrument.unrecorded_counts
    document, knocks = encode_instrument(instrument, PAGE_BYTES - SCRIPT_BYTES)
    content: dict[str, Any] = {
        "instrument": document,
        "modules": {"engine": engine_source(), "worklet": script_source("worklet.js")},
        "recorded": sum(key["recorded"] for key in document["keys"]),
        "guesses": unrecorded_text(between, beyond) + _changed(len(instrument.changed)),
        "layers": recorded_layers(instrument) if recordings else {},
    }  # fmt: skip
    html.write_page(
        path, "page.html.j2", package=PACKAGE, styles=("keyboard.css",),
        scripts=(*COMPARING, *SCRIPTS) if recordings else SCRIPTS, title=instrument.name or "Piano", **content,
    )  # fmt: skip
    return PageSummary(
        len(document["keys"]), content["recorded"], between, beyond, knocks, sum(map(len, content["layers"].values()))
    )


def _changed(count: int) -> str:
    """End of the sentence about guesses, if keys were changed by hand."""
    return f"; {count} {'was' if count == 1 else 'were'} changed by hand" if count else ""


def engine_source() -> str:
    """Source of the modules without user interface, as one module."""
    return IMPORT.sub("", "".join(map(script_source, ENGINE)))


def script_source(name: str) -> str:
    """Source of a script in this package."""
    return html.asset(name, PACKAGE)
