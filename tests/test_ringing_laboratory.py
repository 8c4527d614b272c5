"""Modes of two coupled strings with two polarisations: double decay and beating, estimated from the sound alone."""

from __future__ import annotations

import functools

import numpy as np
import pytest
from coupled_strings import KAPPA, LENGTH, LOSS, POINTS, Unison, stroke

from pianofit.analysis import analyse
from pianofit.modal_response.aligned_layers import align_layers
from pianofit.modal_response.modes import PartialModes, modes_of
from pianofit.recording.recording import recording_from_samples

RATE, SECONDS, LEAD, F0 = 22_050, 4.0, 0.1, 220.0
NOISE = -65.0  # dB, relative to the peak
# Double decays of ratio 8, 7, 1.2, 3 and 3, beats of 1 to 2.7 Hz, modes down to 29 dB below their partial's strongest.
PARTIALS = range(2, 7)


@functools.cache
def true_poles() -> np.ndarray:
    """Poles of the strings. Those of the bridge decay much faster."""
    pole = Unison(F0).poles()
    return pole[(pole.imag > 0) & (pole.real > -30)]


def near(frequency: float) -> np.ndarray:
    return true_poles()[np.abs(true_poles().imag / (2 * np.pi) - frequency) < 0.2 * F0]


@functools.cache
def found() -> dict[int, PartialModes]:
    impulse = Unison(F0).response(RATE, round(SECONDS * RATE))
    recordings = []
    for seed, velocity in enumerate((0.6, 1.0, 1.7)):
        sound = np.pad(stroke(impulse, RATE, velocity), (round(LEAD * RATE), 0))
        noise = 10 ** (NOISE / 20) * np.random.default_rng(seed).normal(size=len(sound))
        recordings.append(recording_from_samples(0.3 * velocity * (sound / np.abs(sound).max() + noise), RATE))
    analyses = [analyse(recording, f0=F0) for recording in recordings]
    return {modes.number: modes for modes in modes_of(align_layers(recordings, analyses), analyses)}


def test_on_a_bridge_that_does_not_move_the_witness_has_the_grids_own_modes():
    """The modes follow from (2/h sin)² and its square, as for any hinged grid."""
    still = Unison(F0, ((1e9, 600.0, 0.0, 1.0), (1e9, 900.0, 0.0, 1.0))).poles()
    h = LENGTH / (POINTS + 1)
    s = (2 / h * np.sin(np.arange(1, 7) * np.pi / (2 * (POINTS + 1)))) ** 2
    expected = np.sqrt((2 * LENGTH * F0) ** 2 * s + KAPPA**2 * s**2)
    away = np.abs(still.imag[:, None] - expected).min(axis=0)
    assert (away < 1e-3).all()
    assert (still.real[np.abs(still.imag - expected[0]).argmin()]) == pytest.approx(-LOSS - 2e-5 * s[0], rel=1e-4)


def test_the_witness_sounds_as_its_poles_say():
    unison, count = Unison(F0), 2000
    pole, vector = np.linalg.eig(unison.A)
    amplitude = (unison.read @ vector) * np.linalg.solve(vector, unison.push)
    expected = (amplitude @ np.exp(np.outer(pole, np.arange(count) / RATE))).real
    np.testing.assert_allclose(unison.response(RATE, count), expected, atol=1e-6 * np.abs(expected).max())


@pytest.mark.parametrize("k", PARTIALS)
def test_double_decay_and_beats_of_a_unison_are_found(k):
    """All four modes of a partial; any two differ by 1.2 1/s or more."""
    modes = found()[k]
    true = near(modes.frequency)
    assert len(true) == len(modes.pole) == 4
    nearest = np.abs(modes.poles[:, None] - true).argmin(axis=0)
    assert sorted(nearest) == [0, 1, 2, 3]
    assert (np.abs(modes.poles[nearest] - true) < 0.35).all()
    double, beat = true.real.min() / true.real.max(), np.ptp(true.imag) / (2 * np.pi)
    assert modes.pole.real.min() / modes.pole.real.max() == pytest.approx(double, rel=0.5)
    assert np.ptp(modes.pole.imag) / (2 * np.pi) == pytest.approx(beat, abs=0.06)
