"""How far one sound of a note is from another, as mel levels tell: of its attack, early and late.

The distance is the mean over the three parts, and over windows of three lengths, of the rms difference of mel levels,
dB, cells weighted by the louder one's power to 0.3. It is blind to gain; the two sounds have to begin together.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence

import numpy as np
from scipy.fft import next_fast_len

__all__ = ["HEARD", "log_mel_distances", "mel_edges", "mel_power"]

# Parts of a note, s from its onset.
PARTS = {"attack": (0.0, 0.05), "early": (0.05, 0.5), "late": (0.5, 3.0)}
# Windows, s, and mel bands of each: from a knock's time to a partial's width.
WINDOWS = ((0.012, 32), (0.046, 64), (0.186, 128))
# Between frames, s.
HOP = 0.006
# What lies so far below the loudest cell, dB, is not heard.
HEARD = 60.0
# Power that a cell weighs by: about loudness.
WEIGHT = 0.3
# Of the mel bands, Hz.
LOWEST, HIGHEST = 30.0, 16_000.0


def log_mel_distances(one: np.ndarray, others: Sequence[np.ndarray], rate: float, onset: int) -> list[float]:
    """Of one sound [samples] from each of `others` [samples], all of whose onsets are at the index `onset`, dB.

    All are compared as long as the shortest lasts.
    """
    size = min(onset + round(PARTS["late"][1] * rate), *map(len, (one, *others)))
    each: list[dict[str, list[float]]] = [{name: [] for name in PARTS} for _ in others]
    for length, bands in WINDOWS:
        n = 2 * round(length * rate / 2)
        time, p = mel_power(one[:size], rate, onset, n, bands)
        floor = max(p.max(), 1e-30) * 10 ** (-HEARD / 10)
        within = {name: (time >= start) & (time < stop) for name, (start, stop) in PARTS.items()}
        for other, parts in zip(others, each, strict=True):
            gain = np.sum(one[:size] ** 2) / max(np.sum(other[:size] ** 2), 1e-300)
            q = gain * mel_power(other[:size], rate, onset, n, bands)[1]
            loud = np.maximum(p, q)
            away, weight = 10 * np.log10((p + floor) / (q + floor)), loud**WEIGHT * (loud > floor)
            for name, at in within.items():
                if at.any():
                    total = max(float(weight[at].sum()), 1e-300)
                    parts[name].append(float(np.sqrt((weight[at] * away[at] ** 2).sum() / total)))
    return [float(np.mean([np.mean(values) for values in parts.values() if values])) for parts in each]


def mel_power(x: np.ndarray, rate: float, onset: int, n: int, bands: int) -> tuple[np.ndarray, np.ndarray]:
    """Times of frames of `n` samples, s from the onset, and their power in mel bands [frames, bands]."""
    hop = round(HOP * rate)
    x = np.pad(x, (n, n))
    first = onset + n - n // 2
    count = max((len(x) - first - n) // hop, 1)
    frames = np.lib.stride_tricks.sliding_window_view(x, n)[first : first + count * hop : hop]
    window = np.hanning(n + 1)[:-1]
    size = next_fast_len(n, real=True)
    found = np.fft.rfft(frames * window, size)
    power = (found.real**2 + found.imag**2) / window.sum() ** 2
    return np.arange(len(frames)) * hop / rate, power @ _mel(n, size, bands, rate).T


def mel_edges(n: int, bands: int, rate: float) -> np.ndarray:
    """Edges of the bands of windows of `n` samples, Hz [bands + 2]: a band reaches over two intervals."""
    low, high = max(LOWEST, rate / n), min(HIGHEST, 0.45 * rate)
    return 700 * np.expm1(np.linspace(np.log1p(low / 700), np.log1p(high / 700), bands + 2))


@functools.cache
def _mel(n: int, size: int, bands: int, rate: float) -> np.ndarray:
    """Triangles [bands, bins of `size`] even on the mel scale, at least three bins of a window's `n` samples wide."""
    hz, edge = np.fft.rfftfreq(size, 1 / rate), mel_edges(n, bands, rate)
    half, middle = np.maximum(np.diff(edge), 1.5 * rate / n)[:, None], edge[1:-1, None]
    return np.maximum(0, np.minimum(1 - (middle - hz) / half[:-1], 1 - (hz - middle) / half[1:]))
