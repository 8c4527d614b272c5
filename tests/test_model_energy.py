"""Energy: constant on the free lossless string, never rising with losses, of second order across the contact."""

import math

import model_cases as cases
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from model_cases import GEOMETRY, HAMMER, RATE, STRING

from pianofit import model

pytestmark = pytest.mark.usefixtures("float64")

LOSSLESS = STRING._replace(b1=0.0, b2=0.0)
ELASTIC = HAMMER._replace(mu=0.0)


def _mass(modes) -> np.ndarray:
    """Modal masses, kg, implied by the gains of the table."""
    strike, gain = np.asarray(modes.strike), np.asarray(modes.modal_gain)
    return np.where(gain == 0, 0.0, strike / np.where(gain == 0, 1.0, gain))


def _step(modes, q, v, T):
    a = float(modes.step) / 2
    omega2, alpha, gain = (np.asarray(x) for x in (modes.omega2, modes.alpha, modes.modal_gain))
    D = 1 + 2 * a * alpha + a**2 * omega2
    new = ((1 - 2 * a * alpha - a**2 * omega2) * v - 2 * a * omega2 * q + a * gain * T) / D
    return q + a * (v + new), new


def _energy(modes, q, v) -> float:
    return 0.5 * float(np.sum(_mass(modes) * (v**2 + np.asarray(modes.omega2) * q**2)))


def _string_energies(modes, drive) -> tuple[np.ndarray, np.ndarray]:
    """Energy of the string, J, and its displacement under the hammer, after every step of the pulse."""
    q = v = np.zeros(np.asarray(modes.omega2).shape)
    energies, under = [], []
    for T in np.asarray(drive):
        q, v = _step(modes, q, v, T)
        energies.append(_energy(modes, q, v))
        under.append(float(np.asarray(modes.strike) @ q))
    return np.array(energies), np.array(under)


@pytest.mark.parametrize("kind", ["continuous", "finite_difference"])
def test_free_lossless_string_keeps_its_energy_for_ten_seconds(kind):
    rate, n = 44_100.0, 24
    modes = cases.table(LOSSLESS, GEOMETRY, rate=rate, n_modes=n, kind=kind)
    q, v = 1e-3 / np.arange(1, n + 1) ** 2, np.zeros(n)
    start = _energy(modes, q, v)
    a = float(modes.step) / 2
    # Ten seconds with the matrix of the scheme: 441 000 = 2^3 · 3^2 · 5^3 · 7^2 steps by repeated products.
    D = 1 + a**2 * np.asarray(modes.omega2)
    one_step = np.empty((n, 2, 2))
    one_step[:, 1, 0], one_step[:, 1, 1] = -2 * a * np.asarray(modes.omega2) / D, (2 - D) / D
    one_step[:, 0, 0], one_step[:, 0, 1] = 1 + a * one_step[:, 1, 0], a * (1 + one_step[:, 1, 1])
    block = np.linalg.matrix_power(one_step, 630)
    state = np.stack([q, v], axis=-1)[..., None]
    for _ in range(700):
        state = block @ state
        assert abs(_energy(modes, state[:, 0, 0], state[:, 1, 0]) / start - 1) <= 1e-10
    assert float(np.abs(np.asarray(modes.pole).real).max()) * 20 <= 1e-10  # the closed forms keep it too


def test_waveform_of_a_free_lossless_string_does_not_fade():
    modes = cases.table(LOSSLESS, GEOMETRY, rate=RATE, n_modes=64)
    free = cases.release(modes, 1e-3 * (np.arange(64) == 0), np.zeros(64))
    y = model.waveform(modes, np.zeros(512), rate=44_100.0, samples=441_000, free=free)
    omega = 2 * math.pi * float(model.mode_frequencies(STRING, 1.0, 1)[0])
    n = np.arange(441_000 - 400, 441_000)
    exact = -1e-3 * omega * math.sin(0.3 * math.pi) * np.sin(omega * n / 44_100.0)
    assert np.abs(y[n] - exact).max() <= 1e-10 * np.abs(exact).max()


