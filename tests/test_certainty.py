"""Profiles and posteriors against intervals that are known exactly, and against each other on a measurement."""

from __future__ import annotations

import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from fit_cases import space
from pianofit.fit import Result, fit_recording, posterior
from pianofit.fit.certainty import Certainty, by_curvature, by_posterior, by_profile, check_intervals
from pianofit.fit.levenberg import descend
from pianofit.fit.posterior import box_of, draw, folded
from pianofit.fit.recipe import fit_partials
from pianofit.fit.space import LOG, NAMES, SIZE, K, P, Space, split, struck
from pianofit.fit.surface import Surface
from pianofit.fit.takes import arranged
from scipy.stats import norm, truncnorm

from pianofit.analysis import analyse
from pianofit.cli import main
from pianofit.errors import ParameterError
from pianofit.model import simulate
from pianofit.model.response import level_db, ringing
from pianofit.recording import recording_from_samples
from pianofit.report.words import how_sure, rows
from pianofit.setup_file import setup_from_dict
from pianofit.twin import make_twin, setup_text

MANY = 1_000_000  # degrees of freedom: Student's quantile is the normal's


def linear(z, arrays, cfg):
    """Residuals M z - d."""
    matrix, data = arrays
    return z @ matrix.T - data, jnp.broadcast_to(matrix, (len(z), *matrix.shape))


def surface(batch, arrays, box: Space, variance: np.ndarray | None = None) -> Surface:
    """The surface of a problem about its least point."""
    found = Surface(batch, arrays, (), box, np.zeros(SIZE), 0.0, *[np.zeros(0)] * 3)
    end = descend(found.evaluate, box.z(box.start[None]), box, iterations=200, tolerance=1e-14)
    z, jacobian = end.z[0], end.jacobian[0]
    pressed = box.at_bound(box.natural(z))
    variance = np.ones(len(jacobian)) if variance is None else variance
    return Surface(batch, arrays, (), box, z, float(end.cost[0]), jacobian, variance, pressed)


# One shape for all of these problems: the sampler is compiled once.
FREE, ROWS = [0, 2, K, P, LOG + 1], 12


def gaussian(scale: float = 0.02, log_u: float = 0.0) -> tuple:
    """A linear problem with correlated parameters of about this standard deviation, K_H = 1."""
    random = np.random.default_rng(5)
    matrix, z = np.zeros((ROWS, SIZE)), np.zeros(SIZE)
    matrix[:, FREE] = random.normal(size=(ROWS, len(FREE))) / scale
    matrix[:, 2] += 2 * matrix[:, 0]
    z[FREE] = scale * random.normal(size=len(FREE))
    z[K] += log_u
    return jnp.asarray(matrix), jnp.asarray(matrix @ z)


def measured_apart(**known: tuple[float, float]) -> tuple:
    """Search coordinates measured one by one: value and standard deviation; the others are 0 ± 0.01."""
    matrix, data = np.zeros((ROWS, SIZE)), np.zeros(ROWS)
    for row, i in enumerate(FREE):
        at, sd = known.get(NAMES[i] if i < LOG else "gain", (0.0, 0.01))
        matrix[row, i], data[row] = 1 / sd, at / sd
    return jnp.asarray(matrix), jnp.asarray(data)


def logs(found: Certainty, name: int) -> np.ndarray:
    span = found.spans[NAMES[name]]
    assert span is not None
    return np.log(span)


# --- where the cost is a parabola, all three say the same -------------------------------------------------------------


@pytest.mark.parametrize("variance", [1.0, 4.0])
def test_on_a_parabola_profile_and_curvature_agree(variance):
    random = np.random.default_rng(6)
    rows = variance ** random.uniform(-1, 1, ROWS)
    it = surface(linear, gaussian(2e-3, -3.0), space(FREE, log_u=-3.0), rows)
    for freedom in (7, MANY):
        curvature = by_curvature(it, freedom)
        profile = by_profile(it, curvature)
        for name in (0, 2, K, P):
            half = np.ptp(logs(curvature, name)) / 2
            np.testing.assert_allclose(logs(profile, name), logs(curvature, name), atol=0.02 * half)
        assert profile.by["c"] == "profile"
        assert profile.by["M_H"] is None
        assert not any(profile.open.values())
        assert not profile.messages


