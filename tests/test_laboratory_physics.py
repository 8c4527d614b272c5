"""Physical properties of the laboratory: energy, felts, second polarisation, bridge."""

from __future__ import annotations

import math

import numpy as np
import pytest
import scipy.integrate
import scipy.signal

from pianofit.errors import FitError
from pianofit.parameters import String
from studies.bensa2005.body import ANGLE, CENTS, RESONATORS, SLOWER, Axis, Body, Resonator, make_axes, make_body
from studies.bensa2005.contact import FELTS, Contact, Felt, FeltState, _solve_contact, strike
from studies.bensa2005.laboratory import FINAL, MODES, RATE, SyntheticMeasurement, felt_of, measure, stroke_of

V = 0.844  # m/s
STRING = FINAL.string
MASS = FINAL.hammer.M_H


def alone(string: String = STRING, resonators: tuple[Resonator, ...] = (), modes: int = MODES) -> Body:
    return make_body((Axis(string, 1.0),), FINAL.geometry, modes, resonators)


def by_frequency(body: Body) -> np.ndarray:
    return body.poles[np.argsort(body.poles.imag)]


# Energy.


def stored(felt: Felt, dent, memory):
    """Energy stored in the felt (S in `contact`), J, for arrays or numbers."""
    p = felt.p
    recent = dent ** (p + 1) / (p + 1) - felt.eps * memory * dent
    return felt.K * (recent + felt.eps * p / (p + 1) * memory ** ((p + 1) / p))


def energy(body: Body, felt: Felt, mass: float, stroke: Contact) -> np.ndarray:
    """Total energy of string, bridge, hammer and felt, J [steps]."""
    xi = np.real(stroke.states @ body.vectors.T)
    kinetic = 0.5 * mass * stroke.hammer[:, 1] ** 2
    return 0.5 * (xi**2).sum(axis=1) + kinetic + stored(felt, stroke.dent, stroke.memory)


def drop(lab: SyntheticMeasurement, velocity: float) -> np.ndarray:
    """Change of the total energy at every step, relative to the initial energy of the hammer."""
    body, stroke = stroke_of(lab, velocity)
    total = energy(body, felt_of(lab), MASS, stroke)
    return np.diff(total) / total[0]


@pytest.mark.parametrize("felt", FELTS)
@pytest.mark.parametrize(("polarisation", "bridge"), [(False, False), (True, False), (False, True), (True, True)])
@pytest.mark.parametrize(("velocity", "rate"), [(0.1, 1.4e6), (2.3, 1e5)])
def test_energy_never_rises(felt, polarisation, bridge, velocity, rate):
    lab = SyntheticMeasurement(polarisation=polarisation, bridge=bridge, felt=felt, contact_rate=rate)
    assert drop(lab, velocity).max() < 2e-15


@pytest.mark.parametrize(("eps", "tau"), [(0.99, 2e-6), (0.5, 1e-5), (0.9, 1e-3), (0.25, 1e-1)])
@pytest.mark.parametrize("rate", [1e5, 1.4e6])
def test_no_memory_makes_energy(eps, tau, rate):
    lab = SyntheticMeasurement(eps=eps, tau=tau, contact_rate=rate)
    changes = drop(lab, 1.3)
    assert changes.max() < 2e-15
    assert changes.sum() < -1e-3


def test_without_losses_the_stroke_keeps_energy():
    body, felt = alone(STRING._replace(b1=0.0, b2=0.0)), Felt(FINAL.hammer.K_H, FINAL.hammer.p)
    total = energy(body, felt, MASS, strike(body, felt, MASS, V, 1e5))
    # On the first step u^p is not a polynomial, so the quadrature of the work has an error of 1e-11.
    np.testing.assert_allclose(total[1:], total[1], rtol=1e-12)
    assert abs(total[1] / total[0] - 1) < 1e-10


