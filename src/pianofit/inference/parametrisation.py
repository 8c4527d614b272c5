"""The unknowns of a fit, all on a log scale: string, felt, hammer and contact, then the velocity of every stroke.

Where the felt's law has a power, its stiffness is searched as the static force at a reference compression,
F = K_H u_ref^p: strokes fix the force where they compress the felt, while K_H alone, whose unit changes with p, trades
off against p. All other parameters of a law are logarithms of their values. No stroke is the first: with no velocity
measured, the scaling (K_H, μ, v) → (K_H s^(1-p), μ/s, s v) is one wide direction of the prior.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from ..felt import BOXES, FeltLaw
from ..parameters import STRING_NAMES, Geometry, Parameter, String

__all__ = ["ABSENT", "STRING_SIZE", "Parametrisation", "names_of"]

STRING_SIZE = len(STRING_NAMES)
# A loss that the felt's law does not have is held at this, log: its square is still a number.
ABSENT = -300.0


def names_of(law: FeltLaw) -> tuple[str, ...]:
    """What all strokes share, by name, in order: the string, then felt, hammer mass and contact."""
    return STRING_NAMES + law.columns


@dataclass(frozen=True)
class Parametrisation:
    """What is known of each unknown before the recordings: Gaussian priors of logarithms, in a box; [size] each."""

    mean: np.ndarray
    sd: np.ndarray  # 0: held at the mean
    lower: np.ndarray
    upper: np.ndarray
    log_reference_compression: float  # log of the reference compression, m
    stiffness: tuple[float, float]  # log of the least and the largest K_H; of no use to a law without a power
    geometry: Geometry  # strike and width are unknowns
    law: FeltLaw

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Of what all strokes share."""
        return names_of(self.law)

    @property
    def shared(self) -> int:
        """How many all strokes share; then come the velocities."""
        return len(self.names)

    def index_of(self, name: str) -> int:
        """Where an unknown stands."""
        return self.names.index(name)

    @cached_property
    def force_and_exponent_index(self) -> tuple[int, int] | None:
        """Where the force at the reference compression stands, in the stiffness's place, and the exponent."""
        return None if self.law.power is None else (self.index_of(self.law.power[0]), self.index_of(self.law.power[1]))

    @cached_property
    def reported(self) -> tuple[str, ...]:
        """The names that mean something to this law's hammers; the others are held."""
        own = (*STRING_NAMES, *self.law.kind._fields, "x0", "width")
        return tuple(name for name in self.names if name in own)

    @property
    def size(self) -> int:
        """How many, strokes included."""
        return len(self.mean)

    @property
    def strokes(self) -> int:
        """How many velocities."""
        return self.size - self.shared

    @property
    def free(self) -> np.ndarray:
        """Which are searched [size]."""
        return self.sd > 0

    @property
    def precision(self) -> np.ndarray:
        """Of the prior; 0 for what is held [size]."""
        return np.where(self.free, 1 / np.where(self.free, self.sd, 1.0) ** 2, 0.0)

    def project(self, z: np.ndarray) -> np.ndarray:
        """The nearest point of the box [..., size]; a force whose K_H would leave its own bounds goes to the edge."""
        z = np.where(self.free, np.clip(z, self.lower, self.upper), self.mean)
        if self.force_and_exponent_index and self.free[self.force_and_exponent_index[0]]:
            force, p = self.force_and_exponent_index
            low, high = (k + np.exp(z[..., p]) * self.log_reference_compression for k in self.stiffness)
            z[..., force] = np.clip(z[..., force], low, high)
        return z

    def bounds_at(self, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The ends of every unknown's range at `z` [..., size]."""
        lower, upper = (np.broadcast_to(x, z.shape).copy() for x in (self.lower, self.upper))
        if self.force_and_exponent_index and self.free[self.force_and_exponent_index[0]]:
            force, p = self.force_and_exponent_index
            shift = np.exp(z[..., p]) * self.log_reference_compression
            lower[..., force], upper[..., force] = self.stiffness[0] + shift, self.stiffness[1] + shift
        return lower, upper

    def at_bound(self, z: np.ndarray) -> np.ndarray:
        """Which free unknowns [..., size] lie on an edge."""
        lower, upper = self.bounds_at(z)
        return self.free & ((z <= lower + 1e-9) | (z >= upper - 1e-9))

    def range(self, i: int) -> tuple[float, float]:
        """The box of a value, logarithms; of K_H in the force's place."""
        return self.stiffness if self._is_force(i) else (float(self.lower[i]), float(self.upper[i]))

    def bound_jacobian(self, z: np.ndarray, active: np.ndarray) -> np.ndarray:
        """d z/d(what moves) [B, size, size] at `z`: where K_H is on an edge the force follows p, as in `project`."""
        out = np.tile(np.eye(self.size), (len(z), 1, 1))
        if self.force_and_exponent_index:
            force, p = self.force_and_exponent_index
            out[:, force, p] = np.where(
                active[:, force] & self.free[p], np.exp(z[:, p]) * self.log_reference_compression, 0.0
            )
        return out

    def from_log_values(self, x: np.ndarray) -> np.ndarray:
        """The point whose `log_values` are `x` [..., size]."""
        out = np.array(x, float)
        if self.force_and_exponent_index:
            out[..., self.force_and_exponent_index[0]] += (
                np.exp(x[..., self.force_and_exponent_index[1]]) * self.log_reference_compression
            )
        return out

    def fix_parameter(self, i: int, log: float) -> Parametrisation:
        """With one unknown, or K_H at the force's place, held at a logarithm: its box is a point."""
        if self._is_force(i):
            return replace(self, stiffness=(log, log))
        lower, upper = self.lower.copy(), self.upper.copy()
        lower[i] = upper[i] = log
        return replace(self, lower=lower, upper=upper)

    def string(self, z: np.ndarray) -> String:
        """The string at `z` [size]."""
        return String(
            *(_inside(BOXES[n], float(x)) for n, x in zip(STRING_NAMES, np.exp(z[:STRING_SIZE]), strict=True))
        )

    def hammer(self, z: np.ndarray, stroke: int) -> Any:
        """The hammer at `z` [size] at the velocity of one stroke."""
        logs = dict(zip(self.names, self.log_values(z), strict=False)) | {"v_H0": z[self.shared + stroke]}
        return self.law.make_hammer({n: _inside(box, float(np.exp(logs[n]))) for n, box in self.law.boxes.items()})

    def value(self, name: str, log: float) -> float:
        """A value from its logarithm, within its range if it has one."""
        boxes = BOXES | self.law.boxes
        return _inside(boxes[name], float(np.exp(log))) if name in boxes else float(np.exp(log))

    def geometry_at(self, z: np.ndarray) -> Geometry:
        """The geometry with the strike position and contact width at `z` [size]."""
        return self.geometry._replace(
            strike_position=float(np.exp(z[self.index_of("x0")])), width=float(np.exp(z[self.index_of("width")]))
        )

    def log_values(self, z: np.ndarray) -> np.ndarray:
        """The same with log K_H in the force's place [..., size]."""
        out = np.array(z, float)
        if self.force_and_exponent_index:
            out[..., self.force_and_exponent_index[0]] -= (
                np.exp(z[..., self.force_and_exponent_index[1]]) * self.log_reference_compression
            )
        return out

    def tangent(self, z: np.ndarray) -> np.ndarray:
        """d(log values)/dz [size, size] at `z` [size]."""
        out = np.eye(self.size)
        if self.force_and_exponent_index:
            out[self.force_and_exponent_index] = (
                -np.exp(z[self.force_and_exponent_index[1]]) * self.log_reference_compression
            )
        return out

    def _is_force(self, i: int) -> bool:
        return self.force_and_exponent_index is not None and i == self.force_and_exponent_index[0]


def _inside(box: Parameter, value: float) -> float:
    """The value within its range: the exponential of an edge's logarithm can round to beyond it."""
    return min(max(value, box.lower), box.upper)
