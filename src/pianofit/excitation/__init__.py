"""Excitations: what sets a string in motion, one file each.

`protocol` lists everything that a fit asks of an excitation. The hammer answers by its felt law (`pianofit.felt`) and
by `hammer`, the pluck by `pluck`. A new excitation is a file in this package and an entry in `OTHERS`.
"""

from .hammer import VELOCITY_OF_STROKE
from .pluck import PLUCK, Pluck
from .protocol import GEOMETRY_FIELDS, Excitation, StrokeParameter

# All excitations except the hammer, by their name in files.
OTHERS: dict[str, Excitation] = {PLUCK.name: PLUCK}
HAMMER = "hammer"
# Parameter of a stroke by the name of the excitation.
STROKES = {HAMMER: VELOCITY_OF_STROKE} | {name: own.stroke for name, own in OTHERS.items()}
NAMES = (HAMMER, *OTHERS)
