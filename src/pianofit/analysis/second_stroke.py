"""Detects a second stroke in a recording that should hold one.

Beats raise some partials and lower others, a hammer raises all at once. In 58 real recordings of single strokes the
median partial rises by at most 3 dB from one window of the bands to the next. In 54 of 75 recordings with a second
stroke it rises by more than 6 dB. The others are soft strokes shortly after the first, on bass notes that still ring.
Noises of the player or the room also raise many partials at once, but far below the initial level of the note.
"""

import numpy as np

from .baseband_fit import FittedBands

# Smallest number of partials that must rise: fewer may beat together.
FEWEST = 4
# dB relative to the initial level; partials that rise to a lower level were not struck. A squeak of a guitar string
# reaches -66, a second stroke of a tenth of the amplitude -20.
FAINTEST = -40.0


def detect_second_stroke(fitted: FittedBands) -> float | None:
    """Time of the second stroke, s after the onset, within half a window; None if there is none."""
    bands, z = fitted.bands, fitted.z
    lag = max(1, round(bands.window * bands.rate))
    if len(z) < FEWEST or z.shape[1] <= lag:
        return None
    floor = 4.0 * fitted.frame_noise[:, None]  # variations below it do not count
    level = 10 * np.log10(np.maximum(np.abs(z) ** 2, floor))
    rise = level[:, lag:] - level[:, :-lag]
    typical_rise = np.quantile(rise, 1 - max(0.5, FEWEST / len(z)), axis=0)
    at = int(np.argmax(typical_rise))
    raised = rise[:, at] > 6.0
    if typical_rise[at] <= 6.0 or np.median((level[:, lag + at] - level[:, : lag + 1].max(axis=1))[raised]) < FAINTEST:
        return None
    return float(bands.time[at] + bands.window / 2)
