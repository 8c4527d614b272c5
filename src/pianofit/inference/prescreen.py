"""Prescreening: rank many sampled hammers by F, each at its best velocities."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.stats import norm, qmc

from .batched_model import levels, run_in_batches, thread_pool
from .optimiser import Optimiser
from .parametrisation import STRING_SIZE
from .quadratic_surrogate import QuadraticSurrogate

__all__ = ["sobol_samples", "prescreen", "rescan_velocities", "initial_hyperparameters"]

# Samples of the prior's hammers: a power of two, as Sobol points require.
SAMPLES = 1024
# Velocities of each sample, m/s: neighbours differ by 30 %, which a minimisation bridges.
VELOCITIES = np.geomspace(0.15, 8.0, 16)
# Velocities of one hammer, m/s: 1.6 % apart, closer than the lobes of a treble force's spectrum.
FINE_VELOCITIES = np.geomspace(0.15, 8.0, 256)
# Probability at each end of a prior that is not sampled.
TAIL = 0.01
# Initial σ, the excess of levels, dB; A, ℓ and η start at their priors.
WIDE_EXCESS = 2.0
# Batch size of a call with thousands of strokes: enough for matrix products.
PRESCREEN_BATCH_SIZE = 64
# Initial velocities, from the brightest stroke down, m/s: a forte,
FASTEST = 4.0
# and the factor from stroke to stroke, for layers far apart and for layers close together.
FACTORS = (0.5, 0.75)
# Rounds of coordinate descent over strokes.
ROUNDS = 8
# Hammers per core at a time: their data fit its cache.
BLOCK = 64
# Cost of a contact that does not end.
ENDLESS = 1e6


def sobol_samples(optimiser: Optimiser, seed: int) -> np.ndarray:
    """Sobol samples of the prior's hammers [samples, size]; velocities at their means."""
    u = optimiser.unknowns
    free = STRING_SIZE + np.flatnonzero(u.free[STRING_SIZE : u.shared])
    theta = np.tile(u.mean, (SAMPLES, 1))
    theta[:, :STRING_SIZE] = optimiser.string
    if len(free):
        points = qmc.Sobol(len(free), rng=np.random.default_rng(seed)).random(SAMPLES)
        theta[:, free] += u.sd[free] * norm.ppf(TAIL + (1 - 2 * TAIL) * points)
    return u.project(theta)


def initial_hyperparameters(optimiser: Optimiser) -> np.ndarray:
    """φ before any residual is known."""
    mean = np.asarray(optimiser.table.prior[0]).copy()
    mean[0] = np.log(WIDE_EXCESS)
    return mean


def prescreen(optimiser: Optimiser, seed: int, surrogates: Sequence[QuadraticSurrogate]) -> list[np.ndarray]:
    """Sample the prior's hammers, each with its best velocities by each surrogate and the prior; the best first.

    Returns one array [S, size] per surrogate.
    """
    samples = sobol_samples(optimiser, seed)
    return _with_velocities(optimiser, samples, np.log(VELOCITIES), surrogates, optimiser.table.value)


def rescan_velocities(
    optimiser: Optimiser,
    theta: np.ndarray,
    surrogates: Sequence[QuadraticSurrogate],
    offset: np.ndarray | float = 0.0,
) -> list[np.ndarray]:
    """Rank hammers `theta` [S, size], each with its best velocities on a fine grid; the best first.

    Returns one array per surrogate. In the treble a contact lasts for several periods of a partial, and the spectrum of
    its force has lobes. A velocity in the wrong lobe is a minimum for every hammer near. `offset` is the discretisation
    error of the levels, dB [R, K].
    """
    targets = optimiser.table.value - offset
    return _with_velocities(optimiser, theta, np.log(FINE_VELOCITIES), surrogates, targets)


def _with_velocities(
    optimiser: Optimiser,
    theta: np.ndarray,
    grid: np.ndarray,
    surrogates: Sequence[QuadraticSurrogate],
    target_levels: np.ndarray,
) -> list[np.ndarray]:
    """Hammers [S, size] with the best of the log velocities `grid`, by each surrogate; the best first.

    `target_levels` are the measured levels, dB [R, K].
    """
    u, shared = optimiser.unknowns, optimiser.unknowns.shared
    free = u.free[shared:]
    # The bounds are the same for all velocities; measured velocities have columns of their own.
    within = np.clip(grid, u.lower[shared:][free].max(), u.upper[shared:][free].min()) if free.any() else ()
    grid = np.append(np.unique(within), u.mean[shared:][~free])
    # In the order of velocities, the strokes of one call have contacts of similar duration.
    batch = np.concatenate(
        [np.tile(theta[:, STRING_SIZE:shared], (len(grid), 1)), np.repeat(grid, len(theta))[:, None]], axis=1
    )
    optimiser.n_strokes_computed += len(batch)
    level, ended = run_in_batches(
        levels, (optimiser.string, batch), optimiser.model_inputs, optimiser.cfg, PRESCREEN_BATCH_SIZE
    )
    level = level.reshape(len(grid), len(theta), -1)[..., optimiser.columns].swapaxes(0, 1)
    own = np.abs(grid - theta[:, shared:, None]).argmin(axis=2)
    starts = [own, *(np.tile(start, (len(theta), 1)) for start in _velocity_starts(optimiser, grid))]
    ended = ended.reshape(len(grid), len(theta)).T
    return [
        _rank_candidates(optimiser, surrogate, theta, grid, target_levels, level, ended, starts)
        for surrogate in surrogates
    ]


