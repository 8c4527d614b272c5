"""Eq. 19 on the damped circle, as the searches see it: of a recording, and of the string and hammer that are searched.

A recording enters as a `Goal`: |S|² on the criterion's cells, one cell of frequencies around each partial. With the
model's |Y|² there it gives C = ½ ∫ (|Y|² - |S|²)² dω, made dimensionless by the recording's own ½ ∫ |S|⁴ dω over the
same cells: 0 for equal spectra, 1 for silence.

|Y|² = |T̂|² |H|² δt². A pulse is short beside the inverse width of a cell, over which its transform T̂ is smooth: T̂ is
computed at a few Chebyshev nodes and interpolated, exactly to 1e-9. While the string is held nothing else changes.

Derivatives come through automatic differentiation, which gives ∇C = 2 ∫ (|Y|² - |S|²) Re(Ȳ ∇Y) dω; the paper prints
|Y| ∇Y.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.polynomial.chebyshev import chebpts1, chebvander

from ..criterion import BANDS, ENOUGH_DAMPING, NODES, band_of, cell_grid, closed_form_gain
from ..inference.batched_model import run_in_batches
from ..model.contact import impulse_amplitude, kernel_rows, strike
from ..model.damped_sums import transform
from ..model.free_response import ringing_transform
from ..model.modal_response import z_transform_at_poles
from ..model.modes import Modes, mode_table
from ..model.program_cache import persistent_jit
from ..parameters import Geometry, Hammer, String
from .descent import LeastSquares

__all__ = [
    "StaticConfig",
    "Goal",
    "Scene",
    "damped_spectrum",
    "fix_string",
    "residuals",
    "spectral_goal",
    "struck_gradients",
]

# Rows of a goal come in whole multiples of this, so that notes share compiled programs; the first band has one row.
ROWS = 16
# Cells are laid out on multiples of this times σ, Hz: next to nothing beside the linewidth σ/2π.
FINE = 1e-6
# Chebyshev nodes a cell.
SMOOTH = 12
# Where they lie, in [-1, 1], and the matrix from values there to values at the cell's own nodes.
PLACES = chebpts1(SMOOTH)
SPREAD_OUT = chebvander(np.linspace(-1, 1, NODES), SMOOTH - 1) @ np.linalg.inv(chebvander(PLACES, SMOOTH - 1))
# Modes of which what is cut off at the recording's end is summed.
NEAREST = 5
# The steps are some 1.6 contacts long; the force is largest here.
MIDDLE = 0.3
# Hammers of one call at most: so many share a compiled program.
BATCH = 32

# Arrays: NumPy's outside of compiled programs, traced inside.
Values = Any


class Goal(NamedTuple):
    """|S|² of a recording on the cells of some partials, padded with rows of weight 0."""

    frequency: Values  # Hz, [rows, nodes]
    energy: Values  # |S|², unit² · s², [rows, nodes]
    weight: Values  # [rows, nodes]: Σ (weight · difference)² is C
    sigma: Values  # 1/s
    factor: Values  # on the model's energy: of a sound that began before the recording's first sample
    span: Values  # s, from where the model's sound begins to where the recording is cut
    calibrated: Values  # 1: the gain is 1; 0: the gain is free


class StaticConfig(NamedTuple):
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


class FixedString(NamedTuple):
    """A string that is held, as a hammer meets it."""

    mobility: Array  # |H|² δt² [rows, nodes]
    rows: Array  # of the kernel
    real: Array  # of ζ^n at the Chebyshev nodes [steps, rows · SMOOTH]: T̂ is then one matrix product
    imag: Array
    modes: Modes


# --- the recording ----------------------------------------------------------------------------------------------------


def spectral_goal(
    samples: np.ndarray, rate: float, f0: float, B: float, last: int, sigma: float, *, bands: Sequence[int] = (0, 1, 2),
    delay: float = 0.0, unit: float = 1.0, calibrated: bool = True,
) -> Goal:  # fmt: skip
    """Eq. 19's view of a recording.

    Parameters
    ----------
    samples : [samples], from the onset on.
    f0, B : of the partials k f0 √(1 + B k²), Hz; they fix the cells and the borders of the bands during a fit.
    last : number of the last partial.
    sigma : 1/s.
    bands : indices into `BANDS`: the partials that count.
    delay : from where the model's sound begins to the first sample, s.
    unit : of the model's signal, per unit of `samples`.
    calibrated : False leaves the gain free, in closed form.

    Raises
    ------
    ValueError
        If the bands hold no partial up to `last`.
    """
    rows = np.flatnonzero(np.isin(band_of(np.arange(1, last + 1)), bands))
    if not rows.size:
        raise ValueError(f"bands={[BANDS[b] for b in bands]} hold no partial up to the {last}th")
    cells = cell_grid(f0, B, last, sigma, FINE * sigma)
    frequency, spacing = cells.frequency[rows], cells.spacing[rows]
    n = min(len(samples), math.ceil(ENOUGH_DAMPING / sigma * rate))
    energy = np.abs(damped_spectrum(samples[:n], rate, frequency, sigma) * unit) ** 2
    weight = np.sqrt(spacing / (spacing[:, None] * energy**2).sum())
    more = 0 if len(rows) == 1 else -len(rows) % ROWS
    fields = (
        np.pad(frequency, ((0, more), (0, 0)), mode="edge"), np.pad(energy, ((0, more), (0, 0))),
        np.pad(np.tile(weight[:, None], frequency.shape[1]), ((0, more), (0, 0))),
        sigma, math.exp(2 * sigma * delay), n / rate + delay, float(calibrated),
    )  # fmt: skip
    return Goal(*(np.asarray(x, float) for x in fields))


def damped_spectrum(samples: np.ndarray, rate: float, frequency: np.ndarray, sigma: float) -> np.ndarray:
    """Σ s_n exp(-(σ + jω) n/rate)/rate at any `frequency`, Hz [...]."""
    return (
        z_transform_at_poles(-(sigma + 2j * np.pi * frequency.ravel()) / rate, samples).reshape(frequency.shape) / rate
    )


def residuals(energy: Float[Array | np.ndarray, "rows nodes"], goal: Goal) -> Float[Array, " bins"]:
    """Residuals, of which half the sum of squares is C (eq. 19, dimensionless), from the model's |Y|².

    A recording that is not calibrated leaves the gain free: it is the one that makes C least.
    """
    energy = goal.factor * energy
    gain = jnp.where(goal.calibrated > 0, 1.0, closed_form_gain(energy, goal.energy, goal.weight**2, jnp))
    difference = gain * energy - goal.energy
    return math.sqrt(2.0) * (goal.weight * difference).ravel()


# --- the string and the hammer ----------------------------------------------------------------------------------------


def _string(z: Array, goal: Goal, scene: Scene, cfg: StaticConfig) -> tuple[Array, Array, Modes]:
    """A string as a hammer meets it: |H|² δt² [rows, nodes], the kernel's rows, and the table."""
    string = String(*jnp.exp(z[:4]))
    modes = mode_table(string, scene.geometry, rate=scene.rate, n_modes=cfg.n_modes, quantity=cfg.quantity)
    return _mobility(modes, goal, MIDDLE * cfg.steps), kernel_rows(modes, cfg.steps), modes


