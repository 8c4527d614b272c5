"""Laplace's approximation where it is exact, and the arithmetic of mixtures."""

from __future__ import annotations

import jax
import numpy as np
import pytest
from scipy.integrate import dblquad, quad
from table_cases import PHI, dense, evaluate_one, noise, point, shared, table

import pianofit.model  # noqa: F401  (float64)
from pianofit.inference.curvature import TablePoint, information_lost_to_weights
from pianofit.inference.hyperparameters import Quadratic, draw_hyperparameters
from pianofit.inference.laplace import Posterior, _inverse, _log_curvature
from pianofit.inference.likelihood import em_weights

HYPER = [0, 1, 2, 3, 4]
pytestmark = pytest.mark.usefixtures("float64")


def test_a_linear_gaussian_problem_is_described_exactly():
    """With nearly normal errors and a given φ the marginal of θ is Gaussian: the noise gives its precision."""
    known = PHI, np.full(5, 1e-5)
    t = table("no path")._replace(degrees_of_freedom=np.float64(1e9), censored=np.zeros((0, 2), int), prior=known)
    residual, _, theta = point("no path")
    w, jacobian = np.ones_like(residual), np.random.default_rng(5).normal(size=(*residual.shape, len(theta)))
    size = len(theta)
    prior = Quadratic(np.zeros(1), np.zeros((1, size)), np.zeros((1, size, size)))
    at = TablePoint(t, residual, jacobian, PHI, w, theta, HYPER)
    found = draw_hyperparameters([at], prior, np.eye(size))[0].curvature
    detected = np.asarray(t.detected).ravel() > 0
    covariance = (shared(t, PHI, (0, 0), theta) + np.diag(noise(t, PHI).ravel()))[np.ix_(detected, detected)]
    rows = jacobian.reshape(-1, size)[detected]
    expected = rows.T @ np.linalg.solve(covariance, rows)
    np.testing.assert_allclose(found, np.broadcast_to(expected, found.shape), rtol=1e-3)
    assert np.abs(information_lost_to_weights(at)).max() < 1e-6 * np.abs(expected).max()


@pytest.mark.parametrize("slope", [0.0, 0.3, 2.0, 40.0])
@pytest.mark.parametrize("curvature", [1e-6, 1.0, 50.0])
def test_at_a_bound_half_a_parabola_is_integrated(slope, curvature):
    inward = quad(lambda t: np.exp(-slope * t - 0.5 * curvature * t**2), 0, 10 / max(slope, np.sqrt(curvature)))[0]
    assert np.exp(-0.5 * _log_curvature(slope, curvature)) == pytest.approx(inward / np.sqrt(2 * np.pi), rel=1e-3)


@pytest.mark.parametrize("gradient", [(0.0, 0.5), (0.5, 0.5), (-0.8, 0.5)])
@pytest.mark.parametrize("inward", [1, -1])
def test_at_a_bound_the_free_parameters_follow(gradient, inward):
    """The mass of a quadratic F over a half plane, by quadrature: a free parameter, and one at a bound."""
    precision, gradient = np.array([[2.0, 1.2 * inward], [1.2 * inward, 1.5]]), np.array(gradient) * (1, inward)

    def density(t: float, x: float) -> float:
        at = np.array([x, inward * t])
        return np.exp(-gradient @ at - 0.5 * at @ precision @ at)

    covariance, log_det = _inverse(precision, np.array([0]), np.array([0, inward]), gradient)
    mass = dblquad(density, -12, 12, 0, 12)[0] / (2 * np.pi)
    assert 0.5 * (gradient @ covariance @ gradient - log_det) == pytest.approx(np.log(mass), abs=1e-6)


def lowest(shape: str):
    """A table, its Jacobian, and the residual and weights at the minimum of F."""
    t, residual, theta = table(shape), 3 * point(shape)[0], point(shape)[2]
    w, jacobian = np.ones_like(residual), np.random.default_rng(5).normal(size=(*residual.shape, len(theta)))
    for _ in range(40):
        found = evaluate_one(t, residual, jacobian, PHI, w, theta)
        gradient = found.gradient - found.by_covariance
        residual = residual - jacobian @ np.linalg.solve(found.curvature, -gradient)
        w = em_weights(t, found.by_log_w, w)
    return t, jacobian, residual, w, theta


