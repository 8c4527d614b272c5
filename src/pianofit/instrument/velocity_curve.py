"""Hammer velocity over MIDI velocity, from the layers of all recorded keys."""

import math
from collections.abc import Sequence
from typing import Literal

import numpy as np

from ..schema.instrument import V_H0, Layer, VelocityCurve
from .key_quantities import LOUDEST_VELOCITY

# Prior of the velocity curve: standard deviations of the logarithm at MIDI velocity 64, and of its rise.
VELOCITY_PRIOR_SD = (0.7, 0.5)
# Standard deviation of the logarithm of a layer's velocity about the curve, and the smallest rise of the curve.
LAYER_SD, LEAST_RISE = 0.4, 0.3
# Largest rise of the logarithm from MIDI velocity 64 to 127. Pianists use a factor of 20 over the whole range, so half
# of it does not have a factor of 55. Numbers of layers, such as 1 to 5, give more.
MOST_RISE = 4.0
# MIDI velocity, if it is known, and hammer velocity, m/s, of the layers of one key.
Strokes = Sequence[tuple[float | None, float]]


def fit_velocity_curve(keys: Sequence[Sequence[Layer]]) -> VelocityCurve:
    """Fit one velocity curve to the layers of each key, soft to loud. Keys with one layer are not used.

    A layer stands for its MIDI velocity in the library. If that of a layer is unknown, the n layers of its key stand
    for the middles of n equal parts of the MIDI range. Numbers that would make the curve rise by more than `MOST_RISE`
    are not MIDI velocities, and count as unknown. A weak prior about the default curve stabilises the fit with few
    layers.
    """
    strokes = _strokes(keys)
    known = _known(strokes)
    return _curve_through(strokes, "midi-velocities" if known and _rise(known) <= MOST_RISE else "layers")


def loudest_velocities(keys: Sequence[Sequence[Layer]]) -> list[float]:
    """Return the velocity to which the loudest layer of each key is set, m/s, or the force of a pluck, N.

    It is `LOUDEST_VELOCITY` for the largest MIDI velocity of all, and falls from there as within the layers of keys. If
    the MIDI velocity of a loudest layer is unknown, all have `LOUDEST_VELOCITY`.
    """
    loudest = [max((layer.midi_velocity or 0.0) for layer in layers) for layers in keys]
    known = _known(_strokes(keys))
    rise = _rise(known) if known else VelocityCurve().rise
    if not min(loudest, default=0.0) or rise > MOST_RISE:
        return [LOUDEST_VELOCITY] * len(keys)
    top = max(loudest)
    return [LOUDEST_VELOCITY * math.exp(max(rise, LEAST_RISE) * (midi - top) / 63) for midi in loudest]


def _strokes(keys: Sequence[Sequence[Layer]]) -> list[Strokes]:
    """Return the strokes of the keys with two or more. Recordings of one stroke at two microphones are one."""
    strokes = [[*dict.fromkeys((layer.midi_velocity, layer.velocity) for layer in layers)] for layers in keys]
    return [layers for layers in strokes if len(layers) > 1]


def _known(strokes: Sequence[Strokes]) -> list[list[tuple[float, float]]]:
    """Return the strokes of the keys whose MIDI velocities are all known."""
    found = [[(midi, v) for midi, v in layers if midi is not None] for layers in strokes]
    return [known for known, layers in zip(found, strokes, strict=True) if len(known) == len(layers)]


def _rise(known: Sequence[Sequence[tuple[float, float]]]) -> float:
    """Rise of the logarithm from MIDI velocity 64 to 127 within the layers of each key, by least squares."""
    rows = [np.array([(midi / 63, math.log(v)) for midi, v in layers]) for layers in known]
    x, y = np.concatenate([row - row.mean(axis=0) for row in rows]).T
    return float(x @ y / max(x @ x, np.finfo(float).tiny))


def _curve_through(strokes: Sequence[Strokes], source: Literal["midi-velocities", "layers"]) -> VelocityCurve:
    """Fit a curve to the layers of some keys; with the source "layers" by their order alone."""
    if not strokes:
        return VelocityCurve()
    points = []
    for layers in strokes:
        by_order = source == "layers" or not _known([layers])
        middles = [127 * (i + 0.5) / len(layers) for i in range(len(layers))]
        points += [(at if by_order else midi, math.log(v)) for at, (midi, v) in zip(middles, layers, strict=True)]
    prior, precision = VelocityCurve(), np.diag(1 / np.square(VELOCITY_PRIOR_SD))
    midi, log_v = np.array(points).T
    rows = np.column_stack([np.ones(len(midi)), (midi - 64) / 63])
    total = precision + rows.T @ rows / LAYER_SD**2
    weighted = precision @ [math.log(prior.at_64), prior.rise] + rows.T @ log_v / LAYER_SD**2
    middle, rise = np.linalg.solve(total, weighted)
    at_64 = float(np.clip(math.exp(middle), V_H0.lower, V_H0.upper))
    rise = float(np.clip(rise, LEAST_RISE, MOST_RISE))
    return VelocityCurve(at_64, rise, source, tuple((m, math.exp(v)) for m, v in points))


def velocity_warnings(keys: Sequence[Sequence[Layer]]) -> list[str]:
    """Warn of numbers that are not MIDI velocities."""
    known = _known(_strokes(keys))
    if not known or _rise(known) <= MOST_RISE:
        return []
    given = sorted(midi for layers in known for midi, _ in layers)
    return [
        f"The velocities {given[0]:g} to {given[-1]:g} of the layers are not MIDI velocities: the strokes would rise "
        "too steeply. The order of the layers is used. List them as layers, or correct them."
    ]
