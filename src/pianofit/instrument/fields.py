"""Smooth functions of frequency and key: what soundboard, room and microphones do to the partials of all keys.

A quantity of a partial, such as its level beyond the string model, is

    u(f, n) = mean + common(log f) + trend(n) + drift(log f, n) + cell + residual

All keys share `common`, because they share one soundboard. `trend` changes slowly from bass to treble. Neighbouring
keys, which stand on neighbouring places of the bridge, share `drift` at one absolute frequency. All three are Gaussian
processes. The rest is white: the partials of one key within one cell of frequency share `cell`, and each partial has
its own residual. Without `cell`, what these partials share would be taken for a drift over one or two keys.

Every prediction is a sum of measured values with weights that follow from the covariance alone. So the same weights
serve levels in all channels, decay curves and phases. Far from all measured points a prediction returns to the mean,
without an edge.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from scipy.linalg import cho_factor, cho_solve, get_lapack_funcs
from scipy.optimize import minimize

# Standard deviation of the logarithms of spreads and lengths in their priors. It is wide: what the keys of an
# instrument share is measured.
FACTOR = 0.6
SPREADS = ("common_sd", "trend_sd", "drift_sd", "cell_sd", "residual")
# The density has several maxima over the lengths in keys. A second search begins at the best of these multiples of
# their medians. Both found the highest maximum of all in 32 of 32 fields of a grand's keys, and the first alone in 30.
START_FACTORS = (0.4, 1.0, 2.5)
# Most points from which spreads and lengths are estimated. All points take part in predictions.
MOST_POINTS = 500
# Share of the variance added to the diagonal: rounding.
JITTER = 1e-8
# Smallest power, to take logarithms and ratios.
NOTHING = 1e-300
# Smallest standard deviation of the measured values: a constant needs no law.
LEAST_SD = 1e-6


class FieldPoints(NamedTuple):
    """Points at which a field was measured."""

    octave: np.ndarray  # log2 of the frequency [points]
    key: np.ndarray  # MIDI number [points]
    size: np.ndarray  # number of partials that a point is the mean of [points]

    @classmethod
    def of_key(cls, octave: np.ndarray, midi: float, size: Any = 1.0) -> FieldPoints:
        """Return points of one key."""
        return cls(octave, np.full(len(octave), float(midi)), np.full(len(octave), size))

    def predict(self, weights: np.ndarray, values: np.ndarray) -> np.ndarray:
        """Predict a field from its values here with weights [..., points]; far from all points it is their mean."""
        centre = np.average(values, axis=0, weights=self.size)
        return centre + np.tensordot(weights, values - centre, 1)


class FieldShape(NamedTuple):
    """Spreads and lengths of a field.

    The defaults are the medians of the priors, with spreads relative to that of the measured values.
    """

    common_sd: float = 0.5
    common_octaves: float = 0.7
    trend_sd: float = 0.5
    trend_keys: float = 20.0
    drift_sd: float = 0.5
    drift_octaves: float = 0.5
    drift_keys: float = 6.0
    cell_sd: float = 0.5
    residual: float = 0.5

    def covariance(self, a: FieldPoints, b: FieldPoints) -> np.ndarray:
        """Covariance of the smooth part between points."""
        octaves, keys = a.octave[:, None] - b.octave, a.key[:, None] - b.key
        common, trend, drift = self.parts(octaves**2, keys**2)
        return common + trend + drift

    def parts(self, octaves: np.ndarray, keys: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Covariances of `common`, `trend` and `drift` at these squares of distances in octaves and keys."""
        common = self.common_sd**2 * np.exp(-0.5 * octaves / self.common_octaves**2)
        trend = self.trend_sd**2 * np.exp(-0.5 * keys / self.trend_keys**2)
        drift = self.drift_sd**2 * np.exp(-0.5 * octaves / self.drift_octaves**2 - 0.5 * keys / self.drift_keys**2)
        return common, trend, drift

    def white(self, size: Any) -> Any:
        """Variance of the mean of `size` partials of one cell about the smooth part."""
        return self.cell_sd**2 + self.residual**2 / size


