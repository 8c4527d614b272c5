"""Synthetic notes that are let go: string modes of the literature with beats, a damper of known rates, and noise."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pianofit.analysis.note_names import midi_to_note
from pianofit.literature import typical
from pianofit.model.modes import mode_frequencies

RATE = 44_100
SECONDS = 4.0
NOISE_DB = -70.0  # rms over the peak


class Released(NamedTuple):
    """A note that is let go, and the truth."""

    note: str
    samples: np.ndarray
    release_s: float
    rate: float  # 1/s, at the first partial
    slope: float


def released(seed: int) -> Released:
    """Draw a key, its damper, the time of the release, and beats."""
    random = np.random.default_rng(seed)
    midi = int(random.integers(28, 85))
    it = typical(midi)
    frequency = mode_frequencies(it.string, it.geometry.length, 60)
    frequency = frequency[frequency < 8_000]
    k = np.arange(1, len(frequency) + 1)
    alpha = it.string.b1 + it.string.b2 * (k * np.pi / it.geometry.length) ** 2
    release, rate, slope = random.uniform(0.4, 2.0), np.exp(random.uniform(3.0, 4.2)), random.uniform(-0.1, 0.4)
    added = rate * (frequency / frequency[0]) ** slope
    level = 10 ** (-np.log2(k) * random.uniform(6, 12) / 20 + random.normal(0, 3, len(k)) / 20)
    # A second component of each partial: beats of up to some 2 Hz, and a slower decay.
    split, part = 2 ** (random.normal(0, 1.0, len(k)) / 1200), random.uniform(0.0, 0.6, len(k))
    t = np.arange(int(SECONDS * RATE)) / RATE
    fall = np.maximum(t - release, 0.0)
    sound = np.zeros(len(t))
    for i in range(len(k)):
        damper = np.exp(-added[i] * fall)
        for f, size, decay in ((frequency[i], 1.0, alpha[i]), (frequency[i] * split[i], part[i], 0.4 * alpha[i])):
            phase = random.uniform(0, 2 * np.pi)
            sound += level[i] * size * np.exp(-decay * t) * damper * np.cos(2 * np.pi * f * t + phase)
    sound = np.append(np.zeros(2205), sound)
    sound += 10 ** (NOISE_DB / 20) * np.abs(sound).max() * random.normal(size=len(sound))
    return Released(midi_to_note(midi), 0.5 * sound / np.abs(sound).max(), release, rate, slope)
