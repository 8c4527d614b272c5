"""Global search of F: sample the prior, rank the samples by F, and minimise from the best.

Every step lowers or compares one function (likelihood.py). Hammers of the prior are ranked by it with wide
hyperparameters, each at its best velocities. The best are minimised (optimiser.py): first on a quadratic surrogate that
all share, then on F with a falling lower limit of the excess σ, which smooths the landscape. The search restarts near
the lowest.
"""

import functools
from collections.abc import Callable, Sequence

import numpy as np
from scipy.special import ndtri

from ..errors import FitError
from ..progress import Progress
from ..sobol import sobol_points
from .batched_model import thread_pool
from .likelihood import ObservationTable
from .objective import Candidates, Objective, QuadraticSurrogate
from .optimiser import minimise
from .parametrisation import STRING_SIZE, Parametrisation
from .problem import FitProblem, brightness

# Samples of the prior's hammers: a power of two, as Sobol points require.
SAMPLES = 1024
# Probability at each end of a prior that is not sampled.
TAIL = 0.01
# Initial σ, the excess of levels, dB; A, ℓ and η start at their priors.
WIDE_EXCESS = 2.0
# Number of candidates of every answer about gains that continue at wide φ, and their steps;
FIRST, FIRST_STEPS = 96, 4
# then how many continue, for how many steps, with σ above this, dB;
SECOND, SECOND_STEPS, SECOND_FLOOR = 24, 6, 1.0
# and to the end, in so many steps, all within this of the lowest F. These are few for a note with many partials, and
# many in the treble, where hammers are distinguished least and cost least.
NEAR, LAST_STEPS = 10.0, 25
# Candidates closer than this, in the prior's standard deviations, are merged.
MERGE_DISTANCE = 0.2
# Rounds of restarts about the best continue until one lowers F by less than this. A likelihood ratio of 1.6 does not
# distinguish hammers.
LEAST_DECREASE = 0.5
# Maximum number of rounds,
ROUNDS = 8
# restarts of each,
RESTARTS = 8
# their largest distance, in the prior's standard deviations, within the reach of a minimisation,
REACH = 0.3
# and in standard deviations of the quadratic approximation. F of a clean recording has ripples along a ridge that is
# narrow in all other directions. They are some deviations apart, and F can fall by tens between them.
ALONG = 10.0
# Shifts of the logarithm of a position: minima of the strike position are less than a percent apart in the bass.
SCAN = (0.003, 0.006, 0.01, 0.015, 0.02, 0.03, 0.045, 0.065)
# Steps of a restart
TRIAL = 6
# before it must be within `NEAR` of the best to continue, and how many of a round do.
GOING = 2
# θ [points, size] from the best candidate and the surrogate there.
RestartPoints = Callable[[Candidates, QuadraticSurrogate], np.ndarray]
NO_HAMMER = "no hammer within the bounds gives a finite sound; widen [bounds] or check [fixed] in the setup"


def multistart(objective: Objective, seed: int, first: np.ndarray, progress: Progress) -> Candidates:
    """Find the minima of F of the levels; the lowest is first.

    Parameters
    ----------
    first : starts in addition to the samples of the prior [starts, size].
    """
    table = objective.problem.observed.level
    phi = initial_hyperparameters(table)
    # Before a hammer is known, it is open whether recordings share a gain: each answer has its own hammers.
    surrogates = QuadraticSurrogate.of_gains(table, phi)
    fixed = [objective.with_surrogate(surrogate) for surrogate in surrogates]
    values, geometry = objective.problem.initial_values.law.stroke, objective.problem.initial_values.geometry
    coarse, fine = values.coarse(geometry), values.fine(geometry)

    def minimised(starts: Sequence[np.ndarray]) -> Candidates:
        """Minimise the candidates [S, size] of every surrogate on that surrogate, and join them."""
        ends = [minimise(f, f.start(x, [phi]), FIRST_STEPS) for f, x in zip(fixed, starts, strict=True)]
        return functools.reduce(Candidates.join, ends)

    samples = rank_hammers(objective, sobol_samples(objective, seed), coarse, surrogates)
    candidates = minimised([np.concatenate([first, theta[:FIRST]]) for theta in samples])
    if not len(candidates):
        raise FitError(NO_HAMMER)
    progress("hammer", 0.3)
    survivors = _survivors(objective, candidates).theta
    candidates = candidates.join(minimised(rank_hammers(objective, survivors, fine, surrogates)))
    progress("hammer", 0.4)
    candidates = _continued(objective, _survivors(objective, candidates), SECOND_STEPS, SECOND_FLOOR)
    progress("hammer", 0.5)
    candidates = _continued(objective, _survivors(objective, candidates, NEAR), LAST_STEPS)
    progress("restarts", 0.6)
    kinds = _kinds_of_restart(objective, np.random.default_rng(seed), fine)
    for _ in range(ROUNDS):
        before = objective.total(candidates)[0]
        for points, gains in kinds:
            candidates = _restarted(objective, candidates, points, gains)
        if objective.total(candidates)[0] > before - LEAST_DECREASE:
            break
    return candidates


