"""One search: the prior is sampled, the samples are scored by F, and the best go down it.

Everything here lowers, or compares, one function (likelihood.py): the hammers of the prior are scored by it at wide
hyperparameters, each with the velocities that suit it (screen.py); the best go down it (descent.py), at first on its
parabola there, which all share, then with the excess σ held above a falling floor, which smooths the landscape; and the
lowest are started again from nearby.
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

# How many of every answer about gains go on at wide φ, for how many steps;
FIRST, FIRST_STEPS = 96, 4
# then how many, for how many steps, with σ held above this, dB;
SECOND, SECOND_STEPS, SECOND_FLOOR = 24, 6, 1.0
# and to the end, in so many steps, all that are this near to the lowest, F: few of a note with many partials, many in
# the treble, where hammers are told apart least and cost least.
NEAR, LAST_STEPS = 10.0, 25
# Candidates that come closer than this on their way down, in the prior's standard deviations, go on as one.
ONE_VALLEY = 0.2
# Rounds of restarts about the best go on until one gains less than this, F: a likelihood of 1.6 is no better hammer,
GAIN = 0.5
# or there have been this many;
ROUNDS = 8
# how many in each,
RESTARTS = 8
# and how far: no farther than these standard deviations of the prior, within what a descent finds,
REACH = 0.3
# nor than these of the parabola there. The landscape of a clean recording has ripples along a valley that is narrow in
# all other directions, some deviations apart, where F would fall by tens.
ALONG = 10.0
# Of log x0: valleys of the strike position are less than a percent apart in the bass.
SCAN = (0.003, 0.006, 0.01, 0.015, 0.02, 0.03, 0.045, 0.065)
# Steps that a restart has
TRIAL = 6
# to come as near to the best as `NEAR` to go on, and how many of a round do.
GOING = 2
NO_HAMMER = "no hammer within the bounds gives a finite sound; widen [bounds] or check [fixed] in the setup"
# Minima closer than this in every unknown, in the prior's standard deviations, are one.
SAME = 0.02


def multistart(
    descent: Optimiser, seed: int, first: np.ndarray, progress: Callable[[str, float], None] = lambda *_: None
) -> Candidates:
    """All minima found, the lowest first.

    Parameters
    ----------
    first : a point from which to start besides the prior's [size].

    Raises
    ------
    FitError
        If no hammer gives a finite sound.
    """
    phi = initial_hyperparameters(descent)
    # Whether recordings share a gain, nobody knows before a hammer is: each answer has its own hammers.
    parabolas = [QuadraticSurrogate.of(descent.table, phi, gains=node) for node in range(len(descent.table.scale))]

    def lowered(each: Sequence[np.ndarray]) -> Candidates:
        """All of the candidates [S, size] of every parabola, each down its own."""
        ends = [
            descent.minimise(descent.initialise(z, [phi], parabola=parabola), 0.0, FIRST_STEPS, parabola=parabola)
            for z, parabola in zip(each, parabolas, strict=True)
        ]
        return functools.reduce(Candidates.join, ends)

    each = prescreen(descent, seed, parabolas)
    people = lowered([np.concatenate([first[None], z[:FIRST]]) for z in each])
    if not len(people):
        raise FitError(NO_HAMMER)
    progress("hammer", 0.3)
    people = people.join(lowered(rescan_velocities(descent, _survivors(descent, people).theta, parabolas)))
    progress("hammer", 0.4)
    people = descent.minimise(
        _with_discretisation_error(descent, _survivors(descent, people)), SECOND_FLOOR, SECOND_STEPS
    )
    progress("hammer", 0.5)
    people = descent.minimise(_with_discretisation_error(descent, _survivors(descent, people, NEAR)), 0.0, LAST_STEPS)
    progress("restarts", 0.6)
    random = np.random.default_rng(seed)
    for _ in range(ROUNDS):
        before = _lowest(descent, people)
        people = _restarted(descent, people, lambda best, _: _perturb(descent, best, random))
        for node in range(len(parabolas)):
            people = _restarted(
                descent, people, lambda best, by: rescan_velocities(descent, best.theta, [by], best.offset[0])[0], node
            )
        if descent.unknowns.free[descent.unknowns.index_of("x0")]:
            people = _restarted(descent, people, lambda best, _: _shift_strike_position(descent, best.theta[0]))
        if _lowest(descent, people) > before - GAIN:
            break
    return people


def _survivors(descent: Optimiser, people: Candidates, within: float = np.inf) -> Candidates:
    """The lowest, of those that have come together one."""
    apart = deduplicate(people, descent.unknowns, descent.total(people), within, ONE_VALLEY)
    return people.take(np.array(apart[:SECOND], int))


def _with_discretisation_error(descent: Optimiser, people: Candidates) -> Candidates:
    """With the levels as if contacts had been stepped without end: what that adds at the lowest it adds to all."""
    return descent.initialise(people.theta, people.phi, people.w, descent.discretisation_error_db(people.theta[:1]))


def _lowest(descent: Optimiser, people: Candidates) -> float:
    """F of the first."""
    return float(descent.total(people)[0])


def _perturb(descent: Optimiser, best: Candidates, random: np.random.Generator) -> np.ndarray:
    """Points about the best in everything, along its valley [restarts, size]."""
    u, moves = descent.unknowns, descent.is_free
    precision = (
        descent.prior(best.theta)[2] / REACH**2 + sum(part.derivatives.curvature[0] for part in best.parts) / ALONG**2
    )
    value, vector = np.linalg.eigh(precision[np.ix_(moves, moves)])
    z = np.tile(best.theta, (RESTARTS, 1))
    z[:, moves] += random.normal(size=(RESTARTS, moves.sum())) / np.sqrt(value) @ vector.T
    return u.project(z)


def _shift_strike_position(descent: Optimiser, best: np.ndarray) -> np.ndarray:
    """The best [size] with its strike moved [2 · len(SCAN), size]."""
    z = np.tile(best, (2 * len(SCAN), 1))
    z[:, descent.unknowns.index_of("x0")] += np.outer([1, -1], SCAN).ravel()
    return descent.unknowns.project(z)


def _restarted(
    descent: Optimiser, people: Candidates, points: Callable[[Candidates, QuadraticSurrogate], np.ndarray],
    gains: int | None = None,
) -> Candidates:  # fmt: skip
    """With the minima reached from `points` of the lowest, at first on the parabola at its φ and w.

    Parameters
    ----------
    gains : the node of the gains by which the parabola goes; all of them by default.
    """
    best = people.take(np.array([0]))
    there = best.level
    parabola = QuadraticSurrogate.of(descent.table, there.phi[0], there.w[0], there.residual[0], gains)
    more = descent.initialise(points(best, parabola), best.phi, best.w, best.offset, parabola)
    if not len(more):
        return people
    more = descent.minimise(more, 0.0, TRIAL, parabola=parabola)
    lowest = descent.prior(best.theta)[0] + parabola(there.residual, there.jacobian).nll
    going = np.flatnonzero(descent.total(more) < lowest + NEAR)[:GOING]
    if len(going):
        people = people.join(descent.minimise(more.take(going), 0.0, LAST_STEPS))
    return people.take(np.argsort(descent.total(people), kind="stable"))


def deduplicate(
    people: Candidates, unknowns: Parametrisation, scores: np.ndarray, within: float, apart: float = SAME
) -> list[int]:
    """Which are `apart` from all lower ones, and within `within` of the lowest score; the lowest first."""
    chosen: list[int] = []
    free = unknowns.free
    for i in np.argsort(scores, kind="stable"):
        if scores[i] > scores.min() + within:
            break
        away = [np.abs((people.theta[i] - people.theta[j]) / unknowns.sd.clip(1e-12))[free].max() for j in chosen]
        if not away or min(away) >= apart:
            chosen.append(int(i))
    return chosen
