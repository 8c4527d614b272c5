"""Spectrum, waveform and levels: against stepping, against each other, and against exact free motion."""

import math

import jax
import jax.numpy as jnp
import model_cases as cases
import numpy as np
import pytest
from model_cases import GEOMETRY, HAMMER, RATE, STRING

from pianofit import model
from pianofit.errors import ParameterError
from pianofit.model.free_response import damped_circle

pytestmark = pytest.mark.usefixtures("float64")

QUANTITIES = ("velocity", "displacement", "bridge-force")
spectrum = jax.jit(model.spectrum)
mobility = jax.jit(model.mobility)


def _stepped_output(modes, drive, quantity: str, steps: int) -> np.ndarray:
    """The pickup signal by stepping the scheme, with the gains of design §2 for small losses."""
    a = float(modes.step) / 2
    omega2, alpha, gamma = (np.asarray(x) for x in (modes.omega2, modes.alpha, modes.modal_gain))
    beta = np.arange(1, omega2.size + 1) * math.pi / GEOMETRY.length
    angle = np.sqrt(STRING.c**2 * beta**2 + STRING.kappa**2 * beta**4) * a
    if quantity == "velocity":
        read = np.sin(beta * GEOMETRY.pickup) * (angle / np.sin(angle)) ** 2
    else:
        read = np.sin(beta * GEOMETRY.pickup) * angle / (np.sin(angle) * np.cos(angle))
    if quantity == "bridge-force":
        tension = GEOMETRY.mass / GEOMETRY.length * (STRING.c**2 * beta + STRING.kappa**2 * beta**3)
        read = tension * (-1.0) ** np.arange(beta.size) * angle / (np.sin(angle) * np.cos(angle))
    D = 1 + 2 * a * alpha + a**2 * omega2
    q = v = np.zeros(beta.size)
    out = np.empty(steps)
    T = np.zeros(steps)
    T[: len(drive)] = drive
    for n in range(steps):
        new = ((1 - 2 * a * alpha - a**2 * omega2) * v - 2 * a * omega2 * q + a * gamma * T[n]) / D
        q, v = q + a * (v + new), new
        out[n] = read @ (v if quantity == "velocity" else q)
    return out


@pytest.mark.parametrize("quantity", QUANTITIES)
def test_waveform_is_the_stepping(quantity):
    modes, pulse = cases.hit(STRING, HAMMER, GEOMETRY, RATE, quantity=quantity)
    stepped = _stepped_output(modes, np.asarray(pulse.drive), quantity, 3000)
    y = model.waveform(modes, pulse.drive, rate=RATE, samples=3000)
    assert np.abs(y - stepped).max() <= 1e-10 * np.abs(stepped).max()
    half = model.waveform(modes, pulse.drive, rate=RATE / 2, samples=1500)
    low = np.asarray(modes.pole).imag < math.pi * RATE / 2
    cut = modes._replace(pickup=jnp.where(low, modes.pickup, 0.0))
    np.testing.assert_allclose(half, model.waveform(cut, pulse.drive, rate=RATE, samples=3000)[::2], atol=1e-12)


@pytest.mark.parametrize("quantity", QUANTITIES)
@pytest.mark.parametrize("sigma", [30.0, 300.0])
def test_spectrum_is_the_transform_of_the_damped_waveform(quantity, sigma):
    modes, pulse = cases.hit(STRING, HAMMER, GEOMETRY, RATE, quantity=quantity)
    samples = round(32 / sigma * RATE)  # exp(-32) is beyond rounding
    n = np.arange(samples)
    damped = model.waveform(modes, pulse.drive, rate=RATE, samples=samples) * np.exp(-sigma * n / RATE)
    frequency = np.concatenate([[0.0, 10.0], np.linspace(100, 12_000, 41)])
    direct = np.exp(-2j * np.pi * np.outer(frequency, n) / RATE) @ damped / RATE
    found = np.asarray(spectrum(modes, pulse.drive, jnp.asarray(frequency), sigma))
    assert np.abs(found - direct).max() <= 1e-10 * np.abs(direct).max()


@pytest.mark.parametrize("quantity", QUANTITIES)
def test_ringing_continues_the_waveform(quantity):
    modes, pulse = cases.hit(STRING, HAMMER, GEOMETRY, RATE, quantity=quantity)
    y = model.waveform(modes, pulse.drive, rate=RATE, samples=20_000)
    n = np.arange(512, 20_000, 97)
    A, p = np.asarray(cases.ringing(modes, pulse.drive)), np.asarray(modes.pole)
    direct = (np.exp(np.outer(n / RATE, p)) @ A).real
    assert np.abs(y[n] - direct).max() <= 1e-11 * np.abs(y).max()