def from_starts(objective: Objective, starts: np.ndarray, steps: int) -> Candidates:
    """Minimise F of the levels from given starts [starts, size] only; the lowest is first.

    Every hammer also starts at its best velocities on the quadratic surrogates, because they depend on all other values
    of the hammer.
    """
    table = objective.problem.observed.level
    phi = initial_hyperparameters(table)
    surrogates = QuadraticSurrogate.of_gains(table, phi)
    values = objective.problem.initial_values
    ranked = rank_hammers(objective, starts, values.law.stroke.fine(values.geometry), surrogates)
    theta = np.concatenate([starts, *ranked])
    error = objective.level_model.discretisation_error_db(theta)
    candidates = minimise(objective, objective.start(theta, [phi], None, error), steps)
    if not len(candidates):
        raise FitError(NO_HAMMER)
    return candidates


def _survivors(objective: Objective, candidates: Candidates, within: float = np.inf) -> Candidates:
    """The lowest candidates after merging; with a limit `within`, those of the largest posterior mass."""
    scores = objective.total(candidates) if np.isinf(within) else objective.negative_log_mass(candidates)
    u = objective.problem.parametrisation
    distinct = deduplicate(candidates, u.free, scores, within, MERGE_DISTANCE * u.sd)
    return candidates.take(np.array(distinct[:SECOND], int))


def _continued(objective: Objective, candidates: Candidates, steps: int, sigma_floor: float = 0.0) -> Candidates:
    """Minimise F, with the levels of all candidates corrected by the discretisation error of the lowest candidate."""
    error = objective.level_model.discretisation_error_db(candidates.theta[:1])
    starts = objective.start(candidates.theta, candidates.phi, candidates.w, error)
    return minimise(objective, starts, steps, sigma_floor=sigma_floor)


def _kinds_of_restart(
    objective: Objective, random: np.random.Generator, fine: np.ndarray
) -> list[tuple[RestartPoints, int | None]]:
    """Points about the best candidate, and the node of the gains of the surrogate on which they start; None for all."""
    u = objective.problem.parametrisation
    # Values and sizes that were given with a standard deviation have no other minima.
    free = objective.free & ~u.given & (np.arange(u.size) < u.velocities.stop)
    nodes = range(len(objective.problem.observed.level.scale))

    def perturbed(best: Candidates, _: QuadraticSurrogate) -> np.ndarray:
        """Random points in all parameters, widest along the ridge."""
        curvature = sum(part.derivatives.curvature[0] for part in best.parts)
        precision = objective.prior(best.theta)[2][0] / REACH**2 + curvature / ALONG**2
        value, vector = np.linalg.eigh(precision[np.ix_(free, free)])
        theta = np.tile(best.theta, (RESTARTS, 1))
        theta[:, free] += random.normal(size=(RESTARTS, free.sum())) / np.sqrt(value) @ vector.T
        return u.project(theta)

    def rescanned(best: Candidates, surrogate: QuadraticSurrogate) -> np.ndarray:
        return rank_hammers(objective, best.theta, fine, [surrogate], best.offset[0])[0]

    def shifted(best: Candidates, _: QuadraticSurrogate) -> np.ndarray:
        """Other positions, one at a time; one stroke and a pickup can also exchange their positions."""
        theta = np.tile(best.theta, (2 * len(SCAN) * len(positions), 1))
        for n, at in enumerate(positions):
            theta[n * 2 * len(SCAN) : (n + 1) * 2 * len(SCAN), at] += np.outer([1, -1], SCAN).ravel()
        if len(positions) > 1 and u.strokes == 1:
            theta = np.concatenate([theta, best.theta])
            theta[-1, positions] = theta[-1, positions[::-1]]
        return u.project(theta)

    # A partial has equal levels on both sides of its node, so minima of a position lie in pairs.
    positions = [at for at in _positions(u) if free[at]]
    return [(perturbed, None), *((rescanned, node) for node in nodes), *[(shifted, None)] * bool(positions)]


