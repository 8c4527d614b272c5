"""Writer of the page: one HTML file with keyboard, engine and the tables of all keys, without external files."""

import os
import re
from typing import NamedTuple

from ..instrument import Instrument
from ..io.files import check_ending
from ..report import html
from .payload import encode_instrument
from .recordings import recorded_layers

# Bytes: small enough for an e-mail, and for a browser to open without delay.
PAGE_BYTES = 1_500_000
# Bytes reserved for scripts, styles and text: 166,800 today, with a margin.
SCRIPT_BYTES = 170_000
# Modules without a user interface. Joined into one, they are loaded by both the main and the audio thread.
ENGINE = (
    "signal.js",
    "contact.js",
    "pedals.js",
    "prepare.js",
    "free_strings.js",
    "resonance.js",
    "release.js",
    "engine.js",
    "output.js",
    "change.js",
    "note.js",
    "instrument.js",
    "midi.js",
    "record.js",
    "loudness.js",
)
# Additional scripts for pages with recordings; the first is shared by all pages.
COMPARING = ("audio.js", "compare.js")
SCRIPTS = ("player.js", "workbench.js", "song.js", "keyboard.js")
IMPORT = re.compile(r'^import [^;]* from "\./\w+\.js";\n', re.MULTILINE)
# Comments that fill lines. A page has room for sounds instead.
COMMENT = re.compile(r"^ *(//.*|/\*\*(.|\n)*?\*/)\n", re.MULTILINE)
PACKAGE = "pianofit.web"


class PageSummary(NamedTuple):
    """Contents of the written page, in addition to the keys of the instrument."""

    knock_error_db: float | None  # largest error of a knock, relative to its note, if the instrument has any
    layers: int  # recordings


def write_playable_page(path: str | os.PathLike[str], instrument: Instrument, recordings: bool = False) -> PageSummary:
    """Write the page of an instrument, of at most 1.5 MB, completely or not at all.

    Parameters
    ----------
    path : HTML file to write.
    instrument : instrument to play.
    recordings : include every recorded layer for comparison with its key, in addition to the 1.5 MB.

    Returns
    -------
    The error of the knocks, and the number of recordings.

    Raises
    ------
    ParameterError
        For a felt law that a page cannot play, or an instrument or recordings that are too large.
    FitError
        If requested recordings are missing.
    OutputError
        If `path` cannot be written.

    Examples
    --------
    >>> import pianofit
    >>> pianofit.write_playable_page("piano.html", pianofit.load_instrument("instrument.json"))
    PageSummary(knock_error_db=None, layers=0)
    """
    check_ending(path, ".html", ".htm")
    payload, knock_error_db = encode_instrument(instrument, PAGE_BYTES - SCRIPT_BYTES)
    layers = recorded_layers(instrument) if recordings else {}
    changed = len(instrument.changed)
    by_hand = f"; {changed} {'was' if changed == 1 else 'were'} changed by hand" if changed else ""
    html.write_page(
        path,
        "page.html.j2",
        package=PACKAGE,
        styles=("keyboard.css",),
        scripts=(*COMPARING, *SCRIPTS) if recordings else SCRIPTS,
        title=instrument.name or "Piano",
        instrument=payload,
        is_plucked=not instrument.law.has_contact,
        modules={"engine": engine_source(), "worklet": script_source("worklet.js")},
        recorded=len(instrument.recorded),
        guesses=instrument.guesses + by_hand,
        layers=layers,
    )
    return PageSummary(knock_error_db, sum(map(len, layers.values())))


def engine_source() -> str:
    """Source of the modules without user interface, as one module without comments."""
    return COMMENT.sub("", IMPORT.sub("", "".join(map(script_source, ENGINE))))


def script_source(name: str) -> str:
    """Source of a script in this package."""
    return html.asset(name, PACKAGE)
