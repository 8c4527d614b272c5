"""Intervals by Laplace's approximation, profiles and draws of one F agree where F is nearly quadratic."""

from __future__ import annotations

import functools
import re
import sys
from dataclasses import replace

import jax
import jax.flatten_util
import jax.numpy as jnp
import numpy as np
import pytest

from pianofit import ParameterError, Setup, analyse, fit, recording_from_samples
from pianofit.felt import DEFAULT_LAW, LAWS
from pianofit.inference import (
    Estimate,
    FitProblem,
    InferenceResult,
    Interval,
    build_problem,
    check_intervals,
    map_estimate,
    nuts,
)
from pianofit.inference.laplace import laplace, unbounded_warnings
from pianofit.inference.nuts import density_context, log_density, random_start, reflect_into_bounds
from pianofit.inference.objective import Objective
from pianofit.inference.optimiser import minimise
from pianofit.inference.parametrisation import names_of
from pianofit.inference.pipeline import compute_intervals
from pianofit.inference.profile import DELTA_NLL_95, _Profile, profiles
from pianofit.parameters import STRING_NAMES
from pianofit.result import build_result
from pianofit.synthetic import demo_recording

FORCE, P = (names_of(DEFAULT_LAW).index(name) for name in ("K_H", "p"))
pytestmark = pytest.mark.usefixtures("float64")

# Parameters that levels determine: their profiles are nearly quadratic. Each parameter of the string depends on a few
# frequencies and decays, whose heavy tails and unknown excess Laplace's approximation does not describe.
HAMMER = ("K_H", "p", "mu", "M_H", "v_H0")


@functools.cache
def posed() -> FitProblem:
    return build_problem([measured()], [analyse(measured())], setup())


@functools.cache
def synthetic():
    return demo_recording(50.0, 0)


def setup():
    return synthetic().setup


@functools.cache
def measured():
    return recording_from_samples(synthetic().samples, synthetic().rate, name="synthetic")


@functools.cache
def fitted() -> Estimate:
    return map_estimate(posed())


@functools.cache
def profiled():
    view = compute_intervals(posed(), fitted(), "profile", 0, lambda *_: None)
    assert view is not None
    return view


def halves(intervals: dict[str, Interval], found: Estimate) -> dict[str, tuple[float, ...]]:
    """Distance of both ends from the minimum, in Laplace's standard deviations × 1.96; (-1, 1) if they agree."""
    posterior, names = found.posterior, posed().reported_parameters
    ends = {
        name: np.log([intervals[name].low, intervals[name].high]) - posterior.mean[0, i] for name, i in names.items()
    }
    return {name: tuple(ends[name] / (1.96 * posterior.covariance[0, i, i] ** 0.5)) for name, i in names.items()}


# --- profiles ---------------------------------------------------------------------------------------------------------


def test_invariants_are_those_of_the_view():
    """A ratio to a given value has the parameter's own interval; `interval_method` names the method of every other."""
    fit = build_result(InferenceResult(posed(), fitted(), 0, profiled())).fit
    table, invariants = fit.parameters, fit.invariants
    for name, of, over in (("M_H/M_S", "M_H", "M_S"), ("x0/L", "x0", "L")):
        if table[of].interval is not None:
            ends = np.array(table[of].interval) / table[over].value
            np.testing.assert_allclose(invariants[name].interval, ends, rtol=1e-12)
            assert invariants[name].interval_method == "profile"
    assert invariants["B"].interval_method == "laplace"
    assert fit.reference.stroke_interval == table["v_H0"].interval


