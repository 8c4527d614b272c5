"""Statuses follow from one table of dependencies and from tests of the joint posterior."""

from __future__ import annotations

import graphlib
from types import SimpleNamespace

import numpy as np
import pytest

from pianofit.inference import Posterior
from pianofit.result.statuses import SIGNIFICANCE, path_compared
from pianofit.schema.dependencies import CONTACT, FELT, STANDS_ON, VELOCITIES, derived_status, foundations

SHARED = 3  # parameters before the velocities


def test_what_stands_on_what_has_no_circle_and_ends_at_parts_of_the_model_or_parameters():
    tuple(graphlib.TopologicalSorter(STANDS_ON).static_order())
    ends = {below for name in STANDS_ON for below in foundations(name)} - STANDS_ON.keys()
    assert ends == {FELT, CONTACT, VELOCITIES, "c", "kappa", "x0", "pickup", "width"}


@pytest.mark.parametrize(
    ("name", "states", "log_sd", "expected"),
    [
        ("M_H/M_S", {"M_H": "not-identifiable"}, 0.01, "not-identifiable"),
        ("M_H/M_S", {"M_H": "scaled", "v_H0": "not-identifiable"}, 0.01, "fitted"),
        ("M_H/M_S", {"M_H": "fitted"}, 0.8, "not-identifiable"),
        ("hammer", {"F/M_S": "at-bound", "M_H": "fitted"}, 0.1, "at-bound"),
        ("B", {"c": "scaled", "kappa": "scaled"}, 0.01, "fitted"),
        ("M_H/M_S", {"M_H": "given"}, 0.0, "given"),
        ("M_H/M_S", {"M_H": "assumed"}, 0.0, "assumed"),
        ("v/v_ref 2", {"v_H0": "not-identifiable"}, 0.0, "not-identifiable"),
    ],
)
def test_a_derived_quantity_is_as_good_as_what_it_stands_on(name, states, log_sd, expected):
    assert derived_status(name, states, log_sd) == expected


def compared(logs: np.ndarray, sd: np.ndarray, groups: tuple[int, ...]) -> bool:
    """Whether strokes with these log velocities and standard deviations differ in one of the path groups."""
    size = SHARED + len(logs)
    mean, covariance = np.zeros((1, size)), np.zeros((1, size, size))
    mean[0, SHARED:], covariance[0, SHARED:, SHARED:] = logs, np.diag(sd**2)
    layout = SimpleNamespace(stroke=tuple(range(len(logs))), group=groups)
    problem = SimpleNamespace(structure=layout, parametrisation=SimpleNamespace(shared=SHARED))
    return path_compared(SimpleNamespace(problem=problem, posterior=Posterior(mean, covariance, np.ones(1))))


@pytest.mark.parametrize("strokes", [2, 5, 12])
def test_equal_strokes_seem_to_differ_as_often_as_the_significance_says(strokes):
    random, count = np.random.default_rng(0), 2000
    sd = random.uniform(0.05, 0.3, strokes)
    found = sum(compared(random.normal(0.0, sd), sd, (0,) * strokes) for _ in range(count)) / count
    assert found == pytest.approx(SIGNIFICANCE, abs=4 * np.sqrt(SIGNIFICANCE / count))


def test_two_strokes_differ_if_the_interval_of_their_ratio_excludes_one():
    sd = np.array([0.3, 0.4])
    assert compared(np.array([0.0, 0.99]), sd, (0, 0))
    assert not compared(np.array([0.0, 0.97]), sd, (0, 0))
    assert not compared(np.array([0.0, 0.99]), sd, (0, 1))


def test_exact_velocities_differ_or_do_not():
    zero = np.zeros(2)
    assert compared(np.log([1.0, 1.01]), zero, (0, 0))
    assert not compared(np.log([1.0, 1.0]), zero, (0, 0))
