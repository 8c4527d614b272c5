"""The one objective, against a dense covariance, quadrature, Student's t, and its own automatic derivatives."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.special
import scipy.stats
from table_cases import PHI, SHAPES, SHARED, SMALL, dense, dense_nodes, evaluate_one, noise, point, shared, table

import pianofit.model  # noqa: F401  (float64)
from pianofit.inference.derivatives import latent_posterior
from pianofit.inference.likelihood import (
    ObservationTable,
    combine_nodes,
    em_weights,
    interference_db,
    node_weights,
    solve_nodes,
    table_objective,
)
from pianofit.inference.objective import QuadraticSurrogate

pytestmark = pytest.mark.usefixtures("float64")

F = jax.jit(table_objective)
ONE_NODE = [name for name, shape in SHAPES.items() if shape[4] == (1, 1)]


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("shape", SHAPES)
def test_the_objective_is_the_dense_one(shape, seed):
    t, (residual, w, theta) = table(shape, seed), point(shape, seed)
    for phi in (PHI, PHI + np.array([0.5, -1.0, 0.7, 4.0, -1.0])):
        found = float(F(t, residual, phi, w, theta))
        assert found == pytest.approx(dense(t, residual, phi, w, theta), rel=1e-9, abs=1e-8)
        assert table_objective(t, residual, phi, w, theta, np) == pytest.approx(found, rel=1e-11)


@pytest.mark.parametrize("shape", SHAPES)
def test_many_points_at_once_are_each_alone(shape):
    t, points = table(shape), [point(shape, seed) for seed in range(3)]
    residual, w, theta = (np.stack(x) for x in zip(*points, strict=True))
    phi = PHI + 0.1 * np.arange(3)[:, None]
    together = solve_nodes(t, residual, phi, w, theta).nll_per_node
    for i in range(3):
        alone = solve_nodes(t, *(x[i : i + 1] for x in (residual, phi, w, theta))).nll_per_node
        np.testing.assert_allclose(together[i], alone[0], rtol=1e-12)


def test_interference_is_the_spread_of_a_level_over_all_phases():
    """The level of 1 + η exp(iφ), dB, for a small η and every φ."""
    eta = 1e-3
    level = 20 * np.log10(np.abs(1 + eta * np.exp(2j * np.pi * np.arange(360) / 360)))
    t = table("one recording")
    phi = np.where(np.arange(5) == 3, np.log(eta), PHI)
    assert interference_db(t, phi[None])[0] == pytest.approx(np.std(level) * np.asarray(t.ratio), rel=1e-5)


@pytest.mark.parametrize("shape", SHAPES)
def test_the_gradient_is_the_automatic_one(shape):
    t, (residual, w, theta) = table(shape), point(shape)
    size = len(theta)
    jacobian = np.random.default_rng(3).normal(size=(*residual.shape, size))
    automatic = jax.jit(
        jax.grad(lambda d, at: table_objective(t, jnp.asarray(residual) - jacobian @ d, PHI, w, at), argnums=(0, 1))
    )
    _, gradient, hessian, *_ = evaluate_one(t, residual, jacobian, PHI, w, theta)
    by_levels, by_velocities = automatic(np.zeros(size), theta)
    np.testing.assert_allclose(gradient, by_levels + by_velocities, rtol=1e-9, atol=1e-9)
    several = len(residual) > len(t.group[0])  # recordings of a path
    assert (np.abs(by_velocities[SHARED:]) > 1e-3).any() == several
    assert np.linalg.eigvalsh(hessian)[0] > -1e-10 * np.abs(hessian).max()
    step = 1e-5
    exact = [(automatic(e, theta)[0] - automatic(-e, theta)[0]) / (2 * step) for e in step * np.eye(size)]
    exact = np.stack(exact)
    if shape in ONE_NODE:  # a quadratic, except for censored entries, whose curvature is exact too
        np.testing.assert_allclose(hessian, exact, rtol=1e-6, atol=1e-7)
    else:  # the nodes' weights change with θ, and leaving that out makes the curvature larger
        assert np.linalg.eigvalsh(hessian - exact)[0] > -1e-7


@pytest.mark.parametrize("shape", SHAPES)
def test_a_report_has_the_derivatives_of_the_objective(shape):
    t, (residual, w, theta) = table(shape), point(shape)
    found = evaluate_one(t, residual, np.ones((*residual.shape, len(theta))), PHI, w, theta)

    def of(p: jax.Array, x: jax.Array) -> jax.Array:
        return table_objective(t, jnp.asarray(residual), p, jnp.exp(x), theta)

    both = jax.jit(jax.value_and_grad(of, argnums=(0, 1)))
    value, (by_phi, by_log_w) = both(PHI, np.log(w))
    assert float(found.nll) == pytest.approx(float(value), rel=1e-12)
    np.testing.assert_allclose(found.by_phi, by_phi, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(found.by_log_w, by_log_w, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("shape", ["no path", "ten nodes"])
def test_the_parabola_touches_F_from_above(shape):
    """At its residual it has F's slope and curvature. With φ and w fixed, lowering it lowers F."""
    t = table(shape)._replace(censored=np.zeros((0, 2), int))
    residual, w, theta = point(shape)
    random = np.random.default_rng(3)
    jacobian = random.normal(size=(*residual.shape, len(theta)))
    surrogate = QuadraticSurrogate.at_residual(t, PHI, w, residual, theta)
    here = surrogate.evaluate(residual[None], jacobian[None])
    _, gradient, hessian, *_ = evaluate_one(t, residual, jacobian, PHI, w, theta)
    by_covariance = evaluate_one(t, residual, 0 * jacobian, PHI, w, theta).gradient  # the surrogate's is fixed
    np.testing.assert_allclose(here.gradient[0], gradient - by_covariance, rtol=1e-8)
    np.testing.assert_allclose(here.curvature[0], hessian, rtol=1e-8, atol=1e-10)
    moved = residual + 3 * random.normal(size=(60, *residual.shape)) * np.exp(random.normal(size=(60, 1, 1)))
    rise = surrogate.evaluate(moved, np.zeros((60, *jacobian.shape))).nll - here.nll
    value = jax.jit(lambda r: table_objective(t, r, PHI, w, theta))
    F = np.array([value(jnp.asarray(r)) for r in (residual, *moved)])
    assert (F[1:] - F[0] <= rise + 1e-9 * np.abs(rise)).all()
    if len(t.log_weight) == 1:
        np.testing.assert_allclose(F[1:] - F[0], rise, rtol=1e-8, atol=1e-8)


