"""A strike is a differentiable function: the derivative of the level of every partial by every parameter.

A fit is based on this table. A column of zeros is a parameter that these levels do not determine. If two columns are
multiples of each other, the levels determine only one combination of the two parameters.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import Array

import pianofit

RATE = 88_200.0
PARTIALS = 12


def levels(log_values: Array, geometry: pianofit.Geometry):
    """Levels of the first partials, dB [partials], from the logarithms of the nine parameters [9]."""
    values = jnp.exp(log_values)
    string, hammer = pianofit.String(*values[:4]), pianofit.Hammer(*values[4:])
    modes = pianofit.mode_table(string, geometry, rate=RATE, n_modes=64, quantity="bridge-force")
    pulse = pianofit.strike(modes, hammer, steps=1024)
    return pianofit.levels(modes, pulse.drive)[:PARTIALS]


def main() -> None:
    """Print dB per percent."""
    it = pianofit.preset("bensa-final")
    at = jnp.log(jnp.asarray([*it.string, *it.hammer]))
    slopes = 0.01 * jax.jit(jax.jacfwd(levels))(at, it.geometry)
    print("partial" + "".join(f"{name:>9}" for name in (*it.string._fields, *it.hammer._fields)) + "   dB per 1 %")
    for number, row in enumerate(slopes, 1):
        print(f"{number:7}" + "".join(f"{float(x):9.4f}" for x in row))

    # Many velocities in one program: a harder stroke has a brighter sound.
    velocities = jnp.linspace(0.5, 4.0, 8)
    struck = jax.vmap(lambda v: levels(at.at[-1].set(jnp.log(v)), it.geometry))(velocities)
    for velocity, level in zip(velocities, struck, strict=True):
        print(
            f"{float(velocity):.1f} m/s: partial {PARTIALS} lies {float(level[0] - level[-1]):5.1f} dB below the first"
        )


if __name__ == "__main__":
    with jax.enable_x64(True):  # the model computes in float64, and so do the derivatives that JAX takes of it
        main()
