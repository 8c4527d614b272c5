"""Derivatives by a complex step, exact to rounding: an imaginary step has no difference of two close values."""

from collections.abc import Callable
from typing import Any

import numpy as np

# Imaginary step. Its square is far below rounding, so that the real part does not change.
STEP = 1e-30


def slope_by_entry(function: Callable[[np.ndarray], Any], at: np.ndarray, i: int) -> np.ndarray:
    """Derivative of an analytic `function` by entry `i` of `at` [..., size], in its unit over that of the entry.

    Source: Squire and Trapp, SIAM Review 40 (1998), 110-112.
    """
    return np.imag(function(at + 1j * STEP * np.eye(at.shape[-1])[i])) / STEP
