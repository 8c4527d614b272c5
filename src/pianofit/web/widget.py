"""A playable note in a notebook: engine and player of the page as a widget of Jupyter, marimo and similar.

The front end is one JavaScript module, assembled from the scripts of the page, which anywidget loads.
"""

import functools
import json
from typing import Any

from ..conversions import HIGHEST_KEY, LOWEST_KEY, midi_of
from ..errors import ParameterError
from ..io.table_output import require_optional
from ..model.note import Note
from .payload import encode_note
from .write import engine_source, script_source


def widget(note: Note) -> Any:
    """Return a widget that plays `note`.

    Raises
    ------
    ParameterError
        If anywidget is not installed, or a page cannot play the felt law of the note.
    """
    return _widget_class()(instrument=note_payload(note))


@functools.cache
def _widget_class() -> type:
    """Define the class on first use, because anywidget is an optional dependency."""
    anywidget, traitlets = (
        require_optional(package, "a note in a notebook", "widget", ParameterError)
        for package in ("anywidget", "traitlets")
    )

    class NoteWidget(anywidget.AnyWidget):
        """Front end and its data."""

        _esm = front_end()
        _css = script_source("widget.css")
        instrument = traitlets.Dict().tag(sync=True)

    return NoteWidget


def front_end() -> str:
    """JavaScript module for anywidget."""
    code = json.dumps({"engine": engine_source(), "worklet": script_source("worklet.js")})
    return f"const CODE = {code};\n{script_source('player.js')}\n{script_source('widget.js')}"


def note_payload(note: Note) -> dict[str, Any]:
    """Payload of an instrument with one key, the nearest to the pitch of the note."""
    f0 = float(note.f0)
    midi = min(max(round(midi_of(f0)), LOWEST_KEY), HIGHEST_KEY)
    return {
        "name": "a note in Python",
        "velocity": {"at_64": float(note.size), "rise": 1.5},
        "keys": [{"midi": midi, "note": f"{f0:.2f} Hz", "recorded": True, **encode_note(note, midi)}],
    }