def _rank_candidates(
    optimiser: Optimiser,
    surrogate: QuadraticSurrogate,
    theta: np.ndarray,
    grid: np.ndarray,
    target_levels: np.ndarray,
    level: np.ndarray,
    ended: np.ndarray,
    starts: list[np.ndarray],
) -> np.ndarray:
    """The hammers with their best velocities, the best first [S, size].

    Parameters
    ----------
    theta : hammers [S, size].
    grid : log velocities [V], with their `level` [S, V, K], dB, and `ended` [S, V].
    starts : initial velocities, indices of the grid [S, strokes].
    """
    u = optimiser.unknowns
    free, mean = u.free[u.shared :], u.mean[u.shared :]
    prior = 0.5 * ((grid - mean[:, None]) / np.where(free, u.sd[u.shared :], 1.0)[:, None]) ** 2
    prior = np.where(free[:, None], prior, np.where(np.abs(grid - mean[:, None]) < 1e-9, 0.0, np.inf))

    def best_of(block: slice) -> tuple[np.ndarray, np.ndarray]:
        costs = np.where(ended[block], 0.0, ENDLESS)[:, None] + prior
        block_starts = [start[block] for start in starts]
        return _best_velocities(optimiser, surrogate, target_levels, level[block], costs, block_starts)

    parts = list(thread_pool().map(best_of, [slice(i, i + BLOCK) for i in range(0, len(theta), BLOCK)]))
    best, chosen = (np.concatenate(column) for column in zip(*parts, strict=True))
    best = best + optimiser.prior(theta)[0]
    theta = theta.copy()
    theta[:, u.shared :] = np.where(free, grid[chosen], mean)
    order = np.argsort(best, kind="stable")
    return theta[order[np.isfinite(best[order])]]


def _best_velocities(
    optimiser: Optimiser, surrogate: QuadraticSurrogate, target_levels: np.ndarray, level: np.ndarray,
    costs: np.ndarray, starts: list[np.ndarray],
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """The lowest surrogate of each hammer [S], and its velocities [S, strokes], by coordinate descent.

    Parameters
    ----------
    target_levels, level : dB [R, K], and at every velocity [S, V, K].
    costs : additional cost of each velocity of each stroke [S, strokes, V].
    starts : initial velocities [S, strokes].
    """
    table, strokes = optimiser.table, optimiser.unknowns.strokes
    R, K = table.value.shape
    Q = surrogate.whole(R * K).reshape(R, K, R, K)
    recordings = [np.flatnonzero(optimiser.stroke == s) for s in range(strokes)]
    count, V = level.shape[:2]
    # Residuals of every stroke's recordings at that velocity [S, V, recordings K].
    T = [((target_levels[r] - level[:, :, None]) * table.detected[r]).reshape(count, V, -1) for r in recordings]
    # The surrogate is a sum over strokes and over pairs of strokes: tables of it [S, V] and [S, V, V].
    own, pair = costs.copy(), {}
    for s, first in enumerate(recordings):
        for t, second in enumerate(recordings[: s + 1]):
            size = len(first) * K, len(second) * K
            weighted = T[s].reshape(-1, size[0]) @ Q[np.ix_(first, np.arange(K), second)].reshape(size)
            weighted = weighted.reshape(count, V, -1)
            if s == t:
                own[:, s] += 0.5 * (weighted * T[s]).sum(axis=2)
            else:
                pair[s, t] = weighted @ T[t].swapaxes(1, 2)
                pair[t, s] = pair[s, t].swapaxes(1, 2)
    S = np.arange(count)
    best, chosen = np.full(count, np.inf), np.zeros((count, strokes), int)
    for start in starts:
        v = start.copy()
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


def _velocity_starts(optimiser: Optimiser, grid: np.ndarray) -> list[np.ndarray]:
    """Initial velocities: falling by a factor from the brightest stroke to the softest; indices [strokes]."""
    p, u = optimiser.problem, optimiser.unknowns
    free, mean, strokes = u.free[u.shared :], u.mean[u.shared :], u.strokes
    brightness = np.zeros(strokes)
    for stroke, analysis in zip(optimiser.stroke, p.analyses, strict=True):
        amplitude = 10 ** (analysis.partials.level / 20)
        value = float((analysis.partials.number * amplitude).sum() / amplitude.sum())
        brightness[stroke] = max(brightness[stroke], value)
    rank = np.empty(strokes)
    rank[np.argsort(-brightness)] = np.arange(strokes)
    log_velocities = [np.where(free, np.log(FASTEST * factor**rank), mean) for factor in FACTORS]
    return [np.abs(grid - start[:, None]).argmin(axis=1) for start in log_velocities]
