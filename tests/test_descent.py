"""Minimisation within bounds: gradient descent against theory and SciPy's minima, and least squares."""

from itertools import pairwise
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize

from pianofit.bensa2005.descent import STEP_GROWTH, STEP_REDUCTION, SUFFICIENT_DECREASE, LeastSquares, gradient_descent


def descended(evaluate, starts: np.ndarray, lower: np.ndarray, upper: np.ndarray, **how) -> Any:
    """Descend from every row of `starts`: one column for each field of the result; `evaluate` takes rows."""

    def single(theta):
        cost, gradient = evaluate(theta[None])
        return cost[0], gradient[0]

    ends = [gradient_descent(single, start, lower, upper, **how) for start in starts]
    return SimpleNamespace(**{name: np.array([getattr(end, name) for end in ends]) for name in ends[0]._fields})


def quadratic(hessian: np.ndarray, centre: np.ndarray, points: list | None = None):
    """½ (theta − centre)ᵀ H (theta − centre) and its gradient, for rows of theta."""

    def evaluate(theta):
        if points is not None:
            points.append(theta)
        gradient = (theta - centre) @ hessian
        return 0.5 * np.einsum("sn,sn->s", theta - centre, gradient), gradient

    return evaluate


def hessian(condition: float, size: int, seed: int) -> np.ndarray:
    axes = np.linalg.qr(np.random.default_rng(seed).normal(size=(size, size)))[0]
    return axes @ np.diag(np.geomspace(1.0, condition, size)) @ axes.T


@pytest.mark.parametrize("condition", [1.0, 10.0, 100.0])
@pytest.mark.parametrize("size", [1, 2, 5, 10])
def test_a_parabola_is_descended_at_the_rate_that_the_line_search_guarantees(condition, size):
    """An accepted step is at least (1 − SHARE)/L long, once one was too long; it gains SHARE of its prediction.

    So every accepted step lowers C by the factor 1 − 2 SHARE (1 − SHARE)/κ, and per accepted step there are at most
    ln LONGER/ln(1/SHORTER) rejected ones.
    """
    start = np.random.default_rng(size).uniform(-1, 1, (8, size))
    evaluate = quadratic(hessian(condition, size, 1), np.zeros(size))
    box = np.full(size, -10.0), np.full(size, 10.0)
    first = evaluate(start)[0]
    factor = 1 - 2 * SUFFICIENT_DECREASE * (1 - SUFFICIENT_DECREASE) / condition
    steps_per_taken = 1 + np.log(STEP_GROWTH) / np.log(1 / STEP_REDUCTION)
    for iterations in (50, 100, 300):
        end = descended(evaluate, start, *box, iterations=iterations, tolerance=0.0)
        bound = factor ** ((iterations - 20) / steps_per_taken)
        # A step of less than 1e-13 of the range is not counted; there the slope is still at most 3e-12 κ.
        assert (end.cost <= np.maximum(bound * first, 1e-22 * condition**2)).all()


@pytest.mark.parametrize("seed", range(6))
def test_the_minimum_in_a_box_is_scipys(seed):
    random = np.random.default_rng(seed)
    H, centre = hessian(20.0, 4, seed), random.uniform(-2, 2, 4)
    lower, upper = np.full(4, -1.0), random.uniform(-0.5, 1, 4)
    evaluate = quadratic(H, centre)
    start = random.uniform(lower, upper, (5, 4))
    end = descended(evaluate, start, lower, upper, iterations=2000, tolerance=1e-14)
    expected = minimize(
        lambda theta: tuple(x[0] for x in evaluate(theta[None])), start[0], jac=True, method="L-BFGS-B",
        bounds=list(zip(lower, upper, strict=True)), options={"ftol": 1e-15, "gtol": 1e-12},
    )  # fmt: skip
    assert end.converged.all()
    np.testing.assert_allclose(end.cost, expected.fun, rtol=1e-9)
    np.testing.assert_allclose(end.z, np.tile(expected.x, (5, 1)), atol=1e-5)