def _log_zeta(frequency: Array, goal: Goal, step: Array) -> Array:
    return -(goal.sigma + 2j * jnp.pi * frequency) * step


def _mobility(modes: Modes, goal: Goal, pulse: float) -> Float[Array, "rows nodes"]:
    """|H|² δt² of a string struck by a pulse whose middle comes after so many steps."""
    residue, log_z = modes.pickup * impulse_amplitude(modes), modes.pole * modes.step
    log_zeta, steps = _log_zeta(goal.frequency, goal, modes.step), goal.span / modes.step - pulse
    # What is cut off where the recording ends, as if the whole pulse had come in its middle: so it is near a mode.
    nearest = jnp.searchsorted(modes.pole.imag, 2 * jnp.pi * goal.frequency.mean(axis=1)) - (NEAREST + 1) // 2
    nearest = jnp.clip(nearest, 0, len(residue) - NEAREST)[:, None, None] + jnp.arange(NEAREST)
    left = residue[nearest] * jnp.exp(steps * log_z[nearest])
    tail = jnp.exp(steps * log_zeta) * ringing_transform(left, log_z[nearest], log_zeta)
    total = ringing_transform(residue, log_z, log_zeta) - tail
    return (total.real**2 + total.imag**2) * modes.step**2


def _smooth(goal: Goal, step: Array) -> Array:
    """log ζ at the Chebyshev nodes of all cells [rows · SMOOTH]."""
    first, last = goal.frequency[:, :1], goal.frequency[:, -1:]
    return _log_zeta((first + last) / 2 + (last - first) / 2 * PLACES, goal, step).ravel()


