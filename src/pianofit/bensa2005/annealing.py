"""Adaptive simulated annealing (ASA) after Ingber, with many chains at once.

A chain jumps about the box. It takes every jump downhill, and one uphill with a probability that falls as it cools. The
jumps have a fat tail: all lengths between the temperature and the box are about equally likely on a log scale, so that
a parameter may cool exponentially in k^(1/D) and still get out: T = T_0 exp(-c k^(1/D)), where k counts steps for the
parameters and jumps taken for the acceptance, and c is such that the coldest temperature is reached where the plan
ends. Now and then the annealing is set anew: parameters to which the cost is insensitive are searched more widely, and
the acceptance gets a temperature of the size of what there is still to gain.

The chains go in lockstep, so that `cost` always gets a batch of the same shape, [chains, D]; the more of the plan is
done, the more often a chain looks at another one and jumps to where that is.

Sources: L. Ingber, "Very fast simulated re-annealing", Math. Comput. Modelling 12 (1989) 967-973; the manual of his
ASA 30, sections 5.2.2 to 5.2.4. Where this departs from them stands at the line, and in docs/annealing.md.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from ..errors import ParameterError

__all__ = [
    "Annealed", "AnnealingState", "Schedule", "anneal", "annealing", "cost_temperature", "generate", "jump_cdf",
    "temperatures",
]  # fmt: skip

# Below this a jump is lost in the rounding of the coordinates, box widths.
COLDEST = 1e-15


@dataclass(frozen=True)
class Schedule:
    """How an annealing cools. The defaults do well over many functions (benchmarks/annealing_study.py)."""

    start: float = 1.0  # T_0 of every parameter, box widths
    end: float = 1e-7  # what it cools to by the end of the plan, box widths (ASA: Temperature_Ratio_Scale)
    cost_start: float | None = None  # acceptance, units of cost; None: the spread of the first samples
    cost_end: float = 1e-9  # what it would cool to by the end of the plan were all jumps taken, relative
    samples: int = 16  # uniform points before the first jump; each chain starts at its lowest
    reanneal: int = 100  # steps between re-annealings, 0 for none (ASA: Acceptance_Frequency_Modulus)
    probe: float = 1e-3  # displacement by which sensitivities are measured, box widths (ASA: Delta_X)
    stretch: float = 0.5  # temperatures go as sensitivity^-stretch; Ingber's is 1
    widest: float = 1e3  # no parameter is searched more than this factor more widely
    meetings: float = 80.0  # how often, on average, a chain looks at another during the plan


@dataclass(frozen=True)
class AnnealingState:
    """All that the next step depends on. Arrays are [chains, D] or [chains]."""

    z: np.ndarray
    cost: np.ndarray  # at z
    best_z: np.ndarray
    best_cost: np.ndarray
    width: np.ndarray  # [chains, free]: factors on the parameters' temperatures, by sensitivity
    cost_start: np.ndarray  # [chains]: T_0 of the acceptance, units of cost
    accepted: np.ndarray  # [chains]: jumps taken since that T_0 was set, k of the acceptance
    steps: int  # k of the parameters
    length: int  # steps planned
    evaluations: int

    def lowered(self, which: np.ndarray, z: np.ndarray, cost: np.ndarray) -> AnnealingState:
        """The same with better bests, where `which` chains' `cost` at `z` is lower."""
        lower = which & (cost < self.best_cost)
        best_z = np.where(lower[:, None], z, self.best_z)
        return replace(self, best_z=best_z, best_cost=np.where(lower, cost, self.best_cost))


class Annealed(NamedTuple):
    """The lowest point of all chains, and how it was come by."""

    z: np.ndarray  # [D]
    cost: float  # inf where no finite one was met
    state: AnnealingState
    evaluations: int


class _Problem(NamedTuple):
    """What stays while a box is searched."""

    cost: Callable[[np.ndarray], np.ndarray]
    lower: np.ndarray
    size: np.ndarray
    upper: np.ndarray
    free: np.ndarray  # indices of what may move
    schedule: Schedule
    rng: np.random.Generator


