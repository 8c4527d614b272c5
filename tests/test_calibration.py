"""Posteriors of data that are drawn from the priors hold the true values as often as they claim."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))
import calibration

from pianofit.inference import pipeline
from pianofit.inference.objective import Objective

# Data sets, and the probability that a right posterior fails, shared by two tests of each parameter.
CASES, FALSE_ALARM = 40, 1e-4
# With widths of the priors times these, Laplace's approximation is nearly exact.
HYPER, HAMMER = 0.05, 0.25


@pytest.fixture(scope="module")
def scores() -> np.ndarray:
    """Standard normal numbers of the ranks [cases, parameters]."""
    problem = calibration.template(HYPER, HAMMER)
    cases = (calibration.draw(np.random.default_rng([4, n]), problem) for n in range(CASES))
    return np.array([calibration.normal_scores(case) for case in cases])


def unlikely(scores: np.ndarray) -> list[int]:
    """Parameters whose ranks are not uniform: by their distribution, or by the mean square of their normal scores."""
    level = FALSE_ALARM / (2 * scores.shape[1])
    found = []
    for i, z in enumerate(scores.T):
        above = stats.chi2.sf(z @ z, len(z))
        if stats.kstest(z, "norm").pvalue < level or min(above, 1 - above) < level / 2:
            found.append(i)
    return found


def test_true_values_are_uniformly_distributed_in_their_posteriors(scores):
    assert scores.shape == (CASES, 10)
    assert unlikely(scores) == []


@pytest.mark.parametrize(("factor", "shift"), [(2.0, 0.0), (0.5, 0.0), (1.0, 1.0)], ids=["narrow", "wide", "shifted"])
def test_a_wrong_posterior_fails(scores, factor, shift):
    """A Gaussian posterior that is too narrow by a factor multiplies the normal scores by it."""
    assert len(unlikely(factor * scores + shift)) > scores.shape[1] / 2


def test_a_string_with_outliers_is_fitted_from_several_excesses(monkeypatch):
    """A smooth deviation and errors with heavy tails have a minimum of F for each set of outliers."""
    problem = calibration.template()
    table, random = problem.observed.frequency, np.random.default_rng(5)
    d = np.sqrt(3) * table.distance_octaves / 0.7
    smooth = np.linalg.cholesky((1 + d) * np.exp(-d) + 1e-9 * np.eye(len(d))) @ random.normal(size=len(d))
    cents = 0.6 * table.smooth_profile * smooth[None] + 0.01 * random.standard_t(0.7, size=table.value.shape)
    exact = table._replace(value=cents, variance=np.full(cents.shape, 1e-4), systematic=0 * table.systematic)
    problem = replace(problem, observed=replace(problem.observed, frequency=exact))

    def lowest() -> float:
        found = pipeline.fit_string(problem)
        assert found.last_decrease[0] < 1e-6  # within the maximum number of steps
        return float(Objective.of_string(problem).total(found)[0])

    several = lowest()
    monkeypatch.setattr(pipeline, "STRING_STARTS", ((0.0, 0.0),))
    assert several < lowest() - 1
