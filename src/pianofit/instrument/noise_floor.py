"""Noise floor of the recordings of an instrument."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

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
