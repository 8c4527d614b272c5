"""Instruments of plucked strings: playback, page, exports and guessed keys against the model, and bad input."""

from __future__ import annotations

import numpy as np
import pytest
from page_cases import BLOCK, RATE, STEP, early, error_db, page_job, play, ringing_note

import pianofit
from pianofit import Geometry, Instrument, Key, Note, Pluck, String
from pianofit.excitation import PLUCK
from pianofit.model.modal_response import ModalResponse, force_pulse
from pianofit.model.output_path import OutputPath
from pianofit.playback import Song, render_song
from pianofit.playback.repeated_strike import string_tables
from pianofit.playback.voice import StringVoice
from pianofit.web.payload import encode_note

STRING = String(143.0, 0.42, 0.9, 4e-4)
PLACE = Geometry(length=0.65, mass=4e-3, strike_position=0.11, width=0.01, pickup=0.17)
FREQUENCY = 30.0 * 2.0 ** np.arange(10)
PATH = OutputPath(FREQUENCY, 3 * np.sin(np.log2(FREQUENCY / 30)))
# Two programs of one formula differ by rounding and by modes below -160 dB.
SAME_DB = -110.0
# The page has patterns of 32 bits and velocity gains of 16.
PAGE_DB = -80.0


def plain(midi: int = 45, quantity: str = "pressure", force: float = 4.0) -> Note:
    """A string of the model through a path, without measured modes."""
    string = STRING._replace(c=143.0 * 2 ** ((midi - 45) / 12))
    return Note(string, Pluck(force), PLACE, quantity, 0.02, PATH)


def measured(midi: int = 45, force: float = 4.0) -> Note:
    """A string with two modes a partial, a knock and a velocity gain."""
    response = ringing_note(60).modal_response
    ratio = 2 ** ((midi - 60) / 12)
    pattern = response.pattern / np.arange(1, response.pattern.shape[1] + 1)
    return plain(midi, force=force)._replace(path=None, modal_response=response.scale_pitch(ratio)._replace(pattern=pattern))


@pytest.mark.parametrize("quantity", ["velocity", "displacement", "bridge-force"])
def test_a_pluck_is_the_excitation_of_a_force_that_stops(quantity):
    note = plain(quantity=quantity)
    table, modes = string_tables(note, RATE), note.strike(RATE).modes
    static = np.asarray(note.strike(RATE).free.amplitude)
    count = len(static)
    np.testing.assert_allclose(4.0 * table.unit[:count], static, rtol=1e-12, atol=1e-18)
    # 1 N s leaves the velocity 2 Φ/M_S, and so the amplitude 2 Φ/(j ω_d M_S).
    pole = np.asarray(modes.pole)
    impulse = 2 * np.asarray(modes.strike) / (1j * pole.imag * PLACE.mass)
    np.testing.assert_allclose(static, -4.0 / pole * impulse, rtol=1e-6, atol=1e-9 * np.abs(static).max())


def test_the_pulse_of_a_pluck_drives_all_modes_by_its_force():
    note = plain(force=3.0)
    pole = np.array([-1.0 + 700j, -40.0 + 60_000j])
    np.testing.assert_allclose(force_pulse(note.strike(RATE), note.hammer).drive(pole), 3.0, rtol=1e-12)
    np.testing.assert_allclose(PLUCK.mode_excitation(np.abs(pole)), np.abs(1 / pole), rtol=1e-12)


@pytest.mark.parametrize("note", [plain(), plain(57), measured(), measured(57)], ids=["45", "57", "45 modes", "57 modes"])
def test_a_pluck_of_the_player_is_the_rendered_note(note):
    voice = StringVoice(note, 45, RATE)
    sound = np.concatenate([voice.strike(4.0), voice.ring(RATE)], axis=-1)
    expected = note.render_channels(note.strike(RATE), RATE, RATE, voice.lead)
    assert error_db(voice.through_path(sound)[:, :RATE], expected) < SAME_DB


def test_a_pluck_ends_the_earlier_motion_without_a_click():
    note, half = measured(), 2 * RATE // BLOCK // 4 * BLOCK
    voice = StringVoice(note, 45, RATE)
    first = np.concatenate([voice.strike(4.0), voice.ring(half)], axis=-1)
    again = np.concatenate([voice.strike(1.0), voice.ring(half)], axis=-1)
    alone = StringVoice(note, 45, RATE)
    expected = np.concatenate([alone.strike(1.0), alone.ring(half)], axis=-1)
    lead, gone = voice.lead, round(0.011 * RATE)
    np.testing.assert_allclose(again[:, lead + gone :], expected[:, lead + gone :], atol=1e-7)
    whole = np.concatenate([first, again], axis=-1)
    old = whole[:, first.shape[-1] :] - expected
    # What remains of the first pluck starts where it was, and falls below its former envelope.
    before = np.abs(whole[:, first.shape[-1] + lead - 2000 : first.shape[-1] + lead]).max()
    assert np.abs(np.diff(old[:, lead - 50 : lead + gone])).max() < before
    assert np.abs(old[:, lead + round(0.004 * RATE) : lead + gone]).max() < 2e-3 * before


@pytest.mark.parametrize("note", [plain(), measured()], ids=["string", "modes"])
@pytest.mark.parametrize("force", [0.5, 4.0])
def test_the_page_plays_the_rendered_note(note, force):
    job = {"keys": {45: encode_note(note, 45)}, "events": [[0, "noteOn", 45, force]], "blocks": 375}
    (sound,) = play([job])
    expected = note.with_size(force).render(seconds=1.0, rate=RATE, mono=False)
    assert error_db(sound[:, early(note) :], expected) < PAGE_DB


@pytest.mark.parametrize("make", [plain, measured], ids=["string", "modes"])
def test_a_song_with_strings_plucked_again_and_let_go_is_that_of_the_page(make):
    notes = {k: make(k)._replace(path=None) for k in (45, 50, 57)}
    guitar, random = Instrument("guitar", {k: Key(note._replace(gain=1e-3 * note.gain)) for k, note in notes.items()}), np.random.default_rng(1)
    keys = {}
    for key in notes:
        begins = np.arange(10, 600, 60) + random.integers(0, 30, 10)
        keys[key] = [x for b in begins for x in ((b * STEP, int(random.integers(30, 110))), ((b + random.integers(20, 28)) * STEP, 0))]
    song = Song(keys, [(200 * STEP, 127), (400 * STEP, 0)], 700 * STEP, 30, una_corda=[(300 * STEP, 127)])
    expected = render_song(guitar, song, RATE)
    assert expected.limited_db == expected.gain_db == 0
    assert expected.restrikes > 5
    job = page_job(guitar, song)
    assert job["bridge"] is None
    (sound,) = play([job])
    assert error_db(sound[:, early(notes[45]) :], expected.samples) < -60


def test_the_left_pedal_and_resonance_have_no_effect():
    guitar = Instrument("guitar", {k: Key(measured(k)) for k in (45, 57)})
    keys = {45: [(0.0, 100), (0.5, 0)], 57: [(0.2, 100), (0.6, 0)]}
    one, other = (render_song(guitar, Song(keys, [(0.0, 127)], 1.0, 2, una_corda=soft), RATE) for soft in ([], [(0.0, 127)]))
    np.testing.assert_array_equal(one.samples, other.samples)