def _residuals(
    z: Float[Array, " 5"], mobility: Array, rows: Array | None, modes: Modes, pushed: Callable, goal: Goal,
    scene: Scene, cfg: StaticConfig,
) -> Float[Array, " bins"]:  # fmt: skip
    """Of a hammer on a string; `pushed` gives T̂'s real and imaginary part at the Chebyshev nodes.

    Infinite for a contact that does not end, and for a felt that is out of bounds.
    """
    _, mu, p, mass, velocity = jnp.exp(z)
    stiffness = z[0] - p * scene.log_u
    pulse = strike(modes, Hammer(jnp.exp(stiffness), mu, p, mass, velocity), steps=cfg.steps, rows=rows)
    energy = mobility * sum((part.reshape(-1, SMOOTH) @ SPREAD_OUT.T) ** 2 for part in pushed(pulse.drive))
    inside = (stiffness >= scene.stiff[0]) & (stiffness <= scene.stiff[1])
    return jnp.where((pulse.compression[-1] <= 0) & inside, residuals(energy, goal), jnp.inf)


@persistent_jit
def struck_gradients(z, goal: Goal, scene: Scene, cfg: StaticConfig):
    """C [starts] and its gradient by all nine search coordinates `z` [starts, 9]."""

    def cost(x: Array) -> Array:
        mobility, _, modes = _string(x, goal, scene, cfg)
        log_zeta = _smooth(goal, modes.step)

        def pushed(drive: Array) -> tuple[Array, Array]:
            # From about the pulse's middle, where its phase turns least.
            turned = transform(drive, log_zeta) * jnp.exp(-1j * log_zeta.imag * MIDDLE * cfg.steps)
            return turned.real, turned.imag

        return 0.5 * (_residuals(x[4:], mobility, None, modes, pushed, goal, scene, cfg) ** 2).sum()

    return jax.vmap(jax.value_and_grad(cost))(z)


def fix_string(
    z: Float[Array | np.ndarray, " 9"],
    lower: np.ndarray,
    upper: np.ndarray,
    goal: Goal,
    scene: Scene,
    cfg: StaticConfig,
) -> LeastSquares:
    """C of hammers [n, 5] between the edges `lower` and `upper` [5], on the string of `z`, which is computed once."""
    mobility, rows, real, imag, *modes = held_string(z, goal, scene, cfg)
    held = FixedString(mobility, rows, real, imag, Modes(*modes))

    def each(program: Callable, z: np.ndarray) -> tuple[np.ndarray, ...]:
        return run_in_batches(partial(program, held, goal), (z,), scene, cfg, min(BATCH, len(z)))

    return LeastSquares(lambda z: each(hammer_costs, z)[0], lambda z: each(hammer_residuals, z), lower, upper)


@persistent_jit
def held_string(z, goal: Goal, scene: Scene, cfg: StaticConfig):
    """The parts of `Held`, its table last."""
    mobility, rows, modes = _string(z, goal, scene, cfg)
    log_zeta = _smooth(goal, modes.step)
    powers = jnp.exp(jnp.arange(cfg.steps)[:, None] * log_zeta - 1j * log_zeta.imag * MIDDLE * cfg.steps)
    return mobility, rows, powers.real, powers.imag, *modes


def _on_held(
    z: Float[Array, " 5"], held: FixedString, goal: Goal, scene: Scene, cfg: StaticConfig
) -> Float[Array, " bins"]:
    def pushed(drive: Array) -> tuple[Array, Array]:
        return drive @ held.real, drive @ held.imag

    return _residuals(z, held.mobility, held.rows, held.modes, pushed, goal, scene, cfg)


@persistent_jit
def hammer_costs(held: FixedString, goal: Goal, z, scene: Scene, cfg: StaticConfig):
    """C [chains] of hammers `z` [chains, 5] on a string that is held."""
    return (jax.vmap(lambda x: 0.5 * (_on_held(x, held, goal, scene, cfg) ** 2).sum())(z),)


@persistent_jit
def hammer_residuals(held: FixedString, goal: Goal, z, scene: Scene, cfg: StaticConfig):
    """Residuals [starts, bins], of which half the sum of squares is C, and their Jacobian [starts, bins, 5]."""

    def twice(x: Array) -> tuple[Array, Array]:
        value = _on_held(x, held, goal, scene, cfg)
        return value, value

    jacobian, value = jax.vmap(jax.jacfwd(twice, has_aux=True))(z)
    return value, jacobian
