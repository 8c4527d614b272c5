"""Given values with a standard deviation: what they do to every interval, and their errors."""

from __future__ import annotations

import copy
import functools
import math
from dataclasses import replace

import jax
import numpy as np
import pytest
from twin_cases import FIRST, SEVERAL, inferred, record_model, setup_of, strokes_of, through

import pianofit
from pianofit.analysis import analyse
from pianofit.errors import ParameterError, SetupError
from pianofit.felt import LAWS
from pianofit.inference import Estimate, InferenceResult, Minima, run_inference
from pianofit.inference.batched_model import LevelModel, StringModel
from pianofit.inference.laplace import laplace
from pianofit.inference.nuts import density_context, log_density, random_start
from pianofit.inference.objective import Objective
from pianofit.inference.problem import build_problem
from pianofit.result import build_result
from pianofit.setup import Measured, RecordingInfo, Setup
from pianofit.synthetic import setup_text

LENGTH, MASS = FIRST.geometry.length, FIRST.geometry.mass
TWO = (SEVERAL[0], SEVERAL[2])


@functools.cache
def recorded(quantity: str = "velocity"):
    recording = record_model(FIRST, quantity=quantity)
    return [recording], [analyse(recording)]


@functools.cache
def calibrated(**more) -> InferenceResult:
    if not more:
        return inferred("model")
    return run_inference(
        *recorded(), replace(setup_of(FIRST), **{k: dict(v) if k == "fixed" else v for k, v in more.items()})
    )


@functools.cache
def microphones(length: float, mass: float) -> InferenceResult:
    """Two strokes through one output path; the strike position is fitted."""
    setup = replace(strokes_of(TWO), length=length, mass=mass, strike_position=None, strike_width=None)
    return run_inference(*through(TWO, "model"), setup)


def sds(inference: InferenceResult) -> dict[str, float]:
    """Standard deviations of logarithms at the best minimum, by name."""
    at = inference.problem.parameter_indices
    return {name: float(np.sqrt(inference.posterior.covariance[0][i, i])) for name, i in at.items()}


def test_a_length_and_a_mass_add_their_variance_to_what_scales_with_them():
    exact, found = (
        sds(microphones(LENGTH, MASS)),
        sds(microphones(Measured(LENGTH, 0.004), Measured(MASS, 0.02 * MASS))),
    )
    length, mass = 0.004 / LENGTH, 0.02
    added = {"c": length, "x0": length, "kappa": 2 * length, "b2": 2 * length, "M_H": mass, "K_H": mass}
    for name, sd in exact.items():
        assert found[name] ** 2 == pytest.approx(sd**2 + added.get(name, 0.0) ** 2, rel=1e-5), name
    assert (found["L"], found["M_S"]) == pytest.approx((length, mass), rel=1e-6)


def test_invariants_do_not_notice_a_length_or_a_mass():
    exact, found = (
        build_result(x).invariants
        for x in (microphones(LENGTH, MASS), microphones(Measured(LENGTH, 0.004), Measured(MASS, 0.02 * MASS)))
    )
    for name in ("f0", "B", "M_H/M_S", "x0/L", "F/M_S"):
        assert found[name].value == pytest.approx(exact[name].value, rel=1e-5)
        assert found[name].interval == pytest.approx(exact[name].interval, rel=1e-4), name
        assert found[name].status == exact[name].status


def test_a_vanishing_sd_gives_the_exact_intervals():
    exact = build_result(calibrated())
    names = {"length": LENGTH, "strike_position": 0.11, "pickup_position": 0.31, "pickup_scale": 4.0, "mass": MASS}
    found = build_result(calibrated(**{name: Measured(value, 1e-9 * value) for name, value in names.items()}))
    for name, quantity in exact.parameters.items():
        if quantity.interval is not None:
            # The search ends where F is flat to 1e-3, so the interval is the same within some hundredths of it.
            width, other = (math.log(q.interval[1] / q.interval[0]) for q in (quantity, found.parameters[name]))
            assert other == pytest.approx(width, rel=0.05), name
            assert abs(math.log(found.parameters[name].value / quantity.value)) < 0.1 * width


