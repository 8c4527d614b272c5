"""The one objective: minus the log marginal posterior of tables of partials.

    y[r,k] = law_k(θ, v_r) + Σ_q c_q B_q[r,k] + a_g(r),k + e[r,k]
    c ~ N(0, S²)      a_g ~ N(0, A² M(ℓ) + τ_g² I + S)      e[r,k] ~ t_ν(0, s²[r,k] + σ² u_k + η² R²[r,k])

A table holds levels, frequencies or decays of all recordings. What recordings share (a path, a string's own deviation
from the law, a systematic error of the analysis) are a's, what a recording has alone (gain, onset, pitch) are columns
B; both are integrated out in closed form. Student's t is a scale mixture whose log-weights w are unknowns like the
others, so that weighting anew is descent on the same function:

    F = ½ rᵀC⁻¹r + ½ log|C| + ν/2 Σ (w - 1 - log w) - log p(φ) - Σ_absent log Φ((bound - mean)/sd)

Partials that are absent are censored: the predictive distribution of each, given all that are there, lies below the
bound of its band. τ, of which one velocity tells nothing by itself, and whether recordings share a gain are summed over
the nodes of their priors, however many recordings there are.

C is never written down. Of a path recordings tell only their weighted mean, x̄ = Σ_r d x / D with d = w/var and
D = Σ_r d over a path's recordings; what lies about the mean does not know of it. So, before the columns,

    C₀⁻¹x = d (x - x̄) + d/D N x̄,      N = (A + 1/D)⁻¹,      A the path's prior covariance

and with them C⁻¹ = C₀⁻¹ - UᵀU, U = L⁻¹ S B C₀⁻¹, L Lᵀ = I + S B C₀⁻¹Bᵀ S (Woodbury). Only N knows τ, only S the gains.
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

__all__ = [
    "Latent",
    "Report",
    "Solved",
    "Table",
    "factored",
    "hazard",
    "inverse",
    "latent",
    "next_weights",
    "objective",
    "pulled",
    "report",
    "responsible",
    "solved",
    "variance",
]

# A NumPy array outside of a computation, JAX's inside.
Values = Any
# Keeps a common part without any variance positive definite, in the table's unit squared.
JITTER = 1e-10
# 20/log 10 over √2: what an amplitude η R that adds at any phase does to a level, dB.
ADDED = 20 / np.log(10) / np.sqrt(2)


class Table(NamedTuple):
    """One kind of observation: R recordings, K partials, G groups that share what is common, Q columns.

    T are the nodes of τ, M those of the gains.
    """

    value: Values  # y [R, K]
    variance: Values  # s², of measurement [R, K]
    found: Values  # 1 where observed [R, K]
    absent: Values  # int, recording and partial of what is absent, where `value` is a bound [N, 2]
    group: Values  # one-hot [R, G]
    columns: Values  # B [Q, R, K]
    scale: Values  # S, prior standard deviations of their coefficients [M, Q]
    systematic: Values  # S [K, K]
    apart: Values  # distance of partials, octaves [K, K]; infinite from padding
    smooth: Values  # 1 where the group's path is unknown [G]
    common: Values  # log τ [T, G]
    share: Values  # log prior weight of the nodes, of `common` and `scale` together [T, M]
    growth: Values  # u, of σ² [K]
    ratio: Values  # R: amplitude of the loudest partial over that of each [R, K]
    prior: tuple[Values, Values]  # of φ: means and standard deviations of logarithms
    student: Values  # ν


class Pieces(NamedTuple):
    """C at φ and w, in pieces."""

    precision: Array  # d [R, K]; 0 where nothing was found
    share: Array  # d/D [R, K]
    prior: Array  # A [T, G, K, K]
    path: Array  # N [T, G, K, K]
    columns: Array  # B C₀⁻¹ [T, Q, R, K]
    cholesky: Array  # L [T, M, Q, Q]
    own: Array  # U [T, M, Q, R, K]
    half_log: Array  # ½ log|C| [T, M]


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


def _solve(lower: Array, x: AnyArray) -> Array:
    """L⁻¹ x for stacks [..., n, n] and [..., n, m]."""
    x = jnp.asarray(x)
    return _each_matrix(lambda a, b: solve_triangular(a, b, lower=True), lower, x) if x.size else x


def _added(table: Table, phi: AnyArray) -> Array:
    """What other sounds do to a level, dB [R, K]."""
    return jnp.exp(phi[3]) * ADDED * table.ratio


def variance(table: Table, phi: AnyArray, w: AnyArray) -> Array:
    """var/w [R, K]; φ = (log σ, log A, log ℓ, log η)."""
    return (table.variance + jnp.exp(2 * phi[0]) * table.growth + _added(table, phi) ** 2) / w


def _matern(table: Table, phi: AnyArray) -> tuple[Array, Array]:
    """A² M(ℓ) between partials, and its derivative by log ℓ [K, K]."""
    near = jnp.isfinite(table.apart)
    d = jnp.sqrt(3.0) * jnp.where(near, table.apart, 0.0) * jnp.exp(-phi[2])
    decay = jnp.where(near, jnp.exp(2 * phi[1] - d), 0.0)
    return (1 + d) * decay, d**2 * decay


def factored(table: Table, phi: AnyArray, w: AnyArray) -> Pieces:
    """The covariance at φ and w, factored."""
    alone = variance(table, phi, w)
    precision = table.found / alone
    total = jnp.einsum("rg,rk->gk", table.group, precision)
    there = total > 0
    own = jnp.exp(2 * table.common)[..., None, None]
    eye = jnp.eye(len(table.apart))
    prior = table.smooth[:, None, None] * _matern(table, phi)[0] + table.systematic + (own + JITTER) * eye
    root = jnp.where(there, jnp.sqrt(jnp.where(there, total, 1.0)), 0.0)
    lower = _cholesky(eye + root[:, :, None] * prior * root[:, None, :])
    inverse = _solve(lower, jnp.broadcast_to(root[:, None, :] * eye, prior.shape))
    path = jnp.einsum("tgml,tgmk->tglk", inverse, inverse)
    share = precision / jnp.einsum("rg,gk->rk", table.group, jnp.where(there, total, 1.0))
    half_log = jnp.log(jnp.diagonal(lower, axis1=2, axis2=3)).sum(axis=(1, 2))
    half_log = half_log + 0.5 * (table.found * jnp.log(alone)).sum()

    columns = _before_columns(table, precision, share, path, table.columns)
    size = table.scale.shape[1]
    inner = jnp.einsum("mq,qrk,tprk,mp->tmqp", table.scale, table.columns, columns, table.scale)
    lower = _cholesky(inner + jnp.eye(size))
    scaled = table.scale[:, :, None] * columns.reshape(len(prior), 1, size, -1)
    u = _solve(lower, scaled).reshape(*lower.shape[:3], *precision.shape)
    half_log = half_log[:, None] + jnp.log(jnp.diagonal(lower, axis1=2, axis2=3)).sum(axis=2)
    return Pieces(precision, share, prior, path, columns, lower, u, half_log)


def _mean(table: Table, share: Array, x: AnyArray) -> Array:
    """x̄ of every path [..., G, K] of x [..., R, K]."""
    return jnp.einsum("rg,rk,...rk->...gk", table.group, share, x)


def _before_columns(table: Table, precision: Array, share: Array, path: Array, x: AnyArray) -> Array:
    """C₀⁻¹x [T, n, R, K] of x [n, R, K]."""
    mean = _mean(table, share, x)
    about = precision * (x - jnp.einsum("rg,ngk->nrk", table.group, mean))
    return about + share * jnp.einsum("rg,tgkl,ngl->tnrk", table.group, path, mean)


def inverse(table: Table, pieces: Pieces) -> Array:
    """C⁻¹ of all entries, 0 where nothing was found [T, M, RK, RK]."""
    shape = pieces.precision.shape
    count = shape[0] * shape[1]
    every = jnp.eye(count).reshape(count, *shape)
    before = _before_columns(table, pieces.precision, pieces.share, pieces.path, every).reshape(-1, 1, count, count)
    u = pieces.own.reshape(*pieces.own.shape[:3], count)
    return before - jnp.einsum("tmqi,tmqj->tmij", u, u)


class Predicted(NamedTuple):
    """Entries' paths and columns given all that is there [T, M, N]."""

    mean: Array
    variance: Array
    by: Array  # ρ: the coefficients' part of each, in units of L [T, M, Q, N]


