"""What an analysis says: plain numbers with their standard errors."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

__all__ = ["WAYS", "Analysis", "Partials"]

# In which a level may be read off: see `Partials.levels`.
WAYS = 3


@dataclass(frozen=True)
class Partials:
    """The table of partials, ascending in number; only those found above the noise. Errors are standard errors.

    A doubt is what neighbouring partials share of an error: beats bend them alike.
    """

    number: np.ndarray  # int [partials], k
    frequency: np.ndarray  # [partials], Hz
    frequency_error: np.ndarray
    frequency_doubt: np.ndarray  # Hz
    decay: np.ndarray  # [partials], 1/s, decay rate α of the amplitude
    decay_error: np.ndarray
    decay_doubt: np.ndarray  # 1/s
    level: np.ndarray  # [partials], dB re full scale² · s: ∫_0^0.35s of its mean power · exp(−16 t) dt, from the onset
    level_error: np.ndarray
    levels: np.ndarray  # [3, partials], dB: by one exponential over the whole, over the first 0.4 s, by their energy
    level_errors: np.ndarray
    way: np.ndarray  # int [partials]: which of these `level` is
    level_doubt: np.ndarray  # dB: how far a beat may keep a level from what the blow alone would give
    snr: np.ndarray  # [partials], dB, amplitude at the onset over its own standard error from noise
    beating: np.ndarray  # [partials], dB, rms deviation of the log envelope from one exponential

    def __len__(self) -> int:
        return len(self.number)


@dataclass(frozen=True)
class Analysis:
    """One recording of one note: the string's two laws, the partials, and how far they keep to the laws."""

    f0: float  # Hz, of f_k = k f0 √(1 + B k²), over 0.2 to 1.0 s after the onset where the note lasts that long
    f0_error: float
    B: float
    B_error: float
    b1: float  # 1/s, of α_k = b1 + d2 k²
    b1_error: float
    d2: float  # 1/s, = b2 π²/L²
    d2_error: float
    partials: Partials
    scatter_cents: float  # robust deviation of the partials from the frequency law, beyond their noise
    scatter_decay: float  # relative robust deviation of the decay rates from their law, beyond their noise
    glide_cents: float  # fall of the pitch from the first 0.35 s to the last window in which it can be measured
    glide: tuple[tuple[float, float, float], ...]  # windows (start s, stop s, f0 Hz)
    noise_density: np.ndarray  # [partials], one-sided noise power density at each partial, full scale²/Hz
    note: str | None
    warnings: tuple[str, ...]
    glide_error: float = 0.0  # cents, of all frequencies alike: how well a glide that was taken out is known
    glide_start: float = 0.0  # cents above f0 at which a glide that was taken out began
