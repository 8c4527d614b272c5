"""Sounds of a page: cut to the note, equally loud, 16 bits, encoded as text that a browser can play.

Listeners compare the sounds and prefer the louder of two. Therefore all get the same loudness: the mean square over the
channels and the first second, after the K-weighting of ITU-R BS.1770. Its two filters are analogue prototypes here, so
they are the same at every rate. A common gain keeps the highest peak 1 dB below full scale, so that sounds do not clip,
also during a crossfade. Sounds whose loudness is to be compared get the common gain only.
"""

from __future__ import annotations

import base64
import math
from dataclasses import dataclass

import numpy as np

from ..io.files import PEAK_LIMIT, encode_pcm
from .html import data_uri

SECONDS = 8.0  # of each sound; three mono sounds at 48 kHz have 3 MB
LEAD_IN = 0.05  # s, before the onset
FADE = 0.05  # s, at the end, because many recordings are cut off
HIGHEST_RATE = 96_000  # Hz; every browser must support it in Web Audio
LIGHT_RATE = 32_000  # Hz, for pages with many sounds; its bandwidth is 16 kHz


@dataclass(frozen=True)
class Clip:
    """One sound of the page: a WAV file of 16 bits, and its gain in dB."""

    name: str
    wav: bytes
    gain_db: float
    rate: int
    seconds: float

    @property
    def uri(self) -> str:
        """The file as a data URI."""
        return data_uri("audio/wav", self.wav)

    @property
    def text(self) -> str:
        """The file as base64."""
        return base64.b64encode(self.wav).decode()

    @property
    def file(self) -> str:
        """The file name for saving."""
        return "".join(c if c.isalnum() or c in ".-" else "-" for c in self.name) + "-matched.wav"


def k_weighted_mean_square(samples: np.ndarray, rate: float) -> float:
    """Return the mean square of `samples` [..., samples] after the K-weighting of ITU-R BS.1770-4, annex 1."""
    power = np.mean(np.abs(np.fft.rfft(np.atleast_2d(samples))) ** 2, axis=0)
    count = np.shape(samples)[-1]
    s = 2j * np.pi * np.fft.rfftfreq(count, 1 / rate)
    w1, q1, high = (
        2 * np.pi * 1681.974,
        0.7071752,
        10 ** (3.999844 / 20),
    )  # shelf: +4 dB above 1.7 kHz, effect of the head
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
    lead_in, seconds : length before the onset, and total length, s.
    highest_rate : Hz. Sounds of higher rates are resampled to the rate divided by an integer.
    matched : True for equal loudness, False to keep the differences. A silent sound keeps its level.
    """
    factor = math.ceil(rate / highest_rate)
    excerpts = {name: excerpt(samples, rate, onset - lead_in, seconds, factor) for name, samples in sounds.items()}
    rate = round(rate / factor)
    powers = {
        name: k_weighted_mean_square(samples[:, :rate], rate) if matched else 0.0 for name, samples in excerpts.items()
    }
    gains = {name: power**-0.5 if power > 0 else 1.0 for name, power in powers.items()}
    highest = max(gains[name] * np.max(np.abs(samples)) for name, samples in excerpts.items())
    common = PEAK_LIMIT / highest if highest > 0 else 1.0
    return [
        Clip(name, encode_pcm(np.round(samples * gains[name] * common * 2**15).astype(np.int16), rate, bits=16),
             20 * math.log10(gains[name] * common), rate, samples.shape[-1] / rate)
        for name, samples in excerpts.items()
    ]  # fmt: skip


def seconds_each(pairs: int, samples: int, longest: float, shortest: float) -> float:
    """Return the length of each sound, s, so that all pairs together have about `samples` at `LIGHT_RATE`."""
    return max(shortest, min(longest, samples / (2 * max(pairs, 1) * LIGHT_RATE)))


def excerpt(samples: np.ndarray, rate: int, begin: float, seconds: float, factor: int) -> np.ndarray:
    """Return at most `seconds` from `begin`, s, faded out, at the rate divided by `factor` [channels, samples]."""
    samples = np.atleast_2d(np.nan_to_num(np.asarray(samples, dtype=np.float64), posinf=0.0, neginf=0.0))
    samples = samples if samples.size else np.zeros((1, 1))
    start = max(0, round(begin * rate))
    start = start if start < samples.shape[-1] else 0
    kept = samples[:, start : start + round(seconds * rate)].copy()
    fade = round(FADE * rate)
    kept[:, -fade:] *= np.linspace(1.0, 0.0, fade)[-kept.shape[-1] :]
    if factor == 1:
        return kept
    from scipy.signal import resample  # by FFT; both ends are silent, so they do not wrap around

    size = -(-kept.shape[-1] // factor)
    return np.asarray(resample(np.pad(kept, ((0, 0), (0, size * factor - kept.shape[-1]))), size, axis=-1))
