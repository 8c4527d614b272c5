"""What an analysis says: plain numbers with their standard errors."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

__all__ = ["Analysis", "Partials"]


@dataclass(frozen=True)
class Partials:
    """The table of partials, ascending in number; those found above the noise, and bounds on the others.

    Errors come in two kinds. A standard error `_error` is from noise alone, independent from partial to partial and
    from recording to recording. A covariance `_systematic` is of what beats, a second polarisation or a glide that was
    not taken out do to a value: neighbouring partials share it, and all recordings of a key do. It leaves out
    `Analysis.glide_error`, and is nought where nothing beyond noise is seen.
    """

    number: np.ndarray  # int [partials], k
    frequency: np.ndarray  # [partials], Hz
    frequency_error: np.ndarray  # [partials], Hz
    frequency_systematic: np.ndarray  # [partials, partials], Hz²
    decay: np.ndarray  # [partials], 1/s, decay rate α of the amplitude
    decay_error: np.ndarray  # [partials], 1/s
    decay_systematic: np.ndarray  # [partials, partials], 1/s²
    level: np.ndarray  # [partials], dB re full scale² · s: ∫_0^0.35s of its mean power · exp(−16 t) dt, from the onset
    level_error: np.ndarray  # [partials], dB
    level_systematic: np.ndarray  # [partials, partials], dB²: from the level of the string's single mode
    snr: np.ndarray  # [partials], dB, amplitude at the onset over its own standard error from noise
    beating: np.ndarray  # [partials], dB, rms deviation of the log envelope from one exponential
    absent: np.ndarray  # int [absent], numbers below the highest frequency looked at that were not found
    absent_bound: np.ndarray  # [absent], dB as `level`: all the energy in the band of each, noise included

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
