"""Covariances against brute force, and against what happens when an experiment is repeated."""

import numpy as np
import pytest
from fit_cases import space
from pianofit.fit.space import LOG, NAMES, SIZE, K, P
from pianofit.fit.uncertainty import DOUBTED, intervals, neighbours, statuses, tangled, to_stiffness, whole_covariance

FREE = [0, 2, 4, 6, 7]
ROWS = 40
RANDOM = np.random.default_rng(3)
JACOBIAN = RANDOM.normal(size=(ROWS, SIZE)) * 10 ** RANDOM.uniform(-3, 3, SIZE)
NOWHERE = np.zeros(SIZE, bool)


def covariance(*arguments):
    """Of the parameters alone, without gain and path."""
    return whole_covariance(*arguments)[:LOG, :LOG]


def test_the_covariance_is_the_inverse_of_the_curvature():
    found = covariance(JACOBIAN, np.ones(ROWS), space(FREE), NOWHERE)
    expected = np.zeros((LOG, LOG))
    expected[np.ix_(FREE, FREE)] = np.linalg.inv(JACOBIAN[:, FREE].T @ JACOBIAN[:, FREE])
    np.testing.assert_allclose(found, expected, rtol=1e-8, atol=1e-12 * np.abs(expected).max())


def test_what_is_pressed_against_a_bound_is_held():
    pressed = np.arange(SIZE) == 4
    found = covariance(JACOBIAN, np.ones(ROWS), space(FREE), pressed)
    held = covariance(JACOBIAN, np.ones(ROWS), space([n for n in FREE if n != 4]), NOWHERE)
    np.testing.assert_array_equal(found, held)
    assert found[4].max() == 0.0


def test_gain_and_path_are_fitted_along():
    nuisance = LOG + 1
    jacobian = JACOBIAN.copy()
    own = np.random.default_rng(4).normal(size=ROWS) * np.abs(jacobian[:, 0]).max()
    jacobian[:, nuisance] = jacobian[:, 0] + 0.1 * jacobian[:, 2] + 1e-3 * own
    alone = covariance(jacobian, np.ones(ROWS), space([0, 2]), NOWHERE)
    along = covariance(jacobian, np.ones(ROWS), space([0, 2, nuisance]), NOWHERE)
    assert along.shape == (LOG, LOG)
    assert along[0, 0] > 100 * alone[0, 0]


def test_the_sandwich_is_what_repeating_the_experiment_gives():
    variance = 10 ** RANDOM.uniform(-1, 1, ROWS)
    found = covariance(JACOBIAN, variance, space(FREE), NOWHERE)[np.ix_(FREE, FREE)]
    noise = np.sqrt(variance)[:, None] * RANDOM.normal(size=(ROWS, 20_000))
    estimates = np.linalg.lstsq(JACOBIAN[:, FREE], noise, rcond=None)[0]
    sd = np.sqrt(np.diag(found))
    np.testing.assert_allclose(np.cov(estimates / sd[:, None]), found / np.outer(sd, sd), atol=0.05)


def test_intervals_cover_the_truth_as_often_as_they_say():
    sd = np.sqrt(np.diag(covariance(JACOBIAN, np.ones(ROWS), space(FREE), NOWHERE)))
    freedom, inside = ROWS - len(FREE), np.zeros(len(FREE))
    for _ in range(4000):
        noise = RANDOM.normal(size=ROWS)
        estimate, rest = np.linalg.lstsq(JACOBIAN[:, FREE], noise, rcond=None)[:2]
        values = np.ones(SIZE)
        values[FREE] = np.exp(estimate)
        scaled = np.diag((sd**2) * rest[0] / freedom)
        spans = intervals(scaled, values[:LOG], freedom)
        for i, n in enumerate(FREE):
            low, high = spans[NAMES[n]] or (1.0, 1.0)
            inside[i] += low <= 1.0 <= high
    np.testing.assert_allclose(inside / 4000, 0.95, atol=0.015)


