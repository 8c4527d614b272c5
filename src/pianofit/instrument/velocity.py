"""Hammer velocity as a function of MIDI velocity, one rising curve for the whole instrument.

log v is linear in the MIDI velocity. It is fitted to the velocities of the recordings. The n layers of a key, soft to
loud, stand for the middles of n equal parts of the MIDI range, because a library's own mapping is not in its
recordings. A weak prior stabilises the fit with few layers. Without layers, the curve goes from 0.29 m/s at 1 to 5.8
m/s at 127.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from ..parameters import PARAMETERS

__all__ = ["hammer_velocity", "velocity_map"]

MIDDLE, RISE = math.log(1.3), 1.5  # log v at 64, and its increase from 64 to 127
PRIOR_SD = (0.7, 0.5)
LAYER_SD = 0.4  # of a layer's log v about the curve
LEAST_RISE = 0.3


def velocity_map(velocities: Sequence[Sequence[float]]) -> dict[str, Any]:
    """The curve from the velocities of each key's layers, ascending, m/s. Keys with one layer are not used."""
    points = [
        (127 * (i + 0.5) / len(layers), math.log(v))
        for layers in velocities
        if len(layers) > 1
        for i, v in enumerate(layers)
    ]
    mean, precision = np.array([MIDDLE, RISE]), np.diag(1 / np.square(PRIOR_SD))
    if points:
        midi, log_v = np.array(points).T
        rows = np.column_stack([np.ones(len(midi)), (midi - 64) / 63])
        total = precision + rows.T @ rows / LAYER_SD**2
        mean = np.linalg.solve(total, precision @ mean + rows.T @ log_v / LAYER_SD**2)
    middle, rise = float(mean[0]), max(float(mean[1]), LEAST_RISE)
    return {
        "at_64": math.exp(middle),
        "rise": rise,
        "from": "layers" if points else "default",
        "layers": [[m, math.exp(v)] for m, v in points],
    }


def hammer_velocity(midi_velocity: float, at_64: float, rise: float) -> float:
    """v_H0, m/s, at a MIDI velocity from 1 to 127."""
    box = PARAMETERS["v_H0"]
    return float(np.clip(at_64 * math.exp(rise * (midi_velocity - 64) / 63), box.lower, box.upper))