@pytest.mark.parametrize("quantity", ["velocity", "displacement"])
def test_strike_and_pickup_may_trade_places(quantity):
    """Reciprocity: force at one point and pickup at another can be exchanged."""
    k = np.arange(1, 65) * math.pi / GEOMETRY.length
    original, exchanged = GEOMETRY._replace(pickup=0.37), GEOMETRY._replace(pickup=0.12)
    forth = cases.table(STRING, original, rate=RATE, n_modes=64, quantity=quantity, strike_weights=np.sin(0.12 * k))
    back = cases.table(STRING, exchanged, rate=RATE, n_modes=64, quantity=quantity, strike_weights=np.sin(0.37 * k))
    zeta = damped_circle(jnp.linspace(20, 15_000, 300), 30.0, forth.step)
    H = np.asarray(mobility(forth, zeta))
    assert np.abs(np.asarray(mobility(back, zeta)) - H).max() <= 1e-12 * np.abs(H).max()


def test_the_hammer_hears_no_pickup():
    """Quantity and position of the pickup do not affect the contact."""
    _, pulse = cases.hit(STRING, HAMMER, GEOMETRY, RATE)
    for quantity in QUANTITIES:
        _, other = cases.hit(STRING, HAMMER, GEOMETRY._replace(pickup=0.77), RATE, quantity=quantity)
        np.testing.assert_allclose(other.force, pulse.force, atol=1e-11 * float(pulse.force.max()))


# --- plucks ---------------------------------------------------------------------------------------------------------


def _exact_free(q0, v0, t, quantity: str) -> np.ndarray:
    """Σ of damped cosines, each solving q¨ + 2αq˙ + ω²q = 0 from (q0, v0)."""
    beta = np.arange(1, len(q0) + 1) * math.pi / GEOMETRY.length
    alpha = STRING.b1 + STRING.b2 * beta**2
    omega2 = STRING.c**2 * beta**2 + STRING.kappa**2 * beta**4
    omega_d = np.sqrt(omega2 - alpha**2)
    cos, sin = np.cos(np.outer(t, omega_d)), np.sin(np.outer(t, omega_d))
    fade = np.exp(-np.outer(t, alpha))
    if quantity == "velocity":
        terms = fade * (v0 * cos - (omega2 * q0 + alpha * v0) / omega_d * sin)
    else:
        terms = fade * (q0 * cos + (v0 + alpha * q0) / omega_d * sin)
    read = np.sin(beta * GEOMETRY.pickup)
    if quantity == "bridge-force":
        read = GEOMETRY.mass * (STRING.c**2 * beta + STRING.kappa**2 * beta**3) * (-1.0) ** np.arange(beta.size)
    return terms @ read


@pytest.mark.parametrize("quantity", QUANTITIES)
def test_plucks_are_the_exact_free_motion(quantity):
    modes = cases.table(STRING, GEOMETRY, rate=RATE, n_modes=64, quantity=quantity)
    q0 = np.asarray(model.project(lambda x: 1e-3 * np.minimum(x / 0.2, (1 - x) / 0.8), 1.0, 64))
    v0 = np.asarray(model.project(lambda x: 0.3 * np.exp(-(((x - 0.6) / 0.1) ** 2)), 1.0, 64))
    free = cases.release(modes, q0, v0)
    y = model.waveform(modes, np.zeros(512), rate=RATE, samples=60_000, free=free)
    exact = _exact_free(q0, v0, np.arange(60_000) / RATE, quantity)
    assert np.abs(y - exact).max() <= 1e-10 * np.abs(exact).max()
    A, p = np.asarray(cases.ringing(modes, jnp.zeros(512), free)), np.asarray(modes.pole)
    t = np.array([0.0, 0.1, 0.5])
    np.testing.assert_allclose((np.exp(np.outer(t, p)) @ A).real, _exact_free(q0, v0, t, quantity), rtol=1e-9)


def test_spectrum_of_a_strike_on_a_sounding_string():
    modes = cases.table(STRING, GEOMETRY, rate=RATE, n_modes=64)
    q0, v0 = np.zeros(64), np.zeros(64)
    q0[[0, 3]], v0[2] = [2e-5, -1e-5], 0.02
    free = cases.release(modes, q0, v0)
    pulse = cases.strike(modes, HAMMER, steps=512, free=free)
    sigma, frequency = 100.0, np.linspace(50, 6000, 37)
    n = np.arange(round(0.32 * RATE))
    y = model.waveform(modes, pulse.drive, rate=RATE, samples=n.size, free=free)
    direct = np.exp(-np.outer(sigma + 2j * np.pi * frequency, n / RATE)) @ y / RATE
    found = np.asarray(spectrum(modes, pulse.drive, jnp.asarray(frequency), sigma, free))
    assert np.abs(found - direct).max() <= 1e-10 * np.abs(direct).max()
    quiet = cases.strike(modes, HAMMER, steps=512)
    assert np.abs(np.asarray(pulse.force) - np.asarray(quiet.force)).max() > 0.01 * float(quiet.force.max())


