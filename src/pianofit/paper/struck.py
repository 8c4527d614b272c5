"""The struck string's |Y|² on the criterion's cells, fast enough for an annealing.

|Y|² = |T̂|² |H|² δt². Over one cell the pulse's transform T̂ is smooth, for a pulse is short beside the cell's inverse
width; and so is what all modes but the nearest leave there of the mobility H. Both are computed at a few Chebyshev
nodes and interpolated, which is exact to 1e-9; the nearest modes are summed at every node. While the string is held
nothing but T̂ changes.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.polynomial.chebyshev import chebpts1, chebvander

from ..criterion import NODES
from ..inference.lanes import in_lanes
from ..model.cache import kept
from ..model.contact import Pulse, impulse_amplitude, kernel_rows, strike
from ..model.modes import Modes, mode_table
from ..model.response import pulse_transform, ringing_transform
from ..parameters import Geometry, Hammer, String
from .descent import LeastSquares
from .spectral import Goal, Values, miss

__all__ = ["Cfg", "Scene", "hold", "struck_gradients"]

# Chebyshev nodes a cell.
SMOOTH = 12
# Modes that are summed at every node.
NEAREST = 5
# The steps are some 1.6 contacts long; the force is largest here.
MIDDLE = 0.3
# Hammers of one call at most: so many share a compiled program.
BATCH = 32
# Where a cell is sampled, in [-1, 1], and the matrix from values there to values at the cell's own nodes.
PLACES = chebpts1(SMOOTH)
SPREAD_OUT = chebvander(np.linspace(-1, 1, NODES), SMOOTH - 1) @ np.linalg.inv(chebvander(PLACES, SMOOTH - 1))


class Cfg(NamedTuple):
    """What a compiled program is specialised to."""

    n_modes: int
    steps: int
    quantity: str


class Scene(NamedTuple):
    """What stays while a string and a hammer are searched."""

    geometry: Geometry
    rate: Values  # of the contact, Hz
    log_u: Values  # log of the compression, m, at which the felt's force is searched
    stiff: Values  # [2], logs of the least and the largest stiffness


class Held(NamedTuple):
    """A string that is held, as a hammer meets it."""

    modes: Modes
    mobility: Array  # |H|² δt² [rows, nodes]
    real: Array  # of ζ^n at the Chebyshev nodes [steps, rows · SMOOTH]: T̂ is then one matrix product
    imag: Array
    rows: Array  # of the kernel


def _log_zeta(frequency: Array, sigma: Array, step: Array) -> Array:
    return -(sigma + 2j * jnp.pi * frequency) * step


def _smooth_frequency(goal: Goal) -> Float[Array, "rows smooth"]:
    first, last = goal.frequency[:, :1], goal.frequency[:, -1:]
    return (first + last) / 2 + (last - first) / 2 * PLACES


def string_mobility(modes: Modes, goal: Goal, pulse: float) -> Float[Array, "rows nodes"]:
    """|H|² δt² of a string struck by a pulse whose middle comes after so many steps."""
    residue, log_z = modes.pickup * impulse_amplitude(modes), modes.pole * modes.step
    middle = goal.frequency.mean(axis=1)
    nearest = jnp.searchsorted(modes.pole.imag, 2 * jnp.pi * middle) - (NEAREST + 1) // 2
    nearest = jnp.clip(nearest, 0, len(residue) - NEAREST)[:, None] + jnp.arange(NEAREST)
    far = jnp.ones((len(middle), len(residue))).at[jnp.arange(len(middle))[:, None], nearest].set(0.0)
    rough = _log_zeta(_smooth_frequency(goal), goal.sigma, modes.step)
    background = ringing_transform((far * residue)[:, None, :], log_z[None, None, :], rough) @ SPREAD_OUT.T
    fine = _log_zeta(goal.frequency, goal.sigma, modes.step)
    near, log_near = residue[nearest][:, None, :], log_z[nearest][:, None, :]
    # What is cut off where the recording ends, as if the whole pulse had come in its middle.
    steps = goal.span / modes.step - pulse
    tail = jnp.exp(steps * fine) * ringing_transform(near * jnp.exp(steps * log_near), log_near, fine)
    total = background + ringing_transform(near, log_near, fine) - tail
    return (total.real**2 + total.imag**2) * modes.step**2


def pulse_energy(real: Array, imag: Array) -> Float[Array, "rows nodes"]:
    """|T̂|² on the cells, from T̂ at their Chebyshev nodes [rows · SMOOTH]."""
    return sum((part.reshape(-1, SMOOTH) @ SPREAD_OUT.T) ** 2 for part in (real, imag))


def _smooth_transform(drive: Float[Array, " steps"], log_zeta: Array) -> tuple[Array, Array]:
    """T̂ at the Chebyshev nodes, from about the pulse's middle, where its phase turns least."""
    transform = pulse_transform(drive, log_zeta) * jnp.exp(-1j * log_zeta.imag * MIDDLE * drive.shape[0])
    return transform.real, transform.imag


