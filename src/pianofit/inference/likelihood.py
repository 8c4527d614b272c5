"""The one objective: minus the log marginal posterior of tables of partials.

    y[r,k] = law_k(θ, v_r) + Σ_q c_q B_q[r,k] + a_g(r),k + e[r,k]
    c ~ N(0, S²)      a_g ~ N(0, A² M(ℓ) + τ_g² I + S)      e[r,k] ~ t_ν(0, s²[r,k] + σ² u_k + (6.14 η R[r,k])²)

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

All this is written once for NumPy, in which the search runs, and for JAX, whose derivatives the sampler takes. The
search has its derivatives in closed form (reports.py).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import cholesky, solve_triangular
from jax.scipy.special import log_ndtr as jax_log_ndtr
from jaxtyping import Float
from scipy.linalg import get_lapack_funcs
from scipy.special import log_ndtr

from ..model.x64 import AnyArray

__all__ = [
    "ADDED",
    "CovarianceFactors",
    "Predicted",
    "NodeSolutions",
    "ObservationTable",
    "interference_db",
    "before_columns",
    "factor_covariance",
    "em_weights",
    "objective",
    "path_mean",
    "pointwise",
    "predicted",
    "node_weights",
    "solve_nodes",
    "variance",
    "combine_nodes",
]

# Arrays of NumPy or of JAX, and the one or the other as a module.
Values = Any
Space = Any
# Keeps a common part without any variance positive definite, in the table's unit squared.
JITTER = 1e-10
# 20/log 10 over √2: what an amplitude η R that adds at any phase does to a level, dB.
ADDED = 20 / np.log(10) / np.sqrt(2)
# LAPACK's inverse of a triangle.
_trtri: Any = get_lapack_funcs("trtri", dtype=np.float64)


class ObservationTable(NamedTuple):
    """One kind of observation: R recordings, K partials, G groups that share what is common, Q columns.

    T are the nodes of τ, M those of the gains.
    """

    value: Values  # y [R, K]
    variance: Values  # s², of measurement [R, K]
    detected: Values  # 1 where observed [R, K]
    censored: Values  # int, recording and partial of what is absent, where `value` is a bound [N, 2]
    group: Values  # one-hot [R, G]
    columns: Values  # B [Q, R, K]
    scale: Values  # S, prior standard deviations of their coefficients [M, Q]
    systematic: Values  # S [K, K]
    distance_octaves: Values  # distance of partials, octaves [K, K]
    has_unknown_path: Values  # 1 where the group's path is unknown [G]
    log_tau: Values  # log τ [T, G]
    log_weight: Values  # log prior weight of the nodes, of `common` and `scale` together [T, M]
    variance_profile: Values  # u, of σ² [K]
    ratio: Values  # R: amplitude of the loudest partial over that of each [R, K]
    prior: tuple[Values, Values]  # of φ: means and standard deviations of logarithms
    degrees_of_freedom: Values  # ν


class CovarianceFactors(NamedTuple):
    """C at φ and w, in pieces."""

    precision: Values  # d [R, K]; 0 where nothing was found
    log_weight: Values  # d/D [R, K]
    has_unknown_path: tuple[Values, Values]  # A² M(ℓ), and its derivative by log ℓ [K, K]
    prior: Values  # A [T, G, K, K]
    path: Values  # N [T, G, K, K]
    root: Values  # L⁻¹S [T, M, Q, Q]
    own: Values  # U [T, M, Q, R, K]
    half_log: Values  # ½ log|C| [T, M]


def _whitening(x: Values, xp: Space) -> Values:
    """L⁻¹ of matrices L Lᵀ in a stack [..., n, n], one by one.

    NumPy's stacks have no triangular solver. XLA's wait inside its own pool of threads and, called from several of
    ours, for ever.
    """
    shape, each = x.shape, x.reshape(-1, *x.shape[-2:])
    if xp is np:
        return np.array([_trtri(a, lower=1)[0] for a in np.linalg.cholesky(each)]).reshape(shape)
    eye = jnp.eye(shape[-1])
    return jax.lax.map(lambda a: solve_triangular(cholesky(a, lower=True), eye, lower=True), each).reshape(shape)


def _half_log(whitening: Values, xp: Space) -> Values:
    """½ log|L Lᵀ| [...], of L⁻¹ [..., n, n]."""
    return -xp.log(xp.diagonal(whitening, axis1=-2, axis2=-1)).sum(axis=-1)


def interference_db(table: ObservationTable, phi: Values, xp: Space = np) -> Values:
    """What other sounds do to a level, dB [R, K]."""
    return xp.exp(phi[3]) * ADDED * table.ratio


def variance(table: ObservationTable, phi: Values, w: Values, xp: Space = np) -> Values:
    """var/w [R, K]; φ = (log σ, log A, log ℓ, log η)."""
    return (table.variance + xp.exp(2 * phi[0]) * table.variance_profile + interference_db(table, phi, xp) ** 2) / w


def _matern(table: ObservationTable, phi: Values, xp: Space = np) -> tuple[Values, Values]:
    """A² M(ℓ) between partials, and its derivative by log ℓ [K, K]."""
    d = np.sqrt(3.0) * table.distance_octaves * xp.exp(-phi[2])
    decay = xp.exp(2 * phi[1] - d)
    return (1 + d) * decay, d**2 * decay


def factor_covariance(table: ObservationTable, phi: Values, w: Values, xp: Space = np) -> CovarianceFactors:
    """The covariance at φ and w, factored."""
    alone = variance(table, phi, w, xp)
    precision = table.detected / alone
    total = table.group.T @ precision
    there = total > 0
    eye = xp.eye(len(table.distance_octaves))
    smooth = _matern(table, phi, xp)
    prior = table.has_unknown_path[:, None, None] * smooth[0] + table.systematic
    prior = prior + (xp.exp(2 * table.log_tau)[..., None, None] + JITTER) * eye
    root = xp.where(there, xp.sqrt(xp.where(there, total, 1.0)), 0.0)
    whitening = _whitening(eye + root[:, :, None] * prior * root[:, None, :], xp)
    half_log = _half_log(whitening, xp).sum(axis=1) + 0.5 * (table.detected * xp.log(alone)).sum()
    whitening = whitening * root[:, None, :]
    path = xp.swapaxes(whitening, -1, -2) @ whitening
    share = precision / (table.group @ xp.where(there, total, 1.0))

    size, shape = table.scale.shape[1], precision.shape
    columns = before_columns(table, precision, share, path, table.columns).reshape(len(prior), 1, size, -1)
    inner = table.columns.reshape(size, -1) @ xp.swapaxes(columns, -1, -2)
    whitening = _whitening(table.scale[:, :, None] * inner * table.scale[:, None, :] + xp.eye(size), xp)
    root = whitening * table.scale[:, None, :]
    own = (root @ columns).reshape(*root.shape[:3], *shape)
    return CovarianceFactors(
        precision, share, smooth, prior, path, root, own, half_log[:, None] + _half_log(whitening, xp)
    )


def path_mean(table: ObservationTable, share: Values, x: Values) -> Values:
    """x̄ of every path [..., G, K] of x [..., R, K]."""
    return table.group.T @ (share * x)


def before_columns(table: ObservationTable, precision: Values, share: Values, path: Values, x: Values) -> Values:
    """C₀⁻¹x [T, n, R, K] of x [n, R, K]."""
    mean = path_mean(table, share, x)
    pulled = (mean.swapaxes(0, 1) @ path).swapaxes(1, 2)
    return precision * (x - table.group @ mean) + share * (table.group @ pulled)


class Predicted(NamedTuple):
    """Entries' paths and columns given all that is there [T, M, N]."""

    mean: Values
    variance: Values
    cross_gain: Values  # A N: what a path is, by the mean of its recordings [T, G, N, K]
    by: Values  # ρ: the coefficients' part of each, in units of L [T, M, Q, N]


