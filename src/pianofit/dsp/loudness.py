"""Loudness of a sound, and the log-mel distance of two sounds of one note."""

import functools
from collections.abc import Sequence

import numpy as np

from .bands import fast_length

# Parts of a note, s from its onset.
NOTE_PARTS = {"attack": (0.0, 0.05), "early": (0.05, 0.5), "late": (0.5, 3.0)}
# Length of each window, s, and its number of mel bands: from the time scale of a knock to the width of a partial.
WINDOWS = ((0.012, 32), (0.046, 64), (0.186, 128))
# Time between frames, s.
HOP = 0.006
# Exponent of the power in the weight of a cell, approximately that of loudness.
WEIGHT = 0.3
# Frames that are transformed at once: few enough for a processor cache.
CHUNK = 32
# Range of the mel bands, Hz.
LOWEST, HIGHEST = 30.0, 16_000.0


def k_weighted_mean_square(samples: np.ndarray, rate: float) -> float:
    """Return the mean square of `samples` [..., samples] after the K-weighting of ITU-R BS.1770-4, annex 1.

    Its two filters are analogue prototypes here, so they are the same at every rate.
    """
    power = np.mean(np.abs(np.fft.rfft(np.atleast_2d(samples))) ** 2, axis=0)
    count = np.shape(samples)[-1]
    s = 2j * np.pi * np.fft.rfftfreq(count, 1 / rate)
    # Shelf: +4 dB above 1.7 kHz, the effect of the head.
    w, q, high = 2 * np.pi * 1681.974, 0.7071752, 10 ** (3.999844 / 20)
    shelf = (high * s**2 + high**0.4996668 * w / q * s + w**2) / (s**2 + w / q * s + w**2)
    w, q = 2 * np.pi * 38.13547, 0.5003270
    highpass = s**2 / (s**2 + w / q * s + w**2)
    return float(2 * np.sum(power * np.abs(shelf * highpass) ** 2) / count**2)


def log_mel_distances(one: np.ndarray, others: Sequence[np.ndarray], rate: float, onset: int) -> list[float]:
    """Distances of one sound [samples] from each of `others` [samples], dB; all have their onset at index `onset`.

    The distance is the mean over three parts of the note (attack, early, late) and over windows of three lengths. Each
    term is the rms difference of mel levels, dB. The weight of a cell is the larger of the two powers, to the power
    0.3. The distance does not depend on a gain. All sounds are cut to the length of the shortest.
    """
    size = min(onset + round(NOTE_PARTS["late"][1] * rate), *map(len, (one, *others)))
    terms: list[dict[str, list[float]]] = [{name: [] for name in NOTE_PARTS} for _ in others]
    for length, bands in WINDOWS:
        n = 2 * round(length * rate / 2)
        time, p = mel_power(one[:size], rate, onset, n, bands)
        floor = audible_floor(p)
        within = {name: (time >= start) & (time < stop) for name, (start, stop) in NOTE_PARTS.items()}
        for other, parts in zip(others, terms, strict=True):
            gain = np.sum(one[:size] ** 2) / max(np.sum(other[:size] ** 2), 1e-300)
            q = gain * mel_power(other[:size], rate, onset, n, bands)[1]
            louder = np.maximum(p, q)
            difference, weight = 10 * np.log10((p + floor) / (q + floor)), louder**WEIGHT * (louder > floor)
            for name, frames in within.items():
                if frames.any():
                    total = max(float(weight[frames].sum()), 1e-300)
                    parts[name].append(float(np.sqrt((weight[frames] * difference[frames] ** 2).sum() / total)))
    return [float(np.mean([float(np.mean(values)) for values in parts.values() if values])) for parts in terms]


def audible_floor(power: np.ndarray) -> float:
    """Power below which a cell of a spectrogram is taken as inaudible: 60 dB below the loudest cell."""
    return max(float(power.max()), 1e-30) * 10 ** (-60.0 / 10)


def mel_power(x: np.ndarray, rate: float, onset: int, n: int, bands: int) -> tuple[np.ndarray, np.ndarray]:
    """Times of frames of `n` samples, s from the onset, and their power in mel bands [frames, bands]."""
    hop = round(HOP * rate)
    x = np.pad(x, (n, n))
    first = onset + n - n // 2
    count = max((len(x) - first - n) // hop, 1)
    frames = np.lib.stride_tricks.sliding_window_view(x, n)[first : first + count * hop : hop]
    window = np.hanning(n + 1)[:-1]
    size = fast_length(n)
    filters = _mel_filters(n, size, bands, rate)
    power = np.empty((len(frames), bands))
    for at in range(0, len(frames), CHUNK):
        spectrum = np.fft.rfft(frames[at : at + CHUNK] * window, size)[:, : filters.shape[1]]
        power[at : at + CHUNK] = (np.square(np.real(spectrum)) + np.square(np.imag(spectrum))) @ filters.T
    return np.arange(len(frames)) * hop / rate, power / window.sum() ** 2


def mel_edges(n: int, bands: int, rate: float) -> np.ndarray:
    """Edges of the bands of windows of `n` samples, Hz [bands + 2]; a band spans two intervals."""
    low, high = max(LOWEST, rate / n), min(HIGHEST, 0.45 * rate)
    return 700 * np.expm1(np.linspace(np.log1p(low / 700), np.log1p(high / 700), bands + 2))


@functools.cache
def _mel_filters(n: int, size: int, bands: int, rate: float) -> np.ndarray:
    """Triangles [bands, bins of `size`], even on the mel scale, at least three bins of an `n`-sample window wide.

    Bins above the highest band are left out.
    """
    hz, edge = np.fft.rfftfreq(size, 1 / rate), mel_edges(n, bands, rate)
    half, middle = np.maximum(np.diff(edge), 1.5 * rate / n)[:, None], edge[1:-1, None]
    filters = np.maximum(0, np.minimum(1 - (middle - hz) / half[:-1], 1 - (hz - middle) / half[1:]))
    return filters[:, : int(np.flatnonzero(filters.any(axis=0))[-1]) + 1]
