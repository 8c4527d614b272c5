"""Sounds made ready for the page: cut to the note, equally loud, 16 bits, as text a browser can play.

The three sounds are compared by ear, and the louder of two sounds seems the better one. So all get the same loudness:
the mean square, over the channels and the first second, after the K-weighting of ITU-R BS.1770 (its two filters, as
analogue prototypes, so that they mean the same at every rate). One more gain, the same for all, keeps the highest peak
1 dB below full scale: nothing clips, also while two sounds are blended into each other. Sounds that are to show how
loud they are get this gain alone.
"""

from __future__ import annotations

import base64
import math
from dataclasses import dataclass

import numpy as np

from ..io.files import PEAK_LIMIT, encode_pcm
from .html import data_uri

__all__ = ["LIGHT_RATE", "Clip", "excerpt", "k_weighted_mean_square", "make_clips", "seconds_each"]

SECONDS = 8.0  # of each sound are kept; three such sounds of one channel at 48 kHz have 3 MB
LEAD_IN = 0.05  # s kept before the onset
FADE = 0.05  # s, at the end: many recordings are cut off
HIGHEST_RATE = 96_000  # Hz; what every browser's Web Audio must play
LIGHT_RATE = 32_000  # Hz, of sounds that a page has many of: to 16 kHz


@dataclass(frozen=True)
class Clip:
    """One sound of the page: a WAV file of 16 bits, and the gain in dB that it was given."""

    name: str
    wav: bytes
    gain_db: float
    rate: int
    seconds: float

    @property
    def uri(self) -> str:
        """The file as an address within the page."""
        return data_uri("audio/wav", self.wav)

    @property
    def text(self) -> str:
        """The file as base64."""
        return base64.b64encode(self.wav).decode()

    @property
    def file(self) -> str:
        """What it is saved as."""
        return "".join(c if c.isalnum() or c in ".-" else "-" for c in self.name) + "-matched.wav"


def k_weighted_mean_square(samples: np.ndarray, rate: float) -> float:
    """Mean square of `samples` [..., samples], over all, after the K-weighting of ITU-R BS.1770-4, annex 1."""
    power = np.mean(np.abs(np.fft.rfft(np.atleast_2d(samples))) ** 2, axis=0)
    count = np.shape(samples)[-1]
    s = 2j * np.pi * np.fft.rfftfreq(count, 1 / rate)
    w1, q1, high = 2 * np.pi * 1681.974, 0.7071752, 10 ** (3.999844 / 20)  # shelf: +4 dB above 1.7 kHz, the head
    w2, q2 = 2 * np.pi * 38.13547, 0.5003270  # high-pass
    shelf = (high * s**2 + high**0.4996668 * w1 / q1 * s + w1**2) / (s**2 + w1 / q1 * s + w1**2)
    highpass = s**2 / (s**2 + w2 / q2 * s + w2**2)
    return float(2 * np.sum(power * np.abs(shelf * highpass) ** 2) / count**2)


def make_clips(
    sounds: dict[str, np.ndarray],
    rate: int,
    onset: float = 0.0,
    *,
    lead_in: float = LEAD_IN,
    seconds: float = SECONDS,
    highest_rate: int = HIGHEST_RATE,
    matched: bool = True,
) -> list[Clip]:
    """Cut, match and encode `sounds`: name -> [samples] or [channels, samples], at `rate` Hz and aligned; `onset` in s.

    Parameters
    ----------
    lead_in, seconds : what is kept before the onset, and in all, s.
    highest_rate : above it, Hz, the sounds are brought down by a whole factor.
    matched : whether all get the same loudness, or keep theirs to each other; a silent sound keeps its level.
    """
    factor = math.ceil(rate / highest_rate)
    cut = {name: excerpt(samples, rate, onset - lead_in, seconds, factor) for name, samples in sounds.items()}
    rate = round(rate / factor)
    powers = {
        name: k_weighted_mean_square(samples[:, :rate], rate) if matched else 0.0 for name, samples in cut.items()
    }
    gains = {name: power**-0.5 if power > 0 else 1.0 for name, power in powers.items()}
    highest = max(gains[name] * np.max(np.abs(samples)) for name, samples in cut.items())
    common = PEAK_LIMIT / highest if highest > 0 else 1.0
    return [
        Clip(name, encode_pcm(np.round(samples * gains[name] * common * 2**15).astype(np.int16), rate, bits=16),
             20 * math.log10(gains[name] * common), rate, samples.shape[-1] / rate)
        for name, samples in cut.items()
    ]  # fmt: skip


def seconds_each(pairs: int, samples: int, longest: float, shortest: float) -> float:
    """How long the sounds of so many pairs may be at `LIGHT_RATE`, s, so that all together have some `samples`."""
    return max(shortest, min(longest, samples / (2 * max(pairs, 1) * LIGHT_RATE)))


def excerpt(samples: np.ndarray, rate: int, begin: float, seconds: float, factor: int) -> np.ndarray:
    """From `begin`, s, at most `seconds`, faded out, at the rate divided by `factor` [channels, samples]."""
    samples = np.atleast_2d(np.nan_to_num(np.asarray(samples, dtype=np.float64), posinf=0.0, neginf=0.0))
    samples = samples if samples.size else np.zeros((1, 1))
    start = max(0, round(begin * rate))
    start = start if start < samples.shape[-1] else 0
    kept = samples[:, start : start + round(seconds * rate)].copy()
    fade = round(FADE * rate)
    kept[:, -fade:] *= np.linspace(1.0, 0.0, fade)[-kept.shape[-1] :]
    if factor == 1:
        return kept
    from scipy.signal import resample  # by Fourier's transform: both ends are silent, so none wraps around

    size = -(-kept.shape[-1] // factor)
    return np.asarray(resample(np.pad(kept, ((0, 0), (0, size * factor - kept.shape[-1]))), size, axis=-1))