def test_the_bridge_and_the_supports_can_only_take():
    body = make_body(make_axes(STRING, True), FINAL.geometry, MODES, RESONATORS)
    gain = np.linalg.eigvalsh((body.matrix + body.matrix.T) / 2)
    assert gain.max() < 1e-9 * np.abs(gain).max()
    assert body.poles.real.max() < -0.99 * SLOWER * STRING.b1


def test_the_exponentials_solve_the_equations_of_motion():
    body = make_body(make_axes(STRING, True), FINAL.geometry, 24, RESONATORS)
    times, xi = np.array([0.0, 3e-4, 1e-3]), np.zeros(len(body.force))
    exact = scipy.integrate.solve_ivp(
        lambda _, x: body.matrix @ x + body.force, (0, 1e-3), xi, "DOP853", times, rtol=1e-11, atol=1e-13
    )
    z = body.drive * np.expm1(np.outer(times, body.poles)) / body.poles
    np.testing.assert_allclose((z @ body.vectors.T).real.T, exact.y, atol=1e-9 * np.abs(exact.y).max())


# The felt.


def test_memory_is_exact_where_the_felts_law_is_linear_in_time():
    felt, h = Felt(1e10, 2.56, eps=0.4, tau=30e-6), 5e-5
    path = np.array([0.0, 1e-4, 1.5e-4, 1.2e-4])
    state = FeltState()
    for gap in path[1:]:
        _, state = felt.advance(state, gap, h)

    def integrand(t: float) -> float:
        a = np.interp(t, h * np.arange(4), path**felt.p)
        return a * math.exp((t - 3 * h) / felt.tau) / felt.tau

    by_definition = scipy.integrate.quad(integrand, 0, 3 * h, points=[h, 2 * h], epsabs=0, epsrel=1e-12)[0]
    assert state.memory == pytest.approx(by_definition, rel=1e-10)


def force_along(felt: Felt, steps: int) -> tuple[np.ndarray, np.ndarray]:
    """Middles of the steps, and the force of the felt along u = U sin(πt/T), T = 1 ms."""
    h = 1e-3 / steps
    state, force = FeltState(), []
    for gap in 2e-4 * np.sin(np.pi * np.arange(1, steps + 1) / steps):
        f, state = felt.advance(state, gap, h)
        force.append(f)
    return (np.arange(steps) + 0.5) * h, np.array(force)


def test_the_force_with_memory_is_stulovs_integral_to_second_order():
    felt = Felt(1.2e10, 2.56, eps=0.3, tau=60e-6)

    def law(t: float) -> float:
        return (2e-4 * np.sin(np.pi * t / 1e-3)) ** felt.p

    def by_definition(t: float) -> float:
        past = scipy.integrate.quad(lambda s: law(s) * math.exp((s - t) / felt.tau), 0, t, epsabs=0, epsrel=1e-11)[0]
        return max(felt.K * (law(t) - felt.eps / felt.tau * past), 0.0)

    errors = []
    for steps in (40, 80, 160):
        times, force = force_along(felt, steps)
        early = times < 0.5e-3  # contact ends during the fall
        errors.append(np.abs(force - [by_definition(t) for t in times])[early].max() / force.max())
    assert np.all(np.abs(np.log2(np.divide(errors[:-1], errors[1:])) - 2) < 0.15), errors
    assert errors[-1] < 2e-4


def test_hunt_crossley_is_the_papers_law_to_second_order():
    felt, errors = Felt(1.1e10, 2.56, mu=0.2), []
    for steps in (40, 80, 160):
        t, force = force_along(felt, steps)
        u, speed = 2e-4 * np.sin(np.pi * t / 1e-3), 2e-4 * np.pi / 1e-3 * np.cos(np.pi * t / 1e-3)
        errors.append(np.abs(force - felt.K * u**felt.p * (1 + felt.mu * speed)).max() / force.max())
    assert np.all(np.abs(np.log2(np.divide(errors[:-1], errors[1:])) - 2) < 0.15), errors


