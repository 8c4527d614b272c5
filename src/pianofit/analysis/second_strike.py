"""Whether a recording holds more than one stroke.

Beats lift one partial and let another fall; a hammer lifts them all at once. From one window of their basebands to the
next the median partial of 58 real single strokes rises by 3 dB at the most, and of 75 that were struck again by more
than 6 in 54; the others are soft strokes, soon after, of bass notes that still ring. A noise of the player or the room
also lifts many partials at once, but only far below the level at which the note began.
"""

from __future__ import annotations

import numpy as np

from .demodulation import Bands

__all__ = ["detect_second_strike"]

# A median partial that rises by so much, dB, has been struck again.
RISE = 6.0
# So many partials rise at the least: fewer may beat together.
FEWEST = 4
# Partials that rise to less than this, dB over the first moments, were not struck: a squeak of a guitar string has -66,
# a second stroke of a tenth of the amplitude -20.
FAINTEST = -40.0
# What stands less above the noise than this, in powers, does not count as risen.
FLOOR = 4.0


def detect_second_strike(bands: Bands, z: np.ndarray, density: np.ndarray) -> float | None:
    """When most partials rise at once, s after the onset, to half a window; None if never.

    Parameters
    ----------
    z : complex basebands [partials, frames]; density : the noise's, one-sided, full scale²/Hz [partials].
    """
    apart = max(1, round(bands.window * bands.rate))
    if len(z) < FEWEST or z.shape[1] <= apart:
        return None
    floor = FLOOR * (density / 2 * bands.noise_width)[:, None]
    level = 10 * np.log10(np.maximum(np.abs(z) ** 2, floor))
    rise = level[:, apart:] - level[:, :-apart]
    most = np.quantile(rise, 1 - max(0.5, FEWEST / len(z)), axis=0)
    at = int(np.argmax(most))
    risen = rise[:, at] > RISE
    if most[at] <= RISE or np.median((level[:, apart + at] - level[:, : apart + 1].max(axis=1))[risen]) < FAINTEST:
        return None
    return float(bands.time[at] + bands.window / 2)
