"""Derived quantities: exact Gaussian intervals, strokes that are simulated alone, the truth of synthetic recordings."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from report_cases import SHARED, covariance_content, example_content, example_fit, minimum
from scipy.special import ndtr
from twin_cases import FIRST
from twin_cases import short_fit as calibrated

import pianofit
from pianofit.conversions import HALF_WIDTH_95
from pianofit.errors import FitError, ParameterError
from pianofit.felt import ALL_PARAMETERS, LAWS, check_hammer
from pianofit.felt.law import scale_velocity
from pianofit.literature import reference_compression
from pianofit.model.note import Note
from pianofit.result import Result
from pianofit.result.derived import scale_length, scale_mass
from pianofit.result.posterior import JointDraws, joint_draws
from pianofit.schema.fit import Fit
from pianofit.schema.quantities import Covariance

LAW = LAWS["hunt-crossley"]


def gaussian(weights: tuple[float, ...] = (1.0,), free=("c", "kappa", "p", "M_H"), size=0.05) -> Fit:
    """A fit whose posterior is known: K_H is given, so the logarithms are Gaussian about each minimum."""
    content, covariance = example_content(), {"covariance": covariance_content(free=free, size=size)}
    own = dict.fromkeys(SHARED, 1.0)
    content["minima"] = [minimum(weight, 0.3 * i) | covariance for i, weight in enumerate(weights)]
    for one in content["minima"]:
        one["parameters"] = own | one["parameters"]
    return example_fit(content)


def log_interval(draws: JointDraws, values: np.ndarray) -> np.ndarray:
    return np.log(draws.interval(values))


# --- draws ------------------------------------------------------------------------------------------------------------


def test_a_product_of_powers_has_the_exact_gaussian_interval():
    fit = gaussian()
    draws, (best,) = joint_draws(fit, LAW), fit.minima
    drawn, cov = draws.values, best.covariance
    power = {"c": 2.0, "kappa": -1.0, "p": 0.7, "M_H": 1.0}
    direction = np.array([power.get(name, 0.0) for name in cov.names])
    values = np.prod([drawn[name] ** x for name, x in power.items()], axis=0)
    centre = sum(x * np.log(best.parameters[name]) for name, x in power.items())
    half = HALF_WIDTH_95 * np.sqrt(direction @ cov.matrix @ direction)
    np.testing.assert_allclose(log_interval(draws, values), centre + np.array([-half, half]), atol=1e-6 * half)


def test_draws_are_a_mixture_of_all_minima():
    fit = gaussian((0.7, 0.3), ("p",), 0.001)
    first, second = (m.parameters["p"] for m in fit.minima)
    near_second = np.abs(joint_draws(fit, LAW).values["p"] - second) < 0.2 * abs(first - second)
    assert near_second.mean() == pytest.approx(0.3, abs=0.01)


def test_the_interval_of_a_mixture_is_that_of_its_gaussians():
    fit = gaussian((0.7, 0.3), ("p",), 0.02)
    draws, sd = joint_draws(fit, LAW), fit.covariance["p", "p"] ** 0.5
    low, high = log_interval(draws, draws.values["p"])
    for end, share in ((low, 0.025), (high, 0.975)):
        z = [(end - np.log(m.parameters["p"])) / sd for m in fit.minima]
        assert 0.7 * ndtr(z[0]) + 0.3 * ndtr(z[1]) == pytest.approx(share, rel=1e-6)


def test_a_function_that_is_no_sum_of_logarithms_has_the_interval_of_many_draws():
    draws, random = joint_draws(gaussian(size=0.3), LAW), np.random.default_rng(3)

    def function(z: np.ndarray) -> np.ndarray:
        return np.exp(z[:, 0]) + np.exp(0.5 * z[:, 1] ** 2 / 4) - 3.0

    expected = np.quantile(function(random.normal(size=(400_000, 4))), (0.025, 0.975))
    found = np.array(draws.interval(function(draws.mixture.standard)))
    np.testing.assert_allclose(found, expected, atol=0.12 * np.ptp(expected) / 2)


@pytest.mark.parametrize("sd", [0.15, 0.02])
def test_the_force_at_the_reference_compression_is_gaussian_even_with_a_wide_exponent(sd):
    """K_H is not: its logarithm is linear in p, and that of p is drawn."""
    content = example_content()
    names = content["minima"][0]["covariance"]["names"]
    log_u = np.log(1e-3 * content["derived"]["reference_compression_mm"])
    own = dict.fromkeys(SHARED, 1.0) | content["minima"][0]["parameters"]
    to_log = np.zeros((len(names), 2))  # from log force and log p to log K_H and log p
    to_log[names.index("K_H")], to_log[names.index("p"), 1] = (1.0, -own["p"] * log_u), 1.0
    matrix = to_log @ np.diag([0.05**2, sd**2]) @ to_log.T
    content["minima"][0] |= {"parameters": own, "covariance": {"names": names, "matrix": matrix.tolist()}}
    draws = joint_draws(example_fit(content), LAW)
    force = draws.values["K_H"] * np.exp(draws.values["p"] * log_u)
    half = 0.05 * HALF_WIDTH_95
    centre = np.log(own["K_H"]) + own["p"] * log_u
    np.testing.assert_allclose(log_interval(draws, force), centre + np.array([-half, half]), atol=1e-6 * half)


def test_draws_are_played_within_the_ranges_of_the_felt():
    """Another scale of the velocities divides μ, which can leave its range."""
    wide = np.geomspace(0.1, 3.0, 8) * ALL_PARAMETERS["mu"].upper
    draws = replace(calibrated().draw_set, sampled={"mu": wide[None]}).draws
    assert max(draw.values["mu"] for draw in draws) == wide[-1]
    for draw in draws:
        check_hammer(draw.note.hammer)


def test_draws_of_a_sampler_are_used_as_they_are():
    fit, random = gaussian(), np.random.default_rng(0)
    sampled = {"p": random.uniform(2.0, 3.0, (4, 500)), "f0": np.ones((4, 500))}
    drawn = joint_draws(fit, LAW, sampled).values
    assert {*drawn["p"]} <= {*sampled["p"].ravel()}
    assert "f0" not in drawn
    np.testing.assert_allclose(np.quantile(drawn["p"], (0.025, 0.975)), (2.025, 2.975), atol=0.02)
    assert len(drawn["c"]) == 1


# --- strokes ----------------------------------------------------------------------------------------------------------


def test_the_contact_of_a_draw_is_that_of_its_note_simulated_alone():
    draws = calibrated().draw_set.draws
    for draw in draws[:: len(draws) // 6]:
        alone = draw.note.strike(round(calibrated().fit.reference.rate))
        assert draw.stroke.contact_time == pytest.approx(alone.contact_time, rel=1e-9)
        assert draw.stroke.pulse.force.max() == pytest.approx(alone.pulse.force.max(), rel=1e-9)
        assert draw.stroke.pulse.contact_ended


def test_what_the_felt_loses_is_what_hammer_and_string_do_not_keep():
    draw = calibrated().draw_set.draws[0]
    pulse, hammer = draw.stroke.pulse, draw.note.hammer
    before, after = (0.5 * hammer.M_H * v**2 for v in (hammer.v_H0, float(pulse.hammer[-1, 1])))
    assert draw.felt_loss == pytest.approx((before - after - float(pulse.work)) / before, abs=2e-3)
    assert 0 < draw.felt_loss < 1


@pytest.mark.parametrize("scale", [scale_velocity, scale_mass, scale_length])
def test_scalings_that_change_no_sound_change_no_contact_time(scale):
    draw = calibrated().draw_set.draws[0]
    found = calibrated().draw_set._probes[scale.__name__.removeprefix("scale_")]
    assert any(found[name] != value for name, value in draw.values.items())
    probe = calibrated().draw_set.draws[1 + [*calibrated().draw_set._probes].index(scale.__name__[6:])]
    assert probe.stroke.contact_time == pytest.approx(draw.stroke.contact_time, rel=1e-7)


# --- quantities of a fit ----------------------------------------------------------------------------------------------


def test_intervals_hold_the_truth_of_a_synthetic_recording():
    result, truth = calibrated(), FIRST
    u = 1e-3 * result.fit.derived.reference_compression_mm
    stroke = Note(truth.string, truth.hammer, truth.geometry, "velocity", 1.0).strike(44_100)
    expected = {
        "felt_force": truth.hammer.K_H * u**truth.hammer.p,
        "contact_time": 1e3 * stroke.contact_time,
        "peak_force": float(stroke.pulse.force.max()),
        "peak_compression": 1e3 * float(stroke.pulse.compression.max()),
    }
    for name, value in expected.items():
        found = result.derived_quantities[name]
        low, high = found.interval
        # Four standard deviations, and the error of the contact's step.
        assert abs(np.log(value / found.value)) < np.log(high / low) + 2e-3, name
        assert found.status == "fitted", name


def test_built_in_quantities_and_functions_agree_also_after_loading(tmp_path):
    result = calibrated()
    loaded = Result.load(result.save(tmp_path / "fit", page=False))
    for one in (result, loaded):
        found = one.derived(lambda draw: 1e3 * draw.stroke.contact_time)
        assert found.value == pytest.approx(result.derived_quantities.contact_time.value, rel=1e-6)
        assert found.interval == pytest.approx(result.derived_quantities.contact_time.interval, rel=1e-6)
    assert loaded.derived_quantities.T60_1.value == pytest.approx(result.derived(lambda draw: draw.t60(1)).value)


def test_a_parameter_as_a_function_has_its_own_status_and_interval():
    result = calibrated()
    for name in ("p", "M_H", "c"):
        found, own = result.derived(lambda draw, name=name: draw.values[name]), result.parameters[name]
        assert found.status == own.status
        half = np.log(own.interval[1] / own.interval[0]) / 2
        assert np.log(found.interval) == pytest.approx(np.log(own.interval), abs=2e-3 * half)
    given = result.derived(lambda draw: draw.note.geometry.length)
    assert (given.interval, given.status) == (None, "given")


def test_where_the_felt_is_not_identified_nothing_that_rests_on_it_is():
    """One uncalibrated recording determines no felt, however narrow the intervals are."""
    result = calibrated()
    invariants = dict(result.fit.invariants)
    invariants["F/M_S"] = replace(invariants["F/M_S"], status="not-identifiable")
    doubtful = replace(result, fit=replace(result.fit, invariants=type(result.invariants)(invariants)))
    assert doubtful.derived(lambda draw: draw.stroke.contact_time).status == "not-identifiable"
    assert doubtful.derived(lambda draw: draw.felt_force(1e-4)).status == "not-identifiable"
    assert doubtful.derived(lambda draw: draw.t60(1)).status == "fitted"


def test_an_open_scale_of_velocities_is_in_forces_and_in_no_time():
    result = calibrated()
    row = replace(result.fit.reference, gain_status="fitted", stroke_status="scaled")
    cov = result.fit.covariance
    change = np.array([float(name == "v_H0") for name in cov.names])  # log s ~ N(0, 0.1²)
    change[cov.names.index("K_H")], change[cov.names.index("mu")] = 1 - result.parameters.p.value, -1.0
    wider = Covariance(cov.names, cov.matrix + np.outer(change, change) * 0.1**2)
    minima = (replace(result.fit.minima[0], weight=1.0, covariance=wider),)
    open_scale = replace(result, fit=replace(result.fit, recordings=(row,), minima=minima))
    shown, wide = (
        open_scale.derived(lambda draw: float(draw.stroke.pulse.force.max()), at_reference_velocity=at)
        for at in (True, False)
    )
    assert shown.status == wide.status == "scaled"
    assert np.ptp(np.log(wide.interval)) == pytest.approx(2 * HALF_WIDTH_95 * 0.1, rel=0.02)
    assert np.ptp(np.log(shown.interval)) < 0.2 * np.ptp(np.log(wide.interval))
    assert open_scale.derived(lambda draw: draw.stroke.contact_time).status == "fitted"


@pytest.mark.parametrize(
    ("function", "error"),
    [
        (lambda _: None, ParameterError),
        (lambda _: [1.0, 2.0], ParameterError),
        (lambda _: "1.5", ParameterError),
        (lambda _: np.nan, FitError),
    ],
    ids=["nothing", "two numbers", "text", "nan"],
)
def test_a_function_that_returns_no_number_is_rejected(function, error):
    with pytest.raises(error, match="function="):
        calibrated().derived(function)


@pytest.mark.parametrize(
    ("function", "word"),
    [
        (lambda draw: draw.felt_force(-1e-4), "compression"),
        (lambda draw: draw.local_exponent(0.0), "compression"),
        (lambda draw: draw.t60(0), "partial"),
    ],
)
def test_a_compression_or_a_partial_that_does_not_exist_is_named(function, word):
    with pytest.raises(ParameterError, match=word):
        calibrated().derived(function)


def test_the_felt_force_and_its_ratio_to_the_mass_have_one_interval():
    result = calibrated()
    force, ratio, mass = result.derived_quantities.felt_force, result.invariants["F/M_S"], result.parameters.M_S.value
    assert force.interval == pytest.approx([end * mass for end in ratio.interval], rel=1e-9)
    # It is that of the draws, up to the scatter of their quantiles.
    u = 1e-3 * result.fit.derived.reference_compression_mm
    drawn = result.derived(lambda draw: draw.felt_force(u))
    assert np.log(force.interval) == pytest.approx(np.log(drawn.interval), abs=0.3 * np.ptp(np.log(force.interval)))


def test_draws_stay_within_the_bounds():
    """Rounding does not carry a value beyond a bound that the posterior reaches."""
    result = calibrated()
    cov = result.fit.covariance
    at = cov.names.index("b1")
    wide = Covariance(cov.names, cov.matrix + np.outer(np.eye(len(cov.names))[at], np.eye(len(cov.names))[at]))
    minimum = replace(
        result.fit.minima[0], parameters=result.fit.minima[0].parameters | {"b1": 100.0}, covariance=wide, weight=1.0
    )
    b1 = joint_draws(replace(result.fit, minima=(minimum,)), LAW).values["b1"]
    assert (b1 == 100.0).mean() > 0.3
    assert b1.max() == 100.0


# --- the reference compression ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("midi", [21, 48, 60, 84, 108])
def test_the_reference_compression_lies_where_strokes_press(midi):
    """Between a fifth and three quarters of the largest compression of the literature's hammer on its string."""
    it = pianofit.typical(midi)
    deepest = pianofit.simulate(it.string, it.hammer, it.geometry).pulse.compression.max()
    assert 0.2 < reference_compression(midi) / deepest < 0.75
    assert reference_compression(midi + 0.4) == reference_compression(midi)  # the key counts, not its tuning
