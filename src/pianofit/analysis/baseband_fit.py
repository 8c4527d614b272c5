"""One damped exponential per partial through a stretch of its baseband, and what noise does to it.

What a partial's fitted neighbours leak into its band is subtracted, and the fit repeated.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..dsp.damped_powers import powers
from .demodulation import Bands
from .exponential_fit import Tones, fit_tones, lag_poles
from .level import energy_level, mean_time

__all__ = ["ExponentialFit", "first_fits", "with_errors", "level_of", "has_drifted", "noise_tolerance", "window"]

_DB = 20 / np.log(10)
LONG = 2.0  # s of frames that make a level, from the first: the more the less a beat's phase tells, up to here
SLOWEST = 3.0  # 1/s, at which their weight falls at least: what rings on tells little of the strike
FASTEST = 100.0  # 1/s; a law carried far beyond the partials that show it is not believed beyond
LEAST = 0.1  # share of a band's energy that is the partial's at least, whatever the noise


def _physical(bands: Bands, fit: Tones) -> tuple[NDArray[np.complex128], NDArray[np.complex128]]:
    """Amplitudes c and poles p of Re c exp(pt), t from the onset."""
    return 2 * fit.at_onset() / bands.gain(fit.pole), fit.pole + 2j * np.pi * bands.centre


def has_drifted(bands: Bands, fit: Tones) -> np.ndarray:
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
    """One exponential per partial through a stretch of frames, and what noise does to it."""

    fit: Tones
    covariance: np.ndarray  # [3, partials]: variances of log a at the origin and of the pole, and between them
    noise: np.ndarray  # [partials], mean power that the noise has in `fit.misfit`
    excess: np.ndarray  # [partials], residual power beyond what noise may leave, over the noise's, at least 0

    def pole_error(self) -> np.ndarray:
        """Standard error of the pole's real part, and of its imaginary part; 1/s."""
        return np.sqrt(0.5 * self.covariance[2])

    def log_error(self, lever: np.ndarray | float) -> np.ndarray:
        """Standard error of the log envelope `lever` s after the first frame; the phase's is the same."""
        first, between, second = self.covariance
        return np.sqrt(0.5 * np.maximum(first + 2 * lever * between + lever**2 * second, 0.0))


def with_errors(bands: Bands, cut: slice, fit: Tones, density: np.ndarray, damping: float = 0.0) -> ExponentialFit:
    """`fit`, made of the frames `cut`, with the errors that noise of this one-sided `density` [partials] makes.

    Parameters
    ----------
    damping : 1/s; the frames had been multiplied by exp(-damping τ), τ from the first of them
    """
    fade = np.exp(-2 * damping * (bands.time[cut] - fit.origin))
    count = np.sum(fade) ** 2 / np.sum(fade**2)
    noise = density / 2 * bands.noise_width * np.mean(fade)
    covariance = _noise_covariance(bands, cut, fit, damping) * density / 2 * bands.rate
    return ExponentialFit(fit, covariance, noise, np.maximum(fit.misfit / noise - noise_tolerance(bands, count), 0.0))


def _noise_covariance(bands: Bands, cut: slice, fit: Tones, damping: float) -> np.ndarray:
    """As `Fitted.covariance`, for noise of the variance 1 a frame before the window coloured it.

    Least squares turn noise n into (JᴴJ)⁻¹Jᴴn, so (log a, pole) has covariance (JᴴJ)⁻¹ JᴴCJ (JᴴJ)⁻¹. The covariance C
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
    """Residual power over so many frames, relative to the noise's, that noise alone hardly ever exceeds."""
    return 1.3 + 4 / np.sqrt(frames * bands.noise_width / bands.rate)


def window(
    bands: Bands, z: NDArray[np.complex128], fit: Tones, density: np.ndarray, span: tuple[float, float],
    damping: float = 0.0, reach: float = np.inf,
) -> ExponentialFit:  # fmt: skip
    """One exponential through the frames within `span` (s), by least squares under exp(-damping t).

    Poles keep within `reach` (1/s) of those of `fit`.
    """
    cut = bands.cut(*span)
    t = bands.time[cut]
    faded = fit_tones(z[:, cut] * np.exp(-damping * (t - t[0])), t, fit.pole - damping, steps=8, reach=reach)
    return with_errors(bands, cut, replace(faded, pole=faded.pole + damping), density, damping)


def level_of(
    bands: Bands,
    z: NDArray[np.complex128],
    full_record_fit: ExponentialFit,
    density: np.ndarray,
    decay: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Levels and their standard errors from noise, dB; and by how much later than a level's energy theirs came, s.

    The weight falls with the partial's amplitude, by the law: less would weigh noise, more the phase of its beats.

    Parameters
    ----------
    z : basebands, neighbours' leakage subtracted [partials, frames]
    whole : of all frames, for its frequency
    density : [partials], the noise's one-sided
    decay : 1/s, by which the energy of the frames is brought to the level's span
    """
    cut = bands.cut(0.0, bands.time[0] + LONG)
    t = bands.time[cut]
    alpha = np.clip(decay, 0.0, FASTEST)[:, None]
    fade = np.exp(-np.maximum(SLOWEST, alpha) * (t - t[0]))
    wave = np.exp((1j * full_record_fit.fit.pole.imag[:, None] - alpha) * t)
    gain = np.abs(bands.gain(-alpha[:, 0] + 1j * full_record_fit.fit.pole.imag)) / 2
    frame = density / 2 * bands.noise_width  # variance of one frame
    energy, noise = np.sum(np.abs(z[:, cut]) ** 2 * fade, axis=1), frame * fade.sum(axis=1)
    heard, unit = np.maximum(energy - noise, LEAST * energy), np.sum(np.abs(wave) ** 2 * fade, axis=1)
    level = 10 * np.log10(heard / unit / gain**2) + energy_level(np.ones((len(z), 1), complex), -alpha.astype(complex))
    # What noise does along the wave, and its own energy, over that of the wave.
    size, colour = bands.colour(len(t))
    along = np.abs(np.fft.fft(wave * fade, size, axis=1)) ** 2 @ colour / size * density / 4 * bands.rate / unit
    own = 0.25 * frame**2 * np.sum(fade**2, axis=1) * bands.rate / bands.noise_width
    late = (np.abs(wave) ** 2 * fade) @ t / unit - mean_time(alpha[:, 0])
    return level, _DB * np.sqrt(along / heard + own / heard**2), late
