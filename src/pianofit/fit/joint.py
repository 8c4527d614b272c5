"""String and hammer together: weights from the residuals, residuals from the weights, until they agree."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from .levenberg import Descent, descend
from .residuals import Cfg, Target, joint_batch
from .space import NAMES, Space
from .state import State, settled_weights
from .target import MOST_SCATTER, Spreads, Takes

__all__ = ["Fit", "ended", "gone_on", "in_tune", "joint_stage", "unlikely"]

# How often weights and parameters are found in turn.
ROUNDS = 4
# How many of the partials tell of the path's roughness each by itself: neighbours leave a smooth path together. If all
# did, a smooth path would outweigh what takes have not in common, which is what tells of the hammer.
OWN = 1 / 3


@dataclass(frozen=True)
class Fit:
    """Where the search ended, before it is put into words."""

    z: np.ndarray  # [1, size]
    values: np.ndarray  # [size]: in the order of `NAMES`, then gain and path in dB
    space: Space
    data: Takes
    spread: Spreads
    robust: np.ndarray  # [3, takes, rows]
    target: Target
    cfg: Cfg
    jacobian: np.ndarray  # [residuals, size]
    residual: np.ndarray  # [residuals]
    cost: float
    pressed: np.ndarray  # [size]
    converged: bool
    evaluations: int
    agreeing: int  # how many of the hammer's starts ended at the lowest cost
    messages: tuple[str, ...]
    state: State


def joint_stage(
    state: State, z: np.ndarray, spread: Spreads, robust: np.ndarray, most: int = ROUNDS, iterations: int = 60
) -> Fit:
    """All together; weights from the residuals, residuals from the weights, until they agree, in `most` rounds."""
    count, rounds = 0, 0
    while True:
        at = state.target(spread, robust)
        end = descend(state.evaluate(joint_batch, at), z, state.space, iterations=iterations, tolerance=1e-8)
        z, count, rounds, before = end.z, count + end.evaluations, rounds + 1, spread
        spread, robust = settled_weights(state, at, z)
        agreed = abs(spread.level - before.level) < 0.02 * spread.level + 1e-4
        if rounds == most or (agreed and end.settled[0]):
            return ended(state, end, at, before, robust, count)


def gone_on(fit: Fit, state: State, z: np.ndarray | None = None, *short: int) -> Fit:
    """The last stage once more, from where `fit` is, or from `z`, and with its weights."""
    new = joint_stage(state, fit.z if z is None else z, fit.spread, fit.robust, *short)
    return replace(new, evaluations=fit.evaluations + new.evaluations)


def ended(state: State, end: Descent, at: Target, spread: Spreads, robust, count: int) -> Fit:
    """What a descent to `end` makes: on the residuals `at` of the weights `spread`, and `robust` as it leaves them."""
    values = state.space.natural(end.z[0])
    downhill = -(end.jacobian[0].T @ end.residual[0])
    pressed = state.space.at_bound(values) & (np.abs(downhill) > 0)
    messages = () if bool(end.settled[0]) else ("The last stage stopped before it settled.",)
    return Fit(
        end.z, values, state.space, state.data, spread, robust, at, state.cfg, end.jacobian[0], end.residual[0],
        float(end.cost[0]), pressed, bool(end.settled[0]), count, 0, messages, state,
    )  # fmt: skip


def unlikely(fit: Fit) -> float:
    """Minus the logarithm of the likelihood, but for a constant: unlike the cost it compares fits of other weights.

    Those of frequencies and decays are the string's, and much the same for all hammers.
    """
    data, found = fit.data, fit.data.found
    sd = np.hypot(data.level_error, min(fit.spread.level, MOST_SCATTER) * data.buried)[found]
    return fit.cost + float(np.log(sd).sum() - OWN * np.log1p(-np.asarray(fit.target.shrink)).sum())


def in_tune(state: State, z: np.ndarray) -> tuple[np.ndarray, int]:
    """The points [hammers, size] with c and κ where the table of partials wants them for the first, all else held.

    A band of one faint partial, as a bass note's first, can put the string far out of tune; the step back with all free
    at once then changes the hammer so much that its contact does not end, and nothing moves any more.
    """
    at = state.target(state.first_spread(1.0, 0.3), state.unweighted)
    places = np.isin(np.arange(z.shape[1]), [NAMES.index("c"), NAMES.index("kappa")])
    end = descend(state.evaluate(joint_batch, at), z[:1], state.space, iterations=10, free=places, tolerance=1e-4)
    return np.where(places, end.z, z), end.evaluations
