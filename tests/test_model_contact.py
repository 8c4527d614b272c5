"""The contact, against the paper's matrices step by step, and against the equations of motion."""

import importlib
import math

import model_cases as cases
import numpy as np
import pytest
import scipy.linalg
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from model_cases import GEOMETRY, HAMMER, RATE, STRING

from pianofit import model
from pianofit.errors import FitError, PianofitError
from pianofit.parameters import PARAMETERS, Geometry, Hammer, String

pytestmark = pytest.mark.usefixtures("float64")


def _relative(found, expected) -> float:
    found, expected = np.asarray(found), np.asarray(expected)
    return float(np.abs(found - expected).max() / np.abs(expected).max())


# --- the paper's scheme ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("hammer", "plucked"),
    [(HAMMER, False), (HAMMER._replace(K_H=1e8, p=1.8, M_H=2e-3), False), (HAMMER, True)],
)
def test_finite_difference_table_is_the_papers_matrices(hammer, plucked):
    N = 30
    geometry = GEOMETRY._replace(width=0.15, pickup=12 * GEOMETRY.length / (N + 1))
    steps, x = 512, np.arange(1, N + 1) / (N + 1)
    y0 = 2e-5 * np.minimum(x / 0.4, (1 - x) / 0.6) if plucked else np.zeros(N)
    v0 = 0.1 * np.sin(3 * np.pi * x) if plucked else np.zeros(N)
    slow = cases.matrix_steps(STRING, hammer, geometry, N, 1 / RATE, steps, y0, v0)
    modes = cases.table(STRING, geometry, rate=RATE, n_modes=N, kind="finite_difference")
    free = cases.release(modes, model.project(y0, 1.0, N), model.project(v0, 1.0, N))
    pulse = cases.strike(modes, hammer, steps=steps, free=free)
    assert slow.force.max() > 1.0
    assert slow.force[-1] == 0.0
    assert _relative(pulse.force, slow.force) < 1e-9
    assert _relative(pulse.compression, slow.compression) < 1e-9
    assert _relative(pulse.hammer[:, 1], slow.hammer[:, 1]) < 1e-9
    velocity = model.waveform(modes, pulse.drive, rate=RATE, samples=steps, free=free)
    assert _relative(velocity, slow.v[:, 11]) < 1e-9


def test_a_hammer_strikes_a_plucked_string():
    modes = cases.table(STRING, GEOMETRY._replace(width=0.15), rate=RATE, n_modes=30, kind="finite_difference")
    columns = [np.asarray(x) for x in (modes.omega2, modes.alpha, modes.strike, modes.modal_gain)]
    still = 2.0 * columns[3] / columns[0]  # m, under 2 N at the strike position
    slow = cases.modal_steps(*columns, HAMMER, 1 / RATE, 300, q0=still)
    pulse = cases.strike(modes, HAMMER, steps=512, free=model.pluck(modes, 2.0))
    assert _relative(pulse.force[:300], slow.force) < 1e-9
    assert _relative(pulse.hammer[:300], slow.hammer) < 1e-9


@pytest.mark.parametrize("rate", [44_100.0, 88_200.0])
def test_kernel_form_is_the_modal_stepping(rate):
    modes = cases.table(STRING, GEOMETRY, rate=rate, n_modes=64)
    columns = (np.asarray(x) for x in (modes.omega2, modes.alpha, modes.strike, modes.modal_gain))
    slow = cases.modal_steps(*columns, HAMMER, 1 / rate, 300)
    pulse = cases.strike(modes, HAMMER, steps=512)
    assert _relative(pulse.force[:300], slow.force) < 1e-12
    assert _relative(pulse.compression[:300], slow.compression) < 1e-11
    assert _relative(pulse.hammer[:300], slow.hammer) < 1e-12


# --- order of accuracy ----------------------------------------------------------------------------------------------

LIGHT = Hammer(K_H=1.1e10, mu=0.1, p=2.5, M_H=1e-3, v_H0=2.0)
ORDER_MODES, ORDER_SAMPLES, FACTORS = 16, 90, (1, 2, 4, 8, 16)


def _continuous_rows(n: int):
    beta = np.arange(1, n + 1) * math.pi / GEOMETRY.length
    omega2 = STRING.c**2 * beta**2 + STRING.kappa**2 * beta**4
    phi = np.asarray(cases.table(STRING, GEOMETRY, rate=RATE, n_modes=n).strike)
    return omega2, STRING.b1 + STRING.b2 * beta**2, phi, 2 * phi / GEOMETRY.mass


