"""The search on tables of an analysis without errors: its minima, and the steps to them."""

from __future__ import annotations

import functools
from dataclasses import replace

import numpy as np
import pytest
from observed_cases import GEOMETRY, HAMMER, STRING, played, setup, tone
from scipy.signal import lfilter

from pianofit.analysis import analyse
from pianofit.errors import FitError
from pianofit.excitation.hammer import FINE_VELOCITIES, VELOCITIES
from pianofit.inference import FitProblem, InferenceResult, Posterior, build_problem, map_estimate
from pianofit.inference.batched_model import LevelModel
from pianofit.inference.laplace import laplace
from pianofit.inference.multistart import (
    deduplicate,
    initial_hyperparameters,
    multistart,
    rank_hammers,
    sobol_samples,
)
from pianofit.inference.objective import Objective, QuadraticSurrogate
from pianofit.inference.optimiser import minimise, predicted_decrease, step
from pianofit.inference.pipeline import ITERATIONS, fit_string, refine_minima
from pianofit.literature import preset
from pianofit.model import simulate
from pianofit.parameters import FIT_NAMES
from pianofit.recording.recording import recording_from_samples
from pianofit.result import build_result
from pianofit.setup import Setup


@functools.cache
def problem() -> FitProblem:
    """One calibrated recording of C4 with a given strike position."""
    return build_problem([tone()], [played()], setup())


@functools.cache
def string() -> np.ndarray:
    return fit_string(problem()).theta[0, :4]


@functools.cache
def found(seed: int = 0):
    return map_estimate(problem(), seed)


def of_levels() -> Objective:
    """F of the levels with the fitted string."""
    return Objective.of_levels(problem(), string())


def wide() -> np.ndarray:
    """φ before any residual is known [5]."""
    return initial_hyperparameters(problem().observed.level)


def surrogate() -> QuadraticSurrogate:
    """The surrogate before any residual is known."""
    return QuadraticSurrogate.of_gains(problem().observed.level, wide())[-1]


def samples(objective: Objective, count: int) -> np.ndarray:
    """The best prescreened hammers [count, size]."""
    return rank_hammers(objective, sobol_samples(objective, 3), VELOCITIES, [surrogate()])[0][:count]


def test_the_string_is_read_off_its_partials():
    np.testing.assert_allclose(np.exp(string()), STRING, rtol=2e-5)
    start = np.exp(problem().parametrisation.mean[:4])
    assert (np.abs(start / np.array(STRING) - 1) > 5e-6).all()  # it began elsewhere


def test_a_descent_never_raises_F():
    p, objective = problem(), of_levels()
    candidates = objective.start(samples(objective, 24), [wide()])
    assert len(candidates) > 8
    before = np.full(len(candidates), np.inf)
    for _ in range(6):
        candidates = step(objective, candidates)
        now = objective.total(candidates)
        assert (now <= before + 1e-9).all()
        before = now
    # Its F is that of a candidate created anew at the same point.
    anew = objective.start(candidates.theta, candidates.phi, candidates.w, candidates.offset)
    np.testing.assert_allclose(objective.total(anew), objective.total(candidates), rtol=1e-10)
    low, high = p.parametrisation.bounds_at(candidates.theta)
    assert ((candidates.theta >= low) & (candidates.theta <= high))[:, p.parametrisation.free].all()


def test_what_went_down_a_parabola_is_then_judged_by_F():
    objective = of_levels()
    replaced = objective.with_surrogate(surrogate())
    candidates = minimise(replaced, replaced.start(samples(objective, 6), [wide()]), 2)
    judged = minimise(objective, candidates, 0)
    anew = objective.start(judged.theta, judged.phi, judged.w)
    np.testing.assert_allclose(objective.total(judged), objective.total(anew), rtol=1e-10)
    assert (np.abs(replaced.total(candidates) - objective.total(judged)) > 1.0).any()


def test_a_descent_with_everything_never_raises_F_and_ends_where_the_string_is():
    """φ and w of levels, frequencies and decays are minimised with θ, from their priors."""
    objective, best = Objective.complete(problem()), found().minima
    priors = [np.asarray(term.table.prior[0]) for term in objective.terms]
    candidates = objective.start(best.candidates.theta, priors, offset=best.candidates.offset)
    before = np.inf
    for _ in range(40):
        candidates = step(objective, candidates)
        now = float(objective.total(candidates)[0])
        assert now <= before + 1e-9
        before = now
    assert now == pytest.approx(best.nll[0], abs=0.01)
    for mine, theirs in zip(candidates.phi, best.candidates.phi, strict=True):
        np.testing.assert_allclose(mine[0, 0], theirs[0, 0], atol=0.02)


