"""Where the search for the hammer of several takes through a path begins: the likeliest of many, by their levels.

A felt and a mass make a family of spectra, one for every velocity. Laid on what was recorded, with a gain of its own
for each take and a level of its own for each partial of a group, they leave only the takes' velocities open, and these
are chosen from a grid, blow after blow, beside a wide belief about them. So a hammer is judged without a derivative.
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from .levenberg import in_groups
from .residuals import level_batch
from .state import State, pool

__all__ = ["CALL", "VELOCITIES", "screened"]

# Velocities that each hammer is looked at with, and hammers that one call looks at.
VELOCITIES, CALL = 16, 8
# The grid's ends, log of the velocity over the first take's. The first is the brightest, or the fastest that was
# measured: then others may be faster by more.
SLOWEST, FASTEST, FASTER = -2.8, 0.45, 1.6
# Levels scatter about a hammer that is not quite the right one by this much, dB.
SCATTER = 2.0
# What a blow costs whose contact does not end.
NEVER = 1e6
# Rounds in which every blow chooses anew.
ROUNDS = 6


def screened(state: State, z: np.ndarray) -> np.ndarray:
    """The points `z` [hammers, size], each with the velocities that suit it best, the likeliest hammer first.

    A blow that is alone on its path suits any velocity, and keeps the one it has.
    """
    at, grid = state.target(state.first_spread(10.0, 1.0), state.unweighted), _grid(state)

    def levels(some: np.ndarray) -> tuple:
        return level_batch(jnp.asarray(some), jnp.asarray(grid), at, state.cfg)

    (model,) = in_groups(levels, CALL, pool().map)(z)
    ratio, cost = _suited(state, model, grid, z[:, state.data.layout.ratio])
    z = z.copy()
    z[:, state.data.layout.ratio] = ratio
    return z[np.argsort(cost, kind="stable")]


def _grid(state: State) -> np.ndarray:
    """Log velocity ratios [VELOCITIES], with all that are known between its ends."""
    start = state.space.start[state.data.layout.ratio]
    fastest = FASTEST if state.start.fixed.get("v_H0") == "assumed" else FASTER
    return np.linspace(min(SLOWEST, start.min()), max(fastest, start.max()), VELOCITIES)


def _suited(state: State, model: np.ndarray, grid: np.ndarray, ratio: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Log velocity ratios [hammers, takes], of blows that can be compared from the grid, and hammers' costs [hammers].

    `model` are levels [hammers, velocities, rows], dB; `ratio` [hammers, takes] is what is known or was thrown.
    """
    data, layout, space = state.data, state.data.layout, state.space
    used, ratio = data.found.any(axis=0), ratio.copy()
    ended = np.asarray(np.isfinite(model).all(axis=2))
    model = np.where(ended[..., None], model, 0.0)[:, :, used]
    weight = (data.found / np.hypot(data.level_error, SCATTER * data.buried) ** 2)[:, used]
    form = quadratic(weight, layout.gains, layout.groups if state.start.quantity == "pressure" else None)
    takes, rows = weight.shape
    believed = 0.5 * ((grid - space.start[layout.ratio, None]) / space.spread[layout.ratio, None]) ** 2
    rest = data.level[:, used] - _between(model, grid, ratio)
    lone = np.array([_lone(take, layout.groups, layout.strikes) for take in range(takes)])
    blows = np.unique(layout.ratio[space.free[layout.ratio] & ~lone])
    for _ in range(ROUNDS):
        before = ratio.copy()
        for blow in blows:
            mine = np.flatnonzero(layout.ratio == blow)
            block = (mine[:, None] * rows + np.arange(rows)).ravel()
            others = rest.copy()
            others[:, mine] = 0.0
            tried = data.level[mine][:, used] - model[:, :, None]  # [hammers, velocities, mine, rows]
            flat = tried.reshape(*tried.shape[:2], -1)
            push = others.reshape(len(rest), -1) @ form[:, block]
            cost = 0.5 * ((flat @ form[np.ix_(block, block)]) * flat).sum(axis=2) + (flat @ push[..., None])[..., 0]
            best = (cost + believed[mine[0]] + NEVER * ~ended).argmin(axis=1)
            ratio[:, mine] = grid[best][:, None]
            rest[:, mine] = tried[np.arange(len(rest)), best]
        if (ratio == before).all():
            break
    flat = rest.reshape(len(rest), -1)
    cost = 0.5 * ((flat @ form) * flat).sum(axis=1)
    _, first = np.unique(layout.ratio, return_index=True)  # one take of each blow
    away = (ratio - space.start[layout.ratio]) / np.where(space.free[layout.ratio], space.spread[layout.ratio], np.inf)
    held = _between(NEVER * ~ended[..., None], grid, ratio)[..., 0].sum(axis=1)
    return ratio, cost + 0.5 * (away[:, first] ** 2).sum(axis=1) + held


def _lone(take: int, groups: tuple[int, ...], strikes: tuple[int, ...]) -> bool:
    """Whether no take of the same group hears another blow."""
    return len({strike for group, strike in zip(groups, strikes, strict=True) if group == groups[take]}) == 1


def _between(values: np.ndarray, grid: np.ndarray, at: np.ndarray) -> np.ndarray:
    """`values` [hammers, velocities, ...] at the velocities `at` [hammers, takes], by straight lines over the grid."""
    place = np.clip((at - grid[0]) / (grid[1] - grid[0]), 0, len(grid) - 1)
    low = np.minimum(place.astype(int), len(grid) - 2)
    share, hammer = (place - low)[..., None], np.arange(len(values))[:, None]
    return (1 - share) * values[hammer, low] + share * values[hammer, low + 1]


def quadratic(weight: np.ndarray, gains: tuple[int, ...], groups: tuple[int, ...] | None) -> np.ndarray:
    """What least squares leave, as a form Q [takes · rows, takes · rows]: r Q r of misfits r, dB, is their least sum.

    Free are a gain for all takes of the same entry in `gains`, and a level of the path for each row of a group; no path
    where `groups` is None. `weight` [takes, rows], 1/dB², is 0 for what is not there.
    """
    takes, rows = weight.shape
    design = (np.array(gains)[:, None] == np.unique(gains))[:, None] & np.ones((1, rows, 1), bool)
    design = design.reshape(takes * rows, -1).astype(float)
    if groups is not None:
        member = np.array(groups)[:, None] == np.unique(groups)
        design = np.hstack([design, np.kron(member, np.eye(rows))])
    each = weight.reshape(-1, 1) * design
    return np.diag(weight.ravel()) - each @ np.linalg.pinv(design.T @ each, hermitian=True) @ each.T