def _positions(u: Parametrisation) -> list[int]:
    """Indices in θ of the positions on the string: of the contact, of the pickup, and of every stroke."""
    shared = [u.index_of(name) for name in ("x0", "pickup") if name in u.names]
    return shared + [at for at in range(u.size)[u.velocities] if u.law.stroke.name == "x0"]


def _restarted(objective: Objective, candidates: Candidates, points: RestartPoints, gains: int | None) -> Candidates:
    """Add the minima reached from `points` of the lowest, first on the surrogate at its φ and w."""
    best = candidates.take(np.array([0]))
    at = best.level.phi[0], best.level.w[0], best.level.residual[0], best.theta[0]
    surrogate = QuadraticSurrogate.at_residual(objective.problem.observed.level, *at, gains)
    fixed = objective.with_surrogate(surrogate)
    trials = fixed.start(points(best, surrogate), best.phi, best.w, best.offset)
    if not len(trials):
        return candidates
    trials = minimise(fixed, trials, TRIAL)
    near = np.flatnonzero(fixed.total(trials) < fixed.total(fixed.enter(best, 0.0)) + NEAR)[:GOING]
    if len(near):
        candidates = candidates.join(minimise(objective, trials.take(near), LAST_STEPS))
    return candidates.take(np.argsort(objective.total(candidates), kind="stable"))


def deduplicate(
    candidates: Candidates, free: np.ndarray, scores: np.ndarray, within: float, width: np.ndarray
) -> list[int]:
    """Indices of candidates that differ from all lower ones and lie within `within` of the lowest; lowest first.

    Parameters
    ----------
    free : mask of the parameters that are compared [size].
    width : the largest difference of two that are the same, of each parameter, [size] or by the lower one [B, size].
    """
    chosen: list[int] = []
    theta, width = candidates.theta, np.broadcast_to(width, candidates.theta.shape).clip(1e-12)
    for i in np.argsort(scores, kind="stable").tolist():
        if scores[i] > scores.min() + within:
            break
        if all((np.abs(theta[i] - theta[j]) / width[j])[free].max() >= 1.0 for j in chosen):
            chosen.append(i)
    return chosen


# --- prescreening: many hammers, each at its best velocities ----------------------------------------------------------


def sobol_samples(objective: Objective, seed: int) -> np.ndarray:
    """Sobol samples of the prior's hammers [samples, size]; velocities at their means."""
    u = objective.problem.parametrisation
    free = STRING_SIZE + np.flatnonzero(u.free[STRING_SIZE : u.shared])
    theta = np.tile(u.mean, (SAMPLES, 1))
    theta[:, :STRING_SIZE] = objective.level_model.string
    if len(free):
        points = sobol_points(len(free), SAMPLES, seed)
        theta[:, free] += u.sd[free] * ndtri(TAIL + (1 - 2 * TAIL) * points)
    return u.project(theta)


def initial_hyperparameters(table: ObservationTable) -> np.ndarray:
    """φ before any residual is known."""
    mean = np.asarray(table.prior[0]).copy()
    mean[0] = np.log(WIDE_EXCESS)
    return mean


def rank_hammers(
    objective: Objective,
    theta: np.ndarray,
    velocities: np.ndarray,
    surrogates: Sequence[QuadraticSurrogate],
    offset: np.ndarray | float = 0.0,
) -> list[np.ndarray]:
    """Rank hammers `theta` [S, size], each at its best velocities by a surrogate and the prior; the best first.

    Returns one array per surrogate. In the treble a contact lasts for several periods of a partial, and the spectrum of
    its force has lobes. A velocity in the wrong lobe is a minimum for every hammer near.

    Parameters
    ----------
    velocities : m/s, tried for every stroke.
    offset : discretisation error of the levels, dB [R, K].
    """
    u, table = objective.problem.parametrisation, objective.problem.observed.level
    lower, upper, mean, sd, free = (x[u.velocities] for x in (u.lower, u.upper, u.mean, u.sd, u.free))
    measured = ~free | u.given[u.velocities]
    # The bounds are the same for all velocities; measured velocities have columns of their own.
    within = np.clip(np.log(velocities), lower[free].max(), upper[free].min()) if free.any() else ()
    grid = np.append(np.unique(within), mean[measured])
    prior = 0.5 * ((grid - mean[:, None]) / np.where(free, sd, 1.0)[:, None]) ** 2
    prior = np.where(free[:, None], prior, np.where(np.abs(grid - mean[:, None]) < 1e-9, 0.0, np.inf))
    # In the order of velocities, the strokes of one call have contacts of similar duration.
    hammers = np.tile(u.model_entries(theta)[:, STRING_SIZE : u.shared], (len(grid), 1))
    level, ended = objective.level_model.levels(np.column_stack([hammers, np.repeat(grid, len(theta))]))
    level = level.reshape(len(grid), len(theta), -1).swapaxes(0, 1) + objective.level_model.size_effect(theta)
    costs = np.where(ended.reshape(len(grid), len(theta)).T, 0.0, 1e6)[:, None] + prior
    own = np.abs(grid - theta[:, u.velocities, None]).argmin(axis=2)
    starts = [own, *(np.tile(start, (len(theta), 1)) for start in _velocity_starts(objective.problem, grid))]
    target = table.value - offset

    def ranked(surrogate: QuadraticSurrogate) -> np.ndarray:
        def best_of(block: slice) -> tuple[np.ndarray, np.ndarray]:
            residual = (target - level[block][:, :, None]) * table.detected
            own = [start[block] for start in starts]
            return _best_velocities(surrogate, residual, objective.level_model.stroke, costs[block], own)

        # The data of 64 hammers fit the cache of a core.
        blocks = [slice(i, i + 64) for i in range(0, len(theta), 64)]
        best, chosen = (np.concatenate(x) for x in zip(*thread_pool().map(best_of, blocks), strict=True))
        best = best + objective.prior(theta)[0]
        moved = theta.copy()
        moved[:, u.velocities] = np.where(free, grid[chosen], mean)
        order = np.argsort(best, kind="stable")
        return moved[order[np.isfinite(best[order])]]

    return [ranked(surrogate) for surrogate in surrogates]


