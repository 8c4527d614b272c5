"""Signal algorithms against exact solutions and plain sums."""

from __future__ import annotations

import ast
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import signal

import pianofit.dsp
from pianofit.dsp.bands import hann_band, kaiser_bands
from pianofit.dsp.common_poles import (
    Signals,
    _residual_and_jacobian,
    _Sums,
    poles_by_subspace,
    refine_poles,
    shift_poles,
)
from pianofit.dsp.damped_sums import powers, sum_damped_modes, z_transform_at_poles
from pianofit.dsp.exponential_fit import autocorrelation_poles, fit_exponentials
from pianofit.dsp.filters import LOWEST_HZ, ORDER, convolve, delayed, forward_mean, reduce_rate, resample, without_drift
from pianofit.dsp.level import energy_level, level_energy, mean_time
from pianofit.dsp.loudness import k_weighted_mean_square, log_mel_distances

RATE = 44_100


def test_dsp_imports_numpy_and_scipy_only():
    for file in Path(pianofit.dsp.__file__).parent.glob("*.py"):
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import):
                assert {alias.name.split(".")[0] for alias in node.names} <= {"numpy", "scipy", "math", "functools"}, (
                    file
                )
            elif isinstance(node, ast.ImportFrom) and not node.level:
                known = {"__future__", "collections", "dataclasses", "numpy", "scipy", "typing"}
                assert str(node.module).split(".")[0] in known, file


@given(st.integers(1, 5000), st.floats(-0.1, 0.001), st.floats(-3.2, 3.2))
def test_powers_are_exponentials(count, real, imag):
    log_z = np.array([[real + 1j * imag], [1j * real]])
    expected = np.exp(log_z[..., None] * np.arange(count))
    # The exponential of a phase of n radians has an error of n roundings.
    assert np.abs(powers(log_z, count) / expected - 1).max() < 1e-15 * (20 + 4 * count)


@pytest.mark.parametrize("count", [0, 1])
def test_the_first_power_is_one(count):
    assert powers(np.array([2j]), count).tolist() == [[1.0][:count]]


@pytest.mark.parametrize("count", [1, 511, 512, 40_000])
def test_sums_and_transforms_of_damped_modes_are_plain_sums(count, float64):
    from pianofit.model.differentiable_sums import sum_damped_exponentials, z_transform

    rng = np.random.default_rng(count)
    log_z = -rng.uniform(1e-5, 1e-2, 7) + 1j * rng.uniform(0.01, 3, 7)
    amplitude, signal = rng.normal(size=(2, 7)) + 1j * rng.normal(size=(2, 7)), rng.normal(size=count)
    waves = np.exp(np.outer(log_z, np.arange(count)))
    plain = (amplitude @ waves).real
    np.testing.assert_allclose(sum_damped_modes(log_z * RATE, amplitude, RATE, count), plain, atol=1e-6)
    every = sum_damped_modes(log_z * RATE, amplitude, RATE, count, np.zeros(7))
    np.testing.assert_allclose(every, plain, atol=1e-10)
    np.testing.assert_allclose(sum_damped_exponentials(amplitude[0], log_z, count), plain[0], atol=1e-10)
    np.testing.assert_allclose(z_transform_at_poles(log_z, signal), waves @ signal, atol=1e-9)
    np.testing.assert_allclose(z_transform(signal, log_z), waves @ signal, atol=1e-9)


