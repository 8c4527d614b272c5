"""Dampers of an instrument."""

from __future__ import annotations

import numpy as np

from ..conversions import hertz_of
from ..schema.dampers import LAST_DAMPER as LAST_DAMPER
from ..schema.dampers import Dampers


def damper_rate(midi: int) -> float:
    """Return the rate that the literature's damper adds at the fundamental of a key, 1/s; 0 without damper."""
    return float(Dampers().rates(midi, np.array([hertz_of(midi)]))[0])
