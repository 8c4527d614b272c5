"""The felt laws in one formula: a monotone equation per step, limits, derivatives, and the choice of a law."""

from __future__ import annotations

import decimal
import math

import jax
import jax.numpy as jnp
import model_cases as cases
import numpy as np
import pytest
from felt_cases import ELASTIC, HAMMERS, RETURNING, STULOV, base, law, memories, relative, speeds
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from model_cases import GEOMETRY, HAMMER, RATE, STRING

from pianofit import model
from pianofit.errors import ParameterError
from pianofit.felt import ALL_PARAMETERS, LAWS, RelaxingHammer, SoftHammer, make_hammer, steps
from pianofit.felt.steps import relaxing
from pianofit.parameters import Geometry, Hammer, String

pytestmark = pytest.mark.usefixtures("float64")

# --- one monotone equation per step -----------------------------------------------------------------------------------


def _log(name: str):
    box = ALL_PARAMETERS[name]
    return st.floats(math.log(box.lower), math.log(box.upper)).map(
        lambda x: min(max(math.exp(x), box.lower), box.upper)
    )


@st.composite
def hammers(draw):
    """Any hammer within bounds, without loss, with one or with both, and with a skin."""
    values = {name: draw(_log(name)) for name in RelaxingHammer._fields}
    hammer = RelaxingHammer(**values)
    hammer = hammer._replace(mu=draw(st.sampled_from([0.0, hammer.mu])))
    return draw(st.sampled_from([hammer, Hammer(*hammer[:5]), SoftHammer(*hammer[:5], draw(_log("skin")))]))


_equation = jax.jit(jax.vmap(relaxing.residual, in_axes=(0, *[None] * 8)))
_weights = jax.jit(steps.memory_weights)


@jax.jit
def _solved(e, u_old, w_old, f_old, c, a, hammer, weights, memory):
    u = steps.compression(e, u_old, w_old, f_old, c, a, hammer, weights, memory)
    return u, steps.force(u, (u - u_old) / a - w_old, e - c * f_old, c, a, hammer, weights, memory)


@settings(max_examples=300, deadline=None, derandomize=True)
@given(
    hammers(), st.floats(-6.0, -2.5), st.floats(-1.0, 1.0), st.floats(-20.0, 20.0), st.floats(0.0, 1.0),
    st.floats(-7.0, -4.9), st.floats(-8.0, -4.0),
)  # fmt: skip
def test_each_step_is_one_monotone_equation_with_its_root_in_the_bracket(hammer, size, before, w, kept, step, give):
    """u + C F(u) - upper rises from below 0 at u = 0 to 0 or more at u = upper, and is 0 at the computed root."""
    upper, a, c = 10.0**size, 10.0**step / 2, 10.0**give
    u_old = before * upper
    weights = _weights(hammer, 2 * a)
    memory = None if weights is None else kept * upper**hammer.p
    rest = (upper, u_old, w, c, a, hammer, weights, memory)
    u = np.concatenate([np.linspace(0.0, upper, 300), upper * np.geomspace(1e-12, 1.0, 200)])
    u.sort()
    residual, slope = (np.asarray(x) for x in _equation(u, *rest))
    # If elastic force and relaxation nearly cancel, each of them determines the rounding.
    noise = 64 * np.finfo(float).eps * (upper + (0.0 if weights is None else c * hammer.K_H * hammer.epsilon * memory))
    noise = noise + 64 * np.finfo(float).eps * np.abs(residual) * (1 + hammer.mu * (abs(w) + upper / a))
    assert np.all(np.diff(residual) >= -noise[1:])
    assert np.all(slope >= 1.0)
    assert residual[0] < 0.0
    assert residual[-1] >= 0.0
    root, force = _solved(upper, u_old, w, 0.0, c, a, hammer, weights, memory)
    assert 0.0 <= root <= upper
    assert force >= 0.0
    at, slope = _equation(np.array([float(root)]), *rest)
    assert abs(at[0]) <= 1e-13 * slope[0] * upper + noise.min()
    assert float(root) + c * float(force) == pytest.approx(upper, rel=1e-9, abs=float(noise.min()))


@settings(max_examples=60, deadline=None, derandomize=True, suppress_health_check=[HealthCheck.too_slow])
@given(hammers(), st.floats(math.log(20), math.log(3000)), st.floats(0.05, 2.0), st.floats(math.log(1e-4), -1.0))
def test_any_felt_on_any_string_obeys_its_law(hammer, pitch, length, mass):
    string = String(min(max(2 * length * math.exp(pitch), 20.0), 2000.0), 0.5, 0.5, 1e-5)
    geometry = Geometry(length, math.exp(mass), 0.12 * length, 0.02 * length, 0.3 * length)
    modes, pulse = cases.hit(string, hammer, geometry, RATE)
    F, u, step = np.asarray(pulse.force), np.asarray(pulse.compression), float(modes.step)
    assert all(np.all(np.isfinite(np.asarray(x))) for x in pulse)
    assert F.min() >= 0.0
    assert np.all(F[u <= 0] == 0)
    w, c = speeds(u, hammer, step), memories(u, hammer, step)
    # Effect of rounding in u, w and c on the force.
    a = base(u, hammer) ** hammer.p
    blurred = hammer.mu * np.maximum.accumulate(np.abs(2 * u / step) + np.abs(w))
    slack = 512 * np.finfo(float).eps * 2 * hammer.K_H * hammer.p * (a * (1 + blurred) + np.maximum.accumulate(a))
    assert np.all(np.abs(F - law(u, w, c, hammer)) <= slack)


