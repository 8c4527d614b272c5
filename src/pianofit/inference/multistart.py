"""Global search of F: sample the prior, rank the samples by F, and minimise from the best.

Every step lowers or compares one function (likelihood.py). Hammers of the prior are ranked by it with wide
hyperparameters, each at its best velocities (prescreen.py). The best are minimised (optimiser.py): first on a quadratic
surrogate that all share, then on F with a falling lower limit of the excess σ, which smooths the landscape. The search
restarts near the lowest.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence

import numpy as np

from ..errors import FitError
from .candidates import Candidates
from .optimiser import Optimiser
from .parametrisation import Parametrisation
from .prescreen import initial_hyperparameters, prescreen, rescan_velocities
from .quadratic_surrogate import QuadraticSurrogate

__all__ = ["NO_HAMMER", "deduplicate", "multistart"]

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
GAIN = 0.5
# Maximum number of rounds,
ROUNDS = 8
# restarts of each,
RESTARTS = 8
# their largest distance, in the prior's standard deviations, within the reach of a minimisation,
REACH = 0.3
# and in standard deviations of the quadratic approximation. F of a clean recording has ripples along a ridge that is
# narrow in all other directions. They are some deviations apart, and F can fall by tens between them.
ALONG = 10.0
# Shifts of log x0: minima of the strike position are less than a percent apart in the bass.
SCAN = (0.003, 0.006, 0.01, 0.015, 0.02, 0.03, 0.045, 0.065)
# Steps of a restart
TRIAL = 6
# before it must be within `NEAR` of the best to continue, and how many of a round do.
GOING = 2
NO_HAMMER = "no hammer within the bounds gives a finite sound; widen [bounds] or check [fixed] in the setup"
# Minima closer than this in every parameter, in the prior's standard deviations, are the same.
SAME = 0.02


def multistart(
    optimiser: Optimiser, seed: int, first: np.ndarray, progress: Callable[[str, float], None] = lambda *_: None
) -> Candidates:
    """Find the minima of F; the lowest is first.

    Parameters
    ----------
    first : a start in addition to the samples of the prior [size].

    Raises
    ------
    FitError
        If no hammer gives a finite sound.
    """
    phi = initial_hyperparameters(optimiser)
    # Before a hammer is known, it is open whether recordings share a gain: each answer has its own hammers.
    nodes = range(len(optimiser.table.scale))
    surrogates = [QuadraticSurrogate.of(optimiser.table, phi, gains=node) for node in nodes]

    def minimised(starts: Sequence[np.ndarray]) -> Candidates:
        """Minimise the candidates [S, size] of every surrogate on that surrogate, and join them."""
        ends = [
            optimiser.minimise(
                optimiser.initialise(theta, [phi], surrogate=surrogate), 0.0, FIRST_STEPS, surrogate=surrogate
            )
            for theta, surrogate in zip(starts, surrogates, strict=True)
        ]
        return functools.reduce(Candidates.join, ends)

    samples = prescreen(optimiser, seed, surrogates)
    candidates = minimised([np.concatenate([first[None], theta[:FIRST]]) for theta in samples])
    if not len(candidates):
        raise FitError(NO_HAMMER)
    progress("hammer", 0.3)
    rescanned = rescan_velocities(optimiser, _survivors(optimiser, candidates).theta, surrogates)
    candidates = candidates.join(minimised(rescanned))
    progress("hammer", 0.4)
    candidates = optimiser.minimise(
        _with_discretisation_error(optimiser, _survivors(optimiser, candidates)), SECOND_FLOOR, SECOND_STEPS
    )
    progress("hammer", 0.5)
    candidates = optimiser.minimise(
        _with_discretisation_error(optimiser, _survivors(optimiser, candidates, NEAR)), 0.0, LAST_STEPS
    )
    progress("restarts", 0.6)
    random = np.random.default_rng(seed)
    for _ in range(ROUNDS):
        before = _lowest(optimiser, candidates)
        candidates = _restarted(optimiser, candidates, lambda best, _: _perturb(optimiser, best, random))
        for node in nodes:
            candidates = _restarted(
                optimiser, candidates,
                lambda best, by: rescan_velocities(optimiser, best.theta, [by], best.offset[0])[0], node,
            )  # fmt: skip
        if optimiser.unknowns.free[optimiser.unknowns.index_of("x0")]:
            candidates = _restarted(
                optimiser, candidates, lambda best, _: _shift_strike_position(optimiser, best.theta[0])
            )
        if _lowest(optimiser, candidates) > before - GAIN:
            break
    return candidates


def _survivors(optimiser: Optimiser, candidates: Candidates, within: float = np.inf) -> Candidates:
    """The lowest candidates after merging."""
    distinct = deduplicate(candidates, optimiser.unknowns, optimiser.total(candidates), within, MERGE_DISTANCE)
    return candidates.take(np.array(distinct[:SECOND], int))


def _with_discretisation_error(optimiser: Optimiser, candidates: Candidates) -> Candidates:
    """Correct the levels of all candidates by the discretisation error of the lowest candidate."""
    error = optimiser.discretisation_error_db(candidates.theta[:1])
    return optimiser.initialise(candidates.theta, candidates.phi, candidates.w, error)


def _lowest(optimiser: Optimiser, candidates: Candidates) -> float:
    """F of the first candidate."""
    return float(optimiser.total(candidates)[0])


def _perturb(optimiser: Optimiser, best: Candidates, random: np.random.Generator) -> np.ndarray:
    """Random points about the best in all parameters, widest along its ridge [restarts, size]."""
    u, free = optimiser.unknowns, optimiser.is_free
    precision = (
        optimiser.prior(best.theta)[2] / REACH**2 + sum(part.derivatives.curvature[0] for part in best.parts) / ALONG**2
    )
    value, vector = np.linalg.eigh(precision[np.ix_(free, free)])
    theta = np.tile(best.theta, (RESTARTS, 1))
    theta[:, free] += random.normal(size=(RESTARTS, free.sum())) / np.sqrt(value) @ vector.T
    return u.project(theta)


def _shift_strike_position(optimiser: Optimiser, best: np.ndarray) -> np.ndarray:
    """The best [size] with shifted strike positions [2 · len(SCAN), size]."""
    theta = np.tile(best, (2 * len(SCAN), 1))
    theta[:, optimiser.unknowns.index_of("x0")] += np.outer([1, -1], SCAN).ravel()
    return optimiser.unknowns.project(theta)


def _restarted(
    optimiser: Optimiser, candidates: Candidates, points: Callable[[Candidates, QuadraticSurrogate], np.ndarray],
    gains: int | None = None,
) -> Candidates:  # fmt: skip
    """Add the minima reached from `points` of the lowest, first on the surrogate at its φ and w.

    Parameters
    ----------
    gains : the node of the gains of the surrogate; all nodes by default.
    """
    best = candidates.take(np.array([0]))
    state = best.level
    surrogate = QuadraticSurrogate.of(optimiser.table, state.phi[0], state.w[0], state.residual[0], gains)
    trials = optimiser.initialise(points(best, surrogate), best.phi, best.w, best.offset, surrogate)
    if not len(trials):
        return candidates
    trials = optimiser.minimise(trials, 0.0, TRIAL, surrogate=surrogate)
    lowest = optimiser.prior(best.theta)[0] + surrogate(state.residual, state.jacobian).nll
    near = np.flatnonzero(optimiser.total(trials) < lowest + NEAR)[:GOING]
    if len(near):
        candidates = candidates.join(optimiser.minimise(trials.take(near), 0.0, LAST_STEPS))
    return candidates.take(np.argsort(optimiser.total(candidates), kind="stable"))


def deduplicate(
    candidates: Candidates, unknowns: Parametrisation, scores: np.ndarray, within: float, apart: float = SAME
) -> list[int]:
    """Indices of candidates at least `apart` from all lower ones and within `within` of the lowest; lowest first."""
    chosen: list[int] = []
    free, theta, sd = unknowns.free, candidates.theta, unknowns.sd.clip(1e-12)
    for i in np.argsort(scores, kind="stable"):
        if scores[i] > scores.min() + within:
            break
        distances = [np.abs((theta[i] - theta[j]) / sd)[free].max() for j in chosen]
        if not distances or min(distances) >= apart:
            chosen.append(int(i))
    return chosen
