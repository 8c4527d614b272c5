"""The model of every table at many θ: levels in batches of strokes, and frequencies and decays of the string.

A stroke [entries] holds the parameters of the hammer and its contact, and the logarithm of the velocity. Their order is
that of `parametrisation.names_of` without the string. Every fit, of one recording or of many, is a number of strokes,
so all fits share the same compiled programs.
"""

from __future__ import annotations

import contextlib
import functools
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..conversions import CENTS, DB
from ..excitation import GEOMETRY_FIELDS
from ..model.note import Note, stroke_levels
from ..model.program_cache import persistent_jit
from ..model.simulate import MAX_MODES
from ..parameters import String
from ..threads import cores
from ..transducer import TRANSDUCERS
from .parametrisation import STRING_SIZE
from .problem import FitProblem, ModelInputs, StaticConfig

# Strokes of one call: enough to fill vector units. With more, short contacts would wait for long ones.
BATCH_SIZE = 8
# The same if each stroke has its own string: the strokes of an ordinary fit.
STRING_BATCH_SIZE = 4
# The same for thousands of hammers: enough for matrix products.
PRESCREEN_BATCH_SIZE = 64
# With the string fixed, steps are longer and modes fewer by this factor: a third of the time.
STEP_COARSENING = 2
# Refinement of the step that estimates the discretisation error of the contact, with all modes of the model.
FINER = 4


def _level(
    log_string: Array, cents: Array | float, stroke: Float[Array, " entries"], inputs: ModelInputs, cfg: StaticConfig
):
    """Levels, dB [rows], from the arrival of the wave at the pickup, and whether the contact ended."""
    c, kappa, *losses = jnp.exp(log_string)
    string = String(c * jnp.exp2(cents / 1200), kappa, *losses)  # another tension
    logs = dict(zip((*cfg.law.columns, cfg.law.stroke.name), stroke, strict=True))
    values = {name: jnp.exp(log) for name, log in logs.items()}
    if cfg.law.power:  # the entry is the force at the reference compression, unless that is 0
        stiffness, u = cfg.law.power[0], inputs.reference_compression
        power = cfg.law.log_power(jnp.where(u > 0, u, 1.0), values, jnp)
        values[stiffness] = jnp.exp(logs[stiffness] - jnp.where(u > 0, power, 0.0))
    hammer = cfg.law.make_hammer(values, jnp.zeros_like(values[cfg.law.stroke.name]))
    places = {field: values[name] for name, field in GEOMETRY_FIELDS.items() if name in values}
    note = Note(string, hammer, inputs.geometry._replace(**places), cfg.quantity, 1.0)
    return stroke_levels(note, inputs.rate, cfg.n_modes, cfg.rows, inputs.steps, cfg.knock)


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


def run_in_batches(program: Callable, batch: tuple, inputs: Any, cfg: Any, size: int) -> Any:
    """Run `program` on any number of strokes, `size` at a time, on all cores.

    Parameters
    ----------
    batch : the program's arguments with a leading axis of strokes; one string for all [4] may precede them.
    """
    *common, arrays = (batch[:1], batch[1:]) if batch[0].ndim == 1 else (batch,)
    count = len(arrays[0])
    padded = [np.concatenate([x, np.repeat(x[-1:], -count % size, axis=0)]) for x in arrays]
    starts = range(0, len(padded[0]), size)
    batches = [(*sum(common, ()), *(x[at : at + size] for x in padded)) for at in starts]
    parts = thread_pool().map(lambda own: jax.tree.map(np.asarray, program(*own, inputs, cfg)), batches)
    return jax.tree.map(lambda *column: np.concatenate(column)[:count], *parts)


# --- residuals of the tables ------------------------------------------------------------------------------------------


# Residuals and derivatives of the model in every table, and whether contacts ended [B].
Residuals = tuple[list[tuple[np.ndarray, np.ndarray]], np.ndarray]


