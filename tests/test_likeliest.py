"""Which of several hammers is followed to the end, and that a race leads to one."""

from __future__ import annotations

import functools

import numpy as np
import pytest
from pianofit.fit.hammers import RACE, search_hammers
from pianofit.fit.joint import Fit, unlikely
from pianofit.fit.likeliest import likeliest
from pianofit.fit.recipe import _prepared
from pianofit.fit.space import NAMES
from pianofit.fit.state import State
from pianofit.fit.takes import arranged
from test_screen import true_point
from test_takes import VELOCITIES, setup, takes
from twin_cases import FIRST

M = NAMES.index("M_H")


@functools.cache
def state_and_truth() -> tuple[State, np.ndarray]:
    ordered, start, layout, order = arranged(*takes(), setup())
    state = _prepared(ordered, start, layout)
    return state, true_point(state, VELOCITIES[order[0]])


@functools.cache
def followed(*masses: float) -> Fit:
    """From the true hammer, but of these masses, in units of its own."""
    state, true = state_and_truth()
    hammers = np.repeat(true, len(masses), axis=0)
    hammers[:, M] += np.log(masses)
    return likeliest(state, state.space.project(hammers), seed=0)


def test_the_likeliest_hammer_is_kept_wherever_it_stood():
    astray, kept = followed(4.0), followed(4.0, 1.0)
    assert unlikely(astray) > unlikely(kept) + 10
    assert abs(np.log(astray.values[M] / FIRST.hammer.M_H)) > 0.3
    assert kept.values[M] == pytest.approx(FIRST.hammer.M_H, rel=0.2)


def test_a_race_that_ends_at_one_place_returns_one_hammer():
    state, true = state_and_truth()
    z, agreeing, _ = search_hammers(state, seed=0)
    assert z.shape == true.shape
    assert agreeing == RACE[-1][-1]
    assert np.exp(z[0, M]) == pytest.approx(FIRST.hammer.M_H, rel=0.2)
