"""Contact is one scalar equation per step.

The hammer meets the string only through the displacement that past forces left under it. With the kernel `g_n` (the
displacement at the strike, n steps after a unit `T`), Crank-Nicolson for hammer and string together (paper eq. 16) is

    e_n = y_H + 2a v_H - Σ_{m<n} g_{n-m} T_m - free motion        u_n = e_n - C T_n,   C = a²/M_H + g_0
    w_n = (u_n - u_{n-1})/a - w_{n-1}                             F_n = F(u_n, w_n)

with the law of `felt` for F: a convex, rising function of `u_n`.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.core import Tracer
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, Bool, Complex, Float

from ..errors import ParameterError
from ..io.number_format import summary
from ..parameters import HAMMER_NAMES
from .damped_sums import BLOCK, real_powers, ring
from .felt import compression, force, memory_weights, update_relaxation
from .modes import Modes
from .x64 import AnyArray, derivative, float64

__all__ = [
    "FreeMotion",
    "Pulse",
    "PostContactState",
    "strike_moving_string",
    "free_motion",
    "impulse_amplitude",
    "kernel",
    "kernel_rows",
    "strike_final_state",
    "strike",
]


class Pulse(NamedTuple):
    """What the contact did, step by step from the first touch at n = 0. Units: SI."""

    drive: Float[Array, " steps"]  # T^n = F^n + F^(n-1), N
    force: Float[Array, " steps"]  # F^n, N
    compression: Float[Array, " steps"]  # u^n, m; negative when apart
    hammer: Float[Array, "steps 2"]  # y_H, m, and v_H, m/s
    work: Float[Array, ""]  # what the contact put into the string, J
    over: Bool[Array, ""]  # proven: the hammer cannot catch the string any more

    def __repr__(self) -> str:
        return summary(self)


class PostContactState(NamedTuple):
    """What a contact left behind, `steps` steps after the first touch."""

    amplitude: Complex[Array, " modes"]  # of every mode, m: q_n = Re(amplitude · z^(n - steps)) from then on
    steps: Array
    separated: Bool[Array, ""]  # whether hammer and string are apart by then


class FreeMotion(NamedTuple):
    """A string that moves by itself: q = Re(amplitude · z^n), with its speed and energy."""

    amplitude: Complex[Array, " modes"]  # m
    speed: Float[Array, ""]  # of the string under the hammer at t = 0, m/s, the scheme's
    energy: Float[Array, ""]  # J

    def __repr__(self) -> str:
        return summary(self)


@float64
def impulse_amplitude(modes: Modes) -> Complex[Array, " modes"]:
    """C_k: a unit `T` at step 0 leaves the mode at q_n = Re(C_k z_k^n), n ≥ 0. m/N."""
    a = modes.step / 2
    v = a * modes.modal_gain / (1 + 2 * a * modes.alpha + a**2 * modes.omega2)
    q = a * v
    return q - 1j * (v + modes.alpha * q) / jnp.sqrt(modes.omega2 - modes.alpha**2)


@float64
def kernel(modes: Modes, steps: int) -> Float[Array, " steps"]:
    """g_n, m/N: the displacement under the hammer n steps after a unit `T`."""
    return ring(modes.strike * impulse_amplitude(modes), modes.pole * modes.step, steps)


@float64
def kernel_rows(modes: Modes, steps: int) -> Float[Array, "32 steps"]:
    """g once more, m/N, a row for each step of a block: what a unit `T` there leaves from the next block on."""
    g = kernel(modes, BLOCK + steps)
    return jnp.stack([g[BLOCK - i : BLOCK - i + steps] for i in range(BLOCK)])


@float64
def free_motion(
    modes: Modes, displacement: Float[AnyArray, " modes"], velocity: Float[AnyArray, " modes"]
) -> FreeMotion:
    """The motion of a string released at t = 0 with modal `displacement`, m, and `velocity`, m/s [modes]."""
    rate = modes.free_rate
    amplitude = displacement - 1j * (velocity - rate.real * displacement) / rate.imag
    silent = modes.modal_gain == 0  # at a node of the strike: never meets the hammer
    mass = jnp.where(silent, 0.0, modes.strike / jnp.where(silent, 1.0, modes.modal_gain))
    # The scheme's own velocity, for its own energy: p̃ = (z - 1)/(z + 1)/a.
    z_1 = jnp.expm1(modes.pole * modes.step)
    velocity = (amplitude * z_1 / (2 + z_1)).real * (2 / modes.step)
    energy = 0.5 * (mass * (velocity**2 + modes.omega2 * displacement**2)).sum()
    return FreeMotion(jnp.asarray(amplitude), (modes.strike * velocity).sum(), energy)


@float64
def strike(
    modes: Modes, hammer: Any, *, steps: int, free: FreeMotion | None = None,
    rows: AnyArray | None = None, whole: bool = True,
) -> Pulse:  # fmt: skip
    """The hammer on the string from the first contact on, for `steps` steps of the table's own δt.

    The contact may end and begin again. Whether it is over for good is proven, not guessed: after the last step the
    string's displacement under the hammer never exceeds √(2 E S), with E its energy and S its static compliance there,
    so a hammer that moves away and is further off than that cannot touch again.

    Parameters
    ----------
    modes : the table, see `mode_table`. Its rate sets the step's error, of second order: 88,200 Hz leaves 1e-3.
    hammer : a `Hammer`, K_H, mu, p, M_H, v_H0 in SI units; a `RelaxingHammer`, or a hammer of a `FeltLaw`.
    steps : how long to follow the hammer; a multiple of 32. Contacts last 1 to 8 ms: 1024 steps at 88,200 Hz suit the
        middle, the bass needs more. What it costs is linear in steps and in modes.
    free : motion of a string that already sounds, see `pluck`; at rest by default.
    rows : the string's `kernel_rows`, where many hammers share a string and it has no derivatives: in place of the
        modes, of which there are more than steps, they then carry the past.
    whole : refuse a pulse that is cut off. Under `jit`, `vmap` or `grad` nothing can be refused: look at `over`.

    Returns
    -------
    `drive`, N, for `spectrum`, `levels` and `waveform`; `force`, N, and `compression`, m [steps]; `hammer`, position
    and velocity [steps, 2]; `work`, J; `over`, whether the contact is proven to be over.

    Raises
    ------
    ParameterError
        If `steps` is no multiple of 32, or too few, and where it is traced in float32 (`precision`).

    Examples
    --------
    >>> import pianofit
    >>> it = pianofit.preset("bensa-final")
    >>> modes = pianofit.mode_table(it.string, it.geometry, rate=88_200.0, n_modes=64)
    >>> pulse = pianofit.strike(modes, it.hammer, steps=1024)
    >>> f"{pulse.force.max():.1f} N, {pianofit.levels(modes, pulse.drive)[0]:.0f} dB"
    '3.8 N, -21 dB'
    """
    if steps % BLOCK:
        raise ParameterError(f"steps={steps} must be a multiple of {BLOCK}")
    if free is None:
        under, speed, energy = jnp.zeros(steps), 0.0, ()
    else:
        under = ring(modes.strike * free.amplitude, modes.pole * modes.step, steps)
        speed, energy = free.speed, (free.energy,)
    drive, force, u, y_hammer, v_hammer = _march(modes, hammer, under, speed, rows)
    own = y_hammer - u - under
    work = 0.5 * (drive[1:] * (own[1:] - own[:-1])).sum()
    over = _cannot_return(modes, u[-1], y_hammer[-1], v_hammer[-1], work, *energy)
    if whole and not isinstance(over, Tracer) and not over:
        after = f"steps={steps}: the contact is not proven to be over after {float(steps * modes.step):.2g} s"
        given = hammer._asdict()
        wrong = [f"{name}={given[name]:g}" for name in HAMMER_NAMES if name in given and not given[name] >= 0]
        raise ParameterError(f"{after}; " + (f"no hammer has {', '.join(wrong)}" if wrong else "give more"))
    return Pulse(drive, force, u, jnp.stack([y_hammer, v_hammer], axis=-1), work, over)


@float64
def strike_final_state(modes: Modes, hammer: Any, *, steps: int | AnyArray) -> PostContactState:
    """What `strike` leaves in the modes of a string at rest, marching only until the contact is proven to be over.

    Parameters
    ----------
    steps : the march ends here whether or not it is over; a multiple of 32, which may be traced: it costs no program.
    """
    if not isinstance(steps, Tracer) and steps % BLOCK:
        raise ParameterError(f"steps={steps} must be a multiple of {BLOCK}")
    zero = jnp.zeros_like(modes.step)
    rest = FreeMotion(jnp.zeros_like(modes.pole), zero, zero)
    count, ((real, imag), _), apart, *_ = _until_over(modes, hammer, rest, steps)
    return PostContactState(real + 1j * imag, jnp.asarray(count * BLOCK + 1), apart)


@float64
def strike_moving_string(
    modes: Modes, hammer: Any, displacement: Float[AnyArray, " modes"], velocity: Float[AnyArray, " modes"],
    powers: tuple[AnyArray, AnyArray], steps: int,
) -> tuple[Float[Array, " steps"], Float[Array, " steps"], Bool[Array, ""]]:  # fmt: skip
    """The contact of a hammer with a string that moves, marching only until it is proven to be over.

    What the string does by itself is carried by its modes, with what past forces left: it costs nothing.

    Parameters
    ----------
    displacement, velocity : of the modes at the first touch, m and m/s [modes].
    powers : real and imaginary parts of z^n, n ≤ 32 [modes, 33], which all strokes on a string share.
    steps : at the most; a multiple of 32.

    Returns
    -------
    `drive` and `force`, N [steps], nought after the end, and whether that is proven to be one.
    """
    free = free_motion(modes, displacement, velocity)
    *_, (drive, force), over = _until_over(modes, hammer, free, steps, powers, (jnp.zeros(steps + 1),) * 2)
    return drive[:-1], force[:-1], over


def _until_over(
    modes: Modes, hammer: Any, free: FreeMotion, steps: int | AnyArray,
    powers: tuple[AnyArray, AnyArray] | None = None, kept: tuple[Array, ...] = (),
):  # fmt: skip
    """Block after block until the contact is proven to be over: how many, state, whether apart, what is kept, over.

    Parameters
    ----------
    kept : where drive and force are written to, N [steps + 1]; nothing is kept without.
    """
    under = (modes.strike * free.amplitude.real).sum()
    block, first = _blocks(modes, hammer, under, free.speed, None, powers)
    turned = free.amplitude * jnp.exp(modes.pole * modes.step)

    def going(now):
        return (now[0] < steps // BLOCK) & ~now[-1]

    def onward(now):
        count, carry, _, before, energy, kept, _ = now
        carry, (*outputs, u, y, v) = block(carry, jnp.zeros(BLOCK))
        string = y - u
        energy = energy + 0.5 * (outputs[0] * (string - jnp.append(before, string[:-1]))).sum()
        at = (1 + count * BLOCK,)
        kept = tuple(jax.lax.dynamic_update_slice(*x, at) for x in zip(kept, outputs, strict=False))
        return (
            count + 1,
            carry,
            u[-1] <= 0,
            string[-1],
            energy,
            kept,
            _cannot_return(modes, u[-1], y[-1], v[-1], energy),
        )

    no = jnp.asarray(False)
    begin = (0, ((turned.real, turned.imag), first), no, under, free.energy, kept, no)
    count, carry, apart, _, _, kept, over = jax.lax.while_loop(going, onward, begin)
    return count, carry, apart, kept, over


def _cannot_return(modes: Modes, u: Array, y_hammer: Array, v_hammer: Array, *energies: AnyArray) -> Array:
    """Whether the hammer moves away, further off than a string of these energies can follow."""
    reach = sum(_max_displacement(modes, energy) for energy in energies)
    return (u <= 0) & (v_hammer <= 0) & (y_hammer + reach <= 0)


def _max_displacement(modes: Modes, energy: AnyArray) -> Array:
    """The farthest a string of this energy can be from rest under the hammer, m (Cauchy-Schwarz over the modes)."""
    compliance = (modes.strike * modes.modal_gain / modes.omega2).sum()
    return jnp.sqrt(2 * jnp.maximum(energy, 0.0) * compliance)


def _blocks(
    modes: Modes, hammer: Any, y_string: AnyArray, speed: AnyArray | float, rows: AnyArray | None,
    given: tuple[AnyArray, AnyArray] | None = None,
):  # fmt: skip
    """A function that steps the hammer over a block of steps, and the state it begins with; symbols as at the top.

    The sum over past forces is split: those of the present block are summed with the kernel, step by step; all earlier
    ones have left the modes ringing with complex amplitudes, which give the whole block's history as one matrix product
    that candidates on the same string share. The cost is linear in the steps. With `rows` what is carried is instead
    the displacement to come.

    Parameters
    ----------
    y_string, speed : of the string under the hammer at the first touch, m and m/s.
    given : `real_powers` of the modes, where they are there already.
    """
    a = modes.step / 2
    unit = impulse_amplitude(modes)
    log_z = modes.pole * modes.step
    powers = (log_z, *(real_powers(log_z, BLOCK + 1, 1) if given is None else given))
    turn = jnp.exp(BLOCK * log_z)
    over_block, unit = (turn.real, turn.imag), (unit.real, unit.imag)
    g = _history(modes.strike * unit[0], modes.strike * unit[1], powers)
    own_g = jnp.concatenate([g[:0:-1], jnp.zeros(BLOCK + 1)])
    c = a**2 / hammer.M_H + g[0]
    weights = memory_weights(hammer, modes.step)

    def block(carry, under):
        earlier, state = carry
        if rows is None:
            past = under + _history(modes.strike * earlier[0], modes.strike * earlier[1], powers)
        else:
            past = under + earlier[:BLOCK]

        def advance(carry, i):
            recent, (u, w, f, y, v, memory) = carry
            own = (jax.lax.dynamic_slice(own_g, (BLOCK - 1 - i,), (BLOCK,)) * recent).sum()
            e = y + 2 * a * v - past[i] - own
            u_new = compression(e, u, w, f, c, a, hammer, weights, memory)
            w_new = (u_new - u) / a - w
            f_new = force(u_new, w_new, e - c * f, c, a, hammer, weights, memory)
            memory = update_relaxation(u_new, hammer, weights, memory)
            t = f_new + f
            v_new = v - a / hammer.M_H * t
            y_new = y + a * (v + v_new)
            return (recent.at[i].set(t), (u_new, w_new, f_new, y_new, v_new, memory)), (t, f_new, u_new, y_new, v_new)

        (recent, state), outputs = jax.lax.scan(advance, (jnp.zeros(BLOCK), state), jnp.arange(BLOCK))
        if rows is None:
            turned, left = _product(earlier, over_block), _product(unit, _left(recent, powers))
            return ((turned[0] + left[0], turned[1] + left[1]), state), outputs
        return (jnp.append(earlier[BLOCK:], jnp.zeros(BLOCK)) + recent @ rows, state), outputs

    zero = jnp.zeros_like(c)
    # y_H(0) = y_s at the strike: the felt touches, uncompressed (paper eq. 7).
    y, v = y_string + zero, hammer.v_H0 + zero
    return block, (zero, v - speed, zero, y, v, None if weights is None else zero)


def _march(modes: Modes, hammer: Any, under: Float[AnyArray, " steps"], speed: AnyArray | float, rows: AnyArray | None):
    """Step the hammer over the string as long as `under` [steps]: drive, force, u, y_H and v_H [steps]."""
    block, state = _blocks(modes, hammer, under[0], speed, rows)
    # The first block starts at step 1, with nothing ringing yet.
    shifted = jnp.append(under[1:], 0.0).reshape(-1, BLOCK)
    earlier = (jnp.zeros_like(modes.alpha),) * 2 if rows is None else jnp.zeros_like(under)
    _, rest = jax.lax.scan(block, (earlier, state), shifted)
    zero = state[0]
    first = (zero, zero, zero, state[3], state[4])
    return tuple(jnp.concatenate([x[None], r.ravel()[:-1]]) for x, r in zip(first, rest, strict=True))


def _product(a, b):
    """Of two complex numbers as pairs of real ones, which a CPU multiplies several times as fast."""
    return a[0] * b[0] - a[1] * b[1], a[0] * b[1] + a[1] * b[0]


@jax.custom_jvp
def _history(real, imag, powers):
    """Σ_k Re(A_k z_k^n), n < BLOCK, m, of the real and imaginary parts of A [modes]."""
    _, re, im = powers
    return real @ re[:, :BLOCK] - imag @ im[:, :BLOCK]


def _history_jvp(given, tangents):
    # log z answers for its powers: z^n moves by n z^n d(log z), and no power is carried along every direction.
    (*amplitude, powers), (*d_amplitude, (d_log_z, _, _)) = given, tangents
    moved = _history(*map(_filled, d_amplitude), powers)
    if type(d_log_z) is not SymbolicZero:
        moved += jnp.arange(BLOCK) * _history(*_product(amplitude, (d_log_z.real, d_log_z.imag)), powers)
    return _history(*amplitude, powers), moved


@jax.custom_jvp
def _left(drive, powers):
    """Σ_i z_k^(BLOCK - i) T_i, real and imaginary [modes], N: how far a unit T at step i has turned by the next."""
    _, re, im = powers
    return drive @ re[:, :0:-1].T, drive @ im[:, :0:-1].T


def _left_jvp(given, tangents):
    (drive, powers), (d_drive, (d_log_z, _, _)) = given, tangents
    real, imag = _left(_filled(d_drive), powers)
    if type(d_log_z) is not SymbolicZero:
        turned = _product((d_log_z.real, d_log_z.imag), _left(jnp.arange(BLOCK, 0, -1) * drive, powers))
        real, imag = real + turned[0], imag + turned[1]
    return _left(drive, powers), (real, imag)


# Where the string is held its powers do not move, and zeros need no products.
_history.defjvp(derivative(_history_jvp), symbolic_zeros=True)
_left.defjvp(derivative(_left_jvp), symbolic_zeros=True)


def _filled(tangent: Any) -> Any:
    return jnp.zeros(tangent.shape) if type(tangent) is SymbolicZero else tangent