def _hammer(z: Float[Array, " 5"], scene: Scene) -> Hammer:
    _, mu, p, mass, velocity = jnp.exp(z)
    return Hammer(jnp.exp(z[0] - p * scene.log_u), mu, p, mass, velocity)


def _allowed(value: Array, hammer: Hammer, pulse: Pulse, scene: Scene) -> Array:
    """`value`; infinite for a contact that does not end, and for a felt that is out of bounds."""
    stiffness = jnp.log(hammer.K_H)
    inside = (stiffness >= scene.stiff[0]) & (stiffness <= scene.stiff[1])
    return jnp.where((pulse.compression[-1] <= 0) & inside, value, jnp.inf)


def _struck(z: Float[Array, " 9"], goal: Goal, scene: Scene, cfg: Cfg) -> Array:
    modes, hammer = _table(z, scene, cfg), _hammer(z[4:], scene)
    pulse = strike(modes, hammer, steps=cfg.steps)
    log_zeta = _log_zeta(_smooth_frequency(goal), goal.sigma, modes.step).ravel()
    energy = pulse_energy(*_smooth_transform(pulse.drive, log_zeta)) * string_mobility(modes, goal, MIDDLE * cfg.steps)
    return _allowed(0.5 * (miss(energy, goal) ** 2).sum(), hammer, pulse, scene)


def _table(z: Array, scene: Scene, cfg: Cfg) -> Modes:
    return mode_table(
        String(*jnp.exp(z[:4])), scene.geometry, rate=scene.rate, n_modes=cfg.n_modes, quantity=cfg.quantity
    )


def _on_held(z: Float[Array, " 5"], held: Held, goal: Goal, scene: Scene, cfg: Cfg) -> Array:
    """Residuals of a hammer on a string that is held."""
    hammer = _hammer(z, scene)
    pulse = strike(held.modes, hammer, steps=cfg.steps, rows=held.rows)
    energy = pulse_energy(pulse.drive @ held.real, pulse.drive @ held.imag) * held.mobility
    return _allowed(miss(energy, goal), hammer, pulse, scene)


@kept
def struck_gradients(z, goal: Goal, scene: Scene, cfg: Cfg):
    """C [starts] and its gradient by all nine search coordinates `z` [starts, 9]."""
    return jax.vmap(jax.value_and_grad(lambda x: _struck(x, goal, scene, cfg)))(z)


def hold(z: Float[Array | np.ndarray, " 9"], goal: Goal, scene: Scene, cfg: Cfg) -> LeastSquares:
    """C of hammers [n, 5] on the string of `z`, which is computed once for a whole search."""
    mobility, real, imag, rows, *modes = held_string(z, goal, scene, cfg)
    held = Held(Modes(*modes), mobility, real, imag, rows)

    def each(program: Callable, z: np.ndarray) -> tuple[np.ndarray, ...]:
        return in_lanes(partial(program, held, goal), (z,), scene, cfg, min(BATCH, len(z)))

    return LeastSquares(lambda z: each(hammer_costs, z)[0], lambda z: each(hammer_residuals, z))


@kept
def held_string(z, goal: Goal, scene: Scene, cfg: Cfg):
    """The parts of `Held`, its table last."""
    modes = _table(z, scene, cfg)
    log_zeta = _log_zeta(_smooth_frequency(goal), goal.sigma, modes.step).ravel()
    powers = jnp.exp(jnp.arange(cfg.steps)[:, None] * log_zeta - 1j * log_zeta.imag * MIDDLE * cfg.steps)
    rows = kernel_rows(modes, cfg.steps)
    return (string_mobility(modes, goal, MIDDLE * cfg.steps), powers.real, powers.imag, rows, *modes)


@kept
def hammer_costs(held: Held, goal: Goal, z, scene: Scene, cfg: Cfg):
    """C [chains] of hammers `z` [chains, 5] on a string that is held."""
    return (jax.vmap(lambda x: 0.5 * (_on_held(x, held, goal, scene, cfg) ** 2).sum())(z),)


@kept
def hammer_residuals(held: Held, goal: Goal, z, scene: Scene, cfg: Cfg):
    """Residuals [starts, bins], of which half the sum of squares is C, and their Jacobian [starts, bins, 5]."""

    def both(x: Array) -> tuple[Array, Array]:
        def twice(y: Array) -> tuple[Array, Array]:
            value = _on_held(y, held, goal, scene, cfg)
            return value, value

        jacobian, value = jax.jacfwd(twice, has_aux=True)(x)
        return value, jacobian

    return jax.vmap(both)(z)
