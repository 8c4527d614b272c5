"""Where the criterion looks: one cell of frequencies around each partial, gathered into the paper's three bands.

The paper splits the spectrum after the tristimulus: the fundamental, partials two to eight, and everything above
(IV.B). Borders lie midway between inharmonic partials, at k = 0.5, 1.5 and 8.5 of f_k = k f0 √(1 + B k²); they come
from the analysis and stay fixed during a fit. Between partials there is next to no energy to compare, so each cell
reaches only a number of linewidths from its partial, or to its borders.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

__all__ = ["BANDS", "WIDEST_SIGMA", "Cells", "band_of", "borders", "cell_grid", "line_sigma", "partial_frequency"]

BANDS = ("band1", "band2", "band3")
NODES = 48
# Half a cell in units of the linewidth σ/2π: beyond it a Lorentzian's energy is down by a factor 150.
REACH = 12.0
# σ at which the criterion is weighed and reported, 1/s, and the spacing of partials in linewidths it must leave.
WIDEST_SIGMA, APART = 30.0, 16.0


class Cells(NamedTuple):
    """Frequencies at which spectra are compared on the damped circle of `sigma`, 1/s."""

    frequency: np.ndarray  # Hz, [partials, nodes]
    spacing: np.ndarray  # Hz, [partials]: the weight of each node
    sigma: float


def partial_frequency(k: np.ndarray, f0: float, B: float) -> np.ndarray:
    """f_k = k f0 √(1 + B k²), Hz, for any real k."""
    return k * f0 * np.sqrt(1 + B * np.square(k))


def line_sigma(f0: float) -> float:
    """σ, 1/s, at which lines are wide enough to forgive cents, and the partials of `f0`, Hz, still stand apart."""
    return min(WIDEST_SIGMA, 2 * np.pi * f0 / APART)


def borders(f0: float, B: float, last: int) -> tuple[float, ...]:
    """Band edges, Hz: below the fundamental, 1|2, 8|9, and above partial `last`."""
    k = np.array([0.5, 1.5, 8.5, max(last, 9) + 0.5])
    return tuple(partial_frequency(k, f0, B).tolist())


def band_of(number: np.ndarray) -> np.ndarray:
    """Index into `BANDS` of each partial number."""
    return np.searchsorted([2, 9], number, side="right")


def cell_grid(f0: float, B: float, last: int, sigma: float, resolution: float) -> Cells:
    """Cells of partials 1 to `last`, with nodes at whole multiples of `resolution`, Hz."""
    k = np.arange(1, last + 1)
    centre = partial_frequency(k, f0, B)
    half = np.minimum(REACH * sigma / (2 * np.pi), 0.5 * f0)
    low = np.maximum(partial_frequency(k - 0.5, f0, B), centre - half)
    high = np.minimum(partial_frequency(k + 0.5, f0, B), centre + half)
    spacing = np.maximum(np.round((high - low) / NODES / resolution), 1) * resolution
    first = np.round((centre - spacing * (NODES - 1) / 2) / resolution) * resolution
    return Cells(first[:, None] + spacing[:, None] * np.arange(NODES), spacing, sigma)
