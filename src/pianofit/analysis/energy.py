"""Levels of partials that no exponential describes: the energy that was there.

A partial that beats or decays in two stages has no amplitude at the onset that could be carried back to. Its energy in
the first 0.35 s under exp(-8t) needs none: it is the squared spectrum of that piece, summed over the partial's band,
over the share of a lone partial's energy that its band holds.
"""

from __future__ import annotations

import numpy as np

from .components import LEVEL_RATE, LEVEL_SECONDS
from .demodulate import fast_length

__all__ = ["band_levels"]

# Half width of a band over the spacing of the partials, and the finest bin, Hz.
_HALF, _BIN = 0.3, 0.25
# A partial that decays faster than this, 1/s, is more likely one that beats: its band is taken to hold no less of it.
_FASTEST = 40.0


def band_levels(
    samples: np.ndarray, rate: int, frequency: np.ndarray, decay: np.ndarray, spacing: float, density: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Energy of each partial in the first 0.35 s under exp(-8t), dB re full scale² · s, and noise over it, [partials].

    Parameters
    ----------
    samples : [samples], beginning at the onset
    frequency, decay : [partials], Hz and 1/s
    spacing : of the partials, Hz
    density : [partials], one-sided noise power density, full scale²/Hz
    """
    count = min(len(samples), round(LEVEL_SECONDS * rate))
    weight = np.exp(-LEVEL_RATE / 2 * np.arange(count) / rate)
    size = fast_length(max(count, int(rate / _BIN)))
    power = np.abs(np.fft.rfft(samples[:count] * weight, size)) ** 2 * 2 / (size * rate)
    total = np.append(0.0, np.cumsum(power))
    edge = frequency[:, None] + _HALF * spacing * np.array([-1.0, 1.0])
    edge = np.clip(np.round(edge * size / rate).astype(int), 0, len(power))
    heard = np.maximum(total[edge[:, 1]] - total[edge[:, 0]], 1e-60)
    noise = density * np.sum(weight**2) / size * (edge[:, 1] - edge[:, 0])
    alone = np.maximum(heard - noise, 1e-3 * heard) / _share(np.clip(decay, 0.0, _FASTEST), spacing, count / rate)
    return 10 * np.log10(alone), noise / heard


def _share(decay: np.ndarray, spacing: float, seconds: float) -> np.ndarray:
    """What share of a lone exponential's energy its own band holds [partials]."""
    a, nodes = decay[:, None] + LEVEL_RATE / 2, 256
    s = a + 2j * np.pi * _HALF * spacing * (np.arange(nodes) + 0.5) / nodes
    inside = 2 * _HALF * spacing * np.mean(np.abs(np.expm1(-s * seconds) / s) ** 2, axis=1)
    return inside / (-np.expm1(-2 * a * seconds) / (2 * a))[:, 0]
