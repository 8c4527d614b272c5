"""The one objective: minus the log marginal posterior of tables of partials.

    y[r,k] = law_k(θ, v_r) + Σ_q c_q B_q[r,k] + a_g(r),k + e[r,k]
    c ~ N(0, I)      a_g ~ N(0, A² M(ℓ) + τ_g² I + S)      e[r,k] ~ t_ν(0, s²[r,k] + σ² u_k + η² R²[r,k])

A table holds levels, frequencies or decays of all recordings. What recordings share (a path, a string's own deviation
from the law, a systematic error of the analysis) are a's, what a recording has alone (gain, onset, pitch) are columns
B; both are integrated out in closed form. Student's t is a scale mixture whose log-weights w are unknowns like the
others, so that weighting anew is descent on the same function:

    F = ½ rᵀC⁻¹r + ½ log|C| + ν/2 Σ (w - 1 - log w) - log p(φ) - Σ_absent log Φ((bound - mean)/sd)

with C = Z Zᵀ + diag(var/w), factored by Woodbury's identity in the size of paths and columns. Partials that are absent
are censored: the predictive distribution of each, given all that are there, lies below the bound of its band. τ, of
which one velocity tells nothing by itself, and whether recordings share a gain are summed over the nodes of their
prior, however many recordings there are.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import cholesky, solve_triangular
from jax.scipy.special import logsumexp
from jax.scipy.stats import norm
from jaxtyping import Array, Float

from ..model.precision import AnyArray

__all__ = ["Latent", "Report", "Table", "curvature", "latent", "next_weights", "objective", "report"]

# A NumPy array outside of a computation, JAX's inside.
Values = Any
# Keeps a common part without any variance positive definite, in the table's unit squared.
JITTER = 1e-10
# 20/log 10 over √2: what an amplitude η R that adds at any phase does to a level, dB.
ADDED = 20 / np.log(10) / np.sqrt(2)


class Table(NamedTuple):
    """One kind of observation: R recordings, K partials, G groups that share what is common, Q columns, T nodes."""

    value: Values  # y [R, K]
    variance: Values  # s², of measurement [R, K]
    found: Values  # 1 where observed [R, K]
    absent: Values  # int, recording and partial of what is absent, where `value` is a bound [N, 2]
    group: Values  # one-hot [R, G]
    columns: Values  # B [Q, R, K]
    scale: Values  # prior standard deviations of their coefficients [T, Q]
    systematic: Values  # S [K, K]
    apart: Values  # distance of partials, octaves [K, K]; infinite from padding
    smooth: Values  # 1 where the group's path is unknown [G]
    common: Values  # log τ [T, G]
    share: Values  # log prior weight of the nodes, of `scale` and `common` together [T]
    growth: Values  # u, of σ² [K]
    ratio: Values  # R: amplitude of the loudest partial over that of each [R, K]
    prior: tuple[Values, Values]  # of φ: means and standard deviations of logarithms
    student: Values  # ν


class Pieces(NamedTuple):
    """Woodbury's factors: [T] is their leading axis."""

    precision: Array  # 1/var [R, K]
    root: Array  # L of the common part [T, G, K, K]
    cholesky: Array  # of I + Bᵀ D⁻¹ B [T, GK + Q, GK + Q]


class Latent(NamedTuple):
    """Posterior means of what is integrated out, and of e."""

    common: Values  # a [G, K]
    columns: Values  # Σ c_q B_q [R, K]
    own: Values  # e [R, K]
    variance: Values  # of a + Σ c B at each entry [R, K]


def _each_matrix(function, *stacks: AnyArray) -> Array:
    """`function` of matrices in stacks [..., n, n], one by one.

    XLA's batched LAPACK waits inside its own pool of threads and, called from several, for ever.
    """
    lead = stacks[0].shape[:-2]
    flat = [x.reshape(-1, *x.shape[-2:]) for x in stacks]
    out = jax.lax.map(lambda x: function(*x), tuple(flat))
    return out.reshape(*lead, *out.shape[1:])


def _cholesky(x: AnyArray) -> Array:
    return _each_matrix(lambda a: cholesky(a, lower=True), x)


def _variance(table: Table, phi: AnyArray, w: AnyArray) -> Array:
    """var/w [R, K]; φ = (log σ, log A, log ℓ, log η)."""
    added = jnp.exp(phi[3]) * ADDED * table.ratio
    return (table.variance + jnp.exp(2 * phi[0]) * table.growth + added**2) / w


def _root(table: Table, phi: AnyArray) -> Array:
    """Cholesky factors of the common part's prior covariance [T, G, K, K]."""
    near = jnp.isfinite(table.apart)
    d = jnp.sqrt(3.0) * jnp.where(near, table.apart, 0.0) * jnp.exp(-phi[2])
    matern = jnp.where(near, jnp.exp(2 * phi[1]) * (1 + d) * jnp.exp(-d), 0.0)
    own = jnp.exp(2 * table.common)[..., None, None]  # [T, G, 1, 1]
    eye = jnp.eye(len(table.apart))
    cov = table.smooth[:, None, None] * matern + table.systematic + (own + JITTER) * eye
    return _cholesky(cov)