def test_on_a_parabola_the_posterior_has_the_same_quantiles():
    rows = 4 ** np.random.default_rng(6).uniform(-1, 1, ROWS)
    it = surface(linear, gaussian(), space(FREE), rows)
    curvature = by_curvature(it, 20)
    found = by_posterior(it, curvature, draw(it, 0))
    for name in (0, 2, K, P):
        half = np.ptp(logs(curvature, name)) / 2
        np.testing.assert_allclose(logs(found, name), logs(curvature, name), atol=0.15 * half)
    sd = np.sqrt(np.diag(curvature.cov)[FREE[:-1]])
    where = np.ix_(FREE[:-1], FREE[:-1])
    np.testing.assert_allclose(found.cov[where] / np.outer(sd, sd), curvature.cov[where] / np.outer(sd, sd), atol=0.25)
    told = found.diagnostics["posterior"]
    assert told["chains"] == 4
    assert all(t["rhat"] < 1.01 and t["ess_bulk"] > 400 for t in told["parameters"].values())
    assert not found.messages


# --- where it is not --------------------------------------------------------------------------------------------------


def test_where_k_h_follows_p_the_curvature_is_wrong_and_the_others_right():
    log_u = -2.0
    box = space(FREE, log_u=log_u)
    values, lower, upper = box.start.copy(), box.lower.copy(), box.upper.copy()
    values[K], lower[K], upper[K] = math.exp(-log_u), math.exp(-8), math.exp(12)  # p = 1, force 1 at the reference
    # The force there is known to 1 %, and p to a factor of e^0.3.
    it = surface(linear, measured_apart(p=(0.0, 0.3)), Space(lower, upper, box.free, values, box.spread, log_u))
    p = np.exp(0.3 * norm.ppf([0.025, 0.975]))
    exact = -p * log_u
    curvature = by_curvature(it, MANY)
    profile = by_profile(it, curvature)
    np.testing.assert_allclose(logs(profile, K), exact, atol=0.02)
    np.testing.assert_allclose(logs(profile, P), np.log(p), atol=0.01)
    assert np.abs(logs(curvature, K) - exact).min() > 0.2
    found = by_posterior(it, curvature, draw(it, 1))
    np.testing.assert_allclose(logs(found, K), exact, atol=0.15)


def test_at_a_bound_an_interval_has_one_side():
    it = surface(linear, measured_apart(c=(-3.5, 0.5)), space(FREE))
    assert it.pressed[0]
    curvature = by_curvature(it, MANY)
    assert curvature.spans["c"] is None
    profile = by_profile(it, curvature)
    end = math.sqrt(0.5**2 + 1.96**2 * 0.5**2) - 3.5  # where the cost has risen by 1.96²/2
    np.testing.assert_allclose(logs(profile, 0), [-3.0, end], atol=0.01)
    assert profile.open["c"] == ("low",)
    assert any("below" in text and "c" in text for text in profile.messages)
    found = by_posterior(it, curvature, draw(it, 2))
    np.testing.assert_allclose(
        logs(found, 0), [-3.0, truncnorm.ppf(0.975, 1.0, math.inf, loc=-3.5, scale=0.5)], atol=0.06
    )
    assert found.open["c"] == ("low",)


def test_what_nothing_bounds_has_the_whole_box():
    it = surface(linear, measured_apart(c=(0.0, 20.0)), space(FREE))
    curvature = by_curvature(it, MANY)
    profile = by_profile(it, curvature)
    found = by_posterior(it, curvature, draw(it, 3))
    for each in (profile, found):
        np.testing.assert_allclose(logs(each, 0), [-3.0, 3.0], rtol=1e-12)
        assert each.open["c"] == ("low", "high")
        assert any("the whole box: c" in text for text in each.messages)


def test_a_second_valley_that_is_deeper_is_reported():
    def two(z, arrays, cfg):
        near, far = ((z[:, 0] - at) / 0.1 for at in (0.0, 0.49))
        value = jnp.sqrt(2 * (6.1 - 5 * jnp.exp(-(near**2)) - 6 * jnp.exp(-(far**2))))
        slope = (10 * near * jnp.exp(-(near**2)) + 12 * far * jnp.exp(-(far**2))) / 0.1 / value
        return value[:, None], jnp.zeros((len(z), 1, SIZE)).at[:, 0, 0].set(slope)

    it = surface(two, (), space([0]))
    jacobian = np.zeros((1, SIZE))
    jacobian[0, 0] = 2.0  # as if the first valley were wide
    far = Surface(two, (), (), it.space, it.z, it.cost, jacobian, np.ones(1), it.pressed)
    found = by_profile(far, by_curvature(far, MANY))
    assert any("had not reached the least" in text for text in found.messages)