def anneal(cost: Callable[[np.ndarray], Any], lower: np.ndarray, upper: np.ndarray, **how: Any) -> Annealed:
    """Search the box `lower` <= z <= `upper` [D] for the lowest `cost(z [chains, D]) -> [chains]`, to the plan's end.

    A cost that is not finite is infinitely bad. If none is finite the result's cost is inf. `how`: see `annealing`.
    """
    state = deque(annealing(cost, lower, upper, **how), maxlen=1).pop()
    best = int(np.argmin(state.best_cost))
    return Annealed(state.best_z[best].copy(), float(state.best_cost[best]), state, state.evaluations)


def annealing(
    cost: Callable[[np.ndarray], Any], lower: np.ndarray, upper: np.ndarray, *, chains: int = 16, evaluations: int,
    seed: int = 0, start: np.ndarray | None = None, schedule: Schedule | None = None,
) -> Iterator[AnnealingState]:  # fmt: skip
    """The same step by step; the same seed gives the same states.

    Parameters
    ----------
    lower, upper : finite; where they are equal the coordinate is held.
    evaluations : points at which the cost may be computed in all; the cooling is planned for it.
    start : where the first chains start, [D] or [n, D]; the others start at uniform points.

    Raises
    ------
    ParameterError
        If the box is not finite or empty, or the evaluations are too few.
    """

    def finite(z: np.ndarray) -> np.ndarray:
        value = np.asarray(cost(z.copy()), float)
        return np.where(np.isfinite(value), value, np.inf)

    lower, upper, schedule = np.array(lower, float), np.array(upper, float), schedule or Schedule()
    if not (np.isfinite(upper - lower).all() and (lower <= upper).all()):
        raise ParameterError(f"lower={lower} and upper={upper} of an annealing must be a finite box")
    rounds, free = -(-schedule.samples // max(chains, 1)), np.flatnonzero(upper > lower)
    if chains < 1 or evaluations < rounds * chains:
        raise ParameterError(f"chains={chains}, evaluations={evaluations}: needs one chain, {schedule.samples} samples")
    on = _Problem(finite, lower, upper - lower, upper, free, schedule, np.random.Generator(np.random.PCG64(seed)))
    state = _first(on, (rounds, chains), evaluations, start)
    yield state
    while len(free) and state.evaluations + chains <= evaluations:
        state = _step(on, state)
        if schedule.reanneal and state.steps % schedule.reanneal == 0:
            if state.evaluations + chains * len(free) <= evaluations and schedule.stretch > 0:
                state = _widened(on, state)
            state = _cost_reannealed(on, state)
        yield state


# --- the laws --------------------------------------------------------------------------------------------------------


def jump_cdf(y: np.ndarray, temperature: np.ndarray) -> np.ndarray:
    """Return the probability of a jump of at most `y`, box widths, from -1 to 1.

    Its density is 1/(2 (|y| + T) ln(1 + 1/T)) (Ingber 1989; section 5.2.2 of the manual omits the logarithm).
    """
    return 0.5 + 0.5 * np.sign(y) * np.log1p(np.abs(y) / temperature) / np.log1p(1 / temperature)


def generate(u: np.ndarray, x: np.ndarray, temperature: np.ndarray) -> np.ndarray:
    """Jump from `x` in [0, 1] to another point in [0, 1], by uniform `u` in [0, 1).

    y = sgn(v) T ((1 + 1/T)^|v| - 1), v = 2u - 1 (Ingber 1989). He draws anew while x + y lies outside; here u is
    drawn from what leads inside, which is the same distribution and takes one draw.
    """
    low, high = jump_cdf(-x, temperature), jump_cdf(1 - x, temperature)
    v = 2 * (low + u * (high - low)) - 1
    y = np.sign(v) * temperature * np.expm1(np.abs(v) * np.log1p(1 / temperature))
    return np.clip(x + y, 0.0, 1.0)


def acceptance(rise: np.ndarray, temperature: np.ndarray) -> np.ndarray:
    """Return exp(-ΔE/T), at most 1 (manual, section 5.2.3; in 1989 it was 1/(1 + exp(ΔE/T)), shy downhill too)."""
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        return np.where(rise > 0, np.exp(-np.maximum(rise, 0.0) / temperature), 1.0)


def temperatures(state: AnnealingState, schedule: Schedule) -> np.ndarray:
    """T_i = T_0 exp(-c k^(1/D)), times the width found by re-annealing, at most T_0; box widths, [chains, D]."""
    fall = np.log(schedule.start / schedule.end) * (state.steps / state.length) ** (1 / state.width.shape[1])
    return np.clip(schedule.start * np.exp(-fall) * state.width, min(COLDEST, schedule.end), schedule.start)


def cost_temperature(state: AnnealingState, schedule: Schedule) -> np.ndarray:
    """T = T_0 exp(-c k^(1/D)), k the number of jumps taken (manual, section 5.2.4); units of cost, [chains]."""
    return state.cost_start * schedule.cost_end ** ((state.accepted / state.length) ** (1 / state.width.shape[1]))


# --- one step --------------------------------------------------------------------------------------------------------


def _step(on: _Problem, state: AnnealingState) -> AnnealingState:
    """Every chain tries one jump and, now and then, looks at another chain."""
    chains, free = state.width.shape
    u = on.rng.random((chains, 2 * free + 5))  # always as many, so that nothing depends on what came before
    warm = cost_temperature(state, on.schedule)
    z = _trial(on, state, u[:, :free], u[:, free:-3])
    new = on.cost(z)
    taken = u[:, -3] < acceptance(_rise(new, state.cost), warm)
    z, new = np.where(taken[:, None], z, state.z), np.where(taken, new, state.cost)
    state = replace(
        state, z=z, cost=new, accepted=state.accepted + taken, steps=state.steps + 1,
        evaluations=state.evaluations + chains,
    ).lowered(taken, z, new)  # fmt: skip
    # Rarely at first, so that the chains search apart, and most at the end, so that they refine together.
    often = 2 * on.schedule.meetings * state.steps / state.length**2
    return _met(on, state, warm, u[:, -2] < often, u[:, -1]) if chains > 1 and on.schedule.meetings else state


def _trial(on: _Problem, state: AnnealingState, u: np.ndarray, which: np.ndarray) -> np.ndarray:
    """Jump in a random subset of the free coordinates, of any size with equal chance; `which` [chains, D + 2].

    Ingber moves all or one at a time. All at once hardly ever meets a small improvement; one at a time cannot follow a
    valley across the axes.
    """
    free = on.free
    moved = which[:, : len(free)] < which[:, -2:-1]
    moved |= np.arange(len(free)) == (which[:, -1:] * len(free)).astype(int)
    lower, size, here = on.lower[free], on.size[free], state.z[:, free]
    there = lower + size * generate(u, np.clip((here - lower) / size, 0.0, 1.0), temperatures(state, on.schedule))
    z = state.z.copy()
    z[:, free] = np.where(moved, np.clip(there, lower, on.upper[free]), here)
    return z


def _met(on: _Problem, state: AnnealingState, warm: np.ndarray, looks: np.ndarray, u: np.ndarray) -> AnnealingState:
    """A chain that looks at another jumps to where that is, by the rule for all jumps, and learns its best point."""
    chains = len(state.z)
    other = (np.arange(chains) + on.rng.integers(1, chains, chains)) % chains
    joins = looks & (u < acceptance(_rise(state.cost[other], state.cost), warm))
    z = np.where(joins[:, None], state.z[other], state.z)
    joined = replace(state, z=z, cost=np.where(joins, state.cost[other], state.cost))
    return joined.lowered(joins, state.best_z[other], state.best_cost[other])


def _rise(new: np.ndarray, old: np.ndarray) -> np.ndarray:
    """By how much the cost rises. From an infinite cost every way leads down."""
    known = np.isfinite(old)
    return np.where(known, new - np.where(known, old, 0.0), -np.inf)


# --- re-annealing ----------------------------------------------------------------------------------------------------


def _widened(on: _Problem, state: AnnealingState) -> AnnealingState:
    """Widths (s_max/s_i)^stretch from sensitivities s_i, differences of cost about each chain's best point.

    Ingber's exponent, 1, makes steps of equal cost on a slope. The best point soon lies in a minimum, where a
    difference measures curvature, and steps of equal cost go as its root. He lets the factors of successive
    re-annealings pile up (T_i ← T_i s_max/s_i); here they are taken afresh from the common schedule.
    """
    best, least, schedule = state.best_z, state.best_cost, on.schedule
    sensitivity = np.zeros_like(state.width)
    for column, i in enumerate(on.free):
        z = best.copy()
        inward = np.where(best[:, i] > on.lower[i] + 0.5 * on.size[i], -1.0, 1.0)
        z[:, i] = np.clip(best[:, i] + inward * schedule.probe * on.size[i], on.lower[i], on.upper[i])
        new = on.cost(z)
        sensitivity[:, column] = np.abs(_rise(new, least))
        state = replace(state, evaluations=state.evaluations + len(z)).lowered(np.full(len(z), True), z, new)
    sensitivity = np.nan_to_num(sensitivity, posinf=0.0)  # a wall says nothing
    most = sensitivity.max(axis=1, keepdims=True)
    ratio = np.divide(sensitivity, most, out=np.ones_like(sensitivity), where=most > 0)
    known = np.maximum(ratio, schedule.widest ** (-1 / schedule.stretch))
    return replace(state, width=np.where(sensitivity > 0, known**-schedule.stretch, 1.0))


def _cost_reannealed(on: _Problem, state: AnnealingState) -> AnnealingState:
    """The acceptance starts anew from what there is to gain: the gap between where a chain is and its best.

    After the manual's section 5.2.4, less the sizes of the costs themselves: adding a constant to the cost must change
    nothing. Never warmer than it started, never colder than it is.
    """
    gap = np.where(np.isfinite(state.cost), _rise(state.cost, state.best_cost), 0.0)
    anew = np.minimum(state.cost_start, np.maximum(gap, cost_temperature(state, on.schedule)))
    return replace(state, cost_start=anew, accepted=np.ones_like(state.accepted))


# --- the beginning ---------------------------------------------------------------------------------------------------


def _first(on: _Problem, shape: tuple[int, int], evaluations: int, start: np.ndarray | None) -> AnnealingState:
    """Uniform samples; each chain starts at its lowest, and their spread is the first temperature of the acceptance."""
    chains, schedule = shape[1], on.schedule
    z = np.clip(on.lower + on.size * on.rng.random((*shape, len(on.lower))), on.lower, on.upper)
    begun = np.zeros(chains, bool)
    if start is not None:
        given = np.atleast_2d(np.asarray(start, float))
        z[0, : len(given)], begun[: len(given)] = np.clip(given, on.lower, on.upper), True
    costs = np.array([on.cost(batch) for batch in z])
    lowest = costs.argmin(axis=0), np.arange(chains)
    here = np.where(begun, 0, lowest[0]), lowest[1]
    warm = _spread(costs[np.isfinite(costs)]) if schedule.cost_start is None else schedule.cost_start
    left = (evaluations - costs.size) / chains
    if schedule.reanneal and schedule.stretch > 0:
        left /= 1 + len(on.free) / schedule.reanneal
    return AnnealingState(
        z=z[here], cost=costs[here], best_z=z[lowest], best_cost=costs[lowest],
        width=np.ones((chains, len(on.free))), cost_start=np.full(chains, warm), accepted=np.ones(chains), steps=1,
        length=max(int(left), 1), evaluations=costs.size,
    )  # fmt: skip


def _spread(costs: np.ndarray) -> float:
    """Median distance from the median: a few samples on a cliff must not set the temperature of the plain."""
    if not len(costs):
        return 1.0  # nothing is known; re-annealing brings it down
    middle = float(np.median(costs))
    candidates = float(np.median(np.abs(costs - middle))), float(np.ptp(costs)), abs(middle)
    return next((c for c in candidates if 0 < c < np.inf), 1.0)
