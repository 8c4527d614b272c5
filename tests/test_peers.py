"""The distances of the comparison with peers: blind to gain and start, and of the size that was put in."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parent.parent / "benchmarks"))
import peers  # pyright: ignore[reportMissingImports]

RATE, F0 = 16_000, 220.0


def sound(levels: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0), decay: float = 2.0, lead: float = peers.LEAD) -> np.ndarray:
    """Four partials at levels, dB, with noise below them."""
    t = np.arange(round(peers.SPAN * RATE)) / RATE
    parts = [10 ** (db / 20) * np.sin(2 * np.pi * F0 * (k + 1) * t) / (k + 1) for k, db in enumerate(levels)]
    heard = np.pad(np.sum(parts, axis=0) * np.exp(-decay * t), (round(lead * RATE), 0))
    return 0.2 * heard + 1e-6 * np.random.default_rng(1).normal(size=len(heard))


@pytest.fixture
def target() -> peers.Target:
    return peers.Target(sound(), RATE, F0 * np.arange(1, 5), F0)


def test_a_copy_with_another_gain_and_start_is_no_other_sound(target):
    found = peers.measured(0.1 * sound(lead=peers.LEAD + 0.004), target, None)
    assert found["level"] < 0.02
    assert found["envelope"] < 0.1
    assert found["MR"] < 0.05
    assert found["realism"] < 0.3


def test_levels_and_decays_that_were_changed_are_found(target):
    """One of four partials 6 dB up, an rms of 6 √3/4 about the mean; and all partials decaying twice as fast."""
    louder = peers.measured(sound((0.0, 6.0, 0.0, 0.0)), target, None)
    assert louder["level"] == pytest.approx(6 * 3**0.5 / 4, abs=0.05)
    faster = peers.measured(sound(decay=4.0), target, None)
    assert faster["level"] < 0.1
    # Lines in dB over time, down to what is taken for the end of the note; the gain is that of the first 0.35 s.
    t, slope = np.arange(0, peers.SPAN, 0.01), 20 * 2 * np.log10(np.e)
    early = np.exp(-peers.DAMPING * t) * (t < peers.EARLY)
    gain = 10 * np.log10((early * 10 ** (-slope * t / 10)).sum() / (early * 10 ** (-2 * slope * t / 10)).sum())
    noise = -slope * 0.98 * peers.SPAN + peers.ABOVE
    away = np.abs(-slope * t - np.maximum(-2 * slope * t, noise - 20 - gain) - gain)
    assert faster["envelope"] == pytest.approx(away[-slope * t > noise].mean(), rel=0.1)