def test_what_was_not_fitted_has_no_interval():
    cov = covariance(JACOBIAN, np.ones(ROWS), space(FREE), NOWHERE)
    spans = intervals(cov, np.ones(LOG), 10)
    assert {name for name, span in spans.items() if span} == {NAMES[n] for n in FREE}


def test_a_direction_without_data_is_vague_but_finite():
    jacobian = JACOBIAN.copy()
    jacobian[:, 4] = 2.0 * jacobian[:, 6]
    cov = covariance(jacobian, np.ones(ROWS), space(FREE), NOWHERE)
    assert np.isfinite(cov).all()
    assert np.sqrt(cov[4, 4]) > 1e3 / np.linalg.norm(jacobian[:, 4])
    assert (NAMES[4], NAMES[6]) in [pair[:2] for pair in tangled(cov)]


def test_the_error_of_k_h_follows_from_those_of_force_and_exponent():
    log_u, values = -7.5, np.ones(LOG)
    values[P] = 2.5
    joint = np.array([[1e-4, 2e-5], [2e-5, 4e-6]])
    cov = np.zeros((LOG, LOG))
    cov[np.ix_([K, P], [K, P])] = joint
    draws = RANDOM.multivariate_normal([0.0, np.log(2.5)], joint, 200_000)
    log_k_h = draws[:, 0] - np.exp(draws[:, 1]) * log_u
    found = to_stiffness(cov, values, log_u)
    assert found[K, K] == pytest.approx(log_k_h.var(), rel=0.02)
    assert found[K, P] == pytest.approx(np.cov(log_k_h, draws[:, 1])[0, 1], rel=0.02)
    assert found[P, P] == joint[1, 1]


def test_statuses_say_what_the_data_told():
    box = space([0, 1, 2, 3, 4])
    box.spread[2:4] = 0.2
    sd = np.zeros(LOG)
    sd[:5] = [0.01, 3.0, 0.05, 0.19, 0.01]
    found = statuses(np.diag(sd**2), box, np.arange(SIZE) == 4, {"mu": "assumed"})
    assert found == dict.fromkeys(NAMES, "fixed") | {
        "c": "free", "kappa": "not-identifiable", "b1": "free", "b2": "not-identifiable", "K_H": "at-bound",
        "mu": "assumed",
    }  # fmt: skip


def test_what_is_told_apart_is_not_called_tangled():
    cov = np.zeros((LOG, LOG))
    cov[np.ix_([0, 1], [0, 1])] = [[1.0, 0.9], [0.9, 1.0]]
    cov[np.ix_([4, 6], [4, 6])] = [[4.0, -1.98], [-1.98, 1.0]]
    assert tangled(cov) == [("K_H", "p", pytest.approx(-0.99))]


def alike(takes: int, rows: int, likeness: float, random: np.random.Generator) -> np.ndarray:
    """Residuals of variance 1 [3, takes, rows], of which neighbours correlate by `likeness`."""
    x = random.normal(size=(3, takes, rows))
    for k in range(1, rows):
        x[..., k] = likeness * x[..., k - 1] + np.sqrt(1 - likeness**2) * x[..., k]
    return x


def test_neighbours_that_are_alike_are_told_from_those_that_are_not():
    random, found = np.random.default_rng(5), np.ones((3, 60), bool)
    found[:, ::7] = False
    for truth in (0.0, 0.8):
        runs = [neighbours(alike(3, 60, truth, random).ravel(), found) for _ in range(50)]
        said = np.array([[run.likeness for run in nine] for nine in runs])
        assert said.shape == (50, 9)
        assert np.median(said) == (0.0 if truth == 0.0 else pytest.approx(truth, abs=0.08))
        assert (said > 0).mean() < 0.02 if truth == 0.0 else said.min() > 0.4
    assert all((run.rows % 60 == run.number).all() and (run.number % 7 > 0).all() for run in runs[0])


