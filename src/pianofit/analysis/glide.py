"""Pitch against time: real strings fall by some cents as they decay, all partials alike.

A partial whose frequency moves is no exponential: fitted with one it seems to decay faster, the higher the more. So the
fall is read off the partials together, as g exp(-t/τ) cents, and taken out of each one's phase before it is fitted.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .baseband_fit import first_fits, has_drifted
from .demodulation import Bands
from .exponential_fit import Tones, fit_tones
from .inharmonicity import CENTS

__all__ = ["LEAST", "PitchGlide", "glide_detected", "glide_windows", "remove_glide"]

_WINDOWS = ((0.0, 0.35), (0.2, 1.0), (1.0, 2.0), (2.0, 4.0), (4.0, np.inf))  # s after the onset
_REFERENCE = 1  # of the windows: where f0 is defined
_ROUNDS = 8
_TAU = (0.05, 5.0)  # s, range of time constants of a fall
_USUAL_TAU = 0.5  # s, taken where one window alone tells of a fall
_SURE = 4.0  # standard errors by which pitch must change to be taken for a fall,
LEAST = 0.1  # and cents
_UNTOLD = 0.3  # share of a fall that is not known where one window alone tells of it, and so not its time constant
_WEIGHED = 0.01  # the same otherwise: the mean over a window depends by so much on how its moments are weighed
_LOUD = 30.0  # power a partial must have in a window, over the noise power of a frame


class PitchGlide(NamedTuple):
    """A pitch that falls as g exp(-t/τ); frequencies are means over 0.2 to 1.0 s."""

    start: float  # cents above these frequencies at the onset
    tau: float  # s

    def relative_deviation(self, t: np.ndarray) -> np.ndarray:
        """How much higher than its frequency a partial is at t, s after the onset, relative."""
        mean = float(_mean(_WINDOWS[_REFERENCE], np.array(self.tau)))
        return self.start / (1 - mean) / CENTS * (np.exp(-t / self.tau) - mean)

    def phase_advance_s(self, t: np.ndarray) -> np.ndarray:
        """Its integral, s: how far what sounds at t is ahead of a pitch that does not fall."""
        mean = float(_mean(_WINDOWS[_REFERENCE], np.array(self.tau)))
        return self.start / (1 - mean) / CENTS * (self.tau * (1 - np.exp(-t / self.tau)) - mean * t)


def glide_windows(
    bands: Bands, z: NDArray[np.complex128], fit: Tones, density: np.ndarray
) -> list[tuple[float, float, float, float]]:
    """Pitch of each window against that of 0.2 to 1.0 s: rows (start s, stop s, cents, standard error in cents).

    The median over partials of the change of frequency of each: a beating partial moves by its own amount, a glide
    moves all by the same.
    """
    frame = density / 2 * bands.noise_width
    end = float(bands.time[-1])
    shift, spans = [], []
    for start, stop in _WINDOWS:
        cut = bands.cut(start, stop - bands.window / 2 if start == 0 else stop, least=1)
        t = bands.time[cut]
        if len(t) < 6 or (start > 0 and end < start + 0.5 * (min(stop, start + 1) - start)):
            shift.append(np.full(len(z), np.nan))
        else:
            local = fit_tones(z[:, cut], t, fit.pole, steps=6)
            moved = np.clip(local.pole.imag / (2 * np.pi * bands.centre), -0.1, 0.1)
            cents = CENTS * np.log1p(moved)
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
    """Whether in any of the windows the pitch is surely another than in that of frequencies."""
    return any(abs(cents) > max(_SURE * error, LEAST) for _, _, cents, error in windows)


def remove_glide(
    bands: Bands, z: NDArray[np.complex128], fit: Tones, density: np.ndarray,
    windows: list[tuple[float, float, float, float]],
) -> tuple[Bands, NDArray[np.complex128], Tones, PitchGlide, float]:  # fmt: skip
    """The bands with the fall of pitch taken out of their phases, and their first fits; the fall, and its error, cents.

    The mean over the window of frequencies stays. What is left is measured and taken out again, as long as that makes
    it smaller.

    Parameters
    ----------
    z, fit : as they are, cleaned and fitted
    windows : of `glide_windows`; those in which too few partials are heard to tell are left out
    """
    windows = [row for row in windows if np.isfinite(row[3])]
    spans = [row[:2] for row in windows]
    wanted = np.array([row[2] for row in windows])
    least, best, best_fits = float(np.abs(wanted).max()), bands, (z, fit)
    for _ in range(_ROUNDS):
        straight = replace(bands, z=bands.z * _unwound(bands, fit, _exponential(spans, wanted)))
        z, fit = first_fits(straight)
        left = {row[:2]: row[2] for row in glide_windows(straight, z, fit, density)}
        rest = np.array([left.get(span, 0.0) for span in spans])
        if np.abs(rest).max() >= least:
            break
        best, best_fits = straight, (z, fit)
        least, wanted = float(np.abs(rest).max()), wanted + rest
    fell = max(abs(row[2]) for row in windows)
    least = max(least, (_UNTOLD if len(windows) == 2 else _WEIGHED) * fell)
    return best, *best_fits, _exponential(spans, wanted), least


def _mean(span: tuple[float, float], tau: np.ndarray) -> np.ndarray:
    """Mean of exp(-t/τ) over a window."""
    start, stop = span
    return tau * (np.exp(-start / tau) - np.exp(-stop / tau)) / (stop - start)


def _exponential(spans: list[tuple[float, float]], cents: np.ndarray) -> PitchGlide:
    """The fall that moves the windows by `cents` against that of frequencies."""
    tau = np.geomspace(*_TAU, 1000)
    moved = np.stack([_mean(span, tau) - _mean(_WINDOWS[_REFERENCE], tau) for span in spans])
    size = (moved * cents[:, None]).sum(axis=0) / (moved**2).sum(axis=0)
    miss = ((cents[:, None] - size * moved) ** 2).sum(axis=0)
    # One window beside that of frequencies is met by any τ: then a usual one.
    best = int(np.argmin(miss + 1e-4 * np.log(tau / _USUAL_TAU) ** 2))
    return PitchGlide(float(size[best] * (1 - _mean(_WINDOWS[_REFERENCE], tau[best]))), float(tau[best]))


def _unwound(bands: Bands, fit: Tones, fall: PitchGlide) -> NDArray[np.complex128]:
    """Factors [partials, frames] that take back the fall g exp(-t/τ): its phase, and what the window made of it.

    The farther a partial is from the middle of its band, the less of it the window lets through.
    """
    turn = 2j * np.pi * bands.centre[:, None]
    middle = 1j * fit.pole.imag[:, None]
    straight = np.exp(-turn * fall.phase_advance_s(bands.time)) * bands.gain(middle)
    return straight / bands.gain(middle + turn * fall.relative_deviation(bands.time))
