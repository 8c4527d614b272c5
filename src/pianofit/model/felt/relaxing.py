"""The package's own laws of the felt, as one formula and one equation a step.

    F = K_H [u^p (1 + μ u̇) - ε c], never below 0,     τ ċ = u^p - c

Without μ and ε this is the power law (Ghosh); with μ it is that of Hunt and Crossley, the paper's; with ε that of
Stulov, K_H [u^p - (ε/τ) ∫ u^p exp(-(t - s)/τ) ds], whose felt is as stiff as K_H to a sudden blow and as K_H (1 - ε) to
a slow one. Over a step u^p is taken as linear in time. Then c is a formula at any τ,

    c_n = k c_(n-1) + w0 a_(n-1) + w1 a_n,     a = u^p, 0 when apart,     k = exp(-δt/τ),     k + w0 + w1 = 1

With w_n = (u_n - u_(n-1))/a - w_(n-1) for u̇ (paper eq. 16), and with string and hammer that give way by C per newton of
F_n + F_(n-1), a step is one equation, u + C F(u) = upper. F is convex, and rises wherever it is not 0, since ε w1 < 1:
Newton's iterates fall monotonically onto the root once they are above it, and one step from below takes them there.
Clipped to [0, upper], which holds the root, they always converge. Halley's, which use the curvature too and triple the
digits where Newton's double them, come first: candidates in a batch wait for the slowest, and powers are what costs.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array

from ...felt import RelaxingHammer
from ...parameters import Hammer
from ..x64 import AnyArray, derivative, float64

__all__ = ["Weights", "felt_force", "memory_weights", "update_relaxation", "residual", "root"]

# Newton's iterations; from the worst start (p = 5) each takes a fifth off the error until it turns quadratic.
MOST_ITERATIONS = 200
# Halley's before them; and the relative change of u after which the next would only change its rounding, for both.
HALLEY, NEAR, NEAR_NEWTON = 6, 1e-6, 1e-9
SERIES = 14


class Weights(NamedTuple):
    """k, w0 and w1 of one step of the memory. Each is in (0, 1); their sum is 1."""

    kept: Array
    old: Array
    new: Array


def felt_force(u: Array, w: Array, hammer: Hammer | RelaxingHammer, memory=0.0, share=0.0) -> Array:
    """Felt force, N, at compression `u`, m, and compression speed `w`, m/s (paper eq. 8, with u = y_H - y_s).

    For a felt that remembers, c is `memory`, m^p, and `share` of u^p.
    """
    pressed = jnp.where(u > 0, u, 1.0)
    if not isinstance(hammer, RelaxingHammer):
        return jnp.where(u > 0, hammer.K_H * pressed**hammer.p * jnp.maximum(1 + hammer.mu * w, 0.0), 0.0)
    loss = jnp.maximum(1 + hammer.mu * w - hammer.epsilon * share, 0.0)
    law = hammer.K_H * (pressed**hammer.p * loss - hammer.epsilon * memory)
    return jnp.where((u > 0) & (law > 0), law, 0.0)


@float64
def memory_weights(hammer: Any, step: AnyArray) -> Weights | None:
    """The weights of a step, s, to rounding for any τ; None for a felt without memory."""
    if not isinstance(hammer, RelaxingHammer):
        return None
    s = step / hammer.tau
    near, far = jnp.minimum(s, 0.5), jnp.maximum(s, 0.5)
    # w1 = 1 - (1 - e^-s)/s = s/2 - s²/6 + s³/24 - ..., by Horner's rule.
    series = jnp.zeros_like(near)
    for k in range(SERIES, 1, -1):
        series = (1 - series) * near / k
    lag = -jnp.expm1(-far) / far
    return Weights(
        jnp.exp(-s),
        jnp.where(s < 0.5, -jnp.expm1(-near) - series, lag - jnp.exp(-far)),
        jnp.where(s < 0.5, series, 1 - lag),
    )


def update_relaxation(u: Array, hammer: Any, weights: Weights | None, memory: Any) -> Array | None:
    """What of the memory comes from before the next step: k c_n + w0 a_n, from `u` of this one and its own `memory`."""
    if weights is None:
        return None
    a = jnp.where(u > 0, jnp.where(u > 0, u, 1.0) ** hammer.p, 0.0)
    return weights.kept * (memory + weights.new * a) + weights.old * a


def _power(base, exponent):
    """For positive bases. Half the time of `**`, which the CPU takes one by one, for a few roundings."""
    return jnp.exp(exponent * jnp.log(base))


def residual(u, *rest):
    """u + C F(u) - upper, and its derivative by u."""
    return _curved_residual(u, *rest)[:2]


def _curved_residual(u, upper, u_old, w_old, c, a, hammer, weights, memory):
    """u + C F(u) - upper, and its first and second derivative by u."""
    pressed = jnp.maximum(u, jnp.finfo(float).tiny)
    stiff = c * hammer.K_H * _power(pressed, hammer.p - 1)
    loss = 1 + hammer.mu * ((u - u_old) / a - w_old)
    if weights is not None:
        loss = loss - hammer.epsilon * weights.new
    by_u = hammer.mu / a * (loss > 0)
    loss = jnp.maximum(loss, 0.0)
    push, slope = stiff * pressed * loss, stiff * (hammer.p * loss + pressed * by_u)
    bend = stiff * hammer.p * ((hammer.p - 1) * loss / pressed + 2 * by_u)
    if weights is not None:
        push = push - c * hammer.K_H * hammer.epsilon * memory
        push, slope, bend = (jnp.where(push > 0, x, 0.0) for x in (push, slope, bend))
    return u - upper + push, 1 + slope, bend


def _guess(upper, u_old, w_old, c, a, hammer):
    """From where u was going; where that is nowhere, from where all of `upper` would be the felt's."""
    going = u_old + 2 * a * w_old
    alone = _power(jnp.maximum(upper, jnp.finfo(float).tiny) / (c * hammer.K_H), 1 / hammer.p)
    return jnp.clip(jnp.where((u_old > 0) & (going > 0) & (going < upper), going, alone), 0.0, upper)


