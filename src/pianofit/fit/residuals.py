"""What a fit minimises, as residuals with their derivatives.

A recording enters as its table of partials, a model as its table of modes, so the two are compared row by row:
frequency, decay and level. Levels count twice. As energies they are the paper's eq. 19, summed over each partial's line
in closed form: it finds the basin, and it keeps what is loud right. As decibels, in units of the measured noise and of
the scatter about the model, they give the estimate and its interval.
"""

from __future__ import annotations

import math
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..model.cache import kept
from ..model.contact import strike
from ..model.modes import mode_table
from ..model.response import level_db, mobility, ringing
from ..parameters import MEMORY_NAMES, Geometry, Hammer, MemoryHammer, String
from .space import LOG, NAMES, stiffness

__all__ = [
    "Cfg",
    "Lines",
    "Target",
    "compare",
    "hammer_batch",
    "joint_batch",
    "level_batch",
    "predict",
    "string_batch",
    "string_lines",
]

# A strike that does not end within the steps of a search costs this much.
ENDLESS = 1e3
DB = 10 / math.log(10.0)
CENT = math.log(2.0) / 1200


class Cfg(NamedTuple):
    """What a compiled program is specialised to."""

    n_modes: int
    steps: int
    quantity: str
    calibrated: bool
    memory: bool = False  # of the felt


class Target(NamedTuple):
    """The takes' partials, k = 1 to rows, and what turns differences into residuals; weights are 0 where none is."""

    frequency: Array  # Hz, [takes, rows]
    decay: Array  # 1/s
    level: Array  # dB
    floor: Array  # dB, energy of the noise
    line: Array  # dB, the level that eq. 19 likes best
    frequency_weight: Array  # 1/Hz
    decay_weight: Array  # s
    level_weight: Array  # 1/dB
    line_weight: Array  # share of each line in its band's eq. 19, times what eq. 19 weighs
    hammer_line: Array  # the same in the hammer's band alone
    by_energy: Array  # 1: the hammer's band alone, on eq. 19; 0: everything else
    common: Array  # [groups, takes, rows]: unit vectors over a group's takes, and
    shrink: Array  # [groups, rows]: how much of what they have in common is the path's roughness
    basis: Array  # [takes, rows, size]: gain and path, dB
    ratio: Array  # [takes, size]: selects the log velocity ratio
    cents: Array  # [takes, size]: selects the pitch
    start: Array  # [size], search coordinates
    prior_weight: Array  # [size]
    log_u: Array
    delay: Array  # s, [takes], from the first touch to the recording's onset
    geometry: Geometry
    rate: Array  # of the contact, Hz
    more: Array  # dB, [takes, rows]: what is added to the model's levels


class Lines(NamedTuple):
    """Cells [partials, nodes] of the measured spectrum, on which the string's lines are laid."""

    frequency: Array  # Hz
    energy: Array  # |S|²
    weight: Array  # [partials]
    sigma: Array  # 1/s
    geometry: Geometry
    rate: Array


def predict(string_z: Float[Array, " 4"], hammer_z: Float[Array, " 7 or 9"], ratio: Array, target: Target, cfg: Cfg):
    """Frequency, Hz, decay, 1/s, and level, dB, of the partials [takes, 3, rows], and whether each contact ended.

    `ratio` [takes] are the log velocities over that in `hammer_z`. Takes differ in nothing else before gain and path.
    """
    string = String(*jnp.exp(string_z))
    _, mu, p, mass, velocity, at, width, *memory = jnp.exp(hammer_z)
    hammer = Hammer(jnp.exp(stiffness(hammer_z[0], p, target.log_u)), mu, p, mass, velocity)
    hammer = MemoryHammer(*hammer, *memory) if cfg.memory else hammer
    geometry = target.geometry._replace(strike=at, width=width)
    modes = mode_table(string, geometry, rate=target.rate, n_modes=cfg.n_modes, quantity=cfg.quantity)

    def levels(ratio: Array, delay: Array):
        pulse = strike(modes, hammer._replace(v_H0=velocity * jnp.exp(ratio)), steps=cfg.steps)
        amplitude = ringing(modes, pulse.drive) * jnp.exp(modes.pole.real * delay)
        return level_db(amplitude, -modes.pole.real), pulse.compression[-1] <= 0

    level, ended = jax.vmap(levels)(ratio, target.delay)
    string = jnp.stack([modes.pole.imag / (2 * jnp.pi), -modes.pole.real])
    rows = target.frequency.shape[1]
    takes = jnp.broadcast_to(string, (len(ratio), *string.shape))
    return jnp.concatenate([takes, level[:, None]], axis=1)[..., :rows], ended


