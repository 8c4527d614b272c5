"""A whole instrument from the fits of its keys: laws over the keyboard, songs, samplers.

`gather` reads the fits, `laws` and `build` make of them an `instrument.json`, `document` reads it back, `play` plays a
`midi` song on its `strings`, `sfz` writes a sampler's folder, and `page` shows every parameter over the keyboard.
"""

from .build import build_instrument
from .document import Instrument, load_instrument, read_instrument
from .gather import find_fits, load_keys, owner
from .midi import Song, load_song
from .play import Performance, limit, perform
from .sfz import export_sfz, parse_keys

__all__ = [
    "Instrument",
    "Performance",
    "Song",
    "build_instrument",
    "export_sfz",
    "find_fits",
    "limit",
    "load_instrument",
    "load_keys",
    "load_song",
    "owner",
    "parse_keys",
    "perform",
    "read_instrument",
]
