"""A user's felt law in simulations: compared with the package's laws, checked, differentiated, rendered."""

from __future__ import annotations

from multiprocessing.reduction import ForkingPickler

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from felt_cases import RETURNING
from model_cases import GEOMETRY, HAMMER, RATE, STRING, strike, table

import pianofit
from pianofit import FeltLaw, Parameter, ParameterError, model
from pianofit.excitation import OTHERS
from pianofit.felt import LAWS, law_of
from pianofit.parameters import PARAMETERS
from pianofit.playback.cached_strike import strike_string, string_tables

pytestmark = pytest.mark.usefixtures("float64")

BOXES = {name: PARAMETERS[name] for name in ("K_H", "mu", "p")}


def hunt_crossley(u, w, felt):
    return felt.K_H * u**felt.p * jnp.maximum(1 + felt.mu * w, 0.0)


def spring(u, felt):
    return felt.K_H * u ** (felt.p + 1) / (felt.p + 1)


# The law of Hunt and Crossley as a user would write it.
AGAIN = FeltLaw("Again", BOXES, hunt_crossley, spring)


def again(hammer):
    return AGAIN.hammer_type(*hammer[:3], hammer.M_H, hammer.v_H0)


HARD, LINEAR = HAMMER._replace(v_H0=5.0, p=3.5, K_H=1e13), HAMMER._replace(p=1.0, K_H=1e4)


@pytest.mark.parametrize("hammer", [HAMMER, HARD, LINEAR])
@pytest.mark.parametrize("kind", ["continuous", "finite_difference"])
def test_a_law_written_outside_strikes_as_the_same_law_inside(hammer, kind):
    modes = table(STRING, GEOMETRY, rate=RATE, n_modes=48, kind=kind)
    inside, outside = (strike(modes, h, steps=1024) for h in (hammer, again(hammer)))
    for name in ("drive", "compression", "hammer"):
        a, b = getattr(inside, name), getattr(outside, name)
        np.testing.assert_allclose(b, a, atol=1e-11 * np.abs(a).max(), err_msg=name)


def test_a_felt_that_touches_again_does_so_by_an_outside_law():
    modes = table(STRING, GEOMETRY, rate=RATE, n_modes=48)
    inside, outside = (strike(modes, h, steps=1024) for h in (RETURNING, again(RETURNING)))
    assert (np.diff((np.asarray(inside.force) > 0).astype(int)) == 1).sum() > 1
    np.testing.assert_allclose(outside.force, inside.force, atol=1e-9 * np.abs(inside.force).max())


def test_its_derivatives_are_those_of_the_law():
    modes = table(STRING, GEOMETRY, rate=RATE, n_modes=32)

    def level(hammer):
        return model.levels(modes, model.strike(modes, hammer, steps=512).drive)[4]

    inside, outside = (jax.jit(jax.grad(level))(jax.tree.map(float, h)) for h in (HAMMER, again(HAMMER)))
    for name in HAMMER._fields:
        assert float(getattr(outside, name)) == pytest.approx(float(getattr(inside, name)), rel=1e-7), name


def test_a_law_without_loss_keeps_the_energy_of_hammer_and_string():
    """The string receives the energy that the hammer loses: a released felt stores none."""
    law = FeltLaw("Tanh", BOXES, lambda u, _, felt: felt.K_H * u * (1 + jnp.tanh(u / 1e-4)))  # stiffens, then linear
    felt = law.hammer(K_H=2e4, mu=0.1, p=1.0, M_H=5e-3, v_H0=1.5)
    struck = model.simulate(STRING._replace(b1=1e-3, b2=1e-12), felt, GEOMETRY, oversampling=32)
    before, after = (0.5 * felt.M_H * float(v) ** 2 for v in (felt.v_H0, struck.pulse.hammer[-1, 1]))
    assert after + float(struck.pulse.work) == pytest.approx(before, rel=1e-5)


def test_a_note_with_it_renders_and_has_levels():
    felt = AGAIN.hammer(**{name: getattr(HAMMER, name) for name in HAMMER._fields})
    own, outside = (pianofit.Note(STRING, h, GEOMETRY, "velocity", 0.1) for h in (HAMMER, felt))
    np.testing.assert_allclose(outside.render(2.0, seconds=0.1), own.render(2.0, seconds=0.1), atol=1e-9)
    np.testing.assert_allclose(
        outside.levels(np.array([0.5, 3.0]), 10), own.levels(np.array([0.5, 3.0]), 10), atol=1e-6
    )


def active(u, w, felt):
    """A felt with a larger force during release than during compression."""
    return felt.K_H * u**felt.p * (1 - 0.1 * felt.mu * w)


GOOD = {name: getattr(HAMMER, name) for name in HAMMER._fields}


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: AGAIN.hammer(K_H=1e9), "felt law Again: .* mu, p, M_H, v_H0"),
        (lambda: AGAIN.hammer(**GOOD | {"p": 9.0}), "felt law Again: p=9.0 must be a number from 1 to 5$"),
        (lambda: AGAIN.hammer(**GOOD, colour=1.0), "felt law Again: .*'colour'"),
        (lambda: FeltLaw("My felt", BOXES, hunt_crossley), "felt law 'My felt': the name must be letters"),
        (
            lambda: FeltLaw("F", {"M_H": Parameter("kg", "", 0.0, 1.0)}, hunt_crossley),
            "'M_H' must be a name other than L, M_H",
        ),
        (lambda: FeltLaw("F", BOXES, hunt_crossley, formula="F = u"), "felt law F: formula='F = u' must be a tuple"),
        (
            lambda: FeltLaw("Gives", BOXES, active, spring).hammer(**GOOD),
            "felt law Gives: at u=.*energy.*storage",
        ),
        (
            lambda: strike_string(
                string_tables(pianofit.Note(STRING, HAMMER, GEOMETRY, "velocity", 1.0), 44_100),
                AGAIN.hammer(**GOOD), "C4",
            ),
            "C4: felt law Again",
        ),
    ],
    ids=["missing", "box", "unknown", "name", "clash", "formula", "active", "played"],
)  # fmt: skip
def test_what_is_no_felt_is_refused(make, message):
    with pytest.raises(ParameterError, match=message):
        make()


def test_a_pulse_that_is_cut_off_is_refused_and_marked_where_traced():
    modes = model.mode_table(STRING, GEOMETRY, rate=RATE, n_modes=32)
    with pytest.raises(ParameterError, match=r"steps=64: .* s; use more steps"):
        model.strike(modes, HAMMER, steps=64)
    with pytest.raises(ParameterError, match=r"K_H=-1e\+10 must be"):
        model.strike(modes, HAMMER._replace(K_H=-1e10), steps=640)
    assert not model.strike(modes, HAMMER, steps=64, whole=False).contact_ended
    assert not jax.jit(lambda h: model.strike(modes, h, steps=64).contact_ended)(HAMMER)


def test_a_hammer_of_a_law_is_sent_to_another_process():
    """The laws of this package remain the same objects, which are compared by identity."""
    felt = again(HAMMER)
    received = ForkingPickler.loads(ForkingPickler.dumps(felt))
    assert received == felt
    assert received.law.name == AGAIN.name
    assert law_of(received) is received.law
    for law in (*LAWS.values(), *OTHERS.values()):
        assert ForkingPickler.loads(ForkingPickler.dumps(law)) is law
