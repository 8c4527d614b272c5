"""The table of partials: frequency, decay rate and level of each, with errors.

Each partial is demodulated (`dsp/bands.py`) and fitted with one damped exponential over the whole recording
(baseband_fit.py). If one exponential describes the partial down to the noise, its values are used. Their errors are
close to the Cramér–Rao bound. Real partials beat, glide and decay in two slopes. Their values then come from shorter
windows:

- the frequency from 0.2 to 1.0 s after the onset, or from the dominant component if the partial beats deeply,
- the decay rates from the slopes of the envelope, early and late (envelope_slopes.py). The law of the string goes
  through the early ones. Decay rates of components are not reported: components of a partial cancel, and the mean of
  their rates is not a rate at which the partial decays.

The level is the energy of the first 2 s minus that of the noise, under a weight that falls with the partial. The decay
law of the string converts it to the span in which levels are defined. `level_decay_sensitivity_s` is the sensitivity of
a level to that law, so that recordings of one key can use a common law. Beats change this energy equally in all
recordings of a key: levels of the layers of nine real notes agree within 1.1 dB, and within 1.5 dB if they are computed
from the first 0.1 s.

The standard error of each value is that of the noise in the frames, propagated through the least squares to first
order. The standard deviation of a systematic error is estimated from residuals beyond the noise, and from differences
between windows beyond the noise. It is zero where neither exceeds the noise. Beats of neighbouring partials are
similar, so it is estimated from a few neighbours. Systematic errors of frequencies and levels are correlated between
neighbours, and those of decay rates are not, because a slope depends on the phase of a beat within its window. Errors
of levels and of decay rates have a common part, because vibrations that one stroke begins are in phase.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from ..conversions import DB
from ..dsp.level import LEVEL_RATE
from .analysis_result import Partials
from .baseband_fit import ExponentialFit, FittedBands, has_drifted, measure_levels
from .beating_partials import Components, resolve_components
from .envelope_slopes import Slopes, measure_decay_rates
from .glide import FREQUENCY_WINDOW
from .inharmonicity import DecayLaw, decay_law

LEAST_SNR = 14.0  # dB; a partial below it is rejected

# 1/s, largest difference between the poles of the first window and of the whole recording; beyond, another sound.
_REACH = 20.0
_DEEP = 1.5  # dB rms, above which a partial counts as beating
_CLEAN_MISFIT = 3e-3  # of the signal's rms, below which one exponential is sufficient at any noise
_COMPONENTS = 0.15  # share of the difference between one component and several that is a systematic error
_TOLERANCE = 2.5  # standard errors due to noise by which two windows may differ
_BEAT_VISIBLE = 0.03  # amplitude of the noise over that of the partial, below which a beat can be measured
_NEAR = 2  # partials on either side from which a systematic error is estimated
# Partials over which the correlation of systematic errors of frequencies and levels falls to 1/e; the value of most
# evidence on beating strings.
_CORRELATION_LENGTH = 10.0
# Share of the variance of systematic errors of levels and decay rates that all partials have in common: vibrations that
# a hammer begins together begin in phase, so that beats lower all levels and make all first slopes steeper.
_COMMON = 0.5
# Rounding and remaining leakage without any noise: relative errors, and dB.
_FREQUENCY_FLOOR = 5e-10
_DECAY_FLOOR = 1e-6
_LEVEL_FLOOR = 5e-5


@dataclass(frozen=True)
class _Fits:
    """Fits of all partials in several windows, and what they imply; [partials]."""

    full: ExponentialFit  # all frames
    early: ExponentialFit  # the first 0.8 s, for frequencies of partials that do not last
    middle: ExponentialFit  # `FREQUENCY_WINDOW`
    first: ExponentialFit  # the first 0.4 s, for fast beats
    components: Components
    lasts: np.ndarray  # bool: the partial sounds in `FREQUENCY_WINDOW`
    beat: np.ndarray  # amplitude of the beating component over that of the partial


def measure_partials(number: np.ndarray, fitted: FittedBands, glides: bool) -> tuple[Partials, DecayLaw]:
    """Measure the partials `number`, and the decay law over the whole recording, on which the levels are based.

    The table has no bounds on absent partials yet. If a glide was detected, frequencies come from 0.2 to 1.0 s.
    """
    bands, fit = fitted.bands, fitted.fit
    clean = _one_exponential(fitted)
    beating, beat_visible = _beating(fitted)
    beat = _at_least_neighbours(np.minimum(_fill_hidden(beating, beat_visible) * np.sqrt(2) / DB, 1.0))
    full = fitted.with_errors(slice(None), fit)
    early, middle = fitted.fit_window(0.0, 0.8), fitted.fit_window(*FREQUENCY_WINDOW)
    first = fitted.fit_window(0.0, bands.time[0] + 0.4, LEVEL_RATE / 2, _REACH)
    components = resolve_components(fitted, (beating > _DEEP) & ~clean)
    lasts = (middle.fit.power > 10 * fitted.frame_noise) & (bands.time[-1] > 0.6) & ~has_drifted(bands, middle.fit)
    fits = _Fits(full, early, middle, first, components, lasts, beat)
    snr = -20 * np.log10(np.maximum(full.log_error(-fit.origin), 1e-15))
    detected = (snr > LEAST_SNR) & ~fitted.drifted  # other peaks must not influence the law
    detected |= not detected.any()
    law = decay_law(number[detected], -fit.pole.real[detected], full.pole_error()[detected])
    frequency, frequency_error, frequency_sd = _frequencies(fits, bands.centre, clean & ~(glides & lasts))
    early_slope, late_slope = (_of_clean(slopes, full, clean, beat_visible) for slopes in measure_decay_rates(fitted))
    level, level_error, level_sd, lag = _levels(fits, fitted, law(number))
    near = np.exp(-np.abs(number[:, None] - number) / _CORRELATION_LENGTH)
    table = Partials(
        number=number,
        frequency=frequency,
        frequency_error=frequency_error,
        frequency_systematic=_covariance(frequency_sd, near),
        decay=early_slope.rate,
        decay_error=early_slope.noise,
        decay_systematic=_covariance(_early_beat_error(early_slope), np.eye(len(number)), _COMMON),
        late_decay=late_slope.rate,
        late_decay_error=np.hypot(late_slope.noise, late_slope.beat_error),
        slope_times=np.stack([early_slope.start, early_slope.stop, late_slope.stop], axis=1),
        level=level,
        level_error=level_error,
        level_systematic=_covariance(level_sd, near, _COMMON) + _decay_law_covariance(number, lag, law),
        level_decay_sensitivity_s=lag,
        snr=snr,
        beating=beating,
        absent=np.zeros(0, int),
        absent_bound=np.zeros(0),
    )
    return table, law


def _covariance(sd: np.ndarray, correlation: np.ndarray, common: float = 0.0) -> np.ndarray:
    """Covariance [partials, partials] of systematic errors with standard deviations `sd` [partials].

    `common` is the share of the variance that all partials have in common. The rest has this `correlation`.
    """
    return np.outer(sd, sd) * (common + (1 - common) * correlation)


def _decay_law_covariance(number: np.ndarray, lag: np.ndarray, law: DecayLaw) -> np.ndarray:
    """Covariance of levels [partials, partials], dB², due to the errors of the decay law on which they are based.

    The errors of b1 and d2 are negatively correlated. The correlation is neglected, so the covariance is a bound.
    """
    errors = np.array([law.b1_error, law.d2_error if np.isfinite(law.d2_error) else 0.0])
    gradient = DB * lag[:, None] * errors * np.stack([np.ones(len(number)), number**2.0], axis=1)
    return gradient @ gradient.T


def _frequencies(fits: _Fits, centre: np.ndarray, use_full: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Frequencies, their standard errors due to noise, and standard deviations of systematic errors, Hz.

    `use_full` selects the fit of the whole recording.
    """
    components = fits.components
    offset, error, excess = fits.early.fit.pole.imag, fits.early.pole_error(), fits.early.excess
    for better, other in ((fits.lasts, fits.middle), (use_full, fits.full)):
        offset = np.where(better, other.fit.pole.imag, offset)
        error = np.where(better, other.pole_error(), error)
        excess = np.where(better, other.excess, excess)
    frequency, error = centre + offset / (2 * np.pi), error / (2 * np.pi)
    # A short partial is the same in all windows. A beating component changes the phase by ± its relative amplitude.
    single = np.where(fits.lasts, _beyond_noise(fits.middle, fits.full, np.imag), 0.0) / (2 * np.pi)
    slow = np.minimum(fits.beat, _DEEP * np.sqrt(2) / DB)  # deeper beats are resolved, or are in the misfit
    single = np.hypot(single, slow / (np.pi * (FREQUENCY_WINDOW[1] - FREQUENCY_WINDOW[0])))
    single = np.hypot(single, error * np.sqrt(excess))
    sd = _at_least_neighbours(np.where(components.valid, _COMPONENTS * (components.frequency - frequency), single))
    error = np.hypot(error, _FREQUENCY_FLOOR * frequency)
    return np.where(components.valid, components.frequency, frequency), error, sd


