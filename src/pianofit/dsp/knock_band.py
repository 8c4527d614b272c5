"""The knock of a treble note: the energy of its attack below the lowest partial.

A string passes a slow force on to the bridge, so this sound follows the spectrum of the hammer's force there. The band
lies below the lowest partial, whose sound would hide it, and above the slow motion of keybed and action.
"""

import numpy as np

# The band, relative to f0. In the treble its energy follows the force within 1.1 dB rms (benchmarks/knock_study.py).
# That of a band from 40 Hz on scatters 1.5 times as much.
BAND = (0.2, 0.7)
# Frequencies at which the force is computed. It is smooth over the band.
NODES = 4
# The window of the energy, s before and after the onset. With 50 ms after it the energies scatter by 0.1 dB more.
BEFORE, AFTER = 0.01, 0.1
# Periods of the lowest frequency of the band that the window holds at least: f0 is 500 Hz or more. Below that, the
# attack of the lowest partial reaches into the band.
FEWEST_PERIODS = 10.0


def centre(f0: float) -> float:
    """Frequency, Hz, that stands for the band: the geometric mean of its ends."""
    return f0 * float(np.sqrt(BAND[0] * BAND[1]))


def nodes() -> np.ndarray:
    """Frequencies of the band at which the force is computed, relative to f0 [nodes]."""
    low, high = BAND
    return low + (high - low) * (np.arange(NODES) + 0.5) / NODES


def has_knock(f0: float) -> bool:
    """Return whether the window holds enough periods of the band."""
    return BAND[0] * f0 * AFTER >= FEWEST_PERIODS
