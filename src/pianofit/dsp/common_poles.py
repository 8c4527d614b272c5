"""Poles of damped exponentials: a subspace estimate, refined by variable projection.

ESPRIT (Roy and Kailath 1989) finds poles without starting values. The signal subspace of a Hankel matrix is shift
invariant, and the eigenvalues of that shift are the poles. It resolves components that a Fourier transform of that
length cannot.

Several signals can share their poles, each with its own amplitudes. The subspace is then that of the sum of their
Hankel covariances. The refinement projects the amplitudes out (Golub and Pereyra 1973, with Kaufman's Jacobian) and
minimises the residual of all signals by Levenberg-Marquardt steps.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

# Samples of a signal that the subspace and the refinement use. A few poles gain nothing from more.
SAMPLES_USED = 240
# Samples of a signal per column of its Hankel matrix. The error of poles is least between one third and two thirds of
# the samples as columns (Hua and Sarkar 1990), and one third is cheapest.
SAMPLES_A_COLUMN = 3
# Singular values of the exponentials below this share of the largest cannot be resolved in a signal.
RANK = 3e-3
# The same threshold where only the direction of a step depends on it.
STEP_RANK = 1e-6


class Signals(NamedTuple):
    """Complex signals at one step, each beginning at time 0."""

    values: np.ndarray  # complex [signals, samples]
    weight: np.ndarray  # inverse standard deviation; 0 after the end of a signal [signals, samples]
    step: float  # s

    def decimated(self) -> Signals:
        """The same signals, decimated to about `SAMPLES_USED` samples."""
        factor = max(1, self.values.shape[-1] // SAMPLES_USED)
        return Signals(self.values[:, ::factor], self.weight[:, ::factor], self.step * factor)

    @property
    def time(self) -> np.ndarray:
        """Times of the samples, s."""
        return self.step * np.arange(self.values.shape[-1])

    @property
    def length(self) -> np.ndarray:
        """Number of samples of each signal [signals]."""
        return (self.weight > 0).sum(axis=-1)


def shift_poles(subspace: np.ndarray, step: float) -> NDArray[np.complex128]:
    """Poles, 1/s [..., modes], of the signal subspaces [..., rows, modes] of Hankel matrices with this step, s."""
    shift = np.linalg.pinv(subspace[..., :-1, :]) @ subspace[..., 1:, :]
    return np.asarray(np.log(np.linalg.eigvals(shift)) / step, complex)


def poles_by_subspace(signals: Signals, scale: np.ndarray, orders: Sequence[int], lift: float) -> dict[int, np.ndarray]:
    """Poles, 1/s, for every order that the lengths of the signals permit.

    Parameters
    ----------
    scale : scale of each signal [signals]. Its covariance is divided by the square.
    lift : 1/s. Signals are multiplied by exp(lift t), which raises the weight of slowly decaying modes.
    """
    from scipy.linalg import eigh

    thin = signals.decimated()
    columns = max(6, thin.values.shape[-1] // SAMPLES_A_COLUMN)
    lifted = thin.values * np.exp(lift * thin.time) / scale[:, None]
    usable = [z[:size] for z, size in zip(lifted, thin.length, strict=True) if size > columns + 2]
    highest = min(max(orders), columns - 3)
    if not usable or highest < 1:
        return {}
    basis = eigh(_hankel_covariance(usable, columns), subset_by_index=[columns - highest, columns - 1])[1]
    return {order: shift_poles(basis[:, -order:], thin.step) - lift for order in orders if order <= highest}


def _hankel_covariance(signals: Sequence[np.ndarray], columns: int) -> np.ndarray:
    """Σ_n z[n + i] z*[n + j] over all complete windows of all signals [columns, columns].

    The next entry along a diagonal gains the last product of the window and loses the first.
    """
    counts = [len(z) - columns + 1 for z in signals]
    first_row = np.sum([np.correlate(z, z[:rows], "valid") for z, rows in zip(signals, counts, strict=True)], axis=0)
    ends = np.stack([z[rows : rows + columns - 1] for z, rows in zip(signals, counts, strict=True)])
    begins = np.stack([z[: columns - 1] for z in signals])
    increment = ends.T @ ends.conj() - begins.T @ begins.conj()
    covariance = np.empty((columns, columns), complex)
    covariance[0], covariance[:, 0] = first_row.conj(), first_row
    for i in range(columns - 1):
        covariance[i + 1, 1:] = covariance[i, :-1] + increment[i]
    return covariance


def _inverse(v: np.ndarray, rank: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Orthonormal columns Q of v = Q R, its adjoint, and the pseudo-inverse of R."""
    q, r = np.linalg.qr(v)
    return q, q.conj().swapaxes(-1, -2), np.linalg.pinv(r, rcond=rank)


