"""Noise floor of the recordings of an instrument."""

from collections.abc import Sequence

import numpy as np

from ..schema.extras import KeyExtras, NoiseFloor


def noise_floor(extras: Sequence[KeyExtras], channels: int) -> NoiseFloor | None:
    """Return the median over keys of the densities; None without a recording or if most have digital silence.

    Parameters
    ----------
    channels : number of channels of the instrument. If one noise floor has another number, the means over channels
        are used.
    """
    entries = [key.noise for key in extras if key.noise is not None]
    if not entries:
        return None
    frequency = entries[0].frequency
    rows = [np.array([np.interp(frequency, noise.frequency, x) for x in noise.density]) for noise in entries]
    same = all(len(row) == channels for row in rows)
    density = np.median([row if same else row.mean(axis=0, keepdims=True) for row in rows], axis=0)
    return NoiseFloor(frequency, tuple(density)) if density.any() else None
