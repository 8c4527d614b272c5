"""Layers of a library over the keyboard: their velocities, and the levels that an even instrument would have."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ..conversions import LOWEST_KEY
from ..dsp.loudness import k_weighted_mean_square
from ..instrument import Instrument
from ..instrument.key_quantities import LEVEL_SECONDS, LOUDEST_VELOCITY, stroke_level
from ..model.modal_response import PRE_ONSET_S

# Keys from which on a layer's velocity has a slope over the keyboard.
FEWEST_FOR_SLOPE = 3
# A layer is missing on a key if at least this share of the recorded keys have it.
LEAST_SHARE = 0.5


@dataclass(frozen=True)
class LayerLaw:
    """Velocity of a layer over keys: its logarithm is linear."""

    slope: float  # per key
    at_zero: float

    def velocity(self, midi: int) -> float:
        """Return the hammer velocity at a key, m/s."""
        return float(np.exp(self.at_zero + self.slope * midi))


def layer_laws(velocities: Mapping[str, Mapping[int, float]]) -> dict[str, LayerLaw]:
    """Fit the law of each layer to its velocities by key, m/s."""
    laws = {}
    for layer, by_key in velocities.items():
        midi, log_v = np.array(list(by_key)), np.log(list(by_key.values()))
        slope, at_zero = np.polyfit(midi, log_v, 1) if len(midi) >= FEWEST_FOR_SLOPE else (0.0, log_v.mean())
        laws[layer] = LayerLaw(float(slope), float(at_zero))
    return laws


def missing_sounds(recorded: Mapping[str, Mapping[int, float]], keys: Sequence[int]) -> list[tuple[int, str]]:
    """List keys and layers without a recording: every layer that is usual among the recorded keys, on every key."""
    known = set().union(*recorded.values())
    usual = [layer for layer, by_key in recorded.items() if len(by_key) >= LEAST_SHARE * len(known)]
    return [(midi, layer) for midi in keys for layer in usual if midi not in recorded[layer]]


def even_level(instrument: Instrument, midi: int, law: LayerLaw) -> float:
    """Return the level of a layer of a key on an even keyboard, dB re full scale.

    The key has the level of the keyboard's law, and the stroke the velocity of its layer. The level is that of
    `recorded_level`.
    """
    note = instrument.keys[midi].note
    at_law = float(instrument.laws["level"].value[midi - LOWEST_KEY])
    return at_law + stroke_level(note, law.velocity(midi)) - stroke_level(note, LOUDEST_VELOCITY)


def recorded_level(sound: np.ndarray, rate: int, onset: int) -> float:
    """Return the K-weighted level of the first second of a recording [channels, samples], dB re full scale."""
    begin = max(onset - round(PRE_ONSET_S * rate), 0)
    first = sound[:, begin : begin + round(LEVEL_SECONDS * rate)]
    power = k_weighted_mean_square(first, rate) * first.shape[-1] / (LEVEL_SECONDS * rate)
    return 10 * math.log10(max(power, 1e-30))