class LevelModel:
    """Levels of the recordings at many θ.

    With a `string` [4], it is the string of all θ, and the contact's steps are longer. Without one, every θ has its own
    string, and every stroke the pitch offset with which it was recorded.
    """

    def __init__(self, problem: FitProblem, string: np.ndarray | None = None) -> None:
        self.problem, self.string = problem, string
        self.inputs, self.cfg = problem.model_inputs, problem.cfg
        if string is not None:
            rate, steps = self.inputs.rate / STEP_COARSENING, self.inputs.steps // STEP_COARSENING
            self.inputs = self.inputs._replace(rate=rate, steps=steps)
            self.cfg = self.cfg._replace(n_modes=max(self.cfg.rows, self.cfg.n_modes // STEP_COARSENING))
        self.stroke = np.array(problem.structure.stroke)
        self.cents = problem.observed.cents[[problem.structure.stroke.index(s) for s in range(self.stroke.max() + 1)]]
        # The knock has number 0, and is the last row.
        self.columns = problem.observed.number - 1
        table = problem.observed.level
        self.has_level = table.detected + 0.0  # 1 where a level or a bound of a censored partial exists [R, K]
        self.has_level[tuple(table.censored.T)] = 1.0
        self.by_size = level_slopes(problem)
        self.strokes_computed = 0  # by `levels` and `residuals`

    def stroke_entries(self, theta: np.ndarray) -> np.ndarray:
        """Every stroke at `theta` [B, size]: [B · strokes, entries]."""
        u = self.problem.parametrisation
        theta = u.model_entries(theta)
        hammers = np.repeat(theta[:, STRING_SIZE : u.shared], u.strokes, axis=0)
        return np.concatenate([hammers, theta[:, u.velocities].reshape(-1, 1)], axis=1)

    def size_effect(self, theta: np.ndarray) -> np.ndarray:
        """Change of the levels with the sizes beyond the model's entries, dB [B, 1, K]."""
        return (self.problem.parametrisation.size_changes(theta) @ self.by_size)[:, None]

    def levels(self, strokes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Levels of many strokes on the fixed string, dB [strokes, K], and whether contacts ended."""
        self.strokes_computed += len(strokes)
        batch = self.string, strokes
        level, ended = run_in_batches(levels, batch, self.inputs, self.cfg, PRESCREEN_BATCH_SIZE)
        return level[:, self.columns], ended

    def level_jacobians(self, theta: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Levels, dB [B, R, K], their derivatives [B, R, K, directions], and whether contacts ended [B]."""
        if self.string is None:
            program, batch, size = level_jacobians_per_string, self._strokes_with_strings(theta), STRING_BATCH_SIZE
        else:
            program, batch, size = level_jacobians, (self.string, self.stroke_entries(theta)), BATCH_SIZE
        level, slope, ended = run_in_batches(program, batch, self.inputs, self.cfg, size)
        level = self._by_recording(level) + self.size_effect(theta)
        return level, self._by_recording(slope), np.all(ended.reshape(len(theta), -1), axis=1)

    def residuals(self, theta: np.ndarray, offset: np.ndarray) -> Residuals:
        """Residuals [B, R, K] with derivatives of the model [B, R, K, size], and whether contacts ended [B].

        Parameters
        ----------
        offset : discretisation error of the levels, dB [B, R, K].
        """
        u, table = self.problem.parametrisation, self.problem.observed.level
        self.strokes_computed += len(theta) * u.strokes
        level, slope, ended = self.level_jacobians(theta)
        # The directions are the string's if it is not fixed, the hammer's free entries, the velocity, and padding.
        shared = self.inputs.free[self.inputs.free >= 0][:-1] + STRING_SIZE
        shared = shared if self.string is not None else np.append(np.arange(STRING_SIZE), shared)
        jacobian = np.zeros((*level.shape, u.size))
        jacobian[..., shared] = slope[..., : len(shared)]
        for r, stroke in enumerate(self.stroke):
            jacobian[:, r, :, u.shared + stroke] = slope[:, r, :, len(shared)]
        jacobian[..., u.velocities.stop :] = self.by_size.T
        jacobian = self.has_level[..., None] * u.by_theta(jacobian)
        residual = (table.value - level - offset) * self.has_level
        valid = ended & np.isfinite(jacobian).all(axis=(1, 2, 3))
        residual = np.where(valid[:, None, None], residual, 0.0)
        return [(residual, np.where(valid[:, None, None, None], jacobian, 0.0))], valid

    def discretisation_error_db(self, theta: np.ndarray) -> np.ndarray:
        """Error of the levels at `theta` [B, size] from the contact's step, dB [B, R, K]; extrapolated at order 2."""
        inputs, cfg = self.problem.model_inputs, self.problem.cfg._replace(n_modes=MAX_MODES)
        fine = inputs._replace(rate=inputs.rate * FINER, steps=inputs.steps * FINER)
        batch = self._strokes_with_strings(theta)
        finer = self._by_recording(run_in_batches(levels_per_string, batch, fine, cfg, STRING_BATCH_SIZE)[0])
        finer = finer + self.size_effect(theta)
        # The search's own program, which is compiled anyway.
        change = finer - self.level_jacobians(theta)[0]
        shorter = (fine.rate / self.inputs.rate) ** 2
        return change * shorter / (shorter - 1) * self.has_level

    def _strokes_with_strings(self, theta: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Strings, pitch offsets and strokes [B · strokes, ...]."""
        strings = np.repeat(self.problem.parametrisation.model_entries(theta)[:, :STRING_SIZE], len(self.cents), axis=0)
        return strings, np.tile(self.cents, len(theta)), self.stroke_entries(theta)

    def _by_recording(self, rows: np.ndarray) -> np.ndarray:
        """Select every recording's columns [B, R, K, ...] from the model's rows [B · strokes, rows, ...]."""
        return rows.reshape(-1, len(self.cents), *rows.shape[1:])[:, self.stroke][:, :, self.columns]


def compile_ahead(problem: FitProblem) -> None:
    """Compile or load the programs of a search in the background, in the order in which it needs them.

    XLA compiles on one core. A search that is the first to need a program waits for it. The string's fit, which needs
    none, runs in the meantime.
    """

    def run() -> None:
        theta = problem.parametrisation.mean[None]
        searched, complete = LevelModel(problem, theta[0, :STRING_SIZE]), LevelModel(problem)
        prescreen = functools.partial(searched.levels, searched.stroke_entries(theta))
        programs = searched.level_jacobians, searched.discretisation_error_db, complete.level_jacobians
        for evaluate in (prescreen, *(functools.partial(program, theta) for program in programs)):
            with contextlib.suppress(Exception):  # the search meets the same error, and reports it
                evaluate()

    if cores() > 1:
        threading.Thread(target=run).start()


def level_slopes(problem: FitProblem) -> np.ndarray:
    """Derivatives of the levels by the logarithms of uncertain sizes, beyond the model's entries, dB [sizes, K].

    The unit of the recordings is that of the given scale, so with a larger scale the model is fainter in it. The force
    on the bridge scales with the string mass. A pickup at x on the string gives partial k the factor sin(a), a = kπx/L.
    Its derivative near a node is that of the mean energy over the uncertainty s of a: (sin²a + s²)^½. The time of the
    wave to the pickup changes levels a hundred times less and is neglected.
    """
    u, start = problem.parametrisation, problem.initial_values
    count = len(problem.observed.number)
    slopes = dict.fromkeys(u.sizes, np.zeros(count))
    if problem.calibrated:
        unit = np.full(count, DB)
        slopes |= {"scale": -unit} | ({} if TRANSDUCERS[start.quantity].on_string else {"M_S": unit})
    if TRANSDUCERS[start.quantity].on_string and "pickup" not in u.names:  # else it is an entry of the model
        phase = problem.observed.number * np.pi * start.geometry.pickup / start.geometry.length
        spread = phase * np.hypot(start.relative_sd.get("pickup", 0.0), start.relative_sd.get("L", 0.0))
        # The attack, number 0, passes the pickup as no partial does: its share is not counted.
        size = np.where(phase > 0, np.sin(phase) ** 2 + spread**2, 1.0)
        slope = DB * phase * np.sin(phase) * np.cos(phase) / size
        slopes |= {"pickup": slope, "L": -slope}
    return np.array([slopes[name] for name in u.sizes]).reshape(len(u.sizes), count)


class StringModel:
    """Frequencies and decays of the string at many θ."""

    def __init__(self, problem: FitProblem) -> None:
        self.problem = problem

    def residuals(self, theta: np.ndarray, _: Any) -> Residuals:
        """Residuals of both tables [B, 1, K] with derivatives of the model [B, 1, K, size]; True for every θ [B]."""
        o, u = self.problem.observed, self.problem.parametrisation
        measured, length = (o.frequency.value[0], o.decay.value[0]), float(self.problem.initial_values.geometry.length)
        tables = []
        strings = u.model_entries(theta)[:, :STRING_SIZE]
        points = [string_residuals(string, measured, o.string_number, o.law, length) for string in strings]
        for table in range(len(measured)):
            jacobian = np.zeros((len(theta), 1, len(o.string_number), u.size))
            jacobian[..., :STRING_SIZE] = [slopes[table] for _, slopes in points]
            tables.append((np.array([residuals[table] for residuals, _ in points]), u.by_theta(jacobian)))
        return tables, np.ones(len(theta), bool)


def string_law(string, number, length, xp=np):
    """Frequency, Hz, and decay, 1/s, of partials k [2, K], and their derivatives by `string` [2, K, 4].

    `string` holds the logarithms of c, κ, b1 and b2. Derivatives are of the logarithm of the frequency and of
    the decay. `xp` is the module NumPy or jax.numpy.
    """
    c, kappa, b1, b2 = xp.exp(string)
    s = (number * xp.pi / length) ** 2
    omega2, alpha = c**2 * s + kappa**2 * s**2, b1 + b2 * s
    frequency = xp.sqrt(omega2 - xp.minimum(alpha, 0.9 * xp.sqrt(omega2)) ** 2) / (2 * xp.pi)
    zero = xp.zeros_like(s)
    pitch = xp.stack([c**2 * s / omega2, kappa**2 * s**2 / omega2, zero, zero], axis=-1)
    loss = xp.stack([zero, zero, b1 + zero, b2 * s], axis=-1)
    return xp.stack([frequency, alpha]), xp.stack([pitch, loss])


def string_residuals(string, measured, number, law, length, xp=np):
    """Residuals [1, K] of frequencies, cents, and of log decays, and the derivatives of their models [1, K, 4].

    Parameters
    ----------
    string : logarithms of c, κ, b1 and b2.
    measured : values of the tables, over `law` [K] each.
    number, law : partials k [K] and the reference's string model [2, K]; `length` of the string, m.
    """
    value, slope = string_law(string, number, length, xp)
    models = CENTS * xp.log(value[0] / law[0]), xp.log(value[1] / law[1])
    slopes = CENTS * slope[0], slope[1] / value[1][:, None]
    return [(y - model)[None] for y, model in zip(measured, models, strict=True)], [s[None] for s in slopes]
