"""The table of partials: frequency, decay and level of each, with errors.

Each partial is brought to baseband (demodulate.py) and fitted with one damped exponential over all that was recorded
(fits.py). Where one exponential describes the partial down to the noise that is the answer, and close to the
Cramér–Rao bound. Real partials beat, glide and decay in two stages; then frequency and decay rate are taken where they
mean something:

- frequency from 0.2 to 1.0 s after the onset, or the dominant component's where the partial beats deeply,
- decay rate of the early energy, the first 0.8 s.

The level is always the energy of the first 2 s, less that of the noise, under a weight that falls as the partial does,
brought to the level's own span by the decay that the string's law has there; `level_lag` tells by how much another law
would change it, so that recordings of one key can be brought there by one. Energy is what it is however the partial
beats, so what a beat does to a level, it does in all recordings of a key alike: layers of nine real notes keep to each
other's levels within 1.1 dB, read off the first 0.1 s within 1.5.

Noise gives each value a standard error, carried from the noise of the frames through the least squares to first order.
Beside it stands the standard deviation of a systematic error, seen in what one exponential leaves over beyond noise and
in what fits of other windows differ by beyond noise; it is nought where nothing is seen. Beats change little from one
partial to the next, so it is that of a few neighbours, and they share it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .baseband_fit import ExponentialFit, has_drifted, level_of, noise_tolerance, window, with_errors
from .beating_partials import Components, resolve
from .demodulation import Bands
from .exponential_fit import Tones
from .inharmonicity import DecayLaw, decay_law
from .level import LEVEL_RATE

__all__ = ["LEAST_SNR", "PartialTable", "decay_law_covariance", "measure_partials", "systematic"]

LEAST_SNR = 14.0  # dB, below which a partial is none

FREQUENCY_WINDOW = (0.2, 1.0)  # s
_EARLY = 0.8  # s, for decay rates
_FIRST = 0.4  # s, in which a fast beat shows
_REACH = (
    20.0  # 1/s by which the first moments' pole may differ from that of the whole; beyond, it follows another sound
)
_DEEP = 1.5  # dB rms beyond which a partial counts as beating
_CLEAN_MISFIT = 3e-3  # of the signal's rms: one exponential is then good enough whatever the noise
_COMPONENTS = 0.15  # share of the difference between one component and several that is taken for systematic
_SURE = 2.5  # standard errors from noise that two windows may differ by
_FAST = 0.6  # level's systematic error, nepers, over the amplitude of what the first moments' exponential leaves over
_SLOW = 0.5  # the same over the amplitude of what beats within 2 s
_SEEN = 0.03  # amplitude of the noise, over the partial's, below which a beat is seen
_NEAR = 2  # partials to either side that tell how large a systematic error is
_FACTOR = 2.0  # log; a decay that a beat changes by more than exp(2) tells of nothing but the beat
_SHARED = (
    10.0  # partials over which a systematic error's correlation falls to 1/e; has most evidence on beating strings
)
_FREQUENCY_FLOOR = 5e-10  # relative; rounding and what is left of neighbours without any noise
_DECAY_FLOOR = 1e-6  # relative; the same
_LEVEL_FLOOR = 5e-5  # dB; the same
_DB = 20 / np.log(10)


@dataclass(frozen=True)
class PartialTable:
    """Columns of the table, [partials] each; `_spread` is the standard deviation of a systematic error."""

    frequency: np.ndarray
    frequency_error: np.ndarray
    frequency_spread: np.ndarray
    decay: np.ndarray
    decay_error: np.ndarray
    decay_spread: np.ndarray
    level: np.ndarray
    level_error: np.ndarray
    level_spread: np.ndarray
    level_lag: np.ndarray
    snr: np.ndarray
    beating: np.ndarray
    level_law: DecayLaw  # of the decays over all that was recorded, by which levels were brought to their span

    def whole_error(self, column: str) -> np.ndarray:
        """Noise and systematic error of "frequency", "decay" or "level" together [partials]."""
        return np.hypot(getattr(self, f"{column}_error"), getattr(self, f"{column}_spread"))


def systematic(number: np.ndarray, spread: np.ndarray) -> np.ndarray:
    """Covariance [partials, partials] of systematic errors with standard deviations `spread` [partials]."""
    apart = np.abs(number[:, None] - number[None, :])
    return spread[:, None] * spread[None, :] * np.exp(-apart / _SHARED)


def decay_law_covariance(number: np.ndarray, lag: np.ndarray, law: DecayLaw) -> np.ndarray:
    """Covariance of levels [partials, partials], dB², from the errors of the law that brought them to their span.

    Those of b1 and d2 go against each other: without their correlation it is a bound.
    """
    errors = np.array([law.b1_error, law.d2_error if np.isfinite(law.d2_error) else 0.0])
    along = _DB * lag[:, None] * errors * np.stack([np.ones(len(number)), number**2.0], axis=1)
    return along @ along.T


def measure_partials(
    number: np.ndarray, bands: Bands, z: NDArray[np.complex128], fit: Tones, density: np.ndarray, glides: bool
) -> PartialTable:
    """Make the columns of the table from the cleaned basebands `z` and the fits over the whole record.

    Parameters
    ----------
    density : [partials], one-sided noise power density, full scale²/Hz
    glides : whether the note's pitch falls measurably; frequencies then come from 0.2 to 1.0 s
    """
    frame = density / 2 * bands.noise_width  # noise variance of one frame
    clean = _one_exponential(bands, z, fit, frame)
    beating, seen = _beating(bands, z, frame)
    # Amplitude of what beats with each partial, over its own. More than that is resolved, or is in the misfit.
    second = _shared(_where_seen(np.minimum(beating, _DEEP), seen) * np.sqrt(2) / _DB)
    whole = with_errors(bands, slice(None), fit, density)
    early, tone = (window(bands, z, fit, density, span) for span in ((0.0, _EARLY), FREQUENCY_WINDOW))
    first = window(bands, z, fit, density, (0.0, bands.time[0] + _FIRST), LEVEL_RATE / 2, _REACH)
    parts = resolve(bands, z, frame, (beating > _DEEP) & ~clean)
    snr = -20 * np.log10(np.maximum(whole.log_error(-fit.origin), 1e-15))
    heard = (snr > LEAST_SNR) & ~has_drifted(bands, whole.fit)  # what is none has no say in the law
    heard |= not heard.any()
    law = decay_law(number[heard], -whole.fit.pole.real[heard], whole.pole_error()[heard])
    audible = (tone.fit.power > 10 * frame) & (bands.time[-1] > 0.6) & ~has_drifted(bands, tone.fit)
    frequency = _frequencies(bands, whole, early, tone, parts, second, clean & ~(glides & audible), audible)
    decay = _decays(whole, early, parts, second, clean, law(number))
    level = _levels(bands, z, whole, first, density, law(number), second)
    return PartialTable(*frequency, *decay, *level, snr, beating, law)


def _frequencies(
    bands: Bands,
    whole: ExponentialFit,
    early: ExponentialFit,
    tone: ExponentialFit,
    parts: Components,
    second: np.ndarray,
    use_whole: np.ndarray,
    audible: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Frequencies, their standard errors from noise, and standard deviations of systematic errors, Hz."""
    offset, error, excess = early.fit.pole.imag, early.pole_error(), early.excess
    for better, other in ((audible, tone), (use_whole, whole)):
        offset = np.where(better, other.fit.pole.imag, offset)
        error = np.where(better, other.pole_error(), error)
        excess = np.where(better, other.excess, excess)
    frequency, error = bands.centre + offset / (2 * np.pi), error / (2 * np.pi)
    # Where nothing is heard late, a longer window is no other. And what beats turns the phase by ± its amplitude.
    single = np.where(audible, _beyond_noise(tone, whole, np.imag), 0.0) / (2 * np.pi)
    single = np.hypot(single, second / (np.pi * (FREQUENCY_WINDOW[1] - FREQUENCY_WINDOW[0])))
    single = np.hypot(single, error * np.sqrt(excess))
    spread = _shared(np.where(parts.valid, _COMPONENTS * (parts.frequency - frequency), single))
    return np.where(parts.valid, parts.frequency, frequency), np.hypot(error, _FREQUENCY_FLOOR * frequency), spread