def _predicted(table: Table, pieces: Pieces, mean: Array, q: Array, at: AnyArray) -> Predicted:
    """Of entries `at` [N, 2]; `mean` is the residual's x̄ [G, K], q = U r [T, M, Q]."""
    r, k = at[:, 0], at[:, 1]
    group = table.group[r]
    # A N: what a path is, by the mean of its recordings.
    pull = jnp.einsum("ng,tgnl,tglm->tngm", group, pieces.prior[:, :, k, :], pieces.path)
    known = jnp.einsum("tngl,tgnl->tn", pull, pieces.prior[:, :, k, :])
    spread = jnp.einsum("ng,tgnn->tn", group, pieces.prior[:, :, k][:, :, :, k]) - known
    left = table.columns[:, r, k] - jnp.einsum("tngl,qgl->tqn", pull, _mean(table, pieces.share, table.columns))
    by = _solve(pieces.cholesky, table.scale[:, :, None] * left[:, None])
    return Predicted(
        jnp.einsum("tngl,gl->tn", pull, mean)[:, None] + jnp.einsum("tmqn,tmq->tmn", by, q),
        spread[:, None] + (by**2).sum(axis=2), by,
    )  # fmt: skip


class Solved(NamedTuple):
    """F at every node without the priors of φ and w, and what it is made of."""

    each: Array  # F [T, M]
    pieces: Pieces
    push: Array  # C⁻¹r [T, M, R, K]
    q: Array  # U r [T, M, Q]
    z: AnyArray  # of what is absent: bound less mean, in standard deviations [T, M, N]
    spread: Array  # these deviations, dB [T, M, N]
    by: Array  # see `Predicted`