def test_what_long_steps_do_to_the_levels_is_much_the_same_for_all_hammers():
    """The search estimates it at its best hammer alone."""
    objective = of_levels()
    coarse, theta = objective.level_model, samples(objective, 24)
    errors = coarse.discretisation_error_db(theta[coarse.residuals(theta, np.zeros(()))[1]])
    whole, left = (np.sqrt((x**2).mean(axis=(1, 2))) for x in (errors, errors[1:] - errors[0]))
    assert len(whole) > 8
    assert 0.05 < np.median(whole) < 0.3  # dB
    assert np.median(left) < 0.5 * np.median(whole)
    # With this correction, the levels agree with those of the problem's own steps, corrected too.
    corrected = [
        model.level_jacobians(theta[:1])[0] * model.has_level + model.discretisation_error_db(theta[:1])
        for model in (coarse, LevelModel(problem()))
    ]
    np.testing.assert_allclose(*corrected, atol=5e-3)


def test_a_descent_sorts_and_ends_where_F_is_flat():
    objective = of_levels()
    candidates = minimise(objective, objective.start(samples(objective, 6), [wide()]), 60)
    F = objective.total(candidates)
    assert (np.diff(F) >= 0).all()
    gradient, curvature = objective.gradient(candidates), objective.curvature(candidates)
    free = objective.free & ~problem().parametrisation.at_bound(candidates.theta[0])
    g, H = gradient[0][free], curvature[0][np.ix_(free, free)]
    left = 0.5 * g @ np.linalg.solve(H, g)
    assert left < 1e-2  # remaining decrease of F
    assert predicted_decrease(objective, candidates)[0] == pytest.approx(left)
    # Half a standard deviation away along any parameter, with the others fixed, F predicts to fall by what it rose.
    away = np.repeat(candidates.theta[:1], free.sum(), axis=0)
    away[:, free] += 0.5 * np.diag(1 / np.sqrt(np.diag(H)))
    candidates = candidates.take(np.zeros(len(away), int))
    candidates = objective.start(away, candidates.phi, candidates.w)
    rise = objective.total(candidates) - F[0]
    np.testing.assert_allclose(predicted_decrease(objective, candidates), rise, rtol=0.2, atol=0.02)


def test_the_hammer_is_found_without_an_error_of_the_steps():
    theta = found().theta
    values = dict(
        zip(problem().parametrisation.names, np.exp(problem().parametrisation.log_values(theta)), strict=False)
    )
    values |= {"v_H0": np.exp(theta[problem().parametrisation.shared])}
    assert values["M_H"] == pytest.approx(HAMMER.M_H, rel=1e-3)
    assert values["v_H0"] == pytest.approx(HAMMER.v_H0, rel=1e-3)
    assert values["p"] == pytest.approx(HAMMER.p, rel=2e-3)
    assert values["mu"] == pytest.approx(HAMMER.mu, rel=1e-2)
    assert values["width"] == pytest.approx(GEOMETRY.width, rel=1e-2)
    u = problem().parametrisation.reference_compression
    assert np.exp(theta[problem().parametrisation.index_of("K_H")]) == pytest.approx(HAMMER.K_H * u**HAMMER.p, rel=5e-3)
    assert found().minima.converged[0]


@pytest.mark.parametrize("felt", ["hunt-crossley", "soft-skin"])
def test_the_searched_force_is_that_of_the_felt_at_the_reference_compression(felt):
    u = build_problem([tone()], [played()], replace(setup(), felt=felt)).parametrisation
    theta = u.project(u.mean + 0.3 * np.random.default_rng(0).normal(size=u.size))
    hammer, force = u.hammer(theta, 0), u.force_and_exponent_index[0]
    assert u.law.force(u.reference_compression, 0.0, hammer) == pytest.approx(np.exp(theta[force]), rel=1e-12)
    np.testing.assert_allclose(u.from_log_values(u.log_values(theta)), theta, rtol=1e-13)
    step = 1e-6 * np.eye(u.size)
    differences = (u.log_values(theta + step) - u.log_values(theta - step)).T / 2e-6
    np.testing.assert_allclose(u.tangent(theta), differences, atol=1e-7)
    change = u.from_log_values(u.log_values(theta) + step)[:, force] - theta[force]
    np.testing.assert_allclose(u.force_direction(theta)[: u.shared], change[: u.shared] / 1e-6, atol=1e-4)


