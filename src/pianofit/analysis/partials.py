"""The table of partials: frequency, decay rate and level of each, with errors.

Each partial is demodulated (demodulation.py) and fitted with one damped exponential over the whole recording
(baseband_fit.py). If one exponential describes the partial down to the noise, its values are used. Their errors are
close to the Cramér–Rao bound. Real partials beat, glide and decay in two slopes. Their values then come from shorter
windows:

- the frequency from 0.2 to 1.0 s after the onset, or from the dominant component if the partial beats deeply,
- the decay rate from the first 0.8 s, which hold most of the energy.

The level is the energy of the first 2 s minus that of the noise, under a weight that falls with the partial. The decay
law of the string converts it to the span in which levels are defined. `level_decay_sensitivity_s` is the sensitivity of
a level to that law, so that recordings of one key can use a common law. Beats change this energy equally in all
recordings of a key: levels of the layers of nine real notes agree within 1.1 dB, and within 1.5 dB if they are computed
from the first 0.1 s.

The standard error of each value is that of the noise in the frames, propagated through the least squares to first
order. The standard deviation of a systematic error is estimated from residuals beyond the noise, and from differences
between windows beyond the noise. It is zero where neither exceeds the noise. Beats of neighbouring partials are
similar, so it is estimated from a few neighbours, and their systematic errors are correlated.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .baseband_fit import ExponentialFit, fit_window, has_drifted, measure_levels, noise_tolerance, with_errors
from .beating_partials import Components, resolve_components
from .demodulation import Bands
from .exponential_fit import Exponentials
from .inharmonicity import DecayLaw, decay_law
from .level import LEVEL_RATE

__all__ = ["LEAST_SNR", "PartialTable", "decay_law_covariance", "measure_partials", "systematic"]

LEAST_SNR = 14.0  # dB; a partial below it is rejected

FREQUENCY_WINDOW = (0.2, 1.0)  # s
_EARLY = 0.8  # s, window of decay rates
_FIRST = 0.4  # s, window in which fast beats are measured
# 1/s, largest difference between the poles of the first window and of the whole recording; beyond, another sound.
_REACH = 20.0
_DEEP = 1.5  # dB rms, above which a partial counts as beating
_CLEAN_MISFIT = 3e-3  # of the signal's rms, below which one exponential is sufficient at any noise
_COMPONENTS = 0.15  # share of the difference between one component and several that is a systematic error
_TOLERANCE = 2.5  # standard errors due to noise by which two windows may differ
_FAST_BEAT_FACTOR = 0.6  # systematic error of a level, nepers, over the amplitude of the residual in the first window
_SLOW_BEAT_FACTOR = 0.5  # the same, over the amplitude of the beats within 2 s
_BEAT_VISIBLE = 0.03  # amplitude of the noise over that of the partial, below which a beat can be measured
_NEAR = 2  # partials on either side from which a systematic error is estimated
_MAX_LOG_CHANGE = 2.0  # log; upper bound of the change of a decay rate by beats
# Partials over which the correlation of systematic errors falls to 1/e; the value of most evidence on beating strings.
_CORRELATION_LENGTH = 10.0
_FREQUENCY_FLOOR = 5e-10  # relative; rounding and remaining leakage without any noise
_DECAY_FLOOR = 1e-6  # relative; the same
_LEVEL_FLOOR = 5e-5  # dB; the same
_DB = 20 / np.log(10)


@dataclass(frozen=True)
class PartialTable:
    """Columns of the table, [partials] each; `_systematic_sd` is the standard deviation of a systematic error."""

    frequency: np.ndarray
    frequency_error: np.ndarray
    frequency_systematic_sd: np.ndarray
    decay: np.ndarray
    decay_error: np.ndarray
    decay_systematic_sd: np.ndarray
    level: np.ndarray
    level_error: np.ndarray
    level_systematic_sd: np.ndarray
    level_decay_sensitivity_s: np.ndarray
    snr: np.ndarray
    beating: np.ndarray
    level_law: DecayLaw  # fitted to the decay rates over the whole recording, on which the levels are based

    def total_error(self, column: str) -> np.ndarray:
        """Total standard deviation of "frequency", "decay" or "level": noise and systematic error [partials]."""
        return np.hypot(getattr(self, f"{column}_error"), getattr(self, f"{column}_systematic_sd"))


def systematic(number: np.ndarray, sd: np.ndarray) -> np.ndarray:
    """Covariance [partials, partials] of systematic errors with standard deviations `sd` [partials]."""
    distance = np.abs(number[:, None] - number[None, :])
    return sd[:, None] * sd[None, :] * np.exp(-distance / _CORRELATION_LENGTH)


def decay_law_covariance(number: np.ndarray, lag: np.ndarray, law: DecayLaw) -> np.ndarray:
    """Covariance of levels [partials, partials], dB², due to the errors of the decay law on which they are based.

    The errors of b1 and d2 are negatively correlated. The correlation is neglected, so the covariance is a bound.
    """
    errors = np.array([law.b1_error, law.d2_error if np.isfinite(law.d2_error) else 0.0])
    gradient = _DB * lag[:, None] * errors * np.stack([np.ones(len(number)), number**2.0], axis=1)
    return gradient @ gradient.T


def measure_partials(
    number: np.ndarray, bands: Bands, z: NDArray[np.complex128], fit: Exponentials, density: np.ndarray, glides: bool
) -> PartialTable:
    """Compute the columns of the table from the cleaned basebands `z` and the fits over the whole recording.

    Parameters
    ----------
    density : one-sided noise power density, full scale²/Hz [partials]
    glides : True if a glide was detected; frequencies then come from 0.2 to 1.0 s
    """
    frame = density / 2 * bands.noise_width  # noise variance of one frame
    clean = _one_exponential(bands, z, fit, frame)
    beating, beat_visible = _beating(bands, z, frame)
    # Amplitude of the beating component over that of the partial. Deeper beats are resolved, or are in the misfit.
    beat = _shared(_fill_hidden(np.minimum(beating, _DEEP), beat_visible) * np.sqrt(2) / _DB)
    full = with_errors(bands, slice(None), fit, density)
    early, middle = (fit_window(bands, z, fit, density, span) for span in ((0.0, _EARLY), FREQUENCY_WINDOW))
    first = fit_window(bands, z, fit, density, (0.0, bands.time[0] + _FIRST), LEVEL_RATE / 2, _REACH)
    components = resolve_components(bands, z, frame, (beating > _DEEP) & ~clean)
    snr = -20 * np.log10(np.maximum(full.log_error(-fit.origin), 1e-15))
    detected = (snr > LEAST_SNR) & ~has_drifted(bands, full.fit)  # other peaks must not influence the law
    detected |= not detected.any()
    law = decay_law(number[detected], -full.fit.pole.real[detected], full.pole_error()[detected])
    lasts = (middle.fit.power > 10 * frame) & (bands.time[-1] > 0.6) & ~has_drifted(bands, middle.fit)
    frequency = _frequencies(bands, full, early, middle, components, beat, clean & ~(glides & lasts), lasts)
    decay = _decays(full, early, components, beat, clean, law(number))
    level = _levels(bands, z, full, first, density, law(number), beat)
    return PartialTable(*frequency, *decay, *level, snr, beating, law)


def _frequencies(
    bands: Bands,
    full: ExponentialFit,
    early: ExponentialFit,
    middle: ExponentialFit,
    components: Components,
    beat: np.ndarray,
    use_full: np.ndarray,
    lasts: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Frequencies, their standard errors due to noise, and standard deviations of systematic errors, Hz.

    `use_full` selects the fit of the whole recording. `lasts` marks partials that sound in the window of frequencies.
    """
    offset, error, excess = early.fit.pole.imag, early.pole_error(), early.excess
    for better, other in ((lasts, middle), (use_full, full)):
        offset = np.where(better, other.fit.pole.imag, offset)
        error = np.where(better, other.pole_error(), error)
        excess = np.where(better, other.excess, excess)
    frequency, error = bands.centre + offset / (2 * np.pi), error / (2 * np.pi)
    # A short partial is the same in all windows. A beating component changes the phase by ± its relative amplitude.
    single = np.where(lasts, _beyond_noise(middle, full, np.imag), 0.0) / (2 * np.pi)
    single = np.hypot(single, beat / (np.pi * (FREQUENCY_WINDOW[1] - FREQUENCY_WINDOW[0])))
    single = np.hypot(single, error * np.sqrt(excess))
    sd = _shared(np.where(components.valid, _COMPONENTS * (components.frequency - frequency), single))
    error = np.hypot(error, _FREQUENCY_FLOOR * frequency)
    return np.where(components.valid, components.frequency, frequency), error, sd


