"""F as a function of JAX against finite differences and the fit's own minimum, and fits that start from a guess."""

from __future__ import annotations

import functools
import math
from multiprocessing.reduction import ForkingPickler

import jax
import numpy as np
import pytest

import pianofit
from pianofit import ParameterError

KEY = "C5"
# Factors of a guess: a network is off by tens of percent.
OFF = {"K_H": 1.5, "p": 1.02, "M_H": 0.8, "v_H0": 1.2, "mu": 1.4}


@functools.cache
def made() -> pianofit.SyntheticRecording:
    it = pianofit.typical(KEY)
    return pianofit.synthetic_recording(it.string, it.hammer, it.geometry, seconds=1.5, noise_db=60)


@functools.cache
def objective() -> pianofit.RecordingObjective:
    return pianofit.objective(made().recording, setup=made().setup)


@functools.cache
def fitted(budget: int | None = None) -> pianofit.Result:
    guess = {name: factor * made().true[name] for name, factor in OFF.items()}
    more = {} if budget is None else {"start": guess, "budget": budget}
    return pianofit.fit(made().recording, setup=made().setup, progress=False, **more)


def test_the_gradient_is_that_of_finite_differences():
    F = objective()
    value, slope = F.value_and_gradient(F.start)
    assert math.isfinite(value)
    # The frequencies determine c and κ to 1e-6, so F is steep there. With steps of 3e-7 the difference errs by 1e-3.
    for i, step in enumerate([1e-7, 1e-7, *[1e-5] * (len(F.names) - 2)]):
        change = step * np.eye(len(F.start))[i]
        (above, _), (below, _) = (F.value_and_gradient(F.start + sign * change) for sign in (1, -1))
        assert slope[i] == pytest.approx((above - below) / (2 * step), rel=1e-3, abs=1e-3), F.names[i]


def test_it_is_sent_to_another_process():
    F = objective()
    value, slope = F.value_and_gradient(F.start)  # it now has a compiled program
    received = ForkingPickler.loads(ForkingPickler.dumps(F)).value_and_gradient(F.start)
    assert received[0] == value
    assert (received[1] == slope).all()


def test_it_is_batched_by_jax_inside_a_float32_program():
    F = objective()
    points = np.tile(F.start, (3, 1))
    points[:, 4:] += 0.01 * np.random.default_rng(0).standard_normal(points[:, 4:].shape)
    with jax.enable_x64(True):
        values = jax.jit(jax.vmap(F))(points)
    for point, value in zip(points, values, strict=True):
        assert float(value) == pytest.approx(F.value_and_gradient(point)[0])
    assert not jax.config.jax_enable_x64


def test_it_is_lowest_where_the_fit_ends():
    result, F = fitted(), objective()
    best = F.at(F.log_values({name: result.parameters[name].value for name in F.names}))
    value, slope = best.value_and_gradient(best.start)
    assert value == pytest.approx(result.fit.minima[0].negative_log_posterior, abs=0.05)
    # The decrease that a step of Newton would bring, with the curvature by the fit's intervals.
    sd = np.array([np.ptp(np.log(result.parameters[name].interval)) / 3.92 for name in F.names])
    assert 0.5 * (slope * sd) @ (slope * sd) < 0.1 * len(sd)
    further, _ = best.value_and_gradient(best.log_values({"M_H": 1.1 * result.parameters["M_H"].value}))
    assert further > value + 1


def test_a_guess_with_a_small_budget_finds_the_same_minimum():
    whole, near = fitted(), fitted(12)
    assert near.fit.minima[0].negative_log_posterior < whole.fit.minima[0].negative_log_posterior + 0.1
    for name in ("c", "kappa", "b1", "K_H", "p", "M_H", "v_H0"):
        low, high = whole.parameters[name].interval
        value = near.parameters[name].value
        assert low < value < high
        assert abs(math.log(value / whole.parameters[name].value)) < 0.1 * math.log(high / low)


def test_a_poor_guess_is_one_start_of_many_without_a_budget():
    """A guess joins the search, so it cannot make it worse."""
    guesses = [{"K_H": 100 * made().true["K_H"], "M_H": 5 * made().true["M_H"]}, {"M_H": made().true["M_H"]}]
    result = pianofit.fit(made().recording, setup=made().setup, progress=False, start=guesses)
    best = fitted().fit.minima[0].negative_log_posterior
    assert result.fit.minima[0].negative_log_posterior < best + 0.1


@pytest.mark.parametrize(
    ("given", "word"),
    [
        ({"start": {"K_H": -1.0}}, "K_H"),
        ({"start": {"K_H": "stiff"}}, "K_H"),
        ({"start": {"tension": 700.0}}, "tension"),
        ({"start": {"p": 9.0}}, "p=9 must be within its bounds, 1 to 5"),
        ({"start": 3.0}, "start"),
        ({"budget": 5}, "budget"),
        ({"start": {"p": 2.5}, "budget": 0}, "budget"),
    ],
)
def test_a_bad_guess_is_rejected(given, word):
    with pytest.raises(ParameterError, match=word):
        pianofit.fit(made().recording, setup=made().setup, progress=False, **given)


def test_bad_arguments_are_rejected():
    F = objective()
    with pytest.raises(ValueError, match="read-only"):
        F.start[0] = 0.0
    for wrong in (F.start[:3], F.start[:1]):
        for function in (F, F.value_and_gradient, F.values):
            with pytest.raises(ParameterError, match="log_values"):
                function(wrong)
    with pytest.raises(ParameterError, match="tension"):
        F.log_values({"tension": 700.0})
    with pytest.raises(ParameterError, match="M_H=True"):
        F.log_values({"M_H": True})
    with pytest.raises(ParameterError, match="float64"):
        jax.jit(F)(F.start)
    assert F.values(F.start)["M_H"] == pytest.approx(float(np.exp(F.start[F.names.index("M_H")])))