def test_on_the_edge_of_K_H_the_force_follows_p():
    """K_H is fixed there: p determines the force, and F rises by a half in one standard deviation."""
    low = build_problem([tone()], [played()], replace(setup(), bounds={"K_H": (1e8, 0.1 * HAMMER.K_H)}))
    one, u = map_estimate(low, 0), low.parametrisation
    force, p = u.force_and_exponent_index
    assert u.at_bound(one.theta)[force]
    assert not u.at_bound(one.theta)[p]
    cov = one.posterior.covariance[0]
    assert not cov[force].any()
    slope = np.exp(one.theta[p]) * np.log(u.reference_compression)
    change = np.eye(u.size)[force] + slope * np.eye(u.size)[p]
    first = Posterior(one.posterior.mean[:1], cov[None], np.ones(1))
    assert first.sd(change) == pytest.approx(-slope * np.sqrt(cov[p, p]), rel=1e-3)
    objective, best = Objective.complete(low), one.minima.candidates.take(np.array([0]))
    inner = np.flatnonzero(cov.diagonal() > 0)
    theta = np.tile(u.log_values(one.theta), (2, 1))
    theta[:, inner] += np.outer([-1, 1], cov[p, inner] / np.sqrt(cov[p, p]))
    moved = objective.start(u.from_log_values(theta), best.phi, best.w, best.offset)
    for _ in range(20):  # until φ and w have converged
        moved = objective.step_nuisances(moved, 0.0)
    # A half, times a factor for the hyperparameters, which the standard deviation integrates (test_hyperparameters.py).
    assert 0.4 < (objective.total(moved) - one.minima.nll[0]).mean() < 1.4
    fit = build_result(InferenceResult(low, one, 0, None)).fit
    assert fit.parameters["K_H"].status == "at-bound"
    assert fit.invariants["F/M_S"].status in ("at-bound", "not-identifiable")
    assert fit.parameters["K_H"].interval is None


def test_the_same_seed_gives_the_same_result_and_another_the_same_minimum():
    again = map_estimate(problem(), 0)
    np.testing.assert_array_equal(again.theta, found().theta)
    np.testing.assert_array_equal(again.minima.nll, found().minima.nll)
    np.testing.assert_array_equal(again.posterior.covariance, found().posterior.covariance)
    other = found(1)
    np.testing.assert_allclose(other.theta, found().theta, atol=2e-3)
    assert other.minima.nll[0] == pytest.approx(found().minima.nll[0], abs=0.05)


def test_minima_are_told_apart_by_where_they_are():
    u = problem().parametrisation
    theta = np.tile(u.mean, (4, 1))
    theta[1, u.index_of("M_H")] += 0.001 * u.sd[u.index_of("M_H")]
    theta[2, u.index_of("M_H")] += 0.5 * u.sd[u.index_of("M_H")]
    theta[3, u.index_of("p")] += 0.5 * u.sd[u.index_of("p")]
    candidates = of_levels().start(u.project(theta), [wide()])
    scores = np.array([1.0, 0.9, 0.0, 9.0])[: len(candidates)]
    assert len(candidates) == 4
    assert deduplicate(candidates, u.free, scores, 6.0, 0.02 * u.sd) == [2, 1]


def test_the_heaviest_minimum_is_the_first_and_what_lies_within_another_is_none(monkeypatch):
    one, u = found(), problem().parametrisation
    mean, covariance = np.repeat(one.posterior.mean[:1], 3, axis=0), one.posterior.covariance[0]
    deviation = np.sqrt(covariance.diagonal())
    mean[1] += 0.5 * deviation  # within the first
    mean[2] += 5.0 * deviation
    minima = one.minima.take(np.zeros(3, int))._replace(nll=np.array([1.0, 1.5, 1.2]))
    candidates = replace(minima.candidates, theta=np.array([u.from_log_values(logs) for logs in mean]))
    described = {0: 0.2, 2: 0.4}  # the second is never described
    monkeypatch.setattr("pianofit.inference.laplace._at_minimum", lambda _o, _c, i: (np.log(described[i]), covariance))
    kept, posterior = laplace(Objective.complete(problem()), minima._replace(candidates=candidates))
    np.testing.assert_array_equal(kept.nll, [1.2, 1.0])
    np.testing.assert_allclose(posterior.weight, [2 / 3, 1 / 3])
    np.testing.assert_allclose(posterior.mean, mean[[2, 0]])


@pytest.fixture
def endless(monkeypatch):
    """No contact ends."""
    residuals = LevelModel.residuals
    monkeypatch.setattr(LevelModel, "residuals", lambda *x: (residuals(*x)[0], np.zeros(len(x[1]), bool)))


def test_a_search_in_which_no_contact_ends_says_so(endless):
    with pytest.raises(FitError, match=r"\[bounds\]"):
        multistart(of_levels(), 0, problem().parametrisation.mean[None], lambda *_: None)


