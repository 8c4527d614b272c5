"""A step of any law of the felt without memory, of which only the force is known.

The step's equation is the same for every law, R(u) = u + C F(u, w(u)) - upper = 0, with w = (u - u_old)/a - w_old. Of F
only its value is known here, and its slope by differentiation; all that is asked is that it does not fall as the felt
is pressed, so that R rises. The root then lies in [0, upper] and is found by Newton's steps, halving the bracket
wherever one leaves it or gains less than half.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

from ...felt import law_of
from ..x64 import derivative

__all__ = ["felt_force", "residual", "root"]

# Halving alone would take some 60 to rounding.
MOST_ITERATIONS = 200
# The relative change of u after which the next of Newton's would only change its rounding.
NEAR = 1e-9


def felt_force(u: Array, w: Array, hammer: Any, *_: Any) -> Array:
    """Felt force, N; 0 when apart."""
    pressed = u > 0
    push = law_of(hammer).force(jnp.where(pressed, u, 1.0), w, hammer)
    return jnp.where(pressed, jnp.maximum(push, 0.0), 0.0)


def residual(u, *rest):
    """u + C F(u) - upper, and its derivative by u."""
    return jax.jvp(lambda x: _residual(x, *rest), (u,), (jnp.ones_like(u),))


def _residual(u, upper, u_old, w_old, c, a, hammer, *_):
    return u + c * felt_force(u, (u - u_old) / a - w_old, hammer) - upper


@jax.custom_jvp
def root(upper, u_old, w_old, c, a, hammer, weights=None, memory=None):
    """The compression in [0, upper] at which `residual` vanishes."""
    rest = (upper, u_old, w_old, c, a, hammer, weights, memory)
    floor = 4 * jnp.finfo(float).eps * upper

    def going(state):
        return state[-2] & (state[-1] < MOST_ITERATIONS)

    def iterate(state):
        u, low, high, before, _, iteration = state
        off, slope = residual(u, *rest)
        low, high = jnp.where(off < 0, u, low), jnp.where(off < 0, high, u)
        newton = u - off / slope
        fine = (newton > low) & (newton < high) & (jnp.abs(off) <= 0.5 * before)
        onward = jnp.where(fine, newton, 0.5 * (low + high))
        moving = (jnp.abs(onward - u) > NEAR * u) & (jnp.abs(off) > floor)
        return jnp.where(jnp.abs(off) > floor, onward, u), low, high, jnp.abs(off), moving, iteration + 1

    going_on = u_old + 2 * a * w_old
    guess = jnp.where((going_on > 0) & (going_on < upper), going_on, 0.5 * upper)
    begin = (guess, jnp.zeros_like(upper), upper, jnp.full_like(upper, jnp.inf), upper > 0, 0)
    return jax.lax.while_loop(going, iterate, begin)[0]


@root.defjvp
@derivative
def _root_jvp(rest, tangents):
    # The implicit function theorem, never the iterations: du = -(∂R/∂rest · d rest)/(∂R/∂u).
    u = root(*rest)
    _, slope = residual(u, *rest)
    _, change = jax.jvp(lambda *r: _residual(u, *r), rest, tangents)
    return u, -change / slope
