"""A strike as it sounds in a file: through gain and path, aligned to the recording's onset."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from ..criterion import OutputPath
from ..model import Simulation, simulate
from ..parameters import Geometry, Hammer, String

__all__ = ["Voice", "arrival", "strike_voice"]


class Voice(NamedTuple):
    """Everything between a set of parameters and a file's samples."""

    string: String
    hammer: Hammer
    geometry: Geometry
    quantity: str
    gain: float  # file units (full scale = 1) per unit of the pickup
    path: OutputPath | None  # dB over frequency, beside the gain

    def play(self, rate: float, samples: int, onset: int) -> tuple[np.ndarray, Simulation]:
        """The sound [samples] in file units, its first arrival at index `onset`, and the strike behind it.

        A path multiplies every partial by its own level, so it goes into the pickup's weights.
        """
        simulation = strike_voice(self, rate)
        factor = self.gain * np.ones(simulation.modes.pole.shape[0])
        if self.path is not None:
            factor = factor * 10 ** (self.path.at(np.abs(np.asarray(simulation.modes.pole.imag)) / (2 * np.pi)) / 20)
        heard = simulation.modes._replace(pickup=simulation.modes.pickup * jnp.asarray(factor))
        first = onset - round(arrival(self.string, self.geometry, self.quantity) * rate)
        sound = simulation._replace(modes=heard).waveform(rate, samples - min(first, 0) - max(first, 0))
        return np.pad(sound[max(-first, 0) :], (max(first, 0), 0)), simulation


def strike_voice(voice: Voice, rate: float) -> Simulation:
    """The strike, with the contact at a multiple of `rate`."""
    return simulate(voice.string, voice.hammer, voice.geometry, rate=rate, quantity=voice.quantity)


def arrival(string: String, geometry: Geometry, quantity: str) -> float:
    """When the wave from the nearest edge of the contact window reaches the pickup, s after the first touch."""
    end = geometry.length if quantity in ("bridge-force", "pressure") else geometry.pickup
    return float(max(abs(end - geometry.strike) - geometry.width / 2, 0.0) / string.c)
