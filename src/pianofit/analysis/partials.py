"""The table of partials: frequency, decay and level of each, with errors.

Each partial is brought to baseband (demodulate.py) and fitted with one damped exponential over all that was recorded.
What the fitted neighbours leak into the band is subtracted and the fit repeated. Where one exponential describes the
partial down to the noise that is the answer, and close to the Cramér–Rao bound. Real partials beat, glide and decay in
two stages; then each number is taken where it means something:

- frequency from 0.2 to 1.0 s after the onset, or the dominant component's where the partial beats deeply,
- decay rate of the early energy, the first 0.8 s,
- level from one exponential through the first 0.4 s, or, where none follows them, from their energy (energy.py),

and the errors grow by the misfit. A beat too slow to be seen whole bends what one exponential says of a partial by more
than it misses it: how far a fit of other windows differs is taken for that doubt. Beats change little from one partial
to the next, so a doubt is that of a few neighbours, and neighbours share it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .components import LEVEL_RATE, LEVEL_SECONDS, Components, energy_level, resolve
from .demodulate import Bands
from .energy import band_levels
from .tones import Tones, fit_tones, lag_poles

__all__ = ["Measured", "first_fits", "lost", "measure"]

FREQUENCY_WINDOW = (0.2, 1.0)  # s
_EARLY, _FIRST = 0.8, 0.4  # s, for decay rates and for levels
_DEEP = 1.5  # dB rms beyond which a partial counts as beating
_CLEAN_MISFIT = 3e-3  # of the signal's rms: one exponential is then good enough whatever the noise
_DOUBT = 0.15  # share of the difference between one component and several that goes into the error
_EXACT = 1e-4  # misfit over power at which components may be carried back to the onset
_SURE = 2.5  # standard errors from noise that two windows may differ by
_HALF = 0.5  # share of what the two windows' levels differ by
_SEEN = 0.03  # amplitude of the noise, over the partial's, below which a beat is seen
_NEAR = 2  # partials to either side whose doubt a partial shares
_FOLLOWED = 0.05  # misfit of the first moments' exponential, of its rms, up to which it says more than their energy
_NOISY = 0.5  # share of a band's energy that is noise beyond which one exponential says more
_DB = 20 / np.log(10)


@dataclass(frozen=True)
class Measured:
    """Columns of the table, [partials] each."""

    frequency: np.ndarray
    frequency_error: np.ndarray
    frequency_doubt: np.ndarray
    decay: np.ndarray
    decay_error: np.ndarray
    decay_doubt: np.ndarray
    level: np.ndarray
    level_error: np.ndarray
    levels: np.ndarray  # [ways, partials]
    level_errors: np.ndarray
    way: np.ndarray
    level_doubt: np.ndarray
    snr: np.ndarray
    beating: np.ndarray


def _physical(bands: Bands, fit: Tones) -> tuple[NDArray[np.complex128], NDArray[np.complex128]]:
    """Amplitudes c and poles p of Re c exp(pt), t from the onset."""
    return 2 * fit.at_onset() / bands.gain(fit.pole), fit.pole + 2j * np.pi * bands.centre


def lost(bands: Bands, fit: Tones) -> np.ndarray:
    """Rows whose fit ran off to something else in the band, [partials]."""
    return np.abs(fit.pole.imag) > 0.25 * 2 * np.pi * bands.spacing


def first_fits(bands: Bands, rounds: int = 3) -> tuple[np.ndarray, Tones]:
    """One exponential per partial over the whole record, neighbours' leakage subtracted: (cleaned z, fits)."""
    z, t = bands.z, bands.time
    cut = bands.cut(0.0, t[0] + 1.0)
    fit = fit_tones(z[:, cut], t[cut], lag_poles(z[:, cut], t[cut], bands.window / 2))
    fit = fit_tones(z, t, fit.pole)
    for _ in range(rounds):
        z = bands.z - _leakage(bands, fit)
        fit = fit_tones(z, t, fit.pole, steps=4)
    return z, fit


def _leakage(bands: Bands, fit: Tones) -> np.ndarray:
    """Sum what each partial's two neighbours leave in its band; further ones lie outside the slice."""
    c, p = _physical(bands, fit)
    c = np.where(lost(bands, fit), 0, c)
    total = np.zeros_like(bands.z)
    for own, other in ((slice(1, None), slice(None, -1)), (slice(None, -1), slice(1, None))):
        s = p[other] - 2j * np.pi * bands.centre[own]
        inside = np.abs(s.imag) < np.pi * bands.rate
        amplitude = np.where(inside, 0.5 * c[other] * bands.gain(s), 0)
        total[own] += amplitude[:, None] * np.exp(s[:, None] * bands.time)
    return total


