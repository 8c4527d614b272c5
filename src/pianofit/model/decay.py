"""How the partials of a key decay and beat, as their modes have it: two decays, and how deep and fast the beats are.

The energy of a partial's modes without their interference, Σ |P_m|² exp(2 Re p_m t) over modes and channels, falls
smoothly, first as its fast modes and then as its slow ones do. What interference adds to it are the beats.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..conversions import BEAT
from .modal_response import ModalResponse

__all__ = ["EARLY", "LATE", "PartialDecay", "decays_and_beats"]

# Where the two decays are taken, s after the contact: before and after the bend that most partials have.
EARLY = (0.05, 0.5)
LATE = (1.0, 3.0)
# Beats are followed as long as a partial stands within so many dB of what it is at the start of `EARLY`.
HEARD = 60.0
# Points on the envelope, s apart: modes of one partial lie closer together than 100 Hz.
STEP = 0.002


class PartialDecay(NamedTuple):
    """One partial of a key."""

    number: int  # k
    frequency: float  # of its strongest mode, Hz
    modes: int  # how many
    early: float  # T60 of its energy over `EARLY`, s; NaN where its modes' errors exceed the decay
    late: float  # the same over `LATE`, s
    beat_frequency: float  # of the two modes that interfere most, Hz; NaN where none beat by `units.BEAT` within `LATE`
    beat_depth: float  # from the deepest trough to the highest peak that interference makes, dB; NaN without beats
    error: tuple[float, float]  # least and largest standard error of its poles' real and imaginary parts, 1/s


def decays_and_beats(ringing: ModalResponse) -> list[PartialDecay]:
    """Of every partial, by number, after an impulse on the string: all modes of a partial get the same force."""
    return [_decay(ringing, int(number)) for number in np.unique(ringing.number)]


def _decay(ringing: ModalResponse, number: int) -> PartialDecay:
    own = ringing.number == number
    pole, pattern = ringing.pole[own], ringing.pattern[:, own]
    rate, power = -np.real(pole), np.sum(np.abs(pattern) ** 2, axis=0)
    strongest = np.argmax(power * -np.expm1(-2 * rate * LATE[1]) / rate)  # by energy to the end of `LATE`
    centre, error = float(np.imag(pole[strongest])), ringing.pole_error[own]
    return PartialDecay(
        number, centre / (2 * np.pi), len(pole), _t60(rate, error, power, *EARLY),
        _t60(rate, error, power, *LATE),
        *_beats(pole - 1j * centre, pattern), (float(error.min()), float(error.max())),
    )  # fmt: skip


def _energy(rate: np.ndarray, power: np.ndarray, time: np.ndarray) -> np.ndarray:
    """dB [time], without interference."""
    exponent = np.log(power) - 2 * np.outer(time, rate)
    return 10 / np.log(10) * np.logaddexp.reduce(exponent, axis=1)


def _t60(rate: np.ndarray, error: np.ndarray, power: np.ndarray, start: float, stop: float) -> float:
    """Of the line of least squares through the energy, s; NaN where it is not known to fall, by one standard error."""
    time = np.arange(start, stop, STEP)
    share = power * np.exp(-(start + stop) * rate)
    share = share / share.sum()
    if np.hypot.reduce(share * error) >= share @ rate:
        return float("nan")
    return -60 / float(np.polyfit(time, _energy(rate, power, time), 1)[0])


def _beats(pole: np.ndarray, pattern: np.ndarray) -> tuple[float, float]:
    """Frequency, Hz, and depth, dB, of the beats of modes [modes] with patterns [channels, modes]."""
    apart = np.abs(np.subtract.outer(np.imag(pole), np.imag(pole))) / (2 * np.pi)
    if apart.max() < 1 / LATE[1]:
        return np.nan, np.nan
    time = np.arange(EARLY[0], LATE[1], STEP)
    smooth = _energy(-np.real(pole), np.sum(np.abs(pattern) ** 2, axis=0), time)
    shape = np.exp(np.outer(pole, time))
    whole = 10 * np.log10(np.maximum(np.sum(np.abs(pattern @ shape) ** 2, axis=0), 1e-300))
    depth = np.ptp((whole - smooth)[smooth > smooth[0] - HEARD])
    if depth < BEAT:
        return np.nan, np.nan
    # What two modes have in common, over the energy of all: the mean over time.
    share = np.abs(shape) @ (np.abs(shape) / 10 ** (smooth / 10)).T
    common = np.abs(pattern.conj().T @ pattern) * share * (apart >= 1 / LATE[1])
    return float(apart.flat[np.argmax(common)]), float(depth)
