"""The table of modes: eigenvalues, weights, prewarped poles and gains, and scalings that leave the sound unchanged."""

import math

import jax.numpy as jnp
import model_cases as cases
import numpy as np
import pytest
import scipy.integrate
from model_cases import GEOMETRY, HAMMER, RATE, STRING

from pianofit import model
from pianofit.errors import ParameterError

pytestmark = pytest.mark.usefixtures("float64")


def _scheme_poles(modes) -> np.ndarray:
    """Poles, 1/s, of the one-step matrix of Crank-Nicolson, from the table's ω̃² and α̃ [modes]."""
    a = float(modes.step) / 2
    omega2, alpha = np.asarray(modes.omega2), np.asarray(modes.alpha)
    A = np.zeros((omega2.size, 2, 2))
    A[:, 0, 1], A[:, 1, 0], A[:, 1, 1] = 1.0, -omega2, -2 * alpha
    one = np.eye(2)
    z = np.linalg.eigvals(np.linalg.solve(one - a * A, one + a * A))
    return np.log(z[np.arange(z.shape[0]), np.argmax(z.imag, axis=1)]) / (2 * a)


@pytest.mark.parametrize("b2", [0.0, 2e-4, 2e-2])
def test_prewarped_scheme_has_the_continuous_strings_poles(b2):
    string = STRING._replace(b2=b2)
    modes = cases.table(string, GEOMETRY, rate=RATE / 2, n_modes=96)
    beta2 = (np.arange(1, 97) * math.pi / GEOMETRY.length) ** 2
    alpha = string.b1 + string.b2 * beta2
    exact = -alpha + 1j * np.sqrt(string.c**2 * beta2 + string.kappa**2 * beta2**2 - alpha**2)
    kept = np.abs(exact) / (2 * np.pi) < 0.2 * RATE
    assert 60 < kept.sum() < 96
    assert np.abs(_scheme_poles(modes) / exact - 1)[kept].max() < 1e-12
    assert np.abs(np.asarray(modes.pole) / exact - 1)[kept].max() < 1e-12
    assert np.all(np.asarray(modes.strike)[~kept] == 0)


def test_finite_difference_poles_are_the_schemes_own():
    modes = cases.table(STRING, GEOMETRY, rate=RATE, n_modes=40, kind="finite_difference")
    assert np.abs(np.asarray(modes.pole) / _scheme_poles(modes) - 1).max() < 1e-11


def test_finite_difference_rows_are_the_grids_eigenvalues():
    N = 40
    grid = cases.grid_matrices(GEOMETRY, N)
    stiff = -(STRING.c**2) * grid.second + STRING.kappa**2 * grid.fourth
    omega2, vectors = np.linalg.eigh(stiff)
    modes = cases.table(STRING, GEOMETRY, rate=RATE, n_modes=N, kind="finite_difference")
    np.testing.assert_allclose(modes.omega2, omega2, rtol=1e-11)
    alpha = STRING.b1 - STRING.b2 * np.einsum("ik,ij,jk->k", vectors, grid.second, vectors)
    np.testing.assert_allclose(modes.alpha, alpha, rtol=1e-11)
    sines = vectors * math.sqrt((N + 1) / 2)  # of amplitude 1, up to sign
    np.testing.assert_allclose(np.abs(modes.strike), np.abs(grid.window @ sines), atol=1e-12)


def test_continuous_frequencies_follow_the_inharmonicity_law():
    k = np.arange(1, 31)
    f0, B = STRING.c / (2 * GEOMETRY.length), (STRING.kappa * math.pi / (STRING.c * GEOMETRY.length)) ** 2
    np.testing.assert_allclose(
        model.mode_frequencies(STRING, GEOMETRY.length, 30), k * f0 * np.sqrt(1 + B * k**2), rtol=1e-13
    )


WINDOWS = {
    "raised-cosine": lambda z: 1 + np.cos(2 * np.pi * z),
    "parabola": lambda z: 1 - 4 * z**2,
    "box": lambda z: np.ones_like(z),
    "triangle": lambda z: 1 - 2 * np.abs(z),
    "off-centre": lambda z: np.where(z > 0.25, 1.0, 0.2),
}