def measure(
    samples: np.ndarray, rate: int, spacing: float, bands: Bands, z: NDArray[np.complex128], fit: Tones,
    density: np.ndarray, glides: bool,
) -> Measured:  # fmt: skip
    """Make the columns of the table from the cleaned basebands `z` and the fits over the whole record.

    Parameters
    ----------
    samples : [samples] at `rate`, beginning at the onset
    spacing : of the partials, Hz
    density : [partials], one-sided noise power density, full scale²/Hz
    glides : whether the note's pitch falls measurably; frequencies then come from 0.2 to 1.0 s
    """
    shape = bands.shaping(fit(bands.time) / np.abs(fit.amplitude)[:, None])
    peak = np.sqrt(density / 2 * bands.rate * shape)  # noise of a frame as the partial's peak feels it
    frame = density / 2 * bands.noise_width  # noise variance of one frame
    clean, chi = _one_exponential(bands, z, fit, frame)
    beating, seen = _beating(bands, z, frame)
    # Amplitude of what beats with each partial, over its own. More than that is resolved, or is in the misfit.
    second = _shared(_where_seen(np.minimum(beating, _DEEP), seen) * np.sqrt(2) / _DB)
    whole = _Fit(fit, peak * np.sqrt(np.maximum(1.0, chi)), peak)
    early, tone, first = (
        _window(bands, z, fit, peak, frame, *window)
        for window in ((0.0, _EARLY), FREQUENCY_WINDOW, (0.0, bands.time[0] + _FIRST))
    )
    parts = resolve(bands, z, frame)
    audible = (tone.fit.power > 10 * frame) & (bands.time[-1] > 0.6) & ~lost(bands, tone.fit)
    split = parts.valid & (beating > _DEEP) & ~clean
    frequency = _frequencies(bands, whole, early, tone, parts, second, clean & ~(glides & audible), audible, split)
    decay = _decays(whole, early, parts, second, clean, split)
    energy = band_levels(samples, rate, frequency[0], decay[0], spacing, density)
    level = _levels(bands, whole, first, parts, energy, frame, clean, split, decay[0])
    snr = -20 * np.log10(np.maximum(peak * fit.level_error(0.0), 1e-15))
    return Measured(*frequency, *decay, *level, _level_doubt(level[2], level[3], first, frame), snr, beating)


@dataclass(frozen=True)
class _Fit:
    """A fit with the noise (per frame, [partials]) that its misfit shows, and the recording's alone."""

    fit: Tones
    noise: np.ndarray
    bare: np.ndarray


def _window(
    bands: Bands, z: NDArray[np.complex128], fit: Tones, peak: np.ndarray, frame: np.ndarray, start: float, stop: float
) -> _Fit:
    """One exponential through the frames between `start` and `stop`."""
    cut = bands.cut(start, stop)
    local = fit_tones(z[:, cut], bands.time[cut], fit.pole, steps=8)
    return _Fit(local, peak * np.sqrt(np.maximum(1.0, local.misfit / frame)), peak)


