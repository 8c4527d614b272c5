"""The hammer's search on a string that is known: many starts at once, the paper's criterion first, then levels."""

from __future__ import annotations

from dataclasses import replace

import jax.numpy as jnp
import numpy as np

from ..errors import FitError
from .levenberg import descend
from .residuals import Target, hammer_batch
from .screen import screened
from .space import LOG, NAMES, K, P
from .state import State

__all__ = ["anchored", "comparable", "physical", "search_hammers"]

# Starts of a batch, batches at most, and iterations on eq. 19.
STARTS, BATCHES, ENERGIES = 16, 6, 20
# Power of energy by which levels are weighed, iterations, and how many of a batch's starts, the best, go on: loud
# partials lead to the basin, all of them finish, and where a start leads shows long before it is there.
GRADES = ((0.25, 10, 8), (0.0, 5, 4), (0.0, 15, 4))
# One uncalibrated take does not show whether it is explained: it has one batch, of more starts, each led less far.
ALONE, FEWER_ENERGIES = 32, 8
GRADES_ALONE = ((0.25, 3, 16), (0.25, 7, 8), *GRADES[1:])
# Several takes through a path are one race, of the likeliest starts of so many times as many. Two steps tell in which
# third of them the best are.
RACING, SCREENED = 48, 8
RACE = ((0.25, 2, 16), (0.25, 4, 8), (0.0, 5, 6), (0.0, 10, 6))
# Starts whose costs differ by less than this ended at about the same place, or just there.
AGREEMENT, SAME = 0.5, 0.05
# Hammers that cost more than the best by less than this may be better at the weights that are found later.
OPEN = 20.0
# Velocities that differ by less than this, log, are not worth another round.
SAME_VELOCITY = 1e-3

V, MU = NAMES.index("v_H0"), NAMES.index("mu")


def search_hammers(state: State, seed: int) -> tuple[np.ndarray, int, int]:
    """The best hammers [hammers, size], the best first; how many starts ended there; and evaluations of batches.

    Those of several takes through a path are screened first: a gradient leads to the next minimum, and there are many.
    One uncalibrated take has one batch. All others are searched by the batch, until two hammers end at the same lowest
    cost or all batches are spent. Of a calibrated recording a hammer should explain all but the first scatter; many can
    agree on one that does not.
    """
    if comparable(state):
        z, cost, count = _hammers(state, screened(state, _starts(state, SCREENED * RACING, seed))[:RACING], RACE)
    elif state.data.layout.takes == 1 and not state.data.calibrated:
        z, cost, count = _hammers(state, _starts(state, ALONE, seed), GRADES_ALONE, FEWER_ENERGIES)
    else:
        z, cost, count = _by_the_batch(state, seed)
    if not np.isfinite(cost).any():
        raise FitError("no hammer within the bounds gives a finite sound; widen [bounds] or check [known] in the setup")
    order = np.argsort(cost, kind="stable")[: np.isfinite(cost).sum()]
    z, cost = z[order], cost[order]
    told = (cost < cost[0] + OPEN) & (np.diff(cost, prepend=-np.inf) > SAME)
    return z[told], _agreeing(cost), count


def _by_the_batch(state: State, seed: int) -> tuple[np.ndarray, np.ndarray, int]:
    starts = _starts(state, BATCHES * STARTS, seed)
    z, cost, count = np.zeros((0, starts.shape[1])), np.zeros(0), 0
    for batch in np.split(starts, BATCHES):
        found, costs, evaluations = _hammers(state, batch, GRADES, ENERGIES)
        z, cost, count = np.append(z, found, axis=0), np.append(cost, costs), count + evaluations
        explained = not state.data.calibrated or cost.min() <= 0.5 * state.data.found.sum()
        if _agreeing(cost) > 1 and explained:
            break
    return z, cost, count


def _agreeing(cost: np.ndarray) -> int:
    return int((cost < cost.min() + AGREEMENT).sum())


def comparable(state: State) -> bool:
    """Whether several blows were heard with gains that are not known, so that levels tell of a hammer by comparison."""
    return state.data.layout.compared and not state.data.calibrated