def _of_clean(slopes: Slopes, full: ExponentialFit, clean: np.ndarray, beat_visible: np.ndarray) -> Slopes:
    """Slopes, with the exponential of the whole recording where one is sufficient, bool `clean` [partials].

    Such a partial does not beat if a beat would be visible above its noise. If not, it can beat as the others do.
    """
    measured = np.isfinite(slopes.rate)
    rate = np.where(clean & measured, -full.fit.pole.real, slopes.rate)
    noise = np.where(clean & measured, full.pole_error(), slopes.noise)
    beats = _fill_hidden(np.where(clean, 0.0, slopes.beats), beat_visible | ~clean)
    return replace(
        slopes, rate=rate, noise=np.hypot(noise, _DECAY_FLOOR * np.abs(rate)), beats=_at_least_neighbours(beats)
    )


def _early_beat_error(early: Slopes) -> np.ndarray:
    """Standard deviations of early decay rates due to beats, 1/s [partials].

    A line is shorter where the measured rate is larger. An error proportional to the measured value would give small
    values more weight. With correlated errors a fitted law would then lie below all values (Peelle's pertinent puzzle).
    The duration is therefore the geometric mean over neighbours.
    """
    log = np.pad(np.log(early.stop - early.start), _NEAR, mode="symmetric")
    return early.beats / np.exp(np.mean(np.lib.stride_tricks.sliding_window_view(log, 2 * _NEAR + 1), axis=1))


