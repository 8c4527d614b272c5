"""What the page draws and plays: arrays, ready computed. The page itself computes no physics."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

__all__ = ["Curves"]


@dataclass(frozen=True)
class Curves:
    """One fit's curves and sounds. Frequencies in Hz, decays in 1/s; NaN where there is no value.

    `frequency_cents` is the deviation from k f0, `frequency_cents_law` that of k f0 √(1 + B k²); `decay_law` is
    b1 + d2 k². `_error` is one standard deviation. `path` is the fitted output path at the partials, or None.
    """

    frequency: np.ndarray  # [bins], of the spectra on the damped circle
    measured_db: np.ndarray  # [bins]
    initial_db: np.ndarray
    fitted_db: np.ndarray
    borders: tuple[float, ...]  # Hz; low, 1|2, 2|3, high, as far as there are such bands
    attack_ms: np.ndarray  # [n], from the onset
    attack_measured: np.ndarray  # [n], full scale = 1
    attack_initial: np.ndarray
    attack_fitted: np.ndarray
    number: np.ndarray  # [partials], k
    frequency_cents: np.ndarray  # [partials]
    frequency_cents_error: np.ndarray
    frequency_cents_law: np.ndarray
    decay: np.ndarray  # [partials]
    decay_error: np.ndarray
    decay_law: np.ndarray
    level: np.ndarray  # [partials], dB
    level_error: np.ndarray
    level_initial: np.ndarray
    level_fitted: np.ndarray
    path: np.ndarray | None  # [partials], dB
    force_ms: np.ndarray  # [m], from the first touch
    force_initial: np.ndarray  # [m], N
    force_fitted: np.ndarray
    compression_initial: np.ndarray  # [m], mm
    compression_fitted: np.ndarray
    sound_rate: int  # Hz
    sound_original: np.ndarray  # [samples], full scale = 1
    sound_initial: np.ndarray
    sound_fitted: np.ndarray