def _pulses(hammer: Hammer, samples: int):
    for factor in FACTORS:
        _, pulse = cases.hit(STRING, hammer, GEOMETRY, RATE * factor, n_modes=ORDER_MODES, steps=2048)
        yield tuple(np.asarray(x)[::factor][:samples] for x in (pulse.force, pulse.compression, pulse.hammer[:, 1]))


def _orders(hammer: Hammer, exact: tuple[np.ndarray, ...]):
    """Observed order of each halving for force, compression and hammer velocity, and Richardson's last error."""
    pulses = list(_pulses(hammer, exact[0].size))
    errors = np.array([[_relative(x, e) for x, e in zip(pulse, exact, strict=True)] for pulse in pulses])
    extrapolated = [_relative((4 * b - a) / 3, e) for a, b, e in zip(*pulses[-2:], exact, strict=True)]
    return np.log2(errors[:-1] / errors[1:]), max(extrapolated)


@pytest.mark.parametrize("hammer", [LIGHT, LIGHT._replace(mu=0.0), LIGHT._replace(K_H=1e16, p=4.0, mu=0.02)])
def test_order_two_against_the_equations_of_motion(hammer):
    exact = cases.exact_contact(*_continuous_rows(ORDER_MODES), hammer, np.arange(ORDER_SAMPLES) / RATE)
    orders, floor = _orders(hammer, (exact.force, exact.compression, exact.hammer[:, 1]))
    assert np.abs(orders - 2).max() < 0.1
    assert floor < 1e-6


def test_order_two_against_the_exact_solution_of_a_linear_felt():
    """With p = 1 and μ = 0 string, felt and hammer are a linear system during contact: a matrix exponential."""
    hammer = Hammer(K_H=5e4, mu=0.0, p=1.0, M_H=1e-3, v_H0=2.0)
    omega2, alpha, phi, gamma = _continuous_rows(ORDER_MODES)
    n = omega2.size
    A = np.zeros((2 * n + 2, 2 * n + 2))
    press = np.concatenate([-phi, np.zeros(n), [1.0, 0.0]])
    A[:n, n : 2 * n] = np.eye(n)
    A[n : 2 * n, :n], A[n : 2 * n, n : 2 * n] = -np.diag(omega2), -2 * np.diag(alpha)
    A[2 * n, 2 * n + 1] = 1.0
    A += hammer.K_H * np.outer(np.concatenate([np.zeros(n), gamma, [0.0, -1 / hammer.M_H]]), press)
    samples = 30
    start = np.concatenate([np.zeros(2 * n + 1), [hammer.v_H0]])
    states = np.stack([scipy.linalg.expm(A * (i / RATE)) @ start for i in range(samples)])
    assert np.all(states[1:] @ press > 0), "still touching"
    orders, floor = _orders(hammer, (hammer.K_H * states @ press, states @ press, states[:, -1]))
    assert np.abs(orders - 2).max() < 0.1
    assert floor < 1e-8


EPS = np.finfo(float).eps

# --- the felt law, everywhere in the box ----------------------------------------------------------------------------


def _check_scheme(string, hammer, geometry, modes, pulse) -> None:
    """Check that the results satisfy the equations of the scheme."""
    F, u, T = (np.asarray(x) for x in (pulse.force, pulse.compression, pulse.drive))
    y_H, v_H = np.asarray(pulse.hammer).T
    for array in (F, u, T, y_H, v_H):
        assert np.all(np.isfinite(array))
    assert F.min() >= 0.0
    assert np.all(F[u <= 0] == 0)
    a = float(modes.step) / 2
    g = np.asarray(model.kernel(modes, F.size))
    y_S = np.convolve(g, T)[: F.size]
    w = np.empty_like(u)
    w[0] = hammer.v_H0
    for n in range(1, u.size):
        w[n] = (u[n] - u[n - 1]) / a - w[n - 1]
    # Effect of rounding in u and w on the force: bounds allow felts of 1e10 N/m.
    loss, pressed = np.maximum(1 + hammer.mu * w, 0), np.maximum(u, 0)
    elastic = hammer.K_H * pressed**hammer.p
    speed_error = 64 * EPS * np.maximum.accumulate(np.abs(u) / a + np.abs(w))
    slack = 64 * EPS * hammer.p * elastic * (1 + hammer.mu * np.abs(w)) + elastic * hammer.mu * speed_error
    assert np.all(np.abs(elastic * loss - F) <= slack)
    # The root of the scalar equation.
    C = a**2 / hammer.M_H + g[0]
    scale = max(np.abs(y_H).max(), np.abs(y_S).max())
    assert np.all(np.abs(y_H - y_S - u) <= 1e-12 * scale + C * slack)
    assert np.abs(np.diff(v_H) + a / hammer.M_H * T[1:]).max() <= 1e-12 * np.abs(v_H).max()