def solved(table: Table, residual: AnyArray, phi: AnyArray, w: AnyArray) -> Solved:
    """F at every node, and the pieces."""
    p = factored(table, phi, w)
    before = _before_columns(table, p.precision, p.share, p.path, residual[None])[:, 0]
    q = jnp.einsum("tmqrk,rk->tmq", p.own, residual)
    push = before[:, None] - jnp.einsum("tmqrk,tmq->tmrk", p.own, q)
    about = residual - jnp.einsum("rg,gk->rk", table.group, mean := _mean(table, p.share, residual))
    square = (p.precision * about**2).sum() + jnp.einsum("gk,tgkl,gl->t", mean, p.path, mean)
    at = table.absent
    absent = _predicted(table, p, mean, q, at)
    spread = jnp.sqrt(absent.variance + variance(table, phi, jnp.ones_like(residual))[at[:, 0], at[:, 1]])
    z = (residual[at[:, 0], at[:, 1]] - absent.mean) / spread
    each = 0.5 * (square[:, None] - (q**2).sum(axis=2)) + p.half_log - norm.logcdf(z).sum(axis=2)
    return Solved(each, p, push, q, z, spread, absent.by)


def responsible(table: Table, each: Array) -> Array:
    """How much of the posterior each node has [T, M]."""
    return jax.nn.softmax(table.share - each, axis=(0, 1))


def objective(
    table: Table, residual: Float[AnyArray, "R K"], phi: Float[AnyArray, " hyper"], w: Float[AnyArray, "R K"]
) -> Float[Array, ""]:
    """F at a residual: y - law where a partial is found, bound - law where it is absent."""
    return _whole(table, solved(table, residual, phi, w).each, phi, w)


def _whole(table: Table, each: Array, phi: AnyArray, w: AnyArray) -> Array:
    mean, sd = table.prior
    mixture = 0.5 * table.student * (table.found * (w - 1 - jnp.log(w))).sum()
    return -logsumexp(table.share - each) + mixture + 0.5 * (((phi - mean) / sd) ** 2).sum()


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


def pulled(table: Table, s: Solved) -> Array:
    """What moves the means of absent entries: their derivatives by the residual [T, M, N, R, K]."""
    r, k = table.absent[:, 0], table.absent[:, 1]
    p = s.pieces
    path = jnp.einsum("ng,tgnl,tglm,rg,rm->tnrm", table.group[r], p.prior[:, :, k], p.path, table.group, p.share)
    return path[:, None] + jnp.einsum("tmqn,tmqrk->tmnrk", s.by, p.own)


def hazard(z: AnyArray) -> Array:
    """Minus the derivative of -log Φ(z)."""
    return jnp.exp(norm.logpdf(z) - norm.logcdf(z))


