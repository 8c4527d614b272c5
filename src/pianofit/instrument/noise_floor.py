"""Noise floor of the recordings of an instrument."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..schema.extras import KeyExtras, NoiseEntry

# Samples of one block of noise. Blocks overlap by half.
BLOCK = 2**14


@dataclass(frozen=True, eq=False)
class NoiseFloor:
    """Stationary noise with the spectrum of the recordings.

    Parameters
    ----------
    frequency : frequencies, ascending, Hz [frequencies].
    density : power spectral density, file units² per Hz [channels, frequencies].
    """

    frequency: np.ndarray
    density: np.ndarray

    @property
    def level_db(self) -> float:
        """Level of one channel, rms, dB re full scale."""
        power = np.trapezoid(self.density.mean(axis=0), self.frequency)
        return 10 * float(np.log10(max(power, 1e-30)))

    def sound(self, samples: int, rate: int, seed: int) -> np.ndarray:
        """Return noise in file units [channels, samples]. The same seed gives the same noise.

        The windows of overlapping blocks of independent noise have a constant sum of squares.
        """
        rng, half = np.random.default_rng(seed), BLOCK // 2
        bins = np.fft.rfftfreq(BLOCK, 1 / rate)
        spectrum = np.array([np.interp(bins, self.frequency, row, right=0.0) for row in self.density])
        size = np.sqrt(spectrum * (rate / 2))  # standard deviation of white noise of this density
        window = np.sin(np.pi * (np.arange(BLOCK) + 0.5) / BLOCK)
        blocks = -(-samples // half) + 1
        noise = np.zeros((len(size), (blocks + 1) * half))
        for block in range(blocks):
            white = np.fft.rfft(rng.standard_normal((len(size), BLOCK)))
            noise[:, block * half : block * half + BLOCK] += window * np.fft.irfft(size * white, BLOCK)
        return noise[:, half : half + samples]


def noise_floor(extras: Sequence[KeyExtras], channels: int) -> NoiseFloor | None:
    """Return the median over keys of the densities; None without a recording or if most have digital silence.

    Parameters
    ----------
    channels : number of channels of the instrument. If one noise floor has another number, the means over channels
        are used.
    """
    entries = [key.noise for key in extras if key.noise is not None]
    if not entries:
        return None
    frequency = entries[0].frequency
    rows = [np.array([np.interp(frequency, noise.frequency, x) for x in noise.density]) for noise in entries]
    same = all(len(row) == channels for row in rows)
    density = np.median([row if same else row.mean(axis=0, keepdims=True) for row in rows], axis=0)
    return NoiseFloor(frequency, density) if density.any() else None


def noise_entry(noise: NoiseFloor | None) -> NoiseEntry | None:
    """Return the entry of an `instrument.json`."""
    return None if noise is None else NoiseEntry(noise.frequency, tuple(noise.density))