def _levels(
    fits: _Fits, fitted: FittedBands, decay: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Levels, their standard errors due to noise and standard deviations of systematic errors, dB, and their lags, s.

    Fast beats are measured by the residual in the first window, slow ones by the envelope of the first 2 s. Two
    vibrations of amplitudes 1 and a that begin in phase have the energy 1 + a² instead of (1 + a)².
    """
    bands, components = fitted.bands, fits.components
    frequency = np.where(components.valid, components.frequency, bands.centre + fitted.fit.pole.imag / (2 * np.pi))
    level, error, lag = measure_levels(fitted, frequency, decay)
    first, power = fits.first, fits.first.fit.power
    residual = np.where(first.excess > 0, 2 * first.fit.misfit, 0.0) / np.maximum(power, 1e-300)
    fast = _at_least_neighbours(_fill_hidden(np.sqrt(residual), first.noise < _BEAT_VISIBLE**2 * power))
    a = np.minimum(np.maximum(fast, fits.beat), 1.0)
    sd = DB * np.log((1 + a) / np.sqrt(1 + a**2))
    return level, np.hypot(error, _LEVEL_FLOOR), sd, lag


def _beyond_noise(short: ExponentialFit, long: ExponentialFit, part: Callable) -> np.ndarray:
    """Difference of one part of the poles of two windows beyond the noise of the shorter [partials], 1/s."""
    difference, noise = part(short.fit.pole - long.fit.pole), _TOLERANCE * short.pole_error()
    return np.sqrt(np.maximum(difference**2 - noise**2, 0.0))


def _at_least_neighbours(sd: np.ndarray) -> np.ndarray:
    """The larger of each value and the rms of its neighbours [partials]; a single value can be zero by chance."""
    size = np.abs(np.nan_to_num(sd))
    near = np.lib.stride_tricks.sliding_window_view(np.pad(size, _NEAR, mode="symmetric"), 2 * _NEAR + 1)
    return np.maximum(size, np.sqrt(np.mean(near**2, axis=1)))


def _fill_hidden(size: np.ndarray, visible: np.ndarray) -> np.ndarray:
    """`size` [partials], with the median of the visible values where noise hides it."""
    return np.where(visible, size, np.median(size[visible]) if visible.any() else 0.0)


def _one_exponential(fitted: FittedBands) -> np.ndarray:
    """True if one exponential fits down to the noise while it is above the noise [partials]."""
    signal, frame = fitted.fit(fitted.bands.time), fitted.frame_noise
    power = np.abs(signal) ** 2
    above_noise = power > frame[:, None]
    above_noise[:, :12] = True
    count = np.sum(above_noise, axis=1)
    residual = np.sum(np.abs(fitted.z - signal) ** 2 * above_noise, axis=1) / count
    sufficient = residual < _CLEAN_MISFIT**2 * np.sum(power * above_noise, axis=1) / count
    return (residual < fitted.noise_tolerance(count) * frame) | sufficient


def _beating(fitted: FittedBands) -> tuple[np.ndarray, np.ndarray]:
    """Rms deviation in dB of the log envelope of the first 2 s from a straight line, noise removed; [partials].

    The second value is True where the noise is low enough for a beat to be measured.
    """
    bands, frame = fitted.bands, fitted.frame_noise
    frames = bands.frames_within(0.0, max(2.0, bands.time[0] + 0.2))
    power, t = np.abs(fitted.z[:, frames]) ** 2, bands.time[frames]
    weight = (power > 30 * frame[:, None]).astype(float)
    count = np.maximum(weight.sum(1), 1)
    level = 10 * np.log10(np.maximum(power, 1e-60))
    t = t - (weight @ t / count)[:, None]
    level = level - (np.sum(weight * level, 1) / count)[:, None]
    slope = np.sum(weight * t * level, 1) / np.maximum(np.sum(weight * t**2, 1), 1e-12)
    residual = np.sum(weight * (level - slope[:, None] * t) ** 2, 1) / count
    noise = DB**2 * np.sum(weight * 0.5 * frame[:, None] / np.maximum(power, 1e-60), 1) / count
    size = np.sqrt(np.where(residual > fitted.noise_tolerance(count) * noise, residual - noise, 0.0))
    enough = count >= 8
    return np.where(enough, size, 0.0), enough & (noise < (DB * _BEAT_VISIBLE) ** 2)
