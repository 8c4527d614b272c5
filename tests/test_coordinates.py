"""The parametrisation: bounds, the bounds of K_H for the force, and the values by name."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from model_cases import GEOMETRY

from pianofit.felt import LAWS, RelaxingHammer, check_hammer
from pianofit.inference.parametrisation import LOG_ABSENT_LOSS, Parametrisation, names_of
from pianofit.parameters import PARAMETERS, Hammer, check

STROKES = 2
LAW = LAWS["hunt-crossley"]
VALUES = names_of(LAW)
SHARED = len(VALUES)
FORCE, P, MU, X0 = (VALUES.index(name) for name in ("K_H", "p", "mu", "x0"))
VALUE = {
    "c": 304.0, "kappa": 1.7, "b1": 0.5, "b2": 2e-4, "K_H": 1e10, "p": 2.5, "mu": 0.2, "M_H": 5e-3, "x0": 0.12,
    "width": 0.02, "epsilon": 0.5, "tau": 1e-4, "skin": 1e-4,
}  # fmt: skip
LOG_U = float(np.log(4e-4))


def unknowns() -> Parametrisation:
    """All parameters are free except for relaxation and skin, which this felt law does not have."""
    mean = np.log([VALUE[name] for name in VALUES] + [1.0, 2.0])
    mean[FORCE] += VALUE["p"] * LOG_U
    sd = np.full(len(mean), 0.5)
    sd[[VALUES.index(name) for name in ("epsilon", "tau", "skin")]] = 0.0
    lower, upper = mean - 0.7, mean + 0.7
    lower[FORCE], upper[FORCE] = np.log(5e9), np.log(2e10)
    no_size = (), np.zeros((0, len(mean))), np.zeros(len(mean), bool)
    return Parametrisation(mean, sd, lower, upper, float(np.exp(LOG_U)), GEOMETRY, LAW, *no_size)


def points(count: int = 40) -> np.ndarray:
    return unknowns().mean + np.random.default_rng(0).normal(size=(count, SHARED + STROKES))


def test_a_projection_lies_in_the_box_and_keeps_what_did():
    u, theta = unknowns(), points()
    inside = u.project(theta)
    low, high = u.bounds_at(inside)
    assert ((inside >= low - 1e-12) & (inside <= high + 1e-12))[:, u.free].all()
    np.testing.assert_array_equal(u.project(inside), inside)
    np.testing.assert_array_equal(inside[:, ~u.free], np.tile(u.mean[~u.free], (len(theta), 1)))
    kept = (theta > low) & (theta < high) & u.free
    kept[:, FORCE] &= kept[:, P]  # a change of p changes the range of the force
    np.testing.assert_array_equal(inside[kept], theta[kept])
    assert kept.any(axis=0)[u.free].all()


def test_the_force_is_bounded_as_K_H_is_whatever_p():
    u = unknowns()
    for exponent in (2.0, 2.5, 3.2):
        theta = u.mean.copy()
        theta[P] = np.log(exponent)
        for force, K in ((50.0, 2e10), (-50.0, 5e9)):
            theta[FORCE] = force
            held = u.project(theta)
            assert np.exp(u.log_values(held)[VALUES.index("K_H")]) == pytest.approx(K, rel=1e-12)
            assert u.at_bound(held)[FORCE]
    assert not u.at_bound(u.mean).any()


def test_only_what_is_free_can_be_at_a_bound():
    u = unknowns()
    held = replace(u, sd=np.where(np.arange(u.size) == MU, 0.0, u.sd))
    theta = u.mean.copy()
    theta[[MU, X0]] = u.upper[[MU, X0]]
    assert np.flatnonzero(u.at_bound(theta)).tolist() == [MU, X0]
    assert np.flatnonzero(held.at_bound(theta)).tolist() == [X0]


def test_a_hammer_on_an_edge_of_its_range_is_a_hammer():
    """The exponential of the logarithm of 1e16 is more than 1e16."""
    u = unknowns()
    for edge in ("lower", "upper"):
        log = {name: float(np.log(getattr(PARAMETERS[name], edge))) for name in (*VALUES[:8], "v_H0")}
        theta = np.append([log.get(name, 0.0) for name in VALUES], [log["v_H0"]] * STROKES)
        theta = u.from_log_values(theta)
        check_hammer(u.hammer(theta, 0))
        check(u.string(theta)._asdict())


def test_the_tangent_is_that_of_the_values():
    u, step = unknowns(), 1e-6
    for theta in points(5):
        expected = [(u.log_values(theta + e) - u.log_values(theta - e)) / (2 * step) for e in step * np.eye(u.size)]
        np.testing.assert_allclose(u.tangent(theta), np.array(expected).T, atol=1e-7)


def sized() -> Parametrisation:
    """As `unknowns`, with uncertain length and mass; c, K_H and x0 were given."""
    u = unknowns()
    size = SHARED + STROKES + 2
    exponents = np.random.default_rng(3).normal(size=(2, size))
    exponents[:, [P, *range(SHARED, size)]] = 0.0  # p and velocities do not scale
    given = np.isin(np.arange(size), [0, FORCE, X0])
    columns = {name: np.append(getattr(u, name), [0.0, 0.0]) for name in ("mean", "sd", "lower", "upper")}
    columns["sd"][-2:] = 0.01
    return replace(u, **columns, sizes=("L", "M_S"), exponents=exponents, given=given)


def test_a_value_is_that_of_the_model_scaled_with_the_sizes_whether_it_was_given_or_not():
    u = sized()
    theta = u.mean + 0.1 * np.random.default_rng(4).normal(size=(5, u.size))
    scaling = u.size_changes(theta) @ u.exponents
    ratio = u.log_values(theta) - u.model_entries(theta)
    ratio[:, FORCE] += np.exp(theta[:, P]) * LOG_U
    np.testing.assert_allclose(ratio, scaling, atol=1e-12)
    np.testing.assert_allclose(u.from_log_values(u.log_values(theta)), theta, atol=1e-12)
    steps = 1e-6 * np.eye(u.size)
    expected = [(u.log_values(theta[0] + step) - u.log_values(theta[0] - step)) / 2e-6 for step in steps]
    np.testing.assert_allclose(u.tangent(theta[0]), np.array(expected).T, atol=1e-7)


def test_values_are_those_of_a_string_and_a_hammer():
    u = unknowns()
    values = dict(zip(VALUES, np.exp(u.log_values(u.mean)), strict=False))
    assert values == pytest.approx(VALUE, rel=1e-12)
    assert u.string(u.mean) == pytest.approx([VALUE[n] for n in ("c", "kappa", "b1", "b2")])
    hammer = u.hammer(u.mean, 1)
    assert isinstance(hammer, Hammer)
    assert hammer._asdict() == pytest.approx({n: VALUE[n] for n in ("K_H", "mu", "p", "M_H")} | {"v_H0": 2.0})
    assert u.geometry_at(u.mean)[2:4] == pytest.approx((VALUE["x0"], VALUE["width"]))
    relaxing = replace(u, law=LAWS["stulov"])
    theta = u.mean.copy()
    theta[MU] = LOG_ABSENT_LOSS
    hammer = relaxing.hammer(theta, 0)
    assert isinstance(hammer, RelaxingHammer)
    assert (hammer.mu, hammer.v_H0) == (0.0, pytest.approx(1.0))
    assert hammer[-2:] == pytest.approx((0.5, 1e-4))