@jax.custom_jvp
def root(upper, u_old, w_old, c, a, hammer, weights, memory):
    """The compression in [0, upper] at which `residual` vanishes."""
    rest = (upper, u_old, w_old, c, a, hammer, weights, memory)
    floor = 4 * jnp.finfo(float).eps * upper
    if weights is not None:  # where the force is a small difference, its rounding is that of the terms
        floor = floor + 4 * jnp.finfo(float).eps * c * hammer.K_H * hammer.epsilon * memory

    def going(state):
        _, unsettled, iteration = state
        return unsettled & (iteration < MOST_ITERATIONS)

    def iterate(state):
        u, _, iteration = state
        off, slope, bend = _curved_residual(u, *rest)
        curved = iteration < HALLEY
        step = off / slope
        step = step / jnp.where(curved, jnp.clip(1 - 0.5 * step * bend / slope, 0.5, 2.0), 1.0)
        # Where the felt is not pressed a short step may end beyond its edge, and says nothing.
        near = (jnp.abs(step) <= jnp.where(curved, NEAR, NEAR_NEWTON) * u) & (slope > 1)
        return jnp.clip(u - step, 0.0, upper), ~near & (jnp.abs(off) > floor), iteration + 1

    guess = _guess(upper, u_old, w_old, c, a, hammer)
    return jax.lax.while_loop(going, iterate, (guess, upper > 0, 0))[0]


@root.defjvp
@derivative
def _root_jvp(rest, tangents):
    # The implicit function theorem, never the iterations: du = -(∂R/∂rest · d rest)/(∂R/∂u).
    u = root(*rest)
    (_, slope), (change, _) = jax.jvp(lambda *r: residual(u, *r), rest, tangents)
    return u, -change / slope
