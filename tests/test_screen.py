"""Hammers judged by their levels alone, velocities, gains and path unknown."""

from __future__ import annotations

import numpy as np
import pytest
from test_takes import VELOCITIES, setup, takes
from twin_cases import FIRST

from pianofit.fit.hammers import _starts
from pianofit.fit.recipe import _prepared
from pianofit.fit.screen import GRID, _Levels, screened
from pianofit.fit.space import NAMES
from pianofit.fit.takes import arranged

STEP = GRID[1] - GRID[0]


def test_the_true_hammer_comes_first_with_the_velocities_of_its_takes():
    """All takes have the same peak, so loudness says nothing; that of the first of them, the hardest, is known."""
    ordered, start, layout, order = arranged(*takes(), setup())
    state = _prepared(ordered, start, layout)
    values = state.space.start.copy()
    values[: len(FIRST.values)] = [FIRST.values[name] for name in NAMES[: len(FIRST.values)]]
    values[NAMES.index("v_H0")] = VELOCITIES[order[0]]
    z = _starts(state, 64, seed=0)
    z[-1] = state.space.z(values)
    z[:, :4] = z[-1, :4]
    best = screened(state, z)
    np.testing.assert_array_equal(best[0, 4:9], z[-1, 4:9])
    true = np.log(np.array(VELOCITIES)[order] / VELOCITIES[order[0]])
    np.testing.assert_allclose(best[0, layout.ratio], true, atol=0.75 * STEP)
    assert best.shape == z.shape
    np.testing.assert_array_equal(np.sort(best[:, 4]), np.sort(z[:, 4]))


@pytest.mark.parametrize("groups", [(0, 0, 0), (0, 1, 0, 1)])
def test_gains_and_path_leave_what_least_squares_leave(groups):
    random = np.random.default_rng(3)
    takes, rows = len(groups), 9
    level, model = random.normal(0, 5, (takes, rows)), random.normal(0, 5, (2, 4, rows))
    weight = random.uniform(0.5, 2.0, (takes, rows))
    weight[0, -1] = 0.0  # a partial that one take has not
    levels, chosen = _Levels(level, weight, np.array(groups)), random.integers(0, 4, (2, takes))
    assert levels.cost(model, chosen) == pytest.approx(
        [_least(level - model[hammer][chosen[hammer]], weight, groups) for hammer in range(2)], rel=0.02
    )


def test_a_take_alone_suits_every_velocity():
    """Through a path that no other take shares a level of its own for each partial explains any hammer."""
    random = np.random.default_rng(4)
    levels = _Levels(random.normal(0, 5, (3, 6)), np.ones((3, 6)), np.array([0, 0, 1]))
    model = random.normal(0, 5, (2, 4, 6))
    np.testing.assert_allclose(levels.suits(2, np.array([2]), model, np.zeros((2, 3), int)), 0.0)
    assert levels.suits(1, np.array([1]), model, np.zeros((2, 3), int)).min() > 1.0


def _least(rest: np.ndarray, weight: np.ndarray, groups: tuple[int, ...]) -> float:
    """Half the weighted sum of squares when a gain a take and a level a partial and group are fitted: by `lstsq`."""
    takes, rows = rest.shape
    design = np.zeros((takes, rows, takes + rows * (max(groups) + 1)))
    for take, group in enumerate(groups):
        design[take, :, take] = 1.0
        design[take, np.arange(rows), takes + rows * group + np.arange(rows)] = 1.0
    root = np.sqrt(weight).ravel()
    matrix, data = design.reshape(takes * rows, -1) * root[:, None], rest.ravel() * root
    found = np.linalg.lstsq(matrix, data, rcond=None)[0]
    return 0.5 * float(((data - matrix @ found) ** 2).sum())
