"""Hammers judged by their levels alone, velocities, gains and path unknown."""

from __future__ import annotations

import numpy as np
import pytest
from pianofit.fit.hammers import _starts
from pianofit.fit.recipe import _prepared
from pianofit.fit.screen import FASTEST, SLOWEST, quadratic, screened
from pianofit.fit.screen import VELOCITIES as TRIED
from pianofit.fit.space import NAMES
from pianofit.fit.takes import arranged
from test_takes import VELOCITIES, setup, takes
from twin_cases import FIRST

from pianofit.setup_file import Take

STEP = (FASTEST - SLOWEST) / (TRIED - 1)


def test_the_true_hammer_comes_first_with_the_velocities_of_its_takes():
    """All takes have the same peak, so loudness says nothing; that of the first of them, the hardest, is known."""
    ordered, start, layout, order = arranged(*takes(), setup())
    state = _prepared(ordered, start, layout)
    z = _starts(state, 64, seed=0)
    z[-1] = true_point(state, VELOCITIES[order[0]])[0]
    z[:, :4] = z[-1, :4]
    best = screened(state, z)
    np.testing.assert_array_equal(best[0, 4:9], z[-1, 4:9])
    true = np.log(np.array(VELOCITIES)[order] / VELOCITIES[order[0]])
    np.testing.assert_allclose(best[0, layout.ratio], true, atol=0.75 * STEP)
    assert best.shape == z.shape
    np.testing.assert_array_equal(np.sort(best[:, 4]), np.sort(z[:, 4]))


def test_a_soft_take_whose_velocity_is_known_may_come_first():
    ordered, start, layout, order = arranged(*takes(), setup(Take(file="take-0.wav", v_H0=VELOCITIES[0])))
    assert order[0] == 0
    state = _prepared(ordered, start, layout)
    z = true_point(state, VELOCITIES[0])
    best = screened(state, z)
    true = np.log(np.array(VELOCITIES)[order] / VELOCITIES[0])
    np.testing.assert_allclose(best[0, layout.ratio], true, atol=0.75 * STEP)


def test_known_velocities_are_kept_to_the_digit():
    known = (Take(file=f"take-{i}.wav", v_H0=v) for i, v in enumerate(VELOCITIES))
    ordered, start, layout, _ = arranged(*takes(), setup(*known))
    state = _prepared(ordered, start, layout)
    z = true_point(state, VELOCITIES[2])
    softer = z.copy()
    softer[:, NAMES.index("K_H")] -= np.log(2.0)
    best = screened(state, np.concatenate([softer, z]))
    np.testing.assert_array_equal(best[0], z[0])


@pytest.mark.parametrize("gains", [(0, 1, 2, 3), (0, 0, 2, 2)])
@pytest.mark.parametrize("groups", [(0, 0, 0, 0), (0, 1, 0, 1), None])
def test_gains_and_path_leave_what_least_squares_leave(gains, groups):
    random = np.random.default_rng(3)
    weight = random.uniform(0.5, 2.0, (4, 12))
    weight[1, 5:], weight[3, 3:] = 0.0, 0.0  # soft takes have few partials
    rest = random.normal(0, 5, (4, 12)) + 40.0 * np.arange(4)[:, None]
    flat = rest.ravel()
    form = quadratic(weight, gains, groups)
    assert flat @ form @ flat == pytest.approx(_least(rest, weight, gains, groups), rel=1e-9)


def test_a_blow_alone_on_its_path_keeps_its_velocity():
    """A level of its own for each partial explains any hammer."""
    known = [Take(file=f"take-{i}.wav", group="near" if i else "far") for i in range(3)]
    ordered, start, layout, order = arranged(*takes(), setup(*known))
    state = _prepared(ordered, start, layout)
    z = np.repeat(true_point(state, VELOCITIES[2]), 3, axis=0)
    lone = order.index(0)
    z[:, layout.ratio[lone]] = [-0.3, -0.7, -1.1]
    best = screened(state, z)
    assert sorted(best[:, layout.ratio[lone]]) == [-1.1, -0.7, -0.3]


def true_point(state, velocity: float) -> np.ndarray:
    """The point [1, size] of the twin's string and hammer, struck at `velocity` first, its other velocities unknown."""
    values = state.space.start.copy()
    values[: len(FIRST.values)] = [FIRST.values[name] for name in NAMES[: len(FIRST.values)]]
    values[NAMES.index("v_H0")] = velocity
    return state.space.z(values)[None]


def _least(rest: np.ndarray, weight: np.ndarray, gains: tuple[int, ...], groups: tuple[int, ...] | None) -> float:
    """The weighted sum of squares when gains, and a level for each partial and group, are fitted: by `lstsq`."""
    takes, rows = rest.shape
    columns = []
    for gain in set(gains):
        column = np.zeros((takes, rows))
        column[[take for take in range(takes) if gains[take] == gain]] = 1.0
        columns.append(column.ravel())
    for group in set(groups or ()):
        for row in range(rows):
            column = np.zeros((takes, rows))
            column[[take for take in range(takes) if groups and groups[take] == group], row] = 1.0
            columns.append(column.ravel())
    root = np.sqrt(weight).ravel()
    matrix, data = np.stack(columns, axis=1) * root[:, None], rest.ravel() * root
    found = np.linalg.lstsq(matrix, data, rcond=None)[0]
    return float(((data - matrix @ found) ** 2).sum())
