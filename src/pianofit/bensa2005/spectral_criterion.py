"""Eq. 19 on the damped circle, with gradients, as a function of string and hammer.

A `Goal` holds |S|² of a recording on the criterion's cells, one cell of frequencies around each partial. With the
model's |Y|² on the same cells, C = ½ ∫ (|Y|² - |S|²)² dω. C is divided by ½ ∫ |S|⁴ dω over the same cells, so that it
is 0 for equal spectra and 1 for silence.

|Y|² = |T̂|² |H|² δt². The force pulse is short compared with the inverse width of a cell, so its transform T̂ is smooth
there. T̂ is computed at a few Chebyshev nodes and interpolated, with an error below 1e-9. With a fixed string only T̂
changes.

Automatic differentiation gives ∇C = 2 ∫ (|Y|² - |S|²) Re(Ȳ ∇Y) dω; the paper prints |Y| ∇Y.
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

from ..criterion import ENOUGH_DAMPING, NODES, band_of, cell_grid, closed_form_gain
from ..dsp.damped_sums import z_transform_at_poles
from ..inference import run_in_batches
from ..model.contact import impulse_amplitude, kernel_rows, strike
from ..model.differentiable_sums import z_transform
from ..model.free_response import modal_transform
from ..model.modes import Modes, mode_table
from ..model.program_cache import persistent_jit
from ..parameters import Geometry, Hammer, String
from .descent import LeastSquares

# Goals are padded to a multiple of this many rows, so that notes share compiled programs. The first band has one row.
ROWS = 16
# Spacing of the grid on which cells are laid out, in units of σ, Hz: negligible compared with the linewidth σ/2π.
FINE = 1e-6
# Chebyshev nodes per cell,
SMOOTH = 12
# their positions in [-1, 1], and the matrix that interpolates from them to the nodes of the cell.
PLACES = chebpts1(SMOOTH)
INTERPOLATION = chebvander(np.linspace(-1, 1, NODES), SMOOTH - 1) @ np.linalg.inv(chebvander(PLACES, SMOOTH - 1))
# Modes around a cell whose truncation at the end of the recording is computed.
NEAREST = 5
# Time of the largest force, as a share of the steps, which cover some 1.6 contacts.
MIDDLE = 0.3
# Most hammers in one call, so that all calls share a compiled program.
BATCH = 32

# Arrays: NumPy's outside of compiled programs, traced inside.
Values = Any


class Goal(NamedTuple):
    """|S|² of a recording on the cells of some partials, padded with rows of weight 0."""

    frequency: Values  # Hz, [rows, nodes]
    energy: Values  # |S|², unit² · s², [rows, nodes]
    weight: Values  # [rows, nodes]: Σ (weight · difference)² is C
    sigma: Values  # 1/s
    factor: Values  # on the model's energy, for a sound that begins before the first sample of the recording
    span: Values  # s, from the start of the model's sound to the end of the recording
    calibrated: Values  # 1: the gain is 1; 0: the gain is free


class StaticConfig(NamedTuple):
    """Static arguments of a compiled program."""

    n_modes: int
    steps: int
    quantity: str


class SearchConstants(NamedTuple):
    """Constants of a search over string and hammer."""

    geometry: Geometry
    rate: Values  # sampling rate of the contact, Hz
    log_u: Values  # log of the reference compression, m, of the felt's force
    log_stiffness_bounds: Values  # [2], logs of the least and the largest felt stiffness


class FixedString(NamedTuple):
    """Precomputed response of a fixed string."""

    mobility: Array  # |H|² δt² [rows, nodes]
    rows: Array  # of the kernel
    real: Array  # of ζ^n at the Chebyshev nodes [steps, rows · SMOOTH], so that T̂ is one matrix product
    imag: Array
    modes: Modes


# --- the recording ----------------------------------------------------------------------------------------------------


def spectral_goal(
    samples: np.ndarray,
    rate: float,
    f0: float,
    B: float,
    last: int,
    sigma: float,
    *,
    bands: Sequence[int] = (0, 1, 2),
    delay: float = 0.0,
    unit: float = 1.0,
    calibrated: bool = True,
) -> Goal:
    """Return the `Goal` of a recording.

    Parameters
    ----------
    samples : [samples], from the onset on.
    f0, B : of the partials k f0 √(1 + B k²), Hz; they set the cells and the limits of the bands, which a fit keeps.
    last : number of the last partial.
    sigma : 1/s.
    bands : indices into `criterion.BANDS` of the bands that the criterion uses. They contain a partial.
    delay : time from the start of the model's sound to the first sample, s.
    unit : unit of the model's signal, per unit of `samples`.
    calibrated : if False, the gain is free and computed in closed form.
    """
    rows = np.flatnonzero(np.isin(band_of(np.arange(1, last + 1)), bands))
    cells = cell_grid(f0, B, last, sigma, FINE * sigma)
    frequency, spacing = cells.frequency[rows], cells.spacing[rows]
    n = min(len(samples), math.ceil(ENOUGH_DAMPING / sigma * rate))
    energy = np.abs(damped_spectrum(samples[:n], rate, frequency, sigma) * unit) ** 2
    weight = np.sqrt(spacing / (spacing[:, None] * energy**2).sum())
    padding = 0 if len(rows) == 1 else -len(rows) % ROWS
    fields = (
        np.pad(frequency, ((0, padding), (0, 0)), mode="edge"),
        np.pad(energy, ((0, padding), (0, 0))),
        np.pad(np.tile(weight[:, None], frequency.shape[1]), ((0, padding), (0, 0))),
        sigma,
        math.exp(2 * sigma * delay),
        n / rate + delay,
        float(calibrated),
    )
    return Goal(*(np.asarray(x, float) for x in fields))


def damped_spectrum(samples: np.ndarray, rate: float, frequency: np.ndarray, sigma: float) -> np.ndarray:
    """Σ s_n exp(-(σ + jω) n/rate)/rate at any `frequency`, Hz [...]."""
    return (
        z_transform_at_poles(-(sigma + 2j * np.pi * frequency.ravel()) / rate, samples).reshape(frequency.shape) / rate
    )


def residuals(energy: Float[Array | np.ndarray, "rows nodes"], goal: Goal) -> Float[Array, " bins"]:
    """Return residuals for the model's |Y|². Half their sum of squares is C (eq. 19, dimensionless).

    For a recording that is not calibrated, the gain is the one that minimises C.
    """
    energy = goal.factor * energy
    gain = jnp.where(goal.calibrated > 0, 1.0, closed_form_gain(energy, goal.energy, goal.weight**2, jnp))
    difference = gain * energy - goal.energy
    return math.sqrt(2.0) * (goal.weight * difference).ravel()


# --- the string and the hammer ----------------------------------------------------------------------------------------


def _string(z: Array, goal: Goal, scene: SearchConstants, cfg: StaticConfig) -> tuple[Array, Array, Modes]:
    """Return |H|² δt² [rows, nodes] of a string, the rows of its kernel, and its modes."""
    string = String(*jnp.exp(z[:4]))
    modes = mode_table(string, scene.geometry, rate=scene.rate, n_modes=cfg.n_modes, quantity=cfg.quantity)
    return _mobility(modes, goal, MIDDLE * cfg.steps), kernel_rows(modes, cfg.steps), modes


def _log_zeta(frequency: Array, goal: Goal, step: Array) -> Array:
    return -(goal.sigma + 2j * jnp.pi * frequency) * step


def _mobility(modes: Modes, goal: Goal, pulse: float) -> Float[Array, "rows nodes"]:
    """|H|² δt² of a string struck by a pulse whose middle lies `pulse` steps after its start."""
    residue, log_z = modes.pickup * impulse_amplitude(modes), modes.pole * modes.step
    log_zeta, steps = _log_zeta(goal.frequency, goal, modes.step), goal.span / modes.step - pulse
    # Truncation at the end of the recording, with the whole pulse placed at its middle: accurate near a mode.
    nearest = jnp.searchsorted(modes.pole.imag, 2 * jnp.pi * goal.frequency.mean(axis=1)) - (NEAREST + 1) // 2
    nearest = jnp.clip(nearest, 0, len(residue) - NEAREST)[:, None, None] + jnp.arange(NEAREST)
    left = residue[nearest] * jnp.exp(steps * log_z[nearest])
    tail = jnp.exp(steps * log_zeta) * modal_transform(left, log_z[nearest], log_zeta)
    total = modal_transform(residue, log_z, log_zeta) - tail
    return (total.real**2 + total.imag**2) * modes.step**2


def _smooth(goal: Goal, step: Array) -> Array:
    """log ζ at the Chebyshev nodes of all cells [rows · SMOOTH]."""
    first, last = goal.frequency[:, :1], goal.frequency[:, -1:]
    return _log_zeta((first + last) / 2 + (last - first) / 2 * PLACES, goal, step).ravel()


def _residuals(
    z: Float[Array, " 5"],
    mobility: Array,
    rows: Array | None,
    modes: Modes,
    pushed: Callable,
    goal: Goal,
    scene: SearchConstants,
    cfg: StaticConfig,
) -> Float[Array, " bins"]:
    """Residuals for a hammer on a string; `pushed` gives real and imaginary part of T̂ at the Chebyshev nodes.

    They are infinite for a contact that does not end and for a felt stiffness out of bounds.
    """
    _, mu, p, mass, velocity = jnp.exp(z)
    stiffness = z[0] - p * scene.log_u
    pulse = strike(modes, Hammer(jnp.exp(stiffness), mu, p, mass, velocity), steps=cfg.steps, rows=rows)
    energy = mobility * sum((part.reshape(-1, SMOOTH) @ INTERPOLATION.T) ** 2 for part in pushed(pulse.drive))
    inside = (stiffness >= scene.log_stiffness_bounds[0]) & (stiffness <= scene.log_stiffness_bounds[1])
    return jnp.where((pulse.compression[-1] <= 0) & inside, residuals(energy, goal), jnp.inf)


@persistent_jit
def criterion_gradients(z, goal: Goal, scene: SearchConstants, cfg: StaticConfig):
    """Return C [starts] and its gradient by all nine search coordinates `z` [starts, 9]."""

    def cost(x: Array) -> Array:
        mobility, _, modes = _string(x, goal, scene, cfg)
        log_zeta = _smooth(goal, modes.step)

        def pushed(drive: Array) -> tuple[Array, Array]:
            # Relative to the middle of the pulse, where the phase varies least.
            turned = z_transform(drive, log_zeta) * jnp.exp(-1j * log_zeta.imag * MIDDLE * cfg.steps)
            return turned.real, turned.imag

        return 0.5 * (_residuals(x[4:], mobility, None, modes, pushed, goal, scene, cfg) ** 2).sum()

    return jax.vmap(jax.value_and_grad(cost))(z)


def fix_string(
    z: Float[Array | np.ndarray, " 9"],
    lower: np.ndarray,
    upper: np.ndarray,
    goal: Goal,
    scene: SearchConstants,
    cfg: StaticConfig,
) -> LeastSquares:
    """Return C as a function of hammers [n, 5] in the box `lower` to `upper` [5], on the string of `z`."""
    mobility, rows, real, imag, *modes = fixed_string_response(z, goal, scene, cfg)
    fixed = FixedString(mobility, rows, real, imag, Modes(*modes))

    def run(program: Callable, z: np.ndarray) -> tuple[np.ndarray, ...]:
        return run_in_batches(partial(program, fixed, goal), (z,), scene, cfg, min(BATCH, len(z)))

    return LeastSquares(lambda z: run(hammer_costs, z)[0], lambda z: run(hammer_residuals, z), lower, upper)


@persistent_jit
def fixed_string_response(z, goal: Goal, scene: SearchConstants, cfg: StaticConfig):
    """Return the fields of `FixedString`, the modes last."""
    mobility, rows, modes = _string(z, goal, scene, cfg)
    log_zeta = _smooth(goal, modes.step)
    powers = jnp.exp(jnp.arange(cfg.steps)[:, None] * log_zeta - 1j * log_zeta.imag * MIDDLE * cfg.steps)
    return mobility, rows, powers.real, powers.imag, *modes


def _on_fixed_string(
    z: Float[Array, " 5"], fixed: FixedString, goal: Goal, scene: SearchConstants, cfg: StaticConfig
) -> Float[Array, " bins"]:
    def pushed(drive: Array) -> tuple[Array, Array]:
        return drive @ fixed.real, drive @ fixed.imag

    return _residuals(z, fixed.mobility, fixed.rows, fixed.modes, pushed, goal, scene, cfg)


@persistent_jit
def hammer_costs(fixed: FixedString, goal: Goal, z, scene: SearchConstants, cfg: StaticConfig):
    """Return C [chains] of hammers `z` [chains, 5] on a fixed string."""
    return (jax.vmap(lambda x: 0.5 * (_on_fixed_string(x, fixed, goal, scene, cfg) ** 2).sum())(z),)


@persistent_jit
def hammer_residuals(fixed: FixedString, goal: Goal, z, scene: SearchConstants, cfg: StaticConfig):
    """Return residuals [starts, bins], with C as half their sum of squares, and their Jacobian [starts, bins, 5]."""

    def value_and_aux(x: Array) -> tuple[Array, Array]:
        value = _on_fixed_string(x, fixed, goal, scene, cfg)
        return value, value

    jacobian, value = jax.vmap(jax.jacfwd(value_and_aux, has_aux=True))(z)
    return value, jacobian
