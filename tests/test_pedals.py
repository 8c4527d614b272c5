"""Pedals and dampers in songs: what each holds, how much, and that nothing clicks."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from instrument_cases import notes_of, piano_of, rung, true_instrument, with_notes

from pianofit.errors import ParameterError
from pianofit.playback import PedalRange, PlayOptions, Song, render_song
from pianofit.playback.pedals import key_motions, releases

RATE = 48_000
DRY = PlayOptions(resonance=0.0)
PIANO = true_instrument(range(40, 73))
# Below the threshold of the limiter, and so loud that the end of modes at -160 dB does not matter.
QUIET = with_notes(PIANO, {m: v._replace(gain=0.2 * v.gain) for m, v in notes_of(PIANO).items()})
NOTE = {48: [(0.0, 90), (0.5, 0)]}


def sound(options: PlayOptions = DRY, keys: dict[int, list[tuple[float, int]]] = NOTE, **pedals: object) -> np.ndarray:
    """A song of 3 s on an instrument without keys above the last damper."""
    song = Song(keys, pedals.pop("pedal", ()), 3.0, len(keys), **pedals)
    done = render_song(QUIET, song, RATE, options=options)
    assert done.gain_db == done.limited_db == 0
    samples = done.samples[0]
    return np.pad(samples, (0, 8 * RATE))[: 8 * RATE]


def energy(samples: np.ndarray, start: float, stop: float) -> float:
    return 10 * np.log10(np.mean(samples[round(start * RATE) : round(stop * RATE)] ** 2) + 1e-30)


def test_with_all_other_keys_damped_a_song_is_what_it_was():
    """Notes one after the other, without a pedal: nothing is free while a string sounds."""
    keys = {48: [(0.0, 90), (0.5, 0)], 60: [(0.6, 70), (1.0, 0)], 55: [(1.2, 100), (1.5, 0)]}
    dry, whole = sound(DRY, keys), sound(PlayOptions(), keys)
    assert np.abs(whole - dry).max() <= 1e-4 * np.abs(dry).max()


def test_held_keys_sing_along():
    """C4 is struck and let go. What is left is C3, held, whose second partial it excited, and not the damped C4."""
    held = {48: [(0.0, 1), (3.0, 0)], 60: [(0.5, 110), (0.7, 0)]}
    dry, whole = sound(DRY, held), sound(PlayOptions(), held)
    assert energy(whole - dry, 1.5, 2.5) > energy(dry, 0.5, 0.7) - 50
    spectrum = np.abs(np.fft.rfft((whole - dry)[round(1.5 * RATE) : round(2.5 * RATE)] * np.hanning(RATE)))
    second = QUIET.keys[48].note.frequencies(2)[1]
    assert np.argmax(spectrum) == pytest.approx(second, abs=2)


def test_strings_without_a_damper_are_in_the_recordings():
    """A stroke on a measured key adds nothing to them. Struck themselves, they excite strings that a pedal frees."""
    undamped = 96
    piano = piano_of({key: rung(key)._replace(gain=1e-3) for key in (48, 60, undamped)})

    def added(key: int, pedal: int) -> float:
        """Largest sample of what resonance adds, over that of the stroke."""
        song = Song({key: [(0.0, 100), (0.8, 0)]}, [(0.0, pedal)], 1.0, 1)
        dry, whole = (render_song(piano, song, RATE, options=o).samples for o in (DRY, PlayOptions()))
        return np.abs(whole[:, :RATE] - dry[:, :RATE]).max() / np.abs(dry).max()

    assert added(48, 0) == added(undamped, 0) == 0
    assert added(48, 127) > 1e-3
    assert added(undamped, 127) > 1e-5


@pytest.mark.parametrize("model", [True, False])
def test_what_no_recording_contains_is_added(model):
    """In an instrument of the string model alone, strings without a damper sing along."""
    notes = {key: rung(key) for key in (48, 96)}
    piano = piano_of({key: note._replace(modal_response=None) if model else note for key, note in notes.items()})
    song = Song({48: [(0.0, 100), (0.8, 0)]}, (), 1.0, 1)
    dry, whole = (render_song(piano, song, RATE, options=o).samples for o in (DRY, PlayOptions()))
    size = min(whole.shape[-1], dry.shape[-1])  # what sings along can last longer
    assert bool(np.abs(whole[:, :size] - dry[:, :size]).max()) == model


def test_the_pedal_frees_all_strings():
    pedal = [(0.0, 127), (2.5, 0)]
    dry, whole = sound(DRY, pedal=pedal), sound(PlayOptions(), pedal=pedal)
    added = whole - dry
    assert -40 < energy(added, 0.5, 2.0) - energy(dry, 0.0, 0.5) < -3
    assert energy(added, 3.2, 3.6) < energy(added, 2.0, 2.4) - 40  # dampers end it


def test_a_pedal_pressed_again_catches_resonance_too():
    """Lifted for 40 ms, dampers take only a part of what rings."""
    pedal = [(0.0, 127), (1.0, 0), (1.04, 127)]
    never, again = sound(PlayOptions(), pedal=pedal[:1]), sound(PlayOptions(), pedal=pedal)
    assert -40 < energy(again, 1.3, 2.0) - energy(never, 1.3, 2.0) < -5


@pytest.mark.parametrize("options", [DRY, PlayOptions()])
def test_half_pedal_is_monotone(options):
    """The higher the controller, the longer a note that was let go rings."""
    left = [energy(sound(options, pedal=[(0.0, value)]), 0.7, 1.2) for value in range(16, 80, 8)]
    assert (np.diff(left) >= -1e-9).all()
    assert left[-1] - left[0] > 40
    assert np.diff(left).max() < 30  # no switch


def test_a_switch_is_what_it_was():
    """MIDI defines 64 and above as down. Below, files with a switch have 0."""
    down, half = sound(pedal=[(0.0, 127)]), sound(pedal=[(0.0, 64)])
    np.testing.assert_allclose(down, half, rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(sound(pedal=[(0.0, 0)]), sound(), rtol=1e-6, atol=1e-12)


@given(st.floats(0, 126), st.floats(0.5, 127), st.floats(0, 127), st.floats(0, 127))
def test_contact_falls_with_the_pedal(low, way, one, two):
    pedal_range = PedalRange(low, min(low + way, 127.0)).check()
    contacts = [pedal_range.contact(x) for x in (0.0, min(one, two), max(one, two), 127.0)]
    assert contacts == sorted(contacts, reverse=True)
    assert (pedal_range.contact(low), pedal_range.contact(pedal_range.high)) == (1.0, 0.0)


def test_a_pedal_range_is_checked():
    with pytest.raises(ParameterError, match=r"pedal_range=\(64, 24\)"):
        sound(PlayOptions(PedalRange(64, 24)))
    with pytest.raises(ParameterError, match=r"pedal_range=\(0, 127\.5\)"):
        PedalRange(0, 127.5).check()


@pytest.mark.parametrize(("value", "contact"), [(63, 1.0), (64, 0.0)])
def test_sostenuto_holds_from_64_on(value, contact):
    song = Song({48: [(0.0, 90), (0.5, 0)]}, (), 3.0, 1, sostenuto=[(0.3, value), (2.0, 0)])
    contacts = {motion.seconds: motion.contact for motion in key_motions(song, 48, PedalRange(), 6.0)}
    assert contacts.get(0.5, 0.0) == contact


def test_sostenuto_holds_what_was_held():
    """C3 is down when the middle pedal goes down, G3 is struck later."""
    keys = {48: [(0.0, 90), (0.5, 0)], 55: [(0.6, 90), (0.9, 0)]}
    song = Song(keys, (), 3.0, 2, sostenuto=[(0.3, 127), (2.0, 0)])
    held, free = (key_motions(song, key, PedalRange(), 6.0) for key in (48, 55))
    assert [(m.seconds, m.contact) for m in held] == [(0.0, 0.0), (2.0, 1.0)]
    assert [(m.seconds, m.contact) for m in free] == [(0.6, 0.0), (0.9, 1.0)]


def test_una_corda_raises_the_aftersound_over_the_prompt_sound():
    """By 20 log10(3/2) dB, with three strings: the hammer's momentum goes to two of them."""
    piano = piano_of({60: rung(60)})
    song = Song({60: [(0.0, 80), (4.0, 0)]}, (), 4.0, 1)
    full, soft = (render_song(piano, s, RATE, options=DRY).samples.mean(axis=0)
                  for s in (song, song._replace(una_corda=[(0.0, 127)])))  # fmt: skip
    early, late = (energy(soft, *span) - energy(full, *span) for span in ((0.02, 0.1), (3.0, 3.8)))
    assert late - early == pytest.approx(20 * np.log10(1.5), abs=1.5)
    assert early < 0.0
    centre = [np.sum(np.arange(2400) * np.abs(np.fft.rfft(x[1000:5799])) ** 2) for x in (full, soft)]
    power = [np.sum(x[1000:5799] ** 2) for x in (full, soft)]
    assert centre[1] / power[1] < centre[0] / power[0]  # duller


