"""Rendering of songs: strokes against the model, dampers and pedal against their definition, and the limiter."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from instrument_cases import notes_of, piano_of, true_instrument, true_note, uneven_note, with_notes

from pianofit.errors import FitError, ParameterError
from pianofit.instrument.dampers import LAST_DAMPER, Dampers
from pianofit.io.files import PEAK_LIMIT
from pianofit.model import simulate
from pianofit.model.modal_response import ModalResponse
from pianofit.model.modes import mode_frequencies
from pianofit.model.note import Note
from pianofit.playback import PlayOptions, Song, render_song
from pianofit.playback.song import limit
from pianofit.playback.voice import StringVoice

RATE = 48_000
PIANO = true_instrument()


def song(*notes: tuple[float, float, int, int], pedal: tuple[tuple[float, int], ...] = ()) -> Song:
    """Notes of (start, stop, key, velocity)."""
    keys: dict[int, list[tuple[float, int]]] = {}
    for start, stop, key, velocity in notes:
        keys.setdefault(key, []).extend([(start, velocity), (stop, 0)])
    for events in keys.values():
        events.sort(key=lambda event: (event[0], event[1] > 0))
    return Song(keys, list(pedal), max(stop for _, stop, _, _ in notes), len(notes))


def played(*notes: tuple[float, float, int, int], pedal: tuple[tuple[float, int], ...] = ()) -> np.ndarray:
    """A song far below the threshold of the limiter, without resonance, 12 s."""
    quiet = with_notes(PIANO, {m: v._replace(gain=1e-2 * v.gain) for m, v in notes_of(PIANO).items()})
    done = render_song(quiet, song(*notes, pedal=pedal), RATE, options=PlayOptions(resonance=0.0))
    assert done.gain_db == done.limited_db == 0
    assert len(done.samples) == 1
    return np.pad(done.samples[0], (0, 12 * RATE))[: 12 * RATE]


def rms_db(samples: np.ndarray, start: float, stop: float) -> float:
    return 10 * np.log10(np.mean(samples[round(start * RATE) : round(stop * RATE)] ** 2) + 1e-30)


def rung_note(midi: int) -> Note:
    """A key with a modal response in two channels: beating, aftersound and knock, unlike its string model."""
    note, random = uneven_note(midi), np.random.default_rng(midi)
    law = mode_frequencies(note.string, note.geometry.length, 12)
    law = law[law < 16_000]
    number = np.repeat(np.arange(len(law)) + 1, 3)
    pole = -np.tile([8.0, 2.0, 1.3], len(law)) + 2j * np.pi * (np.repeat(law, 3) + np.tile([0.4, 0.0, 0.9], len(law)))
    pattern = random.normal(size=(2, len(pole))) + 1j * random.normal(size=(2, len(pole)))
    knock = random.normal(size=(2, 9_000)) * np.exp(-np.arange(9_000) / 1_500)
    rung = ModalResponse(number, pole, np.zeros(len(pole)), pattern * 100, knock * 20, 44_100)
    return note._replace(modal_response=rung)


def stroke_and_ring(string: StringVoice, velocity: float, samples: int) -> np.ndarray:
    """Sound [channels, samples] from `lead` samples before the contact on."""
    head = string.strike(velocity)
    return string.through_path(np.concatenate([head, string.ring(samples - head.shape[-1])], axis=-1))[:, :samples]


@pytest.mark.parametrize("kind", [uneven_note, rung_note])
@pytest.mark.parametrize("midi", [21, 45, 60, 84, 108])
def test_a_stroke_at_rest_is_what_render_plays(midi, kind):
    note = kind(midi)
    expected = note.render_channels(note.strike(RATE), RATE, RATE, round(note.pre_onset_s * RATE))
    sound = stroke_and_ring(StringVoice(note, midi, RATE), note.hammer.v_H0, RATE)
    assert sound.shape == expected.shape
    assert np.abs(sound - expected).max() < 1e-6 * np.abs(expected).max()


@pytest.mark.parametrize("kind", [uneven_note, rung_note])
def test_a_string_that_is_reset_sounds_as_a_new_one(kind):
    string = StringVoice(kind(45), 45, RATE)
    first = stroke_and_ring(string, 2.0, RATE // 4)
    string.reset()
    np.testing.assert_array_equal(string.ring(100), np.zeros((len(first), 100)))
    np.testing.assert_array_equal(stroke_and_ring(string, 2.0, RATE // 4), first)


@pytest.mark.parametrize(("midi", "after"), [(28, 0.013), (60, 0.1), (79, 0.05)])
def test_a_stroke_on_a_moving_string_is_the_models(midi, after):
    """`simulate` from the same displacement and velocity, whose contact and waveform are independent code."""
    note = uneven_note(midi)
    string = StringVoice(note, midi, RATE)
    head = string.strike(4.0)
    string.ring(max(round(after * RATE) - head.shape[-1], 0))
    state = string.string.state.copy()
    string_pole = np.asarray(string.table.modes.pole)
    q, v = state.real, (string_pole * state).real
    moving = simulate(
        note.string, note.hammer._replace(v_H0=1.5), note.geometry, rate=RATE, quantity="pressure",
        n_modes=len(q), displacement=q, velocity=v,
    )  # fmt: skip
    beta = np.arange(1, len(string_pole) + 1) * np.pi / note.geometry.length
    # The played rates are the string's law.
    assert -string.string.pole.real == pytest.approx(note.string.b1 + note.string.b2 * beta**2)
    with_gain = moving.modes._replace(
        pickup=np.asarray(moving.modes.pickup) * note.gain,
        free_pickup=np.asarray(moving.modes.free_pickup) * note.gain,
    )
    expected = moving._replace(modes=with_gain).waveform(RATE, RATE // 2)
    head = string.strike(1.5)
    sound = np.concatenate([head, string.ring(RATE // 2 - head.shape[-1])], axis=-1)
    assert np.abs(sound - expected).max() < 1e-6 * np.abs(expected).max()
    # It differs from the sum of the old sound and a stroke at rest, because the string was moving.
    rest = StringVoice(note, midi, RATE)
    alone = np.concatenate([head := rest.strike(1.5), rest.ring(RATE // 2 - head.shape[-1])], axis=-1)
    rest.string.state = state
    assert np.abs(sound - alone - rest.ring(RATE // 2)).max() > 1e-4 * np.abs(expected).max()


def test_what_rings_is_linear_in_the_forces():
    """The sound of a restrike is the sum of the responses of modes and knock to both forces."""
    note, forces = rung_note(45), []
    string = StringVoice(note, 45, RATE)
    strike_response = string.modal_response.strike_response
    string.modal_response = SimpleNamespace(
        strike_response=lambda force, end: forces.append(force) or strike_response(force, end)
    )
    between = round(0.05 * RATE)
    sound = np.zeros((2, RATE))
    sound[:, :between] = stroke_and_ring(string, 2.0, between)
    sound[:, between:] = stroke_and_ring(string, 1.0, RATE - between)
    expected = sum(
        np.pad(note.gain * note.modal_response.sound(force, RATE, RATE - at), ((0, 0), (at, 0)))
        for force, at in zip(forces, (0, between), strict=True)
    )
    assert np.abs(sound - expected).max() < 1e-6 * np.abs(expected).max()
    rest = note.with_velocity(1.0).render_channels(
        note.with_velocity(1.0).strike(RATE), RATE, RATE - between, string.lead
    )
    alone = note.with_velocity(2.0).render_channels(note.with_velocity(2.0).strike(RATE), RATE, RATE, string.lead)
    alone[:, between:] += rest
    assert np.abs(sound - alone).max() > 1e-4 * np.abs(expected).max()  # the second hammer hit a moving string


@pytest.mark.parametrize("kind", [true_note, rung_note])
def test_a_damper_adds_its_rate_to_every_mode(kind):
    free, damped = (StringVoice(kind(50), 50, RATE) for _ in range(2))
    for string in (free, damped):
        stroke_and_ring(string, 2.0, RATE // 2)  # the knock is over
    damped.contact = 0.4
    n, late = 4800, free.lead
    rates = Dampers().rates(50, free.modes.pole.imag / (2 * np.pi))
    state = free.modes.state[:, None] * np.exp((free.modes.pole - 0.4 * rates)[:, None] * np.arange(n) / RATE)
    assert damped.ring(n + late)[:, late:] == pytest.approx((free.modes.pattern @ state).real, abs=1e-7)


def test_high_keys_have_no_dampers():
    hz = np.array([1000.0, 2000.0])
    assert not Dampers().rates(LAST_DAMPER + 1, hz).any()
    assert Dampers().rates(LAST_DAMPER, hz).all()


def test_one_channel_is_heard_in_both_and_strokes_stay_together():
    piano = piano_of({45: rung_note(45), 60: uneven_note(60)})
    dry = PlayOptions(resonance=0.0)
    both = render_song(piano, song((0.0, 0.4, 45, 60), (0.1, 0.4, 60, 60)), RATE, options=dry).samples
    one, two = (render_song(replace(piano, keys={m: piano.keys[m]}), song(x), RATE).samples
                for m, x in ((45, (0.0, 0.4, 45, 60)), (60, (0.1, 0.4, 60, 60))))  # fmt: skip
    assert (len(both), len(one), len(two)) == (2, 2, 1)
    lead = round(piano.pre_onset_s * RATE)
    assert lead == round(0.012 * RATE)
    expected = one[:, : RATE // 2].copy()
    expected[:, lead:] += two[:, : RATE // 2 - lead]
    assert both[:, : RATE // 2] == pytest.approx(expected, abs=1e-9)


def test_keys_and_pedal_move_the_dampers():
    held = played((0.0, 3.0, 55, 80))
    short = played((0.0, 0.5, 55, 80), (0.0, 3.0, 96, 1))
    pedalled = played((0.0, 0.5, 55, 80), (0.0, 3.0, 96, 1), pedal=((0.2, 127), (1.5, 0)))
    assert rms_db(held, 1.0, 1.4) > -80
    assert rms_db(short, 1.0, 1.4) < rms_db(held, 1.0, 1.4) - 60
    assert rms_db(pedalled, 1.0, 1.4) == pytest.approx(rms_db(held, 1.0, 1.4), abs=0.1)
    assert rms_db(pedalled, 2.0, 2.4) < rms_db(held, 2.0, 2.4) - 60
    treble = played((0.0, 0.05, 96, 80)), played((0.0, 3.0, 96, 80))
    assert treble[0][:RATE] == pytest.approx(treble[1][:RATE], abs=1e-7)


def test_a_late_pedal_catches_what_still_sounds():
    caught = played((0.0, 0.5, 40, 90), (0.0, 3.0, 96, 1), pedal=((0.55, 127), (3.0, 0)))
    lost = played((0.0, 0.5, 40, 90), (0.0, 3.0, 96, 1))
    assert rms_db(caught, 1.0, 1.3) > rms_db(lost, 1.0, 1.3) + 60
    assert rms_db(caught, 1.0, 1.3) < rms_db(played((0.0, 3.0, 40, 90)), 1.0, 1.3) - 5


def test_nothing_clicks_where_no_hammer_strikes():
    """When a damper or the pedal moves, the second difference of the sound is not larger than just before."""
    sound = played((0.0, 0.6, 45, 100), (0.0, 1.0, 60, 70), pedal=((0.8, 127), (1.3, 0)))
    bend = np.abs(np.diff(sound, 2))
    for at in (0.6, 0.8, 1.0, 1.3):
        here = round(at * RATE)
        assert bend[here - 24 : here + 24].max() <= 1.05 * bend[here - 2400 : here - 24].max()


def test_keys_sound_together_as_they_do_alone():
    a, b = (0.0, 1.0, 40, 90), (0.25, 0.9, 47, 60)
    both, first, second = played(a, b), played(a), played(b, (0.0, 1.0, 108, 1)) - played((0.0, 1.0, 108, 1))
    assert both[:RATE] == pytest.approx((first + second)[:RATE], abs=1e-9)


def test_what_is_held_at_the_end_is_let_go():
    done = render_song(PIANO, Song({40: [(0.0, 80)], 100: [(0.0, 80)]}, [(0.0, 127)], 0.1, 2), RATE)
    assert done.samples.shape[-1] <= 5.1 * RATE
    assert np.abs(done.samples[:, -20:]).max() < 1e-4
    assert rms_db(done.samples[0], 2.9, 3.0) > rms_db(done.samples[0], 3.4, 3.6) + 20


def test_a_song_is_as_long_at_every_rate():
    short = Song({60: [(0.0, 80), (0.05, 0)]}, [], 0.05, 1)
    seconds = [render_song(PIANO, short, rate).samples.shape[-1] / rate for rate in (22_050, 44_100, 96_000)]
    assert np.ptp(seconds) < 0.02


def test_repeated_notes_are_counted():
    done = render_song(
        PIANO, song((0.0, 0.2, 60, 80), (0.2, 0.4, 60, 80), (0.4, 0.6, 60, 80), (0.0, 0.2, 72, 80)), RATE
    )
    assert (done.strikes, done.restrikes) == (4, 2)


def test_a_trill_faster_than_the_contact_is_played_in_turn():
    sound = played(*[(0.001 * i, 0.001 * i + 0.0005, 30, 90) for i in range(8)])
    assert np.isfinite(sound).all()


@pytest.mark.parametrize("loud", [0.5, 1.0, 3.0, 100.0])
def test_the_limiter_never_lets_through(loud):
    random = np.random.default_rng(1)
    sound = loud * 0.4 * random.normal(size=(2, RATE)) * (1 + 4 * (random.random((2, RATE)) > 0.9995))
    out, gain_db, limited_db = limit(sound, RATE)
    assert np.abs(out).max() <= PEAK_LIMIT
    assert gain_db <= 0 <= limited_db <= 3.0001
    again, *_ = limit(sound, RATE)
    assert (out == again).all()
    gain = out / sound
    assert np.abs(np.diff(gain)).max() < 2e-3 * gain.max()  # a smooth gain, not a clipper
    assert gain[0] == pytest.approx(
        gain[1], rel=1e-12
    )  # equal for both channels, so that the stereo image does not move


def test_the_limiter_leaves_alone_what_fits():
    sound = 0.8 * np.sin(np.arange(RATE) / 30)[None]
    out, gain_db, limited_db = limit(sound, RATE)
    assert (out == sound).all()
    assert gain_db == limited_db == 0
    assert limit(np.zeros((1, 10)), RATE)[0].tolist() == [[0.0] * 10]


def test_what_cannot_be_played_is_refused():
    piano = true_instrument(range(40, 60))
    with pytest.raises(ParameterError, match=r"key 60 .*E2 to B3"):
        render_song(piano, song((0.0, 1.0, 60, 80)), RATE)
    with pytest.raises(ParameterError, match="rate=100"):
        render_song(PIANO, song((0.0, 1.0, 60, 80)), 100)
    with pytest.raises(ParameterError, match="694 s"):
        render_song(PIANO, song((0.0, 1700.0, 60, 80)), RATE)
    silent = piano_of({60: true_note(60)._replace(gain=1e-12)})
    with pytest.raises(ParameterError, match="the song is silent"):
        render_song(silent, song((0.0, 1.0, 60, 80)), RATE)
    stuck = true_note(60)
    stuck = piano_of({60: stuck._replace(hammer=stuck.hammer._replace(M_H=0.1, K_H=1e4, p=5.0))})
    with pytest.raises(FitError, match=r"key 60: .*v_H0="):
        render_song(stuck, song((0.0, 1.0, 60, 1)), RATE)
