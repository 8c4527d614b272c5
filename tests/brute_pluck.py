"""A plucked string by brute force: an independent reference for the tests, on the grid of `brute_force`.

The static shape under a force over the contact window is solved for on the grid of points, with its stiffness. The
string is released from it. Its motion is the exact exponential of the matrix of the grid. The package instead expands
the shape in sines. Frequencies above the band of the sample rate are left out.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from brute_force import HALF, Grid, Strike, _exponentials, fold, matched_width

# Highest frequency of the output over the sample rate.
BAND = 0.45


def static_shape(grid: Grid) -> np.ndarray:
    """Displacement of the points, m, under a static force of 1 N on the contact window."""
    offsets = np.arange(-2 * HALF, 2 * HALF + 1)
    stiffness = np.stack([fold(grid.N, i + offsets, -grid.pull) for i in range(1, grid.N + 1)])
    return np.linalg.solve(stiffness, grid.window / (grid.h * grid.density))


def pluck(
    string: Any,
    geometry: Any,
    *,
    rate: float,
    samples: int,
    quantity: str,
    window: str = "raised-cosine",
    points: int = 240,
) -> np.ndarray:
    """The signal from the release on [samples], in SI units, after a force of 1 N.

    `window` has the variance of a raised cosine of the width of the geometry.
    """
    geometry = geometry._replace(width=matched_width(window, geometry.width))
    grid = Grid(string, geometry, points, window)
    row = grid.pickup(quantity, geometry)
    poles, amplitudes = _exponentials(grid, row, static_shape(grid), np.zeros(grid.N), quantity == "velocity")
    keep = (poles.imag > 0) & (poles.imag < 2 * np.pi * BAND * rate)
    free = Strike(rate, *(np.zeros(0),) * 5, poles[keep], 2 * amplitudes[keep])
    return free.free(np.arange(samples) / rate)
