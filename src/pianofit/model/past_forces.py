"""Effect of the forces of earlier blocks on the string under the hammer, with derivatives.

The modes carry past forces as complex amplitudes, as pairs of real and imaginary part. With a fixed string their powers
have symbolic zeros as tangents, and products by them are left out.
"""

from typing import Any

import jax
import jax.numpy as jnp
from jax.custom_derivatives import SymbolicZero

from ..x64 import derivative
from .differentiable_sums import BLOCK


def product(a, b):
    """Complex product of pairs (real, imaginary): on a CPU several times as fast as complex arithmetic."""
    return a[0] * b[0] - a[1] * b[1], a[0] * b[1] + a[1] * b[0]


@jax.custom_jvp
def displacement_of_modes(real, imag, powers):
    """Σ_k Re(A_k z_k^n), n < BLOCK, m, of the real and imaginary parts of A [modes]."""
    _, re, im = powers
    return real @ re[:, :BLOCK] - imag @ im[:, :BLOCK]


def _displacement_jvp(primal, tangents):
    # d(z^n) = n z^n d(log z): tangents of log z suffice, and no tangents of single powers are carried.
    (*amplitude, powers), (*d_amplitude, (d_log_z, _, _)) = primal, tangents
    tangent = displacement_of_modes(*map(_instantiated, d_amplitude), powers)
    if type(d_log_z) is not SymbolicZero:
        tangent += jnp.arange(BLOCK) * displacement_of_modes(*product(amplitude, (d_log_z.real, d_log_z.imag)), powers)
    return displacement_of_modes(*amplitude, powers), tangent


@jax.custom_jvp
def advance_drive(drive, powers):
    """Σ_i z_k^(BLOCK - i) T_i, real and imaginary [modes], N: the drive of a block, advanced to the next block."""
    _, re, im = powers
    return drive @ re[:, :0:-1].T, drive @ im[:, :0:-1].T


def _drive_jvp(primal, tangents):
    (drive, powers), (d_drive, (d_log_z, _, _)) = primal, tangents
    real, imag = advance_drive(_instantiated(d_drive), powers)
    if type(d_log_z) is not SymbolicZero:
        weighted = advance_drive(jnp.arange(BLOCK, 0, -1) * drive, powers)
        by_log_z = product((d_log_z.real, d_log_z.imag), weighted)
        real, imag = real + by_log_z[0], imag + by_log_z[1]
    return advance_drive(drive, powers), (real, imag)


displacement_of_modes.defjvp(derivative(_displacement_jvp), symbolic_zeros=True)
advance_drive.defjvp(derivative(_drive_jvp), symbolic_zeros=True)


def _instantiated(tangent: Any) -> Any:
    return jnp.zeros(tangent.shape) if type(tangent) is SymbolicZero else tangent