# --- limits ----------------------------------------------------------------------------------------------------------


def force_of(hammer) -> np.ndarray:
    return np.asarray(cases.hit(STRING, hammer, GEOMETRY, RATE)[1].force)


def test_a_felt_that_forgets_slowly_is_stiff_and_one_that_forgets_at_once_is_soft():
    """The difference from either limit is proportional to τ over contact duration, or to its inverse."""
    for taus, limit in (((1.0, 100.0), ELASTIC), ((1e-7, 1e-9), ELASTIC._replace(K_H=0.6 * ELASTIC.K_H))):
        near, nearer = (relative(force_of(STULOV._replace(tau=tau)), force_of(limit)) for tau in taus)
        assert nearer < 1e-4
        assert nearer == pytest.approx(near / 100, rel=0.2)


@pytest.mark.parametrize("tau", [1e-6, 1e-4, 1e-2])
def test_without_a_share_the_memory_is_not_felt(tau):
    assert relative(force_of(STULOV._replace(epsilon=0.0, tau=tau)), force_of(ELASTIC)) < 1e-13
    assert relative(force_of(RelaxingHammer(*HAMMER, epsilon=0.0, tau=tau)), force_of(HAMMER)) < 1e-12
    small = relative(force_of(STULOV._replace(epsilon=1e-6, tau=tau)), force_of(ELASTIC))
    assert 0 < small < 1e-5


def test_hunt_and_crossleys_felt_without_loss_is_the_power_law():
    u = np.asarray(cases.hit(STRING, ELASTIC, GEOMETRY, RATE)[1].compression)
    np.testing.assert_allclose(force_of(ELASTIC), ELASTIC.K_H * np.maximum(u, 0.0) ** ELASTIC.p, rtol=1e-9, atol=1e-9)
    assert 1e-9 < relative(force_of(HAMMER._replace(mu=1e-7)), force_of(ELASTIC)) < 1e-6


@pytest.mark.parametrize("ratio", [1e-9, 1e-5, 1e-2, 0.3, 0.4999, 0.5, 0.7, 2.0, 11.0, 1e3])
def test_the_weights_of_the_memory_are_exact_to_rounding(ratio):
    found = _weights(STULOV._replace(tau=1e-5), 1e-5 * ratio)
    with decimal.localcontext(prec=60):
        s = decimal.Decimal.from_float(1e-5 * ratio) / decimal.Decimal.from_float(1e-5)
        k = (-s).exp()
        exact = (k, (1 - k) / s - k, 1 - (1 - k) / s)
    np.testing.assert_allclose([float(x) for x in found], [float(x) for x in exact], rtol=2e-14, atol=1e-300)
    assert 0 < float(found.new) < 1


# --- derivatives -----------------------------------------------------------------------------------------------------


def outputs(values: dict) -> dict:
    string = String(*(values[n] for n in String._fields))
    modes = model.mode_table(string, GEOMETRY, rate=RATE, n_modes=64)
    pulse = model.strike(modes, make_hammer(values), steps=512)
    amplitude = model.modal_amplitudes(modes, pulse.drive)[:20]
    return {
        "force": pulse.force, "compression": pulse.compression[:250], "work": pulse.work[None],
        "ringing": jnp.concatenate([amplitude.real, amplitude.imag]),
    }  # fmt: skip


_outputs = jax.jit(outputs)
_slopes = jax.jit(jax.jacfwd(outputs))
_pull = jax.jit(jax.grad(lambda v: sum((x * jnp.cos(jnp.arange(x.size))).sum() for x in outputs(v).values())))
DIFFERENTIATED = ("stulov", "stulov, faster than the step", "stulov, slow", "both losses")


@pytest.mark.parametrize("name", [*DIFFERENTIATED, "returning"])
def test_derivatives_by_every_parameter_against_central_differences(name):
    """With a relative step of 5e-6 truncation is negligible, and rounding is 1e-12 of the value over the step."""
    hammer = RelaxingHammer(*RETURNING, epsilon=0.5, tau=2e-4) if name == "returning" else HAMMERS[name]
    at, relative_step = {**STRING._asdict(), **hammer._asdict()}, 5e-6
    exact, values = _slopes(at), _outputs(at)
    for parameter, value in at.items():
        h = relative_step * (value or 1.0)
        above, below = (_outputs(at | {parameter: value + sign * h}) for sign in (1, -1))
        for output in values:
            found = np.asarray(exact[output][parameter]) * h
            expected = np.asarray((above[output] - below[output]) / 2)
            allowed = 1e-5 * np.abs(expected).max() + 1e-12 * float(jnp.abs(values[output]).max())
            assert np.all(np.isfinite(found))
            assert np.abs(found - expected).max() <= allowed, (parameter, output)


