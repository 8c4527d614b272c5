"""Tests of the brute-force reference: exact eigenvalues, convergence, energy, filtering."""

import ast
import math
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import brute_force
import numpy as np
import pytest
import scipy.signal


class _String(NamedTuple):
    c: float = 304.1
    kappa: float = 1.737
    b1: float = 0.568
    b2: float = 2e-4


class _Hammer(NamedTuple):
    K_H: float = 1.09949e10
    mu: float = 0.1998
    p: float = 2.56
    M_H: float = 5.687e-3
    v_H0: float = 0.8


class _Geometry(NamedTuple):
    length: float = 1.0
    mass: float = 0.00618
    strike_position: float = 0.12
    width: float = 0.02
    pickup: float = 0.3


STRING, HAMMER, GEOMETRY = _String(), _Hammer(), _Geometry()
RATE = 44_100


def _strike(factor: int, points: int, **options) -> brute_force.Strike:
    options = {"quantity": "velocity"} | options
    return brute_force.strike(STRING, HAMMER, GEOMETRY, rate=factor * RATE, points=points, **options)


def test_shares_no_code_with_the_program():
    tree = ast.parse(Path(brute_force.__file__).read_text(encoding="utf-8"))
    names = {n.module for n in ast.walk(tree) if isinstance(n, ast.ImportFrom)}
    names |= {a.name for n in ast.walk(tree) if isinstance(n, ast.Import) for a in n.names}
    assert {str(name).split(".")[0] for name in names} <= {
        "__future__", "dataclasses", "functools", "math", "numpy", "scipy", "typing",
    }  # fmt: skip


def test_poles_are_the_damped_strings():
    hit = _strike(16, 240)
    beta2 = (np.arange(1, 41) * math.pi / GEOMETRY.length) ** 2
    alpha = STRING.b1 + STRING.b2 * beta2
    exact = -alpha + 1j * np.sqrt(STRING.c**2 * beta2 + STRING.kappa**2 * beta2**2 - alpha**2)
    found = hit.poles[hit.poles.imag > 0]
    found = found[np.argsort(found.imag)][:40]
    assert np.abs(found.imag / exact.imag - 1).max() < 2e-6
    assert np.abs(found.real / exact.real - 1).max() < 2e-6


@pytest.mark.parametrize("quantity", ["velocity", "bridge-force"])
def test_half_the_step_and_half_the_spacing_change_nothing(quantity):
    coarse, fine = _strike(16, 240, quantity=quantity), _strike(32, 481, quantity=quantity)
    n = min(coarse.output.size, fine.output[::2].size)
    for name in ("force", "compression", "output"):
        a, b = getattr(coarse, name)[:n], getattr(fine, name)[::2][:n]
        # The bridge force above 20 kHz, beyond the band of a file, depends on the grid.
        if name == "output":
            low = scipy.signal.butter(6, 15_000, fs=16 * RATE, output="sos")
            a, b = scipy.signal.sosfilt(low, a), scipy.signal.sosfilt(low, b)
        assert np.linalg.norm(a - b) < 1e-4 * np.linalg.norm(b), name


def test_energy_balance():
    hit = _strike(16, 240)
    total = hit.energy + hit.lost
    assert hit.energy[0] == pytest.approx(0.5 * HAMMER.M_H * HAMMER.v_H0**2)
    assert np.abs(total / total[0] - 1).max() < 1e-8
    assert np.diff(hit.lost).min() >= 0


def test_force_stops_the_hammer():
    hit = _strike(16, 240)
    impulse = hit.force.sum() / hit.rate
    assert HAMMER.M_H * HAMMER.v_H0 < impulse < 2 * HAMMER.M_H * HAMMER.v_H0
    assert hit.force.min() == 0.0
    assert np.all(hit.compression[-20:] < 0)