def compare(prediction: Array, z: Float[Array, " size"], target: Target, cfg: Cfg) -> Float[Array, " residuals"]:
    """Residuals of a prediction [takes, 3, rows] (frequency, decay, level before gain and path) and of the point.

    Half their sum of squares is the cost. Levels of one partial in several takes of a group share the path's roughness:
    what they have in common counts less than their differences, by the square root of their covariance's inverse.
    """
    frequency, decay, level = jnp.moveaxis(prediction, 1, 0)
    frequency = frequency * (1 + CENT * (target.cents @ z))[:, None]
    shaped = level + target.more + target.basis @ z
    # Noise adds its energy to the model's, as it did to the recording's.
    heard = DB * jnp.logaddexp(shaped / DB, target.floor / DB)
    miss = target.level_weight * (heard - target.level)
    miss = miss - jnp.einsum("gtk,gk,gsk,sk->tk", target.common, target.shrink, target.common, miss)
    rest = 1 - target.by_energy
    kinds = (
        target.frequency_weight * (frequency - target.frequency),
        target.decay_weight * (decay - target.decay),
        rest * miss,
        rest * target.line_weight * (_relative(shaped - target.line) - 1),
        target.by_energy * jax.vmap(partial(_in_hammer_band, cfg=cfg))(shaped, target.line, target.hammer_line),
    )
    return jnp.concatenate([*(x.ravel() for x in kinds), target.prior_weight * (z - target.start)])


def _relative(db: Array) -> Array:
    """Energy ratio; far above 1 only its root still rises, lest one wild partial hide all others."""
    ratio = jnp.exp(jnp.minimum(db, 60.0) / DB)
    return jnp.where(ratio > 4.0, 4.0 * jnp.sqrt(ratio / 4.0), ratio)


def _in_hammer_band(level: Array, line: Array, share: Array, cfg: Cfg) -> Array:
    """Eq. 19 over the hammer's band of one take, with the gain, where it is unknown, in closed form."""
    model = share * jnp.exp(jnp.clip(level - line, -300.0, 300.0) / DB)
    gain = 1.0 if cfg.calibrated else (model * share).sum() / jnp.maximum((model**2).sum(), 1e-300)
    return 30.0 * (gain * model - share)


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
    return (lines.weight[:, None] * miss).ravel()


def _last(cfg: Cfg) -> int:
    """Where the parameters of string and hammer end in a search point; a felt's memory comes last."""
    return LOG if cfg.memory else LOG - len(MEMORY_NAMES)


def _evaluate(string_z: Array, rest: Array, fixed_string: bool, target: Target, cfg: Cfg):
    """Residuals, Jacobian and prediction at one point; the prediction is differentiated, the comparison chained on."""
    z = jnp.concatenate([string_z, rest])
    ratio, velocity = target.ratio @ z, NAMES.index("v_H0")

    def twice(x):
        string, hammer = (string_z, x) if fixed_string else (x[:4], x[4:])
        value, ended = predict(string, hammer, ratio, target, cfg)
        return value, (value, ended.all())

    first, last = 4 if fixed_string else 0, _last(cfg)
    slope, (value, ended) = jax.jacfwd(twice, has_aux=True)(z[first:last])
    slope = jnp.pad(slope, ((0, 0), (0, 0), (0, 0), (first, z.shape[0] - last)))
    # Each take's velocity is v_H0 times its own ratio.
    slope = slope + slope[..., velocity : velocity + 1] * target.ratio[:, None, None, :]
    residual, push = jax.linearize(lambda v, x: compare(v, x, target, cfg), value, z)
    jacobian = jax.vmap(push, in_axes=(3, 0), out_axes=1)(slope, jnp.eye(z.shape[0]))
    endless = jnp.where(ended, 0.0, ENDLESS)
    return jnp.append(residual, endless), jnp.pad(jacobian, ((0, 1), (0, 0))), value


@kept
def joint_batch(z, target: Target, cfg: Cfg):
    """Residuals [starts, residuals], their Jacobian [starts, residuals, size], the prediction [starts, takes, 3, rows].

    `z` is a batch of search points [starts, size].
    """
    return jax.vmap(lambda x: _evaluate(x[:4], x[4:], False, target, cfg))(z)


@kept
def hammer_batch(z, target: Target, cfg: Cfg):
    """As `joint_batch`, with the first row's string for all: it is computed once, and has no derivatives."""
    return jax.vmap(lambda x: _evaluate(z[0, :4], x, True, target, cfg))(z[:, 4:])


@kept
def level_batch(z, ratio, target: Target, cfg: Cfg):
    """Levels, dB, before gain and path, as a tuple of one [hammers, velocities, rows]; inf where a contact did not end.

    Hammers are those of `z` [hammers, size] on the first row's string, velocities their v_H0 times exp(`ratio`).
    """
    at, last = target._replace(delay=jnp.broadcast_to(target.delay[0], ratio.shape)), _last(cfg)

    def one(x):
        value, ended = predict(z[0, :4], x[4:last], ratio, at, cfg)
        return jnp.where(ended[:, None], value[:, 2], jnp.inf)

    return (jax.vmap(one)(z),)


@kept
def string_batch(z, lines: Lines, cfg: Cfg):
    """`string_lines` and its Jacobian for a batch of search points [starts, size]; only the string has derivatives."""

    def both(x):
        def twice(y):
            value = string_lines(y, lines, cfg)
            return value, value

        jacobian, value = jax.jacfwd(twice, has_aux=True)(x[:4])
        return value, jnp.pad(jacobian, ((0, 0), (0, x.shape[0] - 4)))

    return jax.vmap(both)(z)