# --- the sampler ------------------------------------------------------------------------------------------------------


def test_folding_keeps_the_inside_and_mirrors_the_rest():
    box = space([0, K, P], log_u=-2.0)
    edges = box_of(box)
    inside = np.zeros(SIZE)
    inside[[0, K, P]] = 2.5, -1.0, 0.4
    plain = np.asarray(folded(jnp.asarray(inside), edges))
    assert plain[0] == 2.5
    assert plain[K] == pytest.approx(-1.0 + 2.0 * math.exp(0.4))
    outside = inside.copy()
    outside[[0, K]] = 3.7, -4.0 - 2.0 * math.exp(0.4)  # log K_H = -4 lies below the box
    there = np.asarray(folded(jnp.asarray(outside), edges))
    assert there[0] == pytest.approx(2.3)
    edge = math.log((-3.0 - outside[K]) / 2.0)  # log p at which K_H meets its edge with the same force
    assert there[P] == pytest.approx(2 * edge - 0.4)
    assert there[K] - 2.0 * math.exp(there[P]) == pytest.approx(outside[K])
    anywhere = jnp.asarray(np.random.default_rng(0).normal(0, 9, (99, SIZE)))
    lost = np.asarray(jax.vmap(lambda z: folded(z, edges))(anywhere))
    assert np.abs(lost[:, [0, K, P]]).max() <= 3.0 + 1e-9
    assert (lost[:, 2] == 0.0).all()


def test_folding_leaves_volumes_as_they_are():
    edges = box_of(space([0, K, P], log_u=-2.0))
    for z in np.random.default_rng(1).normal(0, 6, (20, SIZE)):
        slope = np.asarray(jax.jacfwd(lambda x: folded(x, edges))(jnp.asarray(z)))[np.ix_([0, K, P], [0, K, P])]
        assert abs(np.linalg.det(slope)) == pytest.approx(1.0)


def test_the_same_seed_draws_the_same_and_another_does_not():
    it = surface(linear, gaussian(), space(FREE))
    first, again, other = (draw(it, seed).z for seed in (7, 7, 8))
    np.testing.assert_array_equal(first, again)
    assert np.abs(first - other).max() > 1e-3
    assert first.shape == (4, 500, SIZE)


def test_chains_that_have_not_mixed_are_reported():
    it = surface(linear, gaussian(), space(FREE))
    every = draw(it, 0)
    few = every._replace(bulk=every.bulk / 10)
    found = by_posterior(it, by_curvature(it, MANY), few)
    assert any("independent draws" in text for text in found.messages)
    rhat = np.where(it.space.free, 1.2, 1.0)
    found = by_posterior(it, by_curvature(it, MANY), few._replace(rhat=rhat, divergences=3))
    assert any("R-hat 1.200" in text for text in found.messages)
    assert any("diverged" in text for text in found.messages)


def test_without_the_sampler_an_error_says_what_to_install(monkeypatch):
    monkeypatch.setattr(posterior, "find_spec", lambda _: None)
    with pytest.raises(ParameterError, match=r"blackjax.*pip install 'pianofit\[bayes\]'"):
        check_intervals("posterior")
    check_intervals("profile")


@pytest.mark.parametrize(
    ("means", "recipe", "said"),
    [("exact", "default", "intervals='exact' must be one of"), ("profile", "paper", "recipe='paper' gives none")],
)
def test_other_means_are_refused(means, recipe, said):
    with pytest.raises(ParameterError, match=said):
        check_intervals(means, recipe)
    with pytest.raises(ParameterError, match=said):  # before anything is read
        fit_recording(None, None, recipe=recipe, intervals=means)  # pyright: ignore[reportArgumentType]


def test_an_unknown_means_is_no_command(tmp_path, capsys):
    command = ["fit", str(tmp_path / "none.wav"), "--out", str(tmp_path / "out"), "--intervals", "exact"]
    assert main(command) == 2
    assert "'exact' is none of curvature, profile, posterior" in capsys.readouterr().err


# --- in words ---------------------------------------------------------------------------------------------------------


