"""Sums of damped exponentials over steps, and the transforms that are their transposes.

With n = 32 i + j, z^n = z^(32 i) z^j. So the sum over rows is one small matrix product, and the steps × rows powers are
never formed. Derivatives are sums of the same kind, since differentiating by log z multiplies by n. Forward mode costs
two thin products more, and carries no tangents of single powers.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Complex, Float

from ..x64 import AnyArray, derivative, float64

# Steps in a block, here and in the contact.
BLOCK = 32


def real_powers(log_z: Complex[AnyArray, " rows"], count: int, stride: int) -> tuple[Array, Array]:
    """Real and imaginary part of z^(stride i), i < count: [rows, count]. Complex products are slow on a CPU."""
    n = stride * jnp.arange(count)
    size, angle = jnp.exp(jnp.real(log_z)[:, None] * n), jnp.imag(log_z)[:, None] * n
    return size * jnp.cos(angle), size * jnp.sin(angle)


@jax.custom_jvp
def _ring(amplitude, log_z, n):
    blocks = -(-n.shape[0] // BLOCK)
    (coarse_re, coarse_im), (fine_re, fine_im) = real_powers(log_z, blocks, BLOCK), real_powers(log_z, BLOCK, 1)
    real = amplitude.real[:, None] * coarse_re - amplitude.imag[:, None] * coarse_im
    imag = amplitude.real[:, None] * coarse_im + amplitude.imag[:, None] * coarse_re
    return (real.T @ fine_re - imag.T @ fine_im).ravel()[: n.shape[0]]


@_ring.defjvp
@derivative
def _ring_jvp(primal, tangent):
    amplitude, log_z, n = primal
    d_amplitude, d_log_z, _ = tangent
    return _ring(amplitude, log_z, n), _ring(d_amplitude, log_z, n) + n * _ring(amplitude * d_log_z, log_z, n)


@float64
def sum_damped_exponentials(
    amplitude: Complex[AnyArray, " rows"], log_z: Complex[AnyArray, " rows"], steps: int
) -> Float[Array, " steps"]:
    """Σ_k Re(A_k z_k^n), n < steps."""
    return _ring(amplitude, log_z, jnp.arange(steps, dtype=float))


@jax.custom_jvp
def _transform(signal, log_z, n):
    blocks = -(-n.shape[0] // BLOCK)
    (coarse_re, coarse_im), (fine_re, fine_im) = real_powers(log_z, blocks, BLOCK), real_powers(log_z, BLOCK, 1)
    rows = jnp.pad(signal, (0, blocks * BLOCK - n.shape[0])).reshape(blocks, BLOCK)
    real, imag = fine_re @ rows.T, fine_im @ rows.T
    return (real * coarse_re - imag * coarse_im).sum(axis=1) + 1j * (real * coarse_im + imag * coarse_re).sum(axis=1)


@_transform.defjvp
@derivative
def _transform_jvp(primal, tangent):
    signal, log_z, n = primal
    d_signal, d_log_z, _ = tangent
    return _transform(signal, log_z, n), _transform(d_signal, log_z, n) + d_log_z * _transform(n * signal, log_z, n)


@float64
def z_transform(signal: Float[AnyArray, " steps"], log_z: Complex[AnyArray, " rows"]) -> Complex[Array, " rows"]:
    """Σ_n s_n z_k^n."""
    return _transform(signal, log_z, jnp.arange(signal.shape[0], dtype=float))
