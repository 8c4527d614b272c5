"""Prominent spectral peaks of a part of the recording, and the noise between them."""

from dataclasses import dataclass

import numpy as np

from ..dsp.bands import fast_length

HIGHEST_PARTIAL = 12_000.0  # Hz, of the partials that are searched
_BETA = 10.0  # side lobes 75 dB down


@dataclass(frozen=True)
class Spectrum:
    """Peaks of the power spectrum of a windowed part of the recording, relative to its floor."""

    step: float  # Hz between bins
    peak: np.ndarray  # [peaks], Hz, ascending
    height: np.ndarray  # [peaks], dB above the floor, 0..60
    strength: np.ndarray  # [peaks], dB
    resolution: float  # Hz, half width of a peak at its foot


def _density(samples: np.ndarray, rate: int, pad: int, beta: float = _BETA) -> tuple[np.ndarray, float]:
    window = _kaiser(len(samples), beta)
    size = fast_length(pad * len(samples))
    bins = np.fft.rfft(samples * window, size)
    return 2 * np.abs(bins) ** 2 / (rate * np.sum(window**2)), rate / size


def _kaiser(count: int, beta: float) -> np.ndarray:
    """Kaiser window of at least two samples, by half of the Bessel functions that `np.kaiser` computes."""
    middle = (count - 1) / 2
    half = np.i0(beta * np.sqrt(1 - ((np.arange((count + 1) // 2) - middle) / middle) ** 2)) / np.i0(beta)
    return np.concatenate([half, half[: count // 2][::-1]])


def _floor(level: np.ndarray, step: float, span: float) -> np.ndarray:
    """Running 30 % quantile of `level` (dB) over `span` Hz, computed on blocks and interpolated."""
    block = max(8, int(span / 4 / step))
    count = -(-len(level) // block)
    padded = np.pad(level, (0, count * block - len(level)), mode="edge").reshape(count, block)
    wide = np.concatenate([np.roll(padded, shift, axis=0) for shift in (-1, 0, 1)], axis=1)
    wide[0, :block] = wide[0, block : 2 * block]
    wide[-1, :block] = wide[-1, block : 2 * block]
    low = np.partition(wide, int(0.3 * wide.shape[1]), axis=1)[:, int(0.3 * wide.shape[1])]
    return np.interp(np.arange(len(level)), (np.arange(count) + 0.5) * block, low)


def highest_partial(rate: int) -> float:
    """Highest frequency that is searched for partials, Hz."""
    return min(0.45 * rate, HIGHEST_PARTIAL)


def spectrum(samples: np.ndarray, rate: int, seconds: float) -> Spectrum:
    """Spectrum of the first `seconds` of `samples`."""
    part = samples[: max(64, int(seconds * rate))]
    power, step = _density(part, rate, 4)
    level = 10 * np.log10(power + 1e-40)
    level = np.maximum(level, max(-200.0, float(level.max()) - 140.0))
    # Maxima of noise rarely reach 10 dB above the 30 % quantile.
    prominence = np.clip(level - _floor(level, step, max(160.0, 40 * step)) - 10.0, 0.0, 60.0)
    inner = level[1:-1]
    at = np.flatnonzero((inner > level[:-2]) & (inner >= level[2:]) & (prominence[1:-1] > 0)) + 1
    left, middle, right = level[at - 1], level[at], level[at + 1]
    bend = left - 2 * middle + right
    shift = np.where(bend < 0, 0.5 * (left - right) / np.minimum(bend, -1e-12), 0.0)
    resolution = float(np.hypot(_BETA, np.pi) / np.pi) * rate / len(part)
    return Spectrum(step, (at + shift) * step, prominence[at], middle, resolution)


def noise_between(
    samples: np.ndarray, rate: int, expected: np.ndarray, wanted: np.ndarray, spacing: float, start: float
) -> np.ndarray:
    """One-sided noise density (full scale²/Hz) near each of `wanted` Hz, between the partials at `expected` Hz.

    It is the median of the bins within ± 2 spacings that lie at least 0.3 spacings from every expected partial, divided
    by ln 2, the ratio of median to mean of an exponential variable. The bins are those of the sound from `start` s
    after the onset to the end.
    """
    part = samples[min(int(start * rate), len(samples) // 2) :]
    # The foot of a peak is a quarter of a spacing wide. Side lobes 135 dB down are below any noise.
    reach = np.pi * 0.25 * spacing * len(part) / rate
    power, step = _density(part, rate, 1, float(np.clip(reach, _BETA, 18.0)))
    frequency = np.arange(min(len(power), int((wanted.max() + 2 * spacing) / step) + 2)) * step
    place = np.searchsorted(expected, frequency)
    padded = np.concatenate([[-np.inf], expected, [np.inf]])
    distance = np.minimum(frequency - padded[place], padded[place + 1] - frequency)
    quiet = distance > 0.3 * spacing
    density = np.empty(len(wanted))
    for i, f in enumerate(wanted):
        low, high = np.searchsorted(frequency, [f - 2 * spacing, f + 2 * spacing])
        values = power[low:high][quiet[low:high]]
        density[i] = np.median(values) / np.log(2) if len(values) else np.nan
    measured = np.isfinite(density)
    if not measured.any():
        return np.full(len(wanted), float(np.median(power)) / np.log(2))
    return np.interp(wanted, wanted[measured], density[measured])
