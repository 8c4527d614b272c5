"""The unknowns of a fit, all on a log scale: string, felt, hammer and contact, then the velocity of every stroke.

The felt's stiffness is searched as its static force at a reference compression, F = K_H u_ref^p: strokes fix the force
where they compress the felt, while K_H alone, whose unit changes with p, trades off against p. No stroke is the first:
with no velocity measured, the scaling (K_H, μ, v) → (K_H s^(1-p), μ/s, s v) is one wide direction of the prior.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ..parameters import PARAMETERS, Geometry, Hammer, MemoryHammer, String

__all__ = ["FORCE", "NAMES", "P", "SHARED", "STRING_SIZE", "VALUES", "WIDTH", "X0", "Unknowns"]

NAMES = ("c", "kappa", "b1", "b2", "force", "p", "mu", "M_H", "x0", "width", "epsilon", "tau")
# The same with what is reported in the force's place.
VALUES = tuple("K_H" if name == "force" else name for name in NAMES)
SHARED = len(NAMES)
STRING_SIZE = 4
FORCE, P, MU, X0, WIDTH = (NAMES.index(name) for name in ("force", "p", "mu", "x0", "width"))
# A loss that the felt's law does not have is held at this, log: its square is still a number.
ABSENT = -300.0


@dataclass(frozen=True)
class Unknowns:
    """What is known of each unknown before the recordings: Gaussian priors of logarithms, in a box; [size] each."""

    mean: np.ndarray
    sd: np.ndarray  # 0: held at the mean
    lower: np.ndarray
    upper: np.ndarray
    log_u: float  # log of the reference compression, m
    stiffness: tuple[float, float]  # log of the least and the largest K_H
    geometry: Geometry  # strike and width are unknowns
    memory: bool  # whether the felt relaxes

    @property
    def size(self) -> int:
        """How many, strokes included."""
        return len(self.mean)

    @property
    def strokes(self) -> int:
        """How many velocities."""
        return self.size - SHARED

    @property
    def free(self) -> np.ndarray:
        """Which are searched [size]."""
        return self.sd > 0

    def project(self, z: np.ndarray) -> np.ndarray:
        """The nearest point of the box [..., size]; a force whose K_H would leave its own bounds goes to the edge."""
        z = np.where(self.free, np.clip(z, self.lower, self.upper), self.mean)
        if self.free[FORCE]:
            low, high = (k + np.exp(z[..., P]) * self.log_u for k in self.stiffness)
            z[..., FORCE] = np.clip(z[..., FORCE], low, high)
        return z

    def edges(self, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The ends of every unknown's range at `z` [..., size]."""
        lower, upper = (np.broadcast_to(x, z.shape).copy() for x in (self.lower, self.upper))
        if self.free[FORCE]:
            shift = np.exp(z[..., P]) * self.log_u
            lower[..., FORCE], upper[..., FORCE] = self.stiffness[0] + shift, self.stiffness[1] + shift
        return lower, upper

    def at_bound(self, z: np.ndarray) -> np.ndarray:
        """Which free unknowns [..., size] lie on an edge."""
        lower, upper = self.edges(z)
        return self.free & ((z <= lower + 1e-9) | (z >= upper - 1e-9))

    def range(self, i: int) -> tuple[float, float]:
        """The box of a value, logarithms; of K_H in the force's place."""
        return self.stiffness if i == FORCE else (float(self.lower[i]), float(self.upper[i]))

    def along_edges(self, z: np.ndarray, active: np.ndarray) -> np.ndarray:
        """d z/d(what moves) [B, size, size] at `z`: where K_H is on an edge the force follows p, as in `project`."""
        out = np.tile(np.eye(self.size), (len(z), 1, 1))
        out[:, FORCE, P] = np.where(active[:, FORCE] & self.free[P], np.exp(z[:, P]) * self.log_u, 0.0)
        return out

    def from_log_values(self, x: np.ndarray) -> np.ndarray:
        """The point whose `log_values` are `x` [..., size]."""
        out = np.array(x, float)
        out[..., FORCE] = x[..., FORCE] + np.exp(x[..., P]) * self.log_u
        return out

    def held(self, name: int, log: float) -> Unknowns:
        """With one unknown, or K_H at the force's place, held at a logarithm: its box is a point."""
        if name == FORCE:
            return replace(self, stiffness=(log, log))
        lower, upper = self.lower.copy(), self.upper.copy()
        lower[name] = upper[name] = log
        return replace(self, lower=lower, upper=upper)

    def string(self, z: np.ndarray) -> String:
        """The string at `z` [size]."""
        return String(*(_inside(n, float(x)) for n, x in zip(String._fields, np.exp(z[:STRING_SIZE]), strict=True)))

    def hammer(self, z: np.ndarray, stroke: int) -> Hammer | MemoryHammer:
        """The hammer at `z` [size] at the velocity of one stroke."""
        force, p, mu, mass = z[FORCE], np.exp(z[P]), np.exp(z[MU]), np.exp(z[NAMES.index("M_H")])
        values = np.exp(force - p * self.log_u), mu, p, mass, np.exp(z[SHARED + stroke])
        five = [_inside(n, float(x)) for n, x in zip(Hammer._fields, values, strict=True)]
        if z[MU] <= ABSENT:
            five[Hammer._fields.index("mu")] = 0.0
        if not self.memory:
            return Hammer(*five)
        memory = zip(("epsilon", "tau"), np.exp(z[NAMES.index("epsilon") : SHARED]), strict=True)
        return MemoryHammer(*five, *(_inside(n, float(x)) for n, x in memory))

    def struck(self, z: np.ndarray) -> Geometry:
        """The geometry with the strike position and contact width at `z` [size]."""
        return self.geometry._replace(strike=float(np.exp(z[X0])), width=float(np.exp(z[WIDTH])))

    def log_values(self, z: np.ndarray) -> np.ndarray:
        """The same with log K_H in the force's place [..., size]."""
        out = np.array(z, float)
        out[..., FORCE] = z[..., FORCE] - np.exp(z[..., P]) * self.log_u
        return out

    def tangent(self, z: np.ndarray) -> np.ndarray:
        """d(log values)/dz [size, size] at `z` [size]."""
        out = np.eye(self.size)
        out[FORCE, P] = -np.exp(z[P]) * self.log_u
        return out


def _inside(name: str, value: float) -> float:
    """The value within its range: the exponential of an edge's logarithm can round to beyond it."""
    return min(max(value, PARAMETERS[name].lower), PARAMETERS[name].upper)


def box(name: str) -> tuple[float, float]:
    """The range of a parameter, logarithms."""
    return float(np.log(PARAMETERS[name].lower)), float(np.log(PARAMETERS[name].upper))
