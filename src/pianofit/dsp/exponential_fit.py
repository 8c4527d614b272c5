"""One damped exponential per signal, by least squares.

For `z(t) = a exp(st)` in white circular noise the least-squares solution is the maximum-likelihood one. It reaches the
Cramér–Rao bound. The model is analytic in a and s, so Gauss–Newton runs in complex numbers. With a eliminated
(variable projection, Golub and Pereyra 1973) a step is one quotient. All signals are stepped at once.
`dsp/common_poles.py` fits several exponentials to signals that share them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .damped_sums import powers


@dataclass(frozen=True)
class Exponentials:
    """One least-squares exponential per row; [rows]."""

    amplitude: NDArray[np.complex128]  # complex, at the origin
    pole: NDArray[np.complex128]  # complex, 1/s
    misfit: np.ndarray  # mean |residual|²
    power: np.ndarray  # mean |z|²
    origin: float  # time of the first sample, s

    def select(self, keep: np.ndarray) -> Exponentials:
        """The rows selected by `keep`, bool [rows]."""
        return Exponentials(self.amplitude[keep], self.pole[keep], self.misfit[keep], self.power[keep], self.origin)

    def __call__(self, t: np.ndarray) -> np.ndarray:
        """The exponentials at evenly spaced times `t` (s) [rows, samples]."""
        first = self.amplitude * np.exp(self.pole * (t[0] - self.origin))
        return first[:, None] * powers(self.pole * (t[1] - t[0]), len(t))

    def at_onset(self) -> np.ndarray:
        """Amplitudes extrapolated to t = 0, complex [rows]; by a factor of at most exp(50)."""
        back = -self.pole * self.origin
        return self.amplitude * np.exp(np.minimum(back.real, 50.0) + 1j * back.imag)


def autocorrelation_poles(z: NDArray[np.complex128], t: np.ndarray, lag: float) -> NDArray[np.complex128]:
    """Poles (1/s) [rows] from the ratio of the autocorrelation at `lag` and at twice that (s).

    Noise with a correlation time below `lag` does not bias them.
    """
    step = float(t[1] - t[0])
    d = int(np.clip(round(lag / step), 1, max(1, (len(t) - 1) // 3)))
    first, second = np.vecdot(z[:, :-d], z[:, d:]), np.vecdot(z[:, : -2 * d], z[:, 2 * d :])
    silent = first == 0
    ratio = np.where(silent, 1, second) / np.where(silent, 1, first)
    return np.asarray(np.log(ratio) / (d * step), complex)


def fit_exponentials(
    z: NDArray[np.complex128], t: np.ndarray, start: NDArray[np.complex128], *, steps: int = 12, reach: float = np.inf
) -> Exponentials:
    """Least-squares exponential for each row of `z` [rows, samples] at evenly spaced `t` (s), from poles `start`.

    Neither the real nor the imaginary part of a pole moves more than `reach` (1/s) from its start. The step of a row
    is halved if it does not lower the misfit. Rows that have converged do not change.
    """
    tau, step = t - t[0], float(t[1] - t[0])
    span = max(float(tau[-1]), 1e-9)
    lowest, highest = -(60 / span + 400), 5 / span
    moments = tau[:, None] ** np.arange(3)

    def limited(pole: NDArray[np.complex128]) -> NDArray[np.complex128]:
        change = pole - start
        near = start + np.clip(change.real, -reach, reach) + 1j * np.clip(change.imag, -reach, reach)
        return np.clip(near.real, lowest, highest) + 1j * near.imag

    pole, factor = limited(start), np.ones(len(z))
    amplitude, update, cost = np.zeros(len(z), complex), np.zeros(len(z), complex), np.full(len(z), np.inf)
    for _ in range(steps + 1):
        trial = limited(np.asarray(pole + factor * update, complex))
        wave = powers(trial * step, len(t))
        s0, s1, s2 = ((np.square(wave.real) + np.square(wave.imag)) @ moments).T
        own = np.vecdot(wave, z) / s0
        residual = z - own[:, None] * wave
        misfit = np.vecdot(residual, residual).real
        slope = np.vecdot(wave, residual * tau) / (s2 - s1**2 / s0)
        newton = np.where(own == 0, 0, slope / np.where(own == 0, 1, own))
        better = misfit <= cost
        pole, amplitude, cost, update = (
            np.where(better, new, old)
            for new, old in ((trial, pole), (own, amplitude), (misfit, cost), (newton, update))
        )
        factor = np.where(better, 1.0, factor / 2)
        if np.max(np.abs(update)) < 1e-10 / span:
            break
    return Exponentials(amplitude, pole, cost / z.shape[1], np.mean(z.real**2 + z.imag**2, axis=1), t[0])
