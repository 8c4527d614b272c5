"""Struck strings for the tests of the reference scheme, and functions to solve and compare them."""

from __future__ import annotations

import finite_difference
import numpy as np
from model_cases import GEOMETRY, HAMMER, STRING

from pianofit.parameters import Geometry, Hammer, String

POINTS, STEPS = 48, 512
X = np.arange(1, POINTS + 1) / (POINTS + 1)
WIDE = GEOMETRY._replace(width=0.06)


def solve(case: dict, **more) -> finite_difference.Reference:
    return finite_difference.solve(**case, steps=STEPS, points=POINTS, **more)


def relative(actual, expected) -> float:
    actual, expected = np.asarray(actual), np.asarray(expected)
    return float(np.abs(actual - expected).max() / np.abs(expected).max())


def touches(force) -> int:
    return int(np.sum(np.diff((np.asarray(force) > 0).astype(int)) == 1))


def _parabola(x):
    return np.maximum(1 - (x / 0.05) ** 2, 0.0)


BASS = String(c=155.0, kappa=0.6, b1=0.25, b2=1e-5)
CASES = {  # case, least number of contacts
    "paper": ({"string": STRING, "hammer": HAMMER, "geometry": WIDE, "step": 1 / 44_100}, 1),
    "linear felt": (
        {"string": STRING, "hammer": HAMMER._replace(p=1.0, K_H=5e4), "geometry": WIDE, "step": 1 / 44_100}, 1,
    ),
    "hard hammer": (
        {"string": STRING, "hammer": Hammer(1e13, 0.1, 2.5, 1e-3, 2.0), "geometry": WIDE, "step": 1 / 88_200}, 3,
    ),
    "bass string": (
        {"string": BASS, "hammer": Hammer(1e12, 0.1, 2.5, 5e-3, 2.0), "geometry": Geometry(1.9, 0.1, 0.23, 0.1, 0.5),
         "step": 1 / 44_100}, 3,
    ),
    "heavy slow hammer, light string": (
        {"string": STRING._replace(b1=0.01), "hammer": Hammer(1e13, 0.1, 2.5, 0.1, 0.5),
         "geometry": WIDE._replace(mass=0.002), "step": 1 / 44_100}, 3,
    ),
    "plucked and struck": (
        {"string": STRING, "hammer": HAMMER, "geometry": WIDE, "step": 1 / 44_100,
         "displacement": 2e-5 * np.minimum(X / 0.4, (1 - X) / 0.6)}, 1,
    ),
    "struck in motion": (
        {"string": STRING, "hammer": HAMMER, "geometry": WIDE, "step": 1 / 44_100,
         "displacement": 1e-4 * X * (1 - X), "velocity": 0.6 * np.sin(3 * np.pi * X)}, 1,
    ),
    "window of another shape": (
        {"string": STRING, "hammer": HAMMER, "geometry": WIDE._replace(width=0.1), "step": 1 / 60_000,
         "window": _parabola(X - WIDE.strike_position)}, 1,
    ),
    "window of given weights": (
        {"string": STRING, "hammer": HAMMER, "geometry": WIDE, "step": 1 / 60_000,
         "window": np.where(np.abs(X - 0.3) < 0.1, 1.0 + X, 0.0)}, 1,
    ),
}  # fmt: skip