@pytest.mark.parametrize("name", WINDOWS)
def test_window_weights_against_adaptive_quadrature(name):
    width, shape = 0.05, WINDOWS[name]
    geometry = GEOMETRY._replace(width=width)
    weights = np.asarray(model.window_weights(lambda x: shape(np.asarray(x) / width), geometry, 64))
    options = {"points": [0.0, 0.25], "epsabs": 1e-13, "epsrel": 1e-13, "limit": 200}
    area = scipy.integrate.quad(lambda z: float(shape(z)), -0.5, 0.5, **options)[0]
    for k in (1, 2, 7, 33, 64):
        beta = k * math.pi / geometry.length
        exact = scipy.integrate.quad(
            lambda z, b=beta: float(shape(z)) * math.sin(b * (geometry.strike_position + width * z)),
            -0.5,
            0.5,
            **options,
        )[0]
        assert weights[k - 1] == pytest.approx(exact / area, abs=1e-11)


def test_default_window_is_the_raised_cosine():
    geometry = GEOMETRY._replace(width=0.05)
    default = cases.table(STRING, geometry, rate=1e6, n_modes=64).strike
    shape = WINDOWS["raised-cosine"]
    np.testing.assert_allclose(
        default, model.window_weights(lambda x: shape(np.asarray(x) / 0.05), geometry, 64), atol=1e-13
    )


def test_a_window_of_half_the_shortest_wavelength_or_more_is_no_singularity():
    """The closed form of the raised cosine has removable poles where β width = 2π."""
    geometry = GEOMETRY._replace(width=2 / 25 * GEOMETRY.length, strike_position=0.3)  # β_25 width = 2π exactly
    weights = np.asarray(cases.table(STRING, geometry, rate=1e6, n_modes=64).strike)
    assert weights[24] == pytest.approx(0.5 * math.sin(25 * math.pi * 0.3), abs=1e-12)
    assert np.all(np.isfinite(weights))


def test_gains_keep_what_they_promise():
    modes = cases.table(STRING, GEOMETRY, rate=RATE, n_modes=48)
    beta = np.arange(1, 49) * math.pi / GEOMETRY.length
    omega2 = STRING.c**2 * beta**2 + STRING.kappa**2 * beta**4
    compliance = 2 * np.asarray(modes.strike) / GEOMETRY.mass / omega2
    np.testing.assert_allclose(np.asarray(modes.modal_gain) / np.asarray(modes.omega2), compliance, rtol=1e-12)


def test_every_pickup_rings_as_the_exact_string_does():
    """After a force with low frequencies each mode has the amplitude of the continuous string."""
    rate, beta = 44_100.0, np.arange(1, 13) * math.pi
    n = np.arange(200)
    force = np.where(n < 128, np.sin(np.pi * n / 128) ** 8, 0.0)  # smooth: its samples determine it
    drive = jnp.asarray(force + np.concatenate([[0.0], force[:-1]]))
    alpha = STRING.b1 + STRING.b2 * beta**2
    omega_d = np.sqrt(STRING.c**2 * beta**2 + STRING.kappa**2 * beta**4 - alpha**2)
    p = -alpha + 1j * omega_d
    transform = np.exp(-np.outer(p, n / rate)) @ force / rate  # ∫ F exp(-p t) dt, spectrally accurate
    for quantity, read in {
        "velocity": np.sin(beta * GEOMETRY.pickup) * p,
        "displacement": np.sin(beta * GEOMETRY.pickup),
        "bridge-force": GEOMETRY.mass * (STRING.c**2 * beta + STRING.kappa**2 * beta**3) * (-1.0) ** np.arange(12),
    }.items():
        modes = cases.table(STRING, GEOMETRY, rate=rate, n_modes=12, quantity=quantity)
        exact = read * (2 * np.asarray(modes.strike) / GEOMETRY.mass) / (1j * omega_d) * transform
        found = np.asarray(cases.ringing(modes, drive))
        strong = np.abs(exact) > 1e-9 * np.abs(exact).max()
        assert strong.sum() >= 6
        np.testing.assert_allclose(found[strong], exact[strong], rtol=1e-5, err_msg=quantity)


