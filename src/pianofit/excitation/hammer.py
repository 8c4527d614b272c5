"""The stroke of a hammer: its velocity. Felt laws (`pianofit.felt`) hold everything else of a hammer."""

from typing import Any

import numpy as np

from ..parameters import PARAMETERS, Geometry
from .protocol import StrokeParameter, Words

# Hammer velocity at the string, m/s: pianissimo to fortissimo is 0.3 to 6 (Askenfelt and Jansson 1991).
VELOCITY = 1.5
VELOCITY_SD = 0.8
# Velocities of each sample of the prior, m/s: neighbours differ by 30 %, which a minimisation bridges.
VELOCITIES = np.geomspace(0.15, 8.0, 16)
# Velocities of one hammer, m/s: 1.6 % apart, closer than the lobes of a treble force's spectrum.
FINE_VELOCITIES = np.geomspace(0.15, 8.0, 256)
# Initial velocities, from the brightest stroke down, m/s: a forte,
FASTEST = 4.0
# and the factor from stroke to stroke, for layers far apart and for layers close together.
FACTORS = (0.5, 0.75)
STRIKE = 0.12  # x0/L, Chaigne and Askenfelt (1994)
# Velocity, m/s, of the stroke from which steps and modes are chosen.
NOMINAL = 2.0
# Gains of recordings through one path: as likely equal, except for variation of single strokes, as normalised one by
# one. Standard deviations from their mean, dB.
GAIN_DEVIATION = (1.0, 20.0)
# Roughness τ of a path, dB, median and spread of its logarithm, from notes recorded at several velocities
# (benchmarks/path_prior.py).
PATH = (4.5, 0.4)


def _starts(_: Geometry, rank: Any) -> list[Any]:
    return [FASTEST * factor**rank for factor in FACTORS]


VELOCITY_OF_STROKE = StrokeParameter(
    "v_H0",
    PARAMETERS["v_H0"].unit,
    PARAMETERS["v_H0"].meaning,
    lambda _: (VELOCITY, VELOCITY_SD),
    lambda _: (PARAMETERS["v_H0"].lower, PARAMETERS["v_H0"].upper),
    lambda _: VELOCITIES,
    lambda _: FINE_VELOCITIES,
    _starts,
    lambda entry, _: entry.v_H0,
    scale_is_open=True,
)
HAMMER_WORDS = Words("hammer", "hammer velocity", "velocities", "velocity", "struck")
