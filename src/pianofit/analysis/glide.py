"""Pitch against time: real strings fall by some cents as they decay."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .demodulate import Bands
from .inharmonicity import CENTS
from .partials import lost
from .tones import Tones, fit_tones

__all__ = ["glide_windows"]

_WINDOWS = ((0.0, 0.35), (0.2, 1.0), (1.0, 2.0), (2.0, 4.0), (4.0, np.inf))  # s after the onset
_REFERENCE = 1  # of the windows: where f0 is defined
_LOUD = 30.0  # power a partial must have in a window, over the noise power of a frame


def glide_windows(
    bands: Bands, z: NDArray[np.complex128], fit: Tones, density: np.ndarray
) -> list[tuple[float, float, float, float]]:
    """Pitch of each window against that of 0.2 to 1.0 s: rows (start s, stop s, cents, standard error in cents).

    The median over partials of the change of frequency of each: a beating partial moves by its own amount, a glide
    moves all by the same.
    """
    frame = density / 2 * bands.noise_width
    end = float(bands.time[-1])
    shift, spans = [], []
    for start, stop in _WINDOWS:
        cut = bands.cut(start, stop - bands.window / 2 if start == 0 else stop, least=1)
        t = bands.time[cut]
        if len(t) < 6 or (start > 0 and end < start + 0.5 * (min(stop, start + 1) - start)):
            shift.append(np.full(len(z), np.nan))
        else:
            local = fit_tones(z[:, cut], t, fit.pole, steps=6)
            moved = np.clip(local.pole.imag / (2 * np.pi * bands.centre), -0.1, 0.1)
            cents = CENTS * np.log1p(moved)
            shift.append(np.where((local.power > _LOUD * frame) & ~lost(bands, local), cents, np.nan))
        spans.append((start, float(min(stop, end + bands.window / 2))))
    rows = []
    for (start, stop), row in zip(spans, shift, strict=True):
        moved = row - shift[_REFERENCE]
        moved = moved[np.isfinite(moved)]
        if len(moved):
            middle = float(np.median(moved))
            spread = 1.4826 * float(np.median(np.abs(moved - middle))) * 1.25 / np.sqrt(len(moved))
            rows.append((start, stop, middle, spread if len(moved) > 2 else np.inf))
    return rows
