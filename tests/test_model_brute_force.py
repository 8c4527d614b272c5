"""The model against the wave equation, stepped on a fine grid by a program that shares no code with it."""

import math

import brute_force
import jax.numpy as jnp
import model_cases as cases
import numpy as np
import pytest
import scipy.signal
from model_cases import GEOMETRY, HAMMER, RATE, STRING

from pianofit import model
from pianofit.parameters import Geometry, Hammer, String

pytestmark = pytest.mark.usefixtures("float64")

FILE_RATE = 44_100
FINE = 16 * FILE_RATE
WINDOWS = {
    "parabola": lambda x, width: 1 - 4 * (x / width) ** 2,
    "box": lambda x, width: np.ones_like(x / width),
    "triangle": lambda x, width: 1 - 2 * np.abs(x) / width,
}


def _weights(window: str, geometry: Geometry, n_modes: int):
    return model.window_weights(lambda x: WINDOWS[window](np.asarray(x), geometry.width), geometry, n_modes)


def _simulated(string, hammer, geometry, quantity: str, window: str):
    n_modes = 128
    modes = cases.table(
        string, geometry, rate=RATE, n_modes=n_modes, quantity=quantity,
        strike_weights=_weights(window, geometry, n_modes),
    )  # fmt: skip
    return modes, cases.strike(modes, hammer, steps=1024)


def _rms(found, expected) -> float:
    return float(np.linalg.norm(found - expected) / np.linalg.norm(expected))


@pytest.mark.parametrize("window", WINDOWS)
def test_force_and_compression(window):
    hit = brute_force.strike(STRING, HAMMER, GEOMETRY, rate=FINE, quantity="velocity", window=window)
    _, pulse = _simulated(STRING, HAMMER, GEOMETRY, "velocity", window)
    n = hit.force[::8].size
    assert _rms(np.asarray(pulse.force)[:n], hit.force[::8]) < 2e-3
    assert _rms(np.asarray(pulse.compression)[:n], hit.compression[::8]) < 2e-3


@pytest.mark.parametrize("quantity", ["velocity", "displacement", "bridge-force"])
def test_waveform_of_the_first_second(quantity):
    modes, pulse = _simulated(STRING, HAMMER, GEOMETRY, quantity, "parabola")
    y = model.waveform(modes, pulse.drive, rate=FILE_RATE, samples=FILE_RATE)
    sound = brute_force.make_synthetic_recording(
        STRING, HAMMER, GEOMETRY, seconds=1.0, rate=FILE_RATE, quantity=quantity
    )
    low = scipy.signal.butter(4, 6000, fs=FILE_RATE, output="sos")
    assert _rms(scipy.signal.sosfilt(low, y), scipy.signal.sosfilt(low, sound)) < 1e-3


@pytest.mark.parametrize("quantity", ["velocity", "bridge-force"])
def test_spectrum_on_the_damped_circle(quantity):
    modes, pulse = _simulated(STRING, HAMMER, GEOMETRY, quantity, "parabola")
    sound = brute_force.make_synthetic_recording(
        STRING, HAMMER, GEOMETRY, seconds=1.0, rate=FILE_RATE, quantity=quantity
    )
    sigma, frequency = 30.0, np.linspace(50, 8000, 200)
    direct = np.exp(-np.outer(sigma + 2j * np.pi * frequency, np.arange(sound.size) / FILE_RATE)) @ sound / FILE_RATE
    Y = np.asarray(model.spectrum(modes, pulse.drive, jnp.asarray(frequency), sigma))
    assert _rms(Y, direct) < 2e-3


INSTRUMENTS = {  # string, hammer, geometry, partials
    "paper": (STRING, HAMMER, GEOMETRY, 30),
    "bass": (
        String(151.0, 0.5, 0.25, 5e-5), Hammer(4e8, 0.05, 2.3, 4.9e-3, 2.0), Geometry(1.92, 0.035, 0.23, 0.03, 0.6), 40,
    ),
    "treble": (
        String(397.0, 1.4, 9.0, 5e-4), Hammer(1e11, 0.02, 3.0, 2.2e-3, 3.0),
        Geometry(0.095, 4.7e-4, 0.0114, 0.008, 0.03), 5,
    ),
    "hard and fast": (STRING, Hammer(2e11, 0.3, 3.2, 9e-3, 5.0), GEOMETRY, 30),
}  # fmt: skip


@pytest.mark.parametrize("name", INSTRUMENTS)
def test_partials_of_other_instruments(name):
    """Level and phase of every partial after the contact, at the contact rate of `contact_rate`."""
    string, hammer, geometry, partials = INSTRUMENTS[name]
    rate = 96_000 if name == "treble" else 2 * FILE_RATE
    points = {"bass": 400, "treble": 54}.get(name, 240)
    hit = brute_force.strike(
        string, hammer, geometry, rate=16 * rate, quantity="velocity", window="parabola", points=points
    )
    weights = _weights("parabola", geometry, 128)
    contact = model.contact_rate(string, geometry, rate)
    modes = cases.table(string, geometry, rate=contact, n_modes=128, strike_weights=weights)
    pulse = cases.strike(modes, hammer, steps=1024)
    assert bool(pulse.contact_ended)
    up = hit.poles.imag > 0
    order = np.argsort(hit.poles[up].imag)[:partials]
    poles, amplitudes = hit.poles[up][order], 2 * hit.amplitudes[up][order]
    amplitudes = amplitudes * np.exp(-poles * hit.output.size / hit.rate)  # back to the first touch
    assert np.abs(np.asarray(modes.pole)[:partials] / poles - 1).max() < 1e-5
    A = np.asarray(cases.ringing(modes, pulse.drive))[:partials]
    strong = np.abs(amplitudes) > 0.02 * np.abs(amplitudes).max()
    assert strong.sum() >= min(3, partials)
    ratio = A[strong] / amplitudes[strong]
    assert np.abs(20 * np.log10(np.abs(ratio))).max() < 0.05
    assert _rms(A, amplitudes) < 1e-3


def test_the_default_window_is_the_witness_with_a_raised_cosine():
    hit = brute_force.strike(STRING, HAMMER, GEOMETRY, rate=FINE, quantity="velocity", window="raised-cosine")
    _, pulse = cases.hit(STRING, HAMMER, GEOMETRY, RATE)
    n = hit.force[::8].size
    assert _rms(np.asarray(pulse.force)[:n], hit.force[::8]) < 2e-3
    assert math.isclose(float(pulse.force.max()), hit.force.max(), rel_tol=1e-3)
