"""Where the search for the hammer of several takes through a path begins: the likeliest of many, by their levels.

A felt and a mass make a family of spectra, one for every velocity. Laid on what was recorded, with a gain of its own
for each take and a level of its own for each partial of a group, they leave only the takes' velocities open, and these
are chosen from a grid, blow after blow. So a hammer is judged without a derivative, and without a guess of how hard
each blow was: with unknown gains loudness tells nothing of that.
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from .levenberg import in_groups
from .residuals import level_batch
from .state import State, pool

__all__ = ["GRID", "TOGETHER", "screened"]

# Velocities over the first take's, log: from 0.06 to 1.54 times it, it among them.
GRID = 0.216 * np.arange(-13, 3)
# Hammers that one call looks at.
TOGETHER = 8
# Levels scatter about a hammer that is not quite the right one by this much, dB.
SCATTER = 2.0
# What a blow costs whose contact does not end.
ENDLESS = 1e6
# Rounds in which every blow chooses anew, and in which gains and path come to agree.
ROUNDS, AGREE = 6, 3


def screened(state: State, z: np.ndarray) -> np.ndarray:
    """The points `z` [hammers, size], each with the velocities that suit it best, the likeliest hammer first."""
    at = state.target(state.first_spread(10.0, 1.0), state.unweighted)

    def levels(some: np.ndarray) -> tuple:
        return level_batch(jnp.asarray(some), jnp.asarray(GRID), at, state.cfg)

    (model,) = in_groups(levels, TOGETHER, pool().map)(z)
    suited, cost = _suited(state, model)
    z = z.copy()
    z[:, state.data.layout.ratio] = suited
    return z[np.argsort(cost, kind="stable")]


def _suited(state: State, model: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Log velocity ratios [hammers, takes], from the grid where they are open, and each hammer's cost [hammers].

    `model` are levels [hammers, velocities, rows], dB.
    """
    data, layout = state.data, state.data.layout
    used = data.found.any(axis=0)
    weight, model = (data.found / np.hypot(data.level_error, SCATTER) ** 2)[:, used], model[:, :, used]
    endless = ENDLESS * ~np.isfinite(model).all(axis=2)
    model = np.where(np.isfinite(model), model, 0.0)
    levels = _Levels(data.level[:, used], weight, np.array(layout.groups))
    start, open_ = state.space.start[layout.ratio], state.space.free[layout.ratio]
    away = (GRID - start[:, None]) / state.space.spread[layout.ratio, None]
    belief = np.where(open_[:, None], 0.5 * away**2, 0.0) + endless[:, None]  # [hammers, takes, velocities]
    chosen = np.tile(np.abs(GRID - start[:, None]).argmin(axis=1), (len(model), 1))
    for _ in range(ROUNDS):
        before = chosen.copy()
        for blow in np.unique(layout.ratio[open_]):
            mine = np.flatnonzero(layout.ratio == blow)
            cost = belief[:, mine[0]] + sum(levels.suits(take, mine, model, chosen) for take in mine)
            chosen[:, mine] = cost.argmin(axis=1)[:, None]
        if (chosen == before).all():
            break
    _, first = np.unique(layout.ratio, return_index=True)  # one take of each blow
    believed = np.take_along_axis(belief[:, first], chosen[:, first, None], axis=2).sum(axis=(1, 2))
    return np.where(open_, GRID[chosen], start), levels.cost(model, chosen) + believed


class _Levels:
    """Levels [takes, rows] with weights, and what a model [hammers, velocities, rows] leaves of them.

    `chosen` [hammers, takes] says at which of its velocities. Every take has a gain, every partial of a group a level
    of the path's own: weighted means, by turns.
    """

    def __init__(self, level: np.ndarray, weight: np.ndarray, group: np.ndarray) -> None:
        self.level, self.weight, self.group = level, weight, group
        self.alike = (group == group[:, None]).astype(float)

    def cost(self, model: np.ndarray, chosen: np.ndarray) -> np.ndarray:
        """Half the weighted sum of squares [hammers]."""
        rest = self._ungained(model, chosen)
        path = np.einsum("ts,sk,hsk->htk", self.alike, self.weight, rest) / np.maximum(self.alike @ self.weight, 1e-300)
        return 0.5 * (self.weight * (rest - path) ** 2).sum(axis=(1, 2))

    def suits(self, take: int, blow: np.ndarray, model: np.ndarray, chosen: np.ndarray) -> np.ndarray:
        """The same of one take at every velocity [hammers, velocities], by what the other blows say of the path."""
        others = self.alike[take] * ~np.isin(np.arange(len(self.group)), blow)
        known = others @ self.weight
        path = np.einsum("s,sk,hsk->hk", others, self.weight, self._ungained(model, chosen)) / np.maximum(known, 1e-300)
        weight = self.weight[take] * known / np.maximum(self.weight[take] + known, 1e-300)
        miss = self.level[take] - path[:, None] - model
        gain = (miss @ weight) / max(float(weight.sum()), 1e-300)
        return 0.5 * ((miss - gain[..., None]) ** 2 @ weight)

    def _ungained(self, model: np.ndarray, chosen: np.ndarray) -> np.ndarray:
        """What the chosen levels and the gains leave [hammers, takes, rows]: the path and the misfit."""
        rest = self.level - np.take_along_axis(model, chosen[..., None], axis=1)
        whole, gain = np.maximum(self.alike @ self.weight, 1e-300), np.zeros((*chosen.shape, 1))
        for _ in range(AGREE):
            path = np.einsum("ts,sk,hsk->htk", self.alike, self.weight, rest - gain) / whole
            gain = ((rest - path) * self.weight).sum(axis=2, keepdims=True) / np.maximum(
                self.weight.sum(axis=1)[:, None], 1e-300
            )
        return rest - gain
