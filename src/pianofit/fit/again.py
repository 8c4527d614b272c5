"""A second, closer search for the hammer of takes through a path, at the weights by which the answer is judged.

The first search weighs levels before anything is known of their scatter, several dB. Once it is known to be a fraction
of one, what was a single wide valley falls apart into some: the hammer's bounces and the reflections that meet it make
ripples along it. Starts are thrown about the place that was found, and go down on the settled weights.
"""

from __future__ import annotations

import numpy as np

from .hammers import physical
from .levenberg import descend
from .residuals import Target, hammer_batch
from .state import State

__all__ = ["nearby"]

# Where starts are thrown, in units of the literature's spread: hardly beyond what the first search left open.
THROWS = (0.1,) * 8 + (0.3,) * 8
# Iterations, and how many of the starts, the best, go on.
LEGS, TOLERANCE = ((2, 6), (4, 3), (20, 1)), 1e-4
# Costs that differ by less than this are of the same place.
LOWER = 0.5


def nearby(state: State, at: Target, z: np.ndarray, cost: float, seed: int) -> tuple[np.ndarray | None, int]:
    """The best hammer [1, size] near `z` whose cost is lower than `cost`, or None, and how many evaluations it took.

    Parameters
    ----------
    at : the takes with the weights under which `z` costs `cost`.
    """
    space, layout = state.space, state.data.layout
    hammer = np.arange(layout.size) >= 4
    throw = np.random.default_rng(seed).standard_normal((len(THROWS), layout.size)) * np.array(THROWS)[:, None]
    z = space.project(z + throw * np.where(physical(state) & space.free, space.spread, 0.0))
    count, least = 0, np.inf
    for iterations, keep in LEGS:
        end = descend(
            state.evaluate(hammer_batch, at), z, space, iterations=iterations, free=hammer, tolerance=TOLERANCE
        )
        best = np.argsort(end.cost)[:keep]
        z, count, least = end.z[best], count + end.evaluations, end.cost[best[0]]
    return z if least < cost - LOWER else None, count
