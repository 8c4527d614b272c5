"""A monotone piecewise cubic through given points, in NumPy: SciPy's interpolators take long to import.

The slopes are those of PCHIP (Fritsch and Butland 1984), so the cubic does not overshoot. At both ends the slope is
that of the adjacent interval.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class MonotoneCubic:
    """A cubic between points with rising `x` [points]."""

    x: np.ndarray
    y: np.ndarray
    slopes: np.ndarray

    @classmethod
    def through(cls, x: np.ndarray, y: np.ndarray) -> MonotoneCubic:
        """The cubic through the points (x, y) [points], at least two."""
        step, change = np.diff(x), np.diff(y) / np.diff(x)
        return cls(x, y, np.concatenate([change[:1], _inner_slopes(step, change), change[-1:]]))

    def __call__(self, x: float) -> float:
        """Value at `x`, which lies between the first and the last point."""
        i = min(max(int(np.searchsorted(self.x, x, "right")), 1), len(self.x) - 1) - 1
        h = self.x[i + 1] - self.x[i]
        t = (x - self.x[i]) / h
        early = (1 - t) ** 2 * ((1 + 2 * t) * self.y[i] + t * h * self.slopes[i])
        late = t**2 * ((3 - 2 * t) * self.y[i + 1] - (1 - t) * h * self.slopes[i + 1])
        return float(early + late)


def _inner_slopes(step: np.ndarray, change: np.ndarray) -> np.ndarray:
    """Slopes at the inner points [points - 2] from distances of points and the slopes between them [points - 1].

    A slope is the weighted harmonic mean of the two next to it, and 0 between two of opposite sign.
    """
    before, after, rises = change[:-1], change[1:], change[:-1] * change[1:] > 0
    first, second = 2 * step[1:] + step[:-1], step[1:] + 2 * step[:-1]
    total = np.where(rises, first * after + second * before, 1.0)
    return np.where(rises, (first + second) * before * after / total, 0.0)
