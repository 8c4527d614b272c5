"""Where a fit searches: logarithms of parameters, strike position and width, then the takes' own and paths, in a box.

The felt's stiffness is searched as the force at a reference compression, F_ref = K_H u_ref^p: K_H and p trade off along
F = const at the compressions that a strike really reaches, and F_ref is what the recording fixes. String, felt and
hammer are those of all takes, v_H0 is that of the first; `Layout` says where the rest is. A calibrated recording has
neither gain nor path.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..criterion import PATH_TERMS
from ..parameters import FIT_NAMES, MEMORY_NAMES, PARAMETERS, Geometry, Hammer, MemoryHammer, String

__all__ = [
    "ABSENT",
    "LOG",
    "NAMES",
    "SIZE",
    "Box",
    "K",
    "Layout",
    "P",
    "Space",
    "default_box",
    "split",
    "stiffness",
    "struck",
]

NAMES = (*FIT_NAMES, "x0", "width", *MEMORY_NAMES)
LOG = len(NAMES)
K, P = NAMES.index("K_H"), NAMES.index("p")
# What a felt's law does not have is searched nowhere; on a log scale it is held at this.
ABSENT = 1e-12
# Gain and path stay within this, dB, log velocity ratios and pitches, cents, within these.
MOST_DB, MOST_RATIO, MOST_CENTS = 400.0, 5.0, 50.0


@dataclass(frozen=True)
class Layout:
    """Where in a search point [size] a take has its own: v_H0 over the first take's (log), gain, dB, pitch, cents."""

    groups: tuple[int, ...] = (0,)  # of each take: takes of one group, from 0, share one path
    gains: tuple[int, ...] = (0,)  # of each take: the take whose gain it has
    strikes: tuple[int, ...] = (0,)  # of each take: the take whose velocity and pitch it has, as of one blow

    @property
    def takes(self) -> int:
        """How many."""
        return len(self.groups)

    @property
    def compared(self) -> bool:
        """Whether any path was heard with two velocities: only then hammer and path can be told apart."""
        pairs = set(zip(self.groups, self.strikes, strict=True))
        return len(pairs) > max(self.groups) + 1

    @property
    def size(self) -> int:
        """Of a search point."""
        return LOG + 3 * self.takes + PATH_TERMS * (max(self.groups) + 1)

    @property
    def ratio(self) -> np.ndarray:
        """Coordinates of the log velocity ratios [takes]; the first, and whatever shares it, stays 0."""
        return LOG + 3 * np.array(self.strikes)

    @property
    def gain(self) -> np.ndarray:
        """Coordinates of the gains [takes]."""
        return LOG + 3 * np.array(self.gains) + 1

    @property
    def cents(self) -> np.ndarray:
        """Coordinates of the pitches [takes]; the first, and whatever shares it, stays 0."""
        return LOG + 3 * np.array(self.strikes) + 2

    @property
    def path(self) -> np.ndarray:
        """Coordinates of the paths' terms [takes, terms]."""
        first = LOG + 3 * self.takes + PATH_TERMS * np.array(self.groups)
        return first[:, None] + np.arange(PATH_TERMS)


SIZE = Layout().size


def split(values: np.ndarray) -> tuple[String, Hammer | MemoryHammer]:
    """Parameters in the order of `NAMES` as string and hammer."""
    string, (stiffness, mu, *rest) = String(*map(float, values[:4])), map(float, values[4:9])
    hammer, memory = Hammer(stiffness, mu if mu > ABSENT else 0.0, *rest), values[11:13]
    return string, MemoryHammer(*hammer, *map(float, memory)) if memory[0] > ABSENT else hammer


def struck(geometry: Geometry, values: np.ndarray) -> Geometry:
    """`geometry` with the strike's position and width of `values` in the order of `NAMES`."""
    return geometry._replace(strike=float(values[9]), width=float(values[10]))


def stiffness(log_force, p, log_u):
    """log K_H of a felt that pushes with exp(`log_force`) N at the reference compression exp(`log_u`) m."""
    return log_force - p * log_u


