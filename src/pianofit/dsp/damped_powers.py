"""Damped exponentials on an even grid, without one exponential per sample."""

from __future__ import annotations

import numpy as np

__all__ = ["powers"]


def powers(log_z: np.ndarray, count: int) -> np.ndarray:
    """Compute z^n, n < count, complex [..., count], from log z [...].

    Each step doubles the number of powers. So there are log2(count) exponentials and roundings per row.
    """
    out = np.ones((*np.shape(log_z), count), complex)
    done = 1
    while done < count:
        added = min(done, count - done)
        np.multiply(out[..., :added], np.exp(log_z * done)[..., None], out=out[..., done : done + added])
        done += added
    return out