def test_a_scale_moves_the_velocity_and_leaves_what_has_no_unit():
    """(K_H, μ, v) scale with the unit of the levels as K_H s^(1-p), μ/s, s v."""
    exact, found = sds(calibrated()), sds(calibrated(pickup_scale=Measured(4.0, 0.2)))
    for name, power in {"v_H0": 1.0, "mu": -1.0, "K_H": 1 - FIRST.hammer.p, "p": 0.0, "M_H": 0.0}.items():
        assert found[name] ** 2 == pytest.approx(exact[name] ** 2 + (power * 0.05) ** 2, rel=0.02), name


def test_a_velocity_with_an_sd_gives_a_posterior_between_the_measurement_and_the_recording():
    free = build_result(calibrated()).parameters.v_H0
    sd = float(free.sd)
    given = free.value + 1.5 * sd  # with more, φ is uncertain whether the levels are that wrong
    found = build_result(calibrated(fixed=(("v_H0", Measured(given, sd)),))).parameters.v_H0
    assert found.status == "given"
    # Two Gaussians of one width have their mean in the middle, and their width over the root of 2.
    assert found.value == pytest.approx((given + free.value) / 2, abs=0.3 * sd)
    assert found.sd == pytest.approx(sd / math.sqrt(2), rel=0.1)


def test_two_measurements_and_their_ratio_are_one_adjustment():
    """The recording determines M_H/M_S far better than 1 %, so both masses share one weighted mean."""
    masses = {
        "fixed": (("M_H", Measured(FIRST.hammer.M_H, 0.01 * FIRST.hammer.M_H)),),
        "mass": Measured(MASS, 0.02 * MASS),
    }
    found = sds(calibrated(**masses))
    assert found["M_H"] == pytest.approx(1 / math.hypot(1 / 0.01, 1 / 0.02), rel=0.01)
    assert found["M_S"] == pytest.approx(found["M_H"], rel=0.01)


def test_a_strike_position_in_metres_measures_an_uncertain_length():
    """The nodes give x0/L: with an exact x0 the length is known better than it was given, and x0 stays exact."""
    parameters = build_result(calibrated(length=Measured(LENGTH, 0.001))).parameters
    assert float(parameters.L.sd) < 1e-4
    assert parameters.x0.interval is None
    assert parameters.x0.value == FIRST.geometry.strike_position


@pytest.mark.parametrize("quantity", ["velocity", "bridge-force"])
def test_derivatives_by_sizes_are_those_of_the_tables(quantity):
    setup = replace(
        setup_of(FIRST),
        length=Measured(LENGTH, 0.01),
        mass=Measured(MASS, 0.01 * MASS),
        strike_position=0.1103,  # at a node, the derivative of a level is infinite
        pickup_quantity=quantity,
        pickup_position=Measured(0.31, 0.001) if quantity == "velocity" else None,
        pickup_scale=Measured(4.0, 0.1),
        fixed={"M_H": Measured(4.9e-3, 1e-5), "c": Measured(352.0, 0.1), "p": 2.9},
    )
    problem = build_problem(*recorded(quantity), setup)
    u = problem.parametrisation
    assert set(u.sizes) == ({"L", "M_S", "pickup", "scale"} if quantity == "velocity" else {"L", "M_S", "scale"})
    none = np.zeros((1, *problem.observed.level.value.shape))
    for model in (LevelModel(problem), StringModel(problem)):
        for i in range(u.velocities.stop, u.size):
            step = np.eye(u.size)[i] * 1e-5
            tables = [model.residuals((u.mean + sign * step)[None], none)[0] for sign in (1, -1)]
            slopes = model.residuals(u.mean[None], none)[0]
            for (above, _), (below, _), (_, jacobian) in zip(*tables, slopes, strict=True):
                np.testing.assert_allclose(-(above - below) / 2e-5, jacobian[..., i], rtol=1e-3, atol=2e-2)