def test_a_parabola_of_one_answer_about_gains_lies_above_F_as_well():
    """Jensen's inequality for any weights p of the nodes: F is at most Σ p (F of the node - log(its weight / p))."""
    t = table("ten nodes")._replace(censored=np.zeros((0, 2), int))
    residual, w, theta = point("ten nodes")
    random = np.random.default_rng(4)
    moved = np.concatenate([residual[None], residual + 3 * random.normal(size=(40, *residual.shape))])
    value = jax.jit(lambda r: table_objective(t, r, PHI, w, theta))
    F = np.array([value(jnp.asarray(r)) for r in moved])
    per_node = solve_nodes(t, *(x[None] for x in (residual, PHI, w, theta))).nll_per_node[0]
    weight, answers = node_weights(t, per_node[None])[0], t.log_weight.shape[1]
    assert answers > 1
    for gains in range(answers):
        surrogate = QuadraticSurrogate.at_residual(t, PHI, w, residual, theta, gains)
        rise = surrogate.evaluate(moved, np.zeros((*moved.shape, 1))).nll
        p = weight[:, gains] / weight[:, gains].sum()
        above = (p * (per_node[:, gains] - t.log_weight[:, gains] + np.log(p))).sum()
        # Priors of φ and w.
        rest = combine_nodes(t, per_node[None], PHI[None], w[None])[0] + scipy.special.logsumexp(
            t.log_weight - per_node
        )
        assert (above + rest + rise - rise[0] + 1e-9 * np.abs(rise) >= F).all()