def _decays(
    whole: ExponentialFit,
    early: ExponentialFit,
    parts: Components,
    second: np.ndarray,
    clean: np.ndarray,
    law: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Decay rates, their standard errors from noise, and standard deviations of systematic errors, 1/s.

    What beats changes a decay by a factor. Its size is that of the neighbourhood, rms, and is taken of the `law`: a
    size that grew with the value itself would give small values the more weight and, where errors are shared, draw a
    law below them all (Peelle's pertinent puzzle).
    """
    single = -early.fit.pole.real
    decay = np.where(parts.valid, parts.decay, single)
    error = np.where(clean, whole.pole_error(), early.pole_error())
    excess = np.where(clean, whole.excess, early.excess)
    apart = np.where(parts.valid, _COMPONENTS * (decay - single), _beyond_noise(early, whole, np.real))
    apart = np.hypot(apart, error * np.sqrt(excess)) / np.maximum(decay, _DECAY_FLOOR * law)
    spread = law * _nearby(np.minimum(np.hypot(apart, second), _FACTOR))
    decay = np.where(clean, -whole.fit.pole.real, decay)
    return decay, np.hypot(error, _DECAY_FLOOR * decay), spread


def _beyond_noise(short: ExponentialFit, long: ExponentialFit, part: Callable) -> np.ndarray:
    """How far a part of the poles of two windows differs, [partials], 1/s, beyond what noise in the shorter may do."""
    apart, noise = part(short.fit.pole - long.fit.pole), _SURE * short.pole_error()
    return np.sqrt(np.maximum(apart**2 - noise**2, 0.0))


def _shared(spread: np.ndarray) -> np.ndarray:
    """Each partial's, or its neighbourhood's if that is more [partials]: one's own can be nought by chance."""
    return np.maximum(np.abs(np.nan_to_num(spread)), _nearby(spread))


def _nearby(spread: np.ndarray) -> np.ndarray:
    """Rms of each partial's and its neighbours' [partials]."""
    size = np.pad(np.abs(np.nan_to_num(spread)), _NEAR, mode="symmetric")
    return np.sqrt(np.mean(np.lib.stride_tricks.sliding_window_view(size, 2 * _NEAR + 1) ** 2, axis=1))


def _levels(
    bands: Bands,
    z: NDArray[np.complex128],
    whole: ExponentialFit,
    first: ExponentialFit,
    density: np.ndarray,
    decay: np.ndarray,
    second: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Levels, their standard errors from noise and standard deviations of systematic errors, dB, and their lags, s.

    A beat that is fast is what the first moments' exponential leaves over. Of a slow one only later moments tell.
    """
    level, error, lag = level_of(bands, z, whole, density, decay)
    over = np.where(first.excess > 0, 2 * first.fit.misfit, 0.0) / np.maximum(first.fit.power, 1e-300)
    fast = _shared(_where_seen(np.sqrt(over), first.noise < _SEEN**2 * first.fit.power))
    return level, np.hypot(error, _LEVEL_FLOOR), _DB * np.hypot(_FAST * fast, _SLOW * second), lag


def _where_seen(size: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """The size [partials] of something, and of most where noise hides it."""
    return np.where(seen, size, np.median(size[seen]) if seen.any() else 0.0)


def _one_exponential(bands: Bands, z: NDArray[np.complex128], fit: Tones, frame: np.ndarray) -> np.ndarray:
    """Whether one exponential fits down to the noise while it is heard [partials]."""
    signal = fit(bands.time)
    power = np.abs(signal) ** 2
    heard = power > frame[:, None]
    heard[:, :12] = True
    count = np.sum(heard, axis=1)
    rest = np.sum(np.abs(z - signal) ** 2 * heard, axis=1) / count
    return (rest < noise_tolerance(bands, count) * frame) | (
        rest < _CLEAN_MISFIT**2 * np.sum(power * heard, axis=1) / count
    )


def _beating(bands: Bands, z: NDArray[np.complex128], frame: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rms deviation in dB of the log envelope of the first 2 s from a straight line, noise removed; [partials].

    And whether so little noise had to be removed that a beat would be seen.
    """
    cut = bands.cut(0.0, max(2.0, bands.time[0] + 0.2))
    power, t = np.abs(z[:, cut]) ** 2, bands.time[cut]
    weight = (power > 30 * frame[:, None]).astype(float)
    count = np.maximum(weight.sum(1), 1)
    level = 10 * np.log10(np.maximum(power, 1e-60))
    t = t - (weight @ t / count)[:, None]
    level = level - (np.sum(weight * level, 1) / count)[:, None]
    slope = np.sum(weight * t * level, 1) / np.maximum(np.sum(weight * t**2, 1), 1e-12)
    rest = np.sum(weight * (level - slope[:, None] * t) ** 2, 1) / count
    noise = _DB**2 * np.sum(weight * 0.5 * frame[:, None] / np.maximum(power, 1e-60), 1) / count
    told = count >= 8
    size = np.sqrt(np.where(rest > noise_tolerance(bands, count) * noise, rest - noise, 0.0))
    return np.where(told, size, 0.0), told & (noise < (_DB * _SEEN) ** 2)
