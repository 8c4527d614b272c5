"""Damper, release noise and noise floor of a key: the measurements beyond its string and hammer.

A batch writes it as `extras.json` in the folder of a key. An `instrument.json` holds the same entries.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from msgspec import Meta

from ..conversions import HIGHEST_KEY, LOWEST_KEY
from ..io.files import MAX_CHANNELS
from .decode import Number, load_record
from .modal_response import decode_embedded, encode_embedded

EXTRAS_FILE = "extras.json"
# Largest extras.json, bytes.
LARGEST_EXTRAS = 2**25
# Largest number of frequencies of a noise floor.
MOST_FREQUENCIES = 1000
# Samples of one block of noise. Blocks overlap by half.
BLOCK = 2**14
HINT = "give the folder that pianofit batch wrote"
KeyNumber = Annotated[int, Meta(ge=LOWEST_KEY, le=HIGHEST_KEY)]


@dataclass(frozen=True, eq=False, kw_only=True)
class DamperEntry:
    """The damper of a key in one recording."""

    file: str
    sha256: str  # of its bytes
    release_s: Number  # time of the release after the onset, s
    log_rate: Annotated[float, Meta(ge=-10.0, le=10.0)]  # logarithm of the added decay rate at partial 1, in 1/s
    slope: Annotated[float, Meta(ge=-10.0, le=10.0)]  # exponent of the rate over frequency
    covariance: np.ndarray  # of both [2, 2]
    frequency: np.ndarray  # Hz [partials]
    rate: np.ndarray  # 1/s [partials]
    rate_error: np.ndarray  # standard errors, 1/s [partials]

    def __post_init__(self) -> None:
        if self.covariance.shape != (2, 2) or not np.linalg.eigvalsh(self.covariance).min() > 0:
            raise ValueError("Expected a covariance of both, with eigenvalues above 0")


@dataclass(frozen=True)
class SoundEntry:
    """A sound as FLAC of 16 bits in base64, divided by `scale`. A page writes WAV instead."""

    scale: Annotated[float, Meta(gt=0.0, le=1e6)]  # full scale in file units
    flac: str | None = None
    wav: str | None = None
    file: str = ""  # recording from which it was cut

    def __post_init__(self) -> None:
        if (self.flac is None) == (self.wav is None):
            raise ValueError("Expected either flac or wav")

    @classmethod
    def of(cls, samples: np.ndarray, rate: int, file: str = "") -> SoundEntry:
        """Return the entry of a sound [channels, samples]."""
        scale = float(np.abs(samples).max()) or 1.0
        return cls(scale, encode_embedded(samples / scale, rate), file=file)

    def samples(self, where: str) -> tuple[np.ndarray, int]:
        """Return the sound [channels, samples] and its rate, Hz. A `FitError` names `where` the entry is."""
        samples, rate = decode_embedded(self.flac, self.wav, where)
        return self.scale * samples, rate


@dataclass(frozen=True, eq=False)
class NoiseFloor:
    """Stationary noise with the spectrum of the recordings, as it stands in a file and in memory."""

    frequency: np.ndarray  # ascending, Hz [frequencies]
    density: tuple[np.ndarray, ...]  # power spectral density of each channel, file units² per Hz

    def __post_init__(self) -> None:
        shapes = {self.frequency.shape, *(row.shape for row in self.density)}
        if len(shapes) != 1 or self.frequency.ndim != 1 or not 2 <= len(self.frequency) <= MOST_FREQUENCIES:
            raise ValueError(f"Expected 2 to {MOST_FREQUENCIES} frequencies, and a density for each")
        if not 1 <= len(self.density) <= MAX_CHANNELS or not all((row >= 0).all() for row in self.density):
            raise ValueError(f"Expected densities of 0 or more for 1 to {MAX_CHANNELS} channels")
        if not (np.diff(self.frequency, prepend=0.0) > 0).all():
            raise ValueError("Expected frequencies that rise from above 0")

    @property
    def level_db(self) -> float:
        """Level of one channel, rms, dB re full scale."""
        power = np.trapezoid(np.mean(self.density, axis=0), self.frequency)
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


@dataclass(frozen=True, kw_only=True)
class KeyExtras:
    """Content of an `extras.json`."""

    schema: int = 1
    program: str = "pianofit"
    kind: Literal["extras"] = "extras"
    midi: KeyNumber
    dampers: tuple[DamperEntry, ...] = ()
    releases: tuple[SoundEntry, ...] = ()
    noise: NoiseFloor | None = None


def read_extras(path: str | os.PathLike[str]) -> KeyExtras:
    """Read an `extras.json`; raise a `FitError` for any other file, which names the file and the entry."""
    return load_record(path, KeyExtras, LARGEST_EXTRAS, f"an {EXTRAS_FILE}", HINT)