@pytest.mark.parametrize("law", LAWS)
def test_names_are_those_of_the_felt_s_law(law):
    """The covariance and the draws contain only the parameters of the felt law."""
    names = build_problem([measured()], [analyse(measured())], Setup(length=1.0, felt=law)).parameter_indices
    assert {*names} == {*STRING_NAMES, *LAWS[law].parameters, "M_H", "x0", "width", "v_H0"}
    if law == posed().parametrisation.law.name:
        covariance = build_result(InferenceResult(posed(), fitted(), 0)).covariance
        assert covariance.names == tuple(names)
        at = posed().reported_parameters["M_H"]
        assert covariance["M_H", "M_H"] == fitted().posterior.covariance[0, at, at]


def test_an_interval_ends_at_its_box_and_says_so():
    problem, found = posed(), fitted()
    i = problem.parametrisation.index_of("M_H")
    low, high = np.log(build_result(InferenceResult(problem, found, 0)).parameters["M_H"].interval)
    middle = 0.5 * (low + high)
    upper = problem.parametrisation.upper.copy()
    upper[i] = middle + 0.25 * (high - low)
    tight = replace(problem, parametrisation=replace(problem.parametrisation, upper=upper))
    mass = build_result(InferenceResult(tight, found, 0)).parameters["M_H"]
    assert mass.interval_unbounded == ("high",)
    np.testing.assert_allclose(np.log(mass.interval), [low, upper[i]])


@pytest.mark.slow
def test_profiles_of_a_calibrated_twin_agree_with_laplace():
    found = halves(profiled().intervals, fitted())
    assert set(found) == {*HAMMER, "c", "kappa", "b1", "b2", "width"}
    for name, ends in found.items():
        assert ends == pytest.approx((-1, 1), abs=0.15 if name in HAMMER else 0.25), name
    assert not profiled().messages


def test_a_profile_rises_to_its_ends_and_says_how():
    for name, diagnostics in profiled().diagnostics["profile"].items():
        interval = profiled().intervals[name]
        values, rises = np.array(diagnostics["points"]).T
        assert (np.diff(values) > 0).all()
        assert rises.min() > -1e-3
        assert rises[[0, -1]] == pytest.approx(DELTA_NLL_95, rel=0.3)
        assert (interval.method, interval.unbounded) == ("profile", ())
        assert diagnostics["evaluations"] == len(values)
        # Where F is quadratic in the logarithm, √(rise) is linear in it.
        low, high = interval.low, interval.high
        inner = (values > low) & (values < high) & (rises > 0.1)
        distance = np.abs(np.log(values / values[rises.argmin()]))
        reach = np.abs(np.log(np.array([low, high]) / values[rises.argmin()]))
        share = distance / np.where(values < values[rises.argmin()], reach[0], reach[1])
        np.testing.assert_allclose(share[inner], np.sqrt(rises / DELTA_NLL_95)[inner], atol=0.15)


@pytest.mark.parametrize("name", ["p", "K_H"])
def test_a_bound_that_cuts_a_profile_leaves_it_open(name):
    i, u = posed().reported_parameters[name], posed().parametrisation
    mean, sd = fitted().posterior.mean[0, i], fitted().posterior.covariance[0, i, i] ** 0.5
    bound = mean + sd
    upper = u.upper.copy()
    upper[i] = bound
    profile = _Profile(replace(posed(), parametrisation=replace(u, upper=upper)), fitted())
    branch = profile.trace_branch(i, 1.0)
    assert branch.open
    assert branch.end == bound
    # A half with known hyperparameters. The standard deviation integrates them, and a profile minimises by them.
    assert 0.45 < branch.points[-1].F - profile.start.F < 1.4
    assert not profile.trace_branch(i, -1.0).open


def test_where_k_h_is_held_the_force_follows_p():
    """With K_H at a bound the optimiser finds the minimum with a fixed K_H along the ridge."""
    profile, x = _Profile(posed(), fitted()), fitted().posterior.mean[0]
    cov = fitted().posterior.covariance[0]
    point = profile._fixed(FORCE, x[FORCE] + cov[FORCE, FORCE] ** 0.5, profile.start, x)
    assert point.logs[FORCE] == pytest.approx(x[FORCE] + cov[FORCE, FORCE] ** 0.5, abs=1e-9)
    assert point.logs[P] - x[P] == pytest.approx(cov[FORCE, P] / cov[FORCE, FORCE] ** 0.5, rel=0.1)
    assert 0.45 < point.F - profile.start.F < 1.4  # as above