def test_minima_whose_contacts_do_not_end_by_the_finer_steps_are_none(request):
    objective = of_levels()
    candidates = objective.start(problem().parametrisation.mean[None], [wide()])
    own = fit_string(problem())
    request.getfixturevalue("endless")
    with pytest.raises(FitError, match=r"\[bounds\]"):
        refine_minima(Objective.complete(problem()), objective, candidates, own, ITERATIONS)


@pytest.mark.parametrize(("low", "high"), [(0.3, 0.6), (3.0, 4.0)])
def test_a_velocity_keeps_within_its_bounds_and_says_so_at_one(low, high):
    """The true velocity lies outside."""
    bounded = build_problem([tone()], [played()], replace(setup(), bounds={"v_H0": (low, high)}))
    one, at = map_estimate(bounded), bounded.reference_velocity_index
    bound = low if HAMMER.v_H0 < low else high
    assert np.exp(one.theta[at]) == pytest.approx(bound, rel=1e-9)
    document = build_result(InferenceResult(bounded, one, 0, None)).fit
    assert document.parameters["v_H0"].status == "at-bound"
    assert document.recordings[0].stroke_status == "at-bound"
    assert any("bound" in said and "v_H0" in said for said in document.warnings)


@functools.cache
def two_like_strokes():
    """The problem of two recordings of a preset, of nearly the same velocity."""
    note, rate, noise = preset("chabassier-F3"), 44_100, np.random.default_rng(5)
    recordings = []
    for velocity in (2.0, 2.2):
        strike = simulate(note.string, note.hammer._replace(v_H0=velocity), note.geometry, quantity="bridge-force")
        sound = lfilter([1, 0.6, 0.2], [1, -0.5], strike.waveform(rate, 3 * rate))
        sound = np.pad(0.5 * sound / np.abs(sound).max(), (rate // 10, 0))
        recordings.append(recording_from_samples(sound + 1e-4 * noise.standard_normal(len(sound)), rate))
    return build_problem(recordings, [analyse(one, note="F3") for one in recordings], Setup.from_dict({}, "here"))


@pytest.mark.parametrize("seed", [0, 2])
def test_a_search_of_two_like_strokes_does_not_stay_on_a_ripple_of_their_valley(seed):
    """A false minimum lies eight standard deviations from the truth, 28 in F above it."""
    note, posed = preset("chabassier-F3"), two_like_strokes()
    one, u = map_estimate(posed, seed), posed.parametrisation
    mass = np.exp(one.posterior.mean[0, u.index_of("M_H")]) / posed.initial_values.geometry.mass
    low, high = one.posterior.interval(np.eye(u.size)[u.index_of("M_H")])
    true = note.hammer.M_H / note.geometry.mass
    assert np.exp(low) / posed.initial_values.geometry.mass < true < np.exp(high) / posed.initial_values.geometry.mass
    assert mass == pytest.approx(true, rel=0.01)


@pytest.mark.parametrize(("file", "near"), [("Tone.flac", ["tone.wav"]), ("tone.wav", []), ("tone2.wav", [""])])
def test_a_misspelt_recording_of_the_setup_is_told(file, near):
    """Also one that is like none, if no other is used; a setup may list more recordings than a fit has."""
    known = setup(recording=[{"file": "tone.wav"}, {"file": "tone2.wav", "v_H0": 1.0}])
    assert build_problem([tone(name="tone.wav")], [played()], known).unmatched_entries == ()
    known = setup(recording=[{"file": file, "v_H0": 1.0}])
    posed = build_problem([tone(name="tone.wav")], [played()], known)
    assert [other for _, other in posed.unmatched_entries] == near


def test_where_everything_is_known_nothing_is_left_to_fit():
    known = dict(zip(FIT_NAMES, map(float, (*STRING, *HAMMER)), strict=False))
    with pytest.raises(FitError, match=r"\[fixed\]"):
        build_problem([tone()], [played()], setup(pickup={"quantity": "pressure"}, fixed=known))


def test_a_stroke_in_the_wrong_lobe_is_struck_anew():
    """With the true hammer at a wrong velocity, the best of the fine grid is the true velocity."""
    theta = found().theta.copy()
    theta[: len(string())] = string()
    at = problem().parametrisation.shared
    for factor in (0.2, 0.5, 3.0):
        away = theta.copy()
        away[at] += np.log(factor)
        rescanned = rank_hammers(of_levels(), away[None], FINE_VELOCITIES, [surrogate()])[0]
        assert rescanned[0, at] == pytest.approx(theta[at], abs=0.01)
