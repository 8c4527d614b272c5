"""Hyperparameters are integrated over: few levels give Student's t, many give Laplace's Gaussian."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import quad

from pianofit.inference.curvature import TablePoint
from pianofit.inference.hyperparameters import Quadratic, draw_hyperparameters
from pianofit.inference.likelihood import ObservationTable

SPREAD = 3.0  # of the prior of log σ: the levels decide
STUDENT = 1e9  # the residuals are Gaussian


def linear_table(count: int, parameters: int, seed: int = 0) -> tuple[TablePoint, float]:
    """Levels y = J θ + e without path and gain, at the minimum of F by θ and log σ; and the residual sum of squares."""
    random = np.random.default_rng(seed)
    J = random.normal(size=(count, parameters))
    y = random.normal(size=count)
    residual = y - J @ np.linalg.lstsq(J, y, rcond=None)[0]
    square = float(residual @ residual)
    one = np.ones((1, count))
    prior_mean = 0.5 * np.log(square / count)  # then the minimum by log σ is the mean of its prior
    table = ObservationTable(
        value=y[None], variance=0 * one, detected=one, censored=np.zeros((0, 2), int), group=np.ones((1, 1)),
        columns=0 * one[None], scale=np.ones((1, 1)), systematic=np.zeros((count, count)),
        distance_octaves=np.abs(np.subtract.outer(np.arange(count), np.arange(count))) + 0.0,
        has_unknown_path=np.zeros(1), log_tau=np.full((1, 1), -50.0), log_weight=np.zeros((1, 1)),
        excess_profile=np.ones(count), smooth_profile=np.ones(count), pitch=0 * one,
        ratio=0 * one,
        prior=(np.array([prior_mean, 0.0, 0.0, -50.0, -50.0]), np.array([SPREAD, 1.0, 1.0, 1.0, 1.0])),
        velocity=np.zeros((1, parameters)), degrees_of_freedom=np.float64(STUDENT),
    )  # fmt: skip
    phi = np.array([prior_mean, 0.0, 0.0, -50.0, -50.0])
    return TablePoint(table, residual[None], J[None], phi, one, np.zeros(parameters), [0, 1, 2, 3, 4]), square


def posterior_mean(point: TablePoint, of) -> float:
    """Mean of a function of the draws' F over p(φ | data)."""
    size = len(point.theta)
    prior = Quadratic(np.zeros(1), np.zeros((1, size)), np.zeros((1, size, size)))
    F, negative_log_proposal = draw_hyperparameters([point], prior, np.eye(size))
    gain = np.einsum("ni,ni->n", F.gradient, np.linalg.solve(F.curvature, F.gradient[..., None])[..., 0])
    log_weight = negative_log_proposal - F.value + 0.5 * (gain - np.linalg.slogdet(F.curvature)[1])
    weight = np.exp(log_weight - log_weight.max())
    return float(weight @ [of(curvature) for curvature in F.curvature] / weight.sum())


def mean_variance(count: int, parameters: int) -> tuple[float, float]:
    """Mean of σ² over the draws, and exactly, from p(σ | y) ∝ σ^-(n - k) exp(-S/2σ²) p(log σ)."""
    point, square = linear_table(count, parameters)
    gram = point.jacobian[0].T @ point.jacobian[0]
    centre = point.phi[0]

    def density(x: float) -> float:
        return float(np.exp(-(count - parameters) * (x - centre) - 0.5 * square * (np.exp(-2 * x) - np.exp(-2 * centre))
                            - 0.5 * ((x - centre) / SPREAD) ** 2))  # fmt: skip

    total, weighted = (
        quad(
            lambda x, power=power: density(x) * np.exp(power * x), centre - 8, centre + 20, limit=500, points=[centre]
        )[0]
        for power in (0, 2)
    )
    found = posterior_mean(point, lambda own: np.trace(gram @ np.linalg.inv(own)) / parameters)
    return found, weighted / total


@pytest.mark.parametrize(("count", "parameters"), [(300, 3), (60, 6), (30, 12), (24, 14)])
def test_the_variance_of_the_parameters_is_that_of_the_exact_integral(count, parameters):
    found, exact = mean_variance(count, parameters)
    assert found == pytest.approx(exact, rel=0.1)


def test_few_levels_widen_intervals_by_the_degrees_of_freedom():
    found, _ = mean_variance(24, 14)
    _, square = linear_table(24, 14)
    assert found > 1.5 * square / 24  # the value at the minimum of F
    many, _ = mean_variance(300, 3)
    assert many == pytest.approx(linear_table(300, 3)[1] / 297, rel=0.05)


def test_a_smooth_deviation_that_parameters_follow_has_the_size_of_the_exact_integral():
    """The deviation of a string from its model: two parameters follow most of it, so A is too small at the minimum."""
    count, error, length = 20, 0.05, 0.7
    octave = np.log2(np.arange(1, count + 1))
    d = np.sqrt(3) * np.abs(np.subtract.outer(octave, octave)) / length
    matern, number = (1 + d) * np.exp(-d), np.arange(1, count + 1) / count
    J = np.stack([np.ones(count), number**2], axis=1)
    y = np.linalg.cholesky(matern + 1e-9 * np.eye(count)) @ np.random.default_rng(3).normal(size=count)
    point, _ = linear_table(count, 2)
    one, wide = np.ones((1, count)), np.array([1e-3, 1.5, 1e-3, 1.0, 1.0])

    def marginal(log_size: float) -> tuple[float, np.ndarray, np.ndarray, float]:
        """log p(y | A) p(A), with a flat prior of θ; the precision of θ, θ, and its F."""
        C = np.exp(2 * log_size) * matern + (error**2 + 1e-10) * np.eye(count)
        solved = np.linalg.solve(C, np.column_stack([J, y]))
        precision = J.T @ solved[:, :2]
        theta = np.linalg.solve(precision, J.T @ solved[:, 2])
        F = 0.5 * (y - J @ theta) @ np.linalg.solve(C, y - J @ theta) + 0.5 * np.linalg.slogdet(C)[1]
        F += 0.5 * (log_size / wide[1]) ** 2
        return -F - 0.5 * np.linalg.slogdet(precision)[1], precision, theta, F

    sizes = np.linspace(-5, 5, 1001)
    every = [marginal(x) for x in sizes]
    best = int(np.argmin([own[3] for own in every]))
    mass = np.exp([own[0] - max(o[0] for o in every) for own in every])
    exact = float(mass @ [np.linalg.inv(own[1])[0, 0] for own in every] / mass.sum())
    at_minimum = float(np.linalg.inv(every[best][1])[0, 0])
    phi = np.array([-50.0, sizes[best], np.log(length), -50.0, -50.0])
    table = point.table._replace(
        value=y[None], variance=error**2 * one, distance_octaves=np.abs(np.subtract.outer(octave, octave)),
        has_unknown_path=np.ones(1), prior=(np.array([-50.0, 0.0, np.log(length), -50.0, -50.0]), wide),
    )  # fmt: skip
    point = TablePoint(table, (y - J @ every[best][2])[None], J[None], phi, one, np.zeros(2), [0, 1, 2, 3, 4])
    found = posterior_mean(point, lambda own: np.linalg.inv(own)[0, 0])
    assert found == pytest.approx(exact, rel=0.1)
    assert found > 1.2 * at_minimum
