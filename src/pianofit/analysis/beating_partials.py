"""Partials that beat: two or three damped exponentials where one does not do.

Coupled strings, and the two polarisations of one, give a partial components a few hertz or less apart. ESPRIT (Roy and
Kailath 1989) finds their poles without starting values: the signal subspace of the baseband's Hankel matrix is shift
invariant, and the eigenvalues of that shift are the poles. It resolves what a Fourier transform of that length cannot.
All partials are treated at once; of one, two or three components the fewest that describe the first second are taken.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from .demodulation import Bands

__all__ = ["Components", "resolve"]

_SPAN = 1.0  # s of sound that the components have to describe
_ROWS = 30  # of the Hankel matrix; variance is least with a third of the samples
_SAMPLES = 90  # of the thinned series
_GOOD = 1e-3  # misfit over power at which more components are not needed
_FAIR = 0.05  # misfit over power beyond which even three say nothing
_FASTEST = 80.0  # 1/s


@dataclass(frozen=True)
class Components:
    """What the sum of components of each partial amounts to; [partials]."""

    frequency: np.ndarray  # Hz, of the component with most energy
    decay: np.ndarray  # 1/s, mean of the components' decay rates weighted by energy
    valid: np.ndarray  # bool: a sum of up to three components describes the partial


def resolve(bands: Bands, z: NDArray[np.complex128], frame: np.ndarray, wanted: np.ndarray) -> Components:
    """Resolve the rows of the basebands `z` that are `wanted`, bool [partials], into one to three components.

    Parameters
    ----------
    frame : [partials], noise variance of one frame
    """
    found = Components(bands.centre.copy(), np.zeros(len(z)), np.zeros(len(z), bool))
    if wanted.any():
        some = _resolve(bands.select(wanted), z[wanted], frame[wanted])
        for field in fields(found):
            getattr(found, field.name)[wanted] = getattr(some, field.name)
    return found


def _resolve(bands: Bands, z: NDArray[np.complex128], frame: np.ndarray) -> Components:
    cut = bands.cut(0.0, bands.time[0] + _SPAN)
    series, time = z[:, cut], bands.time[cut]
    power = np.mean(np.abs(series) ** 2, axis=1)
    vectors, step = _subspace(series, time)
    best: list[np.ndarray] = []
    for terms in (1, 2, 3):
        pole = _poles(vectors[:, :, -terms:], step)
        amplitude, misfit = _amplitudes(series, time, pole)
        fresh = _summary(bands, amplitude, pole, misfit)
        if not best:
            best = fresh
            continue
        wanted = (best[2] > np.maximum(2 * frame, _GOOD * power)) & (misfit < 0.7 * best[2]) & fresh[3]
        best = [np.where(wanted, new, old) for new, old in zip(fresh, best, strict=True)]
    described = best[2] < np.maximum(2 * frame, _FAIR * power)
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
    rest = series - (basis @ amplitude)[:, :, 0]
    return amplitude[:, :, 0] * np.exp(-pole * time[0]), np.mean(np.abs(rest) ** 2, axis=1)


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