def _observed(string, hammer, geometry, quantity="velocity"):
    modes, pulse = cases.hit(string, hammer, geometry, RATE, quantity=quantity)
    return np.asarray(pulse.compression), np.asarray(cases.ringing(modes, pulse.drive)), np.asarray(pulse.force)


def _close(found, expected):
    assert np.abs(found - expected).max() <= 1e-10 * np.abs(expected).max()


@pytest.mark.parametrize("s", [0.1, 3.7])
def test_masses_and_felt_matter_only_as_ratios(s):
    hammer = HAMMER._replace(K_H=s * HAMMER.K_H, M_H=s * HAMMER.M_H)
    heavier = GEOMETRY._replace(mass=s * GEOMETRY.mass)
    u, y, F = _observed(STRING, HAMMER, GEOMETRY)
    u2, y2, F2 = _observed(STRING, hammer, heavier)
    _close(u2, u)
    _close(y2, y)
    _close(F2, s * F)
    _close(
        _observed(STRING, hammer, heavier, "bridge-force")[1],
        s * _observed(STRING, HAMMER, GEOMETRY, "bridge-force")[1],
    )


@pytest.mark.parametrize("s", [0.2, 2.5])
def test_lengths_matter_only_as_ratios(s):
    string = STRING._replace(c=s * STRING.c, kappa=s**2 * STRING.kappa, b2=s**2 * STRING.b2)
    geometry = GEOMETRY._replace(
        **{name: s * getattr(GEOMETRY, name) for name in ("length", "strike_position", "width", "pickup")}
    )
    for found, expected in zip(_observed(string, HAMMER, geometry), _observed(STRING, HAMMER, GEOMETRY), strict=True):
        _close(found, expected)


@pytest.mark.parametrize("s", [0.3, 4.0])
def test_gain_trades_against_velocity(s):
    hammer = HAMMER._replace(K_H=HAMMER.K_H * s ** (1 - HAMMER.p), mu=HAMMER.mu / s, v_H0=s * HAMMER.v_H0)
    for found, expected in zip(_observed(STRING, hammer, GEOMETRY), _observed(STRING, HAMMER, GEOMETRY), strict=True):
        _close(found, s * expected)


def test_project_recovers_modal_coordinates():
    q = np.array([1e-3, -2e-4, 0.0, 5e-5, 1e-6])
    x = np.arange(1, 65) / 65 * GEOMETRY.length
    points = np.sin(np.outer(x, np.arange(1, 6) * math.pi / GEOMETRY.length)) @ q
    np.testing.assert_allclose(model.project(points, GEOMETRY.length, 5), q, atol=1e-17)


def test_project_of_a_plucked_triangle_is_the_textbooks():
    at, height = 0.3, 2e-3
    shape = model.project(lambda x: height * np.minimum(x / at, (1 - x) / (1 - at)), 1.0, 20)
    k = np.arange(1, 21)
    exact = 2 * height * np.sin(k * np.pi * at) / (k**2 * np.pi**2 * at * (1 - at))
    np.testing.assert_allclose(shape, exact, atol=1e-6 * height)


def test_unusable_arguments_say_what_to_do():
    with pytest.raises(ParameterError, match=r"quantity='loudness'.*velocity"):
        model.mode_table(STRING, GEOMETRY, rate=RATE, n_modes=8, quantity="loudness")
    with pytest.raises(ParameterError, match=r"kind='fem'.*finite_difference"):
        model.mode_table(STRING, GEOMETRY, rate=RATE, n_modes=8, kind="fem")
    with pytest.raises(ParameterError, match="4 points; 8 modes"):
        model.project(np.zeros(4), 1.0, 8)


def test_a_window_between_two_grid_points_is_refused():
    narrow = GEOMETRY._replace(strike_position=0.12, width=0.002)
    with pytest.raises(ParameterError, match=r"width=0\.002 m: none of the 40 grid points"):
        model.simulate(STRING, HAMMER, narrow, kind="finite_difference", n_modes=40, oversampling=1)
