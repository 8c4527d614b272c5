"""One damped exponential per partial, fitted to a part of its band, with its errors due to noise; and levels.

The leakage of the fitted neighbours into the band of a partial is subtracted, and the fit is repeated. The level of a
partial (`dsp/level.py`) is computed from the energy of the first 2 s, converted to the span of a level by the decay
law. A partial that was not detected has an upper bound: the level of an exponential with all the energy in its band.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..conversions import DB
from ..dsp.bands import Bands, kaiser_bands
from ..dsp.damped_sums import powers
from ..dsp.exponential_fit import Exponentials, autocorrelation_poles, fit_exponentials
from ..dsp.level import LEVEL_RATE, LEVEL_SECONDS, energy_level, mean_time

LEVEL_FRAMES_SECONDS = 2.0  # s of frames that determine a level: a longer span depends less on the phase of a beat


def has_drifted(bands: Bands, fit: Exponentials) -> np.ndarray:
    """Rows whose fit drifted to another sound in the band, bool [partials]."""
    return np.abs(fit.pole.imag) > 0.25 * 2 * np.pi * bands.spacing


@dataclass(frozen=True)
class ExponentialFit:
    """One exponential per partial through a range of frames, and its errors due to noise."""

    fit: Exponentials
    # [3, partials]: variance of log a at the origin, its covariance with the pole, variance of the pole
    covariance: np.ndarray
    noise: np.ndarray  # [partials], mean power of the noise in `fit.misfit`
    excess: np.ndarray  # [partials], residual power beyond the tolerance for noise, over that of the noise, at least 0

    def pole_error(self) -> np.ndarray:
        """Standard error of the pole's real part, and of its imaginary part; 1/s."""
        return np.sqrt(0.5 * self.covariance[2])

    def log_error(self, lever: np.ndarray | float) -> np.ndarray:
        """Standard error of the log envelope `lever` s after the first frame; the phase has the same."""
        first, between, second = self.covariance
        return np.sqrt(0.5 * np.maximum(first + 2 * lever * between + lever**2 * second, 0.0))


@dataclass(frozen=True)
class FittedBands:
    """Bands of partials, with one exponential each through all frames."""

    bands: Bands  # as measured
    z: NDArray[np.complex128]  # without the leakage of neighbours [partials, frames]
    fit: Exponentials
    density: np.ndarray  # one-sided noise density, full scale²/Hz [partials]

    @property
    def frame_noise(self) -> np.ndarray:
        """Noise variance of one frame [partials]."""
        return self.density / 2 * self.bands.noise_width

    @property
    def drifted(self) -> np.ndarray:
        """`has_drifted` of the fit through all frames."""
        return has_drifted(self.bands, self.fit)

    def select(self, keep: np.ndarray) -> FittedBands:
        """The partials selected by `keep`, bool [partials]."""
        return FittedBands(self.bands.select(keep), self.z[keep], self.fit.select(keep), self.density[keep])

    def noise_tolerance(self, frames: np.ndarray | float) -> np.ndarray:
        """Residual power over so many frames, relative to the noise power, that noise alone rarely exceeds."""
        return 1.3 + 4 / np.sqrt(frames * self.bands.noise_width / self.bands.rate)

    def with_errors(self, cut: slice, fit: Exponentials, damping: float = 0.0) -> ExponentialFit:
        """`fit` of the frames `cut`, which were multiplied by exp(-damping τ), with its errors due to noise."""
        fade = np.exp(-2 * damping * (self.bands.time[cut] - fit.origin))
        count = np.sum(fade) ** 2 / np.sum(fade**2)
        noise = self.frame_noise * np.mean(fade)
        covariance = _noise_covariance(self.bands, cut, fit, damping) * self.density / 2 * self.bands.rate
        return ExponentialFit(fit, covariance, noise, np.maximum(fit.misfit / noise - self.noise_tolerance(count), 0.0))

    def fit_window(self, start: float, stop: float, damping: float = 0.0, reach: float = np.inf) -> ExponentialFit:
        """One exponential through the frames within `start`..`stop` s, by least squares under exp(-damping t).

        Poles stay within `reach` (1/s) of those of the fit through all frames.
        """
        cut = self.bands.frames_within(start, stop)
        t = self.bands.time[cut]
        faded = self.z[:, cut] * np.exp(-damping * (t - t[0]))
        fit = fit_exponentials(faded, t, self.fit.pole - damping, steps=8, reach=reach)
        return self.with_errors(cut, replace(fit, pole=fit.pole + damping), damping)


def fit_bands(bands: Bands, density: np.ndarray) -> FittedBands:
    """Fit one exponential to all frames of each band, without the leakage of its neighbours."""
    z, t = bands.z, bands.time
    early = bands.frames_within(0.0, t[0] + 1.0)
    fit = fit_exponentials(z[:, early], t[early], autocorrelation_poles(z[:, early], t[early], bands.window / 2))
    fit = fit_exponentials(z, t, fit.pole)
    for _ in range(3):
        z = bands.z - _leakage(bands, fit)
        fit = fit_exponentials(z, t, fit.pole, steps=4)
    return FittedBands(bands, z, fit, density)


def _leakage(bands: Bands, fit: Exponentials) -> np.ndarray:
    """Leakage of the two neighbours of each partial into its band; others lie outside the slice."""
    # Amplitudes c and poles p of Re c exp(pt), t from the onset.
    c, p = 2 * fit.at_onset() / bands.gain(fit.pole), fit.pole + 2j * np.pi * bands.centre
    c = np.where(has_drifted(bands, fit), 0, c)
    total, t = np.zeros_like(bands.z), bands.time
    for own, other in ((slice(1, None), slice(None, -1)), (slice(None, -1), slice(1, None))):
        s = p[other] - 2j * np.pi * bands.centre[own]
        inside = np.abs(s.imag) < np.pi * bands.rate
        amplitude = np.where(inside, 0.5 * c[other] * bands.gain(s), 0)
        total[own] += (amplitude * np.exp(s * t[0]))[:, None] * powers(s * (t[1] - t[0]), len(t))
    return total


