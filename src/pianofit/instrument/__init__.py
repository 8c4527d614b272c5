"""A playable instrument from the fits of single keys.

`collect_fits` reads the fits. `key_quantities` and `laws` describe them over the keyboard, `build` combines them to an
`Instrument`, and `files` reads and writes it. `page` shows every parameter over the keyboard.
"""

from ..schema.instrument import VelocityCurve
from .build import build_instrument
from .collect_fits import find_fits, instrument_name, load_keys
from .files import load_instrument, write_instrument
from .instrument import Instrument, Key

__all__ = [
    "Instrument",
    "Key",
    "VelocityCurve",
    "build_instrument",
    "find_fits",
    "instrument_name",
    "load_instrument",
    "load_keys",
    "write_instrument",
]
