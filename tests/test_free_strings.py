"""Strings of all keys as modes on one bridge: forces, knocks and amplitudes, against direct sums."""

from __future__ import annotations

import numpy as np
import pytest
from instrument_cases import piano_of, rung, true_note

from pianofit.literature import typical_strings
from pianofit.model.modal_response import PRE_ONSET_S, ForcePulse, VelocityGain, release_pulse
from pianofit.model.output_path import OutputPath
from pianofit.playback import PlayOptions, Song, render_song
from pianofit.playback.cached_strike import string_tables
from pianofit.playback.coupled_modes import MOST_BRIDGE_SHARE
from pianofit.playback.free_strings import HIGHEST, FreeStrings, _knock_transform, _modelled, _transform
from pianofit.playback.resonance import HOP_SECONDS, RATE_RATIO, hop_count, hop_samples

RATE = 48_000
POLE = -np.array([0.5, 2.0, 8.0]) + 2j * np.pi * np.array([110.0, 777.0, 3210.0])


@pytest.fixture(scope="module")
def strings() -> FreeStrings:
    """Two keys with measured modal responses and knocks."""
    return FreeStrings(piano_of({57: rung(57), 60: rung(60)}), RATE, common=0.3)


def test_the_transform_of_a_force_is_the_sum_over_its_samples():
    time = np.arange(200) / RATE
    pulse = ForcePulse(np.sin(np.pi * time / time[-1]) ** 2 * (1 + time / time[-1]), 1 / RATE, 2.0)
    direct = (pulse.force[None] * np.exp(-np.outer(POLE, time))).sum(axis=1) / RATE
    assert _transform(pulse, POLE) == pytest.approx(direct, rel=0.02)


def test_the_transform_of_a_knock_is_the_sum_over_its_samples(strings):
    """At frequencies without decay, relative to the contact."""
    note = strings.instrument.keys[60].note
    response, pole = note.modal_response, 1j * POLE.imag
    time = np.arange(response.knock.shape[-1]) / response.rate - PRE_ONSET_S
    direct = response.continuous_knock() @ np.exp(-np.outer(pole, time)).T / response.rate
    assert _knock_transform(response, pole) == pytest.approx(direct, abs=0.02 * np.abs(direct).max())


@pytest.mark.parametrize("decay", [3.0, 30.0, 300.0])
def test_a_long_knock_gives_a_mode_its_energy_however_fast_the_mode_decays(strings, decay):
    """Against the sum over all samples, for noise of half a second: the mean over modes, within 30 %."""
    random, rate, seconds = np.random.default_rng(1), 4_000, 0.5
    knock = random.normal(size=(1, round(seconds * rate)))
    response = strings.instrument.keys[60].note.modal_response
    response = response._replace(pattern=0 * response.pattern[:1], knock=knock, rate=rate)
    pole = -decay + 2j * np.pi * np.linspace(300, 1500, 150)
    time = np.arange(round((seconds + 7 / decay) * rate)) / rate
    ringing = np.array([np.convolve(knock[0], np.exp(p * time))[: len(time)] for p in pole]) / rate
    energy = (np.abs(ringing) ** 2).sum(axis=1) / rate
    given = np.abs(_knock_transform(response, pole)[0]) ** 2 / (2 * decay)
    assert given.sum() == pytest.approx(energy.sum(), rel=0.3)


def test_a_knock_leaves_the_amplitudes_that_are_nearest_to_its_transform_in_all_channels(strings):
    response = strings.instrument.keys[60].note.modal_response
    radiated = -2 * 0.3 * strings.drive**2 * _knock_transform(response, strings.pole)
    nearest = [
        np.linalg.lstsq(sound[:, None], own, rcond=None)[0][0]
        for sound, own in zip(strings.sound.T, radiated.T, strict=True)
    ]
    assert strings._knock_response(response) == pytest.approx(nearest, rel=1e-9)


def test_the_velocity_gain_of_a_string_at_the_frequency_of_a_struck_mode_is_that_of_the_mode(strings):
    note = rung(60)
    response, gain = note.modal_response, np.random.default_rng(1).uniform(0.5, 2.0, (2, 10))
    part = VelocityGain(response.velocity_gain.velocity, np.repeat(gain, 2, axis=1))
    piano = piano_of({57: rung(57), 60: note._replace(modal_response=response._replace(velocity_gain=part))})
    other, gains = FreeStrings(piano, RATE), np.abs(part.at(3.0))
    expected = [gains[np.argmin(np.abs(response.pole.imag - omega))] for omega in other.pole[other.modes[60]].imag]
    assert other._velocity_gain(60, 3.0)[other.modes[60]] == pytest.approx(expected)


def test_a_key_without_a_velocity_gain_excites_by_its_force_alone():
    piano = FreeStrings(piano_of({57: true_note(57), 60: true_note(60)}), RATE)
    pulse = ForcePulse(np.hanning(100), 1 / RATE, 2.0)
    own = piano.modes[60]
    expected = piano.coupled.far_response(own, piano.per_impulse[own]) * _transform(pulse, piano.pole)
    expected[own] = 0.0
    assert piano.excited_by(60, pulse) == pytest.approx(expected)