def predicted(table: ObservationTable, p: CovarianceFactors, mean: Values, q: Values, at: Values) -> Predicted:
    """Of entries `at` [N, 2]; `mean` is the residual's x̄ [G, K], q = U r [T, M, Q]."""
    r, k = at[:, 0], at[:, 1]
    group = table.group[r].T
    rows = p.prior[:, :, k]
    pull = group[:, :, None] * (rows @ p.path)
    known = (pull * rows).sum(axis=(1, 3))
    spread = (group * p.prior[:, :, k, k]).sum(axis=1) - known
    flat = pull.swapaxes(1, 2).reshape(len(pull), len(k), mean.size)
    theirs = flat @ path_mean(table, p.log_weight, table.columns).reshape(-1, mean.size).T
    by = p.root @ (table.columns[:, r, k] - theirs.swapaxes(1, 2))[:, None]
    return Predicted(
        (flat @ mean.reshape(-1))[:, None] + (q[:, :, None] @ by)[:, :, 0], spread[:, None] + (by**2).sum(axis=2),
        pull, by,
    )  # fmt: skip


class NodeSolutions(NamedTuple):
    """F at every node without the priors of φ and w, and what it is made of."""

    nll_per_node: Values  # F [T, M]
    pieces: CovarianceFactors
    precision_residual: Values  # C⁻¹r [T, M, R, K]
    q: Values  # U r [T, M, Q]
    censored: Predicted
    z: Values  # of what is absent: bound less mean, in standard deviations [T, M, N]
    conditional_sd: Values  # these deviations, dB


