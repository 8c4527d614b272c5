"""The removal of the prior of a fit, against exact posteriors of linear measurements and the fit's own coordinates."""

from __future__ import annotations

import numpy as np
import pytest
from instrument_cases import fit_document, true_note

from pianofit.felt import DEFAULT_LAW
from pianofit.felt.published import HAMMER_SD
from pianofit.inference.parametrisation import Parametrisation
from pianofit.instrument.fit_prior import REACH, FitPrior, prior_of, remove_prior
from pianofit.instrument.keyboard_posterior import KeyMeasurements, Measurement, keyboard_posterior
from pianofit.instrument.quantity_law import Prior
from pianofit.schema.decode import convert
from pianofit.schema.fit import Fit

ALL = list(range(21, 109))


def posterior(mean, precision, median, sd) -> tuple[np.ndarray, np.ndarray]:
    """Mean and covariance of a Gaussian likelihood times a Gaussian prior of every value."""
    covariance = np.linalg.inv(precision + np.diag(sd**-2.0))
    return covariance @ (precision @ mean + median / sd**2), covariance


def test_a_posterior_without_its_prior_is_the_likelihood():
    random = np.random.default_rng(1)
    root, sd, median = random.normal(size=(3, 3)), np.array([0.5, 1.0, 2.0]), np.array([0.1, -0.2, 0.3])
    precision = root @ root.T + np.diag(4 / sd**2)
    truth = median + 0.5 * sd
    mean, covariance = posterior(truth, precision, median, sd)
    found = remove_prior(FitPrior(np.diag(1 / sd), (mean - median) / sd), covariance)
    assert mean + found.shift == pytest.approx(truth, abs=0.01)
    assert found.covariance == pytest.approx(np.linalg.inv(precision), rel=0.02)


def test_weights_of_minima_without_their_prior_are_those_of_the_likelihood():
    """Two minima of equal likelihood have weights by the prior alone, and these are removed."""
    sd, median, precision = np.array([1.0]), np.zeros(1), np.array([[9.0]])
    weights = []
    for at in (0.0, 1.5):
        mean, covariance = posterior(np.array([at]), precision, median, sd)
        total = 1 / 9 + 1
        prior_weight = np.exp(-0.5 * at**2 / total)
        removal = remove_prior(FitPrior(np.eye(1), mean), covariance)
        weights.append(prior_weight * np.exp(removal.log_weight))
    assert weights[1] == pytest.approx(weights[0], rel=0.02)


def test_what_a_recording_does_not_determine_gets_wide_and_stays_near():
    """No mean moves farther than the posterior reaches, at which a fit's posterior is not Gaussian any more."""
    mean, covariance = np.array([1.5, 0.5]), np.diag([0.9, 1.0])
    found = remove_prior(FitPrior(np.eye(2), mean), covariance)
    assert found.shift == pytest.approx(REACH * np.sqrt(np.diag(covariance)))
    assert (np.diag(found.covariance) > [5.0, 50.0]).all()


def test_the_values_with_a_prior_are_the_coordinates_of_the_fit():
    """Against finite differences of the parametrisation, which searches the force in place of the stiffness."""
    note, law = true_note(60), DEFAULT_LAW
    errors = dict.fromkeys(("K_H", "mu", "p", "M_H", "x0"), 0.1)
    document = fit_document(note, errors, (4.0,))
    names = [*document["minima"][0]["covariance"]["names"], "skin"]
    document["felt"], document["minima"][0]["parameters"]["skin"] = law.name, 3e-5
    document["minima"][0]["covariance"] = {"names": names, "matrix": np.eye(len(names)).tolist()}
    document["parameters"]["skin"] = {**document["parameters"]["p"], "value": 3e-5}
    medians = {"K_H": 1e9, "mu": 0.1, "p": 2.5, "M_H": 3e-3, "x0": 0.08, "skin": 6e-5}
    for name, value in medians.items():
        document["parameters"][name] |= {"initial": value, "status": "fitted"}
    fit = convert(document, Fit, "fit.json", "")
    u = fit.derived.reference_compression_mm * 1e-3
    prior = prior_of(fit, fit.minima[0], tuple(names))

    own = [*(n for n in law.columns if n in names)]
    size = len(law.columns) + 4
    zero, no_size = np.zeros(size), ((), np.zeros((0, size)), np.zeros(size, bool))
    at = Parametrisation(zero, np.ones(size), zero, zero, u, note.geometry, law, *no_size)

    def theta(values) -> np.ndarray:
        logs = np.array([np.log(values.get(n, 1.0)) for n in at.names])
        return at.from_log_values(logs)

    values = dict(fit.minima[0].parameters)
    spread = HAMMER_SD | {n: p.prior_sd for n, p in law.parameters.items()}
    order = [n for n in spread if n in medians]
    index, sd = [at.index_of(n) for n in order], np.array([spread[n] for n in order])
    away = (theta(values) - theta(values | medians))[index] / sd
    assert prior.away == pytest.approx(away, rel=1e-9, abs=1e-9)
    for name in own:
        moved = theta(values | {name: values[name] * np.exp(1e-6)}) - theta(values)
        assert prior.rows[:, names.index(name)] == pytest.approx(moved[index] / 1e-6 / sd, rel=1e-4, abs=1e-4)


def test_a_law_that_no_key_determines_is_not_certain():
    """Nine fits return their prior. The law keeps the width of the literature's."""
    prior, x = Prior(1.5, 0.7, 1.0), np.linspace(24, 100, 9).astype(int)
    handed = remove_prior(FitPrior(np.eye(1) / 1.5, np.zeros(1)), np.eye(1) * 1.49**2)
    keys = [KeyMeasurements(int(k), (Measurement(1.0, handed.shift, handed.covariance),), np.zeros(1)) for k in x]
    found = keyboard_posterior(keys, np.zeros((1, 88)), [prior], ALL)
    assert found.sd[0, 0, 60 - 21] > 0.9 * np.hypot(prior.offset, 0.3)
