"""What a fit minimises, as residuals with their derivatives.

A recording enters as its table of partials, a model as its table of modes, so the two are compared row by row:
frequency, decay and level. The unknown gain and output path are linear in dB, and so are removed in closed form by a
projection. Two scales serve two purposes. On the `energy` scale the level residuals are the paper's eq. 19, summed over
each partial's line in closed form: it finds the basin. On the `level` scale they are in units of the measured noise and
misfit: it gives the estimate and its interval.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..model.contact import strike
from ..model.modes import mode_table
from ..model.response import LEVEL_DECAY, level_db, mobility, ringing
from ..parameters import Geometry, Hammer, String
from .space import stiffness

__all__ = ["Cfg", "Lines", "Target", "hammer_batch", "joint", "joint_batch", "predict", "string_batch", "string_lines"]

# A strike that does not end within the steps of a search costs this much.
ENDLESS = 1e3
DB = 10 / jnp.log(10.0)


class Cfg(NamedTuple):
    """What a compiled program is specialised to."""

    n_modes: int
    steps: int
    quantity: str
    calibrated: bool


class Target(NamedTuple):
    """The recording, padded to [partials] rows, and what turns differences into residuals. `weight`s of padding are 0."""

    row: Array  # k - 1
    frequency: Array  # Hz
    decay: Array  # 1/s
    level: Array  # dB
    floor: Array  # dB, energy of the noise
    frequency_weight: Array  # 1/Hz
    decay_weight: Array  # s
    level_weight: Array  # 1/dB
    energy_weight: Array  # 1 in the band that eq. 19 is taken over
    scale: Array  # 1: levels in dB, weighted; 0: energies, the paper's eq. 19
    projector: Array  # [partials + terms, columns], orthonormal: gain and path
    start: Array  # [10], search coordinates
    prior_weight: Array  # [10]
    log_u: Array
    delay: Array  # s, from the first touch to the recording's onset
    geometry: Geometry
    rate: Array  # of the contact, Hz


class Lines(NamedTuple):
    """Cells [partials, nodes] of the measured spectrum, on which the string's lines are laid."""

    frequency: Array  # Hz
    energy: Array  # |S|²
    weight: Array  # [partials]
    sigma: Array  # 1/s
    geometry: Geometry
    rate: Array


def predict(string_z: Float[Array, " 4"], hammer_z: Float[Array, " 6"], target: Target, cfg: Cfg):
    """Frequency, Hz, decay, 1/s, and level, dB, of every partial of the target, and whether the contact ended."""
    string = String(*jnp.exp(string_z))
    _, mu, p, mass, velocity, at = jnp.exp(hammer_z)
    hammer = Hammer(jnp.exp(stiffness(hammer_z[0], p, target.log_u)), mu, p, mass, velocity)
    geometry = target.geometry._replace(strike=at)
    modes = mode_table(string, geometry, rate=target.rate, n_modes=cfg.n_modes, quantity=cfg.quantity)
    pulse = strike(modes, hammer, steps=cfg.steps)
    heard = jax.tree.map(lambda x: x[target.row] if x.ndim else x, modes)
    amplitude = ringing(heard, pulse.drive) * jnp.exp(heard.pole.real * target.delay)
    decay = -heard.pole.real
    return heard.pole.imag / (2 * jnp.pi), decay, level_db(amplitude, decay), pulse.compression[-1] <= 0


def joint(string_z: Array, hammer_z: Array, target: Target, cfg: Cfg):
    """Residuals of all partials, the path's penalty and the prior, and the prediction they come from.

    Half the residuals' sum of squares is the cost. Levels count on two scales, of which `target.scale` picks one.
    """
    frequency, decay, level, ended = predict(string_z, hammer_z, target, cfg)
    # Noise adds its energy to the model's, as it did to the recording's.
    level = DB * jnp.logaddexp(level / DB, target.floor / DB)
    heard = jnp.zeros(target.projector.shape[0])
    heard = heard.at[: level.shape[0]].set(target.level_weight * (level - target.level))
    heard = heard - target.projector @ (target.projector.T @ heard)
    residual = jnp.concatenate(
        [
            target.frequency_weight * (frequency - target.frequency),
            target.decay_weight * (decay - target.decay),
            target.scale * heard,
            (1 - target.scale) * _energy_lines(level, decay, target, cfg),
            target.prior_weight * (jnp.concatenate([string_z, hammer_z]) - target.start),
            jnp.where(ended, 0.0, ENDLESS)[None],
        ]
    )
    return residual, jnp.stack([frequency, decay, level])