@pytest.mark.slow
def test_a_profile_that_finds_lower_ground_says_so():
    minima = fitted().minima
    theta = minima.candidates.theta.copy()
    worse = fitted()._replace(minima=minima._replace(nll=minima.nll + 2.0), posterior=fitted().posterior)
    view = profiles(posed(), worse)
    assert any("lower by 2" in text for text in view.messages)
    np.testing.assert_array_equal(theta, minima.candidates.theta)


def test_open_ends_are_named():
    ends = {"c": ("low",), "p": ("low", "high"), "mu": ()}
    messages = unbounded_warnings({name: Interval(1.0, 2.0, "profile", sides) for name, sides in ends.items()})
    assert len(messages) == 2
    assert re.search(r"\bp: .*whole", messages[0])
    assert re.search(r"\bc below\b", messages[1])


@pytest.mark.slow
def test_a_fit_has_the_intervals_it_was_asked_for():
    result = fit(measured(), setup=setup(), intervals="profile")
    for name, interval in profiled().intervals.items():
        quantity = result.parameters[name]
        assert quantity.interval_method == "profile"
        np.testing.assert_allclose(quantity.interval, [interval.low, interval.high], rtol=1e-3)
    assert set(result.fit.diagnostics.profile) == set(profiled().intervals)


# --- the density that is sampled --------------------------------------------------------------------------------------


@functools.cache
def density():
    at = density_context(posed(), fitted())
    return at, jax.jit(jax.value_and_grad(lambda point: log_density(at, point, posed().cfg)))


def test_the_density_is_that_of_f_with_its_gradient():
    at, density_of = density()
    key = jax.random.PRNGKey(0)
    value, slope = density_of(random_start(at, key, 0.0))
    assert float(value) == pytest.approx(-fitted().minima.nll[0], abs=1e-6)
    np.testing.assert_allclose(slope.whitened, 0.0, atol=0.02)
    for log_w in slope.log_w:
        np.testing.assert_allclose(log_w, 0.0, atol=0.05)
    point, step = random_start(at, key, 0.5), 1e-4
    _, slope = density_of(point)
    flat, unravel = jax.flatten_util.ravel_pytree(point)
    exact = np.asarray(jax.flatten_util.ravel_pytree(slope)[0])
    for i in range(0, len(flat), 3):
        up, down = (float(density_of(unravel(flat.at[i].add(s)))[0]) for s in (step, -step))
        assert exact[i] == pytest.approx((up - down) / (2 * step), abs=1e-3, rel=1e-3)


def test_folding_keeps_the_inside_and_mirrors_the_rest():
    at, _ = density()
    near = random_start(at, jax.random.PRNGKey(1), 1.0).whitened
    inside = reflect_into_bounds(at, near)
    np.testing.assert_allclose(inside, at.theta + at.root @ near, atol=1e-12)
    u = posed().parametrisation
    for far in np.random.default_rng(0).normal(0, 3000, (50, len(near))):
        theta = np.asarray(reflect_into_bounds(at, jnp.asarray(far)))
        assert np.isfinite(theta).all()
        np.testing.assert_allclose(u.project(theta), theta, atol=1e-9)
    slope = np.asarray(jax.jacfwd(lambda x: reflect_into_bounds(at, x))(near * 100))[u.free]
    plain = np.asarray(at.root)[u.free]
    assert abs(np.linalg.det(slope)) == pytest.approx(abs(np.linalg.det(plain)), rel=1e-6)


# --- draws ------------------------------------------------------------------------------------------------------------


