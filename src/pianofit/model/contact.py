"""Contact is one scalar equation per step.

The string acts on the hammer only through the displacement that past forces left under it. The kernel `g_n` is the
displacement at the strike position, n steps after a unit `T`. Crank-Nicolson for hammer and string together (paper
eq. 16) is

    e_n = y_H + 2a v_H - Σ_{m<n} g_{n-m} T_m - free motion        u_n = e_n - C T_n,   C = a²/M_H + g_0
    w_n = (u_n - u_{n-1})/a - w_{n-1}                             F_n = F(u_n, w_n)

where F is the felt law (`felt.steps`), a convex function that rises with `u_n`.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.core import Tracer
from jaxtyping import Array, Bool, Float

from ..errors import ParameterError
from ..felt.steps import compression, force, memory_weights, update_relaxation
from ..io.number_format import summary
from ..parameters import HAMMER_NAMES
from ..x64 import AnyArray, float64
from .differentiable_sums import BLOCK, real_powers, sum_damped_exponentials
from .free_motion import FreeMotion, free_motion
from .modes import ComplexModes, Modes, RealModesLike
from .past_forces import advance_drive, displacement_of_modes, product


class Pulse(NamedTuple):
    """Force and motion during the contact, step by step from the first touch at n = 0. Units: SI."""

    drive: Float[Array, " steps"]  # T^n = F^n + F^(n-1), N
    force: Float[Array, " steps"]  # F^n, N
    compression: Float[Array, " steps"]  # u^n, m; negative when apart
    hammer: Float[Array, "steps 2"]  # y_H, m, and v_H, m/s
    work: Float[Array, ""]  # energy that the contact transferred to the string, J
    contact_ended: Bool[Array, ""]  # proven: the hammer cannot touch the string again

    def __repr__(self) -> str:
        return summary(self)


@float64
def impulse_amplitude(modes: Modes) -> ComplexModes:
    """C_k, m/N: after a unit `T` at step 0 the mode moves as q_n = Re(C_k z_k^n), n ≥ 0."""
    a = modes.step / 2
    v = a * modes.modal_gain / (1 + 2 * a * modes.alpha + a**2 * modes.omega2)
    q = a * v
    return q - 1j * (v + modes.alpha * q) / jnp.sqrt(modes.omega2 - modes.alpha**2)


@float64
def kernel(modes: Modes, steps: int) -> Float[Array, " steps"]:
    """g_n, m/N: the displacement under the hammer n steps after a unit `T`."""
    return sum_damped_exponentials(modes.strike * impulse_amplitude(modes), modes.pole * modes.step, steps)


@float64
def kernel_rows(modes: Modes, steps: int) -> Float[Array, "32 steps"]:
    """Displacement under the hammer from the next block on, after a unit `T` at each step of a block, m/N."""
    g = kernel(modes, BLOCK + steps)
    return jnp.stack([g[BLOCK - i : BLOCK - i + steps] for i in range(BLOCK)])


@float64
def strike(
    modes: Modes,
    hammer: Any,
    *,
    steps: int,
    free: FreeMotion | None = None,
    rows: AnyArray | None = None,
    whole: bool = True,
) -> Pulse:
    """Simulate the contact of hammer and string for `steps` steps δt of the table.

    The contact may end and begin again. The function proves its end: after the last step the string's displacement
    under the hammer cannot exceed √(2 E S), with its energy E and its static compliance S there. A hammer that moves
    away and is farther off than that cannot touch the string again.

    Parameters
    ----------
    modes : the table, see `mode_table`. The error is of second order in its step: at 88,200 Hz it is 1e-3.
    hammer : a `Hammer`, K_H, mu, p, M_H, v_H0 in SI units; a `SoftHammer`, a `RelaxingHammer`, or a hammer of a
        `FeltLaw`.
    steps : number of steps; a multiple of 32. Contacts last 1 to 8 ms: 1024 steps at 88,200 Hz suit the middle
        register, the bass needs more. The cost is linear in steps and in modes.
    free : motion of a string that already sounds, see `pluck`; at rest by default.
    rows : `kernel_rows` of the string, for many hammers on one string without derivatives by it. They then carry the
        response to past forces in place of the modes, which are more numerous than the steps.
    whole : reject a pulse that is cut off. Under `jit`, `vmap` or `grad` this is not possible: check `contact_ended`.

    Returns
    -------
    A pulse: `drive`, N, for `spectrum`, `levels` and `waveform`; `force`, N, and `compression`, m [steps]; `hammer`,
    m and m/s [steps, 2]; `work`, J; `contact_ended`, true if the contact is proven to be over.

    Raises
    ------
    ParameterError
        If `steps` is not a multiple of 32 or is too small, and if traced in float32 (`x64`).

    Examples
    --------
    >>> import pianofit
    >>> it = pianofit.preset("bensa-final")
    >>> modes = pianofit.mode_table(it.string, it.geometry, rate=88_200.0, n_modes=64)
    >>> pulse = pianofit.strike(modes, it.hammer, steps=1024)
    >>> f"{pulse.force.max():.1f} N, {pianofit.levels(modes, pulse.drive)[0]:.0f} dB"
    '3.8 N, -21 dB'
    """
    if "M_H" not in hammer._fields:
        raise ParameterError(f"hammer={summary(hammer)} has no contact with the string; use simulate")
    if steps % BLOCK:
        raise ParameterError(f"steps={steps} must be a multiple of {BLOCK}")
    if free is None:
        under, speed, energy = jnp.zeros(steps), 0.0, ()
    else:
        under = sum_damped_exponentials(modes.strike * free.amplitude, modes.pole * modes.step, steps)
        speed, energy = free.speed, (free.energy,)
    drive, force, u, y_hammer, v_hammer = _march(modes, hammer, under, speed, rows)
    driven = y_hammer - u - under
    work = 0.5 * (drive[1:] * (driven[1:] - driven[:-1])).sum()
    over = _cannot_return(modes, u[-1], y_hammer[-1], v_hammer[-1], work, *energy)
    if whole and not isinstance(over, Tracer) and not over:
        problem = f"steps={steps}: the contact is not proven to be over after {float(steps * modes.step):.2g} s"
        values = hammer._asdict()
        invalid = [f"{name}={values[name]:g}" for name in HAMMER_NAMES if name in values and not values[name] >= 0]
        hint = f"{', '.join(invalid)} must be 0 or more" if invalid else "use more steps"
        raise ParameterError(f"{problem}; {hint}")
    return Pulse(drive, force, u, jnp.stack([y_hammer, v_hammer], axis=-1), work, over)


@float64
def strike_final_state(
    modes: Modes, hammer: Any, *, steps: int | AnyArray
) -> tuple[ComplexModes, Array, Bool[Array, ""]]:
    """Strike a string at rest; the strike stops once the contact is proven over.

    Parameters
    ----------
    steps : largest number of steps, a multiple of 32. It may be traced, so another number needs no new program.

    Returns
    -------
    C_k, m, with which each mode moves as q_n = Re(C_k z_k^(n - N)) afterwards; the number N of computed steps; and
    true if hammer and string are apart after these.
    """
    zero = jnp.zeros_like(modes.step)
    at_rest = FreeMotion(jnp.zeros_like(modes.pole), zero, zero)
    count, ((real, imag), _), separated, *_ = _until_over(modes, hammer, at_rest, steps)
    return real + 1j * imag, jnp.asarray(count * BLOCK + 1), separated


@float64
def strike_until_over(modes: Modes, hammer: Any, *, steps: int, batch: str) -> tuple[Pulse, Array]:
    """Return the pulse of a strike on a string at rest; it stops once the contact is proven over.

    Parameters
    ----------
    steps : largest number of steps, a multiple of 32.
    batch : name of the axis of `jax.vmap`. All strokes stop together, after the longest contact. Otherwise each would
        copy its arrays in every block until then.

    Returns
    -------
    The pulse [steps], and the number of computed steps; later ones are zero.
    """
    zero = jnp.zeros_like(modes.step)
    at_rest = FreeMotion(jnp.zeros_like(modes.pole), zero, zero)
    outputs = (*(jnp.zeros(steps + 1),) * 4, jnp.zeros(steps + 1).at[0].set(hammer.v_H0))
    count, _, _, outputs, work, over = _until_over(modes, hammer, at_rest, steps, None, outputs, batch)
    drive, force, u, y, v = (x[:-1] for x in outputs)
    return Pulse(drive, force, u, jnp.stack([y, v], axis=-1), work, over), jnp.asarray(count * BLOCK)


@float64
def strike_moving_string(
    modes: Modes,
    hammer: Any,
    displacement: RealModesLike,
    velocity: RealModesLike,
    powers: tuple[AnyArray, AnyArray],
    steps: int,
) -> tuple[Float[Array, " steps"], Float[Array, " steps"], Bool[Array, ""]]:
    """Simulate the contact of a hammer with a moving string; it stops once the contact is proven over.

    The modes carry the free motion together with the response to past forces, at no extra cost.

    Parameters
    ----------
    displacement, velocity : state of the modes at the first touch, m and m/s [modes].
    powers : real and imaginary parts of z^n, n ≤ 32 [modes, 33], shared by all strokes on a string.
    steps : largest number of steps; a multiple of 32.

    Returns
    -------
    `drive` and `force`, N [steps], zero after the end, and true if the contact is proven to be over.
    """
    free = free_motion(modes, displacement, velocity)
    *_, (drive, force), _, over = _until_over(modes, hammer, free, steps, powers, (jnp.zeros(steps + 1),) * 2)
    return drive[:-1], force[:-1], over


def _until_over(
    modes: Modes,
    hammer: Any,
    free: FreeMotion,
    steps: int | AnyArray,
    powers=None,
    outputs=(),
    batch: str | None = None,
):
    """Step block by block until the contact is proven to be over.

    Parameters
    ----------
    outputs : arrays that receive drive and force, N, compression, m, and the hammer's position, m, and velocity, m/s
        [steps + 1], as many of these as given.
    batch : see `strike_until_over`.

    Returns
    -------
    The number of blocks, the state, whether hammer and string are apart, the `outputs`, the energy that the string has
    received, J, and whether contact is over.
    """
    under = (modes.strike * free.amplitude.real).sum()
    block, first = _blocks(modes, hammer, under, free.speed, None, powers)
    advanced = free.amplitude * jnp.exp(modes.pole * modes.step)

    def is_unfinished(state):
        unfinished = (state[0] < steps // BLOCK) & ~state[-1]
        return unfinished if batch is None else jax.lax.pmax(unfinished.astype(int), batch) > 0

    def advance_block(state):
        count, carry, _, outputs, previous, energy, _ = state
        carry, new = block(carry, jnp.zeros(BLOCK))
        string, at = new.y - new.u, (1 + count * BLOCK,)
        energy = energy + 0.5 * (new.drive * (string - jnp.append(previous, string[:-1]))).sum()
        outputs = tuple(jax.lax.dynamic_update_slice(*x, at) for x in zip(outputs, new, strict=False))
        over = _cannot_return(modes, new.u[-1], new.y[-1], new.v[-1], energy)
        return count + 1, carry, new.u[-1] <= 0, outputs, string[-1], energy, over

    no = jnp.asarray(False)
    initial = (0, ((advanced.real, advanced.imag), first), no, outputs, under, free.energy, no)
    count, carry, separated, outputs, _, work, over = jax.lax.while_loop(is_unfinished, advance_block, initial)
    return count, carry, separated, outputs, work, over


def _cannot_return(modes: Modes, u: Array, y_hammer: Array, v_hammer: Array, *energies: AnyArray) -> Array:
    """Return true if the hammer moves away and is farther off than a string of these energies, J, can reach.

    The largest displacement under the hammer is √(2 E S) (Cauchy-Schwarz over modes).
    """
    compliance = (modes.strike * modes.modal_gain / modes.omega2).sum()
    reach = sum(jnp.sqrt(2 * jnp.maximum(energy, 0.0) * compliance) for energy in energies)
    return (u <= 0) & (v_hammer <= 0) & (y_hammer + reach <= 0)


class HammerState(NamedTuple):
    """The hammer after a step; symbols as in the module."""

    u: Array
    w: Array
    f: Array
    y: AnyArray
    v: AnyArray
    memory: Array | None


class StepOutputs(NamedTuple):
    """Entries of a pulse at one step."""

    drive: Array  # T, N
    force: Array  # N
    u: Array
    y: AnyArray
    v: AnyArray


def _blocks(modes: Modes, hammer: Any, y_string: AnyArray, speed: AnyArray | float, rows, computed_powers=None):
    """Return a function that advances the hammer by one block, and its initial state; symbols as in the module.

    The sum over past forces is split. Forces of the present block are summed with the kernel, step by step. Earlier
    forces are carried by the complex amplitudes of the modes. One matrix product gives their effect for the whole
    block, and candidates on the same string share it. The cost is linear in the steps. With `rows` the future
    displacement is carried instead.

    Parameters
    ----------
    y_string, speed : displacement and speed of the string under the hammer at the first touch, m and m/s.
    computed_powers : `real_powers` of the modes, if they are already computed.
    """
    a = modes.step / 2
    unit = impulse_amplitude(modes)
    log_z = modes.pole * modes.step
    powers = (log_z, *(real_powers(log_z, BLOCK + 1, 1) if computed_powers is None else computed_powers))
    z_block = jnp.exp(BLOCK * log_z)
    block_factor, unit = (z_block.real, z_block.imag), (unit.real, unit.imag)
    g = displacement_of_modes(modes.strike * unit[0], modes.strike * unit[1], powers)
    reversed_g = jnp.concatenate([g[:0:-1], jnp.zeros(BLOCK + 1)])
    c = a**2 / hammer.M_H + g[0]
    weights = memory_weights(hammer, modes.step)

    def displacement_by_modes(earlier):
        return displacement_of_modes(modes.strike * earlier[0], modes.strike * earlier[1], powers)

    def append_to_modes(earlier, recent):
        decayed, added = product(earlier, block_factor), product(unit, advance_drive(recent, powers))
        return decayed[0] + added[0], decayed[1] + added[1]

    def displacement_by_rows(earlier):
        return earlier[:BLOCK]

    def append_to_rows(earlier, recent):
        return jnp.append(earlier[BLOCK:], jnp.zeros(BLOCK)) + recent @ rows

    # Past forces leave complex amplitudes of the modes, or the future displacement.
    displacement_after, append_forces = (
        (displacement_by_modes, append_to_modes) if rows is None else (displacement_by_rows, append_to_rows)
    )

    def block(carry, under):
        earlier, first = carry
        past = under + displacement_after(earlier)

        def advance(carry, i):
            recent, (u, w, f, y, v, memory) = carry
            present = (jax.lax.dynamic_slice(reversed_g, (BLOCK - 1 - i,), (BLOCK,)) * recent).sum()
            e = y + 2 * a * v - past[i] - present
            u_new = compression(e, u, w, f, c, a, hammer, weights, memory)
            w_new = (u_new - u) / a - w
            f_new = force(u_new, w_new, e - c * f, c, a, hammer, weights, memory)
            memory = update_relaxation(u_new, hammer, weights, memory)
            t = f_new + f
            v_new = v - a / hammer.M_H * t
            y_new = y + a * (v + v_new)
            new = HammerState(u_new, w_new, f_new, y_new, v_new, memory)
            return (recent.at[i].set(t), new), StepOutputs(t, f_new, u_new, y_new, v_new)

        (recent, last), outputs = jax.lax.scan(advance, (jnp.zeros(BLOCK), first), jnp.arange(BLOCK))
        return (append_forces(earlier, recent), last), outputs

    zero = jnp.zeros_like(c)
    # y_H(0) = y_s at the strike position: the felt touches without compression (paper eq. 7).
    y, v = y_string + zero, hammer.v_H0 + zero
    return block, HammerState(zero, v - speed, zero, y, v, None if weights is None else zero)


def _march(modes: Modes, hammer: Any, under: Float[AnyArray, " steps"], speed: AnyArray | float, rows: AnyArray | None):
    """Simulate as many steps as `under` has: drive, force, u, y_H and v_H [steps]."""
    block, state = _blocks(modes, hammer, under[0], speed, rows)
    # The first block starts at step 1, before any force.
    shifted = jnp.append(under[1:], 0.0).reshape(-1, BLOCK)
    earlier = (jnp.zeros_like(modes.alpha),) * 2 if rows is None else jnp.zeros_like(under)
    _, later = jax.lax.scan(block, (earlier, state), shifted)
    zero = jnp.zeros_like(state.u)
    first = StepOutputs(zero, zero, zero, state.y, state.v)
    return tuple(jnp.concatenate([x[None], r.ravel()[:-1]]) for x, r in zip(first, later, strict=True))
