"""The laws of an annealing: how it jumps, accepts and cools; and all that it remembers.

The laws of cooling are functions of a frozen `AnnealingState`: T = T_0 exp(-c k^(1/D)), where k counts steps for the
parameters and jumps taken for the acceptance (L. Ingber, Math. Comput. Modelling 12 (1989) 967-973; manual of his
ASA 30, section 5.2.4). c is such that the coldest temperature is reached where the plan ends.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ..errors import ParameterError

__all__ = ["AnnealingState", "Schedule", "acceptance", "cost_temperature", "generate", "jump_cdf", "temperatures"]

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

    def __post_init__(self) -> None:
        for name in ("start", "end", "cost_end", "probe", "widest"):
            if not 0 < getattr(self, name) < np.inf:
                raise ParameterError(f"{name}={getattr(self, name)} of an annealing's schedule must be positive")
        if self.end > self.start or self.cost_end > 1:
            raise ParameterError(f"end={self.end}, cost_end={self.cost_end}: an annealing must not get warmer")
        if min(self.samples - 1, self.reanneal, self.stretch, self.meetings) < 0 or (self.cost_start or 0.0) < 0:
            raise ParameterError("samples of an annealing's schedule must be at least 1, and nothing in it negative")


@dataclass(frozen=True)
class AnnealingState:
    """All that the next step depends on. Arrays are [chains, D] or [chains]."""

    z: np.ndarray
    cost: np.ndarray  # at z
    best_z: np.ndarray
    best_cost: np.ndarray
    width: np.ndarray  # [chains, D]: factors on the parameters' temperatures, by sensitivity
    cost_start: np.ndarray  # [chains]: T_0 of the acceptance, units of cost
    accepted: np.ndarray  # [chains]: jumps taken since that T_0 was set, k of the acceptance
    steps: int  # k of the parameters
    length: int  # steps planned
    evaluations: int
    trace: tuple[tuple[int, float], ...]  # evaluations and lowest cost, whenever that fell
    random: dict[str, Any]  # of NumPy's PCG64


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


def temperatures(state: AnnealingState, schedule: Schedule, dimensions: int) -> np.ndarray:
    """T_i = T_0 exp(-c k^(1/D)), times the width found by re-annealing, at most T_0; box widths, [chains, D]."""
    fall = np.log(schedule.start / schedule.end) * (state.steps / state.length) ** (1 / dimensions)
    return np.clip(schedule.start * np.exp(-fall) * state.width, min(COLDEST, schedule.end), schedule.start)


def cost_temperature(state: AnnealingState, schedule: Schedule, dimensions: int) -> np.ndarray:
    """T = T_0 exp(-c k^(1/D)), k the number of jumps taken (manual, section 5.2.4); units of cost, [chains]."""
    return state.cost_start * schedule.cost_end ** ((state.accepted / state.length) ** (1 / dimensions))
