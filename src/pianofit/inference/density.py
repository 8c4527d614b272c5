"""exp(-F) as one differentiable density of (θ, φ, log w), in coordinates that suit a sampler.

The density is proper (likelihood.py) and contains all unknowns, also φ and w of frequencies and decays. θ is whitened
by Laplace's covariance. log w is scaled by the standard deviation that its curvature gives. The bounds reflect: beyond
a bound the density is the mirror image of the inside. A sampler therefore meets a continuous density without a wall,
and the reflected points have exactly the density inside the bounds. The search range of φ of the levels reflects too.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .batched_model import ModelInputs, StaticConfig, level_jacobians_per_string, levels_per_string
from .laplace import HYPER
from .likelihood import ObservationTable, objective, pointwise
from .map_estimate import Estimate
from .observation_tables import string_residuals
from .optimiser import HYPER_REACH
from .parametrisation import STRING_SIZE
from .problem import FitProblem

__all__ = [
    "DensityContext",
    "Point",
    "reflect_into_bounds",
    "density_context",
    "log_density",
    "log_likelihood",
    "random_start",
]

# Scale of a parameter at a bound: its prior's standard deviation, or this fraction of its range if that is smaller.
RANGE_FRACTION = 0.25


class Point(NamedTuple):
    """Whitened unknowns: 0 at the minimum, of order 1 in the posterior."""

    whitened: Array  # θ [free]
    phi: tuple[Array, ...]  # of levels, frequencies and decays
    log_w: tuple[Array, ...]  # of the detected entries


class DensityContext(NamedTuple):
    """The minimum, its coordinates, the bounds, the priors and the tables."""

    theta: Any  # [size]
    root: Any  # from whitened coordinates to θ [size, free]
    bounds: tuple[Any, Any]  # [size] each
    power: Any  # index of the force and of the exponent; None for a law without a power
    stiffness: Any  # lowest and highest log K_H
    log_u: Any
    prior: tuple[Any, Any]  # mean and precision [size]
    tables: tuple[ObservationTable, ...]
    phi: tuple[Any, ...]
    w: tuple[Any, ...]
    detected: tuple[Any, ...]  # row and column of every detected entry [N, 2]
    offset: Any  # discretisation error of the contact, dB [R, K]
    has_level: Any  # 1 where a level or a bound of a censored partial exists [R, K]
    stroke: Any  # index of the stroke, by recording [R]
    column: Any  # index of the model's partial, by column of the table [K]
    cents: Any  # pitch offset of every stroke
    partials: tuple[Any, Any, Any]  # numbers and string model of the string tables, length
    inputs: ModelInputs


def density_context(problem: FitProblem, estimate: Estimate) -> DensityContext:
    """Collect what the density needs at the best minimum."""
    u, o, minima = problem.parametrisation, problem.observed, estimate.minima
    optimiser, best = minima.optimiser, minima.candidates
    cents = optimiser.model_inputs_with_strings(best.theta[:1])[1]
    fields = (
        best.theta[0],
        _whitening_root(problem, estimate),
        (u.lower, u.upper),
        u.force_and_exponent_index,
        np.array(u.stiffness),
        u.log_reference_compression,
        (u.mean, u.precision),
        optimiser.tables,
        tuple(phi[0] for phi in best.phi),
        tuple(w[0] for w in best.w),
        tuple(np.argwhere(np.asarray(t.detected) > 0) for t in optimiser.tables),
        best.offset[0],
        optimiser.has_level,
        optimiser.stroke,
        optimiser.columns,
        cents,
        (o.string_number, o.law, float(problem.initial_values.geometry.length)),
        problem.model_inputs,
    )
    return DensityContext(*jax.tree.map(np.asarray, fields))


def _whitening_root(problem: FitProblem, estimate: Estimate) -> np.ndarray:
    """Root of Laplace's covariance of θ [size, free]; parameters at a bound use `RANGE_FRACTION`."""
    u = problem.parametrisation
    free, tangent = np.flatnonzero(u.free), np.linalg.inv(u.tangent(estimate.theta))
    # With K_H at a bound, the force only follows p and counts as at a bound too.
    at_bound = u.at_bound(estimate.theta)[free]
    covariance = (tangent @ estimate.posterior.covariance[0] @ tangent.T)[np.ix_(free, free)]
    covariance = np.where(at_bound[:, None] | at_bound, 0.0, covariance)
    wide = np.minimum(u.sd, RANGE_FRACTION * (u.upper - u.lower))[free]
    scale = np.sqrt(np.where(np.diag(covariance) > 0, np.diag(covariance), wide**2))
    correlation = covariance / np.outer(scale, scale)
    np.fill_diagonal(correlation, 1.0)
    root = np.zeros((u.size, len(free)))
    root[free] = scale[:, None] * np.linalg.cholesky(correlation)
    return root


