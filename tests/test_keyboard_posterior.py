"""The parts of the posterior over the keyboard, each against one dense Gaussian of all keys."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from pianofit.instrument.keyboard_posterior import (
    VELOCITY_SCALE_SD,
    KeyMeasurements,
    Measurement,
    _data,
    _deviation,
    _Fitted,
    _joint_covariance,
    _Model,
    _most_probable,
    _observed,
    _shares,
    _solve,
    _student_weights,
    joint_laws,
    keyboard_posterior,
)
from pianofit.instrument.quantity_law import (
    SHAPE_SD,
    STEPS,
    STUDENT,
    LawShape,
    Observed,
    Prior,
    _grid,
    _shape,
    law_covariance,
    log_posterior,
    most_probable,
)

PRIORS = [Prior(0.5, 0.4, 0.5), Prior(1.0, 0.5, 0.3)]
SHAPES = [LawShape(0.2, 0.05, 12.0), LawShape(0.1, 0.2, 20.0)]
MIDI = (30, 34, 43, 51, 60, 72, 80)
REFERENCE = np.linspace(-1.0, 2.0, 2 * len(MIDI)).reshape(2, len(MIDI))
# The key with two minima.
TWO = 3


def keys() -> list[KeyMeasurements]:
    """Seven keys with correlated errors and an unknown scale of the velocities; one has two minima."""
    random, found = np.random.default_rng(3), []
    for i, midi in enumerate(MIDI):
        minima = []
        for weight in (0.7, 0.3) if i == TWO else (1.0,):
            root = 0.2 * random.normal(size=(2, 2))
            minima.append(Measurement(weight, REFERENCE[:, i] + 0.3 * random.normal(size=2), root @ root.T))
        found.append(KeyMeasurements(midi, tuple(minima), np.array([1.0, -0.4])))
    return found


def model() -> _Model:
    return _Model(np.random.default_rng(1).uniform(0.4, 1.3, (2, len(MIDI))), SHAPES, PRIORS)


def fitted() -> _Fitted:
    shares = [np.array([one.weight for one in key.minima]) for key in keys()]
    data = _data(keys(), shares, np.array(MIDI, float), REFERENCE)
    return _Fitted(data, model(), _solve(data, model()), shares)


def spreads(x: list[int], weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Covariances of the laws and of the deviations of single keys [2, x, 2, x], entry by entry."""
    count = len(x)
    laws, deviations = np.zeros((2, 2, count, 2, count))
    for q, (prior, shape) in enumerate(zip(PRIORS, SHAPES, strict=True)):
        for i, a in enumerate(x):
            for j, b in enumerate(x):
                laws[q, i, q, j] = prior.offset**2 + prior.slope_sd**2 * (a - 64.5) * (b - 64.5) / 43.5**2
                laws[q, i, q, j] += shape.smooth**2 * np.exp(-((a - b) ** 2) / (2 * shape.length**2))
            deviations[q, i, q, i] = shape.scatter**2 / weights[q, i]
    return laws, deviations


def noise_of(data) -> np.ndarray:
    """Covariance of the errors of all fits [2, keys, 2, keys]."""
    total = np.zeros((2, len(MIDI), 2, len(MIDI)))
    for i, own in enumerate(data.noise):
        total[:, i, :, i] = own
    return total


def square(blocks: np.ndarray) -> np.ndarray:
    return blocks.reshape(blocks.shape[0] * blocks.shape[1], -1)


def test_laws_and_values_have_the_covariance_of_a_dense_gaussian():
    """At fitted keys and at one without a fit, whose deviation has the variance of Student's t."""
    one, at = fitted(), [30, 47, 60]
    unrecorded = np.full((2, 1), 1 / stats.t(STUDENT).var())
    laws, deviations = spreads([*MIDI, 47], np.hstack([one.model.weights, unrecorded]))
    values, place = laws + deviations, [0, 7, 4]
    observed = square(values[:, :7, :, :7] + noise_of(one.data))
    parts = [laws[:, place], values[:, place]]
    cross = np.concatenate([square(part[..., :7]) for part in parts])
    both = [[laws, laws], [laws, values]]
    prior = np.block([[square(part[:, place][..., place]) for part in row] for row in both])
    dense = prior - cross @ np.linalg.solve(observed, cross.T)
    found = _joint_covariance(one, (0, 1), np.array(at, float))
    assert found.reshape(len(dense), -1) == pytest.approx(dense, rel=1e-5, abs=1e-7)


def test_weights_of_student_are_those_of_the_posterior_deviations():
    """One step of EM, (ν + 1)/(ν + E[δ²]/scatter²), with δ conditioned on all fits in a dense Gaussian."""
    one = fitted()
    laws, deviations = spreads(list(MIDI), one.model.weights)
    observed, own = square(laws + deviations + noise_of(one.data)), square(deviations)
    mean = own @ np.linalg.solve(observed, one.data.y.ravel())
    variance = np.diag(own - own @ np.linalg.solve(observed, own))
    scatter = np.repeat([shape.scatter for shape in SHAPES], len(MIDI))
    expected = (STUDENT + 1) / (STUDENT + (mean**2 + variance) / scatter**2)
    assert _student_weights(one.system, one.model).ravel() == pytest.approx(expected, rel=1e-5)


