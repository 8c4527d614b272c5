"""Damped exponentials on an even grid, without an exponential a sample."""

from __future__ import annotations

import numpy as np

__all__ = ["powers"]


def powers(log_z: np.ndarray, count: int) -> np.ndarray:
    """z^n, n < count, complex [..., count], of logarithms [...].

    What is there, times its next power, is as much again: log2(count) exponentials a row, and as many roundings.
    """
    out = np.ones((*np.shape(log_z), count), complex)
    done = 1
    while done < count:
        more = min(done, count - done)
        np.multiply(out[..., :more], np.exp(log_z * done)[..., None], out=out[..., done : done + more])
        done += more
    return out
