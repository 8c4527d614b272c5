"""Glide: the tension and with it the pitch of real strings falls during the decay.

The fundamental falls by some cents, and each partial by the share of the tension in its restoring force, 1/(1 + B k²).
A partial whose frequency changes is not an exponential. An exponential fit overestimates its decay rate. The glide is
therefore fitted to all partials together, as g exp(-t/τ) cents. It is removed from their phases before the partials are
fitted.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..conversions import CENTS
from ..dsp.bands import Bands
from ..dsp.exponential_fit import Exponentials, fit_exponentials
from .baseband_fit import FittedBands, fit_bands, has_drifted

FREQUENCY_WINDOW = (0.2, 1.0)  # s after the onset; it defines f0
_WINDOWS = ((0.0, 0.35), FREQUENCY_WINDOW, (1.0, 2.0), (2.0, 4.0), (4.0, np.inf))  # s after the onset
# A glide is detected if the pitch changes by more than both.
_SIGNIFICANT = 4.0  # standard errors
_LEAST_GLIDE = 0.01  # cents; sounds of constant pitch without noise move by less, due to leakage between bands
# Median τ, s, and standard deviation of its logarithm, of the glides of recorded piano strings whose windows determine
# it. Beats can move the pitch of one window. Without this prior, the glide is then one of the first 50 ms, of some
# cents.
_TAU, _TAU_SD = 0.8, 0.6
_ROUNDING = 1e-4  # cents; without noise the windows have no error

Window = tuple[float, float, float, float]  # start s, stop s, cents, standard error in cents


class PitchGlide(NamedTuple):
    """A pitch that falls as g exp(-t/τ). Frequencies are means over 0.2 to 1.0 s."""

    start_cents: float  # cents above these frequencies at the onset
    tau: float  # s

    def relative_deviation(self, t: np.ndarray) -> np.ndarray:
        """Relative deviation of the fundamental from its frequency at t, s after the onset."""
        mean = _mean(FREQUENCY_WINDOW, self.tau)
        return self.start_cents / (1 - mean) / CENTS * (np.exp(-t / self.tau) - mean)

    def phase_advance_s(self, t: np.ndarray) -> np.ndarray:
        """Integral of the relative deviation, s: the advance of the phase over that of a constant pitch."""
        mean = _mean(FREQUENCY_WINDOW, self.tau)
        return self.start_cents / (1 - mean) / CENTS * (self.tau * (1 - np.exp(-t / self.tau)) - mean * t)


def glide_windows(fitted: FittedBands, share: np.ndarray) -> list[Window]:
    """Pitch of each window relative to 0.2 to 1.0 s.

    The pitch is the median over partials of the change of frequency over its share of the tension [partials]. Beats
    change each partial differently.
    """
    bands = fitted.bands
    end = float(bands.time[-1])
    shift, spans = [], []
    for start, stop in _WINDOWS:
        frames = bands.frames_within(start, stop - bands.window / 2 if start == 0 else stop, least=1)
        t = bands.time[frames]
        if len(t) < 6 or (start > 0 and end < start + 0.5 * (min(stop, start + 1) - start)):
            shift.append(np.full(len(fitted.z), np.nan))
        else:
            local = fit_exponentials(fitted.z[:, frames], t, fitted.fit.pole, steps=6)
            cents = CENTS * np.log1p(np.clip(local.pole.imag / (2 * np.pi * bands.centre), -0.1, 0.1))
            usable = (local.power > 30.0 * fitted.frame_noise) & ~has_drifted(bands, local)
            shift.append(np.where(usable, cents / share, np.nan))
        spans.append((start, float(min(stop, end + bands.window / 2))))
    rows = []
    for span, row in zip(spans, shift, strict=True):
        moved = row - shift[_WINDOWS.index(FREQUENCY_WINDOW)]
        moved = moved[np.isfinite(moved)]
        if len(moved):
            middle = float(np.median(moved))
            spread = 1.4826 * float(np.median(np.abs(moved - middle))) * 1.25 / np.sqrt(len(moved))
            rows.append((*span, middle, spread if len(moved) > 2 else np.inf))
    return rows


def glide_detected(windows: list[Window]) -> bool:
    """True if the pitch of any window differs significantly from that of the reference window."""
    return any(abs(cents) > max(_SIGNIFICANT * error, _LEAST_GLIDE) for _, _, cents, error in windows)


def remove_glide(
    fitted: FittedBands, windows: list[Window], share: np.ndarray
) -> tuple[FittedBands, PitchGlide, float]:
    """The bands without the glide, the glide, and its error in cents; `share` of the tension of partials [partials].

    The mean pitch over the reference window does not change. The remaining glide is measured and removed again as long
    as it becomes smaller. Windows without a standard error are not used.
    """
    windows = [row for row in windows if np.isfinite(row[3])]
    spans, bands = [row[:2] for row in windows], fitted.bands
    total, errors = np.array([row[2:] for row in windows]).T
    error, best = float(np.abs(total).max()), fitted
    for _ in range(8):
        straight = replace(bands, z=bands.z * _compensation(bands, fitted.fit, _fit_glide(spans, total, errors), share))
        fitted = fit_bands(straight, fitted.density)
        remaining = {row[:2]: row[2] for row in glide_windows(fitted, share)}
        cents = np.array([remaining.get(span, 0.0) for span in spans])
        if np.abs(cents).max() >= error:
            break
        best, error, total = fitted, float(np.abs(cents).max()), total + cents
    # Relative error: one window does not determine τ. With more, the weighting within a window limits it.
    relative = 0.3 if len(windows) == 2 else 0.01
    return best, _fit_glide(spans, total, errors), max(error, relative * max(abs(row[2]) for row in windows))


def _mean(span: tuple[float, float], tau: np.ndarray | float) -> np.ndarray:
    """Mean of exp(-t/τ) over a window."""
    start, stop = span
    return tau * (np.exp(-start / tau) - np.exp(-stop / tau)) / (stop - start)


def _fit_glide(spans: list[tuple[float, float]], cents: np.ndarray, errors: np.ndarray) -> PitchGlide:
    """The most probable glide that changes the pitch of the windows by `cents` relative to the reference window.

    Beats move the pitch of all partials of a window alike, so the scatter of the windows is unknown. It is integrated
    out, above their standard errors.
    """
    tau = np.geomspace(0.05, 5.0, 1000)  # s
    moved = np.stack([_mean(span, tau) - _mean(FREQUENCY_WINDOW, tau) for span in spans])
    size = (moved * cents[:, None]).sum(axis=0) / (moved**2).sum(axis=0)
    misfit = ((cents[:, None] - size * moved) ** 2).sum(axis=0) + (errors**2).sum() + _ROUNDING**2
    best = int(np.argmin(len(spans) * np.log(misfit) + (np.log(tau / _TAU) / _TAU_SD) ** 2))
    return PitchGlide(float(size[best] * (1 - _mean(FREQUENCY_WINDOW, tau[best]))), float(tau[best]))


def _compensation(bands: Bands, fit: Exponentials, glide: PitchGlide, share: np.ndarray) -> NDArray[np.complex128]:
    """Factors [partials, frames] that remove the glide g exp(-t/τ) from the phase and the gain of the window.

    The gain falls with the distance of a partial from the middle of its band.
    """
    turn = 2j * np.pi * (share * bands.centre)[:, None]
    middle = 1j * fit.pole.imag[:, None]
    straight = np.exp(-turn * glide.phase_advance_s(bands.time)) * bands.gain(middle)
    return straight / bands.gain(middle + turn * glide.relative_deviation(bands.time))