@pytest.mark.parametrize("shape", ["two microphones", "ten nodes", "nothing absent"])
def test_weights_are_integrated_out(shape):
    """The Schur complement of a dense F's Hessian, by second differences.

    The curvature by θ alone is Gauss-Newton, which has its own test.
    """
    t, jacobian, residual, w, theta = lowest(shape)
    size = len(theta)
    known = evaluate_one(t, residual, jacobian, PHI, w, theta).curvature
    where = tuple(np.argwhere(np.asarray(t.detected) > 0).T)
    plain = jax.tree.map(np.asarray, t)

    def F(x: np.ndarray) -> float:
        weights = w.copy()
        weights[where] *= np.exp(x[size:])
        return dense(plain, residual - jacobian @ x[:size], PHI, weights, theta)

    H = hessian(F, size + len(where[0]))
    rest, cross = H[size:, size:], H[size:, :size]
    lost = information_lost_to_weights(TablePoint(t, residual, jacobian, PHI, w, theta, HYPER))
    np.testing.assert_allclose(lost, cross.T @ np.linalg.solve(rest, cross), rtol=3e-4, atol=3e-4)
    # Unknown w lower the precision of θ.
    assert np.linalg.eigvalsh(lost)[0] > -1e-9
    assert np.abs(lost).max() > 0.005 * np.abs(known).max()


def hessian(of, size: int) -> np.ndarray:
    """Second derivatives at 0, by central differences [size, size]."""
    step, H = 1e-3, np.zeros((size, size))
    e = step * np.eye(size)
    single = np.array([[of(x), of(-x)] for x in e])
    middle = of(np.zeros(size))
    for i in range(size):
        H[i, i] = single[i].sum() - 2 * middle
        for j in range(i):
            # of(x + y) + of(-x - y) without the terms of x and y alone
            H[i, j] = H[j, i] = 0.5 * (
                of(e[i] + e[j]) + of(-e[i] - e[j]) - single[i].sum() - single[j].sum() + 2 * middle
            )
    return H / step**2


def mixture() -> Posterior:
    random = np.random.default_rng(2)
    roots = random.normal(size=(3, 4, 4))
    covariance = np.einsum("bij,bkj->bik", roots, roots)
    return Posterior(3 * random.normal(size=(3, 4)), covariance, np.array([0.6, 0.3, 0.1]))


def test_an_interval_is_that_of_the_mixture():
    p, random, count = mixture(), np.random.default_rng(3), 400_000
    which = random.choice(3, size=count, p=p.weight)
    draws = np.stack([random.multivariate_normal(m, c, size=count) for m, c in zip(p.mean, p.covariance, strict=True)])
    draws = draws[which, np.arange(count)]
    for change in (np.eye(4)[0], np.array([1.0, -2.0, 0.0, 0.5])):
        low, high = p.interval(change)
        expected = np.quantile(draws @ change, [0.025, 0.975])
        np.testing.assert_allclose((low, high), expected, atol=0.02 * np.ptp(expected))


def test_minima_that_differ_make_a_value_as_vague_as_its_interval():
    separate = Posterior(np.array([[0.0], [4.0]]), np.full((2, 1, 1), 0.01), np.array([0.6, 0.4]))
    low, high = separate.interval(np.ones(1))
    assert separate.sd(np.ones(1)) == pytest.approx((high - low) / (2 * 1.96), rel=1e-4)
    assert separate.sd(np.ones(1)) > 1


def test_one_minimum_has_a_gaussian_interval_and_what_is_held_none():
    one = Posterior(np.array([[1.0, 2.0]]), np.array([[[0.04, 0.0], [0.0, 0.0]]]), np.ones(1))
    assert one.interval(np.array([1.0, 0.0])) == pytest.approx((1 - 1.96 * 0.2, 1 + 1.96 * 0.2), abs=1e-4)
    assert one.interval(np.array([0.0, 1.0])) is None
    assert one.sd(np.array([1.0, 7.0])) == pytest.approx(0.2, rel=1e-4)
    assert one.sd(np.array([0.0, 1.0])) == 0.0


def test_holding_a_sum_conditions_on_it():
    p, fixed_sum = mixture(), np.array([1.0, 0.0, -1.0, 0.0])
    fixed = p.condition_on(fixed_sum)
    for before, after in zip(p.covariance, fixed.covariance, strict=True):
        # Conditioned in coordinates with the sum as the first.
        turn = np.vstack([fixed_sum, np.eye(4)[1:]])
        c = turn @ before @ turn.T
        rest = c[1:, 1:] - np.outer(c[1:, 0], c[0, 1:]) / c[0, 0]
        back = np.linalg.inv(turn)[:, 1:]
        np.testing.assert_allclose(after, back @ rest @ back.T, atol=1e-12)
        assert fixed_sum @ after @ fixed_sum == pytest.approx(0.0, abs=1e-12)
    np.testing.assert_array_equal(fixed.mean, p.mean)
    np.testing.assert_array_equal(p.condition_on(np.zeros(4)).covariance, p.covariance)
