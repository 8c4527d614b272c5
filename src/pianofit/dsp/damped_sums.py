"""Sums of damped exponentials on an even grid, and the transforms that are their transposes.

Time is divided into blocks. z^n at the start of a block times z^n within a block is one matrix product, without an
exponential per sample. `model/differentiable_sums.py` has the same sums with derivatives.
"""

import functools
import math

import numpy as np
from numpy.typing import NDArray

# Modes below this fraction of the largest initial amplitude are left out: -160 dB.
AMPLITUDE_FLOOR = 1e-8
# Blocks computed between two checks of which modes still sound.
BLOCKS_PER_CHECK = 32
# Samples of a block: more would not fit into a processor cache.
LARGEST_BLOCK = 512


def powers(log_z: np.ndarray, count: int) -> NDArray[np.complex128]:
    """Compute z^n, n < count, complex [..., count], from log z [...].

    A power is the product of that at the start of its block and that within the block. So there are about 2 √count
    exponentials per row.
    """
    block = max(math.isqrt(count), 1)
    blocks = -(-count // block)
    log_z = np.asarray(log_z, complex)[..., None]
    begins, within = np.exp(log_z * (block * np.arange(blocks))), np.exp(log_z * np.arange(block))
    return (begins[..., None] * within[..., None, :]).reshape(*log_z.shape[:-1], blocks * block)[..., :count]


def sum_damped_modes(
    pole: np.ndarray, amplitude: np.ndarray, rate: float, count: int, audibility_threshold: np.ndarray | None = None
) -> np.ndarray:
    """Compute Re Σ amplitude exp(pole t) [channels, count] of decaying modes with amplitudes [channels, modes].

    Parameters
    ----------
    audibility_threshold : amplitudes below which modes are left out [modes]; default `AMPLITUDE_FLOOR` times the
        largest.
    """
    out = np.zeros((len(amplitude), count))
    if not (count and amplitude.size):
        return out
    block = min(1 << int(np.ceil(np.log2(np.sqrt(count)))), LARGEST_BLOCK)
    blocks = min(-(-count // block), BLOCKS_PER_CHECK)
    if audibility_threshold is None:
        audibility_threshold = np.full(len(pole), AMPLITUDE_FLOOR * np.abs(amplitude).max())
    log_z = np.asarray(pole / rate, complex)
    within = _powers_within_block(log_z.tobytes(), block)
    begins = powers(pole * (block / rate), blocks + 1)  # [modes, blocks + 1], the last for the next chunk
    for first in range(0, count, blocks * block):
        loud = (np.abs(amplitude) > audibility_threshold).any(axis=0)
        if not loud.any():
            break
        if not loud.all():
            pole, amplitude, audibility_threshold = pole[loud], amplitude[:, loud], audibility_threshold[loud]
            within, begins = within[loud], begins[loud]
        chunk = out[:, first : first + blocks * block]
        starts = amplitude[:, None] * begins[:, :-1].T
        rows = np.ascontiguousarray(starts).view(float) @ within.reshape(-1, block)
        chunk[:] = rows.reshape(len(amplitude), -1)[:, : chunk.shape[-1]]
        amplitude = amplitude * begins[:, -1]
    return out


def z_transform_at_poles(log_z: np.ndarray, samples: np.ndarray) -> np.ndarray:
    """Σ_n x_n z^n, complex [modes]."""
    rows = np.pad(samples, (0, -len(samples) % LARGEST_BLOCK)).reshape(-1, LARGEST_BLOCK)
    within = _powers_within_block(np.asarray(log_z, complex).tobytes(), LARGEST_BLOCK)
    real, imag = np.moveaxis(within @ rows.T, 1, 0)  # [modes, blocks]
    return ((real - 1j * imag) * powers(log_z * LARGEST_BLOCK, len(rows))).sum(axis=1)


@functools.lru_cache(maxsize=16)  # a played key rings free and damped, for times of several lengths
def _powers_within_block(log_z: bytes, count: int) -> np.ndarray:
    """Real part and negative imaginary part of z^n, n < count [modes, 2, count], with log z as bytes."""
    z = powers(np.frombuffer(log_z, complex), count)
    parts = np.stack([np.real(z), -np.imag(z)], axis=1)
    parts.flags.writeable = False
    return parts