def _energy_lines(level: Array, decay: Array, target: Target, cfg: Cfg) -> Array:
    """Eq. 19 over isolated lines. A line |A/2|²/((σ + α)² + ω²) has ∫ (line)² dω ∝ |A|⁴/(σ + α)³, σ = 8/s."""

    def lines(db, alpha):
        width = alpha + LEVEL_DECAY
        return target.energy_weight * jnp.exp(db / DB) * width / width**1.5

    measured = lines(target.level, target.decay)
    model = lines(level, decay)
    gain = 1.0 if cfg.calibrated else (model * measured).sum() / jnp.maximum((model**2).sum(), 1e-300)
    return (gain * model - measured) * (30.0 / jnp.sqrt((measured**2).sum()))


def string_lines(z: Array, lines: Lines, cfg: Cfg) -> Array:
    """Eq. 19 on the cells of some partials, each with a gain of its own in closed form.

    The hammer is not known yet. With every level free, only the lines' places and widths are left to the string.
    """
    modes = mode_table(
        String(*jnp.exp(z[:4])), lines.geometry, rate=lines.rate, n_modes=cfg.n_modes, quantity=cfg.quantity
    )
    zeta = jnp.exp(-(lines.sigma + 2j * jnp.pi * lines.frequency.ravel()) * modes.step)
    model = jnp.abs(mobility(modes, zeta)).reshape(lines.frequency.shape) ** 2
    gain = (model * lines.energy).sum(axis=1) / jnp.maximum((model**2).sum(axis=1), 1e-300)
    miss = gain[:, None] * model - lines.energy
    return (lines.weight[:, None] * miss).ravel(), gain


def _with_jacobian(function):
    """`function(z) -> (residual, extra)` to (residual, Jacobian, extra), in one forward pass."""

    def evaluate(z):
        def twice(x):
            residual, extra = function(x)
            return residual, (residual, extra)

        jacobian, (residual, extra) = jax.jacfwd(twice, has_aux=True)(z)
        return residual, jacobian, extra

    return evaluate


@partial(jax.jit, static_argnames="cfg")
def joint_batch(z, target: Target, cfg: Cfg):
    """For a batch of search points [starts, 10]: residuals [starts, residuals], their Jacobian [starts, residuals, 10],
    and the predicted frequency, decay and level [starts, 3, partials], padded."""  # noqa: D205, D209
    return jax.vmap(_with_jacobian(lambda x: joint(x[:4], x[4:], target, cfg)))(z)


@partial(jax.jit, static_argnames="cfg")
def hammer_batch(z, target: Target, cfg: Cfg):
    """As `joint_batch`, with the first row's string for all: it is computed once, and has no derivatives."""
    string = z[0, :4]
    value, jacobian, extra = jax.vmap(_with_jacobian(lambda x: joint(string, x, target, cfg)))(z[:, 4:])
    return value, jnp.pad(jacobian, ((0, 0), (0, 0), (4, 0))), extra


@partial(jax.jit, static_argnames="cfg")
def string_batch(z, lines: Lines, cfg: Cfg):
    """`string_lines` for a batch of search points [starts, 10]; the hammer has no derivatives."""
    value, jacobian, extra = jax.vmap(_with_jacobian(lambda x: string_lines(x, lines, cfg)))(z[:, :4])
    return value, jnp.pad(jacobian, ((0, 0), (0, 0), (0, z.shape[1] - 4))), extra
