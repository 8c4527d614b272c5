"""The prior that other keys give: its prediction, its part of F, and its removal, against independent computations."""

from __future__ import annotations

import functools
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from instrument_cases import ERRORS, fit_document, library, true_note, truth, write_fit
from observed_cases import GEOMETRY, played, tone
from scipy import stats

from pianofit.analysis import analyse
from pianofit.errors import ParameterError, SetupError
from pianofit.felt import LAWS, SoftHammer
from pianofit.inference import FitProblem, build_problem, map_estimate
from pianofit.inference.nuts import density_context, log_density, random_start
from pianofit.inference.objective import Objective
from pianofit.instrument import find_fits, load_keys, prior_of_key
from pianofit.instrument.build import reference_values
from pianofit.instrument.key_measurements import measurements_of
from pianofit.instrument.key_quantities import LAW_QUANTITIES, at_scale, key_quantities, law_compression
from pianofit.instrument.keyboard_posterior import (
    KeyMeasurements,
    Measurement,
    _fit_model,
    _joint_covariance,
    joint_laws,
    keyboard_posterior,
)
from pianofit.instrument.predicted_key import NAMES
from pianofit.instrument.quantity_law import STUDENT, Prior
from pianofit.key_prior import PRIOR_QUANTITIES, KeyPrior
from pianofit.model.note import Note
from pianofit.parameters import Geometry, String
from pianofit.recording.recording import recording_from_samples
from pianofit.schema.decode import builtins_of, convert
from pianofit.schema.fit import Fit
from pianofit.setup import Setup
from pianofit.synthetic import demo_recording

pytestmark = pytest.mark.usefixtures("float64")

PRIORS = [Prior(0.5, 0.4, 0.5), Prior(1.0, 0.5, 0.3), Prior(0.3, 0.3, 0.4)]
FELT_AT = {name: PRIOR_QUANTITIES.index(name) for name in ("F/M_S", "local_exponent", "skin")}


def some_keys() -> list[KeyMeasurements]:
    """Seven keys that measure three quantities with correlated errors and an unknown scale of the velocities."""
    random, keys = np.random.default_rng(3), []
    for midi in (30, 34, 43, 51, 60, 72, 80):
        root = 0.2 * random.normal(size=(3, 3))
        mean = 0.3 * random.normal(size=3) + (midi - 60) / 60
        keys.append(KeyMeasurements(midi, (Measurement(1.0, mean, root @ root.T),), np.array([1.0, -0.4, 0.0])))
    return keys


def some_prior(seed: int = 5) -> KeyPrior:
    """A prior of a C4 with correlations, about the literature's values."""
    random, note = np.random.default_rng(seed), true_note(60)
    note = note._replace(hammer=SoftHammer(*note.hammer[:5], skin=2e-4))
    at = key_quantities(note, 60) | {"f0": 262.0}
    root = 0.2 * (np.eye(len(PRIOR_QUANTITIES)) + 0.3 * random.normal(size=(len(PRIOR_QUANTITIES),) * 2))
    mean = [math.log(at[name]) for name in PRIOR_QUANTITIES]
    return KeyPrior(PRIOR_QUANTITIES, tuple(mean), tuple(map(tuple, (root @ root.T).tolist())), 9e-4, 2.0, 0.25)


@functools.cache
def problem(felt: str = "soft-skin", quantity: str = "bridge-force", **given) -> FitProblem:
    setup = Setup(length=GEOMETRY.length, pickup_quantity=quantity, felt=felt, prior=some_prior())
    setup = replace(setup, **{name: dict(value) for name, value in given.items()})
    return build_problem([tone()], [played()], setup)


def points(count: int = 6, **more) -> np.ndarray:
    u = problem(**more).parametrisation
    return u.project(u.mean + 0.4 * np.random.default_rng(2).normal(size=(count, u.size)))


# --- the prediction of a key ------------------------------------------------------------------------------------------