@dataclass(frozen=True)
class Box:
    """A plain box in search coordinates [size]; where its edges meet nothing moves."""

    lower: np.ndarray
    upper: np.ndarray

    @property
    def free(self) -> np.ndarray:
        """Which coordinates may move [size]."""
        return self.upper > self.lower

    def project(self, z: np.ndarray) -> np.ndarray:
        """The nearest point of the box."""
        return np.clip(z, self.lower, self.upper)

    def pressed(self, z: np.ndarray, downhill: np.ndarray) -> np.ndarray:
        """Which coordinates [..., size] sit on an edge that a step `downhill` would leave."""
        return ((z <= self.lower) & (downhill < 0)) | ((z >= self.upper) & (downhill > 0))


@dataclass(frozen=True)
class Space:
    """The box in natural units, what is free in it, where it starts, and how far the start may be off: all [size]."""

    lower: np.ndarray
    upper: np.ndarray
    free: np.ndarray
    start: np.ndarray
    spread: np.ndarray  # standard deviation about the start, of log(value) or of dB; inf where nothing is known
    log_u: float

    def z(self, values: np.ndarray) -> np.ndarray:
        """Search coordinates of natural `values` [..., size]."""
        z = np.array(values, float)
        z[..., :LOG] = np.log(values[..., :LOG])
        z[..., K] += values[..., P] * self.log_u
        return z

    def values(self, z: np.ndarray) -> np.ndarray:
        """Natural values [..., size] of search coordinates."""
        values = np.array(z, float)
        values[..., :LOG] = np.exp(np.clip(z[..., :LOG], -300, 300))
        values[..., K] = np.exp(np.clip(stiffness(z[..., K], values[..., P], self.log_u), -300, 300))
        return values

    def natural(self, z: np.ndarray) -> np.ndarray:
        """Natural values within the box to the last digit, what is fixed exactly at its start.

        A bound that went through a logarithm and back comes out beside itself.
        """
        return np.where(self.free, np.clip(self.values(z), self.lower, self.upper), self.start)

    def project(self, z: np.ndarray) -> np.ndarray:
        """The nearest point of the box, coordinate by coordinate; fixed coordinates go back to their start.

        K_H comes last: a p that is clipped keeps the force at the reference compression.
        """
        values = np.where(self.free, np.clip(self.values(z), self.lower, self.upper), self.start)
        if self.free[K]:
            k = np.exp(np.clip(stiffness(z[..., K], values[..., P], self.log_u), -300, 300))
            values[..., K] = np.clip(k, self.lower[K], self.upper[K])
        return self.z(values)

    def pressed(self, z: np.ndarray, downhill: np.ndarray) -> np.ndarray:
        """Which coordinates [..., size] sit on an edge of the box that a step `downhill` would leave."""
        values = self.values(z)
        low = values <= self.lower + 1e-9 * np.abs(self.lower)
        high = values >= self.upper - 1e-9 * np.abs(self.upper)
        return (low & (downhill < 0)) | (high & (downhill > 0))

    def at_bound(self, values: np.ndarray) -> np.ndarray:
        """Which free parameters [size] sit on an edge of the box."""
        low, high = self.z(self.lower), self.z(self.upper)
        edge = 1e-6 * (high - low)[:LOG]
        log = np.log(values[:LOG])
        on = (log - np.log(self.lower[:LOG]) <= edge) | (np.log(self.upper[:LOG]) - log <= edge)
        return self.free & np.pad(on, (0, len(values) - LOG))


def default_box(length: float, width: float, layout: Layout = Layout()) -> tuple[np.ndarray, np.ndarray]:
    """Bounds of `PARAMETERS`, of a strike that keeps its window on the string's first part, and of the takes' own."""
    rest = np.full(layout.size, MOST_DB)
    rest[layout.ratio], rest[layout.cents] = MOST_RATIO, MOST_CENTS
    lower = [PARAMETERS[n].lower for n in FIT_NAMES] + [max(0.04 * length, 0.51 * width), 0.3 * width]
    upper = [PARAMETERS[n].upper for n in FIT_NAMES] + [0.33 * length, 2.0 * width]
    lower += [PARAMETERS[n].lower for n in MEMORY_NAMES]
    upper += [PARAMETERS[n].upper for n in MEMORY_NAMES]
    return np.append(lower, -rest[LOG:]), np.append(upper, rest[LOG:])
