"""How far strokes of different velocities set a key's modes ringing, over what their forces say.

A hammer's force is a model, and a mode's amplitude over the force's spectrum is not one number a key: a partial's level
wanders with the velocity by a decibel or two, and so do the shares that its modes have of it. Both are taken for random
walks over the logarithm of the velocity, seen through errors of two kinds: of measurement, which is known, and by which
any two strokes differ. How far walks go and how much strokes differ is the same for all partials of a key, which say it
together; both are integrated over. So what strokes do not tell apart stays their mean. Between strokes the mean of such
a walk is linear, beyond them constant.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..result.velocity_discrepancy import NOTHING, smooth_random_walk

__all__ = ["velocity_gain"]


def velocity_gain(
    shown: Sequence[np.ndarray], pattern: Sequence[np.ndarray], error: np.ndarray, velocity: np.ndarray
) -> np.ndarray:
    """Factors on the modes' patterns for every stroke, complex [strokes, modes of all partials].

    Parameters
    ----------
    shown : of each partial the amplitudes that a stroke shows, over its force, complex [strokes, channels, modes].
    pattern : of each partial the common one, complex [channels, modes].
    error : relative standard error of the amplitudes' real and imaginary parts [strokes, partials].
    velocity : of the strokes, m/s, rising.
    """
    level, away, share = [], [], []
    for own, common in zip(shown, pattern, strict=True):
        size, whole = np.linalg.norm(own, axis=(1, 2)), np.linalg.norm(common)
        turn = np.exp(-1j * np.angle((own * common.conj()).sum(axis=(1, 2))))
        power = np.linalg.norm(common, axis=0)
        along = (own * common.conj()).sum(axis=1) / np.where(power > 0, power, 1.0)
        share.append(power / whole)
        level.append(np.log(np.where(size > 0, size, whole) / whole))
        away.append((turn / np.where(size > 0, size, 1.0))[:, None] * along - share[-1])
    error = np.where(np.isfinite(error), error, NOTHING)
    levels = smooth_random_walk(np.stack(level, axis=1), error, velocity)
    modes = np.array([len(x) for x in share])
    columns = np.concatenate(away, axis=1)
    both = np.concatenate([np.real(columns), np.imag(columns)], axis=1)
    real, imag = np.split(smooth_random_walk(both, np.tile(np.repeat(error, modes, axis=1), 2), velocity), 2, axis=1)
    parts = np.concatenate(share)
    moved = 1 + (real + 1j * imag) / np.where(parts > 0, parts, np.inf)
    return np.exp(np.repeat(levels, modes, axis=1)) * moved
