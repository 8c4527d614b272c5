"""Where a fit searches: the logarithms of the nine parameters and of the strike position, within a box.

The felt's stiffness is searched as the force at a reference compression, F_ref = K_H u_ref^p: K_H and p trade off along
F = const at the compressions that a strike really reaches, and F_ref is what the recording fixes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..parameters import FIT_NAMES, PARAMETERS, Hammer, String

__all__ = ["NAMES", "Space", "split", "stiffness"]

NAMES = (*FIT_NAMES, "x0")
K, P = NAMES.index("K_H"), NAMES.index("p")


def split(values) -> tuple[String, Hammer]:
    """Parameters [10] in the order of `NAMES` as string and hammer; x0 is the last."""
    return String(*values[:4]), Hammer(*values[4:9])


def stiffness(log_force, p, log_u):
    """log K_H of a felt that pushes with exp(`log_force`) N at the reference compression exp(`log_u`) m."""
    return log_force - p * log_u


@dataclass(frozen=True)
class Space:
    """The box [10] in natural units, what is free in it, where it starts, and how far the start may be off."""

    lower: np.ndarray
    upper: np.ndarray
    free: np.ndarray
    start: np.ndarray
    spread: np.ndarray  # standard deviation of log(value) about the start; inf where nothing is known
    log_u: float

    def z(self, values: np.ndarray) -> np.ndarray:
        """Search coordinates of natural `values` [..., 10]."""
        z = np.log(values)
        z[..., K] += values[..., P] * self.log_u
        return z

    def values(self, z: np.ndarray) -> np.ndarray:
        """Natural values [..., 10] of search coordinates."""
        values = np.exp(z)
        values[..., K] = np.exp(stiffness(z[..., K], values[..., P], self.log_u))
        return values

    def project(self, z: np.ndarray) -> np.ndarray:
        """The nearest point of the box, coordinate by coordinate; fixed coordinates go back to their start."""
        values = np.clip(self.values(np.clip(z, -600, 600)), self.lower, self.upper)
        return self.z(np.where(self.free, values, self.start))

    def at_bound(self, values: np.ndarray) -> np.ndarray:
        """Which free parameters [10] sit on an edge of the box."""
        edge = 1e-6 * np.log(self.upper / self.lower)
        low, high = np.log(values / self.lower) <= edge, np.log(self.upper / values) <= edge
        return self.free & (low | high)


def default_box(length: float, width: float) -> tuple[np.ndarray, np.ndarray]:
    """Bounds [10] of `PARAMETERS`, and of a strike position that keeps the window on the string's first third."""
    lower = [PARAMETERS[n].lower for n in FIT_NAMES] + [max(0.04 * length, 0.51 * width)]
    upper = [PARAMETERS[n].upper for n in FIT_NAMES] + [0.33 * length]
    return np.array(lower), np.array(upper)
