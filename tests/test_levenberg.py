"""Levenberg-Marquardt in a box, against SciPy's least squares and its own promises."""

from dataclasses import replace

import numpy as np
import pytest
from fit_cases import batched, exponential, rosenbrock, space, start_points
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import least_squares

from pianofit.fit.levenberg import descend
from pianofit.fit.space import SIZE, K, P, Space, default_box


def test_rosenbrocks_valley_is_followed_to_its_end():
    box = space([0, 1])
    end = descend(batched(rosenbrock), start_points(box, 12), box, iterations=200, tolerance=1e-12)
    assert end.settled.all()
    np.testing.assert_allclose(end.z[:, :2], 1.0, atol=1e-6)
    np.testing.assert_allclose(end.cost, 0.0, atol=1e-12)


def scipy_minimum(box, function, free: list[int], z: np.ndarray) -> tuple[np.ndarray, float]:
    """The same problem in the logarithms of the natural values, where the box is a box."""

    def residual(x):
        values = box.start.copy()
        values[free] = np.exp(x)
        return function(box.z(values))

    natural = box.values(z)[free]
    bounds = np.log(box.lower[free]), np.log(box.upper[free])
    inside = np.clip(np.log(natural), bounds[0] + 1e-3, bounds[1] - 1e-3)
    found = least_squares(residual, inside, bounds=bounds, xtol=1e-14, ftol=1e-14, gtol=1e-14, max_nfev=2000)
    return np.exp(found.x), found.cost


@pytest.mark.parametrize(
    "edge", [{}, {"upper": (0, 1.5)}, {"lower": (2, 0.5)}, {"upper": (1, 0.5), "lower": (3, 0.25)}], ids=str
)
def test_the_minimum_in_a_box_is_scipys(edge):
    free = [0, 1, 2, 3]
    box = space(free)
    for side, (index, value) in edge.items():
        moved = getattr(box, side).copy()
        moved[index] = value
        box = replace(box, **{side: moved})
    z = start_points(box, 6)
    end = descend(batched(exponential), z, box, iterations=100, tolerance=1e-12)
    values, cost = scipy_minimum(box, exponential, free, z[0])
    best = int(np.argmin(end.cost))
    assert end.cost[best] == pytest.approx(cost, rel=1e-6)
    np.testing.assert_allclose(box.values(end.z[best])[free], values, rtol=1e-3)
    for side, (index, value) in edge.items():
        assert box.values(end.z[best])[index] == pytest.approx(value, rel=1e-6), side


@pytest.mark.parametrize("bound", [(K, "upper", 2.0), (K, "lower", 4.0), (P, "upper", 1.5), (P, "lower", 2.4)], ids=str)
def test_a_bound_on_the_felt_holds_although_its_force_is_searched(bound):
    index, side, value = bound
    log_u = -7.0
    box = space([K, P], log_u=log_u)
    edge = getattr(box, side).copy()
    edge[index] = value
    box = replace(box, **{side: edge})

    def felt(z):  # the force of K_H = 3, p = 2 at some compressions about the reference
        u = np.linspace(-0.4, 0.4, 9)
        return z[K] + u * np.exp(z[P]) - (np.log(3.0) + 2.0 * (log_u + u))

    z = start_points(box, 5)
    end = descend(batched(felt), z, box, iterations=100, tolerance=1e-12)
    values, cost = scipy_minimum(box, felt, [K, P], z[0])
    np.testing.assert_allclose(end.cost, cost, rtol=1e-5)
    np.testing.assert_allclose(box.values(end.z)[:, [K, P]], np.tile(values, (5, 1)), rtol=1e-4)


@settings(max_examples=60)
@given(st.integers(0, 2**32 - 1))
def test_costs_never_rise_and_no_point_outside_the_box_is_tried(seed):
    random = np.random.default_rng(seed)
    free = sorted(random.choice(SIZE, 4, replace=False).tolist())
    box = space(free, low=-1.0, high=0.5, log_u=float(random.uniform(-8, 0)))
    slope, bend = random.normal(size=(6, SIZE)), 0.3 * random.normal(size=(6, SIZE, SIZE))
    target = random.normal(size=6)

    def function(z):
        return slope @ z + np.einsum("rij,i,j->r", bend, z, z) - target

    z, seen, before = start_points(box, 3, seed), [], np.inf
    for iterations in (0, 1, 2, 5, 20):
        end = descend(batched(function, seen), z, box, iterations=iterations)
        assert (end.cost <= before).all()
        before = end.cost
        np.testing.assert_allclose(end.cost, [0.5 * (function(row) ** 2).sum() for row in end.z])
    values = box.values(np.concatenate(seen))
    fixed = ~box.free
    assert (values >= box.lower - 1e-9 * np.abs(box.lower)).all()
    assert (values <= box.upper + 1e-9 * np.abs(box.upper)).all()
    np.testing.assert_allclose(values[:, fixed], np.tile(box.start[fixed], (len(values), 1)), rtol=1e-12)


def test_what_is_not_free_in_a_stage_stays_where_it_came_from():
    box = space([0, 1, 2, 3])
    z = start_points(box, 4)
    end = descend(batched(exponential), z, box, iterations=30, free=np.isin(np.arange(SIZE), [0, 2]))
    np.testing.assert_array_equal(end.z[:, [1, 3]], z[:, [1, 3]])
    assert (np.abs(end.z[:, [0, 2]] - z[:, [0, 2]]) > 1e-6).all()


def test_where_there_is_no_finite_residual_is_no_place_to_go():
    def walled(z):
        return rosenbrock(z) if z[0] < 1.2 else np.full(2, np.nan)

    box = space([0, 1])
    z = box.project(np.pad([[0.0, 2.0], [1.1, -2.0], [2.0, 2.0]], ((0, 0), (0, SIZE - 2))))
    end = descend(batched(walled), z, box, iterations=300, tolerance=1e-12)
    np.testing.assert_allclose(end.z[:2, :2], 1.0, atol=1e-5)
    assert end.cost[2] == np.inf


def test_starts_do_not_disturb_each_other():
    box = space([0, 1, 2, 3])
    z = start_points(box, 5)
    together = descend(batched(exponential), z, box, iterations=7, tolerance=0.0)
    for row in range(5):
        alone = descend(batched(exponential), z[row : row + 1], box, iterations=7, tolerance=0.0)
        np.testing.assert_allclose(alone.z[0], together.z[row], rtol=1e-9, atol=1e-12)


def test_an_unfinished_descent_says_so():
    box = space([0, 1])
    z = box.project(np.pad([[-1.2, 1.0]], ((0, 0), (0, SIZE - 2))))
    assert not descend(batched(rosenbrock), z, box, iterations=2).settled[0]


def test_a_result_on_a_bound_is_the_bound_to_the_last_digit():
    lower, upper = default_box(1.0, 0.02)
    box = Space(lower, upper, np.ones(SIZE, bool), np.sqrt(np.abs(lower * upper)), np.full(SIZE, np.inf), -7.8)
    for edge in (lower, upper):
        found = box.natural(box.z(edge))
        assert ((lower <= found) & (found <= upper)).all()
        np.testing.assert_allclose(found, edge, rtol=1e-12)
