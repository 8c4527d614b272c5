"""The cost about a settled fit, as profiles and samplers walk on it: fixed weights, any point of the box."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
import numpy as np

from .joint import Fit
from .residuals import CENT, joint_batch
from .space import K, P, Space
from .uncertainty import Run, neighbours, whole_covariance

__all__ = ["Surface", "row_variance", "surface_of"]


@dataclass(frozen=True)
class Surface:
    """Half the sum of squares of `batch(z [n, size], arrays, cfg) -> (residuals, Jacobians, ...)`, at its least.

    `arrays` are what a compiled program is given, `cfg` what it is specialised to.
    """

    batch: Callable
    arrays: Any
    cfg: tuple
    space: Space
    z: np.ndarray  # [size]: where the cost is least
    cost: float
    jacobian: np.ndarray  # [residuals, size], there
    variance: np.ndarray  # [residuals]: how much each is expected to vary; 1 by its weight
    pressed: np.ndarray  # [size]: held by the box
    runs: Sequence[Run] = ()  # of residuals whose neighbours are alike
    glide: float = 0.0  # standard error of log c and log κ together, which no residual shows

    @property
    def values(self) -> np.ndarray:
        """Natural values of the least point [size]."""
        return self.space.natural(self.z)

    def evaluate(self, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Residuals and Jacobians at search points [n, size]."""
        residual, jacobian = self.batch(jnp.asarray(z), self.arrays, self.cfg)[:2]
        return np.asarray(residual), np.asarray(jacobian)

    def direction(self, name: int) -> np.ndarray:
        """What log(parameter) `name` changes by, per search coordinate [size]: log K_H = log F_ref - p log u_ref."""
        out = np.zeros(len(self.z))
        out[name] = 1.0
        if name == K:
            out[P] = -np.exp(self.z[P]) * self.space.log_u
        return out

    def covariances(self, name: int | None = None) -> tuple[np.ndarray, np.ndarray]:
        """[size, size] twice: the curvature's inverse, and the sandwich; `name` is free even if it is pressed."""
        pressed = self.pressed & (np.arange(len(self.z)) != name)
        plain = whole_covariance(self.jacobian, np.ones(len(self.variance)), self.space, pressed)
        sandwich = whole_covariance(self.jacobian, self.variance, self.space, pressed, self.runs)
        free = self.space.free[:2] & ~pressed[:2]
        sandwich[:2, :2] += np.outer(free, free) * self.glide**2
        return plain, sandwich

    def inflation(self, name: int) -> float:
        """Variance of log(parameter) by the sandwich over that by the curvature alone."""
        change = self.direction(name)
        plain, sandwich = (change @ c @ change for c in self.covariances(name))
        return float(sandwich / plain) if plain > 0 else 1.0


def surface_of(fit: Fit) -> Surface:
    """The settled fit's, with its weights."""
    variance = row_variance(fit)
    runs = neighbours(
        fit.residual / np.sqrt(np.where(variance > 0, variance, 1.0)), fit.data.found, fit.data.calibrated, _doubt(fit)
    )
    return Surface(
        joint_batch, fit.target, fit.cfg, fit.space, fit.z[0], fit.cost, fit.jacobian, variance, fit.pressed, runs,
        CENT * fit.data.each[0].glide_error,
    )  # fmt: skip


def row_variance(fit: Fit) -> np.ndarray:
    """Variance that each residual is expected to have: 1 by its weight, save for those of level and of eq. 19.

    Their weights are not their scatter's alone, which is known all the same.
    """
    cells, found = fit.data.found.size, fit.data.found.ravel()
    variance = np.ones(fit.jacobian.shape[0])
    sd = np.hypot(fit.data.level_error, fit.spread.level * fit.data.buried).ravel()
    level, line = (np.asarray(x).ravel() for x in (fit.target.level_weight, fit.target.line_weight))
    variance[2 * cells : 3 * cells][found] = (level * sd)[found] ** 2
    variance[3 * cells : 4 * cells] = np.where(found, (line * sd * np.log(10) / 10) ** 2, 0.0)
    return variance


def _doubt(fit: Fit) -> np.ndarray:
    """Which share [3, takes, rows] of a residual's standard deviation beats and glides may have made."""
    data = fit.data
    weight = [np.asarray(x) for x in (fit.target.frequency_weight, fit.target.decay_weight)]
    # Takes of one string share weights of the first two kinds, since they are missed alike.
    takes = np.sqrt(np.maximum(data.found.sum(axis=0), 1))
    level = 1 / np.hypot(data.level_error, fit.spread.level * data.buried)
    return np.clip(np.stack([weight[0] * takes, weight[1] * takes, level]) * data.doubt, 0.0, 1.0)