def test_a_prediction_has_the_covariance_of_a_dense_gaussian():
    """The joint Gaussian of all fits and of the new key, built entry by entry and conditioned on the fits."""
    keys, midi = some_keys(), 55
    fitted = _fit_model(keys, np.zeros((3, len(keys))), PRIORS)
    x = np.array([*(key.midi for key in keys), midi], float)
    count, size = len(x), 3
    total = np.zeros((size, count, size, count))
    for q, (shape, prior) in enumerate(zip(fitted.model.shapes, PRIORS, strict=True)):
        for i in range(count):
            for j in range(count):
                law = prior.offset**2 + prior.slope_sd**2 * (x[i] - 64.5) * (x[j] - 64.5) / 43.5**2
                total[q, i, q, j] += law + shape.smooth**2 * math.exp(-0.5 * ((x[i] - x[j]) / shape.length) ** 2)
        for i in range(count - 1):
            total[q, i, q, i] += shape.scatter**2 / fitted.model.weights[q, i]
        # Variance of Student's t.
        total[q, -1, q, -1] += shape.scatter**2 * stats.t(STUDENT).var()
    for i, key in enumerate(keys):
        total[:, i, :, i] += key.minima[0].covariance + 0.25**2 * np.outer(key.scale_direction, key.scale_direction)
    matrix = np.moveaxis(total, (0, 2), (1, 3)).reshape(size * count, size * count)
    new, old = np.arange(size * (count - 1), size * count), np.arange(size * (count - 1))
    dense = matrix[np.ix_(new, new)] - matrix[np.ix_(new, old)] @ np.linalg.solve(
        matrix[np.ix_(old, old)], matrix[np.ix_(old, new)]
    )
    found = _joint_covariance(fitted, range(size), np.array([midi]))[1, :, 0, 1, :, 0]
    assert found == pytest.approx(dense, rel=1e-5, abs=1e-7)


def test_a_prediction_is_the_posterior_of_the_other_keys():
    keys, midi = some_keys(), 55
    found = keyboard_posterior(keys, np.zeros((3, 88)), PRIORS, range(21, 109))
    at = sorted([*(key.midi for key in keys), midi])
    mean, covariance = joint_laws(keys, np.zeros((3, len(at))), PRIORS, at, range(3)).value_of(at.index(midi))
    assert mean == pytest.approx(found.mean[0, :, midi - 21])
    assert np.sqrt(np.diag(covariance)) == pytest.approx(found.sd[1, :, midi - 21])
    assert np.linalg.eigvalsh(covariance).min() > 0


def test_the_fit_of_a_key_takes_no_part_in_its_prior(tmp_path):
    midis = [48, 55, 62, 69]
    keys = load_keys(find_fits([library(tmp_path / "a", midis)]))
    wrong = true_note(55)
    wrong = wrong._replace(hammer=wrong.hammer._replace(M_H=3 * wrong.hammer.M_H, p=1.5))
    changed = [replace(key, measured=measurements_of(_fit(wrong), wrong, 55, 0.0)) if key.midi == 55 else key
               for key in keys]  # fmt: skip
    assert prior_of_key(changed, 55) == prior_of_key(keys, 55)
    assert prior_of_key(changed, 62) != prior_of_key(keys, 62)
    with pytest.raises(ParameterError, match="C4"):
        prior_of_key([key for key in keys if key.midi == 60] or [replace(keys[0], midi=60)], 60)


def test_a_prior_holds_the_true_key(tmp_path):
    """On the scale of the velocities of the fits, 4 m/s."""
    keys = load_keys(find_fits([library(tmp_path, list(range(36, 90, 6)))]))
    prior = prior_of_key(keys, 63)
    sd = dict(zip(prior.names, np.sqrt(np.diag(prior.covariance)), strict=True))
    assert prior.velocity == pytest.approx(4.0)
    for name, mean in zip(prior.names, prior.mean, strict=True):
        if name in ("B", "b1", "d2", "M_H/M_S", "F/M_S", "local_exponent", "mu", "x0/L"):
            true = float(truth(name, [63])[0])
            assert abs(mean - true) < 3 * sd[name], name
            assert sd[name] < 0.4, name


