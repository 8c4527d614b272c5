"""Glide: the pitch of real strings falls by some cents during the decay, equally for all partials.

A partial whose frequency changes is not an exponential. An exponential fit overestimates its decay rate, most for high
partials. The glide is therefore fitted to all partials together, as g exp(-t/τ) cents. It is removed from their phases
before the partials are fitted.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .baseband_fit import first_fits, has_drifted
from .demodulation import Bands
from .exponential_fit import Exponentials, fit_exponentials
from .inharmonicity import CENTS

__all__ = ["LEAST_GLIDE", "PitchGlide", "glide_detected", "glide_windows", "remove_glide"]

_WINDOWS = ((0.0, 0.35), (0.2, 1.0), (1.0, 2.0), (2.0, 4.0), (4.0, np.inf))  # s after the onset
_REFERENCE = 1  # index of the window that defines f0
_ROUNDS = 8
_TAU = (0.05, 5.0)  # s, range of time constants of a glide
_USUAL_TAU = 0.5  # s, used if only one window other than the reference has a pitch
# A glide is detected if the pitch changes by more than both.
_SIGNIFICANT = 4.0  # standard errors
LEAST_GLIDE = 0.1  # cents
# Relative error of a glide. One window does not determine τ. With more, the weighting within a window limits it.
_ERROR_ONE_WINDOW = 0.3
_ERROR_SEVERAL_WINDOWS = 0.01
_LOUD = 30.0  # least power of a partial in a window, over the noise power of a frame


class PitchGlide(NamedTuple):
    """A pitch that falls as g exp(-t/τ). Frequencies are means over 0.2 to 1.0 s."""

    start_cents: float  # cents above these frequencies at the onset
    tau: float  # s

    def relative_deviation(self, t: np.ndarray) -> np.ndarray:
        """Relative deviation of a partial from its frequency at t, s after the onset."""
        mean = float(_mean(_WINDOWS[_REFERENCE], np.array(self.tau)))
        return self.start_cents / (1 - mean) / CENTS * (np.exp(-t / self.tau) - mean)

    def phase_advance_s(self, t: np.ndarray) -> np.ndarray:
        """Integral of the relative deviation, s: the advance of the phase over that of a constant pitch."""
        mean = float(_mean(_WINDOWS[_REFERENCE], np.array(self.tau)))
        return self.start_cents / (1 - mean) / CENTS * (self.tau * (1 - np.exp(-t / self.tau)) - mean * t)


def glide_windows(
    bands: Bands, z: NDArray[np.complex128], fit: Exponentials, density: np.ndarray
) -> list[tuple[float, float, float, float]]:
    """Pitch of each window relative to 0.2 to 1.0 s: rows (start s, stop s, cents, standard error in cents).

    The pitch is the median change of frequency over partials, because beats change each partial differently, and a
    glide changes all equally.
    """
    frame = density / 2 * bands.noise_width
    end = float(bands.time[-1])
    shift, spans = [], []
    for start, stop in _WINDOWS:
        frames = bands.frames_within(start, stop - bands.window / 2 if start == 0 else stop, least=1)
        t = bands.time[frames]
        if len(t) < 6 or (start > 0 and end < start + 0.5 * (min(stop, start + 1) - start)):
            shift.append(np.full(len(z), np.nan))
        else:
            local = fit_exponentials(z[:, frames], t, fit.pole, steps=6)
            relative = np.clip(local.pole.imag / (2 * np.pi * bands.centre), -0.1, 0.1)
            cents = CENTS * np.log1p(relative)
            shift.append(np.where((local.power > _LOUD * frame) & ~has_drifted(bands, local), cents, np.nan))
        spans.append((start, float(min(stop, end + bands.window / 2))))
    rows = []
    for (start, stop), row in zip(spans, shift, strict=True):
        moved = row - shift[_REFERENCE]
        moved = moved[np.isfinite(moved)]
        if len(moved):
            middle = float(np.median(moved))
            spread = 1.4826 * float(np.median(np.abs(moved - middle))) * 1.25 / np.sqrt(len(moved))
            rows.append((start, stop, middle, spread if len(moved) > 2 else np.inf))
    return rows


def glide_detected(windows: list[tuple[float, float, float, float]]) -> bool:
    """True if the pitch of any window differs significantly from that of the reference window."""
    return any(abs(cents) > max(_SIGNIFICANT * error, LEAST_GLIDE) for _, _, cents, error in windows)


def remove_glide(
    bands: Bands, z: NDArray[np.complex128], fit: Exponentials, density: np.ndarray,
    windows: list[tuple[float, float, float, float]],
) -> tuple[Bands, NDArray[np.complex128], Exponentials, PitchGlide, float]:  # fmt: skip
    """The bands without the glide, their cleaned z and first fits, the glide, and its error in cents.

    The mean pitch over the reference window does not change. The remaining glide is measured and removed again as long
    as it becomes smaller.

    Parameters
    ----------
    z, fit : cleaned basebands and first fits of `bands`
    windows : from `glide_windows`; windows without a standard error are not used
    """
    windows = [row for row in windows if np.isfinite(row[3])]
    spans = [row[:2] for row in windows]
    total = np.array([row[2] for row in windows])
    error, best, best_fits = float(np.abs(total).max()), bands, (z, fit)
    for _ in range(_ROUNDS):
        straight = replace(bands, z=bands.z * _compensation(bands, fit, _fit_glide(spans, total)))
        z, fit = first_fits(straight)
        remaining = {row[:2]: row[2] for row in glide_windows(straight, z, fit, density)}
        cents = np.array([remaining.get(span, 0.0) for span in spans])
        if np.abs(cents).max() >= error:
            break
        best, best_fits = straight, (z, fit)
        error, total = float(np.abs(cents).max()), total + cents
    size = max(abs(row[2]) for row in windows)
    error = max(error, (_ERROR_ONE_WINDOW if len(windows) == 2 else _ERROR_SEVERAL_WINDOWS) * size)
    return best, *best_fits, _fit_glide(spans, total), error


def _mean(span: tuple[float, float], tau: np.ndarray) -> np.ndarray:
    """Mean of exp(-t/τ) over a window."""
    start, stop = span
    return tau * (np.exp(-start / tau) - np.exp(-stop / tau)) / (stop - start)


def _fit_glide(spans: list[tuple[float, float]], cents: np.ndarray) -> PitchGlide:
    """The glide that changes the pitch of the windows by `cents` relative to the reference window."""
    tau = np.geomspace(*_TAU, 1000)
    moved = np.stack([_mean(span, tau) - _mean(_WINDOWS[_REFERENCE], tau) for span in spans])
    size = (moved * cents[:, None]).sum(axis=0) / (moved**2).sum(axis=0)
    misfit = ((cents[:, None] - size * moved) ** 2).sum(axis=0)
    # One window next to the reference is consistent with any τ. The small penalty then selects a usual one.
    best = int(np.argmin(misfit + 1e-4 * np.log(tau / _USUAL_TAU) ** 2))
    return PitchGlide(float(size[best] * (1 - _mean(_WINDOWS[_REFERENCE], tau[best]))), float(tau[best]))


def _compensation(bands: Bands, fit: Exponentials, glide: PitchGlide) -> NDArray[np.complex128]:
    """Factors [partials, frames] that remove the glide g exp(-t/τ) from the phase and the gain of the window.

    The gain falls with the distance of a partial from the middle of its band.
    """
    turn = 2j * np.pi * bands.centre[:, None]
    middle = 1j * fit.pole.imag[:, None]
    straight = np.exp(-turn * glide.phase_advance_s(bands.time)) * bands.gain(middle)
    return straight / bands.gain(middle + turn * glide.relative_deviation(bands.time))