def _best_velocities(
    surrogate: QuadraticSurrogate, residual: np.ndarray, stroke: np.ndarray, costs: np.ndarray, starts: list[np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """The lowest surrogate of each hammer [S], and its velocities [S, strokes], by coordinate descent.

    Parameters
    ----------
    residual : of every recording at every velocity, dB [S, V, R, K].
    stroke : stroke of every recording [R].
    costs : additional cost of each velocity of each stroke [S, strokes, V].
    starts : initial velocities [S, strokes].
    """
    count, V, _, K = residual.shape
    strokes, S = range(costs.shape[1]), np.arange(count)
    recordings = [np.flatnonzero(stroke == s) for s in strokes]
    T = [residual[:, :, r].reshape(count, V, -1) for r in recordings]
    dense, partials = surrogate.dense(), np.arange(K)
    Q = [[dense[np.ix_(r, partials, t)].reshape(len(r) * K, -1) for t in recordings] for r in recordings]
    own = costs.copy()  # the part of each stroke alone, at every velocity
    for s in strokes:
        flat = T[s].reshape(count * V, -1)
        own[:, s] += 0.5 * ((flat @ Q[s][s]) * flat).sum(axis=1).reshape(count, V)
    v = np.stack(starts, axis=1)  # of all starts at once [S, starts, strokes]
    at = [T[s][S[:, None], v[..., s]] for s in strokes]

    def of_others(s: int) -> np.ndarray:
        """Derivative of the surrogate by the residuals of a stroke through those of all others [S, starts, entries]."""
        return sum((at[t] @ Q[t][s] for t in strokes if t != s), np.zeros_like(at[s]))

    for _ in range(8):  # at most: it ends when no velocity changes
        before = v.copy()
        for s in strokes:
            v[..., s] = (own[:, s, None] + of_others(s) @ T[s].swapaxes(1, 2)).argmin(axis=2)
            at[s] = T[s][S[:, None], v[..., s]]
        if (v == before).all():
            break
    cost = own[S[:, None, None], np.arange(len(strokes)), v].sum(axis=2)
    cost += 0.5 * sum((at[s] * of_others(s)).sum(axis=2) for s in strokes)
    best = cost.argmin(axis=1)
    return cost[S, best], v[S, best]


def _velocity_starts(problem: FitProblem, grid: np.ndarray) -> list[np.ndarray]:
    """Initial velocities: falling by a factor from the brightest stroke to the softest; indices [strokes]."""
    u = problem.parametrisation
    mean, by_stroke = u.mean[u.velocities], np.zeros(u.strokes)
    measured = (~u.free | u.given)[u.velocities]
    for stroke, analysis in zip(problem.structure.stroke, problem.analyses, strict=True):
        by_stroke[stroke] = max(by_stroke[stroke], brightness(analysis))
    rank = np.empty(u.strokes)
    rank[np.argsort(-by_stroke)] = np.arange(u.strokes)
    start = problem.initial_values
    given = start.law.stroke.starts(start.geometry, rank)
    log_velocities = [np.where(measured, mean, np.log(values)) for values in given]
    return [np.abs(grid - start[:, None]).argmin(axis=1) for start in log_velocities]
