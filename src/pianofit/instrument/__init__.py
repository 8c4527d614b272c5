"""A playable instrument from the fits of single keys.

`collect_fits` reads the fits, and `key_measurements` what they measured of the `key_quantities`, without the prior of
the fits (`fit_prior`). `keyboard_posterior` combines them to the posterior of all 88 keys. `quantity_law` integrates
over the shapes of each law. `fields` and `guessed_responses` give keys that were never recorded their modes, and
`guessed_knocks` their knocks. `evened_keys` moves recorded keys towards the laws. `build` makes the `Instrument`, and
`dampers`, `release_noise` and `noise_floor` measure what it has besides strings and hammers. `files` reads and writes
it. `page` shows every quantity over the keyboard.
"""

from ..schema.instrument import VelocityCurve
from .build import build_instrument
from .collect_fits import find_fits, instrument_name, load_extras, load_keys
from .files import load_instrument, write_instrument
from .instrument import Instrument, Key
from .predicted_key import prior_of_key