def test_exponentials_continue_the_stepping():
    grid = brute_force.Grid(STRING, GEOMETRY, 240, "parabola")
    contact = brute_force._Contact(grid, HAMMER, GEOMETRY, 1 / (16 * RATE), "velocity")
    contact.advance(16 * 200)
    start = np.array(contact.trace).shape[0]
    poles, amplitudes = brute_force._exponentials(grid, contact.read, contact.y, contact.v, of_velocity=True)
    contact.advance(16 * 100)
    assert np.all(np.array(contact.trace)[start:, 1] == 0), "the hammer must have left"
    stepped = np.array(contact.trace)[start:, 0]
    hit = replace(_strike(16, 240), poles=poles, amplitudes=amplitudes)
    free = hit.free(np.arange(stepped.size) / hit.rate)
    assert np.linalg.norm(free - stepped) < 1e-5 * np.linalg.norm(stepped)


@pytest.mark.parametrize("quantity", ["velocity", "displacement", "bridge-force"])
def test_file_rate_equals_filtering_the_fine_rate(quantity):
    seconds, lead = 0.1, 0.0101
    hit = _strike(16, 240, quantity=quantity)
    fine = np.concatenate([hit.output, hit.free(np.arange(round(0.12 * hit.rate)) / hit.rate)])
    fine = np.concatenate([np.zeros(round(lead * hit.rate)), fine])
    expected = scipy.signal.fftconvolve(fine, brute_force.low_pass(RATE), "same")[::16][: round(seconds * RATE)]
    sound = brute_force.make_synthetic_recording(
        STRING, HAMMER, GEOMETRY, seconds=seconds, rate=RATE, quantity=quantity, lead_in=lead
    )
    assert sound.shape == expected.shape
    assert np.abs(sound - expected).max() < 1e-4 * np.abs(expected).max()


def test_filter_passes_the_band_and_stops_aliases():
    w, response = scipy.signal.freqz(brute_force.low_pass(RATE), worN=1 << 15, fs=16 * RATE)
    assert np.abs(20 * np.log10(np.abs(response[w < 0.44 * RATE]))).max() < 0.01
    assert 20 * np.log10(np.abs(response[w > 0.54 * RATE])).max() < -85


def test_silence_noise_and_seed():
    options = {"seconds": 1.2, "rate": RATE, "quantity": "velocity", "lead_in": 0.1}
    clean = brute_force.make_synthetic_recording(STRING, HAMMER, GEOMETRY, **options)
    noisy = brute_force.make_synthetic_recording(STRING, HAMMER, GEOMETRY, **options, noise_db=-60, seed=3)
    again = brute_force.make_synthetic_recording(STRING, HAMMER, GEOMETRY, **options, noise_db=-60, seed=3)
    other = brute_force.make_synthetic_recording(STRING, HAMMER, GEOMETRY, **options, noise_db=-60, seed=4)
    assert np.array_equal(noisy, again)
    assert not np.array_equal(noisy, other)
    assert np.abs(clean[: round(0.098 * RATE)]).max() < 1e-5 * np.abs(clean).max()
    noise = noisy - clean
    onset = round(0.1 * RATE)
    level = 20 * np.log10(np.std(noise) / np.sqrt(np.mean(clean[onset : onset + RATE] ** 2)))
    assert level == pytest.approx(-60, abs=0.1)


def _frequency(samples: np.ndarray, start: float, stop: float, guess: float = STRING.c / 2) -> float:
    """Frequency of the partial near `guess`, Hz, from the slope of its phase."""
    t = np.arange(samples.size) / RATE
    low = scipy.signal.butter(3, 30, fs=RATE, output="sos")
    base = scipy.signal.sosfiltfilt(low, samples * np.exp(-2j * np.pi * guess * t))
    part = (t > start) & (t < stop)
    return guess + np.polyfit(t[part], np.unwrap(np.angle(base[part])), 1)[0] / (2 * np.pi)


