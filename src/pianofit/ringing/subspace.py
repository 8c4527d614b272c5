"""Damped modes common to several signals: a subspace estimate, refined by variable projection.

All signals share poles and have amplitudes of their own. A start is ESPRIT (Roy and Kailath 1989) on the sum of the
signals' Hankel covariances; the refinement minimises what the poles leave of every signal, amplitudes projected out
(Golub and Pereyra 1973, with Kaufman's Jacobian), by Levenberg and Marquardt's steps.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

__all__ = ["Signals", "amplitudes", "poles_by_subspace", "refined", "standard_errors"]

# Samples of a signal that the subspace and the refinement look at: more cost time and say nothing new of a few poles.
LOOKED_AT = 240
# Least columns of a Hankel matrix.
LEAST_COLUMNS = 6
# Steps of the refinement at the most; it ends where one gains less than this share of the cost.
STEPS = 12
ENOUGH = 1e-4
# Levenberg and Marquardt's damping: at first, and where no step is left.
DAMPING = 1e-3
LAST_DAMPING = 1e6
# Singular values of the exponentials below this share of the largest are not told apart by a signal.
RANK = 3e-3


class Signals(NamedTuple):
    """Complex signals at one step, each beginning at time 0."""

    values: Sequence[np.ndarray]  # complex [samples of each]
    size: Sequence[np.ndarray]  # what is a deviation of 1 in each [samples of each]
    step: float  # s

    def thinned(self) -> Signals:
        """About `LOOKED_AT` samples of the longest."""
        by = max(1, max(map(len, self.values)) // LOOKED_AT)
        return Signals([z[::by] for z in self.values], [s[::by] for s in self.size], self.step * by)

    def times(self, which: int) -> np.ndarray:
        """Of one signal's samples, s."""
        return self.step * np.arange(len(self.values[which]))


def poles_by_subspace(
    signals: Signals, scale: Sequence[float], orders: Sequence[int], lift: float
) -> dict[int, np.ndarray]:
    """Poles, 1/s, for every order that the signals are long enough for.

    Parameters
    ----------
    scale : of each signal; its covariance is divided by the square.
    lift : 1/s; signals are multiplied by exp(lift t), so that what decays slowly counts late as well.
    """
    thin = signals.thinned()
    columns = max(LEAST_COLUMNS, max(map(len, thin.values)) // 2)
    covariance = np.zeros((columns, columns), complex)
    for i, (z, w) in enumerate(zip(thin.values, scale, strict=True)):
        if len(z) > columns + 2:
            lifted = z * np.exp(lift * thin.times(i)) / w
            rows = np.lib.stride_tricks.sliding_window_view(lifted, columns)
            covariance += rows.T @ rows.conj()
    if not covariance.any():
        return {}
    basis = np.linalg.eigh(covariance)[1]
    found = {}
    for order in orders:
        if order + 2 < columns:
            u = basis[:, -order:]
            turn = np.linalg.eigvals(np.linalg.pinv(u[:-1]) @ u[1:])
            found[order] = np.log(turn) / thin.step - lift
    return found


def amplitudes(pole: np.ndarray, signals: Signals) -> np.ndarray:
    """Of every signal, at its begin, by weighted least squares [signals, modes]."""
    longest = np.exp(np.outer(signals.step * np.arange(max(map(len, signals.values))), pole))
    scale = np.linalg.norm(longest, axis=0)
    return np.stack([
        np.linalg.lstsq(longest[: len(z)] / scale / s[:, None], z / s, rcond=RANK)[0] / scale
        for z, s in zip(signals.values, signals.size, strict=True)
    ])  # fmt: skip


def _projected(pole: np.ndarray, signals: Signals) -> tuple[float, np.ndarray, np.ndarray]:
    """Cost, residual [all samples] and Kaufman's Jacobian of its negative by the poles [all samples, modes]."""
    residuals, jacobians = [], []
    for i, (z, s) in enumerate(zip(signals.values, signals.size, strict=True)):
        t = signals.times(i)
        v = np.exp(np.outer(t, pole)) / s[:, None]
        q, r = np.linalg.qr(v)
        y, each = z / s, 1 / np.sqrt(len(z))
        along = q.conj().T @ y
        a = np.linalg.lstsq(r, along, rcond=1e-6)[0]
        moved = t[:, None] * v * a
        residuals.append((y - q @ along) * each)
        jacobians.append((moved - q @ (q.conj().T @ moved)) * each)
    residual = np.concatenate(residuals)
    return float(np.vdot(residual, residual).real), residual, np.concatenate(jacobians)


def refined(pole: np.ndarray, signals: Signals, box: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    """The poles, kept in `box`, that leave least of all signals, each signal with one weight however long."""
    thin, damping = signals.thinned(), DAMPING
    cost, residual, jacobian = _projected(pole, thin)
    for _ in range(STEPS):
        curvature = jacobian.conj().T @ jacobian
        damped = curvature + damping * np.diag(np.real(np.diag(curvature)) + 1e-12)
        tried = box(pole + np.linalg.solve(damped, jacobian.conj().T @ residual))
        there = _projected(tried, thin)
        if there[0] < cost:
            done = cost - there[0] < ENOUGH * cost
            pole, damping, (cost, residual, jacobian) = tried, damping / 5, there
            if done:
                break
        else:
            damping *= 8
            if damping > LAST_DAMPING:
                break
    return pole


def standard_errors(pole: np.ndarray, signals: Signals, correlated: float) -> np.ndarray:
    """Of the poles, 1/s [modes], each of real and imaginary part, from what they leave (Huber's sandwich).

    Parameters
    ----------
    correlated : neighbouring samples that say the same, because the signals' band is narrower than their rate.
    """
    _, residual, jacobian = _projected(pole, signals)
    inverse = np.linalg.pinv(jacobian.conj().T @ jacobian, rcond=1e-10)
    meat = (jacobian.conj().T * np.abs(residual) ** 2) @ jacobian
    return np.sqrt(np.maximum(np.diag(inverse @ meat @ inverse).real * correlated / 2, 0.0))
