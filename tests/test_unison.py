"""The coupled unison of `benchmarks/unison.py`: its sound against its modes, and what modes determine about strings."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

from pianofit.dsp.bands import hann_gain

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))

from unison import Bands, matrices, shape

P = np.array([-0.5 + 0.3j, -0.8 - 0.2j])  # 1/s, of two partials
G = np.array([0.6 + 0.4j, 2.0 - 1.0j])  # 1/s
FREQUENCY = np.array([220.0, 441.0])  # Hz


def bands(frames: int) -> Bands:
    """Two silent partials with this number of frames."""
    silent = np.zeros((2, 1, frames))
    about = np.array([[0.04, 0.08], [0.01, 0.02], [0.06, 0.12]])
    return Bands(FREQUENCY, *about, silent + 0j, silent, np.zeros((2, 2)), [])


def measure(cents: np.ndarray, p: np.ndarray, g: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Poles and amplitudes of strings with equal initial and pickup amplitudes [partials, strings], by eigenvectors."""
    pole, vector = np.linalg.eig(matrices(p, g, cents[None], FREQUENCY))
    begin = np.linalg.solve(vector, np.ones((*pole.shape, 1)) + 0j)[..., 0]
    return pole, vector.sum(axis=-2) * begin / len(cents)


@pytest.mark.parametrize("cents", [[0.0], [-0.4, 0.4], [-0.9, 0.2, 0.7]], ids=len)
def test_a_unison_sounds_as_its_modes_say(cents):
    """The gain of a Hann kernel for each mode is an independent computation."""
    about = bands(50)
    pole, amplitude = measure(np.array(cents), P, G)
    time = about.start[:, None] + about.step[:, None] * np.arange(50)
    mode = hann_gain(pole, about.kernel[:, None])[..., None] * np.exp(pole[..., None] * time[:, None])
    expected = (amplitude[..., None] * mode).sum(axis=1)
    np.testing.assert_allclose(
        shape(matrices(P, G, np.array([cents]), FREQUENCY), about), expected, atol=1e-5
    )  # 12 taps


def test_strings_in_tune_are_one_string_that_decays_faster():
    """Its decay grows by N g. Modes that do not move the bridge are not excited."""
    about, none = bands(50), np.zeros((1, 3))
    single = shape(matrices(P - 3 * G, np.zeros(2), none[:, :1], FREQUENCY), about)
    np.testing.assert_allclose(shape(matrices(P, G, none, FREQUENCY), about), single, atol=1e-12)


def test_two_strings_and_three_of_which_two_are_in_tune_sound_alike():
    """So the sound does not determine N: with equal variance of the mistunings, p and g compensate the difference."""
    two, three = np.array([-0.5, 0.5]), np.array([-2.0, 1.0, 1.0]) * 0.5 / np.sqrt(2)
    assert two.var() == pytest.approx(three.var())
    pole, amplitude = measure(two, P, G)
    # The first moments of three strings' poles, weighted by amplitudes, are p - 3 g; their sum is 2 p + shift - 3 g.
    shift = 2j * np.pi * FREQUENCY * np.expm1(np.log(2) / 1200 * three[[0, 2]]).sum()
    mean, total = (pole * amplitude).sum(axis=1), pole.sum(axis=1)
    p = total - mean - shift
    g = (p - mean) / 3
    about, s = bands(200), {}
    s[2] = shape(matrices(P, G, two[None], FREQUENCY), about)
    s[3] = shape(matrices(p, g, three[None], FREQUENCY), about)
    np.testing.assert_allclose(s[3], s[2], atol=1e-4)
    assert np.abs(s[2] - shape(matrices(P - 2 * G, 0 * G, np.zeros((1, 1)), FREQUENCY), about)).max() > 0.02


def test_the_gain_of_a_window_is_continuous_on_the_unit_circle():
    s = 2 * np.pi * np.exp(1j * np.linspace(0, 2 * np.pi, 33))  # |u| = 1 for a window of 1 s
    assert hann_gain(s, 1.0) == pytest.approx(hann_gain(s * (1 + 1e-4), 1.0), rel=1e-3)
    assert hann_gain(np.array([2j * np.pi]), 1.0) == pytest.approx(0.5)
