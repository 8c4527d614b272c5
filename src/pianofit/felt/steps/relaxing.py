"""The felt laws of this package in one formula, and one equation per step.

    F = K_H [g^p (1 + μ u̇) - ε c], never below 0,     τ ċ = u^p - c,     g = u²/(u + d)

Without a skin d, g = u. Then, without μ and ε this is the power law (Ghosh), with μ the law of Hunt and Crossley, which
the paper uses, and with ε the law of Stulov. A felt does not have both. u^p is assumed linear in time over a step. Then
c has a closed form at any τ,

    c_n = k c_(n-1) + w0 a_(n-1) + w1 a_n,     a = u^p, 0 when apart,     k = exp(-δt/τ),     k + w0 + w1 = 1

u̇ is w_n = (u_n - u_(n-1))/a - w_(n-1) (paper eq. 16). String and hammer yield by C per newton of F_n + F_(n-1). So a
step is one equation, u + C F(u) = upper. F is convex, and rises wherever it is not 0, since ε w1 < 1. Newton's iterates
decrease monotonically to the root once they are above it, and one step from below takes them there. Clipped to
[0, upper], which contains the root, they always converge. Halley's iterations come first: they use the curvature and
triple the digits where Newton's double them. A batch waits for its slowest candidate, and powers are the main cost.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array

from ...parameters import Hammer
from ...x64 import AnyArray, derivative, float64
from ..relaxing import RelaxingHammer
from ..soft_skin import SoftHammer, base

# Limit of iterations. From the worst start (p = 5) each reduces the error by a fifth until convergence is quadratic.
MAX_ITERATIONS = 200
# Number of Halley iterations, and relative changes of u after which the next iteration would only change rounding.
HALLEY, TOLERANCE_HALLEY, TOLERANCE_NEWTON = 6, 1e-6, 1e-9
SERIES_TERMS = 14
# Smallest compression, m, whose powers are computed: smaller ones give no force.
SMALLEST = 1e-100


class Weights(NamedTuple):
    """k, w0 and w1 of one step of the relaxation. Each is in (0, 1); their sum is 1."""

    kept: Array
    old: Array
    new: Array


def _base(u: Any, hammer: Any) -> Any:
    """g of a felt with a skin, u of any other."""
    return base(u, hammer) if isinstance(hammer, SoftHammer) else u


def _softness(u: Any, hammer: Any) -> Any:
    """d/(u + d): the exponent of the force is p times this plus 1."""
    return hammer.skin / (u + hammer.skin) if isinstance(hammer, SoftHammer) else 0.0


def felt_force(u: Array, w: Array, hammer: Hammer | SoftHammer | RelaxingHammer, memory=0.0, share=0.0) -> Array:
    """Felt force, N (paper eq. 8, with u = y_H - y_s).

    For a relaxing felt, c is `memory`, m^p, plus `share` times g^p.
    """
    power = _base(jnp.where(u > 0, u, 1.0), hammer) ** hammer.p
    if not isinstance(hammer, RelaxingHammer):
        return jnp.where(u > 0, hammer.K_H * power * jnp.maximum(1 + hammer.mu * w, 0.0), 0.0)
    loss = jnp.maximum(1 + hammer.mu * w - hammer.epsilon * share, 0.0)
    unclipped = hammer.K_H * (power * loss - hammer.epsilon * memory)
    return jnp.where((u > 0) & (unclipped > 0), unclipped, 0.0)


@float64
def memory_weights(hammer: Any, step: AnyArray) -> Weights | None:
    """Compute the weights of a `step`, s, exact to rounding for any τ; None for a felt that does not relax."""
    if not isinstance(hammer, RelaxingHammer):
        return None
    s = step / hammer.tau
    near, far = jnp.minimum(s, 0.5), jnp.maximum(s, 0.5)
    # w1 = 1 - (1 - e^-s)/s = s/2 - s²/6 + s³/24 - ..., by Horner's rule.
    series = jnp.zeros_like(near)
    for k in range(SERIES_TERMS, 1, -1):
        series = (1 - series) * near / k
    lag = -jnp.expm1(-far) / far
    return Weights(
        jnp.exp(-s),
        jnp.where(s < 0.5, -jnp.expm1(-near) - series, lag - jnp.exp(-far)),
        jnp.where(s < 0.5, series, 1 - lag),
    )


def update_relaxation(u: Array, hammer: Any, weights: Weights | None, memory: Any) -> Array | None:
    """Part of c that the next step inherits, k c_n + w0 a_n, from `u` and `memory` of this step."""
    if weights is None:
        return None
    a = jnp.where(u > 0, jnp.where(u > 0, u, 1.0) ** hammer.p, 0.0)
    return weights.kept * (memory + weights.new * a) + weights.old * a


def _power(base, exponent):
    """Power of positive bases. It takes half the time of `**`, which is not vectorised, and adds a few roundings."""
    return jnp.exp(exponent * jnp.log(base))


def residual(u, *rest):
    """u + C F(u) - upper, and its derivative by u."""
    return _curved_residual(u, *rest)[:2]


def _curved_residual(u, upper, u_old, w_old, c, a, hammer, weights, memory):
    """u + C F(u) - upper, and its first and second derivative by u."""
    pressed = jnp.maximum(u, SMALLEST)
    soft = _softness(pressed, hammer)
    exponent = hammer.p * (1 + soft)
    stiff = c * hammer.K_H * _power(_base(pressed, hammer), hammer.p) / pressed
    loss = 1 + hammer.mu * ((u - u_old) / a - w_old)
    if weights is not None:
        loss = loss - hammer.epsilon * weights.new
    by_u = hammer.mu / a * (loss > 0)
    loss = jnp.maximum(loss, 0.0)
    push, slope = stiff * pressed * loss, stiff * (exponent * loss + pressed * by_u)
    curvature = exponent * (exponent - 1) - hammer.p * soft * (1 - soft)
    bend = stiff * (curvature * loss / pressed + 2 * exponent * by_u)
    if weights is not None:
        push = push - c * hammer.K_H * hammer.epsilon * memory
        push, slope, bend = (jnp.where(push > 0, x, 0.0) for x in (push, slope, bend))
    return u - upper + push, 1 + slope, bend


def _guess(upper, u_old, w_old, c, a, hammer):
    """Initial value: u extrapolated; if that is out of range, u if the felt force alone made up `upper`."""
    extrapolated = u_old + 2 * a * w_old
    felt_only = _power(jnp.maximum(upper, jnp.finfo(float).tiny) / (c * hammer.K_H), 1 / hammer.p)
    if isinstance(hammer, SoftHammer):  # that was g
        felt_only = 0.5 * (felt_only + jnp.sqrt(felt_only * (felt_only + 4 * hammer.skin)))
    in_range = (u_old > 0) & (extrapolated > 0) & (extrapolated < upper)
    return jnp.clip(jnp.where(in_range, extrapolated, felt_only), 0.0, upper)


@jax.custom_jvp
def root(upper, u_old, w_old, c, a, hammer, weights, memory):
    """The compression in [0, upper] at which `residual` vanishes."""
    rest = (upper, u_old, w_old, c, a, hammer, weights, memory)
    floor = 4 * jnp.finfo(float).eps * upper
    if weights is not None:  # if the force is a small difference, the terms determine its rounding
        floor = floor + 4 * jnp.finfo(float).eps * c * hammer.K_H * hammer.epsilon * memory

    def is_unfinished(state):
        _, unconverged, iteration = state
        return unconverged & (iteration < MAX_ITERATIONS)

    def iterate(state):
        u, _, iteration = state
        value, slope, bend = _curved_residual(u, *rest)
        curved = iteration < HALLEY
        step = value / slope
        step = step / jnp.where(curved, jnp.clip(1 - 0.5 * step * bend / slope, 0.5, 2.0), 1.0)
        # If the felt is not pressed, a short step may cross the edge of contact: it does not prove convergence.
        converged = (jnp.abs(step) <= jnp.where(curved, TOLERANCE_HALLEY, TOLERANCE_NEWTON) * u) & (slope > 1)
        return jnp.clip(u - step, 0.0, upper), ~converged & (jnp.abs(value) > floor), iteration + 1

    guess = _guess(upper, u_old, w_old, c, a, hammer)
    return jax.lax.while_loop(is_unfinished, iterate, (guess, upper > 0, 0))[0]


@root.defjvp
@derivative
def _root_jvp(rest, tangents):
    # By the implicit function theorem, not through the iterations: du = -(∂R/∂rest · d rest)/(∂R/∂u).
    u = root(*rest)
    (_, slope), (change, _) = jax.jvp(lambda *r: residual(u, *r), rest, tangents)
    return u, -change / slope