def test_a_measured_state_is_an_impulse_away_from_the_nodes_of_the_stroke(strings):
    away = np.abs(strings.per_impulse) >= 0.999 * np.abs(strings.per_state)
    assert 0.5 < away.mean() < 1.0
    assert strings.per_state[away] == pytest.approx(strings.per_impulse[away])
    assert (np.abs(strings.per_state) >= np.abs(strings.per_impulse)).all()


def test_amplitudes_of_a_modelled_string_are_normalised_to_energy_and_pass_its_path():
    path = OutputPath(np.array([20.0, 20_000.0]), np.array([-6.0, -6.0]))
    plain, filtered = (_modelled(true_note(60)._replace(path=p), 60, RATE) for p in (None, path))
    assert filtered[3] == pytest.approx(plain[3] * 10 ** (-6 / 20))
    table, pole = string_tables(true_note(60), RATE), plain[0]
    assert plain[3][0] == pytest.approx(table.pickup)
    # Half of the mass of all strings, times the squared peak velocity of a mode, is twice its energy.
    mass = typical_strings(60) * true_note(60).geometry.mass
    assert np.abs(plain[4]) ** 2 == pytest.approx(0.5 * mass * np.abs(pole) ** 2)


@pytest.mark.parametrize("rate", [22_050, 44_100, 48_000, 96_000])
def test_a_hop_is_a_whole_number_of_reduced_samples_and_has_its_duration(rate):
    hop, ratio = hop_samples(rate)
    assert hop % ratio == 0
    assert abs(hop - HOP_SECONDS * rate) <= ratio / 2
    assert rate / ratio >= min(RATE_RATIO * HIGHEST, rate)
    assert (hop_count(10 * hop, rate), hop_count(10 * hop + 1, rate)) == (11, 12)


def test_two_free_strings_are_enough_to_resonate():
    piano, song = piano_of({48: rung(48), 60: rung(60)}), Song({60: [(0.0, 90), (0.5, 0)]}, [(0.0, 127)], 1.0, 1)
    dry, whole = (render_song(piano, song, RATE, options=PlayOptions(resonance=x)).samples for x in (0.0, 1.0))
    size = min(dry.shape[-1], whole.shape[-1])
    assert np.abs(whole[:, :size] - dry[:, :size]).max() > 1e-4 * np.abs(dry).max()


def test_partials_pull_the_bridge_with_alternating_signs_and_give_it_no_more_than_they_lose():
    """Strings that ring a hundred times as long have less to give than the bridge of the literature would take."""
    note = rung(60)
    response = note.modal_response
    long = note._replace(modal_response=response._replace(pole=response.pole - 0.99 * response.pole.real))
    strings = FreeStrings(piano_of({57: rung(57), 60: long}), RATE)
    own = strings.modes[60]
    number, drive = response.partial[strings.chosen[60]], strings.drive[own]
    assert np.all(np.sign(drive) == np.where(number % 2, 1, -1))
    given = np.bincount(number, drive**2 / -strings.pole[own].real)[number]
    assert given == pytest.approx(np.full(len(own), MOST_BRIDGE_SHARE))


def test_only_modes_that_sound_and_that_the_sample_rate_holds_are_free_strings():
    note = rung(72)  # its tenth partial lies above 5 kHz
    response = note.modal_response
    silent = response._replace(pattern=response.pattern * (response.partial != 3))
    piano = piano_of({57: rung(57), 72: note._replace(modal_response=silent)})
    slow, fast = (FreeStrings(piano, rate) for rate in (4_000, RATE))
    assert 3 not in silent.partial[fast.chosen[72]]
    highest = [pole.imag.max() / (2 * np.pi) for pole in (slow.pole, fast.pole, response.pole)]
    assert highest[0] < 2_000 < highest[1] < HIGHEST < highest[2]


def test_what_other_strings_sound_does_not_depend_on_where_in_a_hop_a_key_is_struck():
    piano = piano_of({48: rung(48), 60: rung(60), 67: rung(67)})
    hop = hop_samples(RATE)[0]

    def added(samples: int) -> np.ndarray:
        start = 0.1 + samples / RATE
        song = Song({60: [(start, 90), (1.0, 0)]}, [(0.0, 127)], 1.2, 1)
        dry, whole = (render_song(piano, song, RATE, options=PlayOptions(resonance=x)).samples for x in (0.0, 1.0))
        return whole[:, 4_800 + samples :][:, :24_000] - dry[:, 4_800 + samples :][:, :24_000]

    first, later = added(0), added(2 * hop // 3)
    assert np.linalg.norm(later - first) < 0.03 * np.linalg.norm(first)


@pytest.mark.parametrize(("own", "rate"), [(88_200, 48_000), (96_000, 44_100), (88_200, 44_100), (44_100, 96_000)])
def test_a_pluck_keeps_its_impulse_at_every_rate(own, rate):
    assert release_pulse(2.0, 1 / own).at(rate).sum() == pytest.approx(2.0, rel=1e-3)
