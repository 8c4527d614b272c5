"""How far a model's levels of partials are from a recording's, in dB."""

from __future__ import annotations

import numpy as np

__all__ = ["level_error_db"]


def level_error_db(model: np.ndarray, measured: np.ndarray) -> float:
    """Rms difference of levels [partials], dB, with one gain removed."""
    difference = model - measured
    return float(np.sqrt(np.mean((difference - difference.mean()) ** 2)))
