"""Honest weights: noise is measured, misfit is estimated.

A real string scatters about any model by more than its noise. For each kind of residual (frequency, decay, level) one
number, the scatter, is added to the noise's variance so that the residuals are as large as they should be; partials
far out of line then weigh less (Huber).
"""

from __future__ import annotations

import numpy as np

__all__ = ["huber", "scatter"]

# Beyond this many standard deviations a residual counts linearly, not quadratically.
BEND = 2.5
# E[min(x², BEND²)] of a standard normal x.
BENT = 0.978


def scatter(residual: np.ndarray, noise: np.ndarray, freedom: float) -> float:
    """The s ≥ 0 for which Σ min(r²/(noise² + s²), BEND²) is what the degrees of freedom left make of it.

    Parameters
    ----------
    residual, noise : [partials], in the same unit as the result.
    freedom : how many parameters these residuals were fitted with.
    """
    n = len(residual)
    wanted = BENT * max(n - freedom, 0.3 * n)

    def excess(s: float) -> float:
        return np.minimum(residual**2 / (noise**2 + s**2 + 1e-300), BEND**2).sum() - wanted

    if n == 0 or excess(0.0) <= 0:
        return 0.0
    low, high = 0.0, float(np.abs(residual).max()) * 2 + 1e-300
    for _ in range(60):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if excess(middle) > 0 else (low, middle)
    return high


def huber(residual: np.ndarray, sd: np.ndarray) -> np.ndarray:
    """Factors ≤ 1 on the weights [partials] that turn squares into Huber's loss."""
    return np.sqrt(np.minimum(1.0, BEND * sd / np.maximum(np.abs(residual), 1e-300)))
