"""The laboratory as a whole: the paper's model with all effects off, noise and sensor, setup, and errors."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
import scipy.signal

from pianofit import simulate
from pianofit.errors import ParameterError
from pianofit.model.modes import raised_cosine_weights
from pianofit.parameters import FIT_NAMES
from studies.bensa2005 import laboratory
from studies.bensa2005.body import window_weights
from studies.bensa2005.laboratory import FINAL, MODES, Measurement, SyntheticMeasurement, measure, stroke_of

V = 0.844  # m/s
SHORT = {"seconds": 0.2}
STRING = FINAL.string
MASS = FINAL.hammer.M_H


def signal(measurement: Measurement) -> np.ndarray:
    """The note without noise from the first contact on, m/s."""
    return measurement.clean[measurement.onset :] * measurement.scale


# All effects off.


@pytest.fixture(scope="module")
def limit() -> np.ndarray:
    """`pianofit.model`, extrapolated to a step of 0."""

    def fast(oversampling: int) -> np.ndarray:
        hammer = FINAL.hammer._replace(v_H0=V)
        simulation = simulate(STRING, hammer, FINAL.geometry, rate=44_100, oversampling=oversampling, n_modes=MODES)
        return simulation.waveform(44_100, 8_820)

    return (4 * fast(64) - fast(32)) / 3


def ideal_signal(oversampling: int) -> np.ndarray:
    return signal(measure(SyntheticMeasurement.ideal(contact_rate=44_100 * oversampling, **SHORT), V))


def test_with_every_switch_off_it_converges_to_the_papers_model(limit):
    peak = np.abs(limit).max()
    errors = [np.abs(ideal_signal(n) - limit).max() / peak for n in (8, 16, 32)]
    orders = np.log2(np.divide(errors[:-1], errors[1:]))
    assert np.all(np.abs(orders - 2) < 0.1), orders
    assert errors[-1] < 4e-6  # at the default rate


def test_the_limits_of_both_programs_are_the_same_to_a_ten_millionth(limit):
    own = (4 * ideal_signal(64) - ideal_signal(32)) / 3
    assert np.abs(own - limit).max() < 3e-7 * np.abs(limit).max()


def test_more_modes_change_nothing_that_matters(monkeypatch):
    before = ideal_signal(32)
    monkeypatch.setattr(laboratory, "MODES", 256)
    assert np.abs(ideal_signal(32) - before).max() < 4e-6 * np.abs(before).max()


def test_the_window_weighs_as_its_closed_form_does():
    np.testing.assert_allclose(
        window_weights(FINAL.geometry, 256), raised_cosine_weights(FINAL.geometry, 256, np), atol=1e-13
    )


def test_a_blow_says_what_happened():
    body, stroke = stroke_of(SyntheticMeasurement.ideal(), V)
    np.testing.assert_allclose(MASS * (V - stroke.hammer[-1, 1]), stroke.force.sum() * stroke.step, rtol=1e-12)
    np.testing.assert_allclose(
        stroke.hammer[:, 0] - (stroke.states @ body.vectors.T).real @ body.under, stroke.gap, atol=1e-15
    )


# Noise and sensor.


@pytest.mark.parametrize("level", [60.0, 20.0])
def test_the_noise_is_as_loud_as_asked_for(level):
    recorded = measure(SyntheticMeasurement(noise_db=level), V, seed=3)
    noise = recorded.samples - recorded.clean
    first = recorded.clean[recorded.onset : recorded.onset + recorded.rate]
    assert 20 * np.log10(np.std(first) / np.std(noise)) == pytest.approx(level, abs=0.1)
    f, power = scipy.signal.welch(noise, recorded.rate, nperseg=8192)

    def mean(low: float, high: float) -> float:
        return float(np.mean(power[(f >= low) & (f < high)]))

    assert mean(5_000, 10_000) == pytest.approx(mean(10_000, 20_000), rel=0.05)  # white
    assert mean(15, 40) > 2.5 * mean(10_000, 20_000)  # but below 100 Hz


def test_without_noise_there_is_none():
    recorded = measure(SyntheticMeasurement(noise_db=None, **SHORT), V)
    np.testing.assert_array_equal(recorded.samples, recorded.clean)
    assert not recorded.samples[: recorded.onset].any()


def test_the_sensor_errs_as_much_as_asked_for():
    lab = SyntheticMeasurement.ideal(velocity_error=0.02, seconds=0.1, contact_rate=1e5)
    off = [measure(lab, V, seed).nominal_velocity / V - 1 for seed in range(60)]
    assert np.std(off) == pytest.approx(0.02, rel=0.25)
    assert abs(np.mean(off)) < 0.01
    assert measure(SyntheticMeasurement.ideal(**SHORT), V).nominal_velocity == V


def test_the_same_seed_gives_the_same_samples_and_another_only_other_noise():
    lab = SyntheticMeasurement(**SHORT)
    first, again, other = (measure(lab, V, seed) for seed in (5, 5, 6))
    np.testing.assert_array_equal(first.samples, again.samples)
    assert first.nominal_velocity == again.nominal_velocity != other.nominal_velocity
    np.testing.assert_array_equal(first.clean, other.clean)
    assert np.any(first.samples != other.samples)
    steady = measure(SyntheticMeasurement(velocity_error=0.0, **SHORT), V, 5)
    np.testing.assert_array_equal(first.samples, steady.samples)


def test_the_truth_names_the_nine_parameters():
    assert tuple(measure(SyntheticMeasurement.ideal(**SHORT), V).true) == FIT_NAMES
    everything = measure(SyntheticMeasurement(**SHORT), V).true
    assert set(FIT_NAMES) - set(everything) == {"mu"}  # a relaxing felt has none
    assert everything["v_H0"] == V


@pytest.mark.parametrize("velocity", [0.618, 0.844, 1.299, 1.8, 2.3])
def test_every_recorded_velocity_stays_within_the_vibrometers_range(velocity):
    recorded = measure(SyntheticMeasurement(**SHORT), velocity)
    assert 0.05 < np.abs(recorded.samples).max() < 0.9


# The setup.


def test_the_setup_says_what_the_laboratory_knew():
    recorded = measure(SyntheticMeasurement(**SHORT), 2.3)
    setup = recorded.setup(hold_velocity=True)
    g = FINAL.geometry
    assert (setup.length, setup.mass, setup.strike_position, setup.strike_width, setup.pickup_position) == tuple(g)
    assert setup.pickup_quantity == "velocity"
    assert setup.pickup_scale == recorded.scale
    assert [t.v_H0 for t in setup.recordings] == [recorded.nominal_velocity]
    assert setup.initial["K_H"] == 1.51647e9
    assert "v_H0" not in setup.initial


def test_a_velocity_can_be_where_the_fit_starts():
    recorded = measure(SyntheticMeasurement(**SHORT), V)
    setup = recorded.setup()
    assert setup.recordings == ()
    assert setup.initial["v_H0"] == recorded.nominal_velocity != V


# Errors.


def test_what_cannot_be_is_refused():
    with pytest.raises(ParameterError, match="felt='wool'"):
        SyntheticMeasurement(felt="wool")
    with pytest.raises(ParameterError, match=r"velocity=5.0"):
        measure(SyntheticMeasurement(), 5.0)


def test_measuring_needs_no_jax():
    program = "import sys, studies.bensa2005.laboratory as l\nl.measure(l.SyntheticMeasurement(), 0.844)"
    program += "; assert 'jax' not in sys.modules"
    subprocess.run([sys.executable, "-c", program], check=True)
