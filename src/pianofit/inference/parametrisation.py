"""The parameters of a fit as logarithms: string, felt, hammer and contact, then the velocity of every stroke.

If the felt law has a power, its stiffness is searched as the static force at a reference compression, F = K_H u_ref^p.
Strokes determine the force where they compress the felt. K_H alone, whose unit changes with p, trades off against p.
All other parameters of a law are logarithms of their values. No stroke is special: without a measured velocity, the
scaling (K_H, μ, v) → (K_H s^(1-p), μ/s, s v) is one wide direction of the prior.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from ..felt import ALL_PARAMETERS, FeltLaw
from ..parameters import STRING_NAMES, Geometry, String

STRING_SIZE = len(STRING_NAMES)
# Logarithm of a loss that the felt law does not have: its square is still a number.
LOG_ABSENT_LOSS = -300.0


def names_of(law: FeltLaw) -> tuple[str, ...]:
    """Names of the shared parameters, in order: the string, then felt, hammer mass and contact."""
    return STRING_NAMES + law.columns


@dataclass(frozen=True)
class Parametrisation:
    """Gaussian priors of the logarithms of all parameters, with bounds; [size] each."""

    mean: np.ndarray
    sd: np.ndarray  # 0: fixed at the mean
    lower: np.ndarray  # bounds of the values' logarithms, so of K_H in place of the force
    upper: np.ndarray
    log_reference_compression: float  # log of the reference compression, m
    geometry: Geometry  # strike position and contact width are parameters
    law: FeltLaw

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of the shared parameters."""
        return names_of(self.law)

    @property
    def shared(self) -> int:
        """Number of shared parameters; the velocities follow."""
        return len(self.names)

    def index_of(self, name: str) -> int:
        """Index of a parameter."""
        return self.names.index(name)

    @cached_property
    def force_and_exponent_index(self) -> tuple[int, int] | None:
        """Index of the force at the reference compression, in place of the stiffness, and of the exponent."""
        return None if self.law.power is None else (self.index_of(self.law.power[0]), self.index_of(self.law.power[1]))

    @cached_property
    def reported(self) -> tuple[str, ...]:
        """Names of parameters of this law's hammers; the others are fixed."""
        own = (*STRING_NAMES, *self.law.hammer_type._fields, "x0", "width")
        return tuple(name for name in self.names if name in own)

    @property
    def size(self) -> int:
        """Number of parameters, velocities included."""
        return len(self.mean)

    @property
    def strokes(self) -> int:
        """Number of velocities."""
        return self.size - self.shared

    @property
    def free(self) -> np.ndarray:
        """Mask of the searched parameters [size]."""
        return self.sd > 0

    @property
    def precision(self) -> np.ndarray:
        """Precision of the prior; 0 for fixed parameters [size]."""
        return np.where(self.free, 1 / np.where(self.free, self.sd, 1.0) ** 2, 0.0)

    # --- coordinates: θ has the force, log values have K_H ------------------------------------------------------------

    def _shift(self, theta: np.ndarray) -> np.ndarray:
        """θ minus the log values [..., size]: p log u_ref for the force, else 0. Both have the same p."""
        shift = np.zeros(theta.shape)
        if self.force_and_exponent_index:
            force, p = self.force_and_exponent_index
            shift[..., force] = np.exp(theta[..., p]) * self.log_reference_compression
        return shift

    def log_values(self, theta: np.ndarray) -> np.ndarray:
        """`theta` with log K_H in place of the force [..., size]."""
        return theta - self._shift(theta)

    def from_log_values(self, logs: np.ndarray) -> np.ndarray:
        """θ from the `log_values` of it [..., size]."""
        return logs + self._shift(logs)

    def tangent(self, theta: np.ndarray) -> np.ndarray:
        """d(log values)/dθ [size, size] at `theta` [size]."""
        out = np.eye(self.size)
        if self.force_and_exponent_index:
            force, _ = self.force_and_exponent_index
            out[self.force_and_exponent_index] = -self._shift(theta)[force]
        return out

    def force_direction(self, theta: np.ndarray) -> np.ndarray:
        """Change of the log values by which log F(u_ref) = log K_H + p log u_ref changes [size]."""
        direction = np.zeros(self.size)
        if self.force_and_exponent_index:
            force, p = self.force_and_exponent_index
            direction[force], direction[p] = 1.0, self._shift(theta)[force]
        return direction

    def value(self, name: str, log: float) -> float:
        """A value from its logarithm, limited to its range: the exponential of a bound's logarithm can exceed it."""
        value, ranges = float(np.exp(log)), ALL_PARAMETERS | self.law.hammer_parameters
        return min(max(value, ranges[name].lower), ranges[name].upper) if name in ranges else value

    def string(self, theta: np.ndarray) -> String:
        """The string at `theta` [size]."""
        return String(*map(self.value, STRING_NAMES, theta[:STRING_SIZE]))

    def hammer(self, theta: np.ndarray, stroke: int) -> Any:
        """The hammer at `theta` [size] with the velocity of one stroke."""
        logs = dict(zip(self.names, self.log_values(theta), strict=False)) | {"v_H0": theta[self.shared + stroke]}
        return self.law.make_hammer({name: self.value(name, logs[name]) for name in self.law.hammer_parameters})

    def geometry_at(self, theta: np.ndarray) -> Geometry:
        """The geometry with the strike position and contact width at `theta` [size]."""
        strike_position, width = (float(np.exp(theta[self.index_of(name)])) for name in ("x0", "width"))
        return self.geometry._replace(strike_position=strike_position, width=width)

    # --- bounds -------------------------------------------------------------------------------------------------------

    def range(self, i: int) -> tuple[float, float]:
        """Bounds of the logarithm of one value."""
        return float(self.lower[i]), float(self.upper[i])

    def bounds_at(self, theta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper bounds of all parameters at `theta` [..., size]: those of the force depend on p."""
        shift = self._shift(theta)
        return self.lower + shift, self.upper + shift

    def project(self, theta: np.ndarray) -> np.ndarray:
        """The nearest point inside the bounds [..., size]."""
        lower, upper = self.bounds_at(np.where(self.free, np.clip(theta, self.lower, self.upper), self.mean))
        return np.where(self.free, np.clip(theta, lower, upper), self.mean)

    def at_bound(self, theta: np.ndarray) -> np.ndarray:
        """Mask of the free parameters at a bound [..., size]."""
        lower, upper = self.bounds_at(theta)
        return self.free & ((theta <= lower + 1e-9) | (theta >= upper - 1e-9))

    def bound_jacobian(self, theta: np.ndarray, active: np.ndarray) -> np.ndarray:
        """d θ/d(free θ) [B, size, size] at `theta`: with K_H at a bound the force follows p, as in `project`."""
        out = np.tile(np.eye(self.size), (len(theta), 1, 1))
        if self.force_and_exponent_index:
            force, p = self.force_and_exponent_index
            out[:, force, p] = np.where(active[:, force] & self.free[p], self._shift(theta)[:, force], 0.0)
        return out

    def fix_parameter(self, i: int, log: float) -> Parametrisation:
        """Fix the logarithm of one value by equal bounds."""
        lower, upper = self.lower.copy(), self.upper.copy()
        lower[i] = upper[i] = log
        return replace(self, lower=lower, upper=upper)