def _log(name: str):
    box = PARAMETERS[name]
    return st.floats(math.log(box.lower), math.log(box.upper)).map(
        lambda x: min(max(math.exp(x), box.lower), box.upper)
    )


@st.composite
def struck_strings(draw):
    """Any hammer within bounds on any plausible string: f0 from 20 to 5,000 Hz, B up to 0.03."""
    length, f0 = draw(st.floats(0.05, 2.0)), math.exp(draw(st.floats(math.log(20), math.log(5000))))
    c = min(max(2 * length * f0, 20.0), 2000.0)
    B = math.exp(draw(st.floats(math.log(1e-5), math.log(0.03))))
    kappa = min(max(math.sqrt(B) * c * length / math.pi, 1e-3), 1e2)
    string = String(c, kappa, draw(_log("b1")), draw(st.floats(math.log(1e-12), math.log(1e-3)).map(math.exp)))
    strike = draw(st.floats(0.05, 0.5)) * length
    geometry = Geometry(
        length, math.exp(draw(st.floats(math.log(1e-4), math.log(0.5)))), strike,
        draw(st.floats(0.005, 0.09)) * length, 0.3 * length,
    )  # fmt: skip
    return string, Hammer(*(draw(_log(name)) for name in Hammer._fields)), geometry


@settings(max_examples=80, deadline=None, derandomize=True, suppress_health_check=[HealthCheck.too_slow])
@given(struck_strings())
def test_any_hammer_on_any_string_obeys_the_scheme(case):
    string, hammer, geometry = case
    modes, pulse = cases.hit(string, hammer, geometry, RATE)
    _check_scheme(string, hammer, geometry, modes, pulse)


@pytest.mark.parametrize("p", [1.0, 1.5, 2.5, 3.5, 5.0])
@pytest.mark.parametrize("v_H0", [0.01, 1.0, 20.0])
def test_exponents_and_velocities(p, v_H0):
    hammer = HAMMER._replace(p=p, K_H=30.0 / 3e-4**p, v_H0=v_H0)
    modes, pulse = cases.hit(STRING, hammer, GEOMETRY, RATE)
    _check_scheme(STRING, hammer, GEOMETRY, modes, pulse)
    assert float(pulse.force.max()) > 0.1 * v_H0


def test_nothing_moves_before_the_first_step():
    _, pulse = cases.hit(STRING, HAMMER, GEOMETRY, RATE)
    assert float(pulse.force[0]) == float(pulse.compression[0]) == 0.0
    assert np.asarray(pulse.hammer[0]).tolist() == [0.0, HAMMER.v_H0]


# --- ending and beginning again -------------------------------------------------------------------------------------

HARD = Hammer(K_H=1e13, mu=0.1, p=2.5, M_H=1e-3, v_H0=2.0)
BASS = String(c=155.0, kappa=0.6, b1=0.25, b2=1e-5)
RETURNS = {  # string, hammer, geometry: each touches at least twice
    "hard hammer": (STRING, HARD, GEOMETRY),
    "bass string": (BASS, HARD._replace(M_H=5e-3, K_H=1e12), Geometry(1.9, 0.1, 0.23, 0.02, 0.5)),
    "fifty times the string": (
        STRING._replace(b1=0.01), HARD._replace(M_H=0.1, v_H0=0.5), GEOMETRY._replace(mass=0.002),
    ),
    "light string": (STRING, HAMMER._replace(K_H=1e13, v_H0=5.0), GEOMETRY._replace(mass=2e-4, strike_position=0.45)),
}  # fmt: skip


def _touches(force) -> int:
    return int(np.sum(np.diff((np.asarray(force) > 0).astype(int)) == 1))


@pytest.mark.parametrize("name", RETURNS)
def test_contact_is_followed_until_it_is_over_for_good(name):
    string, hammer, geometry = RETURNS[name]
    for steps in (512, 2048, 8192):
        _, pulse = cases.hit(string, hammer, geometry, RATE, steps=steps)
        if bool(pulse.contact_ended):
            break
    assert bool(pulse.contact_ended)
    assert _touches(pulse.force) >= 2
    _, longer = cases.hit(string, hammer, geometry, RATE, steps=4 * steps)
    assert np.all(np.asarray(longer.force[steps:]) == 0)
    assert bool(longer.contact_ended)
    assert _relative(longer.force[:steps], pulse.force) < 1e-9


