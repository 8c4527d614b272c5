"""Which of many sampled hammers suit the recordings, each at the velocities that suit it best."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.stats import norm, qmc

from .batched_model import levels, run_in_batches, thread_pool
from .optimiser import Optimiser
from .parametrisation import STRING_SIZE
from .quadratic_surrogate import QuadraticSurrogate

__all__ = ["sobol_samples", "prescreen", "rescan_velocities", "initial_hyperparameters"]

# Samples of the prior's hammers: a power of two, as Sobol's points want it.
SAMPLES = 1024
# Velocities at which each is struck, m/s: neighbours differ by 30 %, which a descent bridges.
VELOCITIES = np.geomspace(0.15, 8.0, 16)
# Those at which one hammer is struck anew, m/s: 1.6 % apart, closer than the lobes of a treble force's spectrum.
FINE_VELOCITIES = np.geomspace(0.15, 8.0, 256)
# Of the prior of each: the outermost hundredth is not sampled.
TAIL = 0.01
# σ, A, ℓ, η before anything is known: excess of levels, dB, and a path as the prior has it.
WIDE_EXCESS = 2.0
# Lanes of one call where there are thousands: enough to fill matrix products.
MANY_LANES = 64
# Velocities to begin with, from the brightest stroke down, m/s: a forte,
FASTEST = 4.0
# and the factor from stroke to stroke, of layers far apart and of layers close together.
FACTORS = (0.5, 0.75)
# Rounds of coordinate descent over strokes.
ROUNDS = 8
# Hammers of one core at a time: what they need fits its cache.
BLOCK = 64
# What a contact that does not end costs.
ENDLESS = 1e6


def sobol_samples(descent: Optimiser, seed: int) -> np.ndarray:
    """Sobol's points of the prior's hammers [samples, size]; velocities at their means."""
    u = descent.unknowns
    at = STRING_SIZE + np.flatnonzero(u.free[STRING_SIZE : u.shared])
    z = np.tile(u.mean, (SAMPLES, 1))
    z[:, :STRING_SIZE] = descent.string
    if len(at):
        points = qmc.Sobol(len(at), rng=np.random.default_rng(seed)).random(SAMPLES)
        z[:, at] += u.sd[at] * norm.ppf(TAIL + (1 - 2 * TAIL) * points)
    return u.project(z)


def initial_hyperparameters(descent: Optimiser) -> np.ndarray:
    """φ while nothing is known."""
    mean = np.asarray(descent.table.prior[0]).copy()
    mean[0] = np.log(WIDE_EXCESS)
    return mean


def prescreen(descent: Optimiser, seed: int, parabolas: Sequence[QuadraticSurrogate]) -> list[np.ndarray]:
    """The prior's hammers, each with the velocities that suit it best, by each parabola and the prior; the best first.

    One array [S, size] a parabola.
    """
    return _with_velocities(descent, sobol_samples(descent, seed), np.log(VELOCITIES), parabolas, descent.table.value)


def rescan_velocities(
    descent: Optimiser, z: np.ndarray, parabolas: Sequence[QuadraticSurrogate], offset: np.ndarray | float = 0.0
) -> list[np.ndarray]:
    """Hammers `z` [S, size], each with the velocities of a fine grid that suit it best; the best first.

    One array a parabola. In the treble a contact lasts for several periods of a partial, the spectrum of its force has
    lobes, and a velocity in the wrong one is a minimum for every hammer near. `offset` is the levels' step error, dB
    [R, K].
    """
    return _with_velocities(descent, z, np.log(FINE_VELOCITIES), parabolas, descent.table.value - offset)


def _with_velocities(
    descent: Optimiser,
    z: np.ndarray,
    grid: np.ndarray,
    parabolas: Sequence[QuadraticSurrogate],
    target_levels: np.ndarray,
) -> list[np.ndarray]:
    """Hammers [S, size] with the best of the log velocities `grid`, by each parabola; the best first.

    `wanted` are the levels that they are to have, dB [R, K].
    """
    u, shared = descent.unknowns, descent.unknowns.shared
    free = u.free[shared:]
    # Within the bounds, which are those of all; measured velocities have columns of their own.
    within = np.clip(grid, u.lower[shared:][free].max(), u.upper[shared:][free].min()) if free.any() else ()
    grid = np.append(np.unique(within), u.mean[shared:][~free])
    # Velocity by velocity: lanes of one call then have contacts of like lengths.
    lanes = np.concatenate(
        [np.tile(z[:, STRING_SIZE:shared], (len(grid), 1)), np.repeat(grid, len(z))[:, None]], axis=1
    )
    descent.lanes += len(lanes)
    level, ended = run_in_batches(levels, (descent.string, lanes), descent.scene, descent.cfg, MANY_LANES)
    level = level.reshape(len(grid), len(z), -1)[..., descent.columns].swapaxes(0, 1)
    own = np.abs(grid - z[:, shared:, None]).argmin(axis=2)
    begins = [own, *(np.tile(each, (len(z), 1)) for each in _velocity_starts(descent, grid))]
    ended = ended.reshape(len(grid), len(z)).T
    return [_rank_candidates(descent, parabola, z, grid, target_levels, level, ended, begins) for parabola in parabolas]


def _rank_candidates(
    descent: Optimiser,
    parabola: QuadraticSurrogate,
    z: np.ndarray,
    grid: np.ndarray,
    target_levels: np.ndarray,
    level: np.ndarray,
    ended: np.ndarray,
    begins: list[np.ndarray],
) -> np.ndarray:
    """The hammers with their best velocities, the best first [S, size].

    Parameters
    ----------
    z : hammers [S, size].
    grid : log velocities [V], at which `level` [S, V, K] are theirs, dB, and `ended` [S, V].
    begins : velocities to begin with, of the grid [S, strokes].
    """
    u = descent.unknowns
    free, mean = u.free[u.shared :], u.mean[u.shared :]
    belief = 0.5 * ((grid - mean[:, None]) / np.where(free, u.sd[u.shared :], 1.0)[:, None]) ** 2
    belief = np.where(free[:, None], belief, np.where(np.abs(grid - mean[:, None]) < 1e-9, 0.0, np.inf))

    def suited(some: slice) -> tuple[np.ndarray, np.ndarray]:
        costs = np.where(ended[some], 0.0, ENDLESS)[:, None] + belief
        return _best_velocities(descent, parabola, target_levels, level[some], costs, [begin[some] for begin in begins])

    parts = list(thread_pool().map(suited, [slice(i, i + BLOCK) for i in range(0, len(z), BLOCK)]))
    best, chosen = (np.concatenate(column) for column in zip(*parts, strict=True))
    best = best + descent.prior(z)[0]
    z = z.copy()
    z[:, u.shared :] = np.where(free, grid[chosen], mean)
    order = np.argsort(best, kind="stable")
    return z[order[np.isfinite(best[order])]]


def _best_velocities(
    descent: Optimiser, parabola: QuadraticSurrogate, target_levels: np.ndarray, level: np.ndarray, costs: np.ndarray,
    begins: list[np.ndarray],
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """The least parabola of hammers [S], and the velocities that give it [S, strokes], by coordinate descent.

    Parameters
    ----------
    wanted, level : dB [R, K], and at every velocity [S, V, K].
    costs : what each velocity of each stroke costs besides [S, strokes, V].
    begins : velocities to begin with [S, strokes].
    """
    table, strokes = descent.table, descent.unknowns.strokes
    R, K = table.value.shape
    Q = parabola.whole(R * K).reshape(R, K, R, K)
    of = [np.flatnonzero(descent.stroke == s) for s in range(strokes)]
    count, V = level.shape[:2]
    # Residuals of every stroke's recordings, had it that velocity [S, V, recordings K].
    T = [((target_levels[r] - level[:, :, None]) * table.detected[r]).reshape(count, V, -1) for r in of]
    # The parabola is a sum over strokes and over pairs of them: tables of it [S, V] and [S, V, V].
    own, pair = costs.copy(), {}
    for s, first in enumerate(of):
        for t, second in enumerate(of[: s + 1]):
            size = len(first) * K, len(second) * K
            push = (T[s].reshape(-1, size[0]) @ Q[np.ix_(first, np.arange(K), second)].reshape(size)).reshape(
                count, V, -1
            )
            if s == t:
                own[:, s] += 0.5 * (push * T[s]).sum(axis=2)
            else:
                pair[s, t] = push @ T[t].swapaxes(1, 2)
                pair[t, s] = pair[s, t].swapaxes(1, 2)
    S = np.arange(count)
    best, chosen = np.full(count, np.inf), np.zeros((count, strokes), int)
    for begin in begins:
        v = begin.copy()
        for _ in range(ROUNDS):
            before = v.copy()
            for s in range(strokes):
                others = sum(pair[t, s][S, v[:, t]] for t in range(strokes) if t != s)
                v[:, s] = (own[:, s] + others).argmin(axis=1)
            if (v == before).all():
                break
        cost = own[S[:, None], np.arange(strokes), v].sum(axis=1)
        cost += sum(pair[s, t][S, v[:, s], v[:, t]] for s in range(strokes) for t in range(s))
        better = cost < best
        best[better], chosen[better] = cost[better], v[better]
    return best, chosen


def _velocity_starts(descent: Optimiser, grid: np.ndarray) -> list[np.ndarray]:
    """Velocities to begin with: falling by a factor from the brightest stroke to the softest; indices [strokes]."""
    p, u = descent.problem, descent.unknowns
    free, mean, strokes = u.free[u.shared :], u.mean[u.shared :], u.strokes
    bright = np.zeros(strokes)
    for stroke, analysis in zip(descent.stroke, p.analyses, strict=True):
        amplitude = 10 ** (analysis.partials.level / 20)
        value = float((analysis.partials.number * amplitude).sum() / amplitude.sum())
        bright[stroke] = max(bright[stroke], value)
    rank = np.empty(strokes)
    rank[np.argsort(-bright)] = np.arange(strokes)
    target_levels = [np.where(free, np.log(FASTEST * factor**rank), mean) for factor in FACTORS]
    return [np.abs(grid - each[:, None]).argmin(axis=1) for each in target_levels]