@pytest.mark.parametrize("window", ["kaiser", "hann"])
def test_a_damped_cosine_is_one_exponential_in_its_band(window):
    """From half a window after its start to half a window before its end, with the gain in closed form."""
    c, p = 0.7 * np.exp(0.3j), -3.0 + 2j * np.pi * 441.3
    sound = (c * np.exp(p * np.arange(2 * RATE) / RATE)).real
    if window == "kaiser":
        b = kaiser_bands(sound, RATE, np.array([440.0]), 100.0, 0.0)
        z, centre = b.z[0], float(b.centre[0])
    else:
        b = hann_band(np.fft.rfft(sound), len(sound), RATE, 440.0, 0.1)
        z, centre = b.z, float(b.centre)
    inside = (b.time > b.window / 2) & (b.time < 2 - b.window / 2)
    offset = p - 2j * np.pi * centre
    expected = c / 2 * b.gain(np.array([offset]))[0] * np.exp(offset * b.time)
    # The Hann window is discontinuous in its second derivative, so its cut side lobes hold more.
    tolerance = 1e-6 if window == "kaiser" else 2e-3
    np.testing.assert_allclose(z[inside], expected[inside], atol=tolerance)


def test_one_pole_is_the_same_by_subspace_by_common_fit_and_by_single_fit():
    step, pole = 0.005, -2.0 + 7.0j
    time = step * np.arange(200)
    rng = np.random.default_rng(5)
    z = np.exp(pole * time) + 1e-3 * (rng.normal(size=200) + 1j * rng.normal(size=200))
    signals = Signals(z[None], np.ones((1, 200)), step)
    start = poles_by_subspace(signals, np.ones(1), [1], 0.0)[1]
    common = refine_poles(start, signals, lambda x: x)
    single = fit_exponentials(z[None], time, autocorrelation_poles(z[None], time, 0.05))
    np.testing.assert_allclose(start, pole, atol=0.05)
    np.testing.assert_allclose(common, single.pole, atol=1e-3)
    np.testing.assert_allclose(single(time)[0], z, atol=1e-2)


@pytest.mark.parametrize("distance", [3.0, 1e-3, 0.0])
def test_a_step_by_sums_is_that_by_residual_and_jacobian(distance):
    """Also for almost parallel exponentials, and for signals of very different levels and lengths."""
    rng = np.random.default_rng(0)
    weight = np.exp(2.0 * np.arange(300) * 0.01) * np.array([[1.0], [1e4], [1e-3]])
    weight[0, 25:] = 0
    values = rng.standard_normal((3, 300)) + 1j * rng.standard_normal((3, 300))
    signals = Signals(values * np.exp(-2.0 * np.arange(300) * 0.01), weight, 0.01)
    pole = np.array([-1 + 2j, -1 + (2 + distance) * 1j, -4 - 5j])[: 3 if distance else 1]
    cost, gradient, curvature = _Sums(signals).at(pole)
    residual, jacobian = _residual_and_jacobian(pole, signals)
    np.testing.assert_allclose(cost, np.vdot(residual, residual).real, rtol=1e-12)
    for found, true in ((gradient, jacobian.conj().T @ residual), (curvature, jacobian.conj().T @ jacobian)):
        np.testing.assert_allclose(found, true, atol=1e-5 * np.abs(true).max())


def test_equal_poles_have_a_step():
    signals = Signals(np.exp((-1 + 2j) * 0.01 * np.arange(100))[None], np.ones((1, 100)), 0.01)
    cost, *terms = _Sums(signals).at(np.array([-2 + 1j, -2 + 1j]))
    assert cost > 0
    assert all(np.isfinite(term).all() for term in terms)


def test_the_shift_of_a_subspace_gives_all_poles_of_many_signals():
    poles, step = np.array([[-1 + 5j, -3 - 4j], [-0.5 + 2j, -2 + 2.5j]]), 0.01
    z = np.exp(poles[:, :, None] * step * np.arange(90)).sum(axis=1)
    hankel = np.lib.stride_tricks.sliding_window_view(z, 30, axis=1)
    vectors = np.linalg.eigh(hankel.transpose(0, 2, 1) @ hankel.conj())[1]
    found = np.sort_complex(shift_poles(vectors[:, :, -2:], step))
    np.testing.assert_allclose(found, np.sort_complex(poles), atol=1e-6)


