"""What the stages of a fit share: the takes, where they are searched, and how much each residual weighs there.

A real string scatters about any model by more than its noise. How much it does is read off the residuals, for
frequencies, decays and levels apart; levels of several takes through one path scatter in two ways, each for itself and
all alike, and the second is the path's own.
"""

from __future__ import annotations

import functools
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import jax.numpy as jnp
import numpy as np

from ..criterion import PATH_SPREAD
from ..initial import Start
from ..parameters import FELT_LAWS, MEMORY_NAMES, PARAMETERS
from .levenberg import in_groups
from .misfit import huber, scatter
from .residuals import CENT, Cfg, Target, joint_batch
from .space import ABSENT, LOG, NAMES, Layout, Space, default_box
from .takes import Take
from .target import Spreads, Takes, straying, target

__all__ = [
    "ROUGHER",
    "TOGETHER",
    "State",
    "level_freedom",
    "pool",
    "predicted",
    "search_space",
    "settled_weights",
]

# Hammers that are evaluated by one call. Evaluating more at once gains little, and what has settled would go along.
TOGETHER = 4
# The model's window, of an effective width, is a stand-in all the same: levels through it are off by about this much,
# dB, however well they can be fitted.
STAND_IN = 0.01
# No real path is as smooth as the model's, dB; a few partials would otherwise be fitted to the last digit. What several
# takes through one path differ by is known better.
LEAST_SCATTER, LEAST_OWN = 1.0, 0.2
# Before the first round the model is taken to miss a partial by this much, dB: calibrated, one take, and several, whose
# path is then rough by so much more.
FIRST_SCATTER, FIRST_OWN, FIRST_ROUGH = {True: 1.0, False: 4.0}, 1.0, 18.0
# What takes have in common says less of the hammer than its scatter about the smooth path would have it: neighbouring
# partials leave it together, and hammer and path have been bent to take what they can. So the path is held to be this
# much rougher than is seen; without it hammers predict other velocities worse.
ROUGHER = 3.0
# How far the velocities of takes may be from their guesses, log, and their pitches from the first's, cents.
RATIO_SPREAD, CENTS_SPREAD = 0.5, 3.0


def search_space(start: Start, takes: Sequence[Take], layout: Layout) -> Space:
    """The box and the starting point [size]; gain and path start at 0 dB."""
    lower, upper = default_box(start.geometry.length, start.geometry.width, layout)
    speed = PARAMETERS["v_H0"]
    lower[layout.ratio] = np.log(speed.lower / start.values["v_H0"])
    upper[layout.ratio] = np.log(speed.upper / start.values["v_H0"])
    for name, (low, high) in start.bounds.items():
        lower[NAMES.index(name)], upper[NAMES.index(name)] = low, high
    values, spread = np.zeros(layout.size), np.full(layout.size, np.inf)
    values[:LOG] = [start.values[n] for n in NAMES]
    values[layout.ratio] = np.log([take.ratio for take in takes])
    spread[:LOG] = [start.spread[n] for n in NAMES]
    spread[layout.ratio], spread[layout.cents], spread[layout.path] = RATIO_SPREAD, CENTS_SPREAD, PATH_SPREAD
    calibrated, known = start.scale is not None, start.quantity != "pressure"
    free = np.zeros(layout.size, bool)
    free[:LOG] = [n not in start.fixed for n in NAMES]
    absent = np.isin(NAMES, ("mu", *MEMORY_NAMES)) & ~np.isin(NAMES, FELT_LAWS[start.felt])
    values[:LOG][absent], free[:LOG] = ABSENT, free[:LOG] & ~absent
    free[layout.gain], free[layout.path] = not calibrated, not (calibrated or known)
    later = np.array(layout.strikes) > 0  # a take that shares the first's blow has nothing of its own
    free[layout.ratio[later]] = [not take.ratio_known for take, own in zip(takes, later, strict=True) if own]
    free[layout.cents[later]] = True
    lower, upper = np.where(free, lower, values), np.where(free, upper, values)
    return Space(lower, upper, free, np.clip(values, lower, upper), spread, 0.0)


@dataclass(frozen=True)
class State:
    """What the stages after the string's share."""

    data: Takes
    start: Start
    space: Space
    rate: float
    delay: np.ndarray
    cfg: Cfg
    criterion: float
    more: np.ndarray | float = 0.0  # dB, [takes, rows]: what is added to the model's levels

    @property
    def unweighted(self) -> np.ndarray:
        """Huber's factors before anything is known [3, takes, rows]."""
        return np.ones((3, *self.data.found.shape))

    @property
    def least_scatter(self) -> float:
        """The scatter of levels, dB, below which no model is to be believed."""
        if self.start.quantity == "pressure":
            return LEAST_SCATTER if self.data.layout.takes == 1 else LEAST_OWN
        return STAND_IN

    def first_spread(self, frequency: float, decay: float) -> Spreads:
        """Scatter before anything is known."""
        if self.data.calibrated or self.data.layout.takes == 1:
            return Spreads(frequency, decay, FIRST_SCATTER[self.data.calibrated])
        return Spreads(frequency, decay, FIRST_OWN, FIRST_ROUGH)

    def target(self, spread: Spreads, robust: np.ndarray, grade: float = 0.0) -> Target:
        """The recording, weighted."""
        return target(
            self.data, self.start, self.space, spread, robust, rate=self.rate, delay=self.delay, grade=grade,
            criterion=self.criterion, more=self.more,
        )  # fmt: skip

    def evaluate(self, function: Callable, at: Target) -> Callable:
        """Residuals and Jacobians at search points [starts, size], of a batch function.

        Many starts go `TOGETHER` at a time, on all cores, so that any number of them shares one compiled program.
        """

        def some(z: np.ndarray) -> tuple:
            return tuple(np.asarray(x) for x in function(jnp.asarray(z), at, self.cfg))

        return some if function is joint_batch else in_groups(some, TOGETHER, pool().map)