def test_the_table_and_the_page_name_ends_that_are_the_boxs():
    entry = {"value": 2.0, "interval": [1.0, 3.0], "interval_open": ["high"], "status": "free", "note": "effective"}
    (row,) = rows({"parameters": {"c": entry}})
    assert row["note"] == "effective; above, bounded by its range alone"
    (row,) = rows({"parameters": {"c": entry | {"interval_open": ["low", "high"], "note": ""}}})
    assert row["note"] == "bounded by its range alone"
    assert how_sure({"diagnostics": {"evaluations": 3}}) == ""
    each = {"rhat": 1.004, "ess_bulk": 1900.0, "ess_tail": 1500.4, "median": 1.0}
    told = {"chains": 4, "draws": 500, "parameters": {"c": each, "p": each | {"rhat": 1.001, "ess_bulk": 1200.0}}}
    text = how_sure({"diagnostics": {"posterior": told}})
    assert "4 chains of 500 draws" in text
    assert "1200 independent" in text
    assert "1.004" in text


# --- a measurement ----------------------------------------------------------------------------------------------------


@functools.cache
def measured():
    twin = make_twin(60.0, 0)
    return recording_from_samples(twin.samples, twin.rate, name="twin")


@functools.cache
def fitted(means: str) -> Result:
    import tomllib

    setup = setup_from_dict(tomllib.loads(setup_text()), "twin")
    return fit_recording(measured(), analyse(measured()), setup, intervals=means)


def halves(result: Result) -> dict[str, float]:
    """Half the logarithm of each interval."""
    table = result.document["parameters"]
    return {n: float(np.ptp(np.log(p["interval"]))) / 2 for n, p in table.items() if p["interval"]}


def holds(result: Result, true: dict[str, float]) -> int:
    table = result.document["parameters"]
    return sum(table[n]["interval"][0] <= value <= table[n]["interval"][1] for n, value in true.items())


def test_profiles_of_the_demo_hold_the_truth_and_are_as_wide_as_the_curvature_says():
    result, true = fitted("profile"), make_twin(60.0, 0).true
    assert holds(result, true) >= len(true) - 1
    sd = dict(zip(NAMES, np.sqrt(np.diag(result.covariance)), strict=True))
    wide = halves(result)
    assert set(wide) == {*true, "width"}
    for name in true:
        assert wide[name] == pytest.approx(2 * sd[name], rel=0.1), name
    assert {result.document["parameters"][n]["interval_by"] for n in true} == {"profile"}
    told = result.document["diagnostics"]["profile"]["b2"]
    assert min(rise for _, rise in told["points"]) == 0.0
    assert max(rise for _, rise in told["points"]) >= 0.9 * told["allowed_rise"]
    assert result.document["parameters"]["M_S"]["interval_by"] is None


def test_a_calibrated_fit_has_the_levels_of_a_step_without_end():
    """Against a step 32 times as fine, which the fit never takes, and farther off than that without the correction."""
    import tomllib

    setup = setup_from_dict(tomllib.loads(setup_text()), "twin")
    takes, start, layout, _ = arranged([measured()], [analyse(measured())], setup)
    fit = fit_partials(takes, start, layout)
    string, hammer = split(fit.values)
    geometry = struck(fit.state.start.geometry, fit.values)

    def levels(times: int) -> np.ndarray:
        hit = simulate(string, hammer, geometry, rate=fit.state.rate / 4, oversampling=4 * times)
        sound = ringing(hit.modes, hit.pulse.drive)
        return np.asarray(level_db(sound, -hit.modes.pole.real))[: fit.data.rows]

    found = fit.data.found[0]
    missing = (levels(32) - levels(1))[found]
    assert np.abs(missing).max() > 0.01
    np.testing.assert_allclose(fit.state.more[0][found], missing, atol=0.03 * np.abs(missing).max())


@pytest.mark.slow
def test_the_posterior_of_the_demo_agrees_with_its_profiles():
    result, true = fitted("posterior"), make_twin(60.0, 0).true
    assert holds(result, true) >= len(true) - 1
    wide = halves(fitted("profile"))
    for name, half in halves(result).items():
        assert half == pytest.approx(wide[name], rel=0.3), name
    told = result.document["diagnostics"]["posterior"]
    assert all(t["rhat"] < 1.01 for t in told["parameters"].values())
    assert result.draws is not None
    assert result.draws["p"].shape == (told["chains"], told["draws"])