@pytest.mark.parametrize("options", [DRY, PlayOptions()])
def test_nothing_clicks_where_a_pedal_moves(options):
    """High frequencies of the sound, where the chord has none, do not rise when a pedal moves."""
    keys = {k: [(0.0, 90), (0.8, 0)] for k in (48, 52, 55)}
    moves = [(1.0, 40), (1.1, 60), (1.2, 30), (1.3, 127), (1.5, 0), (1.55, 127), (2.0, 50), (2.2, 0)]
    samples = sound(options, keys, pedal=[(0.0, 127), *moves])
    flux = np.abs(np.diff(samples, 4))
    stroke = 2e-2 * flux.max()  # a damper bends the envelope at one sample, 34 dB under the bend of a stroke
    for at, _ in moves:
        here = round(at * RATE)
        assert flux[here - 48 : here + 480].max() <= 1.5 * flux[here - 4800 : here - 48].max() + stroke


def test_random_controllers_end_in_silence():
    random = np.random.default_rng(3)
    moves = [(0.02 * i, int(random.integers(0, 128))) for i in range(100)]
    samples = sound(PlayOptions(), NOTE, pedal=moves, sostenuto=moves[::3], una_corda=moves[::5])
    assert np.isfinite(samples).all()
    assert energy(samples, 6.5, 8.0) < -150