def _gathered(table: Table, root: Array, x: AnyArray) -> Array:
    """Bᵀ x [T, GK + Q, ...] of x [R, K, ...], already weighted."""
    common = jnp.einsum("rg,rk...->gk...", table.group, x)
    common = jnp.einsum("tgkl,gk...->tgl...", root, common)
    columns = jnp.einsum("tq,qrk,rk...->tq...", table.scale, table.columns, x)
    return jnp.concatenate([common.reshape(root.shape[0], -1, *x.shape[2:]), columns], axis=1)


def factored(table: Table, phi: AnyArray, w: AnyArray) -> Pieces:
    """The covariance at φ and w, factored."""
    precision = table.found / _variance(table, phi, w)
    root = _root(table, phi)
    nodes, groups, size, _ = root.shape
    diagonal = jnp.einsum("rg,rk->gk", table.group, precision)
    inner = jnp.einsum("tgkl,gk,tgkm->tglm", root, diagonal, root)
    cross = jnp.einsum("rg,qrk,rk,tgkl->tglq", table.group, table.columns, precision, root)
    cross = cross * table.scale[:, None, None, :]
    rest = jnp.einsum("qrk,rk,prk->qp", table.columns, precision, table.columns)
    rest = rest * table.scale[:, :, None] * table.scale[:, None, :]
    blocks = jnp.einsum("tglm,gh->tglhm", inner, jnp.eye(groups)).reshape(nodes, groups * size, groups * size)
    cross = cross.reshape(nodes, groups * size, -1)
    whole = jnp.concatenate(
        [jnp.concatenate([blocks, cross], axis=2), jnp.concatenate([cross.swapaxes(1, 2), rest], axis=2)], axis=1
    )
    return Pieces(precision, root, _cholesky(whole + jnp.eye(whole.shape[-1])))


def _solve(lower: Array, x: AnyArray) -> Array:
    """L⁻¹ x for stacks [T, n, n] and [T, n] or [T, n, m]."""
    if x.ndim == lower.ndim - 1:
        return _solve(lower, x[..., None])[..., 0]
    return _each_matrix(lambda a, b: solve_triangular(a, b, lower=True), lower, x)


def _whitened(table: Table, pieces: Pieces, at: AnyArray) -> Array:
    """L⁻¹ b of entries `at` [N, 2]: b are an entry's loadings on paths and columns; [T, GK + Q, N]."""
    nodes, groups, size, _ = pieces.root.shape
    if not len(at):
        return jnp.zeros((nodes, pieces.cholesky.shape[-1], 0))
    r, k = at[:, 0], at[:, 1]
    loadings = jnp.einsum("ng,tgnl->tgln", table.group[r], pieces.root[:, :, k, :]).reshape(nodes, groups * size, -1)
    columns = table.scale[:, :, None] * table.columns[:, r, k]
    return _solve(pieces.cholesky, jnp.concatenate([loadings, columns], axis=1))


class _Censored(NamedTuple):
    """What is absent, by its predictive distribution given all that is there; [T, N]."""

    z: AnyArray  # bound less mean, in standard deviations
    spread: Array
    rows: Array  # [T, GK + Q, N]


def _censored(table: Table, residual: AnyArray, phi: AnyArray, pieces: Pieces, q: AnyArray) -> _Censored:
    r, k = table.absent[:, 0], table.absent[:, 1]
    rows = _whitened(table, pieces, table.absent)
    own = _variance(table, phi, jnp.ones_like(residual))[r, k]
    spread = jnp.sqrt((rows**2).sum(axis=1) + own)
    return _Censored((residual[r, k] - jnp.einsum("tmn,tm->tn", rows, q)) / spread, spread, rows)


def _each(table: Table, residual: AnyArray, phi: AnyArray, w: AnyArray) -> tuple[Array, Pieces, Array, _Censored]:
    """F without the priors of φ and w for every node of τ [T], and what it is made of."""
    pieces = factored(table, phi, w)
    q = _solve(pieces.cholesky, _gathered(table, pieces.root, pieces.precision * residual))
    quadratic = (pieces.precision * residual**2).sum() - (q**2).sum(axis=1)
    half_log = jnp.log(jnp.diagonal(pieces.cholesky, axis1=1, axis2=2)).sum(axis=1)
    half_log = half_log + 0.5 * (table.found * jnp.log(_variance(table, phi, w))).sum()
    censored = _censored(table, residual, phi, pieces, q)
    return 0.5 * quadratic + half_log - norm.logcdf(censored.z).sum(axis=1), pieces, q, censored


def responsibilities(table: Table, residual: AnyArray, phi: AnyArray, w: AnyArray) -> Array:
    """How much of the posterior each node of τ and of the gains has [T]."""
    return jax.nn.softmax(table.share - _each(table, residual, phi, w)[0])