def test_the_prior_of_a_key_without_loud_layers_is_that_of_its_loudest_stroke(tmp_path):
    """Strokes of 1, 2 and 4 m/s at MIDI velocities 1, 64 and 127; one key lacks the loudest."""
    files = []
    for midi in (48, 55, 62, 69):
        strokes = {1: 1.0, 64: 2.0} | ({} if midi == 62 else {127: 4.0})
        document = fit_document(true_note(midi), ERRORS, tuple(strokes.values()))
        for row, number in zip(document["recordings"], strokes, strict=True):
            row["midi_velocity"] = number
        files.append(write_fit(tmp_path, midi, document))
    keys = load_keys(files)
    assert prior_of_key(keys, 62).velocity == pytest.approx(2.0)
    assert prior_of_key(keys, 55).velocity == pytest.approx(4.0)
    # The same hammers and levels as with all layers, on one scale of velocities.
    whole = load_keys(find_fits([library(tmp_path / "whole", [62], errors=dict.fromkeys(ERRORS, 1e-9))]))[0]
    (soft,) = [key for key in keys if key.midi == 62]
    assert soft.measured.minima[0].mean == pytest.approx(whole.measured.minima[0].mean, abs=1e-6)


def test_another_scale_of_the_velocities_is_another_hammer_with_the_same_sound():
    """Against the quantities of a note whose hammer is scaled: K s^(1-p), μ/s, s d, s v."""
    note, s = true_note(60), 0.45
    h = note.hammer
    soft = SoftHammer(*h[:5], skin=1.5e-4)
    slow = SoftHammer(h.K_H * s ** (1 - h.p), h.mu / s, h.p, h.M_H, s * h.v_H0, s * 1.5e-4)
    scaled = [
        np.array([LAW_QUANTITIES[n].scaled(({**key_quantities(note._replace(hammer=own), 60), "level": 0.0})[n])
                  for n in NAMES])
        for own in (soft, slow)
    ]  # fmt: skip
    assert at_scale(scaled[0], 60, s) == pytest.approx(scaled[1], rel=1e-12)


# --- its part of F ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("felt", ["soft-skin", "hunt-crossley", "power"])
def test_the_invariants_of_a_fit_are_those_of_its_note(felt):
    """Against the quantities of the keyboard's laws, an implementation of its own."""
    u = problem(felt).parametrisation
    assert u.joint is not None
    kept = u.joint.names
    for theta in points(felt=felt):
        g = u.geometry_at(theta)
        h = u.hammer(theta, 0)
        hammer = SoftHammer(h.K_H, h.mu, h.p, h.M_H, h.v_H0, h.skin if felt == "soft-skin" else 1e-12)
        note = Note(String(*u.string(theta)), hammer, Geometry(*g), "velocity", 1.0)
        # The keyboard states the felt at the compression of its key; here that is the prior's.
        at = key_quantities(note, 60) | {"f0": float(note.f0)}
        found = dict(zip(kept, u.joint.invariants(theta, u.law), strict=True))
        for name in set(kept) - {"F/M_S", "local_exponent"}:
            assert found[name] == pytest.approx(math.log(at[name]), abs=1e-9), name
        force = [float(LAWS["soft-skin"].force(9e-4 * x, 0.0, hammer)) for x in (1.0, 1.0001, 1 / 1.0001)]
        assert found["F/M_S"] == pytest.approx(math.log(force[0] / g.mass), abs=1e-6)
        exponent = math.log(force[1] / force[2]) / (2 * math.log(1.0001))
        assert found["local_exponent"] == pytest.approx(math.log(exponent), abs=1e-6)