def test_a_longer_or_heavier_string_sounds_the_same():
    """The two scalings: a shift of a size and of all that scales with it changes no table."""
    problem = build_problem(
        *recorded(), replace(setup_of(FIRST), length=Measured(LENGTH, 0.01), mass=Measured(MASS, 1e-4))
    )
    u, none = problem.parametrisation, np.zeros((2, *problem.observed.level.value.shape))
    for size in ("L", "M_S"):
        theta = u.mean + 0.01 * np.eye(u.size)[u.index_of(size)]
        theta = np.where(u.given, u.mean + 0.01 * u.exponents[u.sizes.index(size)], theta)
        level, string = LevelModel(problem).residuals(np.stack([u.mean, theta]), none)[0], StringModel(problem)
        pickup = 0.01 * LevelModel(problem).by_size[u.sizes.index(size)]  # the position of the pickup stays in metres
        np.testing.assert_allclose(level[0][0][1], level[0][0][0] - pickup * LevelModel(problem).has_level, atol=1e-9)
        for residual, _ in string.residuals(np.stack([u.mean, theta]), none)[0]:
            np.testing.assert_allclose(residual[1], residual[0], atol=1e-9)


def test_values_scale_with_forces_as_their_unit_says():
    def exponent(unit: str) -> float:
        parameter = pianofit.Parameter(unit, "a parameter", 1.0, 2.0)
        return pianofit.FeltLaw("mine", {"k": parameter}, lambda u, _, felt: felt.k * u).force_exponent("k")

    units = {"N/m": 1, "N/m^p": 1, "1": 0, "s/m": 0, "m/N": -1, "N^2/m": 2, "kg m/s": 1, "Nm": 0, "m/N^0.5": -0.5}
    assert {unit: exponent(unit) for unit in units} == units
    assert LAWS["hunt-crossley"].force_exponent("K_H") == 1


# --- the value, and what is rejected ----------------------------------------------------------------------------------


def test_a_measured_value_is_a_number_that_keeps_its_sd():
    value = Measured(1.602, sd=0.001)
    assert (2 * value, type(2 * value)) == (3.204, float)
    assert value != 1.602
    assert Measured(1.602, 0) == 1.602
    assert copy.deepcopy(value) == value  # as a copy by pickle to another process
    assert len({value, Measured(1.602, 0.001), Measured(1.602, 0.002)}) == 2
    with pytest.raises(AttributeError):
        value.sd = 0.1


def test_every_given_quantity_takes_an_sd_in_python_and_in_a_file(tmp_path):
    setup = Setup(
        length=Measured(1.602, 0.001),
        mass=Measured(0.006, 1e-5),
        strike_position=Measured(0.19, 0.001),
        strike_width=Measured(0.02, 0.001),
        pickup_quantity="velocity",
        pickup_position=Measured(0.3, 0.001),
        pickup_scale=Measured(2.0, 0.02),
        fixed={"M_H": Measured(0.005, 1e-4), "p": 2.5},
        recordings=(RecordingInfo("a.wav", Measured(2.0, 0.1)),),
    )
    (tmp_path / "setup.toml").write_text(setup_text(setup))
    assert replace(Setup.from_toml(tmp_path / "setup.toml"), felt=None) == setup
    assert setup.exact.length == 1.602
    assert setup.relative_sds["L"] == pytest.approx(0.001 / 1.602)
    assert Setup(length=Measured(1.0, 0.0)) == Setup(length=1.0)