def test_releases_know_how_long_a_key_was_down():
    song = Song({60: [(0.0, 80), (0.5, 90), (1.5, 0), (2.0, 0), (3.0, 10), (3.25, 0)]}, (), 4.0, 3)
    assert releases(song, 60) == [(1.5, 1.5), (3.25, 0.25)]


def test_tempo_moves_everything_alike():
    song = Song({60: [(1.0, 80), (2.0, 0)]}, [(0.5, 127), (3.0, 0)], 4.0, 1, sostenuto=[(1.5, 64)],
                release_velocities={(60, 2.0): 30})  # fmt: skip
    fast = song.at_tempo(2.0)
    assert fast.keys == {60: [(0.5, 80), (1.0, 0)]}
    assert (fast.pedal, fast.sostenuto, fast.seconds) == ([(0.25, 127), (1.5, 0)], [(0.75, 64)], 2.0)
    assert fast.release_velocities == {(60, 1.0): 30}
    assert fast.at_tempo(0.5)._replace(una_corda=()) == song


def test_touch_keeps_ends_and_order():
    velocities = list(range(128))
    song = Song({60: [(float(v), v) for v in velocities]}, (), 128.0, 127)
    for exponent in (0.5, 2.0):
        touched = [v for _, v in song.with_touch(exponent).keys[60]]
        assert touched == sorted(touched)
        assert (touched[0], min(touched[1:]), touched[-1]) == (0, max(round(127 * (1 / 127) ** exponent), 1), 127)
        assert (touched[64] > 64) == (exponent < 1)


def test_gain_is_before_the_limiter():
    soft, loud = (sound(PlayOptions(resonance=0.0, gain_db=x)) for x in (-6.0, 0.0))
    assert soft == pytest.approx(10 ** (-6 / 20) * loud, abs=1e-12)
    with pytest.raises(ParameterError, match="tempo=0"):
        sound(PlayOptions(tempo=0.0))