@settings(max_examples=80)
@given(st.integers(0, 2**32 - 1), st.integers(1, 6))
def test_costs_never_rise_and_no_point_outside_the_box_is_tried(seed, size):
    """Also where the gradient is wrong, the cost has cliffs, and parts of the box have no finite cost."""
    random = np.random.default_rng(seed)
    wave, phase, wrong = random.normal(0, 3, (4, size)), random.uniform(0, 7, 4), random.normal(0, 1, (size, size))
    lower = random.uniform(-2, 0, size)
    upper = lower + random.uniform(0, 3, size) * random.integers(0, 2, size)
    points = []

    def evaluate(theta):
        points.append(theta)
        cost = np.cos(theta @ wave.T + phase).sum(axis=1) + np.floor(3 * theta.sum(axis=1))
        gradient = -np.sin(theta @ wave.T + phase) @ wave + 0.3 * theta @ wrong
        return np.where(np.cos(5 * theta[:, 0]) > 0.9, np.nan, cost), gradient

    start = random.uniform(-3, 3, (4, size))
    before = np.full(4, np.inf)
    for iterations in (0, 1, 2, 5, 30):
        end = descended(evaluate, start, lower, upper, iterations=iterations)
        assert (end.cost <= before).all()
        before = end.cost
        value = evaluate(end.z)[0]
        np.testing.assert_allclose(np.where(np.isfinite(value), value, np.inf), end.cost, rtol=1e-12, atol=1e-12)
    tried = np.concatenate(points)
    assert ((tried >= lower) & (tried <= upper)).all()
    held = lower == upper
    np.testing.assert_array_equal(end.z[:, held], np.tile(lower[held], (4, 1)))


def test_every_step_taken_brings_its_share_of_what_the_slope_foretold():
    """Rosenbrock's function, where a step that lowers C to first order only can raise C."""

    def rosenbrock(theta):
        x, y = theta.T
        return (1 - x) ** 2 + 100 * (y - x**2) ** 2, np.stack(
            [-2 * (1 - x) - 400 * x * (y - x**2), 200 * (y - x**2)], axis=1
        )

    start, box = np.array([[-1.2, 1.0], [1.5, -1.0]]), (np.full(2, -2.0), np.full(2, 2.0))
    ends = [descended(rosenbrock, start, *box, iterations=n, tolerance=0.0) for n in range(120)]
    for before, after in pairwise(ends):
        predicted = np.einsum("sn,sn->s", rosenbrock(before.z)[1], before.z - after.z)
        moved = (before.z != after.z).any(axis=1)
        assert (predicted[moved] > 0).all()
        assert (after.cost[moved] <= before.cost[moved] - SUFFICIENT_DECREASE * predicted[moved]).all()
    assert (ends[-1].cost < 0.2 * ends[0].cost).all()
    assert not ends[-1].converged.any()


def test_units_of_the_coordinates_and_of_the_cost_change_nothing():
    scale = 2.0 ** np.array([-20, 0, 30])
    H, centre = hessian(5.0, 3, 2), np.array([0.2, -0.4, 0.1])
    start, box = np.random.default_rng(3).uniform(-1, 1, (4, 3)), (np.full(3, -1.0), np.full(3, 1.0))
    plain = descended(quadratic(H, centre), start, *box, iterations=15)

    def in_other_units(theta):
        cost, gradient = quadratic(H, centre)(theta / scale)
        return 2.0**9 * cost, 2.0**9 * gradient / scale

    other = descended(in_other_units, start * scale, box[0] * scale, box[1] * scale, iterations=15)
    np.testing.assert_array_equal(other.z, plain.z * scale)
    np.testing.assert_array_equal(other.cost, plain.cost * 2.0**9)


def test_a_start_on_an_active_edge_does_not_hold_back_the_other_coordinates():
    """A slope of 1e9 against the bound does not limit the step along it."""

    def evaluate(theta):
        return 1e9 * theta[:, 0] + (theta[:, 1] - 0.7) ** 2, np.stack(
            [np.full(len(theta), 1e9), 2 * (theta[:, 1] - 0.7)], axis=1
        )

    end = descended(evaluate, np.array([[0.0, 0.0]]), np.zeros(2), np.ones(2), iterations=60, tolerance=0.0)
    np.testing.assert_allclose(end.z, [[0.0, 0.7]], atol=1e-9)


def test_where_there_is_no_finite_cost_is_no_place_to_go():
    def walled(theta):
        cost, gradient = quadratic(np.eye(2), np.array([1.0, 0.0]))(theta)
        return np.where(theta[:, 0] > 0.5, np.inf, cost), gradient

    box = np.full(2, -2.0), np.full(2, 2.0)
    end = descended(walled, np.array([[-1.0, 1.0], [1.0, 1.0]]), *box, iterations=300)
    assert end.z[0, 0] == pytest.approx(0.5, abs=1e-3)
    assert end.cost[1] == np.inf
    assert not end.converged[1]
    np.testing.assert_array_equal(end.z[1], [1.0, 1.0])


