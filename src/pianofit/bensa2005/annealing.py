"""Adaptive simulated annealing (ASA) after Ingber, with a batch of chains.

A chain jumps within the box. It accepts every jump that lowers the cost. It accepts a jump that raises the cost with a
probability that falls as the chain cools. The jumps have a heavy tail: all lengths between the temperature and the box
are about equally likely on a log scale. A parameter may therefore cool exponentially in k^(1/D) and still leave a local
minimum: T = T_0 exp(-c k^(1/D)). Here k counts steps for the parameters and accepted jumps for the acceptance, and c is
such that the lowest temperature is reached at the end of the plan. At intervals the chains are re-annealed: parameters
to which the cost is insensitive get wider jumps, and the acceptance temperature is set to the remaining gain.

All chains step together, so that `cost` always gets a batch of the same shape, [chains, D]. As the plan proceeds, a
chain looks at another chain more and more often and may jump to its position.

Sources: L. Ingber, "Very fast simulated re-annealing", Math. Comput. Modelling 12 (1989) 967-973; the manual of his
ASA 30, sections 5.2.2 to 5.2.4. Departures from them are noted at the line and in docs/annealing.md.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

# A shorter jump is lost in the rounding of the coordinates, box widths.
COLDEST = 1e-15


@dataclass(frozen=True)
class Schedule:
    """Cooling schedule. The defaults do well over many functions (benchmarks/annealing_study.py)."""

    start: float = 1.0  # T_0 of every parameter, box widths
    end: float = 1e-7  # temperature at the end of the plan, box widths (ASA: Temperature_Ratio_Scale)
    cost_start: float | None = None  # of the acceptance, units of cost; None: the spread of the first samples
    cost_end: float = 1e-9  # of the acceptance at the end of the plan if all jumps are accepted, relative
    samples: int = 16  # uniform points before the first jump; each chain starts at its lowest
    reanneal: int = 100  # steps between re-annealings, 0 for none (ASA: Acceptance_Frequency_Modulus)
    probe: float = 1e-3  # step of the difference quotient for a sensitivity, box widths (ASA: Delta_X)
    exponent: float = 0.5  # temperatures are proportional to sensitivity^-exponent; Ingber's is 1
    max_width: float = 1e3  # largest factor on a parameter's temperature
    exchanges: float = 80.0  # mean number of times that a chain looks at another during the plan


@dataclass(frozen=True)
class AnnealingState:
    """State on which the next step depends. Arrays are [chains, D] or [chains]."""

    z: np.ndarray
    cost: np.ndarray  # at z
    best_z: np.ndarray
    best_cost: np.ndarray
    width: np.ndarray  # [chains, free]: factors on the parameters' temperatures, by sensitivity
    cost_start: np.ndarray  # [chains]: T_0 of the acceptance, units of cost
    accepted: np.ndarray  # [chains]: jumps accepted since T_0 was set, k of the acceptance
    steps: int  # k of the parameters
    length: int  # steps planned
    evaluations: int

    def with_lower_best(self, which: np.ndarray, z: np.ndarray, cost: np.ndarray) -> AnnealingState:
        """Update the best points of the chains `which` where their `cost` at `z` is lower."""
        lower = which & (cost < self.best_cost)
        best_z = np.where(lower[:, None], z, self.best_z)
        return replace(self, best_z=best_z, best_cost=np.where(lower, cost, self.best_cost))


class Annealed(NamedTuple):
    """The lowest point of all chains."""

    z: np.ndarray  # [D]
    cost: float  # inf if no cost was finite
    evaluations: int


class _Problem(NamedTuple):
    """Constants of one annealing."""

    cost: Callable[[np.ndarray], np.ndarray]
    lower: np.ndarray
    size: np.ndarray
    upper: np.ndarray
    free: np.ndarray  # indices of the free coordinates
    schedule: Schedule
    rng: np.random.Generator


def anneal(cost: Callable[[np.ndarray], Any], lower: np.ndarray, upper: np.ndarray, **options: Any) -> Annealed:
    """Minimise `cost(z [chains, D]) -> [chains]` in the box `lower` <= z <= `upper` [D] and return the best point.

    A cost that is not finite counts as infinite. If no cost is finite, the result's cost is inf. For `options` see
    `annealing`.
    """
    state = deque(annealing(cost, lower, upper, **options), maxlen=1).pop()
    best = int(np.argmin(state.best_cost))
    return Annealed(state.best_z[best].copy(), float(state.best_cost[best]), state.evaluations)


def annealing(
    cost: Callable[[np.ndarray], Any],
    lower: np.ndarray,
    upper: np.ndarray,
    *,
    chains: int = 16,
    evaluations: int,
    seed: int = 0,
    start: np.ndarray | None = None,
    schedule: Schedule | None = None,
) -> Iterator[AnnealingState]:
    """Yield the state after each step. The same seed gives the same states.

    Parameters
    ----------
    lower, upper : finite. A coordinate is fixed where they are equal.
    evaluations : total number of cost evaluations, at least one for each chain and each sample of the schedule. The
        cooling is planned for it.
    start : points where the first chains start, [D] or [n, D]. The other chains start at uniform points.
    """

    def finite(z: np.ndarray) -> np.ndarray:
        value = np.asarray(cost(z.copy()), float)
        return np.where(np.isfinite(value), value, np.inf)

    lower, upper, schedule = np.array(lower, float), np.array(upper, float), schedule or Schedule()
    rounds, free = -(-schedule.samples // chains), np.flatnonzero(upper > lower)
    problem = _Problem(finite, lower, upper - lower, upper, free, schedule, np.random.Generator(np.random.PCG64(seed)))
    state = _initial_state(problem, (rounds, chains), evaluations, start)
    yield state
    while len(free) and state.evaluations + chains <= evaluations:
        state = _step(problem, state)
        if schedule.reanneal and state.steps % schedule.reanneal == 0:
            if state.evaluations + chains * len(free) <= evaluations and schedule.exponent > 0:
                state = _reanneal_widths(problem, state)
            state = _reanneal_acceptance(problem, state)
        yield state


# --- jumps and temperatures ------------------------------------------------------------------------------------------


def jump_cdf(y: np.ndarray, temperature: np.ndarray) -> np.ndarray:
    """Return the probability of a jump of at most `y`, box widths, from -1 to 1.

    Its density is 1/(2 (|y| + T) ln(1 + 1/T)) (Ingber 1989; section 5.2.2 of the manual omits the logarithm).
    """
    return 0.5 + 0.5 * np.sign(y) * np.log1p(np.abs(y) / temperature) / np.log1p(1 / temperature)


def generate(u: np.ndarray, x: np.ndarray, temperature: np.ndarray) -> np.ndarray:
    """Jump from `x` in [0, 1] to another point in [0, 1], by uniform `u` in [0, 1).

    y = sgn(v) T ((1 + 1/T)^|v| - 1), v = 2u - 1 (Ingber 1989). Ingber repeats the draw while x + y lies outside. Here u
    is mapped to the range that leads inside, which gives the same distribution with one draw.
    """
    low, high = jump_cdf(-x, temperature), jump_cdf(1 - x, temperature)
    v = 2 * (low + u * (high - low)) - 1
    y = np.sign(v) * temperature * np.expm1(np.abs(v) * np.log1p(1 / temperature))
    return np.clip(x + y, 0.0, 1.0)


def acceptance(rise: np.ndarray, temperature: np.ndarray) -> np.ndarray:
    """Return exp(-ΔE/T), at most 1 (manual, section 5.2.3).

    The paper of 1989 has 1/(1 + exp(ΔE/T)), which rejects some downhill jumps too.
    """
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        return np.where(rise > 0, np.exp(-np.maximum(rise, 0.0) / temperature), 1.0)


def temperatures(state: AnnealingState, schedule: Schedule) -> np.ndarray:
    """T_i = T_0 exp(-c k^(1/D)), times the width from re-annealing, at most T_0; box widths, [chains, D]."""
    fall = np.log(schedule.start / schedule.end) * (state.steps / state.length) ** (1 / state.width.shape[1])
    return np.clip(schedule.start * np.exp(-fall) * state.width, min(COLDEST, schedule.end), schedule.start)


def cost_temperature(state: AnnealingState, schedule: Schedule) -> np.ndarray:
    """T = T_0 exp(-c k^(1/D)), k the number of accepted jumps (manual, section 5.2.4); units of cost, [chains]."""
    return state.cost_start * schedule.cost_end ** ((state.accepted / state.length) ** (1 / state.width.shape[1]))


# --- one step --------------------------------------------------------------------------------------------------------


def _step(problem: _Problem, state: AnnealingState) -> AnnealingState:
    """Every chain tries one jump and, with some probability, looks at another chain."""
    chains, free = state.width.shape
    # A fixed count, so that the stream does not depend on earlier branches.
    u = problem.rng.random((chains, 2 * free + 5))
    temperature = cost_temperature(state, problem.schedule)
    z = _trial(problem, state, u[:, :free], u[:, free:-3])
    new = problem.cost(z)
    accepted = u[:, -3] < acceptance(_increase(new, state.cost), temperature)
    z, new = np.where(accepted[:, None], z, state.z), np.where(accepted, new, state.cost)
    state = replace(
        state,
        z=z,
        cost=new,
        accepted=state.accepted + accepted,
        steps=state.steps + 1,
        evaluations=state.evaluations + chains,
    ).with_lower_best(accepted, z, new)
    # Rare at first, so that the chains explore independently. Most frequent at the end, so that they refine together.
    rate = 2 * problem.schedule.exchanges * state.steps / state.length**2
    if chains == 1 or not problem.schedule.exchanges:
        return state
    return _exchange(problem, state, temperature, u[:, -2] < rate, u[:, -1])


def _trial(problem: _Problem, state: AnnealingState, u: np.ndarray, which: np.ndarray) -> np.ndarray:
    """Jump in a random subset, of any size with equal chance, of the free coordinates; `which` is [chains, D + 2].

    Ingber moves all or one at a time. Moving all rarely finds a small improvement. Moving one cannot follow a narrow
    minimum that is oblique to the axes.
    """
    free = problem.free
    moved = which[:, : len(free)] < which[:, -2:-1]
    moved |= np.arange(len(free)) == (which[:, -1:] * len(free)).astype(int)
    lower, size, old = problem.lower[free], problem.size[free], state.z[:, free]
    new = lower + size * generate(u, np.clip((old - lower) / size, 0.0, 1.0), temperatures(state, problem.schedule))
    z = state.z.copy()
    z[:, free] = np.where(moved, np.clip(new, lower, problem.upper[free]), old)
    return z


def _exchange(
    problem: _Problem, state: AnnealingState, temperature: np.ndarray, selected: np.ndarray, u: np.ndarray
) -> AnnealingState:
    """Move a chain that looks at another to its position, by the acceptance rule, and copy its best point."""
    chains = len(state.z)
    other = (np.arange(chains) + problem.rng.integers(1, chains, chains)) % chains
    joins = selected & (u < acceptance(_increase(state.cost[other], state.cost), temperature))
    z = np.where(joins[:, None], state.z[other], state.z)
    joined = replace(state, z=z, cost=np.where(joins, state.cost[other], state.cost))
    return joined.with_lower_best(joins, state.best_z[other], state.best_cost[other])


def _increase(new: np.ndarray, old: np.ndarray) -> np.ndarray:
    """Increase of the cost; -inf from an infinite cost, so that every jump is accepted."""
    finite = np.isfinite(old)
    return np.where(finite, new - np.where(finite, old, 0.0), -np.inf)


# --- re-annealing ----------------------------------------------------------------------------------------------------


def _reanneal_widths(problem: _Problem, state: AnnealingState) -> AnnealingState:
    """Widths (s_max/s_i)^exponent from sensitivities s_i, differences of cost around each chain's best point.

    Ingber's exponent 1 makes steps of equal cost on a slope. The best point soon lies in a minimum, where a difference
    measures curvature and steps of equal cost go as its square root. Ingber accumulates the factors of successive
    re-annealings (T_i ← T_i s_max/s_i). Here each re-annealing starts from the common schedule.
    """
    best, least, schedule = state.best_z, state.best_cost, problem.schedule
    sensitivity = np.zeros_like(state.width)
    for column, i in enumerate(problem.free):
        z = best.copy()
        inward = np.where(best[:, i] > problem.lower[i] + 0.5 * problem.size[i], -1.0, 1.0)
        z[:, i] = np.clip(best[:, i] + inward * schedule.probe * problem.size[i], problem.lower[i], problem.upper[i])
        new = problem.cost(z)
        sensitivity[:, column] = np.abs(_increase(new, least))
        state = replace(state, evaluations=state.evaluations + len(z)).with_lower_best(np.full(len(z), True), z, new)
    sensitivity = np.nan_to_num(sensitivity, posinf=0.0)  # an infinite cost gives no sensitivity
    most = sensitivity.max(axis=1, keepdims=True)
    ratio = np.divide(sensitivity, most, out=np.ones_like(sensitivity), where=most > 0)
    limited = np.maximum(ratio, schedule.max_width ** (-1 / schedule.exponent))
    return replace(state, width=np.where(sensitivity > 0, limited**-schedule.exponent, 1.0))


def _reanneal_acceptance(problem: _Problem, state: AnnealingState) -> AnnealingState:
    """Restart the acceptance temperature at the remaining gain: the chain's cost minus its best cost.

    The manual (section 5.2.4) also uses the absolute costs. They are left out, so that a constant added to the cost
    changes nothing. The new temperature is at most the old start and at least the current value.
    """
    gap = np.where(np.isfinite(state.cost), _increase(state.cost, state.best_cost), 0.0)
    restarted = np.minimum(state.cost_start, np.maximum(gap, cost_temperature(state, problem.schedule)))
    return replace(state, cost_start=restarted, accepted=np.ones_like(state.accepted))


# --- initial state ---------------------------------------------------------------------------------------------------


def _initial_state(
    problem: _Problem, shape: tuple[int, int], evaluations: int, start: np.ndarray | None
) -> AnnealingState:
    """Draw uniform samples. Each chain starts at its lowest; their spread is the first acceptance temperature."""
    chains, schedule = shape[1], problem.schedule
    z = np.clip(
        problem.lower + problem.size * problem.rng.random((*shape, len(problem.lower))), problem.lower, problem.upper
    )
    has_start = np.zeros(chains, bool)
    if start is not None:
        given = np.atleast_2d(np.asarray(start, float))
        z[0, : len(given)], has_start[: len(given)] = np.clip(given, problem.lower, problem.upper), True
    costs = np.array([problem.cost(batch) for batch in z])
    lowest = costs.argmin(axis=0), np.arange(chains)
    first = np.where(has_start, 0, lowest[0]), lowest[1]
    temperature = _spread(costs[np.isfinite(costs)]) if schedule.cost_start is None else schedule.cost_start
    length = (evaluations - costs.size) / chains
    if schedule.reanneal and schedule.exponent > 0:
        length /= 1 + len(problem.free) / schedule.reanneal
    return AnnealingState(
        z=z[first],
        cost=costs[first],
        best_z=z[lowest],
        best_cost=costs[lowest],
        width=np.ones((chains, len(problem.free))),
        cost_start=np.full(chains, temperature),
        accepted=np.ones(chains),
        steps=1,
        length=max(int(length), 1),
        evaluations=costs.size,
    )


def _spread(costs: np.ndarray) -> float:
    """Median absolute deviation of the costs, so that a few extreme samples do not set the temperature."""
    if not len(costs):
        return 1.0  # re-annealing lowers it
    median = float(np.median(costs))
    spreads = float(np.median(np.abs(costs - median))), float(np.ptp(costs)), abs(median)
    return next((s for s in spreads if 0 < s < np.inf), 1.0)
