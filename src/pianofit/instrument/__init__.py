"""Keyboard laws, and the document of a whole instrument.

`collect_fits` reads the fits of single keys. `laws` and `build` combine them to an `instrument.json`. `document` reads
that file, and `page` shows every parameter over the keyboard.
"""

from .build import build_instrument
from .collect_fits import find_fits, instrument_name, load_keys
from .document import Instrument, load_instrument, read_instrument

__all__ = [
    "Instrument",
    "build_instrument",
    "find_fits",
    "load_instrument",
    "load_keys",
    "instrument_name",
    "read_instrument",
]
