"""Decay rates that the dampers of an instrument add, as they stand in an `instrument.json` and in memory."""

import math
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from msgspec import Meta

from ..conversions import DB, HALF_WIDTH_95, LOWEST_KEY, hertz_of
from .decode import Number

LAST_DAMPER = 90  # F#6; the strings above have none
# Rates of real dampers lie between 220 and 470 dB/s, and bass strings are damped less (Taguti; Lehtonen, Askenfelt and
# Välimäki 2009). The ends of the range are taken for the lowest key and for the last key with a damper, dB/s.
LITERATURE_DB_PER_S = (220.0, 470.0)
# Exponent of the rate over frequency: low partials are damped less (Lehtonen, Askenfelt and Välimäki 2009), by a number
# that was not published. This one, chosen, gives partial 16 twice the rate of partial 1.
LITERATURE_SLOPE = 0.25
# Standard deviations of the logarithms of both rates, and of the exponent: a range from half to twice the rate, and an
# exponent whose sign is nearly certain. Chosen.
LITERATURE_SD = (0.35, 0.35, 0.15)
# Largest decay rate, 1/s: 60 dB in 0.7 ms.
LARGEST_RATE = 1e4
Rate = Annotated[float, Meta(gt=0.0, le=LARGEST_RATE)]
Row = tuple[Number, Number, Number]


@dataclass(frozen=True)
class Dampers:
    """Decay rates that dampers add. The default is the law of the literature.

    The logarithm of the rate is linear in the key, and in the logarithm of frequency over the fundamental of the key.
    """

    bass: Rate = LITERATURE_DB_PER_S[0] / DB  # at the fundamental of the lowest key, 1/s
    treble: Rate = LITERATURE_DB_PER_S[1] / DB  # at the fundamental of the last key with a damper, 1/s
    slope: Annotated[float, Meta(ge=-3.0, le=3.0)] = LITERATURE_SLOPE  # exponent of the rate over frequency
    covariance: tuple[Row, Row, Row] = (  # of log `bass`, log `treble` and `slope`
        (LITERATURE_SD[0] ** 2, 0.0, 0.0),
        (0.0, LITERATURE_SD[1] ** 2, 0.0),
        (0.0, 0.0, LITERATURE_SD[2] ** 2),
    )
    source: Literal["literature", "recordings"] = "literature"
    keys: tuple[int, ...] = ()  # MIDI numbers of the keys whose dampers were measured

    def rates(self, midi: int, hz: np.ndarray) -> np.ndarray:
        """Return the rates that a damper adds when it rests fully on the string, 1/s [modes]; 0 without a damper."""
        if midi > LAST_DAMPER:
            return np.zeros(len(hz))
        mean = np.array([math.log(self.bass), math.log(self.treble), self.slope])
        return np.exp(design_rows(midi, hz) @ mean)

    def rate(self, midi: int) -> float:
        """Return the rate at the fundamental of a key, 1/s; 0 for a key without damper."""
        return float(self.rates(midi, np.array([hertz_of(midi)]))[0])

    def interval(self, midi: int, hz: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the ends of the 95 % intervals of `rates`, 1/s [modes]."""
        rows = design_rows(midi, hz)
        factor = np.exp(HALF_WIDTH_95 * np.sqrt(np.einsum("mi,ij,mj->m", rows, np.array(self.covariance), rows)))
        rates = self.rates(midi, hz)
        return rates / factor, rates * factor


def design_rows(midi: int, hz: np.ndarray) -> np.ndarray:
    """Return the weights of log `bass`, log `treble` and `slope` in the logarithm of the rate [modes, 3]."""
    position = min(max((midi - LOWEST_KEY) / (LAST_DAMPER - LOWEST_KEY), 0.0), 1.0)
    octave = np.log(np.asarray(hz, float) / hertz_of(midi))
    return np.column_stack([np.full(len(octave), 1 - position), np.full(len(octave), position), octave])
