"""Velocity gain: change of a mode's amplitude with hammer velocity, beyond the change that the force explains.

The amplitude of a mode divided by the force spectrum is not constant for a key. The level of a partial and the shares
of its modes vary with velocity by one or two decibels. Both are modelled as random walks over the logarithm of the
velocity. They are observed with two errors: the measurement error, whose size is given, and a deviation of each stroke.
The variances of walks and of stroke deviations are common to all partials of a key, and are integrated over. Where the
strokes do not determine a walk, it stays at its mean. The posterior mean is linear between strokes and constant outside
them.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..result.notes import UNINFORMATIVE_ERROR, smooth_random_walk

__all__ = ["velocity_gain"]


def velocity_gain(
    observed: Sequence[np.ndarray], pattern: Sequence[np.ndarray], error: np.ndarray, velocity: np.ndarray
) -> np.ndarray:
    """Factors on the modes' patterns for every stroke, complex [strokes, modes of all partials].

    Parameters
    ----------
    observed : for each partial, the amplitudes of every stroke over its force, complex [strokes, channels, modes].
    pattern : for each partial, the common pattern, complex [channels, modes].
    error : relative standard error of the amplitudes' real and imaginary parts [strokes, partials].
    velocity : of the strokes, m/s, rising.
    """
    level, deviation, share = [], [], []
    for own, common in zip(observed, pattern, strict=True):
        size, common_size = np.linalg.norm(own, axis=(1, 2)), np.linalg.norm(common)
        turn = np.exp(-1j * np.angle((own * common.conj()).sum(axis=(1, 2))))
        power = np.linalg.norm(common, axis=0)
        projected = (own * common.conj()).sum(axis=1) / np.where(power > 0, power, 1.0)
        share.append(power / common_size)
        level.append(np.log(np.where(size > 0, size, common_size) / common_size))
        deviation.append((turn / np.where(size > 0, size, 1.0))[:, None] * projected - share[-1])
    error = np.where(np.isfinite(error), error, UNINFORMATIVE_ERROR)
    levels = smooth_random_walk(np.stack(level, axis=1), error, velocity)
    modes = np.array([len(x) for x in share])
    columns = np.concatenate(deviation, axis=1)
    both = np.concatenate([np.real(columns), np.imag(columns)], axis=1)
    real, imag = np.split(smooth_random_walk(both, np.tile(np.repeat(error, modes, axis=1), 2), velocity), 2, axis=1)
    shares = np.concatenate(share)
    factor = 1 + (real + 1j * imag) / np.where(shares > 0, shares, np.inf)
    return np.exp(np.repeat(levels, modes, axis=1)) * factor