def objective(
    table: Table, residual: Float[AnyArray, "R K"], phi: Float[AnyArray, " hyper"], w: Float[AnyArray, "R K"]
) -> Float[Array, ""]:
    """F at a residual: y - law where a partial is found, bound - law where it is absent."""
    each, *_ = _each(table, residual, phi, w)
    mean, sd = table.prior
    mixture = 0.5 * table.student * (table.found * (w - 1 - jnp.log(w))).sum()
    return -logsumexp(table.share - each) + mixture + 0.5 * (((phi - mean) / sd) ** 2).sum()


def curvature(
    table: Table, residual: Float[AnyArray, "R K"], jacobian: Float[AnyArray, "R K n"], phi: AnyArray,
    w: Float[AnyArray, "R K"],
) -> tuple[Float[Array, " n"], Float[Array, "n n"]]:  # fmt: skip
    """Gradient of F and Gauss and Newton's curvature by what moves the law by `jacobian`, averaged over nodes of τ."""
    each, pieces, q, censored = _each(table, residual, phi, w)
    responsible = jax.nn.softmax(table.share - each)
    weighted = pieces.precision[..., None] * jacobian
    projected = _solve(pieces.cholesky, _gathered(table, pieces.root, weighted))
    gradient = -jnp.einsum("rkn,rk->n", weighted, residual) + jnp.einsum("tmn,tm->tn", projected, q)
    hessian = jnp.einsum("rkn,rkm->nm", weighted, jacobian) - jnp.einsum("tmn,tmp->tnp", projected, projected)
    # What is absent: its bound stays while the law moves, and what is there takes its predicted mean along.
    hazard = jnp.exp(norm.logpdf(censored.z) - norm.logcdf(censored.z))
    moved = jnp.einsum("tmn,tmp->tnp", censored.rows, projected) - jacobian[table.absent[:, 0], table.absent[:, 1]]
    moved = moved / censored.spread[..., None]
    gradient = gradient - jnp.einsum("tn,tnp->tp", hazard, moved)
    steep = jnp.maximum(hazard * (hazard + censored.z), 0.0)
    hessian = hessian + jnp.einsum("tn,tnp,tnm->tpm", steep, moved, moved)
    return responsible @ gradient, jnp.einsum("t,tmn->mn", responsible, hessian)


class Report(NamedTuple):
    """F and what a descent on it needs."""

    F: Values
    gradient: Values  # by θ [n]
    curvature: Values  # Gauss and Newton's, by θ [n, n]
    by_phi: Values  # gradient [4]
    by_log_w: Values  # gradient [R, K]

    def take(self, which: np.ndarray) -> Report:
        """Of some of many points."""
        return Report(*(x[which] for x in self))


def report(table: Table, residual: AnyArray, jacobian: Array, phi: AnyArray, w: AnyArray) -> Report:
    """F at one point, its gradient by everything, and its curvature by what moves the law by `jacobian` [R, K, n]."""
    value, (by_phi, by_log_w) = jax.value_and_grad(
        lambda p, x: objective(table, residual, p, jnp.exp(x)), argnums=(0, 1)
    )(phi, jnp.log(w))
    return Report(value, *curvature(table, residual, jacobian, phi, w), by_phi, by_log_w)


def next_weights(table: Table, by_log_w: np.ndarray, w: np.ndarray) -> np.ndarray:
    """The w that EM takes next, (ν + 1)/(ν + E[e²]/var) [..., R, K].

    With F's gradient by log w, ν/2 (w - 1) + G, the expectation at the present latents is E[e²]/var = (1 + 2 G)/w.
    """
    student = float(table.student)
    square = np.maximum((1 + 2 * (by_log_w - 0.5 * student * (w - 1))) / w, 0.0)
    return np.where(np.asarray(table.found) > 0, (student + 1) / (student + square), 1.0)


def latent(table: Table, residual: AnyArray, phi: AnyArray, w: AnyArray) -> Latent:
    """Posterior means at φ and w, averaged over nodes of τ."""
    each, pieces, q, _ = _each(table, residual, phi, w)
    responsible = jax.nn.softmax(table.share - each)
    nodes, groups, size, _ = pieces.root.shape
    u = _each_matrix(lambda a, b: solve_triangular(a, b, lower=True, trans=1), pieces.cholesky, q[..., None])[..., 0]
    common = jnp.einsum("tgkl,tgl->tgk", pieces.root, u[:, : groups * size].reshape(nodes, groups, size))
    columns = jnp.einsum("tq,qrk->trk", table.scale * u[:, groups * size :], table.columns)
    own = residual - jnp.einsum("rg,tgk->trk", table.group, common) - columns
    every = jnp.stack(jnp.meshgrid(*map(jnp.arange, residual.shape), indexing="ij"), axis=-1).reshape(-1, 2)
    spread = (_whitened(table, pieces, every) ** 2).sum(axis=1).reshape(nodes, *residual.shape)
    return Latent(*(jnp.einsum("t,t...->...", responsible, x) for x in (common, columns, own, spread)))
