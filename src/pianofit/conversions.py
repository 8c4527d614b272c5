"""Shared conversions and constants: pitch in equal temperament, cents, decibels, T60, 95 % intervals, beating, MIDI."""

import math

# Half-width of the 95 % interval of a normal distribution, in standard deviations.
HALF_WIDTH_95 = 1.959964
# Smallest deviation from an exponential decay that counts as beating, dB. A curved decay can deviate by less.
BEATING_DB = 1.5
# Range of the velocities of struck keys in MIDI.
MIDI_VELOCITIES = (1.0, 127.0)
# MIDI numbers of the keys of a piano, A0 to C8.
LOWEST_KEY, HIGHEST_KEY = 21, 108
# Cents per unit of the natural logarithm of a frequency, and dB per unit of that of an amplitude.
CENTS = 1200 / math.log(2)
DB = 20 / math.log(10)
# T60 times the decay rate of an amplitude, Np: an amplitude falls by 60 dB, a factor of 1000.
T60_NEPERS = math.log(1000)
A4 = 440.0  # Hz
A4_MIDI = 69


def midi_of(frequency: float) -> float:
    """Return the MIDI number of a frequency, Hz. It may have a fraction."""
    return A4_MIDI + 12 * math.log2(frequency / A4)


def hertz_of(midi: float) -> float:
    """Return the frequency of a MIDI number, Hz. The number may have a fraction."""
    return A4 * 2 ** ((midi - A4_MIDI) / 12)