def test_levels_are_integrals():
    t = np.linspace(0, 0.35, 200_001)
    for decay in (-16.0, -3.0, 0.0, 40.0, 5.0 + 30.0j):
        integral = np.trapezoid(np.exp(-(decay + 16) * t), t)
        assert level_energy(decay) == pytest.approx(integral, rel=1e-8)
    envelope = np.exp(-2 * 6.0 * t - 16 * t)
    assert mean_time(np.array(6.0)) == pytest.approx(np.sum(envelope * t) / np.sum(envelope), rel=1e-4)
    level = energy_level(np.array([[2.0 + 0j]]), np.array([[-6.0 + 500j]]))
    assert level[0] == pytest.approx(10 * np.log10(2 * level_energy(12.0)), abs=1e-12)


@pytest.mark.parametrize("samples", [7.0, 12.25, -3.5])
def test_a_delay_shifts_a_tone(samples):
    def tone(n: np.ndarray) -> np.ndarray:
        return np.sin(0.3 * (n - 2000)) * np.exp(-(((n - 2000) / 300) ** 2))

    n = np.arange(4000.0)
    np.testing.assert_allclose(delayed(tone(n)[None], samples)[0], tone(n - samples), atol=1e-9)


def test_resampling_keeps_a_tone_below_half_of_both_rates():
    t = np.arange(RATE) / RATE
    tone = np.sin(2 * np.pi * 440 * t) * np.hanning(RATE)
    wanted = np.interp(np.arange(22_050) / 22_050, t, tone)
    for lower in (resample(tone, RATE, 22_050), reduce_rate(tone[None], 2)[0]):
        np.testing.assert_allclose(lower, wanted, atol=1e-3)
    assert resample(tone, RATE, RATE) is tone
    assert reduce_rate(tone, 1) is tone


@pytest.mark.parametrize(("old", "new"), [(44_100, 48_000), (48_000, 44_100), (8, 1), (1, 2), (2, 3)])
@pytest.mark.parametrize("count", [1, 7, 3000])
def test_filters_are_those_of_scipy(old, new, count):
    x = np.random.default_rng(0).standard_normal((2, count)) + 1.0
    np.testing.assert_allclose(resample(x, old, new), signal.resample_poly(x, new, old, axis=-1), atol=1e-13)
    np.testing.assert_allclose(convolve(x, x[0]), signal.fftconvolve(x, x[:1], axes=-1), atol=1e-10)
    sections = signal.butter(ORDER, LOWEST_HZ, "highpass", fs=44_100, output="sos")
    lead = min(882, count - 1)
    extended = np.append(2 * x[0, 0] - x[0, lead:0:-1], x[0])
    filtered = signal.sosfilt(sections, extended, zi=extended[0] * signal.sosfilt_zi(sections))[0][lead:]
    np.testing.assert_allclose(without_drift(x[0], 44_100), filtered, atol=1e-9)


@given(st.integers(1, 40), st.integers(1, 60))
def test_a_forward_mean_is_a_mean_from_each_value_on(width, count):
    values = np.random.default_rng(count).random(count)
    expected = np.convolve(values, np.ones(min(width, count)), "valid") / min(width, count)
    np.testing.assert_allclose(forward_mean(values, width), expected, atol=1e-12)


def test_loudness_of_the_reference_tone_and_distance_of_a_gain():
    """A sine of 997 Hz at full scale has -3.01 LKFS (BS.1770-4). The analogue filters read 0.04 dB lower."""
    tone = np.sin(2 * np.pi * 997 * np.arange(48_000) / 48_000)
    assert -0.691 + 10 * np.log10(k_weighted_mean_square(tone, 48_000)) == pytest.approx(-3.05, abs=0.01)
    sound = np.random.default_rng(0).normal(size=30_000) * np.exp(-np.arange(30_000) / 5000)
    same, other = log_mel_distances(sound, [0.1 * sound, np.roll(sound, 3000)], RATE, 100)
    assert same == pytest.approx(0.0, abs=1e-9)
    assert other > 1.0
