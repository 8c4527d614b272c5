"""One HTML file that is an instrument: keyboard, engine and the numbers of every key; it loads nothing."""

from __future__ import annotations

import os
import re
from typing import Any, NamedTuple

from ..instrument.document import Instrument
from ..instrument.text import unrecorded_text
from ..report import html
from .payload import Knocks, payload
from .recordings import recorded_layers

__all__ = ["LARGEST_PAGE", "Page", "engine", "source", "write_page"]

# Bytes: what a mail takes, and a browser opens at once.
LARGEST_PAGE = 1_500_000
# Bytes of them for the script, the style and the words: 126,000 today, and some room.
OWN = 135_000
# Modules that know of no page; they become one, which the page's own thread and the audio thread both load.
ENGINE = (
    "contact.js", "engine.js", "prepare.js", "output.js", "change.js", "note.js", "instrument.js", "midi.js",
    "record.js", "loudness.js",
)  # fmt: skip
# Where recordings are beside the instrument; the first is the kit's.
COMPARING = ("audio.js", "compare.js")
SCRIPTS = ("player.js", "workbench.js", "song.js", "keyboard.js")
IMPORT = re.compile(r'^import .* from "\./\w+\.js";\n', re.MULTILINE)
PACKAGE = "pianofit.web"


class Page(NamedTuple):
    """What was written."""

    keys: int
    recorded: int
    between: int  # keys that are guesses, between recorded ones
    beyond: int  # and beyond them
    knocks: Knocks | None  # how they are kept, if the instrument has any
    layers: int  # recordings that are in it


def write_page(path: str | os.PathLike[str], instrument: Instrument, recordings: bool = False) -> Page:
    """Write an instrument's page, of at most 1.5 MB, whole or not at all.

    Parameters
    ----------
    recordings : put every recorded layer into it, to be heard beside its key; they come on top of the 1.5 MB.

    Raises `ParameterError` for a felt that a page cannot play, or an instrument or recordings that do not fit;
    `FitError` if recordings are wanted, and are not there; `OutputError` if `path` cannot be written.
    """
    between, beyond = instrument.unrecorded_counts
    document, knocks = payload(instrument, LARGEST_PAGE - OWN)
    content: dict[str, Any] = {
        "instrument": document,
        "modules": {"engine": engine(), "worklet": source("worklet.js")},
        "recorded": sum(key["recorded"] for key in document["keys"]),
        "guesses": unrecorded_text(between, beyond) + _changed(len(instrument.changed)),
        "layers": recorded_layers(instrument) if recordings else {},
    }  # fmt: skip
    html.write_page(
        path, "page.html.j2", package=PACKAGE, styles=("keyboard.css",),
        scripts=(*COMPARING, *SCRIPTS) if recordings else SCRIPTS, title=instrument.name or "Piano", **content,
    )  # fmt: skip
    return Page(
        len(document["keys"]), content["recorded"], between, beyond, knocks, sum(map(len, content["layers"].values()))
    )


def _changed(count: int) -> str:
    """The end of the sentence about guesses, if keys were changed by hand."""
    return f"; {count} {'was' if count == 1 else 'were'} changed by hand" if count else ""


def engine() -> str:
    """The modules that know of no page, as one."""
    return IMPORT.sub("", "".join(map(source, ENGINE)))


def source(name: str) -> str:
    """One of the scripts beside this file."""
    return html.asset(name, PACKAGE)
