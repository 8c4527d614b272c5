"""Small problems with known answers, in the coordinates of the fit."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from pianofit.fit.space import LOG, SIZE, Space

Z = np.ndarray


def space(free: list[int], low: float = -3.0, high: float = 3.0, log_u: float = 0.0) -> Space:
    """A box from exp(low) to exp(high) about 1, in which the coordinates `free` are free."""
    one = np.concatenate([np.ones(LOG), np.zeros(SIZE - LOG)])
    lower = np.where(np.arange(SIZE) < LOG, np.exp(low), low)
    upper = np.where(np.arange(SIZE) < LOG, np.exp(high), high)
    mask = np.isin(np.arange(SIZE), free)
    return Space(np.where(mask, lower, one), np.where(mask, upper, one), mask, one, np.full(SIZE, np.inf), log_u)


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


def start_points(box: Space, number: int, seed: int = 0) -> Z:
    """Random points [number, size] of the box."""
    random = np.random.default_rng(seed).uniform(size=(SIZE, number)).T
    low, high = box.z(box.lower), box.z(box.upper)
    return box.project(low + random * (high - low))


def exponential(z: Z) -> np.ndarray:
    """Residuals of a exp(-b t) + c + d t against data with an error; a to d are the exponentials of z[0] to z[3]."""
    t = np.linspace(0, 4, 30)
    a, b, c, d = np.exp(z[:4])
    data = 2.0 * np.exp(-0.7 * t) + 0.3 + 0.2 * t + 0.05 * np.sin(37 * t)
    return a * np.exp(-b * t) + c + d * t - data


def rosenbrock(z: Z) -> np.ndarray:
    """Zero at (1, 1), at the end of a curved valley."""
    return np.array([10 * (z[1] - z[0] ** 2), 1 - z[0]])