def _decays(
    full: ExponentialFit,
    early: ExponentialFit,
    components: Components,
    beat: np.ndarray,
    clean: np.ndarray,
    law: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Decay rates, their standard errors due to noise, and standard deviations of systematic errors, 1/s.

    Beats change a decay rate by a factor. The systematic error is the rms over neighbours of the relative change, times
    the decay rate of the `law`. An error proportional to the measured value would give small values more weight. With
    correlated errors a fitted law would then lie below all values (Peelle's pertinent puzzle).
    """
    single = -early.fit.pole.real
    decay = np.where(components.valid, components.decay, single)
    error = np.where(clean, full.pole_error(), early.pole_error())
    excess = np.where(clean, full.excess, early.excess)
    change = np.where(components.valid, _COMPONENTS * (decay - single), _beyond_noise(early, full, np.real))
    change = np.hypot(change, error * np.sqrt(excess)) / np.maximum(decay, _DECAY_FLOOR * law)
    sd = law * _neighbour_rms(np.minimum(np.hypot(change, beat), _MAX_LOG_CHANGE))
    decay = np.where(clean, -full.fit.pole.real, decay)
    return decay, np.hypot(error, _DECAY_FLOOR * decay), sd


def _beyond_noise(short: ExponentialFit, long: ExponentialFit, part: Callable) -> np.ndarray:
    """Difference of one part of the poles of two windows beyond the noise of the shorter [partials], 1/s."""
    difference, noise = part(short.fit.pole - long.fit.pole), _TOLERANCE * short.pole_error()
    return np.sqrt(np.maximum(difference**2 - noise**2, 0.0))


def _shared(sd: np.ndarray) -> np.ndarray:
    """The larger of each value and the rms of its neighbours [partials]; a single value can be zero by chance."""
    return np.maximum(np.abs(np.nan_to_num(sd)), _neighbour_rms(sd))


def _neighbour_rms(sd: np.ndarray) -> np.ndarray:
    """Rms over each value and its neighbours [partials]."""
    size = np.pad(np.abs(np.nan_to_num(sd)), _NEAR, mode="symmetric")
    return np.sqrt(np.mean(np.lib.stride_tricks.sliding_window_view(size, 2 * _NEAR + 1) ** 2, axis=1))


def _levels(
    bands: Bands,
    z: NDArray[np.complex128],
    full: ExponentialFit,
    first: ExponentialFit,
    density: np.ndarray,
    decay: np.ndarray,
    beat: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Levels, their standard errors due to noise and standard deviations of systematic errors, dB, and their lags, s.

    Fast beats are measured by the residual in the first window, slow ones by the envelope of the first 2 s.
    """
    level, error, lag = measure_levels(bands, z, full, density, decay)
    residual = np.where(first.excess > 0, 2 * first.fit.misfit, 0.0) / np.maximum(first.fit.power, 1e-300)
    fast = _shared(_fill_hidden(np.sqrt(residual), first.noise < _BEAT_VISIBLE**2 * first.fit.power))
    return level, np.hypot(error, _LEVEL_FLOOR), _DB * np.hypot(_FAST_BEAT_FACTOR * fast, _SLOW_BEAT_FACTOR * beat), lag


def _fill_hidden(size: np.ndarray, visible: np.ndarray) -> np.ndarray:
    """`size` [partials], with the median of the visible values where noise hides it."""
    return np.where(visible, size, np.median(size[visible]) if visible.any() else 0.0)


def _one_exponential(bands: Bands, z: NDArray[np.complex128], fit: Exponentials, frame: np.ndarray) -> np.ndarray:
    """True if one exponential fits down to the noise while it is above the noise [partials]."""
    signal = fit(bands.time)
    power = np.abs(signal) ** 2
    above_noise = power > frame[:, None]
    above_noise[:, :12] = True
    count = np.sum(above_noise, axis=1)
    residual = np.sum(np.abs(z - signal) ** 2 * above_noise, axis=1) / count
    return (residual < noise_tolerance(bands, count) * frame) | (
        residual < _CLEAN_MISFIT**2 * np.sum(power * above_noise, axis=1) / count
    )


def _beating(bands: Bands, z: NDArray[np.complex128], frame: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rms deviation in dB of the log envelope of the first 2 s from a straight line, noise removed; [partials].

    The second value is True where the noise is low enough for a beat to be measured.
    """
    frames = bands.frames_within(0.0, max(2.0, bands.time[0] + 0.2))
    power, t = np.abs(z[:, frames]) ** 2, bands.time[frames]
    weight = (power > 30 * frame[:, None]).astype(float)
    count = np.maximum(weight.sum(1), 1)
    level = 10 * np.log10(np.maximum(power, 1e-60))
    t = t - (weight @ t / count)[:, None]
    level = level - (np.sum(weight * level, 1) / count)[:, None]
    slope = np.sum(weight * t * level, 1) / np.maximum(np.sum(weight * t**2, 1), 1e-12)
    residual = np.sum(weight * (level - slope[:, None] * t) ** 2, 1) / count
    noise = _DB**2 * np.sum(weight * 0.5 * frame[:, None] / np.maximum(power, 1e-60), 1) / count
    enough = count >= 8
    size = np.sqrt(np.where(residual > noise_tolerance(bands, count) * noise, residual - noise, 0.0))
    return np.where(enough, size, 0.0), enough & (noise < (_DB * _BEAT_VISIBLE) ** 2)