def report(
    table: Table, residual: Float[AnyArray, "R K"], jacobian: Float[AnyArray, "R K n"], phi: Float[AnyArray, " hyper"],
    w: Float[AnyArray, "R K"],
) -> Report:  # fmt: skip
    """F at one point, its gradient by everything, and its curvature by what moves the law by `jacobian`.

    The curvature is Gauss and Newton's, averaged over nodes.
    """
    s = solved(table, residual, phi, w)
    weight, p = responsible(table, s.each), s.pieces
    pull, steep, z = pulled(table, s), hazard(s.z), s.z

    # By what moves the law. An absent partial's bound stays, and what is there takes its predicted mean along.
    J = jnp.moveaxis(jacobian, -1, 0)
    before = _before_columns(table, p.precision, p.share, p.path, J)
    through = jnp.einsum("tmqrk,nrk->tmqn", p.own, J)
    moved = jnp.einsum("tmark,nrk->tman", pull, J) - jacobian[table.absent[:, 0], table.absent[:, 1]]
    moved = moved / s.spread[..., None]
    gradient = -jnp.einsum("tmrk,nrk->tmn", s.push, J) - jnp.einsum("tma,tman->tmn", steep, moved)
    curvature = jnp.einsum("nrk,tlrk->tnl", J, before)[:, None] - jnp.einsum("tmqn,tmql->tmnl", through, through)
    curvature = curvature + jnp.einsum("tma,tman,tmal->tmnl", jnp.maximum(steep * (steep + z), 0.0), moved, moved)

    # By what changes C: F's derivative by each entry's own variance, and by each path's covariance.
    alone = p.precision * (1 - p.share)
    diagonal = jnp.einsum("rg,tgkk->trk", table.group, p.path) * p.share**2 + alone
    diagonal = diagonal[:, None] - (p.own**2).sum(axis=2)
    far, near = steep / s.spread, 0.5 * steep * z / s.spread**2  # by an absent one's mean, and by its variance
    by_variance = 0.5 * (diagonal - s.push**2)
    by_variance = by_variance - jnp.einsum("tma,tmark,tmrk->tmrk", far, pull, s.push)
    by_variance = jnp.einsum("tm,tmrk->rk", weight, by_variance + jnp.einsum("tma,tmark->tmrk", near, pull**2))
    absent = (
        jnp.zeros_like(residual).at[table.absent[:, 0], table.absent[:, 1]].add(jnp.einsum("tm,tma->a", weight, near))
    )
    push = jnp.einsum("rg,tmrk->tmgk", table.group, s.push)
    u = jnp.einsum("rg,tmqrk->tmqgk", table.group, p.own)
    # What of a path an absent partial has that the others' mean has not.
    one_hot = table.group[table.absent[:, 0]][:, :, None] * jnp.eye(residual.shape[1])[table.absent[:, 1]][:, None]
    apart = one_hot - jnp.einsum("rg,tmark->tmagk", table.group, pull)
    by_path = 0.5 * (
        jnp.einsum("tm,tgkl->gkl", weight, p.path)
        - jnp.einsum("tm,tmqgk,tmqgl->gkl", weight, u, u)
        - jnp.einsum("tm,tmgk,tmgl->gkl", weight, push, push)
    )
    by_path = by_path + jnp.einsum("tm,tma,tmagk,tmgl->gkl", weight, far, apart, push)
    by_path = by_path + jnp.einsum("tm,tma,tmagk,tmagl->gkl", weight, near, apart, apart)

    smooth = jnp.einsum("g,gkl->kl", table.smooth, by_path)
    matern, by_length = _matern(table, phi)
    excess, added = 2 * jnp.exp(2 * phi[0]) * table.growth, 2 * _added(table, phi) ** 2
    changed = by_variance / w + absent
    mean, sd = table.prior
    by_phi = jnp.stack(
        [(changed * excess).sum(), 2 * (smooth * matern).sum(), (smooth * by_length).sum(), (changed * added).sum()]
    )
    return Report(
        _whole(table, s.each, phi, w),
        jnp.einsum("tm,tmn->n", weight, gradient),
        jnp.einsum("tm,tmnl->nl", weight, curvature),
        by_phi + (phi - mean) / sd**2,
        table.found * (0.5 * table.student * (w - 1) - variance(table, phi, w) * by_variance),
    )


def next_weights(table: Table, by_log_w: np.ndarray, w: np.ndarray) -> np.ndarray:
    """The w that EM takes next, (ν + 1)/(ν + E[e²]/var) [..., R, K].

    With F's gradient by log w, ν/2 (w - 1) + G, the expectation at the present latents is E[e²]/var = (1 + 2 G)/w.
    """
    student = float(table.student)
    square = np.maximum((1 + 2 * (by_log_w - 0.5 * student * (w - 1))) / w, 0.0)
    return np.where(np.asarray(table.found) > 0, (student + 1) / (student + square), 1.0)


def latent(table: Table, residual: AnyArray, phi: AnyArray, w: AnyArray) -> Latent:
    """Posterior means at φ and w, averaged over nodes."""
    s = solved(table, residual, phi, w)
    weight, p = responsible(table, s.each), s.pieces
    coefficients = table.scale * _each_matrix(
        lambda a, b: solve_triangular(a, b, lower=True, trans=1), p.cholesky, s.q[..., None]
    )[..., 0]  # fmt: skip
    columns = jnp.einsum("tmq,qrk->tmrk", coefficients, table.columns)
    mean = _mean(table, p.share, residual - columns)
    common = jnp.einsum("tgkl,tglj,tmgj->tmgk", p.prior, p.path, mean)
    own = residual - jnp.einsum("rg,tmgk->tmrk", table.group, common) - columns
    every = jnp.stack(jnp.meshgrid(*map(jnp.arange, residual.shape), indexing="ij"), axis=-1).reshape(-1, 2)
    spread = _predicted(table, p, _mean(table, p.share, residual), s.q, every).variance
    spread = spread.reshape(*weight.shape, *residual.shape)
    return Latent(*(jnp.einsum("tm,tm...->...", weight, x) for x in (common, columns, own, spread)))
