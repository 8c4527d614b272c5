"""Relative pitch of the layers of a key, and of single partials, from the coherence of their phases."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from .aligned_layers import AlignedLayers
from .bands import band, kernel_seconds

__all__ = ["track_offsets", "relative_pitches"]

# Number of lowest partials that determine a layer's pitch. Partials below this coherence have almost no weight.
PITCH_PARTIALS = 16
LEAST_PITCH_COHERENCE = 0.5
# Largest relative detuning of a layer from the last layer that is searched: five cents.
LARGEST_DETUNING = 3e-3
# Largest deviation of a partial from its layer's pitch: a constant, Hz, and a relative part of a third of a cent. A
# real string does not have one pitch for all partials.
LARGEST_DEVIATION = 0.03, 2e-4
# Number of search steps on either side.
STEPS = 60
# Phases are compared between these times after the onset, s: past the attack and above the noise.
COMPARED = 0.08, 2.5
# The offset of a partial is measured only if its phase relative to the loudest layer has this coherence.
LEAST_COHERENCE = 0.6


def relative_pitches(
    spectrum: np.ndarray, count: int, layers: AlignedLayers, partials: Sequence[tuple[int, float, float]]
) -> np.ndarray:
    """Relative detuning of each layer from the last [layers]: the weighted median over its partials.

    The f0 of each layer's analysis is not used. Partials beat, which changes the f0 of a layer by a cent.
    """
    offset, weight = [], []
    for _, frequency, spacing in partials[:PITCH_PARTIALS]:
        b = band(spectrum, count, layers.rate, frequency, kernel_seconds(spacing))
        detuning, coherence = _offsets(b.values, b.time, np.zeros(len(b.values)), LARGEST_DETUNING * frequency)
        offset.append(detuning / frequency)
        weight.append(np.where(coherence > LEAST_PITCH_COHERENCE, coherence**2, 1e-9))
    pitch = np.zeros(len(layers.samples))
    for i, (x, w) in enumerate(zip(np.array(offset).T, np.array(weight).T, strict=True)):
        order = np.argsort(x)
        total = np.cumsum(w[order])
        pitch[i] = x[order][np.searchsorted(total, total[-1] / 2)]
    return pitch


def track_offsets(z: np.ndarray, time: np.ndarray, frequency: float, pitch: np.ndarray) -> np.ndarray:
    """Frequency of a partial in each layer minus that in the last layer, Hz [layers].

    It is measured from the phase if that is coherent. Otherwise it follows from the layers' relative `pitch`.
    """
    expected = frequency * pitch
    offset, coherence = _offsets(z, time, expected, LARGEST_DEVIATION[0] + LARGEST_DEVIATION[1] * frequency)
    return np.where(coherence > LEAST_COHERENCE, offset, expected)


def _offsets(z: np.ndarray, time: np.ndarray, expected: np.ndarray, reach: float) -> tuple[np.ndarray, np.ndarray]:
    """Offset of each layer's partial from the last layer's, Hz, within `reach` of `expected`, and its coherence."""
    frames = (time > COMPARED[0]) & (time < COMPARED[1])
    turn = z[..., frames] * z[-1, :, frames].T.conj() * np.exp(-2j * np.pi * expected[:, None, None] * time[frames])
    turn = turn / np.sqrt(np.abs(turn) + 1e-30)
    trial = np.linspace(-1, 1, 2 * STEPS + 1) * reach
    sums = np.abs(turn @ np.exp(-2j * np.pi * np.outer(time[frames], trial))).sum(axis=1)
    best = np.argmax(sums, axis=1)
    return expected + trial[best], sums.max(axis=1) / np.maximum(np.abs(turn).sum(axis=(1, 2)), 1e-30)
