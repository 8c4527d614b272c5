"""The one objective: minus the log marginal posterior of tables of partials.

    y[r,k] = L_k(θ, v_r) + Σ_q c_q B_q[r,k] + a_g(r),k + n[r,k] m_g(r),k + h[r,k] + e[r,k]
    c_q ~ N(0, ς_q²)    a_g ~ N(0, A² ψψᵀ M(ℓ) + τ_g² I + S)    e[r,k] ~ t_ν(0, s²[r,k] + σ² u_k + (6.14 η R[r,k])²)
    m_gk ~ N(0, 2 τ̂²)   h[·,k] ~ N(0, ρ² W)      W_rs: a random walk over log v, without its mean over the recordings
    of a path

The symbols are those of docs/fitting.md. The residual is Δ = y - L.

A table holds levels, frequencies or decays of all recordings. The a describe what recordings share: an output path, a
string's own smooth deviation from its model, a systematic error of the analysis. The columns B describe what one
recording has alone: gain, onset, pitch. A stroke of another pitch meets the path at other frequencies: n m is the shift
times the slope of the path at partial k. The h describe how a partial deviates from the model in strokes of similar
velocity; ρ is the size of the walk over an e-fold of velocity. All four are integrated out in closed form. Student's t
is a scale mixture, whose log-weights w are unknowns like the others. Reweighting is therefore descent on the same
function:

    F = ½ ΔᵀC⁻¹Δ + ½ log|C| + ν/2 Σ (w - 1 - log w) - log p(φ) - Σ_censored log Φ((bound - mean)/sd)

Undetected partials are censored: the predictive distribution of each, given all detected partials, lies below the bound
of its band. One velocity alone does not determine τ. τ, and whether recordings share a gain, are summed over the nodes
of their priors, for any number of recordings.

C is never formed. Without path and columns, C has one block E = ρ² W + V + diag(var/w) for each partial, with
V_rs = 2 τ̂² n_rk n_sk for two recordings of a path. The recordings determine only the weighted mean of an output path,
x̄ = 1ᵀE⁻¹x / D, D = 1ᵀE⁻¹1 over the recordings of the path. Deviations from the mean do not depend on the path. Before
the columns,

    C₀⁻¹x = E⁻¹(x - x̄) + E⁻¹1/D N x̄,      N = (P + 1/D)⁻¹,      P the prior covariance of the path

and with them C⁻¹ = C₀⁻¹ - UᵀU, U = K⁻¹ ς B C₀⁻¹, K Kᵀ = I + ς B C₀⁻¹Bᵀ ς (Woodbury). Only N depends on τ, and only ς
on the gains. E depends on the velocities through W, and its derivative by them is part of F's gradient.

The code is written once for NumPy, which the search uses, and for JAX, whose derivatives the sampler uses. Functions
take many points at once [B, ...], because the matrices of one point are small. The search has its derivatives in closed
form (derivatives.py).
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import cholesky, solve_triangular
from jax.scipy.special import log_ndtr as jax_log_ndtr
from scipy.linalg import get_lapack_funcs
from scipy.special import log_ndtr

from ..conversions import DB

# Arrays of NumPy or of JAX, and one of the two as a module.
Values = Any
Space = Any
# Keeps the covariance of a path without variance positive definite, in the table's unit squared.
JITTER = 1e-10
# 20/log 10 over √2: effect on a level of an amplitude η R that adds at any phase, dB.
INTERFERENCE_DB = DB / np.sqrt(2)
# LAPACK's inverse of a triangular matrix.
_trtri: Any = get_lapack_funcs("trtri", dtype=np.float64)


class ObservationTable(NamedTuple):
    """One kind of observation: R recordings, K partials, G groups that share a path, Q columns.

    T counts the nodes of τ, M those of the gains.
    """

    value: Values  # y [R, K]
    variance: Values  # s², of measurement [R, K]
    detected: Values  # 1 where a partial was detected [R, K]
    censored: Values  # int, recording and partial of a censored entry, where `value` is a bound [N, 2]
    group: Values  # one-hot [R, G]
    columns: Values  # B [Q, R, K]
    scale: Values  # ς, prior standard deviations of their coefficients [M, Q]
    systematic: Values  # S [K, K]
    distance_octaves: Values  # distance of partials, octaves [K, K]
    has_unknown_path: Values  # 1 where the group has an unknown path, or the string deviates from its model [G]
    log_tau: Values  # log τ [T, G]
    log_weight: Values  # log prior weight of the nodes of `log_tau` and `scale` together [T, M]
    excess_profile: Values  # u, of σ² [K]
    smooth_profile: Values  # ψ, of A [K]
    pitch: Values  # √2 τ̂ n, of strokes that are not at the pitch of the reference [R, K]
    ratio: Values  # R: amplitude of the loudest partial over that of each [R, K]
    prior: tuple[Values, Values]  # of φ: means and standard deviations of logarithms
    velocity: Values  # derivative of each recording's log velocity by θ, 1 or 0 [R, size]
    degrees_of_freedom: Values  # ν


class CovarianceFactors(NamedTuple):
    """Factors of C at many φ and w [B, ...]."""

    precision: Values  # E⁻¹ of each partial [B, K, R, R]; 0 where no partial was detected
    precision_sum: Values  # E⁻¹1 [B, R, K]
    relative_precision: Values  # E⁻¹1/D [B, R, K]
    walk: Values  # ρ² W [B, R, R]
    matern: tuple[Values, Values]  # A² M(ℓ), and its derivative by log ℓ [B, K, K]
    prior: Values  # P [B, T, G, K, K]
    path: Values  # N [B, T, G, K, K]
    root: Values  # K⁻¹ς [B, T, M, Q, Q]
    U: Values  # [B, T, M, Q, R, K]
    half_log_det: Values  # ½ log|C| [B, T, M]


def _whitening(x: Values, xp: Space) -> Values:
    """L⁻¹ of matrices L Lᵀ in a stack [..., n, n], one by one.

    NumPy has no triangular solver for stacks. XLA's solver waits inside its own thread pool. Called from several of our
    threads, it can wait for ever.
    """
    shape, matrices = x.shape, x.reshape(-1, *x.shape[-2:])
    if xp is np:
        return np.array([_trtri(a, lower=1)[0] for a in np.linalg.cholesky(matrices)]).reshape(shape)
    eye = jnp.eye(shape[-1])
    return jax.lax.map(lambda a: solve_triangular(cholesky(a, lower=True), eye, lower=True), matrices).reshape(shape)


def _inverse(x: Values, xp: Space) -> tuple[Values, Values]:
    """Inverses of well-conditioned matrices in a stack [B, K, n, n], and half the sums of their log determinants."""
    if x.shape[-1] == 1:
        return 1 / x, 0.5 * xp.log(x).sum(axis=(1, 2, 3))
    if xp is np:
        diagonal = np.diagonal(np.linalg.cholesky(x), axis1=2, axis2=3)
        return np.linalg.inv(x), np.log(diagonal).sum(axis=(1, 2))
    whitening = _whitening(x, xp)
    return xp.swapaxes(whitening, 2, 3) @ whitening, _half_log_det(whitening, xp).sum(axis=1)


def _half_log_det(whitening: Values, xp: Space) -> Values:
    """½ log|L Lᵀ| [...] from L⁻¹ [..., n, n]."""
    return -xp.log(xp.diagonal(whitening, axis1=-2, axis2=-1)).sum(axis=-1)


def interference_db(table: ObservationTable, phi: Values, xp: Space = np) -> Values:
    """Standard deviation of a level caused by other sounds, dB [B, R, K]."""
    return xp.exp(phi[:, 3, None, None]) * INTERFERENCE_DB * table.ratio


def variance(table: ObservationTable, phi: Values, w: Values, xp: Space = np) -> Values:
    """var/w [B, R, K]; φ = (log σ, log A, log ℓ, log η, log ρ) [B, 5]."""
    excess = xp.exp(2 * phi[:, 0, None, None]) * table.excess_profile
    return (table.variance + excess + interference_db(table, phi, xp) ** 2) / w


def _matern(table: ObservationTable, phi: Values, xp: Space) -> tuple[Values, Values]:
    """A² M(ℓ) between partials, and its derivative by log ℓ [B, K, K]."""
    d = np.sqrt(3.0) * table.distance_octaves * xp.exp(-phi[:, 2, None, None])
    profile = table.smooth_profile
    decay = xp.exp(2 * phi[:, 1, None, None] - d) * profile[:, None] * profile
    return (1 + d) * decay, d**2 * decay


def same_path(table: ObservationTable) -> Values:
    """1 where two recordings share a path [R, R]."""
    return table.group @ table.group.T


def centring(table: ObservationTable) -> Values:
    """Projection that removes the mean over the recordings of each path [R, R]."""
    same = same_path(table)
    return np.eye(len(same)) - same / same.sum(axis=1)


def walk_covariance(table: ObservationTable, theta: Values, xp: Space = np) -> Values:
    """W: covariance of a random walk over log velocity without its mean [B, R, R]; 0 between two paths.

    The increments of the walk have the variance |log v_r - log v_s|. Without the mean, its start has no effect.
    """
    log_velocity, centred = theta @ table.velocity.T, centring(table)
    distance = xp.abs(log_velocity[:, :, None] - log_velocity[:, None]) * same_path(table)
    return -0.5 * centred @ distance @ centred.T


def pitch_covariance(table: ObservationTable) -> Values:
    """V: covariance between the recordings of each partial by their pitches [K, R, R]; 0 between two paths."""
    return table.pitch.T[:, :, None] * table.pitch.T[:, None] * same_path(table)


def by_partial(blocks: Values, x: Values) -> Values:
    """Product of one matrix for each partial [B, K, R, R] and x [B, n, R, K]."""
    return (blocks @ x.transpose(0, 3, 2, 1)).transpose(0, 3, 2, 1)


def flattened(x: Values) -> Values:
    """The last two axes as one, also of arrays without entries [..., R K]."""
    return x.reshape(*x.shape[:-2], x.shape[-2] * x.shape[-1])


def factor_covariance(table: ObservationTable, phi: Values, w: Values, theta: Values, xp: Space) -> CovarianceFactors:
    """Factor the covariance at φ, w and the velocities in θ [B, ...]."""
    entry_variance = variance(table, phi, w, xp)
    walk = xp.exp(2 * phi[:, 4, None, None]) * walk_covariance(table, theta, xp)
    root = xp.swapaxes(table.detected / xp.sqrt(entry_variance), 1, 2)[..., None]
    beside = xp.swapaxes(root, 2, 3)
    block = walk[:, None] + pitch_covariance(table)
    inverse, half_log_det = _inverse(xp.eye(walk.shape[-1]) + root * block * beside, xp)
    half_log_det = half_log_det + 0.5 * (table.detected * xp.log(entry_variance)).sum(axis=(1, 2))
    precision = root * inverse * beside
    precision_sum = xp.swapaxes(precision.sum(axis=3), 1, 2)
    total = table.group.T @ precision_sum
    detected = (table.group.T @ table.detected) > 0
    matern = _matern(table, phi, xp)
    prior, path, of_path = _paths(table, matern[0], xp.where(detected, total, 0.0), xp)
    half_log_det = half_log_det[:, None] + of_path
    relative = precision_sum / (table.group @ xp.where(detected, total, 1.0))
    p = CovarianceFactors(precision, precision_sum, relative, walk, matern, prior, path, None, None, half_log_det)

    size = table.scale.shape[1]
    columns = flattened(before_columns(table, p, table.columns[None]))[:, :, None]
    inner = flattened(table.columns) @ xp.swapaxes(columns, -1, -2)
    whitening = _whitening(table.scale[:, :, None] * inner * table.scale[:, None, :] + xp.eye(size), xp)
    root = whitening * table.scale[:, None, :]
    U = (root @ columns).reshape(*root.shape[:4], *entry_variance.shape[1:])
    return p._replace(root=root, U=U, half_log_det=half_log_det[:, :, None] + _half_log_det(whitening, xp))


def _paths(table: ObservationTable, matern: Values, total: Values, xp: Space) -> tuple[Values, Values, Values]:
    """P and N of every path [B, T, G, K, K], and ½ log|1 + P D| [B, T]; D [B, G, K] is 0 without detected partials."""
    eye = xp.eye(len(table.distance_octaves))
    prior = table.has_unknown_path[:, None, None] * matern[:, None] + table.systematic
    prior = prior[:, None] + (xp.exp(2 * table.log_tau)[..., None, None] + JITTER) * eye
    # The root of 0 has no derivative.
    root = xp.where(total > 0, xp.sqrt(xp.where(total > 0, total, 1.0)), 0.0)[:, None, :, None]
    whitening = _whitening(eye + xp.swapaxes(root, 3, 4) * prior * root, xp)
    half_log_det = _half_log_det(whitening, xp).sum(axis=2)
    whitening = whitening * root
    return prior, xp.swapaxes(whitening, -1, -2) @ whitening, half_log_det


def before_columns(table: ObservationTable, p: CovarianceFactors, x: Values) -> Values:
    """C₀⁻¹x [B, T, n, R, K] of x [B, n, R, K], or of the same x [1, n, R, K] for all."""
    mean = table.group.T @ (p.relative_precision[:, None] * x)  # x̄ of every path [B, n, G, K]
    weighted = (mean.swapaxes(1, 2)[:, None] @ p.path).swapaxes(2, 3)
    own = by_partial(p.precision, x - table.group @ mean)
    return own[:, None] + p.relative_precision[:, None, None] * (table.group @ weighted)


class Predicted(NamedTuple):
    """Paths, walks and columns of N entries given all detected partials [B, T, M, N]."""

    mean: Values
    variance: Values
    gain: Values  # derivative of path and walk by the residuals, without the columns [B, T, N, R, K]
    loading: Values  # λ: the part of the coefficients in each entry, in units of K [B, T, M, Q, N]


def predicted(table: ObservationTable, p: CovarianceFactors, residual: Values, q: Values, at: Values) -> Predicted:
    """Predict entries `at` [N, 2] from the residual [B, R, K] and q = U Δ [B, T, M, Q]."""
    r, k = at[:, 0], at[:, 1]
    group, same_partial = table.group[r].T, k[:, None] == np.arange(residual.shape[2])
    rows = group[:, :, None] * p.prior[:, :, :, k]
    by_pitch = pitch_covariance(table)[k, r]
    walk = (p.walk[:, r] + by_pitch)[..., None] * same_partial[:, None, :]
    # Covariance of path and walk of the entries with those of all entries [B, T, N, R, K].
    shared = (table.group @ rows.swapaxes(2, 3)) + walk[:, None]
    gain = table.group @ (rows @ p.path).swapaxes(2, 3)
    gain = p.relative_precision[:, None, None] * gain + before_columns(table, p, walk)
    prior = (group * p.prior[:, :, :, k, k]).sum(axis=2) + (p.walk[:, r, r] + by_pitch[np.arange(len(r)), r])[:, None]
    remaining = prior - (shared * gain).sum(axis=(3, 4))
    flat = flattened(gain)
    columns = flat @ flattened(table.columns).T
    loading = p.root @ (table.columns[:, r, k] - columns.swapaxes(2, 3))[:, :, None]
    conditional_mean = (flat @ flattened(residual)[:, None, :, None])[:, :, None, :, 0]
    conditional_mean = conditional_mean + (q[..., None, :] @ loading)[..., 0, :]
    return Predicted(conditional_mean, remaining[:, :, None] + (loading**2).sum(axis=3), gain, loading)


class NodeSolutions(NamedTuple):
    """F at every node without the priors of φ and w, and its parts, at many points."""

    nll_per_node: Values  # F [B, T, M]
    factors: CovarianceFactors
    precision_residual: Values  # C⁻¹Δ [B, T, M, R, K]
    q: Values  # U Δ [B, T, M, Q]
    censored: Predicted
    standardised: Values  # bound minus mean of the censored entries, in standard deviations [B, T, M, N]
    conditional_sd: Values  # these standard deviations, dB


def solve_nodes(
    table: ObservationTable, residual: Values, phi: Values, w: Values, theta: Values, xp: Space = np
) -> NodeSolutions:
    """F at every node, and its parts, at residuals [B, R, K], φ [B, 5], w [B, R, K] and θ [B, n]."""
    p = factor_covariance(table, phi, w, theta, xp)
    before = before_columns(table, p, residual[:, None])[:, :, 0]
    U = flattened(p.U)
    q = (U @ flattened(residual)[:, None, None, :, None])[..., 0]
    precision_residual = before[:, :, None] - (q[..., None, :] @ U).reshape(*q.shape[:3], *residual.shape[1:])
    # ΔᵀC₀⁻¹Δ and qᵀq
    square = (before * residual[:, None]).sum(axis=(2, 3))[:, :, None] - (q**2).sum(axis=3)
    at = table.censored
    censored = predicted(table, p, residual, q, at)
    entry_variance = variance(table, phi, xp.ones_like(residual), xp)[:, at[:, 0], at[:, 1]]
    sd = xp.sqrt(censored.variance + entry_variance[:, None, None])
    standardised = (residual[:, at[:, 0], at[:, 1]][:, None, None] - censored.mean) / sd
    log_below = (log_ndtr if xp is np else jax_log_ndtr)(standardised).sum(axis=3)
    nll_per_node = 0.5 * square + p.half_log_det - log_below
    return NodeSolutions(nll_per_node, p, precision_residual, q, censored, standardised, sd)


def node_weights(table: ObservationTable, nll_per_node: Values) -> Values:
    """Posterior weight of each node [B, T, M]."""
    weight = table.log_weight - nll_per_node
    weight = np.exp(weight - weight.max(axis=(1, 2), keepdims=True))
    return weight / weight.sum(axis=(1, 2), keepdims=True)


def pointwise(
    table: ObservationTable, residual: Values, phi: Values, w: Values, theta: Values, xp: Space = np
) -> tuple[Values, Values]:
    """Log density of each detected entry given all others [R, K], and of each censored entry given these [N].

    Entries share paths and columns, so F has no separate term of each. With C⁻¹ and s = C⁻¹Δ, entry i is normal about
    Δ_i - s_i/C⁻¹_ii with variance 1/C⁻¹_ii (Bürkner, Gabry and Vehtari 2021, Computational Statistics 36). The result
    over nodes is the harmonic mean, with the weights of the nodes given all detected entries.
    """
    s = solve_nodes(table, residual[None], phi[None], w[None], theta[None], xp)
    p, detected = s.factors, table.detected > 0
    path, own = xp.diagonal(p.path, axis1=3, axis2=4), xp.swapaxes(xp.diagonal(p.precision, axis1=2, axis2=3), 1, 2)
    own = own - p.precision_sum * p.relative_precision
    inverse = (table.group @ path) * p.relative_precision[:, None] ** 2 + own[:, None]
    inverse = xp.where(detected, inverse[:, :, None] - (p.U**2).sum(axis=3), 1.0)
    density = 0.5 * (xp.log(inverse / (2 * np.pi)) - s.precision_residual**2 / inverse)
    log_below = (log_ndtr if xp is np else jax_log_ndtr)(s.standardised)
    log_weight = table.log_weight - s.nll_per_node - log_below.sum(axis=3)
    log_weight = log_weight - _log_sum(log_weight, xp)[:, None, None]
    density = -_log_sum(log_weight[..., None, None] - density, xp)[0]
    return xp.where(detected, density, 0.0), _log_sum(log_weight[..., None] + log_below, xp)[0]


def _log_sum(x: Values, xp: Space) -> Values:
    """Logarithm of the sum of exponentials over the nodes, the second and third axes."""
    largest = x.max(axis=(1, 2), keepdims=True)
    return largest[:, 0, 0] + xp.log(xp.exp(x - largest).sum(axis=(1, 2)))


def table_objective(
    table: ObservationTable, residual: Values, phi: Values, w: Values, theta: Values, xp: Space = jnp
) -> Values:
    """F of one table at a residual [R, K], φ [5], w [R, K] and θ [size].

    The residual is y - model where a partial is detected, and bound - model where it is censored.
    """
    residual, phi, w, theta = (x[None] for x in (residual, phi, w, theta))
    return combine_nodes(table, solve_nodes(table, residual, phi, w, theta, xp).nll_per_node, phi, w, xp)[0]


def combine_nodes(table: ObservationTable, nll_per_node: Values, phi: Values, w: Values, xp: Space = np) -> Values:
    """F [B] from its values at every node [B, T, M]."""
    mean, sd = table.prior
    mixture = 0.5 * table.degrees_of_freedom * (table.detected * (w - 1 - xp.log(w))).sum(axis=(1, 2))
    return mixture - _log_sum(table.log_weight - nll_per_node, xp) + 0.5 * (((phi - mean) / sd) ** 2).sum(axis=1)


def em_weights(table: ObservationTable, by_log_w: np.ndarray, w: np.ndarray) -> np.ndarray:
    """The next weights w of EM, (ν + 1)/(ν + E[e²]/var) [..., R, K].

    With F's gradient by log w, ν/2 (w - 1) + G, the expectation at the present latents is E[e²]/var = (1 + 2 G)/w.
    """
    degrees = float(table.degrees_of_freedom)
    square = np.maximum((1 + 2 * (by_log_w - 0.5 * degrees * (w - 1))) / w, 0.0)
    return np.where(np.asarray(table.detected) > 0, (degrees + 1) / (degrees + square), 1.0)
