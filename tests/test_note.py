"""Rendered notes: alignment with a recorded attack, and the output path as a filter."""

from __future__ import annotations

import jax
import numpy as np
import pytest
from instrument_cases import true_note, uneven_note

from pianofit import recording_from_samples
from pianofit.dsp.filters import fractional_lag, locate_template
from pianofit.errors import ParameterError
from pianofit.model.free_response import level_db, modal_amplitudes
from pianofit.model.modes import mode_frequencies
from pianofit.model.note import Note, arrival
from pianofit.model.output_path import OutputPath, apply_filter, impulse_response
from pianofit.result.alignment import estimate_contact_onset

RATE, PERIOD = 10_000, 270  # of A♯1, 27 ms: an attack of 50 ms holds fewer than two


@pytest.mark.parametrize("touch", [120, 300, 500, 770])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_an_attack_is_found_among_its_periods(touch, sign):
    t = np.arange(1500) / RATE
    # It grows for two periods, so that its correlation with a later section is larger.
    note = np.minimum(np.arange(1500) / (2 * PERIOD), 1.0) * sum(
        np.sin(2 * np.pi * k * t * RATE / PERIOD) for k in (1, 2)
    )
    sound = np.zeros(1500)
    sound[touch:] = note[: 1500 - touch]
    sound = sign * sound + 1e-3 * np.random.default_rng(1).normal(size=1500)
    at, found = locate_template(note[:500], sound)
    assert (at, found) == (touch, sign)
    assert abs(fractional_lag(note[:500], found * sound[at:][:500])) < 0.1


@pytest.mark.parametrize("midi", [24, 60, 96])
def test_pitch_and_inharmonicity_are_those_of_the_partials(midi):
    note, k = true_note(midi), np.arange(1, 21)
    np.testing.assert_allclose(note.frequencies(20), k * note.f0 * np.sqrt(1 + note.B * k**2), rtol=1e-12)


def steep(midi):
    """A path that rises by 6 dB an octave, and scatters by 6 dB from one third to the next."""
    frequency = np.geomspace(20.0, 20_000.0, 40)
    return OutputPath(frequency, 20 * np.log10(frequency / 1000) + np.random.default_rng(midi).normal(0, 6, 40))


def test_a_strike_that_begins_in_the_file_is_not_cut():
    sound, _ = true_note(24)._replace(path=steep(24)).render_stroke(44_100, 4410, touch=200)
    assert not sound[:200].any()
    assert abs(sound[200]) < 1e-3 * np.abs(sound).max()
    cut, _ = true_note(24)._replace(path=steep(24)).render_stroke(44_100, 4410, touch=-200)
    np.testing.assert_allclose(cut[: 4410 - 400], sound[400:], atol=1e-9 * np.abs(sound).max())


@pytest.mark.parametrize("colour", [0.0, 0.98])  # of a one-pole filter: white, and red below 140 Hz
@pytest.mark.parametrize("midi", [24, 48, 84])
@pytest.mark.parametrize("noise_db", [-80, -50])
def test_the_touch_is_found_from_what_is_seen_of_it_in_the_noise(colour, midi, noise_db):
    note, rate, touch = true_note(midi)._replace(path=steep(midi)), 44_100, 20_000
    sound, strike = note.render_stroke(rate, 2 * rate, touch)
    noise = np.random.default_rng(midi).normal(size=2 * rate)
    for n in range(1, len(noise)):
        noise[n] += colour * noise[n - 1]
    noise *= np.abs(sound).max() * 10 ** (noise_db / 20) / noise.std()
    recording = recording_from_samples(0.5 * (sound + noise) / np.abs(sound).max(), rate)
    assert recording.onset >= touch
    assert abs(estimate_contact_onset(note, strike, recording) - touch) < 0.002 * rate


@pytest.mark.parametrize("midi", [40, 60, 84])
def test_every_partial_is_as_loud_as_the_path_says(midi):
    """Under exp(-8t), as levels are measured, although each partial has its own decay rate."""
    note = uneven_note(midi)
    rate = 44_100
    through, _ = note.render_stroke(rate, 2 * rate)
    plain, _ = note._replace(path=None).render_stroke(rate, 2 * rate)
    damped = np.exp(-8.0 * np.arange(2 * rate) / rate)  # 0.35 s contain it to 0.02 dB
    energy = np.abs(np.fft.rfft(np.stack([through, plain]) * damped)) ** 2
    f, bins = note.path.frequency, np.fft.rfftfreq(2 * rate, 1 / rate)
    lines = np.abs(bins - f[:, None]) < 0.2 * f[0]
    found = 10 * np.log10((lines @ energy[0]) / (lines @ energy[1]))
    # A peak has a width and extends into the steps of the path, most where the force is weak.
    np.testing.assert_allclose(found, note.path.db, atol=0.7)


