"""Eq. 19 for any model of a sound, on the damped circle.

What a fit needs of a model is one small interface, `SoundModel`: positive parameters in a box, and a function from them
to a spectrum. A recording enters as a `Goal`: |S|² on the criterion's cells, one cell of frequencies around each
partial. The two meet in C = ½ ∫ (|Y|² - |S|²)² dω, made dimensionless by the recording's own ½ ∫ |S|⁴ dω over the same
cells: 0 for equal spectra, 1 for silence.

All searches go over logarithms of the parameters. Derivatives come through automatic differentiation, which gives
∇C = 2 ∫ (|Y|² - |S|²) Re(Ȳ ∇Y) dω; the paper prints |Y| ∇Y.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from ..criterion import BANDS, band_of, cell_grid
from ..criterion.energy import ENOUGH_DAMPING
from ..model.contact import strike
from ..model.modes import mode_table
from ..model.response import spectrum
from ..parameters import FIT_NAMES, PARAMETERS, Geometry, Hammer, String

__all__ = [
    "Goal",
    "SoundModel",
    "best_gain",
    "gradient_batch",
    "miss",
    "model_energy",
    "residual_batch",
    "spectral_goal",
    "struck_model",
]

# Rows of a goal come in whole multiples of this, so that notes share compiled programs; the first band has one row.
ROWS = 16
BLOCK = 1024
# Cells are laid out on multiples of this times σ, Hz: next to nothing beside the linewidth σ/2π.
FINE = 1e-6


class SoundModel(NamedTuple):
    """A model as a fit sees it.

    `spectrum(values, frequency, sigma)` returns Y = ∫ y exp(-(σ + jω)t) dt, complex [bins], signal unit · s, at
    `frequency`, Hz [bins], and `sigma`, 1/s, for the natural `values` [parameters] in the order of `names`. It is made
    of JAX functions, for `jit`, `vmap` and derivatives. t = 0 is where the sound begins.
    """

    names: tuple[str, ...]
    lower: Sequence[float]  # natural units, above 0; where `lower` and `upper` are equal the parameter is held
    upper: Sequence[float]
    spectrum: Callable[[Array, Array, Array], Complex[Array, " bins"]]


class Goal(NamedTuple):
    """|S|² of a recording on the cells of some partials, padded with rows of weight 0."""

    frequency: Array  # Hz, [rows, nodes]
    energy: Array  # |S|², unit² · s², [rows, nodes]
    weight: Array  # [rows, nodes]: Σ (weight · difference)² is C
    sigma: Array  # 1/s
    factor: Array  # on the model's energy: of a sound that began before the recording's first sample
    span: Array  # s, from where the model's sound begins to where the recording is cut
    calibrated: Array  # 1: the gain is 1; 0: the gain is free


def spectral_goal(
    samples: np.ndarray, rate: float, f0: float, B: float, last: int, sigma: float, *, bands: Sequence[int] = (0, 1, 2),
    delay: float = 0.0, unit: float = 1.0, calibrated: bool = True, every: int = 1,
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
    every : only every so manieth node of the cells, which stand twice as close as noise is shared.

    Raises
    ------
    ValueError
        If the bands hold no partial up to `last`.
    """
    rows = np.flatnonzero(np.isin(band_of(np.arange(1, last + 1)), bands))
    if not rows.size:
        raise ValueError(f"bands={[BANDS[b] for b in bands]} hold no partial up to the {last}th")
    cells = cell_grid(f0, B, last, sigma, FINE * sigma)
    frequency, spacing = cells.frequency[rows, ::every], cells.spacing[rows]
    n = min(len(samples), math.ceil(ENOUGH_DAMPING / sigma * rate))
    energy = np.abs(damped_spectrum(samples[:n], rate, frequency, sigma) * unit) ** 2
    weight = np.sqrt(spacing / (spacing[:, None] * energy**2).sum())
    more = 0 if len(rows) == 1 else -len(rows) % ROWS
    fields = (
        np.pad(frequency, ((0, more), (0, 0)), mode="edge"), np.pad(energy, ((0, more), (0, 0))),
        np.pad(np.tile(weight[:, None], frequency.shape[1]), ((0, more), (0, 0))),
        sigma, math.exp(2 * sigma * delay), n / rate + delay, float(calibrated),
    )  # fmt: skip
    return Goal(*(jnp.asarray(x, float) for x in fields))


