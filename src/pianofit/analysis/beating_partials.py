"""Partials that beat: two or three damped exponentials where one is not sufficient.

Coupled strings and the two polarisations of a string split a partial into components a few hertz or less apart. ESPRIT
(Roy and Kailath 1989) finds their poles without starting values: the signal subspace of the baseband's Hankel matrix is
shift invariant, and the eigenvalues of that shift are the poles. It resolves components that a Fourier transform of
that length cannot. The smallest number of components that describes the first second is used. All partials are computed
at once.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from .demodulation import Bands

__all__ = ["Components", "resolve_components"]

_SPAN = 1.0  # s of sound that the components must describe
_ROWS = 30  # of the Hankel matrix; variance is least with a third of the samples
_SAMPLES = 90  # of the thinned series
_SUFFICIENT = 1e-3  # misfit over power below which no component is added
_ACCEPTABLE = 0.05  # misfit over power above which the components are not used
_FASTEST = 80.0  # 1/s, upper bound of decay rates


@dataclass(frozen=True)
class Components:
    """Summary of the components of each partial; [partials]."""

    frequency: np.ndarray  # Hz, of the component with most energy
    decay: np.ndarray  # 1/s, mean of the components' decay rates weighted by energy
    valid: np.ndarray  # bool: up to three components describe the partial


def resolve_components(bands: Bands, z: NDArray[np.complex128], frame: np.ndarray, wanted: np.ndarray) -> Components:
    """Resolve the `wanted` rows (bool [partials]) of the basebands `z` into one to three components.

    Parameters
    ----------
    frame : noise variance of one frame [partials]
    """
    result = Components(bands.centre.copy(), np.zeros(len(z)), np.zeros(len(z), bool))
    if wanted.any():
        resolved = _resolve(bands.select(wanted), z[wanted], frame[wanted])
        for field in fields(result):
            getattr(result, field.name)[wanted] = getattr(resolved, field.name)
    return result


def _resolve(bands: Bands, z: NDArray[np.complex128], frame: np.ndarray) -> Components:
    frames = bands.frames_within(0.0, bands.time[0] + _SPAN)
    series, time = z[:, frames], bands.time[frames]
    power = np.mean(np.abs(series) ** 2, axis=1)
    vectors, step = _subspace(series, time)
    best: list[np.ndarray] = []
    for terms in (1, 2, 3):
        pole = _poles(vectors[:, :, -terms:], step)
        amplitude, misfit = _amplitudes(series, time, pole)
        trial = _summary(bands, amplitude, pole, misfit)
        if not best:
            best = trial
            continue
        wanted = (best[2] > np.maximum(2 * frame, _SUFFICIENT * power)) & (misfit < 0.7 * best[2]) & trial[3]
        best = [np.where(wanted, new, old) for new, old in zip(trial, best, strict=True)]
    described = best[2] < np.maximum(2 * frame, _ACCEPTABLE * power)
    return Components(best[0], best[1], valid=best[3].astype(bool) & described)


def _subspace(series: np.ndarray, time: np.ndarray) -> tuple[np.ndarray, float]:
    """Eigenvectors of the Hankel matrices' covariances [partials, rows, rows], and the step between samples, s."""
    stride = max(1, series.shape[1] // _SAMPLES)
    thin = series[:, ::stride]
    rows = max(4, min(_ROWS, thin.shape[1] // 3))
    hankel = np.lib.stride_tricks.sliding_window_view(thin, min(rows, thin.shape[1] - 1), axis=1)
    vectors = np.linalg.eigh(hankel.transpose(0, 2, 1) @ hankel.conj())[1]
    return vectors, float(time[1] - time[0]) * stride


def _poles(signal: np.ndarray, step: float) -> NDArray[np.complex128]:
    """Poles (1/s) [partials, terms] of signal subspaces [partials, rows, terms]."""
    low, high = signal[:, :-1], signal[:, 1:]
    shift = np.linalg.pinv(low) @ high
    pole = np.log(np.linalg.eigvals(shift)) / step
    return np.clip(pole.real, -_FASTEST - 1, 8.0) + 1j * pole.imag


def _amplitudes(
    series: np.ndarray, time: np.ndarray, pole: NDArray[np.complex128]
) -> tuple[NDArray[np.complex128], np.ndarray]:
    """Least-squares amplitudes at the first sample [partials, terms], and mean |residual|² [partials]."""
    basis = np.exp(pole[:, None, :] * (time - time[0])[None, :, None])
    amplitude = np.linalg.pinv(basis, rcond=1e-8) @ series[:, :, None]
    residual = series - (basis @ amplitude)[:, :, 0]
    return amplitude[:, :, 0] * np.exp(-pole * time[0]), np.mean(np.abs(residual) ** 2, axis=1)


def _summary(
    bands: Bands, amplitude: NDArray[np.complex128], pole: NDArray[np.complex128], misfit: np.ndarray
) -> list[np.ndarray]:
    """Frequency, decay, misfit and validity of amplitudes at the onset and poles in the band; [partials] each."""
    c = 2 * amplitude / bands.gain(pole)
    decay = np.maximum(-pole.real, 0.05)
    energy = np.abs(c) ** 2 * -np.expm1(-2 * decay * _SPAN) / (2 * decay)
    strongest = np.argmax(energy, axis=1)[:, None]
    offset = np.take_along_axis(pole.imag, strongest, 1)[:, 0] / (2 * np.pi)
    rate = np.sum(energy * -pole.real, axis=1) / np.sum(energy, axis=1)
    inside = (np.abs(pole.imag) < 0.35 * 2 * np.pi * bands.spacing) & (pole.real > -_FASTEST)
    valid = np.all(inside | (energy < 1e-4 * np.sum(energy, axis=1, keepdims=True)), axis=1)
    return [bands.centre + offset, rate, misfit, valid]
