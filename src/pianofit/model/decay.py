"""Decay and beating of the partials of a key, from its modes: two decay times, and frequency and depth of the beats.

The energy of a partial's modes without their interference, Σ |P_m|² exp(2 Re p_m t) over modes and channels, falls
smoothly, first at the rate of the fast modes and then at that of the slow ones. Interference adds the beats.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..conversions import BEATING_DB
from .modal_response import ModalResponse

__all__ = ["EARLY", "LATE", "PartialDecay", "decays_and_beats"]

# Intervals of the two decay times, s after the contact: before and after the bend of most decays.
EARLY = (0.05, 0.5)
LATE = (1.0, 3.0)
# Beats are evaluated while a partial is within this many dB of its level at the start of `EARLY`.
BEAT_RANGE = 60.0
# Step of the envelope, s: modes of one partial lie closer together than 100 Hz.
STEP = 0.002


class PartialDecay(NamedTuple):
    """One partial of a key."""

    number: int  # k
    frequency: float  # of its strongest mode, Hz
    modes: int  # number of its modes
    early: float  # T60 of its energy over `EARLY`, s; NaN where its modes' errors exceed the decay
    late: float  # the same over `LATE`, s
    beat_frequency: float  # of the two modes that interfere most, Hz; NaN if none beat by `BEAT` dB within `LATE`
    beat_depth: float  # from the lowest to the highest effect of interference, dB; NaN without beats
    error: tuple[float, float]  # smallest and largest standard error of its poles (real or imaginary part), 1/s


def decays_and_beats(response: ModalResponse) -> list[PartialDecay]:
    """Compute decay and beating of each partial, in order, after an impulse that drives all its modes alike."""
    return [_decay(response, int(number)) for number in np.unique(response.number)]


def _decay(response: ModalResponse, number: int) -> PartialDecay:
    chosen = response.number == number
    pole, pattern = response.pole[chosen], response.pattern[:, chosen]
    rate, power = -np.real(pole), np.sum(np.abs(pattern) ** 2, axis=0)
    strongest = np.argmax(power * -np.expm1(-2 * rate * LATE[1]) / rate)  # by energy up to the end of `LATE`
    centre, error = float(np.imag(pole[strongest])), response.pole_error[chosen]
    return PartialDecay(
        number, centre / (2 * np.pi), len(pole), _t60(rate, error, power, *EARLY),
        _t60(rate, error, power, *LATE),
        *_beats(pole - 1j * centre, pattern), (float(error.min()), float(error.max())),
    )  # fmt: skip


def _energy(rate: np.ndarray, power: np.ndarray, time: np.ndarray) -> np.ndarray:
    """Energy without interference, dB [time]."""
    exponent = np.log(power) - 2 * np.outer(time, rate)
    return 10 / np.log(10) * np.logaddexp.reduce(exponent, axis=1)


def _t60(rate: np.ndarray, error: np.ndarray, power: np.ndarray, start: float, stop: float) -> float:
    """T60 of the least-squares line through the energy, s; NaN if the decay is within one standard error of zero."""
    time = np.arange(start, stop, STEP)
    share = power * np.exp(-(start + stop) * rate)
    share = share / share.sum()
    if np.hypot.reduce(share * error) >= share @ rate:
        return float("nan")
    return -60 / float(np.polyfit(time, _energy(rate, power, time), 1)[0])


def _beats(pole: np.ndarray, pattern: np.ndarray) -> tuple[float, float]:
    """Frequency, Hz, and depth, dB, of the beats of modes with these poles [modes] and patterns [channels, modes]."""
    spacing = np.abs(np.subtract.outer(np.imag(pole), np.imag(pole))) / (2 * np.pi)
    if spacing.max() < 1 / LATE[1]:
        return np.nan, np.nan
    time = np.arange(EARLY[0], LATE[1], STEP)
    smooth = _energy(-np.real(pole), np.sum(np.abs(pattern) ** 2, axis=0), time)
    shape = np.exp(np.outer(pole, time))
    whole = 10 * np.log10(np.maximum(np.sum(np.abs(pattern @ shape) ** 2, axis=0), 1e-300))
    depth = np.ptp((whole - smooth)[smooth > smooth[0] - BEAT_RANGE])
    if depth < BEATING_DB:
        return np.nan, np.nan
    # Interference of each two modes relative to the energy of all, averaged over time.
    share = np.abs(shape) @ (np.abs(shape) / 10 ** (smooth / 10)).T
    common = np.abs(pattern.conj().T @ pattern) * share * (spacing >= 1 / LATE[1])
    return float(spacing.flat[np.argmax(common)]), float(depth)
