"""From MIDI velocity to hammer velocity: one smooth, rising law for the whole instrument.

log v is linear in the MIDI velocity. It is known by the recordings: the n layers of a key, soft to loud, are taken
to be the middles of n equal parts of the MIDI range (a library's own mapping is not in its recordings), at the
velocities that the fit found. A weak prior keeps the law sensible with few layers; without any, it goes from 0.29 m/s
at 1 to 5.8 m/s at 127.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from ..parameters import PARAMETERS

__all__ = ["hammer_velocity", "velocity_map"]

MIDDLE, RISE = math.log(1.3), 1.5  # log v at 64, and what it gains from there to 127
PRIOR_SD = (0.7, 0.5)
LAYER_SD = 0.4  # of a layer's log v about the law
LEAST_RISE = 0.3


def velocity_map(velocities: Sequence[Sequence[float]]) -> dict[str, Any]:
    """The law from the velocities of each key's layers, ascending, m/s. A key with one layer says nothing."""
    points = [
        (127 * (i + 0.5) / len(layers), math.log(v))
        for layers in velocities if len(layers) > 1 for i, v in enumerate(layers)
    ]  # fmt: skip
    mean, precision = np.array([MIDDLE, RISE]), np.diag(1 / np.square(PRIOR_SD))
    if points:
        midi, log_v = np.array(points).T
        rows = np.column_stack([np.ones(len(midi)), (midi - 64) / 63])
        total = precision + rows.T @ rows / LAYER_SD**2
        mean = np.linalg.solve(total, precision @ mean + rows.T @ log_v / LAYER_SD**2)
    middle, rise = float(mean[0]), max(float(mean[1]), LEAST_RISE)
    return {
        "at_64": math.exp(middle), "rise": rise, "from": "layers" if points else "default",
        "layers": [[m, math.exp(v)] for m, v in points],
    }  # fmt: skip


def hammer_velocity(midi_velocity: float, at_64: float, rise: float) -> float:
    """v_H0, m/s, of MIDI velocity 1 to 127."""
    box = PARAMETERS["v_H0"]
    return float(np.clip(at_64 * math.exp(rise * (midi_velocity - 64) / 63), box.lower, box.upper))
