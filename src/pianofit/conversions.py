"""Units and scales that every room reads alike: pitch in equal temperament, intervals of 95 %, beats."""

from __future__ import annotations

import math

__all__ = ["BEAT", "NORMAL", "hertz_of", "midi_of"]

# Standard deviations from the mean to either end of a normal distribution's 95 %.
NORMAL = 1.959964
# A partial leaves an even decay by this before it is said to beat, dB: less is as well a decay that bends.
BEAT = 1.5
A4 = 440.0  # Hz
A4_MIDI = 69


def midi_of(frequency: float) -> float:
    """MIDI number of a frequency, Hz, with its fraction."""
    return A4_MIDI + 12 * math.log2(frequency / A4)


def hertz_of(midi: float) -> float:
    """Frequency of a MIDI number, which need not be whole, Hz."""
    return A4 * 2 ** ((midi - A4_MIDI) / 12)
