"""Shared conversions and constants: pitch in equal temperament, 95 % intervals, beating."""

from __future__ import annotations

import math

__all__ = ["BEATING_DB", "HALF_WIDTH_95", "HIGHEST_KEY", "LOWEST_KEY", "hertz_of", "midi_of"]

# Half-width of the 95 % interval of a normal distribution, in standard deviations.
HALF_WIDTH_95 = 1.959964
# Smallest deviation from an exponential decay that counts as beating, dB. A curved decay can deviate by less.
BEATING_DB = 1.5
# MIDI numbers of the keys of a piano, A0 to C8.
LOWEST_KEY, HIGHEST_KEY = 21, 108
A4 = 440.0  # Hz
A4_MIDI = 69


def midi_of(frequency: float) -> float:
    """Return the MIDI number of a frequency, Hz. It may have a fraction."""
    return A4_MIDI + 12 * math.log2(frequency / A4)


def hertz_of(midi: float) -> float:
    """Return the frequency of a MIDI number, Hz. The number may have a fraction."""
    return A4 * 2 ** ((midi - A4_MIDI) / 12)
