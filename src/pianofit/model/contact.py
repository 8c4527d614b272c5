"""Contact is one scalar equation per step.

The hammer meets the string only through the displacement that past forces left under it. With the kernel `g_n` (the
displacement at the strike, n steps after a unit `T`), Crank-Nicolson for hammer and string together (paper eq. 16) is

    e_n = y_H + 2a v_H - Σ_{m<n} g_{n-m} T_m - free motion        u_n = e_n - C T_n,   C = a²/M_H + g_0
    w_n = (u_n - u_{n-1})/a - w_{n-1}                             F_n = K_H u_n^p (1 + μ w_n), never below 0

`F_n` is a convex, rising function of `u_n`: Newton's iterates fall monotonically onto the root once they are above it,
and one step from below takes them there. Clipped to [0, e_n - C F_{n-1}], which holds the root, they always converge.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ..errors import ParameterError
from ..parameters import Hammer
from .exponentials import BLOCK, real_powers, ring
from .modes import Modes

__all__ = ["FreeMotion", "Pulse", "felt_force", "free_motion", "impulse_amplitude", "kernel", "strike"]

# Newton's iterations; from the worst start (p = 5) each takes a fifth off the error until it turns quadratic.
MOST_ITERATIONS = 200


class Pulse(NamedTuple):
    """What the contact did, step by step from the first touch at n = 0. Units: SI."""

    drive: Float[Array, " steps"]  # T^n = F^n + F^(n-1), N
    force: Float[Array, " steps"]  # F^n, N
    compression: Float[Array, " steps"]  # u^n, m; negative when apart
    hammer: Float[Array, "steps 2"]  # y_H, m, and v_H, m/s
    work: Float[Array, ""]  # what the contact put into the string, J
    over: Bool[Array, ""]  # proven: the hammer cannot catch the string any more


class FreeMotion(NamedTuple):
    """A string that moves by itself: q = Re(amplitude · z^n), y at the strike [steps], and its energy."""

    amplitude: Array  # complex [modes], m
    under_hammer: Float[Array, " steps"]  # m
    speed: Float[Array, ""]  # of the string under the hammer at t = 0, m/s, the scheme's
    energy: Float[Array, ""]  # J


def felt_force(u: Array, w: Array, hammer: Hammer) -> Array:
    """Felt force, N, at compression `u`, m, and compression speed `w`, m/s (paper eq. 8, with u = y_H - y_s)."""
    pressed = jnp.where(u > 0, u, 1.0)
    return jnp.where(u > 0, hammer.K_H * pressed**hammer.p * jnp.maximum(1 + hammer.mu * w, 0.0), 0.0)


def impulse_amplitude(modes: Modes) -> Array:
    """C_k, complex [modes]: a unit `T` at step 0 leaves the mode at q_n = Re(C_k z_k^n), n ≥ 0. m/N."""
    a = modes.step / 2
    v = a * modes.drive / (1 + 2 * a * modes.alpha + a**2 * modes.omega2)
    q = a * v
    return q - 1j * (v + modes.alpha * q) / jnp.sqrt(modes.omega2 - modes.alpha**2)


def kernel(modes: Modes, steps: int) -> Float[Array, " steps"]:
    """g_n, m/N: the displacement under the hammer n steps after a unit `T`."""
    return ring(modes.strike * impulse_amplitude(modes), modes.pole * modes.step, steps)


def free_motion(modes: Modes, displacement: Array, velocity: Array, steps: int) -> FreeMotion:
    """The motion of a string released at t = 0 with modal `displacement`, m, and `velocity`, m/s [modes]."""
    rate = modes.free_rate
    amplitude = displacement - 1j * (velocity - rate.real * displacement) / rate.imag
    under = ring(modes.strike * amplitude, modes.pole * modes.step, steps)
    silent = modes.drive == 0  # at a node of the strike: never meets the hammer
    mass = jnp.where(silent, 0.0, modes.strike / jnp.where(silent, 1.0, modes.drive))
    # The scheme's own velocity, for its own energy: p̃ = (z - 1)/(z + 1)/a.
    z_1 = jnp.expm1(modes.pole * modes.step)
    velocity = (amplitude * z_1 / (2 + z_1)).real * (2 / modes.step)
    energy = 0.5 * (mass * (velocity**2 + modes.omega2 * displacement**2)).sum()
    return FreeMotion(amplitude, under, (modes.strike * velocity).sum(), energy)


def strike(modes: Modes, hammer: Hammer, *, steps: int, free: FreeMotion | None = None) -> Pulse:
    """The hammer on the string from the first touch on, for `steps` steps of the table's own δt.

    The contact may end and begin again. Whether it is over for good is proven, not guessed: after the last step the
    string's displacement under the hammer never exceeds √(2 E S), with E its energy and S its static compliance there,
    so a hammer that moves away and is further off than that cannot touch again.
    """
    if steps % BLOCK:
        raise ParameterError(f"steps={steps} must be a multiple of {BLOCK}")
    under = jnp.zeros(steps) if free is None else free.under_hammer
    drive, force, u, y_hammer, v_hammer = _march(modes, hammer, under, 0.0 if free is None else free.speed)
    y_string = y_hammer - u
    own = y_string - under
    work = 0.5 * (drive[1:] * (own[1:] - own[:-1])).sum()
    reach = _reach(modes, work) + (0.0 if free is None else _reach(modes, free.energy))
    over = (u[-1] <= 0) & (v_hammer[-1] <= 0) & (y_hammer[-1] + reach <= 0)
    return Pulse(drive, force, u, jnp.stack([y_hammer, v_hammer], axis=-1), work, over)


def _reach(modes: Modes, energy: Array) -> Array:
    """The farthest a string of this energy can be from rest under the hammer, m (Cauchy-Schwarz over the modes)."""
    compliance = (modes.strike * modes.drive / modes.omega2).sum()
    return jnp.sqrt(2 * jnp.maximum(energy, 0.0) * compliance)


def _march(modes: Modes, hammer: Hammer, under: Array, speed: Array | float):
    """Step the hammer over the string; see the module's docstring for the symbols.

    The sum over past forces is split: those of the present block are summed with the kernel, step by step; all earlier
    ones have left the modes ringing with complex amplitudes, which give the whole block's history as one matrix product
    that candidates on the same string share. The cost is linear in the steps.
    """
    a = modes.step / 2
    unit = impulse_amplitude(modes)
    log_z = modes.pole * modes.step
    re, im = real_powers(log_z, BLOCK + 1, 1)
    g = kernel(modes, BLOCK)
    own_g = jnp.concatenate([g[:0:-1], jnp.zeros(BLOCK + 1)])
    c = a**2 / hammer.M_H + g[0]

    def block(carry, under):
        ringing, state = carry
        past = (modes.strike * ringing.real) @ re[:, :BLOCK] - (modes.strike * ringing.imag) @ im[:, :BLOCK] + under

        def advance(carry, i):
            recent, (u, w, f, y, v) = carry
            own = (jax.lax.dynamic_slice(own_g, (BLOCK - 1 - i,), (BLOCK,)) * recent).sum()
            e = y + 2 * a * v - past[i] - own
            u_new = _compression(e, u, w, f, c, a, hammer)
            w_new = (u_new - u) / a - w
            f_new = _force(u_new, w_new, e - c * f, c, a, hammer)
            t = f_new + f
            v_new = v - a / hammer.M_H * t
            y_new = y + a * (v + v_new)
            return (recent.at[i].set(t), (u_new, w_new, f_new, y_new, v_new)), (t, f_new, u_new, y_new, v_new)

        (recent, state), outputs = jax.lax.scan(advance, (jnp.zeros(BLOCK), state), jnp.arange(BLOCK))
        # A unit T at step i of this block rings as unit · z^(BLOCK - i) at the next block's start.
        left = unit * (re[:, :0:-1] @ recent + 1j * (im[:, :0:-1] @ recent))
        return (ringing * (re[:, BLOCK] + 1j * im[:, BLOCK]) + left, state), outputs

    zero = jnp.zeros_like(c)
    # y_H(0) = y_s at the strike: the felt touches, uncompressed (paper eq. 7).
    y, v = under[0] + zero, hammer.v_H0 + zero
    # The first block starts at step 1, with nothing ringing yet.
    shifted = jnp.append(under[1:], 0.0).reshape(-1, BLOCK)
    _, rest = jax.lax.scan(block, (jnp.zeros_like(unit), (zero, v - speed, zero, y, v)), shifted)
    first = (zero, zero, zero, y, v)
    return tuple(jnp.concatenate([x[None], r.ravel()[:-1]]) for x, r in zip(first, rest, strict=True))


def _compression(e, u_old, w_old, f_old, c, a, hammer: Hammer):
    """The root u of u + C (F(u) + F_old) = e."""
    upper = e - c * f_old
    return jnp.where(upper > 0, _root(jnp.maximum(upper, 0.0), u_old, w_old, c, a, *hammer[:3]), upper)


def _force(u, w, upper, c, a, hammer: Hammer):
    """F_n: by the felt's law, or by what it does to string and hammer, whichever magnifies the rounding of u less."""
    law = felt_force(u, w, hammer)
    _, slope = _residual(u, upper, u - a * w, 0.0, c, a, *hammer[:3])
    return jnp.where((law > 0) & (slope > 2), (upper - u) / c, law)