def test_an_interruption_is_not_taken_for_the_end():
    _, whole = cases.hit(STRING, HARD, GEOMETRY, RATE)
    _, part = cases.hit(STRING, HARD, GEOMETRY, RATE, steps=64)
    assert float(part.force[-1]) == 0.0
    assert float(part.compression[-1]) < 0.0
    assert np.asarray(whole.force[64:]).max() > 0.0
    assert not bool(part.contact_ended)
    assert bool(whole.contact_ended)


EXTREMES = {
    "fastest and hardest": (STRING, HAMMER._replace(v_H0=20.0, K_H=1e16, p=5.0), GEOMETRY),
    "linear": (STRING, HAMMER._replace(p=1.0, K_H=1e5, mu=1e-3), GEOMETRY),
    "highest treble": (
        String(795.0, 1.9, 9.0, 2e-3), Hammer(1e11, 0.1, 3.0, 2.2e-3, 4.0), Geometry(0.095, 4e-4, 0.011, 0.005, 0.05),
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", EXTREMES)
def test_simulate_holds_at_the_edges(name):
    string, hammer, geometry = EXTREMES[name]
    done = model.simulate(string, hammer, geometry, rate=44_100.0)
    _check_scheme(string, hammer, geometry, done.modes, done.pulse)
    assert bool(done.pulse.contact_ended)
    y = done.waveform(44_100.0, 4410)
    assert y.shape == (4410,)
    assert np.all(np.isfinite(y))
    assert np.abs(y).max() > 0
    assert 0 < done.contact_time < 1.0


def test_a_hammer_that_comes_back_touches_again():
    """Contacts are separated by intervals without compression, also if later contacts are weak."""
    done = model.simulate(STRING, HARD, GEOMETRY, rate=44_100.0)
    first, *later = done.contacts
    force, time = np.asarray(done.pulse.force), float(done.modes.step) * np.arange(len(done.pulse.force))
    assert later
    assert (first.start, first.stop) == (pytest.approx(time[1]), done.contact_time)
    assert done.last_touch == later[-1].stop > later[-1].start >= done.contact_time
    # Each contact has force from start to end, no force acts between them, and together they are the whole impulse.
    within = sum(((time >= c.start) & (time < c.stop)).astype(int) for c in done.contacts)
    assert set(within[force > 0]) == {1}
    assert max(c.force for c in done.contacts) == force.max()
    assert all(c.force == force[(time >= c.start) & (time < c.stop)].max() for c in done.contacts)
    free = (time >= done.contact_time) & (time < later[0].start)
    assert (force[free] == 0).all()
    assert (np.asarray(done.pulse.compression)[free] <= 0).any()


def test_a_loss_that_takes_all_force_for_a_moment_ends_no_contact():
    done = model.simulate(STRING, HAMMER, GEOMETRY, rate=44_100.0)
    force, u = np.zeros(12), np.array([0.0, 1, 2, 2, 1, 1, 0.5, -1, -1, 0.1, -1, -1])
    force[[1, 2, 4, 9]] = 3.0, 5.0, 1.0, 0.2
    made = done._replace(pulse=done.pulse._replace(force=force, compression=u))
    step = float(done.modes.step)
    found = [(c.start / step, c.stop / step, c.force) for c in made.contacts]
    # The second ends where the compression is 0: between 0.1 and -1.
    assert found == [pytest.approx((1, 5, 5.0)), pytest.approx((9, 9 + 0.1 / 1.1, 0.2))]


def test_simulate_says_when_a_contact_does_not_end(monkeypatch):
    simulate = importlib.import_module("pianofit.model.simulate")
    monkeypatch.setattr(simulate, "MAX_STEPS", simulate.FIRST_STEPS)
    with pytest.raises(FitError, match=r"M_H=0.1 kg: .* s; use a lighter"):
        model.simulate(STRING, HAMMER._replace(M_H=0.1), GEOMETRY)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"hammer": HAMMER._replace(p=0.5)}, "p=0.5 must be"),
        ({"string": STRING._replace(c=math.nan)}, "c=nan must be"),
        ({"geometry": GEOMETRY._replace(strike_position=0.005)}, "strike=0.005 m with width=0.02 m"),
        ({"geometry": GEOMETRY._replace(pickup=1.0)}, "pickup=1.0 m"),
        ({"geometry": GEOMETRY._replace(width=0.0)}, "width=0.0 m"),
        ({"rate": 10.0}, "rate=10.0 Hz"),
    ],
)
def test_simulate_names_what_it_cannot_use(change, message):
    arguments = {"string": STRING, "hammer": HAMMER, "geometry": GEOMETRY} | change
    with pytest.raises(PianofitError, match=message):
        model.simulate(**arguments)
