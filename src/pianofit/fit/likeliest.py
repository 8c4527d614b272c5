"""Which of the hammers that a search ends at: the likeliest, once each has weights of its own.

The search weighs levels before anything is known of their scatter and of the path's roughness, and a cost under other
weights says little. So the better hammers are tried, and the best of them looked about for a likelier one.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..errors import FitError
from .again import nearby
from .hammers import AGREEMENT, anchored, search_hammers
from .joint import Fit, gone_on, in_tune, joint_stage, unlikely
from .place import smoother_place
from .space import NAMES
from .state import State, pool

__all__ = ["elsewhere", "likeliest"]

STRIKE = NAMES.index("x0")
# How often another place of the strike is looked for.
PLACES = 3
# Hammers of an uncalibrated recording are tried for so many rounds of so many iterations. Of the likeliest so many are
# followed for more of them, and so often a better one is looked for near each.
TRIAL, NEAR, FOLLOWED, SEARCHES = (2, 3), (3, 10), 2, 3
# A hammer that is so much less likely when it is tried, as a logarithm, is not followed.
HOPELESS = 10.0


def likeliest(state: State, hammers: np.ndarray, seed: int) -> Fit:
    """The likeliest of the fits that `hammers` [hammers, size] lead to, at the weights that each leaves."""
    hammers, count = in_tune(state, hammers)
    if state.data.calibrated:
        fit = _followed(state, hammers[:1])
        return replace(fit, evaluations=fit.evaluations + count)
    tried = sorted(pool().map(lambda z: _followed(state, z[None], *TRIAL), hammers), key=unlikely)
    price = np.array([unlikely(fit) for fit in tried])
    if not np.isfinite(price[0]):
        raise FitError("no hammer leads to a finite sound; widen [bounds] or check [known] in the setup")
    worth = (np.diff(price, prepend=-np.inf) > AGREEMENT) & (price < price[0] + HOPELESS)
    fits = [_closer(replace(tried[i], evaluations=0), seed) for i in np.flatnonzero(worth)[:FOLLOWED]]
    best, count = min(fits, key=unlikely), count + sum(fit.evaluations for fit in tried + fits)
    return gone_on(replace(best, evaluations=count), best.state)


def _followed(state: State, z: np.ndarray, *short: int) -> Fit:
    state, z = anchored(state, z)
    return joint_stage(state, z, state.first_spread(1.0, 0.3), state.unweighted, *short)


def _closer(fit: Fit, seed: int) -> Fit:
    """The fit of takes through a path, moved on while a likelier hammer lies near."""
    fit = gone_on(fit, fit.state, None, *NEAR)
    for again in range(SEARCHES):
        z, count = nearby(fit.state, fit.target, fit.z, fit.cost, seed + again)
        fit = replace(fit, evaluations=fit.evaluations + count)
        if z is None:
            break
        other = gone_on(fit, fit.state, z, *NEAR)
        if not unlikely(other) < unlikely(fit):
            return replace(fit, evaluations=other.evaluations)
        fit = other
    return fit


def elsewhere(fit: Fit, seed: int) -> Fit:
    """The fit, or a likelier one about the place of the strike at which its path would be much smoother."""
    for _ in range(PLACES):
        found = smoother_place(fit.state, fit.target, fit.z[0])
        if found is None:
            break
        place, (low, high) = found
        start, lower, upper = fit.space.start.copy(), fit.space.lower.copy(), fit.space.upper.copy()
        start[STRIKE], lower[STRIKE], upper[STRIKE] = place, low, high
        there = replace(fit.state, space=replace(fit.space, start=start, lower=lower, upper=upper))
        z, _, count = search_hammers(there, seed)
        other = likeliest(fit.state, z, seed)
        count += fit.evaluations + other.evaluations
        if not unlikely(other) < unlikely(fit):
            return replace(fit, evaluations=count)
        fit = replace(other, evaluations=count)
    return fit
