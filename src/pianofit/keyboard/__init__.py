"""Laws over the keyboard, and the document of a whole instrument.

`gather` reads the fits of single keys, `laws` and `build` make of them an `instrument.json`, `document` reads it back,
and `page` shows every parameter over the keyboard.
"""

from .build import build_instrument
from .document import Instrument, load_instrument, read_instrument
from .gather import find_fits, load_keys, owner

__all__ = [
    "Instrument", "build_instrument", "find_fits", "load_instrument", "load_keys", "owner", "read_instrument",
]  # fmt: skip