@settings(max_examples=40, deadline=None, derandomize=True, suppress_health_check=[HealthCheck.too_slow])
@given(
    b1=st.floats(1e-3, 100.0), b2=st.floats(1e-12, 1e-1), c=st.floats(20.0, 1000.0), kappa=st.floats(1e-3, 30.0),
    seed=st.integers(0, 1000),
)  # fmt: skip
def test_free_string_never_gains_energy(b1, b2, c, kappa, seed):
    modes = cases.table(STRING._replace(c=c, kappa=kappa, b1=b1, b2=b2), GEOMETRY, rate=RATE, n_modes=64)
    assert float(modes.alpha.min()) >= 0.0
    assert float(np.asarray(modes.pole).real.max()) < 0.0
    random = np.random.default_rng(seed)
    q, v = random.normal(size=64) * 1e-3, random.normal(size=64)
    last = _energy(modes, q, v)
    for _ in range(50):
        q, v = _step(modes, q, v, 0.0)
        now = _energy(modes, q, v)
        assert now <= last * (1 + 1e-13)
        last = now


def test_string_takes_exactly_what_the_contact_gives():
    modes, pulse = cases.hit(LOSSLESS, ELASTIC, GEOMETRY, RATE)
    energies, under = _string_energies(modes, pulse.drive)
    work = np.cumsum(0.5 * np.asarray(pulse.drive) * np.diff(under, prepend=0.0))
    assert np.abs(energies - work).max() <= 1e-12 * work[-1]
    assert float(pulse.work) == pytest.approx(work[-1], rel=1e-12)
    assert float(cases.string_energy(modes, pulse.drive).sum()) == pytest.approx(work[-1], rel=1e-10)
    y_H, v_H = np.asarray(pulse.hammer).T
    lost = 0.5 * HAMMER.M_H * (HAMMER.v_H0**2 - v_H**2)
    taken = np.cumsum(0.5 * np.asarray(pulse.drive) * np.diff(y_H, prepend=0.0))
    assert np.abs(lost - taken).max() <= 1e-12 * lost[-1]


def _felt_work(hammer, rate: float, steps: int) -> float:
    """Net work of the felt from first to last touch, over the initial energy of the hammer."""
    _, pulse = cases.hit(STRING, hammer, GEOMETRY, rate, steps=steps)
    u = np.asarray(pulse.compression)
    assert bool(pulse.contact_ended)
    work = float(np.sum(0.5 * np.asarray(pulse.drive)[1:] * np.diff(u)))
    return work / (0.5 * hammer.M_H * hammer.v_H0**2)


@pytest.mark.parametrize("p", [2.56, 3.5])
def test_energy_across_the_contact_is_of_second_order(p):
    hammer = ELASTIC._replace(p=p, K_H=8.0 / 2e-4**p)
    errors = []
    for factor in (1, 2, 4, 8):
        modes, pulse = cases.hit(LOSSLESS, hammer, GEOMETRY, RATE * factor, steps=8192)
        string = float(cases.string_energy(modes, pulse.drive).sum())
        total = string + 0.5 * hammer.M_H * float(pulse.hammer[-1, 1]) ** 2
        assert float(pulse.force[-1]) == 0.0
        errors.append(total / (0.5 * hammer.M_H * hammer.v_H0**2) - 1)
    orders = np.log2(np.abs(errors[:-1]) / np.abs(errors[1:]))
    assert abs(errors[0]) < 1e-3
    assert np.abs(orders - 2).max() < 0.1


@pytest.mark.parametrize("p", [1.0, 1.7, 2.56, 4.0, 5.0])
@pytest.mark.parametrize("v_H0", [0.05, 1.0, 10.0])
def test_felt_never_gives_more_than_it_took(p, v_H0):
    hammer = ELASTIC._replace(p=p, K_H=8.0 / 2e-4**p, v_H0=v_H0)
    coarse = _felt_work(hammer, RATE, steps=8192)
    fine = _felt_work(hammer, 4 * RATE, steps=8192)
    assert coarse >= -1e-4
    assert fine >= -1e-4 / 4**2
    assert abs(fine) <= abs(coarse) / 10
    for mu in (0.01, 0.1, 1.0):
        assert _felt_work(hammer._replace(mu=mu), RATE, steps=8192) > 0


def test_total_energy_falls_all_through_a_lossy_strike():
    modes, pulse = cases.hit(STRING, HAMMER, GEOMETRY, 4 * RATE, steps=8192)
    string, _ = _string_energies(modes, pulse.drive)
    hammer = 0.5 * HAMMER.M_H * np.asarray(pulse.hammer[:, 1]) ** 2
    pressed = np.maximum(np.asarray(pulse.compression), 0.0)
    felt = HAMMER.K_H * pressed ** (HAMMER.p + 1) / (HAMMER.p + 1)
    total = string + hammer + felt
    assert total[0] == pytest.approx(0.5 * HAMMER.M_H * HAMMER.v_H0**2, rel=1e-12)
    assert np.diff(total).max() <= 1e-7 * total[0]
    assert 0.3 < total[-1] / total[0] < 0.99