def test_glide_falls_to_the_strings_own_pitch():
    sound = brute_force.make_synthetic_recording(
        STRING, HAMMER, GEOMETRY, seconds=2.5, rate=RATE, quantity="velocity", glide_cents=6, glide_seconds=0.3
    )
    exact = math.sqrt((STRING.c * math.pi) ** 2 + (STRING.kappa * math.pi**2) ** 2) / (2 * math.pi)
    early, late = _frequency(sound, 0.05, 0.15), _frequency(sound, 1.8, 2.4)
    assert 1200 * math.log2(late / exact) == pytest.approx(0, abs=0.05)
    assert 1200 * math.log2(early / exact) == pytest.approx(6 * math.exp(-0.1 / 0.3), abs=0.2)


def test_a_glide_is_a_change_of_tension():
    """A partial of a string as stiff as tense falls by half as many cents as its fundamental."""
    stiff = STRING._replace(kappa=STRING.c / (4 * math.pi))
    exact = [math.hypot(STRING.c * b, stiff.kappa * b**2) / (2 * math.pi) for b in (math.pi, 4 * math.pi)]
    sound = brute_force.make_synthetic_recording(
        stiff,
        HAMMER,
        GEOMETRY,
        seconds=2.5,
        rate=RATE,
        quantity="velocity",
        glide_cents=6,
        glide_seconds=0.5,
        points=60,
    )
    low, high = (1200 * math.log2(_frequency(sound, 0.05, 0.15, f) / f) for f in exact)
    assert high / low == pytest.approx(0.5 / (1 / (1 + 1 / 16)), abs=0.03)


def test_a_second_polarisation_beats():
    options = {"seconds": 2.0, "rate": RATE, "quantity": "velocity"}
    alone = brute_force.make_synthetic_recording(STRING, HAMMER, GEOMETRY, **options)
    both = brute_force.make_synthetic_recording(STRING, HAMMER, GEOMETRY, **options, beating_cents=8, beating_level=0.3)
    low = scipy.signal.butter(3, 30, fs=RATE, output="sos")
    turn = np.exp(-2j * np.pi * STRING.c / 2 * np.arange(alone.size) / RATE)
    ratio = np.abs(scipy.signal.sosfiltfilt(low, both * turn) / scipy.signal.sosfiltfilt(low, alone * turn))
    middle = ratio[RATE // 5 : -RATE // 5]
    period = 1 / (STRING.c / 2 * (2 ** (8 / 1200) - 1))  # 1.42 s
    assert middle.max() == pytest.approx(1.3, abs=0.02)
    assert middle.min() == pytest.approx(0.7, abs=0.02)
    assert (RATE // 5 + np.argmin(middle)) / RATE == pytest.approx(period / 2, abs=0.03)


def test_output_path_is_smooth_and_minimum_phase():
    fir = brute_force.output_path(RATE, 3.0, seed=1)
    f = np.geomspace(40, 20_000, 400)
    _, response = scipy.signal.freqz(fir, worN=f, fs=RATE)
    level = 20 * np.log10(np.abs(response))
    assert 1.0 < np.std(level) < 5.0
    assert np.abs(np.diff(level)).max() < 0.5
    # All zeros lie within the unit circle if and only if the phase does not wind.
    _, circle = scipy.signal.freqz(fir, worN=1 << 14)
    assert abs(np.unwrap(np.angle(circle))[-1]) < 0.1


def test_hard_hammer_touches_again_and_is_followed_to_the_end(monkeypatch):
    hard = HAMMER._replace(K_H=1e13, p=2.5, mu=0.1, M_H=1e-3, v_H0=2.0)
    options = {"rate": 16 * RATE, "quantity": "velocity", "points": 120}
    hit = brute_force.strike(STRING, hard, GEOMETRY, **options)
    assert np.sum(np.diff((hit.force > 0).astype(int)) == 1) >= 2
    monkeypatch.setattr(brute_force, "MAX_CONTACT", 5e-4)
    with pytest.raises(ValueError, match="has not left"):
        brute_force.strike(STRING, hard, GEOMETRY, **options)


def test_unstable_steps_are_refused():
    with pytest.raises(ValueError, match="unstable"):
        _strike(2, 240)
