"""How much higher one layer of a key sounds than another, and one partial of it: by the coherence of their phases."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from .aligned_layers import AlignedLayers
from .bands import band, kernel_seconds

__all__ = ["track_offsets", "relative_pitches"]

# Partials that tell a layer's pitch; those that cohere no better than this have hardly a say.
TUNED = 16
HALF_COHERENT = 0.5
# How far from the last layer's it is looked for, relative: five cents; and a partial from its place by that, Hz and
# relative: a third of a cent, for a string has more pitches than one.
DETUNED = 3e-3
ASTRAY = 0.03, 2e-4
# Steps to both sides of it, and where the phases are compared, s after the onset: past the attack, before the noise.
STEPS = 60
COMPARED = 0.08, 2.5
# A layer's partial is followed where its phase against the loudest layer's keeps this coherence.
COHERENT = 0.6


def relative_pitches(
    spectrum: np.ndarray, count: int, heard: AlignedLayers, partials: Sequence[tuple[int, float, float]]
) -> np.ndarray:
    """How much higher each layer sounds than the last, relative [layers]: the median of where its partials cohere.

    Each layer's own law will not do: its partials beat, and a layer's beats move its f0 by a cent.
    """
    offset, weight = [], []
    for _, frequency, spacing in partials[:TUNED]:
        b = band(spectrum, count, heard.rate, frequency, kernel_seconds(spacing))
        away, coherence = _offsets(b.values, b.time, np.zeros(len(b.values)), DETUNED * frequency)
        offset.append(away / frequency)
        weight.append(np.where(coherence > HALF_COHERENT, coherence**2, 1e-9))
    pitch = np.zeros(len(heard.samples))
    for i, (x, w) in enumerate(zip(np.array(offset).T, np.array(weight).T, strict=True)):
        order = np.argsort(x)
        total = np.cumsum(w[order])
        pitch[i] = x[order][np.searchsorted(total, total[-1] / 2)]
    return pitch


def track_offsets(z: np.ndarray, time: np.ndarray, frequency: float, pitch: np.ndarray) -> np.ndarray:
    """How far a partial lies above the last layer's, Hz [layers]: as its phase says, or else the layers' pitch."""
    expected = frequency * pitch
    offset, coherence = _offsets(z, time, expected, ASTRAY[0] + ASTRAY[1] * frequency)
    return np.where(coherence > COHERENT, offset, expected)


def _offsets(z: np.ndarray, time: np.ndarray, expected: np.ndarray, reach: float) -> tuple[np.ndarray, np.ndarray]:
    """How far each layer's partial lies above the last layer's, Hz, within `reach`; and how coherent they are."""
    at = (time > COMPARED[0]) & (time < COMPARED[1])
    turn = z[..., at] * z[-1, :, at].T.conj() * np.exp(-2j * np.pi * expected[:, None, None] * time[at])
    turn = turn / np.sqrt(np.abs(turn) + 1e-30)
    tried = np.linspace(-1, 1, 2 * STEPS + 1) * reach
    sums = np.abs(turn @ np.exp(-2j * np.pi * np.outer(time[at], tried))).sum(axis=1)
    best = np.argmax(sums, axis=1)
    return expected + tried[best], sums.max(axis=1) / np.maximum(np.abs(turn).sum(axis=(1, 2)), 1e-30)
