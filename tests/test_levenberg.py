"""Levenberg-Marquardt in a box, against SciPy's least squares and its own promises."""

import numpy as np
import pytest
from fit_cases import batched, cube, exponential, rosenbrock, start_points
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import least_squares

from pianofit.paper.levenberg import Box, descend


def test_rosenbrocks_valley_is_followed_to_its_end():
    box = cube(2)
    end = descend(batched(rosenbrock), start_points(box, 12), box, iterations=200, tolerance=1e-12)
    assert end.converged.all()
    np.testing.assert_allclose(end.z, 1.0, atol=1e-6)
    np.testing.assert_allclose(end.cost, 0.0, atol=1e-12)


@pytest.mark.parametrize(
    "edge", [{}, {"upper": (0, 1.5)}, {"lower": (2, 0.5)}, {"upper": (1, 0.5), "lower": (3, 0.25)}], ids=str
)
def test_the_minimum_in_a_box_is_scipys(edge):
    box = cube(4)
    for side, (index, value) in edge.items():
        getattr(box, side)[index] = np.log(value)
    z = start_points(box, 6)
    end = descend(batched(exponential), z, box, iterations=100, tolerance=1e-12)
    inside = np.clip(z[0], box.lower + 1e-3, box.upper - 1e-3)
    found = least_squares(exponential, inside, bounds=box, xtol=1e-14, ftol=1e-14, gtol=1e-14, max_nfev=2000)
    best = int(np.argmin(end.cost))
    assert end.cost[best] == pytest.approx(found.cost, rel=1e-6)
    np.testing.assert_allclose(end.z[best], found.x, atol=1e-3)
    for side, (index, _) in edge.items():
        assert end.z[best, index] == getattr(box, side)[index], side


@settings(max_examples=60)
@given(st.integers(0, 2**32 - 1), st.integers(1, 6))
def test_costs_never_rise_and_no_point_outside_the_box_is_tried(seed, size):
    """Where the box has no width nothing moves."""
    random = np.random.default_rng(seed)
    lower = random.uniform(-1, 0, size)
    box = Box(lower, lower + 1.5 * random.integers(0, 2, size))
    slope, bend = random.normal(size=(6, size)), 0.3 * random.normal(size=(6, size, size))
    target = random.normal(size=6)

    def function(z):
        return slope @ z + np.einsum("rij,i,j->r", bend, z, z) - target

    z, seen, before = random.uniform(-3, 3, (3, size)), [], np.inf
    for iterations in (0, 1, 2, 5, 20):
        end = descend(batched(function, seen), z, box, iterations=iterations)
        assert (end.cost <= before).all()
        before = end.cost
        np.testing.assert_allclose(end.cost, [0.5 * (function(row) ** 2).sum() for row in end.z])
    tried = np.concatenate(seen)
    assert ((tried >= box.lower) & (tried <= box.upper)).all()


def test_where_there_is_no_finite_residual_is_no_way_to_go():
    def walled(z):
        return rosenbrock(z) if z[0] < 1.2 else np.full(2, np.nan)

    z = np.array([[0.0, 2.0], [1.1, -2.0], [2.0, 2.0]])
    end = descend(batched(walled), z, cube(2), iterations=300, tolerance=1e-12)
    np.testing.assert_allclose(end.z[:2], 1.0, atol=1e-5)
    assert end.cost[2] == np.inf


def test_starts_do_not_disturb_each_other():
    box = cube(4)
    z = start_points(box, 5)
    together = descend(batched(exponential), z, box, iterations=7, tolerance=0.0)
    for row in range(5):
        alone = descend(batched(exponential), z[row : row + 1], box, iterations=7, tolerance=0.0)
        np.testing.assert_allclose(alone.z[0], together.z[row], rtol=1e-9, atol=1e-12)


def test_an_unfinished_descent_says_so():
    assert not descend(batched(rosenbrock), np.array([[-1.2, 1.0]]), cube(2), iterations=2).converged[0]