def _starts(state: State, count: int, seed: int) -> np.ndarray:
    """Search points [count, size]: the literature's hammer, and others thrown about it by the literature's spread."""
    space = state.space
    throw = np.random.default_rng(seed).standard_normal((count, len(space.start)))
    throw[0] = 0.0
    return space.project(space.z(space.start[None]) + throw * np.where(physical(state), space.spread, 0.0))


def physical(state: State) -> np.ndarray:
    """Which coordinates [size] are a hammer's, its blows included, and of a known spread."""
    index = np.arange(state.data.layout.size)
    hammer = (index >= 4) & ((index < LOG) | np.isin(index, state.data.layout.ratio))
    return hammer & np.isfinite(state.space.spread)


def _hammers(state: State, z: np.ndarray, grades: tuple, energies: int = 0) -> tuple[np.ndarray, np.ndarray, int]:
    """Many hammers on one string: eq. 19 in the hammer's band, then levels, the loud ones first.

    `z` [starts, size] is where they start, `grades` how they go on, as in `GRADES`, after `energies` iterations on
    eq. 19. Several takes are compared with each other, which that cannot do: theirs begin with the levels. Returns the
    best points, their costs and how often the batch was evaluated.
    """
    space, layout = state.space, state.data.layout
    spread = state.first_spread(10.0, 1.0)
    hammer, thrown = np.arange(layout.size) >= 4, physical(state)
    at, count = state.target(spread, state.unweighted), 0
    if layout.takes == 1:
        by_energy = at._replace(by_energy=jnp.ones_like(at.by_energy))
        end = descend(
            state.evaluate(hammer_batch, by_energy), z, space, iterations=energies, free=thrown, tolerance=1e-3
        )
        z, count = end.z, end.evaluations
    z = _levelled(state, at, space.project(z))
    cost = np.zeros(0)
    for grade, iterations, keep in grades:
        at = state.target(spread, state.unweighted, grade)
        end = descend(state.evaluate(hammer_batch, at), z, space, iterations=iterations, free=hammer, tolerance=1e-4)
        best = np.argsort(end.cost)[:keep]
        z, cost, count = end.z[best], end.cost[best], count + end.evaluations
    return z, cost, count


def anchored(state: State, z: np.ndarray) -> tuple[State, np.ndarray]:
    """The state and point [1, size] at which the fastest take has the velocity that was assumed for the fastest.

    Which take that is comes out of the fit. With all velocities s times as large, K_H s^(1 - p), μ/s and gains 1/s
    times as large, nothing heard changes (design §1).
    """
    layout, space = state.data.layout, state.space
    fastest = float(z[0, layout.ratio].max())
    s = state.start.values["v_H0"] / (np.exp(fastest) * space.start[V])
    if layout.takes == 1 or state.start.fixed.get("v_H0") != "assumed" or abs(np.log(s)) < SAME_VELOCITY:
        return state, z
    p, z, values = float(np.exp(z[0, P])), z.copy(), space.start.copy()
    values[V] *= s
    for index, change in ((V, 1.0), (K, 1.0 - p), (MU, -1.0)):
        z[0, index] += change * np.log(s) * (index == V or space.free[index])
    z[0, np.unique(layout.gain)] -= 20 * np.log10(s)
    held = np.arange(layout.size) == V
    space = replace(
        space, start=values, lower=np.where(held, values, space.lower), upper=np.where(held, values, space.upper)
    )
    return replace(state, space=space), space.project(z)


def _levelled(state: State, at: Target, z: np.ndarray) -> np.ndarray:
    """The points `z` [starts, size] with the gains at which each take is right on average."""
    if state.data.calibrated:
        return z
    level = state.evaluate(hammer_batch, at)(z)[2][:, :, 2]
    weight = np.asarray(at.level_weight) ** 2
    gain = ((np.asarray(at.level) - level) * weight).sum(axis=2) / weight.sum(axis=1)
    z = z.copy()
    for take in range(state.data.layout.takes):
        column = state.data.layout.gain[take]
        same = state.data.layout.gain == column
        z[:, column] = np.clip(gain[:, same].mean(axis=1), -300, 300)
    return z