def solve_nodes(table: ObservationTable, residual: Values, phi: Values, w: Values, xp: Space = np) -> NodeSolutions:
    """F at every node, and the pieces."""
    p = factor_covariance(table, phi, w, xp)
    before = before_columns(table, p.precision, p.log_weight, p.path, residual[None])[:, 0]
    own = p.own.reshape(*p.own.shape[:3], -1)
    q = own @ residual.reshape(-1)
    push = before[:, None] - (q[:, :, None] @ own).reshape(*q.shape[:2], *residual.shape)
    mean = path_mean(table, p.log_weight, residual)
    square = (p.precision * (residual - table.group @ mean) ** 2).sum()
    square = square + ((mean[:, None] @ p.path)[:, :, 0] * mean).sum(axis=(1, 2))
    at = table.censored
    absent = predicted(table, p, mean, q, at)
    alone = variance(table, phi, xp.ones_like(residual), xp)
    spread = xp.sqrt(absent.variance + alone[at[:, 0], at[:, 1]])
    z = (residual[at[:, 0], at[:, 1]] - absent.mean) / spread
    below = (log_ndtr if xp is np else jax_log_ndtr)(z).sum(axis=2)
    each = 0.5 * (square[:, None] - (q**2).sum(axis=2)) + p.half_log - below
    return NodeSolutions(each, p, push, q, absent, z, spread)


def node_weights(table: ObservationTable, each: Values) -> Values:
    """How much of the posterior each node has [T, M]."""
    share = table.log_weight - each
    share = np.exp(share - share.max())
    return share / share.sum()


def pointwise(
    table: ObservationTable, residual: Values, phi: Values, w: Values, xp: Space = np
) -> tuple[Values, Values]:
    """Log density of each observation given all others that are there [R, K], and of what is absent given these [N].

    Entries share paths and columns, so F has no term of each alone: by C⁻¹ and s = C⁻¹r entry i is normal about
    r_i - s_i/C⁻¹_ii with variance 1/C⁻¹_ii (Bürkner, Gabry and Vehtari 2021, Computational Statistics 36). Over nodes
    it is the harmonic mean, by the weights that the nodes have given all that is there.
    """
    s = solve_nodes(table, residual, phi, w, xp)
    p, found = s.pieces, table.detected > 0
    path = xp.diagonal(p.path, axis1=2, axis2=3)
    inverse = (table.group @ path) * p.log_weight**2 + p.precision * (1 - p.log_weight)
    inverse = xp.where(found, inverse[:, None] - (p.own**2).sum(axis=2), 1.0)
    there = 0.5 * (xp.log(inverse / (2 * np.pi)) - s.precision_residual**2 / inverse)
    below = (log_ndtr if xp is np else jax_log_ndtr)(s.z)
    share = table.log_weight - s.nll_per_node - below.sum(axis=2)
    share = share - _log_sum(share, xp)
    there = -_log_sum(share[:, :, None, None] - there, xp)
    return xp.where(found, there, 0.0), _log_sum(share[:, :, None] + below, xp)


def _log_sum(x: Values, xp: Space) -> Values:
    """Logarithm of the sum of exponentials over the nodes, the first two axes."""
    most = x.max(axis=(0, 1))
    return most + xp.log(xp.exp(x - most).sum(axis=(0, 1)))


def objective(
    table: ObservationTable,
    residual: Float[AnyArray, "R K"],
    phi: Float[AnyArray, " hyper"],
    w: Float[AnyArray, "R K"],
    xp: Space = jnp,
) -> Values:
    """F at a residual: y - law where a partial is found, bound - law where it is absent."""
    return combine_nodes(table, solve_nodes(table, residual, phi, w, xp).nll_per_node, phi, w, xp)


def combine_nodes(table: ObservationTable, each: Values, phi: Values, w: Values, xp: Space = np) -> Values:
    """F, of what it is at every node [T, M]."""
    mean, sd = table.prior
    mixture = 0.5 * table.degrees_of_freedom * (table.detected * (w - 1 - xp.log(w))).sum()
    return mixture - _log_sum(table.log_weight - each, xp) + 0.5 * (((phi - mean) / sd) ** 2).sum()


def em_weights(table: ObservationTable, by_log_w: np.ndarray, w: np.ndarray) -> np.ndarray:
    """The w that EM takes next, (ν + 1)/(ν + E[e²]/var) [..., R, K].

    With F's gradient by log w, ν/2 (w - 1) + G, the expectation at the present latents is E[e²]/var = (1 + 2 G)/w.
    """
    student = float(table.degrees_of_freedom)
    square = np.maximum((1 + 2 * (by_log_w - 0.5 * student * (w - 1))) / w, 0.0)
    return np.where(np.asarray(table.detected) > 0, (student + 1) / (student + square), 1.0)