@pytest.mark.parametrize("name", DIFFERENTIATED[:1])
def test_reverse_mode_gives_the_same_derivatives(name):
    at = {**STRING._asdict(), **HAMMERS[name]._asdict()}
    found, rows = _pull(at), _slopes(at)
    for parameter in at:
        by = [float(np.asarray(rows[o][parameter]) @ np.cos(np.arange(len(rows[o][parameter])))) for o in rows]
        assert float(found[parameter]) == pytest.approx(sum(by), rel=1e-8, abs=1e-9 * max(map(abs, by)))


# --- one interface ---------------------------------------------------------------------------------------------------


def test_simulate_follows_a_felt_with_memory_to_the_end_of_its_contact():
    done = model.simulate(STRING, STULOV, GEOMETRY, rate=44_100.0)
    assert bool(done.pulse.contact_ended)
    stiff, soft = (
        model.simulate(STRING, ELASTIC._replace(K_H=K), GEOMETRY).contact_time for K in (STULOV.K_H, 0.6 * STULOV.K_H)
    )
    assert 0.9 * stiff < done.contact_time < soft
    assert np.abs(done.waveform(44_100.0, 4410)).max() > 0


@pytest.mark.parametrize(
    ("hammer", "message"),
    [
        (STULOV._replace(epsilon=1.0), "hammer: epsilon=1.0 must be a number from 0.001 to 0.99"),
        (STULOV._replace(tau=0.0), "hammer: tau=0.0 must be a number from 1e-06 to 0.01 s"),
        (STULOV._replace(mu=-0.1), "hammer: mu=-0.1 must be"),
    ],
)
def test_simulate_refuses_a_felt_outside_its_box(hammer, message):
    with pytest.raises(ParameterError, match=message):
        model.simulate(STRING, hammer, GEOMETRY)


def test_the_parameters_given_choose_the_felt():
    values = {**STRING._asdict(), **HAMMER._asdict()}
    assert make_hammer(values) == HAMMER
    assert make_hammer(values | {"mu": 0.0, "epsilon": 0.4, "tau": 60e-6}) == STULOV
    with pytest.raises(ParameterError, match=r"--set: .* epsilon and tau"):
        make_hammer(values | {"tau": 1e-5}, "--set")


@pytest.mark.parametrize("name", LAWS)
def test_each_law_has_the_parameters_that_it_is_said_to_have(name):
    """The force depends only on these; the others are M_H, v_H0, or 0."""
    hammer = {"power": ELASTIC, "hunt-crossley": HAMMER, "stulov": STULOV, "soft-skin": soft_hammer(1e-4)}[name]
    assert set(LAWS[name].parameters) <= set(ALL_PARAMETERS)
    blow, u, w = ("M_H", "v_H0"), jnp.asarray(1e-4), jnp.asarray(0.5)
    assert {n for n, value in hammer._asdict().items() if value and n not in blow} == set(LAWS[name].parameters)
    assert felt_force(u, w, hammer, 1e-11) == pytest.approx(float(law(1e-4, 0.5, 1e-11, hammer)))


def felt_force(u, w, hammer, memory=0.0) -> float:
    return float(relaxing.felt_force(jnp.asarray(u), jnp.asarray(w), hammer, memory))


def soft_hammer(skin: float):
    return SoftHammer(*HAMMER, skin)


def test_a_soft_skin_is_a_power_law_above_and_one_of_twice_the_exponent_below():
    u = np.geomspace(1e-5, 1e-3, 30)

    def exponent(skin: float) -> np.ndarray:
        return np.gradient(np.log([felt_force(x, 0.0, soft_hammer(skin)) for x in u]), np.log(u))

    np.testing.assert_allclose(exponent(1e-6)[-5:], HAMMER.p, rtol=0.01)
    np.testing.assert_allclose(exponent(3e-3)[:5], 2 * HAMMER.p, rtol=0.02)
    with_thin_skin, without = (felt_force(3e-4, 0.5, hammer) for hammer in (soft_hammer(1e-6), HAMMER))
    assert with_thin_skin == pytest.approx(without * (300 / 301) ** HAMMER.p, rel=1e-12)


def test_the_energy_of_a_soft_skin_is_the_work_of_its_force():
    hammer = soft_hammer(2e-4)
    stored = jax.grad(lambda u: LAWS["soft-skin"].storage(u, hammer))
    for u in (1e-5, 1e-4, 1e-3):
        assert float(stored(u)) == pytest.approx(felt_force(u, 0.0, hammer), rel=1e-8)
