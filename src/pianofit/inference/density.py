"""exp(-F) as one differentiable density of (θ, φ, log w), in coordinates that suit a sampler.

The density is proper (likelihood.py), and all of its unknowns stand here, with φ and w of frequencies and decays. θ is
whitened by Laplace's covariance, log w by the spread that each has given its residual. The box is folded: beyond an
edge lies the mirror image of what is inside, so a sampler meets a continuous density without a wall, and what is folded
back has exactly the density in the box. So is the range within which the search keeps φ of the levels.
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
    "start",
]

# What lies at a bound is first looked for within its prior, or this share of its box.
OF_BOX = 0.25


class Point(NamedTuple):
    """Unknowns, 0 at the minimum, of order 1 in the posterior."""

    theta: Array  # [free]
    phi: tuple[Array, ...]  # of levels, frequencies and decays
    log_w: tuple[Array, ...]  # of what was observed


class DensityContext(NamedTuple):
    """The minimum and its coordinates, box and priors, and the tables."""

    z: Any  # [size]
    white: Any  # from unit normals to z [size, free]
    box: tuple[Any, Any]  # [size] each
    power: Any  # where the force stands, and the exponent; None for a law without a power
    stiffness: Any  # least and largest log K_H
    log_u: Any
    prior: tuple[Any, Any]  # mean and precision [size]
    tables: tuple[ObservationTable, ...]
    phi: tuple[Any, ...]
    w: tuple[Any, ...]
    found: tuple[Any, ...]  # row and column of what was observed [N, 2]
    offset: Any  # the contact's step error, dB [R, K]
    there: Any  # 1 where a level is, or is known to be absent [R, K]
    stroke: Any  # of every recording [R]
    column: Any  # the model's, of every column of the table [K]
    cents: Any  # tension of every stroke
    partials: tuple[Any, Any, Any]  # numbers and law of the string's tables, length
    scene: ModelInputs


def density_context(problem: FitProblem, found: Estimate) -> DensityContext:
    """What the density needs, about the best minimum."""
    u, o, minima = problem.unknowns, problem.observed, found.minima
    descent, best = minima.descent, minima.people
    cents = descent.model_inputs_with_strings(best.theta[:1])[1]
    everything = (
        best.theta[0],
        _whitening_root(problem, found),
        (u.lower, u.upper),
        u.force_and_exponent_index,
        np.array(u.stiffness),
        u.log_reference_compression,
        (u.mean, u.precision),
        descent.tables,
        tuple(phi[0] for phi in best.phi),
        tuple(w[0] for w in best.w),
        tuple(np.argwhere(np.asarray(t.found) > 0) for t in descent.tables),
        best.offset[0],
        descent.has_level,
        descent.stroke,
        descent.columns,
        cents,
        (o.string_number, o.law, float(problem.start.geometry.length)),
        problem.scene,
    )
    return DensityContext(*jax.tree.map(np.asarray, everything))


def _whitening_root(problem: FitProblem, found: Estimate) -> np.ndarray:
    """A root of Laplace's covariance of z [size, free]; by prior and box of what is at a bound."""
    u = problem.unknowns
    free, tangent = np.flatnonzero(u.free), np.linalg.inv(u.tangent(found.z))
    loose_at = u.at_bound(found.z)[free]  # a force that only follows p, because K_H lies at a bound, is one of these
    covariance = (tangent @ found.posterior.covariance[0] @ tangent.T)[np.ix_(free, free)]
    covariance = np.where(loose_at[:, None] | loose_at, 0.0, covariance)
    loose = np.minimum(u.sd, OF_BOX * (u.upper - u.lower))[free]
    scale = np.sqrt(np.where(np.diag(covariance) > 0, np.diag(covariance), loose**2))
    correlation = covariance / np.outer(scale, scale)
    np.fill_diagonal(correlation, 1.0)
    out = np.zeros((u.size, len(free)))
    out[free] = scale[:, None] * np.linalg.cholesky(correlation)
    return out


def reflect_into_bounds(at: DensityContext, theta):
    """z [size] in the box, and the mirror images of the box beyond it; K_H is folded by the force, p held."""
    moves = (at.white != 0).any(axis=1)
    z = at.z + at.white @ theta
    plain = jnp.where(moves, _fold(z, *at.box), z)
    if at.power is None:
        return plain
    i, p = at.power
    shift = jnp.exp(plain[p]) * at.log_u
    force = _fold(z[i], at.stiffness[0] + shift, at.stiffness[1] + shift)
    return plain.at[i].set(jnp.where(moves[i], force, z[i]))


