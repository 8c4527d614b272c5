"""Small least-squares problems with known answers, in a box."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from pianofit.paper.levenberg import Box

Z = np.ndarray


def cube(size: int, low: float = -3.0, high: float = 3.0) -> Box:
    return Box(np.full(size, low), np.full(size, high))


def batched(function: Callable[[Z], np.ndarray], seen: list[Z] | None = None) -> Callable:
    """What `descend` evaluates: residuals of every row and their Jacobian, by central differences."""

    def evaluate(z: Z) -> tuple[np.ndarray, np.ndarray]:
        if seen is not None:
            seen.append(z.copy())
        step = 1e-6
        residual = np.stack([function(row) for row in z])
        columns = [
            np.stack([(function(row + e) - function(row - e)) / (2 * step) for row in z])
            for e in step * np.eye(z.shape[1])
        ]
        return residual, np.stack(columns, axis=2)

    return evaluate


def start_points(box: Box, number: int, seed: int = 0) -> Z:
    """Random points [number, size] of the box."""
    return np.random.default_rng(seed).uniform(*box, (number, len(box.lower)))


def exponential(z: Z) -> np.ndarray:
    """Residuals of a exp(-b t) + c + d t against data with an error; a to d are the exponentials of z[0] to z[3]."""
    t = np.linspace(0, 4, 30)
    a, b, c, d = np.exp(z[:4])
    data = 2.0 * np.exp(-0.7 * t) + 0.3 + 0.2 * t + 0.05 * np.sin(37 * t)
    return a * np.exp(-b * t) + c + d * t - data


def rosenbrock(z: Z) -> np.ndarray:
    """Zero at (1, 1), at the end of a curved valley."""
    return np.array([10 * (z[1] - z[0] ** 2), 1 - z[0]])