def _noise_covariance(bands: Bands, cut: slice, fit: Exponentials, damping: float) -> np.ndarray:
    """As `ExponentialFit.covariance`, for noise of variance 1 per frame before the window filters it.

    Least squares turns noise n into (JᴴJ)⁻¹Jᴴn, so (log a, pole) has covariance (JᴴJ)⁻¹ JᴴCJ (JᴴJ)⁻¹. The covariance C
    of the frames' noise is that of a stationary process with the spectrum |G|²: JᴴCJ is a sum over frequencies.
    """
    tau = bands.time[cut] - fit.origin
    wave = powers((fit.pole - damping) * (tau[1] - tau[0]), len(tau))
    weighted = wave * np.exp(-damping * tau)
    size, colour = bands.colour(len(tau))
    zeroth, first = (np.fft.fft(w, size, axis=1) for w in (weighted, weighted * tau))
    n0, n1, n2 = ((a * b.conj()).real @ colour / size for a, b in ((zeroth, zeroth), (zeroth, first), (first, first)))
    power = np.abs(wave) ** 2
    p0, p1, p2 = (power @ tau**n for n in range(3))
    plain = np.array([[p2, -p1], [-p1, p0]]) / np.maximum(p0 * p2 - p1**2, 1e-300)
    full = np.einsum("ijp,jkp,klp->ilp", plain, np.array([[n0, n1], [n1, n2]]), plain)
    return np.stack([full[0, 0], full[0, 1], full[1, 1]]) / np.maximum(np.abs(fit.amplitude) ** 2, 1e-300)


def measure_levels(
    fitted: FittedBands, frequency: np.ndarray, decay: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Levels and their standard errors due to noise, dB, and `Partials.level_decay_sensitivity_s`, s.

    The weight falls with the amplitude that the decay law predicts. A slower weight would include more noise, a faster
    one would depend on the phase of the beats. `decay`, 1/s [partials], converts the energy of the frames to that of
    the level's span. The filter passes each partial as it does its `frequency`, Hz [partials].
    """
    bands, frame = fitted.bands, fitted.frame_noise
    offset = 2j * np.pi * (frequency - bands.centre)
    cut = bands.frames_within(0.0, bands.time[0] + LEVEL_FRAMES_SECONDS)
    t = bands.time[cut]
    alpha = np.clip(decay, 0.0, 100.0)[:, None]  # far beyond the detected partials the law would be too fast
    fade = np.exp(-np.maximum(3.0, alpha) * (t - t[0]))  # late sound carries little information on the strike
    wave = np.exp((offset[:, None] - alpha) * t)
    gain = np.abs(bands.gain(-alpha[:, 0] + offset)) / 2
    energy, noise = np.sum(np.abs(fitted.z[:, cut]) ** 2 * fade, axis=1), frame * fade.sum(axis=1)
    partial_energy, unit = np.maximum(energy - noise, 0.1 * energy), np.sum(np.abs(wave) ** 2 * fade, axis=1)
    level = 10 * np.log10(partial_energy / unit / gain**2)
    level = level + energy_level(np.ones((len(alpha), 1), complex), -alpha.astype(complex))
    # Variance of the energy: noise times wave, and noise times noise.
    size, colour = bands.colour(len(t))
    spectrum = np.abs(np.fft.fft(wave * fade, size, axis=1)) ** 2
    noise_times_wave = spectrum @ colour / size * fitted.density / 4 * bands.rate / unit
    noise_times_noise = 0.25 * frame**2 * np.sum(fade**2, axis=1) * bands.rate / bands.noise_width
    lag = (np.abs(wave) ** 2 * fade) @ t / unit - mean_time(alpha[:, 0])
    return level, DB * np.sqrt(noise_times_wave / partial_energy + noise_times_noise / partial_energy**2), lag


def absent_level_bounds(
    samples: np.ndarray, rate: int, frequency: np.ndarray, decay: np.ndarray, f0: float, skip: float
) -> np.ndarray:
    """Upper bounds on the levels of partials that were not detected, dB re full scale² · s, [absent].

    Each is the level of an exponential of that frequency and decay with all the energy in the band, including noise.
    The band falls to zero at the neighbours. At 0.3 spacings it is 5.5 dB down.

    Parameters
    ----------
    samples : [samples] at `rate` (Hz), beginning at the onset
    frequency, decay : [absent], Hz and 1/s, from the laws of the string
    f0 : Hz
    skip : end of the contact, s
    """
    if not len(frequency):
        return np.zeros(0)
    decay = np.minimum(decay, 40.0)
    bands = kaiser_bands(samples[:rate], rate, frequency, 0.97 * f0, skip)
    frames = bands.frames_within(0.0, LEVEL_SECONDS, least=1)
    z, t = bands.z[:, frames], bands.time[frames]
    pole = -decay + 2j * np.pi * (frequency - bands.centre)
    wave = np.abs(bands.gain(pole) / 2)[:, None] * np.exp(-decay[:, None] * t)
    weight = np.exp(-LEVEL_RATE * t)
    power = (np.abs(z) ** 2 @ weight) / (wave**2 @ weight)
    return energy_level(np.sqrt(power)[:, None], (-decay + 2j * np.pi * frequency)[:, None])