def _fold(x, low, high):
    bounded = jnp.isfinite(high - low) & (high > low)
    width = jnp.where(bounded, high - low, 1.0)
    turn = jnp.mod(x - jnp.where(bounded, low, 0.0), 2 * width)
    return jnp.where(bounded, low + jnp.where(turn < width, turn, 2 * width - turn), x)


def start(at: DensityContext, key, apart: float) -> Point:
    """A point `apart` standard deviations from the minimum in everything."""
    zero = Point(
        jnp.zeros(at.white.shape[1]), tuple(jnp.zeros(n) for n in HYPER), tuple(jnp.zeros(len(x)) for x in at.found)
    )
    leaves, tree = jax.tree.flatten(zero)
    keys = jax.random.split(key, len(leaves))
    return tree.unflatten([apart * jax.random.normal(k, x.shape) for k, x in zip(keys, leaves, strict=True)])


def log_density(at: DensityContext, point: Point, cfg: StaticConfig):
    """-F; minus infinity where a contact does not end."""
    at = jax.tree.map(jnp.asarray, at)
    z, ended, terms = _terms(at, point, cfg)
    mean, precision = at.prior
    F = 0.5 * (precision * (z - mean) ** 2).sum()
    for term in terms:
        F = F + objective(*term)
    return jnp.where(ended.all(), -F, -jnp.inf)


def log_likelihood(at: DensityContext, point: Point, cfg: StaticConfig) -> tuple[Array, ...]:
    """Log density of each observation given all others: of levels, frequencies, decays, and absent partials."""
    at = jax.tree.map(jnp.asarray, at)
    each = [pointwise(table, r, phi, w, jnp) for table, r, phi, w in _terms(at, point, cfg)[2]]
    there = [own[tuple(found.T)] for (own, _), found in zip(each, at.found, strict=True)]
    return *there, each[0][1]


def _terms(at: DensityContext, point: Point, cfg: StaticConfig) -> tuple[Array, Array, list[tuple]]:
    """z, whether contacts ended, and of every table what `objective` takes."""
    z = reflect_into_bounds(at, point.theta)
    level, ended = _law(at, cfg)(z)
    o = at.tables[0]
    residual = (o.value - level[at.stroke][:, at.column] - at.offset) * at.there
    strings = [t.value[0] for t in at.tables[1:]]
    residuals = residual, *string_residuals(z[:STRING_SIZE], strings, *at.partials, jnp)[0]
    terms = []
    for table, r, phi, w, found, x, y in zip(
        at.tables, residuals, at.phi, at.w, at.found, point.phi, point.log_w, strict=True
    ):
        centre, wide = table.prior
        reach = HYPER_REACH * wide if table is at.tables[0] else jnp.full_like(wide, jnp.inf)
        hyper = phi.at[: len(x)].add(wide[: len(x)] * x)
        hyper = _fold(hyper, centre - reach, centre + reach)
        # An entry's log w has curvature (ν + 1)/2 where it is lowest.
        spread = jnp.sqrt(2 / (table.student + 1))
        change = jnp.zeros_like(w).at[found[:, 0], found[:, 1]].set(spread * y)
        terms.append((table, r, hyper, w * jnp.exp(change)))
    return z, ended, terms


def _law(at: DensityContext, cfg: StaticConfig):
    """Levels, dB [strokes, rows], and whether contacts ended, at z; derivatives as the search takes them, forward."""

    def lanes(z):
        strokes = len(at.cents)
        shared = len(z) - strokes
        velocity = z[shared:, None]
        return (
            jnp.tile(z[:STRING_SIZE], (strokes, 1)), at.cents,
            jnp.concatenate([jnp.tile(z[STRING_SIZE:shared], (strokes, 1)), velocity], axis=1),
        )  # fmt: skip

    @jax.custom_jvp
    def law(z):
        return levels_per_string(*lanes(z), at.scene, cfg)

    @law.defjvp
    def _jvp(primal, tangent):
        level, slope, ended = level_jacobians_per_string(*lanes(primal[0]), at.scene, cfg)
        (dz,) = tangent
        string, _, lane = lanes(dz)
        moved = (slope[..., :STRING_SIZE] * string[:, None]).sum(axis=-1)
        moved += (slope[..., STRING_SIZE:] * lane[:, None, at.scene.free]).sum(axis=-1)
        return (level, ended), (moved, np.zeros(ended.shape, jax.dtypes.float0))

    return law