@functools.cache
def pool() -> ThreadPoolExecutor:
    """As many threads as this process may use cores: XLA works outside of Python's lock."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return ThreadPoolExecutor(cores)


def settled_weights(state: State, at: Target, z: np.ndarray) -> tuple[Spreads, np.ndarray]:
    """Scatter of each kind of residual about the model at `z` [1, size], and Huber's factors."""
    data, found = state.data, state.data.found
    frequency, decay, level = np.moveaxis(predicted(at, state.cfg, z[0]), 1, 0)
    there = ~found  # lest what is not there be divided by its 0
    cent = (data.frequency + there) * CENT * straying(data.number)
    cents, cents_sd = (data.frequency - frequency) / cent, data.frequency_error / cent
    fade, fade_sd = (x / decay for x in (data.decay - decay, data.decay_error))
    own, common, noise, freedom = _own_and_common(state, data.level - level)
    # What a path that one take alone went through adds to its levels is no scatter of the take's own.
    scored = found & ~_lone(state)[:, None] if len(common) else found
    spread = Spreads(
        scatter(cents[found], cents_sd[found], 2),
        scatter(fade[found], fade_sd[found], 2),
        scatter((own / data.buried)[scored], (data.level_error / data.buried)[scored], freedom),
        ROUGHER * scatter(common, noise, 0) if len(common) else 0.0,
    )
    spread = replace(spread, level=max(spread.level, state.least_scatter))
    sd_level = np.hypot(data.level_error, spread.level * data.buried)
    if spread.rough > 0:
        sd_level = np.hypot(sd_level, spread.rough * _lone(state)[:, None])
    robust = np.stack(
        [
            huber(cents, np.hypot(cents_sd, spread.frequency)),
            huber(fade, np.hypot(fade_sd, spread.decay)),
            huber(own, sd_level),
        ]
    )
    return spread, robust


def _lone(state: State) -> np.ndarray:
    """Which takes [takes] are the only one of their group."""
    groups = np.array(state.data.layout.groups)
    return np.bincount(groups)[groups] == 1


def _own_and_common(state: State, miss: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """Level residuals [takes, rows], dB, split into each take's own and what takes of a group have in common.

    Returns the first, the second [partials of all groups] with its noise, and how many parameters the first was fitted
    with. A group of one take has nothing in common with another, nor has a calibrated recording a path.
    """
    data, found = state.data, state.data.found
    freedom = float(state.space.free[4:].sum())
    own, common, noise = np.where(found, miss, 0.0), [], []
    for group in range(max(data.layout.groups) + 1):
        mine = found & (np.array(data.layout.groups) == group)[:, None]
        several = mine.sum(axis=0) > 1
        if data.calibrated or mine.any(axis=1).sum() < 2:
            continue
        mean = np.where(mine, miss, 0.0).sum(axis=0) / np.maximum(mine.sum(axis=0), 1)
        own = np.where(mine, miss - mean, own)
        common.append(mean[several])
        noise.append(np.zeros(several.sum()))
        freedom += float(mine.any(axis=0).sum())
    join = np.concatenate if common else (lambda _: np.zeros(0))
    return own, join(common), join(noise), freedom


def level_freedom(state: State) -> int:
    """Levels less what is fitted to them: hammer, gains, paths, and every partial's own level in a group of takes."""
    _, common, _, spent = _own_and_common(state, np.zeros(state.data.found.shape))
    scored = state.data.found & ~_lone(state)[:, None] if len(common) else state.data.found
    return int(scored.sum() - spent)


def predicted(at: Target, cfg: Cfg, z: np.ndarray) -> np.ndarray:
    """Frequency, Hz, decay, 1/s, level, dB, of the partials [takes, 3, rows], with pitch, gain, path and noise."""
    value = np.array(joint_batch(jnp.asarray(z[None]), at, cfg)[2])[0]
    value[:, 0] *= 1 + CENT * (np.asarray(at.cents) @ z)[:, None]
    value[:, 2] = 10 * np.log10(
        10 ** ((value[:, 2] + np.asarray(at.more) + np.asarray(at.basis) @ z) / 10) + 10 ** (np.asarray(at.floor) / 10)
    )
    return value