def test_the_sandwich_of_neighbours_is_what_repeating_the_experiment_gives():
    random, rows, free = np.random.default_rng(6), 50, [0, 2]
    # A mean and a slope over the partials, which neighbours that are alike bend together.
    jacobian = np.zeros((3 * rows, SIZE))
    jacobian[:, 0], jacobian[:, 2] = 1.0, np.tile(np.linspace(-1, 1, rows), 3)
    found = np.ones((1, rows), bool)
    residuals = np.stack([alike(1, rows, 0.7, random).ravel() for _ in range(8000)])
    runs = [run._replace(likeness=0.7) for run in neighbours(residuals[0], found)]
    arguments = (jacobian, np.ones(3 * rows), space(free), NOWHERE)
    sd = np.sqrt(np.diag(covariance(*arguments, runs))[free])
    estimates = np.linalg.lstsq(jacobian[:, free], residuals.T, rcond=None)[0]
    np.testing.assert_allclose(estimates.std(axis=1), sd, rtol=0.04)
    assert (sd > 1.8 * np.sqrt(np.diag(covariance(*arguments))[free])).all()


def test_calibrated_takes_that_are_missed_alike_do_not_add_up():
    """The error of a mean over three takes of 40 levels that share their misses is that of one take's."""
    random, takes, rows, free = np.random.default_rng(7), 3, 40, [4]
    found = np.ones((takes, rows), bool)
    jacobian = np.zeros((3 * takes * rows, SIZE))
    jacobian[2 * takes * rows :, 4] = 1.0
    shared, own = random.normal(size=(4000, 1, rows)), random.normal(size=(4000, takes, rows))
    levels = np.sqrt(0.8) * shared + np.sqrt(0.2) * own
    residuals = np.zeros((4000, 3 * takes * rows))
    residuals[:, 2 * takes * rows :] = levels.reshape(4000, -1)
    estimates = np.linalg.lstsq(jacobian[:, free], residuals.T, rcond=None)[0][0]
    said = []
    for residual in residuals[:50]:
        runs = neighbours(residual, found, calibrated=True)
        said.append(np.sqrt(covariance(jacobian, np.ones(len(residual)), space(free), NOWHERE, runs)[4, 4]))
        assert all(run.across == 0 for run in neighbours(residual, found))
    assert np.median(said) == pytest.approx(estimates.std(), rel=0.1)
    apart = [neighbours(random.normal(size=residuals.shape[1]), found, calibrated=True) for _ in range(50)]
    assert np.mean([max(run.across for run in runs) > 0 for runs in apart]) < 0.1


def test_what_takes_are_doubted_for_alike_does_not_add_up():
    """Levels of all takes are off by one drift along the partials, each take's by its own share, beside their noise."""
    random, takes, rows, free = np.random.default_rng(8), 3, 30, [4]
    share = np.array([0.9, 0.5, 0.2])[:, None] * np.ones(rows)
    jacobian = np.zeros((3 * takes * rows, SIZE))
    jacobian[2 * takes * rows :, 4] = 1.0
    drift = np.stack([alike(1, rows, DOUBTED, random)[0, 0] for _ in range(6000)])
    own = random.normal(size=(6000, takes, rows))
    levels = share * drift[:, None] + np.sqrt(1 - share**2) * own
    doubt = np.zeros((3, takes, rows))
    doubt[2] = share
    runs = [
        run._replace(likeness=0.0, across=0.0) for run in neighbours(np.zeros(3 * takes * rows), share > 0, True, doubt)
    ]
    said = np.sqrt(covariance(jacobian, np.ones(3 * takes * rows), space(free), NOWHERE, runs)[4, 4])
    assert levels.mean(axis=(1, 2)).std() == pytest.approx(said, rel=0.05)
    alone = np.sqrt(covariance(jacobian, np.ones(3 * takes * rows), space(free), NOWHERE)[4, 4])
    assert said > 2.5 * alone