def known_excess() -> tuple[FitProblem, Estimate]:
    """The same with every excess, and all other φ, given to 1 %: the posterior of θ is then nearly Gaussian."""
    problem, minima = posed(), fitted().minima
    o, best = problem.observed, minima.candidates.take(np.array([0]))
    pairs = zip((o.level, o.frequency, o.decay), best.phi, strict=True)
    tables = [table._replace(prior=(phi[0], np.full(4, 0.01))) for table, phi in pairs]
    problem = replace(problem, observed=replace(o, level=tables[0], frequency=tables[1], decay=tables[2]))
    objective = Objective.complete(problem)
    candidates = minimise(objective, objective.start(best.theta, best.phi, best.w, best.offset), 60)
    minima = minima._replace(candidates=candidates, nll=objective.total(candidates))
    return problem, Estimate(*laplace(objective, minima), 0)


@pytest.mark.slow
def test_all_three_agree_where_the_excess_is_known():
    problem, found = known_excess()
    view, profile = nuts.sample_posterior(problem, found, 0), profiles(problem, found)
    assert view.draws is not None
    diagnostics = view.diagnostics["posterior"]
    by_profile, by_draws = (halves(each.intervals, found) for each in (profile, view))
    for name, ends in by_draws.items():
        # An end of 1500 independent draws is itself off by 0.035 of a half interval; b2 and the width are skew.
        assert by_profile[name] == pytest.approx((-1, 1), abs=0.05 if name in HAMMER else 0.2), name
        assert ends == pytest.approx(by_profile[name], abs=0.15), name
        assert view.draws[name].shape == (diagnostics["chains"], diagnostics["draws"])
    assert max(x["rhat"] for x in diagnostics["parameters"].values()) < 1.02
    assert diagnostics["divergences"] < 10


@pytest.mark.slow
def test_the_same_seed_draws_the_same_and_another_does_not(monkeypatch):
    monkeypatch.setattr(nuts, "WARMUP", 20)
    monkeypatch.setattr(nuts, "DRAWS", 20)
    views = [nuts.sample_posterior(posed(), fitted(), seed) for seed in (7, 7, 8)]
    first, again, other = (view.draws["p"] for view in views if view.draws is not None)
    np.testing.assert_array_equal(first, again)
    assert np.abs(np.log(first / other)).max() > 1e-3


def test_an_end_that_the_box_cuts_off_is_open():
    u, i = posed().parametrisation, P
    sd = 0.1
    upper = u.upper.copy()
    upper[i] = fitted().posterior.mean[0, i] + 0.5 * sd
    normal = fitted().posterior.mean[0, i] + sd * np.random.default_rng(0).normal(size=(4, 4000))
    log = np.where(normal > upper[i], 2 * upper[i] - normal, normal)
    interval = nuts._interval(replace(u, upper=upper).range(i), log)
    assert interval.unbounded == ("high",)
    assert np.log(interval.high) == pytest.approx(upper[i])
    assert nuts._interval(u.range(i), normal).unbounded == ()


def test_chains_that_have_not_mixed_are_reported():
    good = {"rhat": 1.001, "ess_bulk": 900.0, "ess_tail": 800.0}
    assert nuts._messages({"p": good}, 0) == []
    messages = " ".join(nuts._messages({"p": good | {"rhat": 1.2, "ess_tail": 90.0}, "c": good}, 3))
    assert "R-hat 1.200" in messages
    assert "90 independent draws" in messages
    assert "3 divergent steps" in messages


# --- rejected arguments -----------------------------------------------------------------------------------------------


def test_without_the_sampler_an_error_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "blackjax", None)
    with pytest.raises(ParameterError, match=r"blackjax.*pip install 'pianofit\[bayes\]'"):
        check_intervals("posterior")
    check_intervals("profile")


def test_other_means_are_refused():
    with pytest.raises(ParameterError, match=r"intervals='exact'.*laplace, profile, posterior"):
        check_intervals("exact")