def test_a_slow_push_goes_through_the_path_at_its_own_frequency():
    """Contact with a soft hammer lasts longer than a period, so its spectrum lies below all modes."""
    note, k = true_note(84), np.arange(1, 16)
    soft = note.hammer._replace(v_H0=0.05, K_H=1e-2 * note.hammer.K_H)
    rises = OutputPath(mode_frequencies(note.string, note.geometry.length, len(k)), -30.0 + 3 * k)
    through, strike = note._replace(hammer=soft, path=rises).render_stroke(44_100, 4410)
    plain, _ = note._replace(hammer=soft, path=None).render_stroke(44_100, 4410)
    assert strike.contact_time > 1 / rises.frequency[0]
    through, plain = np.fft.rfft(through), np.fft.rfft(plain)
    slow = (np.fft.rfftfreq(4410, 1 / 44_100) < 0.7 * rises.frequency[0]) & (np.abs(plain) > 0.1 * np.abs(plain[0]))
    ratio = np.abs(through[slow] / plain[slow])
    np.testing.assert_allclose(20 * np.log10(ratio), rises.db[0], atol=0.5)


def test_a_response_is_causal_and_of_the_path_s_levels():
    path, rate = steep(1), 44_100
    response = impulse_response(path, rate)
    transfer = np.exp(-2j * np.pi * np.outer(path.frequency, np.arange(len(response))) / rate) @ response
    np.testing.assert_allclose(20 * np.log10(np.abs(transfer)), path.db, atol=0.1)
    # The inverse of a minimum-phase response is causal too.
    inverse = np.fft.irfft(1 / np.fft.rfft(response, 4 * len(response)))
    assert np.abs(inverse[len(inverse) // 2 :]).max() < 1e-4 * np.abs(inverse).max()
    late = np.fft.irfft(1 / np.fft.rfft(np.convolve(response, [0.5, 1.0])[: len(response)], 4 * len(response)))
    assert np.abs(late[len(late) // 2 :]).max() > 1e-2 * np.abs(late).max()  # the same levels except for a slope


def test_a_long_sound_goes_through_a_filter_block_by_block():
    random = np.random.default_rng(3)
    for length in (1, 50, 1000, 20_000):
        sound, response = random.normal(size=length), random.normal(size=300)
        np.testing.assert_allclose(apply_filter(sound, response), np.convolve(sound, response), atol=1e-10)


def test_a_note_is_a_pytree_whose_quantity_is_static():
    note = true_note(60)
    leaves, tree = jax.tree.flatten(note)
    assert not any(isinstance(leaf, str) for leaf in leaves)
    again = jax.tree.unflatten(tree, leaves)
    assert isinstance(again, Note)
    assert (again.quantity, again.hammer, again.gain) == (note.quantity, note.hammer, note.gain)
    assert jax.jit(lambda n: n._replace(gain=2 * n.gain))(note).quantity == "pressure"


def test_a_note_renders_at_any_velocity_and_refuses_others():
    note = true_note(60)
    soft, loud = note.render(0.5, seconds=0.2), note.render(4.0, seconds=0.2, rate=48_000)
    assert soft.shape == (8820,)
    assert loud.shape == (9600,)
    assert np.abs(loud).max() > 5 * np.abs(soft).max()
    np.testing.assert_array_equal(note.render(seconds=0.2), note.render_stroke(44_100, 8820)[0])
    with pytest.raises(ParameterError, match=r"velocity=100.0 m/s must be from 0.01 to 20"):
        note.render(100.0)


def test_levels_are_those_of_the_sound_after_the_contact():
    """Levels include velocity, path and gain; they are compared with a simulated stroke."""
    note = true_note(60)
    by_velocity = note.levels(np.array([0.5, 4.0]), 20)
    assert by_velocity.shape == (2, 20)
    np.testing.assert_allclose(note.levels(4.0, 20), by_velocity[1], atol=1e-9)
    np.testing.assert_allclose(note.levels(count=20), by_velocity[1], atol=1e-9)
    strike = note.strike(44_100)
    decay = -strike.modes.pole.real[:20]
    amplitude = np.asarray(modal_amplitudes(strike.modes, strike.pulse.drive))[:20]
    amplitude = amplitude * np.exp(-decay * arrival(note.string, note.geometry, note.quantity))
    assert note.path is not None
    played = level_db(amplitude, decay, np) + note.path.at(note.frequencies(20)) + 20 * np.log10(note.gain)
    np.testing.assert_allclose(by_velocity[1], played, atol=1e-6)
