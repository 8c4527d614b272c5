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
from ..parameters import STRING_NAMES, Geometry, Parameter, String

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
    lower: np.ndarray
    upper: np.ndarray
    log_reference_compression: float  # log of the reference compression, m
    stiffness: tuple[float, float]  # log of the lowest and the highest K_H; unused by a law without a power
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

    def project(self, theta: np.ndarray) -> np.ndarray:
        """The nearest point inside the bounds [..., size]; the force is limited so that K_H stays inside its own."""
        theta = np.where(self.free, np.clip(theta, self.lower, self.upper), self.mean)
        if self.force_and_exponent_index and self.free[self.force_and_exponent_index[0]]:
            force, p = self.force_and_exponent_index
            low, high = (k + np.exp(theta[..., p]) * self.log_reference_compression for k in self.stiffness)
            theta[..., force] = np.clip(theta[..., force], low, high)
        return theta

    def bounds_at(self, theta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper bounds of all parameters at `theta` [..., size]."""
        lower, upper = (np.broadcast_to(x, theta.shape).copy() for x in (self.lower, self.upper))
        if self.force_and_exponent_index and self.free[self.force_and_exponent_index[0]]:
            force, p = self.force_and_exponent_index
            shift = np.exp(theta[..., p]) * self.log_reference_compression
            lower[..., force], upper[..., force] = self.stiffness[0] + shift, self.stiffness[1] + shift
        return lower, upper

    def at_bound(self, theta: np.ndarray) -> np.ndarray:
        """Mask of the free parameters at a bound [..., size]."""
        lower, upper = self.bounds_at(theta)
        return self.free & ((theta <= lower + 1e-9) | (theta >= upper - 1e-9))

    def range(self, i: int) -> tuple[float, float]:
        """Bounds of a value's logarithm; in place of the force, those of K_H."""
        return self.stiffness if self._is_force(i) else (float(self.lower[i]), float(self.upper[i]))

    def bound_jacobian(self, theta: np.ndarray, active: np.ndarray) -> np.ndarray:
        """d θ/d(free θ) [B, size, size] at `theta`: with K_H at a bound the force follows p, as in `project`."""
        out = np.tile(np.eye(self.size), (len(theta), 1, 1))
        if self.force_and_exponent_index:
            force, p = self.force_and_exponent_index
            out[:, force, p] = np.where(
                active[:, force] & self.free[p], np.exp(theta[:, p]) * self.log_reference_compression, 0.0
            )
        return out

    def from_log_values(self, logs: np.ndarray) -> np.ndarray:
        """θ from the `log_values` of it [..., size]."""
        theta = np.array(logs, float)
        if self.force_and_exponent_index:
            force, p = self.force_and_exponent_index
            theta[..., force] += np.exp(logs[..., p]) * self.log_reference_compression
        return theta

    def fix_parameter(self, i: int, log: float) -> Parametrisation:
        """Fix one parameter, or K_H in place of the force, at a logarithm by equal bounds."""
        if self._is_force(i):
            return replace(self, stiffness=(log, log))
        lower, upper = self.lower.copy(), self.upper.copy()
        lower[i] = upper[i] = log
        return replace(self, lower=lower, upper=upper)

    def string(self, theta: np.ndarray) -> String:
        """The string at `theta` [size]."""
        values = zip(STRING_NAMES, np.exp(theta[:STRING_SIZE]), strict=True)
        return String(*(_inside(ALL_PARAMETERS[n], float(x)) for n, x in values))

    def hammer(self, theta: np.ndarray, stroke: int) -> Any:
        """The hammer at `theta` [size] with the velocity of one stroke."""
        logs = dict(zip(self.names, self.log_values(theta), strict=False)) | {"v_H0": theta[self.shared + stroke]}
        return self.law.make_hammer(
            {n: _inside(box, float(np.exp(logs[n]))) for n, box in self.law.hammer_parameters.items()}
        )

    def value(self, name: str, log: float) -> float:
        """A value from its logarithm, limited to its range if it has one."""
        boxes = ALL_PARAMETERS | self.law.hammer_parameters
        return _inside(boxes[name], float(np.exp(log))) if name in boxes else float(np.exp(log))

    def geometry_at(self, theta: np.ndarray) -> Geometry:
        """The geometry with the strike position and contact width at `theta` [size]."""
        strike_position, width = (float(np.exp(theta[self.index_of(name)])) for name in ("x0", "width"))
        return self.geometry._replace(strike_position=strike_position, width=width)

    def log_values(self, theta: np.ndarray) -> np.ndarray:
        """`theta` with log K_H in place of the force [..., size]."""
        logs = np.array(theta, float)
        if self.force_and_exponent_index:
            force, p = self.force_and_exponent_index
            logs[..., force] -= np.exp(theta[..., p]) * self.log_reference_compression
        return logs

    def tangent(self, theta: np.ndarray) -> np.ndarray:
        """d(log values)/dθ [size, size] at `theta` [size]."""
        out = np.eye(self.size)
        if self.force_and_exponent_index:
            force, p = self.force_and_exponent_index
            out[force, p] = -np.exp(theta[p]) * self.log_reference_compression
        return out

    def _is_force(self, i: int) -> bool:
        return self.force_and_exponent_index is not None and i == self.force_and_exponent_index[0]


def _inside(box: Parameter, value: float) -> float:
    """Limit a value to its range: the exponential of a bound's logarithm can exceed it by rounding."""
    return min(max(value, box.lower), box.upper)