@pytest.mark.parametrize("more", [{}, {"fixed": (("M_H", 0.006),)}, {"fixed": (("K_H", 2e10), ("p", 2.5))}])
@pytest.mark.parametrize("felt", ["soft-skin", "hunt-crossley"])
def test_the_prior_in_F_has_the_gradient_and_curvature_of_finite_differences(felt, more):
    own = problem(felt, **more)
    u, objective = own.parametrisation, Objective.complete(own)
    theta, step = points(felt=felt, **more), 1e-5
    value, gradient, curvature = objective.prior(theta)
    assert value == pytest.approx(_value(own, theta), rel=1e-9)
    shifts = step * np.eye(u.size)
    up, down = (np.array([objective.prior(theta + s * h)[0] for h in shifts]).T for s in (1, -1))
    assert gradient == pytest.approx((up - down) / (2 * step) * u.free, rel=1e-6, abs=1e-5)
    # Gauss-Newton: the curvature of the prior with J fixed.
    assert u.joint is not None
    rows = np.array([(u.joint.invariants(theta + h, u.law) - u.joint.invariants(theta - h, u.law)) / (2 * step)
                     for h in shifts])  # fmt: skip
    rows = np.moveaxis(rows, 0, 2) * u.free
    expected = np.einsum("bqm,qr,brn->bmn", rows, u.joint.precision, rows) + np.diag(u.precision)
    assert curvature == pytest.approx(expected, rel=1e-5, abs=1e-4)


def _value(own: FitProblem, theta: np.ndarray) -> np.ndarray:
    """Minus the logarithm of the density of the invariants by SciPy, and of the entries with a prior of their own."""
    u = own.parametrisation
    assert u.joint is not None
    record, kept = u.joint.record, [PRIOR_QUANTITIES.index(name) for name in u.joint.names]
    mean, covariance = np.array(record.mean)[kept], np.array(record.covariance)[np.ix_(kept, kept)]
    values = np.array([mean, *u.joint.invariants(theta, u.law)])
    density: Any = stats.multivariate_normal
    top, *others = density.logpdf(values, mean, covariance)
    joint = top - np.array(others)
    return joint + 0.5 * (u.precision * (theta - u.mean) ** 2).sum(axis=1)


def test_the_centre_of_the_prior_has_its_means():
    u = problem().parametrisation
    assert u.joint is not None
    residual = dict(zip(u.joint.names, u.joint.residual(u.mean[None], u.law)[0][0], strict=True))
    for name in ("M_H/M_S", "F/M_S", "local_exponent", "mu", "skin", "x0/L"):
        assert residual[name] == pytest.approx(0, abs=1e-9)


def test_a_quantity_that_is_assumed_is_integrated_out_and_a_given_one_conditions():
    """Behind an unknown path the contact width is assumed, and a given hammer mass has no prior of its own."""
    assumed = problem(quantity="pressure").parametrisation
    assert assumed.joint is not None
    assert "width/L" not in assumed.joint.names
    given = problem(fixed=(("M_H", 0.006),)).parametrisation
    assert given.joint is not None
    assert "M_H/M_S" in given.joint.names
    assert not given.free[given.index_of("M_H")]


def test_a_sampler_sees_the_same_invariants():
    u, theta = problem().parametrisation, points()
    assert u.joint is not None
    assert np.asarray(u.joint.invariants(jnp.asarray(theta), u.law, jnp)) == pytest.approx(
        u.joint.invariants(theta, u.law), rel=1e-11
    )


def test_the_velocity_of_the_prior_is_that_of_the_loudest_stroke_unless_velocities_are_given():
    u = problem().parametrisation
    assert np.exp(u.mean[u.velocities]) == pytest.approx([2.0])
    assert u.sd[u.velocities] == pytest.approx([0.25])
    given = build_problem([tone()], [played()], Setup(length=GEOMETRY.length, prior=some_prior()), 1.3)
    assert np.exp(given.parametrisation.mean[given.parametrisation.velocities]) == pytest.approx([1.3])


