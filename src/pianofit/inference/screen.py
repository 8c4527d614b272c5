"""Which of many sampled hammers suit the recordings, each at the velocities that suit it best."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from .parabola import Parabola

if TYPE_CHECKING:
    from .search import Search

__all__ = ["screen"]

# Velocities to begin with, from the brightest stroke down, m/s: a forte,
FASTEST = 4.0
# and the factor from stroke to stroke, of layers far apart and of layers close together.
FACTORS = (0.5, 0.75)
# Rounds of coordinate descent over strokes.
ROUNDS = 8
# What a contact that does not end costs.
ENDLESS = 1e6


def screen(search: Search, z: np.ndarray, grid: np.ndarray, level: np.ndarray, ended: np.ndarray) -> np.ndarray:
    """The hammers with their best velocities, the best first [S, size].

    Parameters
    ----------
    z : hammers of the prior [S, size].
    grid : log velocities [V], at which `level` [S, V, K] are theirs, dB, and `ended` [S, V].
    """
    table, u = search.table, search.unknowns
    R, K = table.value.shape
    Q = Parabola.of(table, search.wide()).whole(R * K).reshape(R, K, R, K)
    free, strokes = u.free[u.shared :], u.strokes
    mean, sd = u.mean[u.shared :], np.where(free, u.sd[u.shared :], 1.0)
    belief = 0.5 * ((grid - mean[:, None]) / sd[:, None]) ** 2
    belief = np.where(free[:, None], belief, np.where(np.abs(grid - mean[:, None]) < 1e-9, 0.0, np.inf))
    of = [np.flatnonzero(search.stroke == s) for s in range(strokes)]
    # Residuals of every recording, had its stroke that velocity [S, V, R, K].
    T = (table.value - level[:, :, None]) * table.found
    own = np.empty((len(z), len(grid), strokes))
    for s, rs in enumerate(of):
        push = np.einsum("svqk,qkrl->svrl", T[:, :, rs], Q[rs][:, :, rs], optimize=True)
        own[:, :, s] = 0.5 * (push * T[:, :, rs]).sum(axis=(2, 3)) + belief[s] + np.where(ended, 0.0, ENDLESS)
    S = np.arange(len(z))
    best, chosen = np.full(len(z), np.inf), np.zeros((len(z), strokes), int)
    for begin in _ladders(search, grid, mean, free):
        v = np.tile(begin, (len(z), 1))
        for _ in range(ROUNDS):
            before = v.copy()
            for s, rs in enumerate(of):
                rest = T[S[:, None], v[:, search.stroke], np.arange(R)]  # [S, R, K]
                rest[:, rs] = 0.0
                push = np.einsum("sqk,qkrl->srl", rest, Q[:, :, rs], optimize=True)
                v[:, s] = (own[:, :, s] + np.einsum("svrk,srk->sv", T[:, :, rs], push, optimize=True)).argmin(axis=1)
            if (v == before).all():
                break
        rest = T[S[:, None], v[:, search.stroke], np.arange(R)]
        push = np.einsum("sqk,qkrl->srl", rest, Q, optimize=True)
        cost = 0.5 * (push * rest).sum(axis=(1, 2))
        cost += sum(belief[s][v[:, s]] + np.where(ended[S, v[:, s]], 0.0, ENDLESS) for s in range(strokes))
        better = cost < best
        best[better], chosen[better] = cost[better], v[better]
    best = best + search.known(z)[0]
    z = z.copy()
    z[:, u.shared :] = np.where(free, grid[chosen], u.mean[u.shared :])
    order = np.argsort(best, kind="stable")
    return z[order[np.isfinite(best[order])]]


def _ladders(search: Search, grid: np.ndarray, mean: np.ndarray, free: np.ndarray) -> list[np.ndarray]:
    """Velocities to begin with: falling by a factor from the brightest stroke to the softest; indices [strokes]."""
    strokes = len(mean)
    p = search.problem
    bright = np.zeros(strokes)
    for stroke, analysis in zip(search.stroke, p.analyses, strict=True):
        amplitude = 10 ** (analysis.partials.level / 20)
        value = float((analysis.partials.number * amplitude).sum() / amplitude.sum())
        bright[stroke] = max(bright[stroke], value)
    rank = np.empty(strokes)
    rank[np.argsort(-bright)] = np.arange(strokes)
    wanted = [np.where(free, np.log(FASTEST * factor**rank), mean) for factor in FACTORS]
    return [np.abs(grid - each[:, None]).argmin(axis=1) for each in wanted]
