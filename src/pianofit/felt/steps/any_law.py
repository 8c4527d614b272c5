"""One step of a felt law that is given by its force alone and does not relax, and the test of its passivity.

The equation of the step is the same for every law, R(u) = u + C F(u, w(u)) - upper = 0, with w = (u - u_old)/a - w_old.
Only the value of F is given, and its slope follows by differentiation. F must not fall as u rises, so R rises. The root
then lies in [0, upper]. Newton's iterations find it; the bracket is bisected if one leaves it or gains less than half.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ...errors import ParameterError
from ...x64 import derivative, float64

# Limit of iterations: bisection alone takes some 60 to rounding.
MAX_ITERATIONS = 200
# Relative change of u after which the next Newton iteration would only change rounding.
TOLERANCE = 1e-9
# Points at which passivity is tested: compressions, m, and their speeds, m/s. The same tolerance is for rounding.
TESTED_U = np.geomspace(1e-6, 2e-3, 25)
TESTED_W = np.array([-5.0, -1.0, -0.2, 0.2, 1.0, 5.0])


def felt_force(u: Array, w: Array, hammer: Any, *_: Any) -> Array:
    """Felt force, N; 0 without contact."""
    push = hammer.law.force(jnp.where(u > 0, u, 1.0), w, hammer)
    return jnp.where(u > 0, jnp.maximum(push, 0.0), 0.0)


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


@float64
def check_passive(hammer: Any) -> None:
    """Reject a hammer whose felt returns more energy than the storage function of its law allows."""
    u, w = (jnp.asarray(x.ravel()) for x in np.meshgrid(TESTED_U, TESTED_W))
    stored = jax.vmap(jax.grad(lambda x: jnp.asarray(hammer.law.storage(x, hammer), float)))(u)
    push = felt_force(u, w, hammer)
    excess = np.asarray((stored - push) * w)
    worst = int(np.argmax(excess))
    if excess[worst] > TOLERANCE * float(abs(push[worst] * w[worst])):
        raise ParameterError(
            f"felt law {hammer.law.name}: at u={float(u[worst]):.2g} m and u̇={float(w[worst]):g} m/s the felt returns "
            "more energy than it stores; the force must not be below the slope of storage during compression, "
            "and not above it during release"
        )
