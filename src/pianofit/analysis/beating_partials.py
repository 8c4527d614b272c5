"""Partials that beat: two or three damped exponentials where one is not sufficient.

Coupled strings and the two polarisations of a string split a partial into components a few hertz or less apart. ESPRIT
(`dsp/common_poles.py`) finds their poles. The smallest number of components that describes the first second is used.
All partials are computed at once.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..dsp.bands import Bands
from ..dsp.common_poles import shift_poles
from .baseband_fit import FittedBands

_SPAN = 1.0  # s of sound that the components must describe
_FASTEST = 80.0  # 1/s, upper bound of decay rates


class Components(NamedTuple):
    """Summary of the components of each partial; [partials]."""

    frequency: np.ndarray  # Hz, of the component with most energy
    valid: np.ndarray  # bool: up to three components describe the partial


def resolve_components(fitted: FittedBands, wanted: np.ndarray) -> Components:
    """Resolve the `wanted` partials (bool [partials]) into one to three components."""
    result = Components(fitted.bands.centre.copy(), np.zeros(len(wanted), bool))
    if wanted.any():
        for column, resolved in zip(result, _resolve(fitted.select(wanted)), strict=True):
            column[wanted] = resolved
    return result


def _resolve(fitted: FittedBands) -> Components:
    bands, frame = fitted.bands, fitted.frame_noise
    frames = bands.frames_within(0.0, bands.time[0] + _SPAN)
    series, time = fitted.z[:, frames], bands.time[frames]
    power = np.mean(np.abs(series) ** 2, axis=1)
    vectors, step = _subspace(series, time)
    best: list[np.ndarray] = []
    for terms in (1, 2, 3):
        pole = shift_poles(vectors[:, :, -terms:], step)
        pole = np.clip(pole.real, -_FASTEST - 1, 8.0) + 1j * pole.imag
        amplitude, misfit = _amplitudes(series, time, pole)
        trial = _summary(bands, amplitude, pole, misfit)
        if not best:
            best = trial
            continue
        wanted = (best[1] > np.maximum(2 * frame, 1e-3 * power)) & (misfit < 0.7 * best[1]) & trial[2]
        best = [np.where(wanted, new, old) for new, old in zip(trial, best, strict=True)]
    described = best[1] < np.maximum(2 * frame, 0.05 * power)
    return Components(best[0], best[2].astype(bool) & described)


def _subspace(series: np.ndarray, time: np.ndarray) -> tuple[np.ndarray, float]:
    """Eigenvectors of the Hankel matrices' covariances [partials, rows, rows], and the step between samples, s."""
    stride = max(1, series.shape[1] // 90)
    thin = series[:, ::stride]
    rows = max(4, min(30, thin.shape[1] // 3))  # variance is least with a third of the samples
    hankel = np.lib.stride_tricks.sliding_window_view(thin, min(rows, thin.shape[1] - 1), axis=1)
    vectors = np.linalg.eigh(hankel.transpose(0, 2, 1) @ hankel.conj())[1]
    return vectors, float(time[1] - time[0]) * stride


def _amplitudes(
    series: np.ndarray, time: np.ndarray, pole: NDArray[np.complex128]
) -> tuple[NDArray[np.complex128], np.ndarray]:
    """Least-squares amplitudes at the onset [partials, terms], and mean |residual|² [partials]."""
    basis = np.exp(pole[:, None, :] * (time - time[0])[None, :, None])
    amplitude = np.linalg.pinv(basis, rcond=1e-8) @ series[:, :, None]
    residual = series - (basis @ amplitude)[:, :, 0]
    return amplitude[:, :, 0] * np.exp(-pole * time[0]), np.mean(np.abs(residual) ** 2, axis=1)


def _summary(
    bands: Bands, amplitude: NDArray[np.complex128], pole: NDArray[np.complex128], misfit: np.ndarray
) -> list[np.ndarray]:
    """Frequency, misfit and validity of amplitudes at the onset and poles in the band; [partials] each."""
    c = 2 * amplitude / bands.gain(pole)
    decay = np.maximum(-pole.real, 0.05)
    energy = np.abs(c) ** 2 * -np.expm1(-2 * decay * _SPAN) / (2 * decay)
    strongest = np.argmax(energy, axis=1)[:, None]
    offset = np.take_along_axis(pole.imag, strongest, 1)[:, 0] / (2 * np.pi)
    inside = (np.abs(pole.imag) < 0.35 * 2 * np.pi * bands.spacing) & (pole.real > -_FASTEST)
    valid = np.all(inside | (energy < 1e-4 * np.sum(energy, axis=1, keepdims=True)), axis=1)
    return [bands.centre + offset, misfit, valid]