BAD = [
    ({"string": {"length": {"value": 1.0, "sd": -0.1}}}, "sd=-0.1"),
    ({"string": {"length": {"value": 1.0, "sd": 0.5}}}, "from 0 to 0.3 m"),
    ({"string": {"length": {"value": 1.0, "std": 0.1}}}, "did you mean sd?"),
    ({"string": {"length": {"sd": 0.1}}}, "has no value"),
    ({"string": {"length": {"value": 1.0}}}, "has no sd"),
    ({"string": {"length": {"value": 9.0, "sd": 0.1}}}, "length = 9.0"),
    ({"string": {"length": {"value": "1", "sd": 0.1}}}, "value='1'"),
    ({"string": {"mass": {"value": 0.01, "sd": True}}}, "sd=True"),
    ({"initial": {"p": {"value": 2.5, "sd": 0.1}}}, "use [fixed]"),
    ({"bounds": {"p": [{"value": 2.5, "sd": 0.1}, 3.0]}}, "use [fixed]"),
    ({"fixed": {"p": {"value": 2.5, "sd": math.nan}}}, "sd=nan"),
    ({"recording": [{"v_H0": {"value": 2.5, "sd": 2.0}}]}, "[[recording]] 1 v_H0"),
    ({"string": {"length": {"value": 1.0, "sd": 0.1}}, "strike": {"position": 1.1}}, "past the string"),
]


@pytest.mark.parametrize(("tables", "message"), BAD, ids=[message for _, message in BAD])
def test_a_bad_sd_is_an_error_that_names_it(tables, message):
    with pytest.raises(SetupError) as caught:
        Setup.from_dict(tables, "here")
    assert message in str(caught.value)
    assert str(caught.value).startswith("here: ")


@pytest.mark.parametrize(("arguments", "message"), [((1.0, -0.1), "sd=-0.1"), (("1", 0.1), "value='1'")])
def test_a_bad_measured_value_is_an_error_at_once(arguments, message):
    with pytest.raises(ParameterError, match=message):
        Measured(*arguments)


@pytest.mark.slow
def test_profiles_hold_the_length():
    setup = replace(setup_of(FIRST), length=Measured(LENGTH, 0.004), strike_position=None)
    setup = replace(setup, pickup_quantity="bridge-force", pickup_position=None, pickup_scale=None)
    parameters = build_result(run_inference(*recorded("bridge-force"), setup, intervals="profile")).parameters
    for name in ("c", "L"):
        assert parameters[name].interval_method == "profile"
        low, high = parameters[name].interval
        assert math.log(high / low) == pytest.approx(3.92 * 0.004 / LENGTH, rel=0.05)


@pytest.mark.usefixtures("float64")
@pytest.mark.slow
def test_the_density_of_the_draws_is_that_of_f_at_another_length():
    setup = replace(
        setup_of(FIRST),
        length=Measured(LENGTH, 0.01),
        mass=Measured(MASS, 0.01 * MASS),
        strike_position=0.1103,
        pickup_position=Measured(0.3071, 0.001),
        pickup_scale=Measured(4.0, 0.1),
        fixed={"M_H": Measured(4.9e-3, 1e-4)},
    )
    problem = build_problem(*recorded(), setup)
    u, objective = problem.parametrisation, Objective.complete(problem)
    theta = u.project(u.mean + 0.5 * u.sd * (np.arange(u.size) >= u.velocities.stop))
    start = objective.start(theta[None], [np.asarray(term.table.prior[0]) for term in objective.terms])
    minima = Minima(start, objective.total(start), np.ones(1, bool))
    at = density_context(problem, Estimate(*laplace(objective, minima), 0))
    point = random_start(at, jax.random.PRNGKey(0), 0.0)
    value, slope = jax.jit(jax.value_and_grad(lambda x: log_density(at, x, problem.cfg)))(point)
    assert float(value) == pytest.approx(-minima.nll[0], rel=1e-9)
    np.testing.assert_allclose(slope.whitened, -objective.gradient(start)[0] @ at.root, rtol=1e-5, atol=1e-4)
