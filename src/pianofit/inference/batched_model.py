"""Levels of partials by the model, in lanes: one lane is one string struck by one hammer at one velocity.

Whatever is fitted, one recording or many, is a number of lanes, so all fits share the same compiled programs. A lane
[lane] holds the unknowns of the hammer and its contact, as the law of the felt has them after the string's
(`coordinates.names_of`), and the logarithm of the velocity.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..felt import FeltLaw
from ..model.contact import strike_final_state
from ..model.free_response import LEVEL_DECAY, LEVEL_SPAN
from ..model.modes import mode_table
from ..model.program_cache import persistent_jit
from ..parameters import Geometry, String
from ..threads import cores
from .parametrisation import STRING_SIZE

__all__ = [
    "BATCH_SIZE",
    "StaticConfig",
    "ModelInputs",
    "run_in_batches",
    "levels",
    "levels_per_string",
    "level_jacobians_per_string",
    "thread_pool",
    "level_jacobians",
]

# Lanes of one call: enough to fill vector units; more would make the fast ones wait for the slow ones.
BATCH_SIZE = 8
DB = 20 / np.log(10)


class StaticConfig(NamedTuple):
    """What a compiled program is specialised to."""

    n_modes: int
    rows: int  # partials whose levels are wanted, 1 to rows
    quantity: str
    law: FeltLaw


class ModelInputs(NamedTuple):
    """What all lanes share."""

    geometry: Geometry  # strike and width come from the lane
    rate: Any  # of the contact, Hz
    log_u: Any  # log of the reference compression, m
    steps: Any  # in which a contact must end, a multiple of 32
    free: Any  # int, entries of a lane by which `slopes` differentiates, and -1, by which nothing moves [directions]


def _level(log_string: Array, cents: Array | float, lane: Float[Array, " lane"], scene: ModelInputs, cfg: StaticConfig):
    """Levels, dB [rows], from the moment at which the wave reaches the pickup, and whether the contact ended."""
    c, *rest = jnp.exp(log_string)
    string = String(c * jnp.exp2(cents / 1200), *rest)
    logs = dict(zip((*cfg.law.columns, "v_H0"), lane, strict=True))
    if cfg.law.power:
        stiffness, p = cfg.law.power
        logs[stiffness] = logs[stiffness] - jnp.exp(logs[p]) * scene.log_u
    values = {name: jnp.exp(log) for name, log in logs.items()}
    hammer = cfg.law.make_hammer(values, jnp.zeros_like(values["v_H0"]))
    at, width = values["x0"], values["width"]
    geometry = scene.geometry._replace(strike_position=at, width=width)
    modes = mode_table(string, geometry, rate=scene.rate, n_modes=cfg.n_modes, quantity=cfg.quantity)
    struck = strike_final_state(modes, hammer, steps=scene.steps)
    end = geometry.length if cfg.quantity in ("bridge-force", "pressure") else geometry.pickup
    delay = jnp.maximum(jnp.abs(end - at) - width / 2, 0.0) / string.c
    # What rings after the contact, carried back to the arrival.
    alpha = -modes.pole.real[: cfg.rows]
    left = modes.pickup[: cfg.rows] * struck.amplitude[: cfg.rows]
    size = 0.5 * jnp.log(jnp.maximum(left.real**2 + left.imag**2, np.finfo(float).tiny))
    size = size + alpha * (struck.steps * modes.step - delay)
    rate = 2 * (alpha + LEVEL_DECAY)
    level = DB * (size + 0.5 * jnp.log(-0.5 * jnp.expm1(-rate * LEVEL_SPAN) / rate))
    return level, struck.separated


@persistent_jit
def levels(string: Float[Array, " 4"], lanes: Float[Array, "lanes lane"], scene: ModelInputs, cfg: StaticConfig):
    """Levels, dB [lanes, rows], of many hammers on one string, and whether each contact ended [lanes]."""
    return jax.vmap(lambda lane: _level(string, 0.0, lane, scene, cfg))(lanes)


@persistent_jit
def level_jacobians(
    string: Float[Array, " 4"], lanes: Float[Array, "lanes lane"], scene: ModelInputs, cfg: StaticConfig
):
    """The same, and between them the levels' derivatives by the entries `scene.free` [lanes, rows, directions]."""
    along = jax.nn.one_hot(scene.free, lanes.shape[-1])
    return jax.vmap(lambda lane: _along(lambda x: _level(string, 0.0, x, scene, cfg), lane, along))(lanes)


def _along(function: Callable, at, directions):
    """Of `function`, whose second result has no derivatives: value, derivatives in the last axis, second result."""
    push = functools.partial(jax.jvp, function, (at,), has_aux=True)
    return jax.vmap(lambda direction: push((direction,)), out_axes=(None, -1, None))(directions)


@persistent_jit
def levels_per_string(strings, cents, lanes, scene: ModelInputs, cfg: StaticConfig):
    """As `levels`, each lane with a string of its own [lanes, 4], tenser by its `cents` [lanes]."""
    return jax.vmap(lambda string, c, lane: _level(string, c, lane, scene, cfg))(strings, cents, lanes)


@persistent_jit
def level_jacobians_per_string(strings, cents, lanes, scene: ModelInputs, cfg: StaticConfig):
    """As `levels_per_string`, with derivatives by the string and the entries `scene.free` [lanes, rows, 4 + directions]."""
    size = STRING_SIZE + lanes.shape[-1]
    entries = jnp.where(scene.free < 0, -1, scene.free + STRING_SIZE)
    along = jax.nn.one_hot(jnp.concatenate([jnp.arange(STRING_SIZE), entries]), size)

    def one(string, c, lane):
        def level(x):
            return _level(x[:STRING_SIZE], c, x[STRING_SIZE:], scene, cfg)

        return _along(level, jnp.concatenate([string, lane]), along)

    return jax.vmap(one)(strings, cents, lanes)


@functools.cache
def thread_pool() -> ThreadPoolExecutor:
    """As many threads as this process may use cores: XLA works outside of Python's lock."""
    return ThreadPoolExecutor(cores())


def run_in_batches(
    program: Callable, lanes: tuple, scene: Any, cfg: Any, size: int = BATCH_SIZE
) -> tuple[np.ndarray, ...]:
    """`program` of any number of lanes, `size` at a time, on all cores.

    Parameters
    ----------
    lanes : the program's arguments with a leading axis of lanes; before them may stand one string for all [4].
    """
    *common, first = (lanes[:1], lanes[1:]) if lanes[0].ndim == 1 else (lanes,)
    count = len(first[0])
    padded = [np.concatenate([x, np.repeat(x[-1:], -count % size, axis=0)]) for x in first]

    def some(at: int) -> list[np.ndarray]:
        return [np.asarray(x) for x in program(*sum(common, ()), *(x[at : at + size] for x in padded), scene, cfg)]

    parts = list(thread_pool().map(some, range(0, len(padded[0]), size)))
    return tuple(np.concatenate(column)[:count] for column in zip(*parts, strict=True))
