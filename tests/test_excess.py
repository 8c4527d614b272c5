"""The excess is integrated over: few levels give Student's t, many give Laplace's Gaussian."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import quad

from pianofit.inference.curvature import TablePoint
from pianofit.inference.excess import excess_nodes
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
        variance_profile=np.ones(count), ratio=0 * one,
        prior=(np.array([prior_mean, 0.0, 0.0, -50.0, -50.0]), np.array([SPREAD, 1.0, 1.0, 1.0, 1.0])),
        velocity=np.zeros((1, parameters)), degrees_of_freedom=np.float64(STUDENT),
    )  # fmt: skip
    phi = np.array([prior_mean, 0.0, 0.0, -50.0, -50.0])
    return TablePoint(table, residual[None], J[None], phi, one, np.zeros(parameters), ()), square


def mean_variance(count: int, parameters: int) -> tuple[float, float]:
    """Mean of σ² by the nodes, and exactly, from p(σ | y) ∝ σ^-(n - k) exp(-S/2σ²) p(log σ)."""
    point, square = linear_table(count, parameters)
    curvature = []

    def log_det(own: np.ndarray) -> float:
        curvature.append(own)
        return float(np.linalg.slogdet(own)[1])

    nodes = excess_nodes(point, log_det, 12.0)
    mass = nodes.log_density - 0.5 * np.linalg.slogdet(nodes.curvature)[1]
    mass = np.exp(mass - mass.max())
    gram = point.jacobian[0].T @ point.jacobian[0]
    variances = [np.trace(gram @ np.linalg.inv(own)) / parameters for own in nodes.curvature]
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
    return float(mass @ variances / mass.sum()), weighted / total


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
