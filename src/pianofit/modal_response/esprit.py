"""Damped modes common to several signals: a subspace estimate, refined by variable projection.

All signals share poles and have amplitudes of their own. A start is ESPRIT (Roy and Kailath 1989) on the sum of the
signals' Hankel covariances; the refinement minimises what the poles leave of every signal, amplitudes projected out
(Golub and Pereyra 1973, with Kaufman's Jacobian), by Levenberg and Marquardt's steps.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from scipy.linalg import eigh

__all__ = ["Signals", "amplitudes", "poles_by_subspace", "refined", "standard_errors"]

# Samples of a signal that the subspace and the refinement look at: more cost time and say nothing new of a few poles.
LOOKED_AT = 240
# Of a signal's samples a Hankel matrix has one in so many as columns: poles err least between one and two thirds (Hua
# and Sarkar 1990), and one costs least.
SAMPLES_A_COLUMN = 3
# But so many columns at the least.
LEAST_COLUMNS = 6
# Steps of the refinement at the most; it ends where one gains less than this share of the cost.
STEPS = 12
ENOUGH = 1e-4
# Levenberg and Marquardt's damping: at first, and where no step is left.
DAMPING = 1e-3
LAST_DAMPING = 1e6
# Singular values of the exponentials below this share of the largest are not told apart by a signal.
RANK = 3e-3
# The same where only the direction of a step depends on it.
STEP_RANK = 1e-6


class Signals(NamedTuple):
    """Complex signals at one step, each beginning at time 0."""

    values: np.ndarray  # complex [signals, samples]
    weight: np.ndarray  # over a deviation of 1; from a signal's end on 0 [signals, samples]
    step: float  # s

    def thinned(self) -> Signals:
        """About `LOOKED_AT` samples of the longest."""
        by = max(1, self.values.shape[-1] // LOOKED_AT)
        return Signals(self.values[:, ::by], self.weight[:, ::by], self.step * by)

    @property
    def time(self) -> np.ndarray:
        """Of the samples, s."""
        return self.step * np.arange(self.values.shape[-1])

    @property
    def length(self) -> np.ndarray:
        """How many samples each signal has [signals]."""
        return (self.weight > 0).sum(axis=-1)


def poles_by_subspace(signals: Signals, scale: np.ndarray, orders: Sequence[int], lift: float) -> dict[int, np.ndarray]:
    """Poles, 1/s, for every order that the signals are long enough for.

    Parameters
    ----------
    scale : of each signal [signals]; its covariance is divided by the square.
    lift : 1/s; signals are multiplied by exp(lift t), so that what decays slowly counts late as well.
    """
    thin = signals.thinned()
    columns = max(LEAST_COLUMNS, thin.values.shape[-1] // SAMPLES_A_COLUMN)
    lifted = thin.values * np.exp(lift * thin.time) / scale[:, None]
    cut = [z[:size] for z, size in zip(lifted, thin.length, strict=True) if size > columns + 2]
    most = min(max(orders), columns - 3)
    if not cut or most < 1:
        return {}
    basis = eigh(_hankel_covariance(cut, columns), subset_by_index=[columns - most, columns - 1])[1]
    found = {}
    for order in orders:
        if order <= most:
            u = basis[:, -order:]
            turn = np.linalg.eigvals(np.linalg.pinv(u[:-1]) @ u[1:])
            found[order] = np.log(turn) / thin.step - lift
    return found


def _hankel_covariance(signals: Sequence[np.ndarray], columns: int) -> np.ndarray:
    """Σ_n z[n + i] z*[n + j] over all whole windows of all signals [columns, columns].

    Along a diagonal an entry differs from the last by the window's last product more and its first less.
    """
    last = [len(z) - columns + 1 for z in signals]
    first_row = np.sum([np.correlate(z, z[:rows], "valid") for z, rows in zip(signals, last, strict=True)], axis=0)
    ends = np.stack([z[rows : rows + columns - 1] for z, rows in zip(signals, last, strict=True)])
    begins = np.stack([z[: columns - 1] for z in signals])
    more = ends.T @ ends.conj() - begins.T @ begins.conj()
    covariance = np.empty((columns, columns), complex)
    covariance[0], covariance[:, 0] = first_row.conj(), first_row
    for i in range(columns - 1):
        covariance[i + 1, 1:] = covariance[i, :-1] + more[i]
    return covariance


def _inverse(v: np.ndarray, rank: float) -> tuple[np.ndarray, np.ndarray]:
    """Orthonormal columns of v, and the pseudo-inverse of the triangle beside them."""
    q, r = np.linalg.qr(v)
    return q, np.linalg.pinv(r, rcond=rank)


def _adjoint(q: np.ndarray) -> np.ndarray:
    return q.conj().swapaxes(-1, -2)


def amplitudes(pole: np.ndarray, signals: Signals) -> np.ndarray:
    """Of every signal, at its begin, by weighted least squares [signals, modes]."""
    v = np.exp(np.outer(signals.time, pole))
    scale = np.linalg.norm(v, axis=0)
    q, inverse = _inverse(signals.weight[..., None] * (v / scale), RANK)
    return (inverse @ (_adjoint(q) @ (signals.values * signals.weight)[..., None]))[..., 0] / scale


def _projected(pole: np.ndarray, signals: Signals) -> tuple[float, np.ndarray, np.ndarray]:
    """Cost, residual [all samples] and Kaufman's Jacobian of its negative by the poles [all samples, modes]."""
    time = signals.time
    v = np.exp(np.outer(time, pole)) * signals.weight[..., None]
    q, inverse = _inverse(v, STEP_RANK)
    y = (signals.values * signals.weight)[..., None]
    along = _adjoint(q) @ y
    moved = time[:, None] * v * (inverse @ along).swapaxes(-1, -2)
    each = 1 / np.sqrt(signals.length)[:, None, None]
    residual = ((y - q @ along) * each).ravel()
    jacobian = ((moved - q @ (_adjoint(q) @ moved)) * each).reshape(-1, len(pole))
    return float(np.vdot(residual, residual).real), residual, jacobian


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