def test_shares_of_minima_are_their_densities_in_the_prediction_of_the_other_keys():
    one, key = fitted(), keys()[TWO]
    laws, deviations = spreads(list(MIDI), one.model.weights)
    others, values = np.delete(np.arange(7), TWO), laws + deviations
    observed = square((values + noise_of(one.data))[:, others][..., others])
    cross = square(values[:, [TWO]][..., others])
    mean = REFERENCE[:, TWO] + cross @ np.linalg.solve(observed, one.data.y[:, others].ravel())
    covariance = values[:, TWO, :, TWO] - cross @ np.linalg.solve(observed, cross.T)
    scale = VELOCITY_SCALE_SD**2 * np.outer(key.scale_direction, key.scale_direction)
    density = np.array([
        minimum.weight * stats.multivariate_normal(mean, covariance + minimum.covariance + scale).pdf(minimum.mean)
        for minimum in key.minima
    ])  # fmt: skip
    found = _shares(one.system, one.data, REFERENCE, TWO, key)
    assert found == pytest.approx(density / density.sum(), rel=1e-4)
    assert 0.01 < found[0] < 0.99


def test_a_fit_deviates_from_the_prediction_of_the_other_keys_as_an_ordinary_key():
    one = fitted()
    ordinary = one.model.weights.copy()
    ordinary[:, TWO] = 1.0
    values = sum(spreads(list(MIDI), ordinary))
    others = np.delete(np.arange(7), TWO)
    observed = square((values + noise_of(one.data))[:, others][..., others])
    cross = square(values[:, [TWO]][..., others])
    difference = one.data.y[:, TWO] - cross @ np.linalg.solve(observed, one.data.y[:, others].ravel())
    covariance = values[:, TWO, :, TWO] - cross @ np.linalg.solve(observed, cross.T) + one.data.noise[TWO]
    expected = difference / np.sqrt(np.diag(covariance))
    assert _deviation(one.system, one.data, one.model, TWO) == pytest.approx(expected, rel=1e-5)


def test_shapes_are_searched_one_after_the_other_each_with_the_shapes_before_it():
    """The inverse covariance is updated after each shape. Here it is computed anew."""
    one, model = fitted(), fitted().model
    for q, prior in enumerate(PRIORS):
        shapes = list(model.shapes)
        observed = _observed(_solve(one.data, model), one.data, model, q)
        shapes[q] = most_probable(observed, prior, shapes[q])
        model = model._replace(shapes=shapes)
    assert np.array(_most_probable(one.data, one.model)) == pytest.approx(np.array(model.shapes), rel=1e-3)


def test_weights_of_minima_are_relative():
    literature = np.zeros((2, 88))
    twice = [
        replace(key, minima=tuple(one._replace(weight=2 * one.weight) for one in key.minima)) for key in keys()
    ]  # fmt: skip
    one, other = (keyboard_posterior(x, literature, PRIORS, range(21, 109)) for x in (keys(), twice))
    assert other.mean == pytest.approx(one.mean, rel=1e-9)


def test_joint_laws_are_those_of_the_posterior_and_draws_have_their_covariance():
    literature = np.linspace(3.0, -2.0, 2 * 88).reshape(2, 88)
    joint = joint_laws(keys(), literature, PRIORS, range(21, 109), [1])
    found = keyboard_posterior(keys(), literature, PRIORS, range(21, 109))
    assert joint.mean[:, 0] == pytest.approx(found.mean[:, 1])
    assert np.sqrt(np.diag(joint.covariance)) == pytest.approx(found.sd[:, 1].ravel())
    draws = joint.draw(4000, np.random.default_rng(0)).reshape(4000, -1)
    scale = np.sqrt(np.outer(np.diag(joint.covariance), np.diag(joint.covariance)))
    assert np.abs(draws.mean(axis=0) - joint.mean.ravel()).max() < 0.1 * np.sqrt(np.diag(joint.covariance)).max()
    assert np.abs((np.cov(draws.T) - joint.covariance) / scale).max() < 0.1


# --- shapes -----------------------------------------------------------------------------------------------------------


def test_the_spread_of_a_key_is_that_of_its_law_and_its_scatter():
    prior, at = Prior(0.5, 0.4, 0.5), np.array([21.0, 64.5, 100.0])
    shape = LawShape(*prior.medians)
    variance = np.diag(law_covariance(at, at, shape, prior)) + shape.scatter**2
    assert [prior.sd_at(x) for x in at] == pytest.approx(np.sqrt(variance))


def test_the_grid_of_shapes_is_about_the_most_probable_one_as_wide_as_the_information_allows():
    """Expected information of the logarithms is the covariance of the likelihood's slope over drawn data."""
    random, x = np.random.default_rng(2), np.array([24.0, 31, 40, 52, 60, 75, 96])
    observed = Observed(x, random.normal(size=7), 1e-2 * np.eye(7), np.ones(7))
    shape = most_probable(observed, PRIORS[0], LawShape(*PRIORS[0].medians))
    u = (np.log(shape) - np.log(PRIORS[0].medians)) / SHAPE_SD
    grid = _grid(observed, PRIORS[0], shape)
    assert _shape(PRIORS[0], grid.mean(axis=0)) == pytest.approx(shape)
    total = law_covariance(x, x, shape, PRIORS[0]) + observed.noise + shape.scatter**2 * np.eye(7)
    drawn = random.multivariate_normal(np.zeros(7), total, size=20_000)
    slopes = np.array([log_posterior(observed._replace(y=y), PRIORS[0], u)[1] + u for y in drawn])
    expected = np.var(STEPS) * np.linalg.inv(np.eye(3) + np.cov(slopes.T))
    assert np.cov(grid.T, bias=True) == pytest.approx(expected, abs=0.05 * np.diag(expected).max())