def test_parabolas_before_a_residual_is_known_are_on_one_scale():
    """At the node of the middle τ, for either answer: without a residual the value is the node's own F."""
    t = table("ten nodes")._replace(censored=np.zeros((0, 2), int))
    nothing = np.zeros_like(t.value)
    alike = np.zeros(t.velocity.shape[1])
    per_node = (
        solve_nodes(t, *(x[None] for x in (nothing, PHI, np.ones_like(nothing), alike))).nll_per_node[0] - t.log_weight
    )
    middle = len(per_node) // 2
    for gains, surrogate in enumerate(QuadraticSurrogate.of_gains(t, PHI)):
        found = surrogate.evaluate(nothing[None], np.zeros((1, *nothing.shape, 1)))
        assert found.nll[0] == pytest.approx(per_node[middle, gains], rel=1e-12)


@pytest.mark.parametrize("shape", ["one recording", "no path", "ten nodes"])
def test_weighting_anew_is_descent_to_a_stationary_point(shape):
    t, (residual, w, theta) = table(shape), point(shape)
    both = jax.jit(jax.value_and_grad(lambda x: table_objective(t, jnp.asarray(residual), PHI, jnp.exp(x), theta)))
    before = np.inf
    for _ in range(80):
        now, slope = both(np.log(w))
        assert now <= before + 1e-10
        before, last, w = now, np.asarray(slope), em_weights(t, np.asarray(slope), w)
    assert np.abs(last * np.asarray(t.detected)).max() < 1e-6
    assert (w[np.asarray(t.detected) == 0] == 1).all()


def tiny() -> ObservationTable:
    """Two recordings of two partials through one path, with a gain; one partial is censored."""
    t = table("nothing absent")
    detected, censored = np.ones((2, 2)), np.array([[1, 1]])
    detected[1, 1] = 0.0
    random = np.random.default_rng(0)
    changed = {
        "value": np.zeros((2, 2)), "variance": 0.5 + random.random((2, 2)), "detected": detected, "censored": censored,
        "group": np.ones((2, 1)), "columns": random.normal(size=(1, 2, 2)), "scale": np.array([[0.4], [1.6]]),
        "systematic": t.systematic[:2, :2], "distance_octaves": t.distance_octaves[:2, :2],
        "has_unknown_path": np.ones(1),
        "log_tau": np.log([[0.5], [1.5]]), "log_weight": np.log([[0.2, 0.1], [0.4, 0.3]]),
        "excess_profile": np.ones(2), "smooth_profile": np.ones(2), "pitch": np.zeros((2, 2)),
        "ratio": np.ones((2, 2)), "velocity": np.eye(2),
    }  # fmt: skip
    return t._replace(**{name: jnp.asarray(x) for name, x in changed.items()})


def test_what_is_integrated_out_is_the_integral():
    """Paths, a gain and τ by brute force: a Gauss-Hermite grid over all latent values, one of them censored."""
    t, phi, w = tiny(), np.array([-0.3, 0.2, -0.4, -3.0, SMALL]), np.array([[1.2, 0.7], [0.9, 1.0]])
    theta = np.zeros(2)
    x, weight = np.polynomial.hermite_e.hermegauss(48)
    grid = np.stack(np.meshgrid(x, x, x, indexing="ij"), axis=-1).reshape(-1, 3)
    mass = np.einsum("i,j,k->ijk", *[weight / weight.sum()] * 3).ravel()
    var = noise(t, phi) / w
    mean, sd = (np.asarray(p) for p in t.prior)
    constant = 5.0 * (np.asarray(t.detected) * (w - 1 - np.log(w))).sum() + 0.5 * (((phi - mean) / sd) ** 2).sum()
    for seed in range(3):
        residual = 1.5 * np.random.default_rng(seed).normal(size=(2, 2))
        density = 0.0
        for node, share in np.ndenumerate(np.exp(np.asarray(t.log_weight))):
            own = shared(t._replace(columns=jnp.zeros((1, 2, 2))), phi, node, theta)[:2, :2]
            level = (grid[:, :2] @ np.linalg.cholesky(own).T)[:, None, :] + grid[:, 2, None, None] * np.asarray(
                t.scale[node[1], 0] * t.columns
            )
            e = residual - level
            inside = np.prod(np.where(t.detected, np.exp(-0.5 * e**2 / var) / np.sqrt(var), 1.0), axis=(1, 2))
            below = scipy.stats.norm.cdf(e[:, 1, 1] / np.sqrt(noise(t, phi)[1, 1]))
            density += share * float(mass @ (inside * below))
        assert float(F(t, residual, phi, w, theta)) == pytest.approx(constant - np.log(density), abs=1e-6)


