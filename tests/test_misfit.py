"""Scatter beyond the noise is found where it was put, and outliers lose their weight."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pianofit.fit.misfit import BEND, huber, scatter
from scipy.special import huber as huber_loss

N = 600


def residuals(sd: float, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    random = np.random.default_rng(seed)
    noise = 10 ** random.uniform(-2.5, -1, N)
    return random.normal(size=N) * np.hypot(noise, sd), noise


@pytest.mark.parametrize("sd", [0.05, 0.3, 3.0])
def test_scatter_is_found_beyond_the_noise(sd):
    assert scatter(*residuals(sd), 0) == pytest.approx(sd, rel=0.1)


def test_noise_alone_is_no_scatter():
    residual, noise = residuals(0.0)
    assert scatter(residual, noise, 0) < 0.3 * np.median(noise)
    assert scatter(0.5 * residual, noise, 0) == 0.0


def test_a_few_wild_partials_do_not_decide():
    residual, noise = residuals(0.3)
    residual[::20] = 100.0
    assert scatter(residual, noise, 0) == pytest.approx(0.3, rel=0.35)


def test_parameters_that_were_fitted_take_their_share():
    sd, freedom, n = 0.3, 6, 12
    random = np.random.default_rng(0)
    basis = np.linalg.qr(random.normal(size=(n, freedom)))[0]
    noise = np.full(n, 1e-3)
    fitted, naive = [], []
    for _ in range(400):
        raw = sd * random.normal(size=n)
        left = raw - basis @ (basis.T @ raw)
        fitted.append(scatter(left, noise, freedom))
        naive.append(scatter(left, noise, 0))
    assert np.mean(fitted) == pytest.approx(sd, rel=0.15)
    assert np.mean(naive) < 0.8 * sd


def test_no_partials_have_no_scatter():
    assert scatter(np.zeros(0), np.zeros(0), 2) == 0.0


@given(st.floats(-1e6, 1e6), st.floats(1e-6, 1e6))
def test_hubers_factor_bounds_the_pull(residual, sd):
    factor = huber(np.array([residual]), np.array([sd]))[0]
    # d/dr of Huber's loss, as a weight on r.
    assert 0 < factor <= 1
    assert factor**2 * abs(residual) <= BEND * sd * (1 + 1e-12)
    if abs(residual) <= BEND * sd:
        assert factor == 1
        assert huber_loss(BEND * sd, residual) == pytest.approx(0.5 * residual**2)
