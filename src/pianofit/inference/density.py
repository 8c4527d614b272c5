"""F as one function of JAX, with derivatives of any kind: for samplers, and for programs of users.

The search has its own derivatives in closed form (`derivatives`). Here only the levels have a rule of their own, the
forward derivatives of the search, because a contact has few inputs and many steps.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields, replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .batched_model import LevelModel, level_jacobians_per_string, levels_per_string, string_residuals
from .likelihood import ObservationTable, table_objective
from .parametrisation import STRING_SIZE, Parametrisation
from .problem import FitProblem, ModelInputs, StaticConfig

# Law and names of sizes are static: notes with the same ones share compiled programs.
jax.tree_util.register_dataclass(
    Parametrisation,
    data_fields=[field.name for field in fields(Parametrisation) if field.name not in ("law", "sizes")],
    meta_fields=["law", "sizes"],
)


class DensityContext(NamedTuple):
    """A point, coordinates about it, the parameters, their prior and the tables."""

    theta: Any  # [size]
    root: Any  # from whitened coordinates to θ [size, free]
    parametrisation: Parametrisation  # with arrays of JAX, and without its joint prior
    precision: Any  # of each parameter's own prior [size]
    joint: tuple[Any, Any, Any] | None  # invariants, their mean [quantities] and precision, if other keys gave a prior
    tables: tuple[ObservationTable, ...]
    phi: tuple[Any, ...]
    w: tuple[Any, ...]
    detected: tuple[Any, ...]  # row and column of every detected entry [N, 2]
    offset: Any  # discretisation error of the contact, dB [R, K]
    has_level: Any  # 1 where a level or a bound of a censored partial exists [R, K]
    stroke: Any  # index of the stroke, by recording [R]
    column: Any  # index of the model's partial, by column of the table [K]
    by_size: Any  # derivatives of the levels by uncertain sizes, dB [sizes, K]
    cents: Any  # pitch offset of every stroke
    partials: tuple[Any, Any, Any]  # numbers and string model of the string tables, length
    inputs: ModelInputs


def density_context_at(
    problem: FitProblem,
    theta: np.ndarray,
    root: np.ndarray,
    phi: Sequence[np.ndarray],
    w: Sequence[np.ndarray],
    offset: np.ndarray,
) -> DensityContext:
    """Collect what the density needs about a point: see `DensityContext`."""
    u, o, model = problem.parametrisation, problem.observed, LevelModel(problem)
    tables = o.level, o.frequency, o.decay
    context = DensityContext(
        theta,
        root,
        replace(u, joint=None),
        u.precision,
        None if u.joint is None else (u.joint.invariants, u.joint.mean, u.joint.precision),
        tables,
        tuple(phi),
        tuple(w),
        tuple(np.argwhere(np.asarray(t.detected) > 0) for t in tables),
        offset,
        model.has_level,
        model.stroke,
        model.columns,
        model.by_size,
        model.cents,
        (o.string_number, o.law, float(problem.initial_values.geometry.length)),
        problem.model_inputs,
    )
    return jax.tree.map(np.asarray, context)


def reflect_into_bounds(at: DensityContext, whitened):
    """θ [size] reflected into the bounds; K_H is reflected through the force, with p fixed."""
    u, theta = at.parametrisation, at.theta + at.root @ whitened
    # The bounds of the force depend on the other values of the felt, whose own bounds are constant.
    inside = jnp.where(u.free, reflect(theta, u.lower, u.upper), theta)
    return jnp.where(u.free, reflect(theta, *u.bounds_at(inside)), theta)


def reflect(x, low, high):
    """Reflect `x` into finite bounds."""
    bounded = jnp.isfinite(high - low) & (high > low)
    width = jnp.where(bounded, high - low, 1.0)
    phase = jnp.mod(x - jnp.where(bounded, low, 0.0), 2 * width)
    return jnp.where(bounded, low + jnp.where(phase < width, phase, 2 * width - phase), x)


def negative_log_density(at: DensityContext, theta, phi: Sequence[Any], w: Sequence[Any], cfg: StaticConfig):
    """F at θ [size], and φ and w of every table; infinite where a contact does not end."""
    ended, terms = table_terms(at, theta, phi, w, cfg)
    F = 0.5 * (at.precision * (theta - at.parametrisation.mean) ** 2).sum()
    if at.joint is not None:
        invariants, centre, precision = at.joint
        deviation = invariants(theta, cfg.law, jnp) - centre
        F = F + 0.5 * deviation @ precision @ deviation
    for term in terms:
        F = F + table_objective(*term)
    return jnp.where(ended.all(), F, jnp.inf)


def table_terms(
    at: DensityContext, theta, phi: Sequence[Any], w: Sequence[Any], cfg: StaticConfig
) -> tuple[Array, list[tuple]]:
    """Return which contacts ended, and the arguments of `objective` for every table."""
    u = at.parametrisation
    entries = u.model_entries(theta)
    level, ended = _levels(at, cfg)(entries)
    if u.sizes:
        level = level.at[:, at.column].add(u.size_changes(theta) @ at.by_size)
    o = at.tables[0]
    residual = (o.value - level[at.stroke][:, at.column] - at.offset) * at.has_level
    strings = [t.value[0] for t in at.tables[1:]]
    residuals = residual, *string_residuals(entries[:STRING_SIZE], strings, *at.partials, jnp)[0]
    return ended, [(*parts, theta) for parts in zip(at.tables, residuals, phi, w, strict=True)]


def _levels(at: DensityContext, cfg: StaticConfig):
    """Function of θ: levels, dB [strokes, rows], and whether contacts ended; with the search's forward derivatives."""

    def batch(theta):
        u, strokes = at.parametrisation, len(at.cents)
        velocity = theta[u.velocities, None]
        hammers = jnp.tile(theta[STRING_SIZE : u.shared], (strokes, 1))
        return jnp.tile(theta[:STRING_SIZE], (strokes, 1)), at.cents, jnp.concatenate([hammers, velocity], axis=1)

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