def test_a_slow_felt_with_memory_has_the_papers_stiffness_and_a_relaxed_one_no_dent():
    felt, h, state, force = felt_of(SyntheticMeasurement()), 1e-6, FeltState(), 0.0
    for gap in 2e-4 * np.linspace(0, 1, 20_000)[1:]:
        force, state = felt.advance(state, gap, h)
    assert force == pytest.approx(FINAL.hammer.K_H * 2e-4**FINAL.hammer.p, rel=0.01)
    force, state = felt.advance(state, -1e-3, h)
    assert 0 < state.dent < 2e-4
    for _ in range(2000):
        before = stored(felt, state.dent, state.memory)
        force, state = felt.advance(state, -1e-3, h)
        assert force == 0
        assert stored(felt, state.dent, state.memory) <= before
    assert state.memory < 1e-8 * 2e-4**felt.p


def test_memory_without_weight_is_the_power_law():
    memory, power = (
        measure(SyntheticMeasurement.ideal(felt=felt, eps=0.0, seconds=0.2), V) for felt in ("memory", "power")
    )
    np.testing.assert_array_equal(memory.samples, power.samples)


def test_felts_with_losses_lose():
    kept = {felt: 1 + drop(SyntheticMeasurement.ideal(felt=felt), V).sum() for felt in FELTS}
    assert 0.995 < kept["power"] < 1  # the string's own losses
    assert kept["hunt-crossley"] < kept["power"] - 0.005
    assert kept["memory"] < kept["power"] - 0.005


@pytest.mark.parametrize("free", [1e-13, 1e-11, 1e-9, 1e-6])
def test_the_faintest_touch_is_one(free):
    force, state = _solve_contact(Felt(1e10, 2.56), 7e-7, FeltState(), free, 1e-10)
    assert force > 0
    assert state.gap + 1e-10 * force == pytest.approx(free, rel=1e-14)


def test_a_hammer_that_never_leaves_is_an_error():
    body, felt = alone(modes=32), Felt(1e5, 1.0)
    with pytest.raises(FitError, match=r"velocity=0.5 m/s"):
        strike(body, felt, 10.0, 0.5, 1e5)


# The second polarisation.


def test_each_polarisation_is_a_string_of_its_own_where_the_supports_are_rigid():
    axes = make_axes(STRING, True)
    both = by_frequency(make_body(axes, FINAL.geometry, MODES, ()))
    each = np.concatenate([by_frequency(alone(axis.string)) for axis in axes])
    np.testing.assert_allclose(both, each[np.argsort(each.imag)], rtol=1e-9)
    beta2 = (np.arange(1, MODES + 1) * np.pi / FINAL.geometry.length) ** 2
    decay = STRING.b1 + STRING.b2 * beta2
    exact = -decay + 1j * np.sqrt(STRING.c**2 * beta2 + STRING.kappa**2 * beta2**2 - decay**2)
    np.testing.assert_allclose(by_frequency(alone()), exact, rtol=1e-10)


@pytest.fixture(scope="module")
def envelope() -> tuple[np.ndarray, np.ndarray]:
    """Times, s, and amplitude of the fifth partial with a second polarisation, by its quadrature components."""
    lab = SyntheticMeasurement.ideal(polarisation=True, seconds=12.0)
    measurement, pole = measure(lab, V), by_frequency(alone())[4]
    note = measurement.clean[measurement.onset :]
    t = np.arange(len(note)) / RATE
    width = round(0.05 * RATE)
    mixed = scipy.signal.oaconvolve(note * np.exp(-1j * pole.imag * t), np.hanning(width) / width * 4, "same")
    inside = slice(width, -width, 441)
    return t[inside], np.abs(mixed[inside])


def beat_period() -> float:
    return 2 * np.pi / (by_frequency(alone())[4].imag * (2 ** (CENTS / 1200) - 1))