def test_weights_integrated_out_leave_students_t():
    t = tiny()
    size = (1, 1)
    changed = {
        "value": np.zeros(size), "variance": np.full(size, 0.6), "detected": np.ones(size),
        "censored": np.zeros((0, 2), int),
        "group": np.ones(size), "columns": np.zeros((1, 1, 1)), "scale": np.ones((1, 1)), "systematic": np.zeros(size),
        "distance_octaves": np.zeros(size), "has_unknown_path": np.zeros(1), "log_tau": np.full(size, SMALL),
        "log_weight": np.zeros(size), "excess_profile": np.ones(1), "smooth_profile": np.ones(1),
        "pitch": np.zeros(size), "ratio": np.zeros(size), "velocity": np.ones(size),
    }  # fmt: skip
    t = t._replace(**{name: jnp.asarray(x) for name, x in changed.items()})
    log_w = np.linspace(-12.0, 4.0, 4001)
    both = jax.jit(jax.vmap(lambda r, x: table_objective(t, r, PHI, jnp.exp(x), np.zeros(1)), in_axes=(None, 0)))
    scale, degrees = np.sqrt(noise(t, PHI)[0, 0]), float(t.degrees_of_freedom)

    def density(r: float) -> float:
        return float(np.exp(-np.asarray(both(np.full(size, r), log_w[:, None, None]))).sum())

    for r in (0.5, 2.0, 10.0, 40.0):
        expected = scipy.stats.t.pdf(r / scale, degrees) / scipy.stats.t.pdf(0.0, degrees)
        assert density(r) / density(0.0) == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize("shape", ["nothing absent", "two microphones"])
def test_what_was_integrated_out_is_estimated_as_a_dense_gaussian_would(shape):
    t, (residual, w, theta) = table(shape), point(shape)
    t = t._replace(censored=np.zeros((0, 2), int))
    found = latent_posterior(t, residual, PHI, w, theta)
    detected = np.asarray(t.detected).ravel() > 0
    per_node = dense_nodes(t, residual, PHI, w, theta)
    weight = np.exp(per_node.min() - per_node)
    mean, variance = 0.0, 0.0
    for node, share in np.ndenumerate(weight / weight.sum()):
        cov = shared(t, PHI, node, theta)
        total = cov + np.diag((noise(t, PHI) / w).ravel())
        pull = np.linalg.solve(total[np.ix_(detected, detected)], cov[detected]).T
        mean = mean + share * pull @ residual.ravel()[detected]
        variance = variance + share * (np.diag(cov) - np.einsum("ij,ji->i", pull, cov[detected]))
    common = np.einsum("rg,gk->rk", t.group, found.path)
    np.testing.assert_allclose((common + found.columns + found.discrepancy).ravel(), mean, rtol=1e-7, atol=1e-7)
    np.testing.assert_allclose(common + found.columns + found.discrepancy + found.residual, residual, atol=1e-9)
    np.testing.assert_allclose(np.ravel(found.variance), variance, rtol=1e-6, atol=1e-7)