def fit_amplitudes(pole: np.ndarray, signals: Signals) -> np.ndarray:
    """Amplitudes in every signal at its first sample, by weighted least squares [signals, modes]."""
    v = np.exp(np.outer(signals.time, pole))
    scale = np.linalg.norm(v, axis=0)
    _, adjoint, inverse = _inverse(signals.weight[..., None] * (v / scale), RANK)
    return (inverse @ (adjoint @ (signals.values * signals.weight)[..., None]))[..., 0] / scale


def _residual_and_jacobian(pole: np.ndarray, signals: Signals) -> tuple[float, np.ndarray, np.ndarray]:
    """Cost, residual r [all samples] and Kaufman's Jacobian of -r with respect to the poles [all samples, modes]."""
    time = signals.time
    v = np.exp(np.outer(time, pole)) * signals.weight[..., None]
    q, adjoint, inverse = _inverse(v, STEP_RANK)
    y = (signals.values * signals.weight)[..., None]
    projected = adjoint @ y
    derivative = time[:, None] * v * (inverse @ projected).swapaxes(-1, -2)
    normalisation = 1 / np.sqrt(signals.length)[:, None, None]
    residual = ((y - q @ projected) * normalisation).ravel()
    jacobian = ((derivative - q @ (adjoint @ derivative)) * normalisation).reshape(-1, len(pole))
    return float(np.vdot(residual, residual).real), residual, jacobian


def refine_poles(pole: np.ndarray, signals: Signals, box: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    """Poles within `box` that minimise the residual of all signals.

    The weight of a signal does not depend on its length.
    """
    thin, damping = signals.decimated(), 1e-3
    cost, residual, jacobian = _residual_and_jacobian(pole, thin)
    for _ in range(12):
        curvature = jacobian.conj().T @ jacobian
        damped = curvature + damping * np.diag(np.real(np.diag(curvature)) + 1e-12)
        trial = box(pole + np.linalg.solve(damped, jacobian.conj().T @ residual))
        trial_cost, trial_residual, trial_jacobian = _residual_and_jacobian(trial, thin)
        if trial_cost < cost:
            converged = cost - trial_cost < 1e-4 * cost
            pole, cost, residual, jacobian = trial, trial_cost, trial_residual, trial_jacobian
            damping /= 5
            if converged:
                break
        else:
            damping *= 8
            if damping > 1e6:
                break
    return pole


def standard_errors(pole: np.ndarray, signals: Signals, correlated: float) -> np.ndarray:
    """Standard errors of real and imaginary part of the poles, 1/s [modes], from the residual (Huber's sandwich).

    Parameters
    ----------
    correlated : samples per independent sample. It exceeds 1 because the band is narrower than the frame rate.
    """
    _, residual, jacobian = _residual_and_jacobian(pole, signals)
    inverse = np.linalg.pinv(jacobian.conj().T @ jacobian, rcond=1e-10)
    meat = (jacobian.conj().T * np.abs(residual) ** 2) @ jacobian
    return np.sqrt(np.maximum(np.diag(inverse @ meat @ inverse).real * correlated / 2, 0.0))