def damped_spectrum(samples: np.ndarray, rate: float, frequency: np.ndarray, sigma: float) -> np.ndarray:
    """Σ s_n exp(-(σ + jω) n/rate)/rate at any `frequency`, Hz [...]: with n = 1024 i + j it is one matrix product."""
    blocks = np.pad(samples, (0, -len(samples) % BLOCK)).reshape(-1, BLOCK)
    turn = -(sigma + 2j * np.pi * frequency.ravel()) / rate
    within = np.exp(np.outer(turn, np.arange(BLOCK)))
    sums = np.real(within) @ blocks.T + 1j * (np.imag(within) @ blocks.T)
    total = (sums * np.exp(np.outer(turn, BLOCK * np.arange(len(blocks))))).sum(axis=1) / rate
    return total.reshape(frequency.shape)


def best_gain(energy: Float[Array, "rows nodes"], goal: Goal) -> Array:
    """The g² ≥ 0 on the model's |Y|² that makes C least; 1 for a calibrated recording."""
    model = goal.weight * goal.factor * energy
    best = (model * goal.weight * goal.energy).sum() / jnp.maximum((model**2).sum(), 1e-300)
    return jnp.where(goal.calibrated > 0, 1.0, jnp.maximum(best, 0.0))


def miss(energy: Float[Array, "rows nodes"], goal: Goal) -> Float[Array, " bins"]:
    """Residuals, of which half the sum of squares is C (eq. 19, dimensionless), from the model's |Y|²."""
    difference = best_gain(energy, goal) * goal.factor * energy - goal.energy
    return math.sqrt(2.0) * (goal.weight * difference).ravel()


def model_energy(model: SoundModel, z: Float[Array, " parameters"], goal: Goal) -> Float[Array, "rows nodes"]:
    """|Y|² of a model at the logarithms `z` of its values."""
    y = model.spectrum(jnp.exp(z), goal.frequency.ravel(), goal.sigma)
    return (y.real**2 + y.imag**2).reshape(goal.frequency.shape)


def residual_batch(model: SoundModel) -> Callable:
    """Return f(z [starts, parameters], goal) -> residuals [starts, bins] and their Jacobian [starts, bins, parameters].

    Half the sum of squares is C. Compiled once for each shape of `goal`.
    """

    def both(z: Array, goal: Goal) -> tuple[Array, Array]:
        def twice(x: Array) -> tuple[Array, Array]:
            value = miss(model_energy(model, x, goal), goal)
            return value, value

        jacobian, value = jax.jacfwd(twice, has_aux=True)(z)
        return value, jacobian

    return jax.jit(jax.vmap(both, in_axes=(0, None)))


def gradient_batch(model: SoundModel) -> Callable:
    """Return f(z [starts, parameters], goal) -> C [starts] and its gradient [starts, parameters]."""

    def cost(z: Array, goal: Goal) -> Array:
        return 0.5 * (miss(model_energy(model, z, goal), goal) ** 2).sum()

    return jax.jit(jax.vmap(jax.value_and_grad(cost), in_axes=(0, None)))


def struck_model(
    geometry: Geometry, *, rate: float, n_modes: int, steps: int, quantity: str = "velocity"
) -> SoundModel:
    """The paper's string and hammer: nine parameters, in the order of `FIT_NAMES`.

    Parameters
    ----------
    rate : steps per second of the contact, Hz.
    n_modes, steps : rows of the table, and steps in which the contact must end.
    """

    def spectrum_of(values: Array, frequency: Array, sigma: Array) -> Array:
        modes = mode_table(String(*values[:4]), geometry, rate=rate, n_modes=n_modes, quantity=quantity)
        return spectrum(modes, strike(modes, Hammer(*values[4:]), steps=steps).drive, frequency, sigma)  # pyright: ignore[reportArgumentType]

    box = [PARAMETERS[name] for name in FIT_NAMES]
    return SoundModel(FIT_NAMES, [p.lower for p in box], [p.upper for p in box], spectrum_of)
