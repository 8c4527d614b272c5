"""A note to play in a notebook: the page's engine and player as a widget of Jupyter, marimo and their like.

The front end is one module, made of the page's own scripts; anywidget carries it into the notebook.
"""

from __future__ import annotations

import functools
import json
from typing import Any

from ..conversions import midi_of
from ..errors import ParameterError
from ..instrument.collect_fits import HIGHEST_KEY, LOWEST_KEY
from ..io.table_output import require_optional
from ..model.note import Note
from .payload import encode_note
from .write import engine, source

__all__ = ["front_end", "instrument_of", "widget"]


def widget(note: Note) -> Any:
    """A widget that strikes `note`.

    Raises `ParameterError` if anywidget is not installed, or the note has a felt that a page cannot play.
    """
    return _kind()(instrument=instrument_of(note))


@functools.cache
def _kind() -> type:
    """The class, made once and only for those who ask for it."""
    anywidget, traitlets = (
        require_optional(package, "a note in a notebook", "widget", ParameterError)
        for package in ("anywidget", "traitlets")
    )

    class NoteWidget(anywidget.AnyWidget):
        """What the front end reads, and the front end."""

        _esm = front_end()
        _css = source("widget.css")
        instrument = traitlets.Dict().tag(sync=True)

    return NoteWidget


def front_end() -> str:
    """The module that anywidget loads."""
    code = json.dumps({"engine": engine(), "worklet": source("worklet.js")})
    return f"const CODE = {code};\n{source('player.js')}\n{source('widget.js')}"


def instrument_of(note: Note) -> dict[str, Any]:
    """An instrument of one key, that nearest to the note's pitch, as the player reads it."""
    f0 = float(note.f0)
    midi = min(max(round(midi_of(f0)), LOWEST_KEY), HIGHEST_KEY)
    return {
        "name": "a note in Python", "velocity": {"at_64": float(note.hammer.v_H0), "rise": 1.5},
        "keys": [{"midi": midi, "note": f"{f0:.2f} Hz", "recorded": True} | encode_note(note, midi)],
    }  # fmt: skip
