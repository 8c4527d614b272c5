"""Whether a recording holds more than one stroke.

Beats lift one partial and let another fall; a hammer lifts them all at once. From one window of their basebands to the
next the median partial of 58 real single strokes rises by 3 dB at the most, and of 75 that were struck again by more
than 6 in 54; the others are soft strokes, soon after, of bass notes that still ring.
"""

from __future__ import annotations

import numpy as np

from .demodulate import Bands

__all__ = ["struck_again"]

# A median partial that rises by so much, dB, has been struck again.
RISE = 6.0
# Of fewer partials the median may beat.
FEWEST = 4
# What stands less above the noise than this, in powers, does not count as risen.
FLOOR = 4.0


def struck_again(bands: Bands, z: np.ndarray, density: np.ndarray) -> float | None:
    """When most partials rise at once, s after the onset, to half a window; None if never.

    Parameters
    ----------
    z : complex basebands [partials, frames]; density : the noise's, one-sided, full scale²/Hz [partials].
    """
    apart = max(1, round(bands.window * bands.rate))
    if len(z) < FEWEST or z.shape[1] <= apart:
        return None
    floor = FLOOR * (density / 2 * bands.noise_width)[:, None]
    power = np.maximum(np.abs(z) ** 2, floor)
    rise = np.median(10 * np.log10(power[:, apart:] / power[:, :-apart]), axis=0)
    at = int(np.argmax(rise))
    return float(bands.time[at] + bands.window / 2) if rise[at] > RISE else None
