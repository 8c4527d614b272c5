"""Levels of partials by the model, in batches of strokes: one string, one hammer, one velocity each.

Every fit, of one recording or of many, is a number of strokes, so all fits share the same compiled programs. A stroke
[entries] holds the parameters of the hammer and its contact, and the logarithm of the velocity. Their order is that of
`parametrisation.names_of` without the string.
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

from ..conversions import DB
from ..dsp.level import LEVEL_RATE, LEVEL_SECONDS
from ..felt import FeltLaw
from ..model.contact import strike_final_state
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

# Strokes of one call: enough to fill vector units. With more, short contacts would wait for long ones.
BATCH_SIZE = 8


class StaticConfig(NamedTuple):
    """Static arguments of a compiled program."""

    n_modes: int
    rows: int  # partials with levels, 1 to rows
    quantity: str
    law: FeltLaw


class ModelInputs(NamedTuple):
    """Inputs that all strokes share."""

    geometry: Geometry  # strike position and width are those of the stroke
    rate: Any  # of the contact, Hz
    log_u: Any  # log of the reference compression, m
    steps: Any  # maximum steps of a contact, a multiple of 32
    free: Any  # int, entries of a stroke for derivatives; -1 for a direction without effect [directions]


def _level(
    log_string: Array, cents: Array | float, stroke: Float[Array, " entries"], inputs: ModelInputs, cfg: StaticConfig
):
    """Levels, dB [rows], from the arrival of the wave at the pickup, and whether the contact ended."""
    c, *rest = jnp.exp(log_string)
    string = String(c * jnp.exp2(cents / 1200), *rest)
    logs = dict(zip((*cfg.law.columns, "v_H0"), stroke, strict=True))
    if cfg.law.power:
        stiffness, p = cfg.law.power
        logs[stiffness] = logs[stiffness] - jnp.exp(logs[p]) * inputs.log_u
    values = {name: jnp.exp(log) for name, log in logs.items()}
    hammer = cfg.law.make_hammer(values, jnp.zeros_like(values["v_H0"]))
    strike_position, width = values["x0"], values["width"]
    geometry = inputs.geometry._replace(strike_position=strike_position, width=width)
    modes = mode_table(string, geometry, rate=inputs.rate, n_modes=cfg.n_modes, quantity=cfg.quantity)
    final = strike_final_state(modes, hammer, steps=inputs.steps)
    end = geometry.length if cfg.quantity in ("bridge-force", "pressure") else geometry.pickup
    delay = jnp.maximum(jnp.abs(end - strike_position) - width / 2, 0.0) / string.c
    # Amplitudes after the contact, extrapolated back to the arrival.
    alpha = -modes.pole.real[: cfg.rows]
    amplitude = modes.pickup[: cfg.rows] * final.amplitude[: cfg.rows]
    size = 0.5 * jnp.log(jnp.maximum(amplitude.real**2 + amplitude.imag**2, np.finfo(float).tiny))
    size = size + alpha * (final.steps * modes.step - delay)
    rate = 2 * (alpha + LEVEL_RATE / 2)
    level = DB * (size + 0.5 * jnp.log(-0.5 * jnp.expm1(-rate * LEVEL_SECONDS) / rate))
    return level, final.separated


@persistent_jit
def levels(string: Float[Array, " 4"], batch: Float[Array, "batch entries"], inputs: ModelInputs, cfg: StaticConfig):
    """Levels, dB [batch, rows], of many hammers on one string, and whether each contact ended [batch]."""
    return jax.vmap(lambda stroke: _level(string, 0.0, stroke, inputs, cfg))(batch)


@persistent_jit
def level_jacobians(
    string: Float[Array, " 4"], batch: Float[Array, "batch entries"], inputs: ModelInputs, cfg: StaticConfig
):
    """As `levels`; the second result is the derivatives by the entries `inputs.free` [batch, rows, directions]."""
    along = jax.nn.one_hot(inputs.free, batch.shape[-1])
    return jax.vmap(lambda stroke: _derivatives(lambda x: _level(string, 0.0, x, inputs, cfg), stroke, along))(batch)


def _derivatives(function: Callable, at, directions):
    """Value, derivatives in the last axis, and second result of `function`, whose second result has no derivatives."""
    jvp = functools.partial(jax.jvp, function, (at,), has_aux=True)
    return jax.vmap(lambda direction: jvp((direction,)), out_axes=(None, -1, None))(directions)


@persistent_jit
def levels_per_string(strings, cents, batch, inputs: ModelInputs, cfg: StaticConfig):
    """As `levels`, with one string per stroke [batch, 4], sharper by its `cents` [batch]."""
    return jax.vmap(lambda string, c, stroke: _level(string, c, stroke, inputs, cfg))(strings, cents, batch)


@persistent_jit
def level_jacobians_per_string(strings, cents, batch, inputs: ModelInputs, cfg: StaticConfig):
    """As `levels_per_string`, with derivatives by string and entries `inputs.free` [batch, rows, 4 + directions]."""
    size = STRING_SIZE + batch.shape[-1]
    entries = jnp.where(inputs.free < 0, -1, inputs.free + STRING_SIZE)
    along = jax.nn.one_hot(jnp.concatenate([jnp.arange(STRING_SIZE), entries]), size)

    def jacobian(string, c, stroke):
        def level(x):
            return _level(x[:STRING_SIZE], c, x[STRING_SIZE:], inputs, cfg)

        return _derivatives(level, jnp.concatenate([string, stroke]), along)

    return jax.vmap(jacobian)(strings, cents, batch)


@functools.cache
def thread_pool() -> ThreadPoolExecutor:
    """One thread per core that this process may use: XLA works outside of Python's lock."""
    return ThreadPoolExecutor(cores())


def run_in_batches(
    program: Callable, batch: tuple, inputs: Any, cfg: Any, size: int = BATCH_SIZE
) -> tuple[np.ndarray, ...]:
    """Run `program` on any number of strokes, `size` at a time, on all cores.

    Parameters
    ----------
    batch : the program's arguments with a leading axis of strokes; one string for all [4] may precede them.
    """
    *common, arrays = (batch[:1], batch[1:]) if batch[0].ndim == 1 else (batch,)
    count = len(arrays[0])
    padded = [np.concatenate([x, np.repeat(x[-1:], -count % size, axis=0)]) for x in arrays]

    def run(at: int) -> list[np.ndarray]:
        return [np.asarray(x) for x in program(*sum(common, ()), *(x[at : at + size] for x in padded), inputs, cfg)]

    parts = list(thread_pool().map(run, range(0, len(padded[0]), size)))
    return tuple(np.concatenate(column)[:count] for column in zip(*parts, strict=True))