def reflect_into_bounds(at: DensityContext, whitened):
    """θ [size] reflected into the bounds; K_H is reflected through the force, with p fixed."""
    free = (at.root != 0).any(axis=1)
    theta = at.theta + at.root @ whitened
    reflected = jnp.where(free, _reflect(theta, *at.bounds), theta)
    if at.power is None:
        return reflected
    i, p = at.power
    shift = jnp.exp(reflected[p]) * at.log_u
    force = _reflect(theta[i], at.stiffness[0] + shift, at.stiffness[1] + shift)
    return reflected.at[i].set(jnp.where(free[i], force, theta[i]))


def _reflect(x, low, high):
    bounded = jnp.isfinite(high - low) & (high > low)
    width = jnp.where(bounded, high - low, 1.0)
    phase = jnp.mod(x - jnp.where(bounded, low, 0.0), 2 * width)
    return jnp.where(bounded, low + jnp.where(phase < width, phase, 2 * width - phase), x)


def random_start(at: DensityContext, key, spread: float) -> Point:
    """A random point, every coordinate with standard deviation `spread` about the minimum."""
    zero = Point(
        jnp.zeros(at.root.shape[1]), tuple(jnp.zeros(n) for n in HYPER), tuple(jnp.zeros(len(x)) for x in at.detected)
    )
    leaves, tree = jax.tree.flatten(zero)
    keys = jax.random.split(key, len(leaves))
    return tree.unflatten([spread * jax.random.normal(k, x.shape) for k, x in zip(keys, leaves, strict=True)])


def log_density(at: DensityContext, point: Point, cfg: StaticConfig):
    """-F; minus infinity where a contact does not end."""
    at = jax.tree.map(jnp.asarray, at)
    theta, ended, terms = _terms(at, point, cfg)
    mean, precision = at.prior
    F = 0.5 * (precision * (theta - mean) ** 2).sum()
    for term in terms:
        F = F + objective(*term)
    return jnp.where(ended.all(), -F, -jnp.inf)


def log_likelihood(at: DensityContext, point: Point, cfg: StaticConfig) -> tuple[Array, ...]:
    """Log density of each observation given all others: of levels, frequencies, decays, and censored partials."""
    at = jax.tree.map(jnp.asarray, at)
    densities = [pointwise(table, r, phi, w, jnp) for table, r, phi, w in _terms(at, point, cfg)[2]]
    detected = [entries[tuple(index.T)] for (entries, _), index in zip(densities, at.detected, strict=True)]
    return *detected, densities[0][1]


def _terms(at: DensityContext, point: Point, cfg: StaticConfig) -> tuple[Array, Array, list[tuple]]:
    """θ, whether contacts ended, and the arguments of `objective` for every table."""
    theta = reflect_into_bounds(at, point.whitened)
    level, ended = _levels(at, cfg)(theta)
    o = at.tables[0]
    residual = (o.value - level[at.stroke][:, at.column] - at.offset) * at.has_level
    strings = [t.value[0] for t in at.tables[1:]]
    residuals = residual, *string_residuals(theta[:STRING_SIZE], strings, *at.partials, jnp)[0]
    terms = []
    for table, r, phi, w, index, x, y in zip(
        at.tables, residuals, at.phi, at.w, at.detected, point.phi, point.log_w, strict=True
    ):
        centre, sd = table.prior
        reach = HYPER_REACH * sd if table is at.tables[0] else jnp.full_like(sd, jnp.inf)
        hyper = phi.at[: len(x)].add(sd[: len(x)] * x)
        hyper = _reflect(hyper, centre - reach, centre + reach)
        # At its minimum, F has the curvature (ν + 1)/2 in log w of one entry.
        scale = jnp.sqrt(2 / (table.degrees_of_freedom + 1))
        change = jnp.zeros_like(w).at[index[:, 0], index[:, 1]].set(scale * y)
        terms.append((table, r, hyper, w * jnp.exp(change)))
    return theta, ended, terms


def _levels(at: DensityContext, cfg: StaticConfig):
    """Function of θ: levels, dB [strokes, rows], and whether contacts ended; with the search's forward derivatives."""

    def batch(theta):
        strokes = len(at.cents)
        shared = len(theta) - strokes
        velocity = theta[shared:, None]
        return (
            jnp.tile(theta[:STRING_SIZE], (strokes, 1)), at.cents,
            jnp.concatenate([jnp.tile(theta[STRING_SIZE:shared], (strokes, 1)), velocity], axis=1),
        )  # fmt: skip

    @jax.custom_jvp
    def levels(theta):
        return levels_per_string(*batch(theta), at.inputs, cfg)

    @levels.defjvp
    def _jvp(primal, tangent):
        level, slope, ended = level_jacobians_per_string(*batch(primal[0]), at.inputs, cfg)
        (change,) = tangent
        string, _, entries = batch(change)
        moved = (slope[..., :STRING_SIZE] * string[:, None]).sum(axis=-1)
        moved += (slope[..., STRING_SIZE:] * entries[:, None, at.inputs.free]).sum(axis=-1)
        return (level, ended), (moved, np.zeros(ended.shape, jax.dtypes.float0))

    return levels