def test_energy_and_contact_of_a_pluck_by_no_hammer():
    """The energy of a string released at rest is the potential energy of its shape: tension and stiffness."""
    modes = cases.table(STRING, GEOMETRY, rate=RATE, n_modes=24)
    free = cases.release(modes, 1e-3 * (np.arange(24) == 4), np.zeros(24))
    beta = 5 * math.pi
    exact = 0.25 * GEOMETRY.mass * (STRING.c**2 * beta**2 + STRING.kappa**2 * beta**4) * 1e-6
    assert float(free.energy) == pytest.approx(exact, rel=1e-3)  # mass and frequency of the table differ by (ωa)²


# --- levels ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("frequency", "tolerance"), [(440.0, 0.02), (2000.0, 0.005)])
def test_level_is_the_energy_of_the_first_third_of_a_second(frequency, tolerance):
    """The closed form neglects the part at twice the frequency, at most (α + 8)/ω of the energy."""
    A, decay, omega = 0.3 * np.exp(0.7j), 2.5, 2 * math.pi * frequency
    t = (np.arange(350_000) + 0.5) / 1e6
    signal = (A * np.exp((-decay + 1j * omega) * t)).real
    energy = np.sum(signal**2 * np.exp(-16 * t)) / 1e6
    found = float(model.level_db(jnp.array([A]), jnp.array([decay]))[0])
    assert found == pytest.approx(10 * math.log10(energy), abs=tolerance)


def test_waveform_needs_a_whole_fraction_of_the_contacts_rate():
    modes, pulse = cases.hit(STRING, HAMMER, GEOMETRY, RATE)
    with pytest.raises(ParameterError, match=r"rate=48000.*whole multiple"):
        model.waveform(modes, pulse.drive, rate=48_000.0, samples=10)


@pytest.mark.parametrize("samples", [0, 1, 100, 511, 512, 513])
def test_any_number_of_samples(samples):
    modes, pulse = cases.hit(STRING, HAMMER, GEOMETRY, RATE)
    y = model.waveform(modes, pulse.drive, rate=RATE, samples=samples)
    whole = model.waveform(modes, pulse.drive, rate=RATE, samples=2000)
    assert y.shape == (samples,)
    np.testing.assert_allclose(y, whole[:samples], rtol=1e-9, atol=1e-12)


def test_a_mode_that_dies_within_the_contact_has_finite_levels():
    string, hammer = STRING._replace(b2=0.1), HAMMER._replace(M_H=0.05, v_H0=0.1, K_H=1e8)
    modes, pulse = cases.hit(string, hammer, GEOMETRY._replace(mass=0.002), RATE, n_modes=128, steps=4096)
    assert np.isfinite(np.asarray(model.modal_amplitudes(modes, pulse.drive))).all()
    assert np.isfinite(np.asarray(cases.string_energy(modes, pulse.drive))).all()


@pytest.mark.parametrize("quantity", ["velocity", "bridge-force"])
def test_a_waveform_is_traced_and_has_the_derivatives_of_differences(quantity):
    samples = 900

    def sound(hammer):
        modes = model.mode_table(STRING, GEOMETRY, rate=2 * RATE, n_modes=60, quantity=quantity)
        drive = model.strike(modes, hammer, steps=2048).drive
        return model.waveform(modes, drive, rate=RATE, samples=samples, oversampling=2)

    plain = sound(HAMMER)
    hammer = jax.tree.map(float, HAMMER)
    np.testing.assert_allclose(jax.jit(sound)(hammer), plain, rtol=1e-9, atol=1e-9 * np.abs(plain).max())
    many = jax.tree.map(lambda x: jnp.stack([x, 1.1 * x]), jax.tree.map(jnp.asarray, hammer))
    np.testing.assert_allclose(jax.jit(jax.vmap(sound))(many)[0], plain, rtol=1e-9, atol=1e-9 * np.abs(plain).max())
    slope = jax.jit(jax.jacfwd(sound))(hammer).v_H0
    up, down = (sound(hammer._replace(v_H0=hammer.v_H0 * (1 + h))) for h in (1e-5, -1e-5))
    np.testing.assert_allclose(slope, (up - down) / (2e-5 * hammer.v_H0), atol=1e-5 * np.abs(slope).max())
    loss = jax.jit(jax.grad(lambda h: (sound(h) ** 2).sum()))(hammer)
    assert np.isfinite(jax.tree.leaves(loss)).all()
    with pytest.raises(ParameterError, match="oversampling=None: "):
        jax.jit(
            lambda h: model.waveform(
                m := model.mode_table(STRING, GEOMETRY, rate=2 * RATE, n_modes=60),
                model.strike(m, h, steps=2048).drive, rate=RATE, samples=samples,
            )
        )(hammer)  # fmt: skip
    modes = model.mode_table(STRING, GEOMETRY, rate=2 * RATE, n_modes=60)
    with pytest.raises(ParameterError, match="oversampling=3: the table has 2 steps"):
        model.waveform(modes, rate=RATE, samples=10, oversampling=3)