def _residual(u, upper, u_old, w_old, c, a, stiffness, mu, p):
    """u + C F(u) - upper, and its derivative by u."""
    pressed = jnp.maximum(u, jnp.finfo(float).tiny)
    stiff = c * stiffness * pressed ** (p - 1)
    loss = jnp.maximum(1 + mu * ((u - u_old) / a - w_old), 0.0)
    slope = 1 + stiff * (p * loss + pressed * mu / a * (loss > 0))
    return u - upper + stiff * pressed * loss, slope


@jax.custom_jvp
def _root(upper, u_old, w_old, c, a, stiffness, mu, p):
    """The compression in [0, upper] at which `_residual` vanishes."""
    rest = (upper, u_old, w_old, c, a, stiffness, mu, p)
    floor = 4 * jnp.finfo(float).eps * upper

    def going(state):
        _, residual, iteration = state
        return (upper > 0) & (jnp.abs(residual) > floor) & (iteration < MOST_ITERATIONS)

    def iterate(state):
        u, _, iteration = state
        residual, slope = _residual(u, *rest)
        return jnp.clip(u - residual / slope, 0.0, upper), residual, iteration + 1

    guess = jnp.clip(u_old + 2 * a * w_old, 0.0, upper)
    return jax.lax.while_loop(going, iterate, (guess, jnp.full_like(upper, jnp.inf), 0))[0]


@_root.defjvp
def _root_jvp(rest, tangents):
    # The implicit function theorem, never the iterations: du = -(∂R/∂rest · d rest)/(∂R/∂u).
    u = _root(*rest)
    (_, slope), (change, _) = jax.jvp(lambda *r: _residual(u, *r), rest, tangents)
    return u, -change / slope