def _frequencies(
    bands: Bands,
    whole: _Fit,
    early: _Fit,
    tone: _Fit,
    parts: Components,
    second: np.ndarray,
    use_whole: np.ndarray,
    audible: np.ndarray,
    split: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Frequencies, their errors, and what of these is doubt, Hz."""
    offset, error = early.fit.pole.imag, early.noise * early.fit.pole_error()
    for better, other in ((audible, tone), (use_whole, whole)):
        offset = np.where(better, other.fit.pole.imag, offset)
        error = np.where(better, other.noise * other.fit.pole_error(), error)
    frequency, error = bands.centre + offset / (2 * np.pi), error / (2 * np.pi)
    # Where nothing is heard late, a longer window is no other. And what beats turns the phase by ± its amplitude.
    single = np.where(audible, _beyond_noise(tone, whole, np.imag), 0.0) / (2 * np.pi)
    single = np.hypot(single, second / (np.pi * (FREQUENCY_WINDOW[1] - FREQUENCY_WINDOW[0])))
    doubt = _shared(np.where(split, _DOUBT * (parts.frequency - frequency), single))
    return np.where(split, parts.frequency, frequency), np.hypot(error, doubt), doubt


def _decays(
    whole: _Fit, early: _Fit, parts: Components, second: np.ndarray, clean: np.ndarray, split: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Decay rates, their errors, and what of these is doubt, 1/s."""
    single = -early.fit.pole.real
    decay = np.where(split, parts.decay, single)
    apart = np.where(split, _DOUBT * (decay - single), _beyond_noise(early, whole, np.real))
    doubt = _shared(np.hypot(apart, second * np.maximum(decay, 0.0)))
    better = np.where(clean, whole.noise * whole.fit.pole_error(), early.noise * early.fit.pole_error())
    return np.where(clean, -whole.fit.pole.real, decay), np.hypot(better, doubt), doubt


def _beyond_noise(short: _Fit, long: _Fit, part: Callable) -> np.ndarray:
    """How far a part of the poles of two windows differs, [partials], 1/s, beyond what noise in the shorter may do."""
    apart, noise = part(short.fit.pole - long.fit.pole), _SURE * short.bare * short.fit.pole_error()
    return np.sqrt(np.maximum(apart**2 - noise**2, 0.0))


def _shared(doubt: np.ndarray) -> np.ndarray:
    """How large each partial's doubt is, or its neighbours' median [partials]: one's own can be nought by chance."""
    size = np.abs(np.nan_to_num(doubt))
    near = np.lib.stride_tricks.sliding_window_view(np.pad(size, _NEAR, mode="symmetric"), 2 * _NEAR + 1)
    return np.maximum(size, np.median(near, axis=1))


def _levels(
    bands: Bands, whole: _Fit, first: _Fit, parts: Components, energy: tuple[np.ndarray, np.ndarray],
    frame: np.ndarray, clean: np.ndarray, split: np.ndarray, decay: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:  # fmt: skip
    """Levels and their errors, dB; the same by each way [ways, partials]; and which way suits each partial."""
    middle = _mean_time(decay)
    level, single = (energy_level(*(x[:, None] for x in _physical(bands, which.fit))) for which in (whole, first))
    heard, noise = energy
    early = np.where(noise < _NOISY, heard, single)
    early = np.where(split & (parts.misfit < _EXACT), parts.level, early)
    doubt = np.where(noise < _NOISY, _DOUBT * (early - single), (early - level) / 2)
    error = _DB * first.noise * first.fit.level_error(middle)
    levels = np.stack([level, single, early])
    errors = np.stack([_DB * whole.noise * whole.fit.level_error(middle), error, np.hypot(error, doubt)])
    followed = first.fit.misfit < np.maximum(_FOLLOWED**2 * first.fit.power, 2 * frame)
    way = np.where(clean, 0, np.where(followed, 1, 2))
    which = way, np.arange(len(way))
    return levels[which], errors[which], levels, errors, way


def _level_doubt(levels: np.ndarray, errors: np.ndarray, first: _Fit, frame: np.ndarray) -> np.ndarray:
    """How far a beat may keep levels [ways, partials] from what the blow alone would have given, dB [partials].

    One that is fast is what the first moments' exponential leaves over. A slow one bends the whole's more than theirs.
    """
    over = np.maximum(first.fit.misfit - frame, 0.0) / np.maximum(first.fit.power, 1e-300)
    apart, noise = levels[0] - levels[1], _SURE * errors[1]
    slow = _HALF * np.sqrt(np.maximum(apart**2 - noise**2, 0.0))
    return _shared(_where_seen(np.hypot(_DB * np.sqrt(2 * over), slow), frame < _SEEN**2 * first.fit.power))


def _where_seen(size: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """The size [partials] of something, and of most where noise hides it."""
    return np.where(seen, size, np.median(size[seen]) if seen.any() else 0.0)


def _mean_time(decay: np.ndarray) -> np.ndarray:
    """Mean time of a partial's energy under exp(−16 t) in the first 0.35 s: where its level is decided, s."""
    x = (2 * np.maximum(decay, -7.0) + LEVEL_RATE) * LEVEL_SECONDS
    return LEVEL_SECONDS * (1 / x - 1 / np.expm1(x))


def _one_exponential(
    bands: Bands, z: NDArray[np.complex128], fit: Tones, frame: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Whether one exponential fits down to the noise while it is heard; and residual over noise power."""
    signal = fit(bands.time)
    power = np.abs(signal) ** 2
    heard = power > frame[:, None]
    heard[:, :12] = True
    count = np.sum(heard, axis=1)
    rest = np.sum(np.abs(z - signal) ** 2 * heard, axis=1) / count
    chi = rest / frame
    slack = 1.3 + 4 / np.sqrt(count * bands.noise_width / bands.rate)
    return (chi < slack) | (rest < _CLEAN_MISFIT**2 * np.sum(power * heard, axis=1) / count), chi


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
    return np.where(told, np.sqrt(np.maximum(rest - noise, 0.0)), 0.0), told & (noise < (_DB * _SEEN) ** 2)
