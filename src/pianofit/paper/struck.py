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
from ..model.contact import impulse_amplitude, kernel_rows, strike
from ..model.exponentials import transform
from ..model.modes import Modes, mode_table
from ..model.response import ringing_transform
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


def _table(z: Array, scene: Scene, cfg: Cfg) -> Modes:
    string = String(*jnp.exp(z[:4]))
    return mode_table(string, scene.geometry, rate=scene.rate, n_modes=cfg.n_modes, quantity=cfg.quantity)


def _log_zeta(frequency: Array, goal: Goal, step: Array) -> Array:
    return -(goal.sigma + 2j * jnp.pi * frequency) * step


def _smooth_log_zeta(goal: Goal, step: Array) -> Array:
    """At the Chebyshev nodes [rows, SMOOTH]."""
    first, last = goal.frequency[:, :1], goal.frequency[:, -1:]
    return _log_zeta((first + last) / 2 + (last - first) / 2 * PLACES, goal, step)


def string_mobility(modes: Modes, goal: Goal, pulse: float) -> Float[Array, "rows nodes"]:
    """|H|² δt² of a string struck by a pulse whose middle comes after so many steps."""
    residue, log_z = modes.pickup * impulse_amplitude(modes), modes.pole * modes.step
    middle = goal.frequency.mean(axis=1)
    nearest = jnp.searchsorted(modes.pole.imag, 2 * jnp.pi * middle) - (NEAREST + 1) // 2
    nearest = jnp.clip(nearest, 0, len(residue) - NEAREST)[:, None] + jnp.arange(NEAREST)
    far = jnp.ones((len(middle), len(residue))).at[jnp.arange(len(middle))[:, None], nearest].set(0.0)
    rough, fine = _smooth_log_zeta(goal, modes.step), _log_zeta(goal.frequency, goal, modes.step)
    background = ringing_transform((far * residue)[:, None, :], log_z[None, None, :], rough) @ SPREAD_OUT.T
    near, log_near = residue[nearest][:, None, :], log_z[nearest][:, None, :]
    # What is cut off where the recording ends, as if the whole pulse had come in its middle.
    steps = goal.span / modes.step - pulse
    tail = jnp.exp(steps * fine) * ringing_transform(near * jnp.exp(steps * log_near), log_near, fine)
    total = background + ringing_transform(near, log_near, fine) - tail
    return (total.real**2 + total.imag**2) * modes.step**2


def _residuals(
    z: Float[Array, " 5"], modes: Modes, mobility: Array, rows: Array | None, transform: Callable, goal: Goal,
    scene: Scene, cfg: Cfg,
) -> Float[Array, " bins"]:  # fmt: skip
    """Of a hammer on a string; `transform` gives T̂'s real and imaginary part at the Chebyshev nodes.

    Infinite for a contact that does not end, and for a felt that is out of bounds.
    """
    _, mu, p, mass, velocity = jnp.exp(z)
    stiffness = z[0] - p * scene.log_u
    pulse = strike(modes, Hammer(jnp.exp(stiffness), mu, p, mass, velocity), steps=cfg.steps, rows=rows)
    energy = mobility * sum((part.reshape(-1, SMOOTH) @ SPREAD_OUT.T) ** 2 for part in transform(pulse.drive))
    inside = (stiffness >= scene.stiff[0]) & (stiffness <= scene.stiff[1])
    return jnp.where((pulse.compression[-1] <= 0) & inside, miss(energy, goal), jnp.inf)


def _on_held(z: Float[Array, " 5"], held: Held, goal: Goal, scene: Scene, cfg: Cfg) -> Float[Array, " bins"]:
    def transform(drive: Array) -> tuple[Array, Array]:
        return drive @ held.real, drive @ held.imag

    return _residuals(z, held.modes, held.mobility, held.rows, transform, goal, scene, cfg)


def _struck(z: Float[Array, " 9"], goal: Goal, scene: Scene, cfg: Cfg) -> Array:
    modes = _table(z, scene, cfg)
    log_zeta = _smooth_log_zeta(goal, modes.step).ravel()

    def transformed(drive: Array) -> tuple[Array, Array]:
        # From about the pulse's middle, where its phase turns least.
        turned = transform(drive, log_zeta) * jnp.exp(-1j * log_zeta.imag * MIDDLE * cfg.steps)
        return turned.real, turned.imag

    mobility = string_mobility(modes, goal, MIDDLE * cfg.steps)
    return 0.5 * (_residuals(z[4:], modes, mobility, None, transformed, goal, scene, cfg) ** 2).sum()


@kept
def struck_gradients(z, goal: Goal, scene: Scene, cfg: Cfg):
    """C [starts] and its gradient by all nine search coordinates `z` [starts, 9]."""
    return jax.vmap(jax.value_and_grad(lambda x: _struck(x, goal, scene, cfg)))(z)


def hold(
    z: Float[Array | np.ndarray, " 9"], lower: np.ndarray, upper: np.ndarray, goal: Goal, scene: Scene, cfg: Cfg
) -> LeastSquares:
    """C of hammers [n, 5] between the edges `lower` and `upper` [5], on the string of `z`, which is computed once."""
    mobility, real, imag, rows, *modes = held_string(z, goal, scene, cfg)
    held = Held(Modes(*modes), mobility, real, imag, rows)

    def each(program: Callable, z: np.ndarray) -> tuple[np.ndarray, ...]:
        return in_lanes(partial(program, held, goal), (z,), scene, cfg, min(BATCH, len(z)))

    return LeastSquares(lambda z: each(hammer_costs, z)[0], lambda z: each(hammer_residuals, z), lower, upper)


@kept
def held_string(z, goal: Goal, scene: Scene, cfg: Cfg):
    """The parts of `Held`, its table last."""
    modes, middle = _table(z, scene, cfg), MIDDLE * cfg.steps
    log_zeta = _smooth_log_zeta(goal, modes.step).ravel()
    powers = jnp.exp(jnp.arange(cfg.steps)[:, None] * log_zeta - 1j * log_zeta.imag * middle)
    return string_mobility(modes, goal, middle), powers.real, powers.imag, kernel_rows(modes, cfg.steps), *modes


@kept
def hammer_costs(held: Held, goal: Goal, z, scene: Scene, cfg: Cfg):
    """C [chains] of hammers `z` [chains, 5] on a string that is held."""
    return (jax.vmap(lambda x: 0.5 * (_on_held(x, held, goal, scene, cfg) ** 2).sum())(z),)


@kept
def hammer_residuals(held: Held, goal: Goal, z, scene: Scene, cfg: Cfg):
    """Residuals [starts, bins], of which half the sum of squares is C, and their Jacobian [starts, bins, 5]."""

    def twice(x: Array) -> tuple[Array, Array]:
        value = _on_held(x, held, goal, scene, cfg)
        return value, value

    jacobian, value = jax.vmap(jax.jacfwd(twice, has_aux=True))(z)
    return value, jacobian