@dataclass(frozen=True)
class Field:
    """A field and the points at which it was measured."""

    points: FieldPoints
    shape: FieldShape

    @cached_property
    def _factor(self) -> Any:
        """Cholesky factor of the covariance of the measured values: one serves all keys that are predicted."""
        total = self.shape.covariance(self.points, self.points)
        total[np.diag_indices(len(total))] += self.shape.white(self.points.size) + JITTER * total[0, 0]
        return cho_factor(total)

    def weights(self, at: FieldPoints) -> np.ndarray:
        """Weights of the measured values, after their mean was subtracted, in the prediction [at, points]."""
        return cho_solve(self._factor, self.shape.covariance(at, self.points).T).T

    def variance(self, weights: np.ndarray, at: FieldPoints) -> np.ndarray:
        """Variance of the value of one partial about its prediction with these `weights` [at]."""
        prior = sum(self.shape.parts(np.zeros(1), np.zeros(1))) + self.shape.white(1.0)
        explained = (weights * self.shape.covariance(at, self.points)).sum(axis=1)
        return prior - explained


def field_shape(points: FieldPoints, values: np.ndarray) -> FieldShape:
    """Estimate the most probable spreads and lengths of a field from measured values [points]."""
    chosen = np.unique(np.linspace(0, len(values) - 1, min(len(values), MOST_POINTS)).round().astype(int))
    points = FieldPoints(*(column[chosen] for column in points))
    y = values[chosen] - np.average(values[chosen], weights=points.size)
    scale = max(float(y.std()), LEAST_SD)
    y = y / scale
    octaves = (points.octave[:, None] - points.octave) ** 2
    keys = (points.key[:, None] - points.key) ** 2
    centre = np.log(FieldShape())
    potri: Any = get_lapack_funcs("potri", (octaves,))

    def cost(log_shape: np.ndarray) -> tuple[float, np.ndarray]:
        shape = FieldShape(*np.exp(log_shape))
        common, trend, drift = shape.parts(octaves, keys)
        total = common + trend + drift
        total[np.diag_indices(len(total))] += shape.white(points.size) + JITTER
        factor = np.linalg.cholesky(total)
        inverse, _ = potri(factor.T)  # the upper triangle; the other has zeros
        inverse += np.triu(inverse, 1).T
        solved = inverse @ y
        block = np.outer(solved, solved) - inverse
        by_common, by_trend, by_drift = block * common, block * trend, block * drift
        gradient = np.array(
            [
                by_common.sum(),
                0.5 * np.vdot(by_common, octaves) / shape.common_octaves**2,
                by_trend.sum(),
                0.5 * np.vdot(by_trend, keys) / shape.trend_keys**2,
                by_drift.sum(),
                0.5 * np.vdot(by_drift, octaves) / shape.drift_octaves**2,
                0.5 * np.vdot(by_drift, keys) / shape.drift_keys**2,
                np.trace(block) * shape.cell_sd**2,
                np.sum(np.diag(block) * shape.residual**2 / points.size),
            ]
        )
        away = (log_shape - centre) / FACTOR
        density = -0.5 * y @ solved - np.log(np.diag(factor)).sum() - 0.5 * away @ away
        return -float(density), away / FACTOR - gradient

    bounds = [(c - 4 * FACTOR, c + 4 * FACTOR) for c in centre]
    median = FieldShape()
    starts = [
        np.log(median._replace(trend_keys=trend * median.trend_keys, drift_keys=drift * median.drift_keys))
        for trend, drift in itertools.product(START_FACTORS, repeat=2)
        if (trend, drift) != (1.0, 1.0)
    ]
    searched = {"jac": True, "method": "L-BFGS-B", "bounds": bounds, "options": {"maxiter": 30}}
    begun = [centre, min(starts, key=lambda start: cost(start)[0])]
    found = min((minimize(cost, start, **searched) for start in begun), key=lambda end: end.fun)
    shape = FieldShape(*np.exp(found.x))
    return shape._replace(**{name: scale * getattr(shape, name) for name in SPREADS})