def test_a_descent_ends_when_it_is_done_and_says_so():
    points = []
    evaluate = quadratic(hessian(10.0, 3, 6), np.zeros(3), points)
    start, box = np.full((2, 3), 0.9), (np.full(3, -1.0), np.full(3, 1.0))
    assert not descended(evaluate, start, *box, iterations=2).converged.any()
    points.clear()
    end = descended(evaluate, start, *box, iterations=1000)
    assert end.converged.all()
    assert (end.cost <= 1e-4).all()
    assert len(points) == end.evaluations.sum() < 400
    flat = descended(lambda theta: (np.ones(1), np.zeros(theta.shape)), start, *box, iterations=1000)
    assert flat.converged.all()
    assert (flat.evaluations == 1).all()


def test_small_gains_of_the_first_small_steps_are_not_taken_for_the_end():
    """On an offset of 1e4 a gain of 1 is below this tolerance, and the first steps gain less."""

    def raised(theta):
        return 1e4 + 5 * theta[:, 0] ** 2, 10 * theta

    end = descended(raised, np.array([[0.9]]), -np.ones(1), np.ones(1), iterations=100, tolerance=1e-4)
    assert end.converged[0]
    assert end.cost[0] - 1e4 < 0.2


# --- least squares ----------------------------------------------------------------------------------------------------


def exponential(t: np.ndarray, data: np.ndarray, points: list, lower: np.ndarray, upper: np.ndarray) -> LeastSquares:
    """a exp(-b t) + c against `data`; the coordinates are the logarithms of a, b and c."""

    def residuals(theta):
        points.append(theta.copy())
        a, b, c = np.exp(theta).T[:, :, None]
        fall = a * np.exp(-b * t)
        return fall + c - data, np.stack([fall, -b * t * fall, np.broadcast_to(c, fall.shape)], axis=2)

    return LeastSquares(lambda theta: 0.5 * (residuals(theta)[0] ** 2).sum(axis=1), residuals, lower, upper)


def test_least_squares_find_what_made_the_data_and_lie_on_an_edge_exactly():
    t, true, points = np.linspace(0, 4, 30), np.log([2.0, 0.7, 0.3]), []
    lower, upper = np.full(3, -3.0), np.full(3, 3.0)
    problem = exponential(t, 2.0 * np.exp(-0.7 * t) + 0.3, points, lower, upper)
    end = problem.minimise(np.zeros(3), evaluations=100, tolerance=1e-14)
    np.testing.assert_allclose(end.z, true, atol=1e-6)
    assert end.converged
    held = problem._replace(lower=np.append(lower[:2], 0.1), upper=np.append(upper[:2], 0.1))
    assert held.minimise(np.zeros(3), evaluations=100).z[2] == 0.1
    upper[0], lower[1] = np.log(1.5), 0.0
    upper[1] = 0.0
    end = problem.minimise(np.zeros(3), evaluations=100)
    assert end.z[0] == upper[0]
    assert end.z[1] == 0.0
    tried = np.concatenate(points[-end.evaluations :])
    assert ((tried >= lower) & (tried <= upper)).all()
    assert end.cost == pytest.approx(problem.costs(end.z[None])[0])


def test_least_squares_from_a_wall_stay_there_and_unfinished_ones_say_so():
    def walled(theta):
        residual = np.where(theta > 0.5, np.inf, theta - 1.0)
        return residual, np.ones((1, 1, 1))

    problem = LeastSquares(lambda theta: 0.5 * (walled(theta)[0] ** 2).sum(axis=1), walled, np.zeros(1), np.ones(1))
    end = problem.minimise(np.ones(1), evaluations=50)
    assert (end.z[0], end.cost, end.converged) == (1.0, np.inf, False)
    near = problem.minimise(np.zeros(1), evaluations=50)
    assert 0.0 < near.z[0] <= 0.5
    t = np.linspace(0, 4, 30)
    short = exponential(t, 9.0 * np.exp(-3 * t) + 0.3, [], -np.ones(3), np.full(3, 9.0))
    assert not short.minimise(np.zeros(3), evaluations=2).converged