def test_a_partial_decays_twice(envelope):
    t, amplitude = envelope

    def decay(start: float) -> float:
        """Decay rate from the energies of two successive beat periods, 1/s."""
        first, second = (
            np.mean(amplitude[(t >= s) & (t < s + beat_period())] ** 2) for s in (start, start + beat_period())
        )
        return math.log(first / second) / (2 * beat_period())

    assert decay(0.06) == pytest.approx(STRING.b1, rel=0.05)
    assert decay(9.0) == pytest.approx(STRING.b1 * SLOWER, rel=0.1)


def test_and_beats_as_two_frequencies_do(envelope):
    t, amplitude = envelope
    ratio = math.tan(math.radians(ANGLE)) ** 2
    slow, fast = STRING.b1 * SLOWER, STRING.b1
    # Both start in phase, and their phase difference grows by one cycle per beat period.
    two = np.abs(np.exp(-fast * t) + ratio * np.exp(-slow * t + 2j * np.pi * t / beat_period()))
    level = 20 * np.log10(amplitude / two)
    assert np.ptp(level) < 0.4  # dB, while the beating has
    assert np.ptp(20 * np.log10(amplitude)[(t > 3.5) & (t < 5)]) > 15


# The bridge.


def test_one_resonator_at_the_end_of_an_ideal_string_is_solved_exactly():
    """T k cot(kL) + D(ω) = 0 with k = ω/c, D = m (ω0² - ω² + jωω0/Q), by Newton from the body's own poles."""
    end, length, c = Resonator(330.0, 0.5, 8.0, 0.0), FINAL.geometry.length, STRING.c
    tension, w0 = FINAL.geometry.mass / length * c**2, 2 * np.pi * end.frequency

    def balance(w: np.ndarray) -> np.ndarray:
        return tension * w / c / np.tan(w / c * length) + end.mass * (w0**2 - w**2 + 1j * w * w0 / end.quality)

    poles = by_frequency(alone(String(c, 0.0, 0.0, 0.0), (end,)))[:12] / 1j
    root = poles.copy()
    for _ in range(20):
        slope = (balance(root + 1e-4) - balance(root - 1e-4)) / 2e-4
        root -= balance(root) / slope
    np.testing.assert_allclose(poles, root, atol=2e-5 * c)
    assert np.abs(root[1:].imag).max() > 20 * np.abs(poles - root).max()


def test_the_bridge_takes_energy_near_its_resonances_only():
    rigid, soft = by_frequency(alone())[:40], by_frequency(alone(resonators=RESONATORS))
    near = np.array([soft[np.argmin(np.abs(soft.imag - w))] for w in rigid.imag])
    more = near.real / rigid.real - 1
    frequency = rigid.imag / (2 * np.pi)
    widths = np.stack([np.abs(frequency - r.frequency) * r.quality / r.frequency for r in RESONATORS]).min(axis=0)
    assert np.all(more > 0)
    assert np.all(more[widths > 3] < 0.06)
    assert np.sum(more > 0.5) == 4  # partials 2, 7, 11, 16
    cents = 1200 * np.log2(near.imag / rigid.imag)
    assert 0.2 < np.abs(cents).max() < 1.0


def test_the_bridge_carries_motion_into_the_other_polarisation():
    axes = tuple(Axis(axis.string, share) for axis, share in zip(make_axes(STRING, True), (1.0, 0.0), strict=True))
    for resonators, reached in ((RESONATORS, True), ((), False)):
        body = make_body(axes, FINAL.geometry, 64, resonators)
        stroke = strike(body, felt_of(SyntheticMeasurement.ideal()), MASS, V, 2e5)
        xi = (body.vectors @ (stroke.states[-1] * np.exp(body.poles * 0.05))).real
        second = xi[64:128]  # elastic energy of the second field's modes
        assert (second @ second > 1e-7 * (xi @ xi)) is np.bool_(reached)
