"""One damped exponential per partial, fitted to a part of its baseband, with its errors due to noise.

The leakage of the fitted neighbours into the band of a partial is subtracted, and the fit is repeated.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..dsp.damped_powers import powers
from .demodulation import Bands
from .exponential_fit import Exponentials, autocorrelation_poles, fit_exponentials
from .level import energy_level, mean_time

__all__ = [
    "ExponentialFit",
    "first_fits",
    "with_errors",
    "measure_levels",
    "has_drifted",
    "noise_tolerance",
    "fit_window",
]

_DB = 20 / np.log(10)
LEVEL_FRAMES_SECONDS = 2.0  # s of frames that determine a level: a longer span depends less on the phase of a beat
_MIN_WEIGHT_DECAY = 3.0  # 1/s, of the weight of these frames: late sound carries little information on the strike
_MAX_DECAY = 100.0  # 1/s, upper bound of a decay law extrapolated far beyond the detected partials
_MIN_SHARE = 0.1  # lower bound of the share of a band's energy that is attributed to the partial


def _physical(bands: Bands, fit: Exponentials) -> tuple[NDArray[np.complex128], NDArray[np.complex128]]:
    """Amplitudes c and poles p of Re c exp(pt), t from the onset."""
    return 2 * fit.at_onset() / bands.gain(fit.pole), fit.pole + 2j * np.pi * bands.centre


def has_drifted(bands: Bands, fit: Exponentials) -> np.ndarray:
    """Rows whose fit drifted to another sound in the band, bool [partials]."""
    return np.abs(fit.pole.imag) > 0.25 * 2 * np.pi * bands.spacing


def first_fits(bands: Bands, rounds: int = 3) -> tuple[np.ndarray, Exponentials]:
    """One exponential per partial over the whole recording, without leakage of neighbours: (cleaned z, fits)."""
    z, t = bands.z, bands.time
    early = bands.frames_within(0.0, t[0] + 1.0)
    fit = fit_exponentials(z[:, early], t[early], autocorrelation_poles(z[:, early], t[early], bands.window / 2))
    fit = fit_exponentials(z, t, fit.pole)
    for _ in range(rounds):
        z = bands.z - _leakage(bands, fit)
        fit = fit_exponentials(z, t, fit.pole, steps=4)
    return z, fit


def _leakage(bands: Bands, fit: Exponentials) -> np.ndarray:
    """Leakage of the two neighbours of each partial into its band; others lie outside the slice."""
    c, p = _physical(bands, fit)
    c = np.where(has_drifted(bands, fit), 0, c)
    total = np.zeros_like(bands.z)
    for own, other in ((slice(1, None), slice(None, -1)), (slice(None, -1), slice(1, None))):
        s = p[other] - 2j * np.pi * bands.centre[own]
        inside = np.abs(s.imag) < np.pi * bands.rate
        amplitude = np.where(inside, 0.5 * c[other] * bands.gain(s), 0)
        t = bands.time
        total[own] += (amplitude * np.exp(s * t[0]))[:, None] * powers(s * (t[1] - t[0]), len(t))
    return total


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


def with_errors(
    bands: Bands, cut: slice, fit: Exponentials, density: np.ndarray, damping: float = 0.0
) -> ExponentialFit:
    """`fit` of the frames `cut`, with its errors due to noise of this one-sided `density` [partials].

    Parameters
    ----------
    damping : 1/s; the frames were multiplied by exp(-damping τ), with τ from the first of them
    """
    fade = np.exp(-2 * damping * (bands.time[cut] - fit.origin))
    count = np.sum(fade) ** 2 / np.sum(fade**2)
    noise = density / 2 * bands.noise_width * np.mean(fade)
    covariance = _noise_covariance(bands, cut, fit, damping) * density / 2 * bands.rate
    return ExponentialFit(fit, covariance, noise, np.maximum(fit.misfit / noise - noise_tolerance(bands, count), 0.0))


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


def noise_tolerance(bands: Bands, frames: np.ndarray | float) -> np.ndarray:
    """Residual power over so many frames, relative to the noise power, that noise alone rarely exceeds."""
    return 1.3 + 4 / np.sqrt(frames * bands.noise_width / bands.rate)


def fit_window(
    bands: Bands, z: NDArray[np.complex128], fit: Exponentials, density: np.ndarray, span: tuple[float, float],
    damping: float = 0.0, reach: float = np.inf,
) -> ExponentialFit:  # fmt: skip
    """One exponential through the frames within `span` (s), by least squares under exp(-damping t).

    Poles stay within `reach` (1/s) of those of `fit`.
    """
    cut = bands.frames_within(*span)
    t = bands.time[cut]
    faded = fit_exponentials(z[:, cut] * np.exp(-damping * (t - t[0])), t, fit.pole - damping, steps=8, reach=reach)
    return with_errors(bands, cut, replace(faded, pole=faded.pole + damping), density, damping)


def measure_levels(
    bands: Bands,
    z: NDArray[np.complex128],
    full_record_fit: ExponentialFit,
    density: np.ndarray,
    decay: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Levels and their standard errors due to noise, dB, and `Partials.level_decay_sensitivity_s`, s.

    The weight falls with the amplitude that the decay law predicts. A slower weight would include more noise, a faster
    one would depend on the phase of the beats.

    Parameters
    ----------
    z : basebands without the leakage of neighbours [partials, frames]
    full_record_fit : of all frames; its frequencies are used
    density : one-sided noise density [partials]
    decay : 1/s [partials], which converts the energy of the frames to that of the level's span
    """
    cut = bands.frames_within(0.0, bands.time[0] + LEVEL_FRAMES_SECONDS)
    t = bands.time[cut]
    alpha = np.clip(decay, 0.0, _MAX_DECAY)[:, None]
    fade = np.exp(-np.maximum(_MIN_WEIGHT_DECAY, alpha) * (t - t[0]))
    wave = np.exp((1j * full_record_fit.fit.pole.imag[:, None] - alpha) * t)
    gain = np.abs(bands.gain(-alpha[:, 0] + 1j * full_record_fit.fit.pole.imag)) / 2
    frame = density / 2 * bands.noise_width  # variance of one frame
    energy, noise = np.sum(np.abs(z[:, cut]) ** 2 * fade, axis=1), frame * fade.sum(axis=1)
    partial_energy, unit = np.maximum(energy - noise, _MIN_SHARE * energy), np.sum(np.abs(wave) ** 2 * fade, axis=1)
    level = 10 * np.log10(partial_energy / unit / gain**2)
    level = level + energy_level(np.ones((len(z), 1), complex), -alpha.astype(complex))
    # Variance of the energy: noise times wave, and noise times noise.
    size, colour = bands.colour(len(t))
    noise_times_wave = (
        np.abs(np.fft.fft(wave * fade, size, axis=1)) ** 2 @ colour / size * density / 4 * bands.rate / unit
    )
    noise_times_noise = 0.25 * frame**2 * np.sum(fade**2, axis=1) * bands.rate / bands.noise_width
    lag = (np.abs(wave) ** 2 * fade) @ t / unit - mean_time(alpha[:, 0])
    return level, _DB * np.sqrt(noise_times_wave / partial_energy + noise_times_noise / partial_energy**2), lag
