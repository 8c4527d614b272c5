"""One step of a felt law that is given by its force alone and does not relax.

The equation of the step is the same for every law, R(u) = u + C F(u, w(u)) - upper = 0, with w = (u - u_old)/a - w_old.
Only the value of F is given, and its slope follows by differentiation. F must not fall as u rises, so R rises. The root
then lies in [0, upper]. Newton's iterations find it; the bracket is bisected if one leaves it or gains less than half.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

from ...felt import law_of
from ..x64 import derivative

__all__ = ["felt_force", "residual", "root"]

# Limit of iterations: bisection alone takes some 60 to rounding.
MAX_ITERATIONS = 200
# Relative change of u after which the next Newton iteration would only change rounding.
TOLERANCE = 1e-9


def felt_force(u: Array, w: Array, hammer: Any, *_: Any) -> Array:
    """Felt force, N; 0 without contact."""
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

    def is_unfinished(state):
        return state[-2] & (state[-1] < MAX_ITERATIONS)

    def iterate(state):
        u, low, high, previous, _, iteration = state
        value, slope = residual(u, *rest)
        low, high = jnp.where(value < 0, u, low), jnp.where(value < 0, high, u)
        newton = u - value / slope
        accepted = (newton > low) & (newton < high) & (jnp.abs(value) <= 0.5 * previous)
        u_next = jnp.where(accepted, newton, 0.5 * (low + high))
        unconverged = (jnp.abs(u_next - u) > TOLERANCE * u) & (jnp.abs(value) > floor)
        return jnp.where(jnp.abs(value) > floor, u_next, u), low, high, jnp.abs(value), unconverged, iteration + 1

    extrapolated = u_old + 2 * a * w_old
    guess = jnp.where((extrapolated > 0) & (extrapolated < upper), extrapolated, 0.5 * upper)
    initial = (guess, jnp.zeros_like(upper), upper, jnp.full_like(upper, jnp.inf), upper > 0, 0)
    return jax.lax.while_loop(is_unfinished, iterate, initial)[0]


@root.defjvp
@derivative
def _root_jvp(rest, tangents):
    # By the implicit function theorem, not through the iterations: du = -(∂R/∂rest · d rest)/(∂R/∂u).
    u = root(*rest)
    _, slope = residual(u, *rest)
    _, change = jax.jvp(lambda *r: _residual(u, *r), rest, tangents)
    return u, -change / slope
