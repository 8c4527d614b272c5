"""Poles of damped exponentials: a subspace estimate, refined by variable projection.

ESPRIT (Roy and Kailath 1989) finds poles without starting values. The signal subspace of a Hankel matrix is shift
invariant, and the eigenvalues of that shift are the poles. It resolves components that a Fourier transform of that
length cannot.

Several signals can share their poles, each with its own amplitudes. The subspace is then that of the sum of their
Hankel covariances. The refinement projects the amplitudes out (Golub and Pereyra 1973, with Kaufman's Jacobian) and
minimises the residual of all signals by Levenberg-Marquardt steps. All that a step needs are sums over time of products
of two exponentials or of an exponential and a signal, so the sums of all signals are one matrix product.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .damped_sums import powers

# Samples of a signal that the subspace and the refinement use. A few poles gain nothing from more.
SAMPLES_USED = 240
# Samples of a signal per column of its Hankel matrix. The error of poles is least between one third and two thirds of
# the samples as columns (Hua and Sarkar 1990), and one third is cheapest.
SAMPLES_A_COLUMN = 3
# Singular values of the exponentials below this share of the largest cannot be resolved in a signal.
RANK = 3e-3
# The same threshold where only the direction of a step depends on it.
STEP_RANK = 1e-6
# Added to the diagonal of the sums of a signal, which are about 1. Equal poles would make them exactly singular.
RIDGE = 1e-20


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
    """Poles, 1/s [..., modes], of the signal subspaces [..., rows, modes] of Hankel matrices with this step, s.

    The columns of a subspace are orthonormal. Without their last row r they have the products 1 - r̄ rᵀ, whose inverse
    is known (Sherman and Morrison 1950).
    """
    last = subspace[..., -1:, :].conj().swapaxes(-1, -2)  # r̄ as a column
    shift = subspace[..., :-1, :].conj().swapaxes(-1, -2) @ subspace[..., 1:, :]
    row = last.conj().swapaxes(-1, -2)
    shift = shift + last @ (row @ shift) / (1 - row @ last)
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
    # In rows of `2 columns`, an entry and the next one along its diagonal are `2 columns + 1` apart.
    entries = np.zeros((columns, 2 * columns + 1), complex)
    square = entries.reshape(-1)[: 2 * columns * columns].reshape(columns, 2 * columns)[:, :columns]
    square[0], square[:, 0], square[1:, 1:] = first_row.conj(), first_row, increment
    np.cumsum(entries, axis=0, out=entries)
    return square


def _summed_products(weight: np.ndarray, shape: NDArray[np.complex128]) -> NDArray[np.complex128]:
    """Σ_t w v̄_i v_j [..., signals, modes, modes] of weights w [signals, samples] and v [..., modes, samples]."""
    *batch, modes, samples = shape.shape
    flat = (shape.conj()[..., :, None, :] * shape[..., None, :, :]).reshape(*batch, modes * modes, samples)
    parts = weight @ np.concatenate([flat.real, flat.imag], axis=-2).swapaxes(-1, -2)
    return (parts[..., : modes**2] + 1j * parts[..., modes**2 :]).reshape(*batch, len(weight), modes, modes)


def _inverse(gram: np.ndarray, rank: float) -> NDArray[np.complex128]:
    """Pseudo-inverse of VᴴV [..., modes, modes], for singular values of V above `rank` times the largest."""
    value, vector = np.linalg.eigh(gram)
    resolved = value > rank**2 * value[..., -1:]
    scaled = vector * np.where(resolved, 1 / np.where(resolved, value, 1.0), 0.0)[..., None, :]
    return scaled @ vector.conj().swapaxes(-1, -2)


def fit_amplitudes(pole: np.ndarray, signals: Signals) -> np.ndarray:
    """Amplitudes in every signal at its first sample, by weighted least squares [..., signals, modes].

    Parameters
    ----------
    pole : one set of poles, or several, 1/s [..., modes].
    """
    shape = powers(pole * signals.step, signals.values.shape[-1])
    scale = np.linalg.norm(shape, axis=-1)
    shape = shape / scale[..., None]
    power = signals.weight**2
    projected = (signals.values * power) @ shape.conj().swapaxes(-1, -2)
    inverse = _inverse(_summed_products(power, shape), RANK)
    return (inverse @ projected[..., None])[..., 0] / scale[..., None, :]


class _Sums:
    """Sums over time of weighted signals, and what they say about poles.

    The basis is orthonormal under the mean weight of the signals, because exponentials of close poles are almost
    parallel. Sums of their own products would lose half of the digits.
    """

    def __init__(self, signals: Signals) -> None:
        time, power = signals.time, signals.weight**2 / signals.length[:, None]
        self.step = signals.step
        self.mean = np.sqrt(power.mean(axis=0))
        relative = power / np.where(self.mean > 0, self.mean, 1.0) ** 2
        self.moments = np.concatenate([relative, relative * time, relative * time**2])  # [3 times signals, samples]
        weighted = signals.values * relative * self.mean
        self.weighted = np.concatenate([weighted, weighted * time])  # [2 times signals, samples]
        self.energy = float(np.vdot(signals.values, signals.values * power).real)

    def at(self, pole: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
        """Cost, Jᴴr [modes] and JᴴJ [modes, modes] of the residual r and Kaufman's Jacobian J of -r by the poles.

        With V the exponentials in a signal, a their amplitudes and t the time, J = (1 - V V⁺) t V diag(a).
        """
        shape = powers(pole * self.step, len(self.mean)) * self.mean
        value, vector = np.linalg.eigh(shape.conj() @ shape.T)
        root = np.sqrt(np.maximum(value, STEP_RANK**2 * value[-1]))
        to_basis, from_basis = vector / root, (vector * root).conj().T  # V = basis @ from_basis
        basis = np.asarray(to_basis.T @ shape, complex)
        modes = len(pole)
        gram, first, second = _summed_products(self.moments, basis).reshape(3, -1, modes, modes)
        b0, b1 = (self.weighted @ basis.conj().T).reshape(2, -1, modes)
        gram = gram + RIDGE * np.eye(modes)
        solved = np.linalg.solve(gram, np.concatenate([b0[..., None], first], axis=-1))
        own, amplitude = solved[..., 0], solved[..., 0] @ to_basis.T
        cost = self.energy - float(np.vdot(b0, own).real)
        slope = (b1 - (first @ own[..., None])[..., 0]) @ from_basis.conj()
        gradient = np.sum(amplitude.conj() * slope, axis=0)
        curvature = from_basis.conj().T @ (second - first @ solved[..., 1:]) @ from_basis
        return cost, gradient, np.einsum("si,sj,sij->ij", amplitude.conj(), amplitude, curvature)


def refine_poles(pole: np.ndarray, signals: Signals, box: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    """Poles within `box` that minimise the residual of all signals.

    The weight of a signal does not depend on its length.
    """
    sums, damping = _Sums(signals.decimated()), 1e-3
    cost, gradient, curvature = sums.at(pole)
    for _ in range(12):
        damped = curvature + damping * np.diag(np.real(np.diag(curvature)) + 1e-12)
        trial = box(pole + np.linalg.solve(damped, gradient))
        trial_cost, *trial_terms = sums.at(trial)
        if trial_cost < cost:
            converged = cost - trial_cost < 1e-4 * cost
            pole, cost, (gradient, curvature) = trial, trial_cost, trial_terms
            damping /= 5
            if converged:
                break
        else:
            damping *= 8
            if damping > 1e6:
                break
    return pole


def _residual_and_jacobian(pole: np.ndarray, signals: Signals) -> tuple[np.ndarray, np.ndarray]:
    """Residual r [all samples] and Kaufman's Jacobian of -r with respect to the poles [all samples, modes]."""
    time = signals.time
    v = np.exp(np.outer(time, pole)) * signals.weight[..., None]
    q, triangle = np.linalg.qr(v)
    adjoint, inverse = q.conj().swapaxes(-1, -2), np.linalg.pinv(triangle, rcond=STEP_RANK)
    y = (signals.values * signals.weight)[..., None]
    projected = adjoint @ y
    derivative = time[:, None] * v * (inverse @ projected).swapaxes(-1, -2)
    normalisation = 1 / np.sqrt(signals.length)[:, None, None]
    residual = ((y - q @ projected) * normalisation).ravel()
    return residual, ((derivative - q @ (adjoint @ derivative)) * normalisation).reshape(-1, len(pole))


def standard_errors(pole: np.ndarray, signals: Signals, correlated: float) -> np.ndarray:
    """Standard errors of real and imaginary part of the poles, 1/s [modes], from the residual (Huber's sandwich).

    Parameters
    ----------
    correlated : samples per independent sample. It exceeds 1 because the band is narrower than the frame rate.
    """
    residual, jacobian = _residual_and_jacobian(pole, signals)
    inverse = np.linalg.pinv(jacobian.conj().T @ jacobian, rcond=1e-10)
    meat = (jacobian.conj().T * np.abs(residual) ** 2) @ jacobian
    return np.sqrt(np.maximum(np.diag(inverse @ meat @ inverse).real * correlated / 2, 0.0))