# --- files, and the removal of the prior ------------------------------------------------------------------------------


def test_a_prior_survives_its_file(tmp_path):
    prior = some_prior()
    file = Path(tmp_path / "setup.toml")
    file.write_text("string.length = 0.63\n" + prior.to_toml())
    assert Setup.from_toml(file).prior == prior


@pytest.mark.parametrize(
    ("change", "named"),
    [({"names": ["M_H"]}, "names"), ({"mean": [0.0, 1.0]}, "mean"), ({"covariance": [[-1.0]]}, "covariance"),
     ({"mean": [1e3]}, "mean"), ({"covariance": [[1e-300]]}, "covariance"),
     ({"names": ["f0", "B"], "mean": [5.0, -8.0], "covariance": [[1.0, 1.0], [1.0, 1.0 + 1e-13]]}, "singular"),
     ({"compression": 1.0}, "compression"), ({"velocity": "fast"}, "velocity"), ({"extra": 1}, "extra")],
)  # fmt: skip
def test_a_bad_prior_is_named(change, named):
    table = {"names": ["M_H/M_S"], "mean": [-0.7], "covariance": [[0.04]], "compression": 4e-4, "velocity": 4.0,
             "velocity_sd": 0.25}  # fmt: skip
    assert Setup.from_dict({"prior": table}).prior is not None
    with pytest.raises(SetupError, match=named):
        Setup.from_dict({"prior": table | change})
    with pytest.raises(SetupError, match="mean"):
        Setup.from_dict({"prior": {name: value for name, value in table.items() if name != "mean"}})


def _fit(note: Note, prior: KeyPrior | None = None, errors: dict[str, float] = ERRORS) -> Fit:
    fit = convert(fit_document(note, errors), Fit, "fit.json", "")
    return replace(fit, prior=prior)


def test_a_keyboard_does_not_count_the_prior_of_a_second_pass(tmp_path):
    """A fit that took a parameter from its prior measures it no more precisely than the prior ten times as wide."""
    keys = load_keys(find_fits([library(tmp_path, [48, 55, 62, 69])]))
    prior, note = prior_of_key(keys, 57), true_note(57)
    names = list(LAW_QUANTITIES)
    sd = math.sqrt(prior.covariance[prior.names.index("mu")][prior.names.index("mu")])
    fit = _fit(note, prior, ERRORS | {"mu": 0.98 * sd})
    assert convert(builtins_of(fit), Fit, "fit.json", "").prior == prior
    with_prior, without = (measurements_of(own, note, 57, 0.0).minima[0] for own in (replace(fit, prior=None), fit))
    at = names.index("mu")
    assert math.sqrt(without.covariance[at, at]) > 4 * sd
    assert math.sqrt(with_prior.covariance[at, at]) < 2 * sd
    strike = names.index("x0/L")
    assert without.covariance[strike, strike] < 1.2 * with_prior.covariance[strike, strike]


def test_reference_values_are_those_of_the_requested_keys(tmp_path):
    keys = load_keys(find_fits([library(tmp_path, [48, 60])]))
    assert reference_values(keys, [48, 60, 72]).shape == (len(LAW_QUANTITIES), 3)
    assert law_compression(60) > 0


@pytest.mark.slow
def test_the_density_of_a_sampler_contains_the_prior():
    """At the minimum it is -F of the search, which computes the prior in NumPy."""
    synthetic = demo_recording(50.0, 0)
    recording = recording_from_samples(synthetic.samples, synthetic.rate, name="synthetic")
    own = build_problem([recording], [analyse(recording)], replace(synthetic.setup, prior=some_prior()))
    estimate = map_estimate(own)
    at = density_context(own, estimate)
    density = log_density(at, random_start(at, jax.random.PRNGKey(0), 0.0), own.cfg)
    assert own.key_prior is not None
    assert float(density) == pytest.approx(-estimate.minima.nll[0], abs=1e-6)
