"""Eq. 19 on the damped circle, as the searches see it.

A recording enters as a `Goal`: |S|² on the criterion's cells, one cell of frequencies around each partial. With the
model's |Y|² there it gives C = ½ ∫ (|Y|² - |S|²)² dω, made dimensionless by the recording's own ½ ∫ |S|⁴ dω over the
same cells: 0 for equal spectra, 1 for silence.

Derivatives come through automatic differentiation, which gives ∇C = 2 ∫ (|Y|² - |S|²) Re(Ȳ ∇Y) dω; the paper prints
|Y| ∇Y.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..criterion import BANDS, ENOUGH_DAMPING, band_of, cell_grid, closed_form_gain

__all__ = ["Goal", "Values", "damped_spectrum", "miss", "spectral_goal"]

# Rows of a goal come in whole multiples of this, so that notes share compiled programs; the first band has one row.
ROWS = 16
# Samples that one matrix product turns together.
BLOCK = 1024
# Cells are laid out on multiples of this times σ, Hz: next to nothing beside the linewidth σ/2π.
FINE = 1e-6


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
    """Σ s_n exp(-(σ + jω) n/rate)/rate at any `frequency`, Hz [...]: with n = 1024 i + j it is one matrix product."""
    blocks = np.pad(samples, (0, -len(samples) % BLOCK)).reshape(-1, BLOCK)
    turn = -(sigma + 2j * np.pi * frequency.ravel()) / rate
    within = np.exp(np.outer(turn, np.arange(BLOCK)))
    sums = np.real(within) @ blocks.T + 1j * (np.imag(within) @ blocks.T)
    total = (sums * np.exp(np.outer(turn, BLOCK * np.arange(len(blocks))))).sum(axis=1) / rate
    return total.reshape(frequency.shape)


def miss(energy: Float[Array | np.ndarray, "rows nodes"], goal: Goal) -> Float[Array, " bins"]:
    """Residuals, of which half the sum of squares is C (eq. 19, dimensionless), from the model's |Y|².

    A recording that is not calibrated leaves the gain free: it is the one that makes C least.
    """
    energy = goal.factor * energy
    gain = jnp.where(goal.calibrated > 0, 1.0, closed_form_gain(energy, goal.energy, goal.weight**2, jnp))
    difference = gain * energy - goal.energy
    return math.sqrt(2.0) * (goal.weight * difference).ravel()
