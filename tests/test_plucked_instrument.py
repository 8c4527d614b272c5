"""Instruments of plucked strings: playback, page, exports and guessed keys against the model, and bad input."""

from __future__ import annotations

import importlib.util
import json
from pathlib import Path

import numpy as np
import pytest
from instrument_cases import ERRORS, fit_document, write_fit
from instrument_cases import true_note as true_piano
from page_cases import BLOCK, RATE, STEP, early, error_db, page_job, play, ringing_note

import pianofit
from pianofit import FitError, Geometry, Instrument, Key, Note, ParameterError, Pluck, String
from pianofit.analysis.note_names import midi_to_note
from pianofit.dataset.source import load_source
from pianofit.excitation import PLUCK
from pianofit.export.modal_json import write_modal_json
from pianofit.instrument.key_quantities import LOUDEST_VELOCITY
from pianofit.model.modal_response import force_pulse
from pianofit.model.output_path import OutputPath
from pianofit.playback import Song, render_song
from pianofit.playback.cached_strike import string_tables
from pianofit.playback.voice import StringVoice
from pianofit.web.payload import encode_note

PLAYER = Path(__file__).parents[1] / "examples" / "players" / "modal_player.py"
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
    return plain(midi, force=force)._replace(
        path=None, modal_response=response.scale_pitch(ratio)._replace(pattern=pattern)
    )


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


@pytest.mark.parametrize(
    "note", [plain(), plain(57), measured(), measured(57)], ids=["45", "57", "45 modes", "57 modes"]
)
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
    guitar, random = (
        Instrument("guitar", {k: Key(note._replace(gain=1e-3 * note.gain)) for k, note in notes.items()}),
        np.random.default_rng(1),
    )
    keys = {}
    for key in notes:
        begins = np.arange(10, 600, 60) + random.integers(0, 30, 10)
        keys[key] = [
            x
            for b in begins
            for x in ((b * STEP, int(random.integers(30, 110))), ((b + random.integers(20, 28)) * STEP, 0))
        ]
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
    one, other = (
        render_song(guitar, Song(keys, [(0.0, 127)], 1.0, 2, una_corda=soft), RATE) for soft in ([], [(0.0, 127)])
    )
    np.testing.assert_array_equal(one.samples, other.samples)


# --- an instrument from recordings ------------------------------------------------------------------------------------

RECORDED, BETWEEN = (45, 50, 57), 53
SIZES = (1.0, 3.0)
SOUND_RATE = 44_100


def true_note(midi: int) -> Note:
    """A guitar of known strings behind one body: an output path over absolute frequency."""
    f0 = 110.0 * 2 ** ((midi - 45) / 12)
    c, random = 1.3 * f0, np.random.default_rng(0)
    frequency = 60.0 * 2 ** (np.arange(40) / 4)
    db = np.convolve(random.normal(0, 8, 44), np.hanning(7)[1:-1] / 3, "valid")[:40]
    string = String(c, c * 0.65 * np.sqrt(6e-5) / np.pi, 1.2, 6e-4)
    return Note(string, Pluck(1.0), PLACE._replace(strike_position=0.09), "pressure", 0.01, OutputPath(frequency, db))


def partial_levels(sound: np.ndarray, f0: float, B: float, rate: int, count: int) -> np.ndarray:
    """Level of the strongest bin near each partial over the first second, dB [partials]."""
    size = 8 * rate
    spectrum = np.abs(np.fft.rfft(sound[:rate] * np.hanning(rate), size))
    k = np.arange(1, count + 1)
    centre = k * f0 * np.sqrt(1 + B * k**2) * size / rate
    return np.array([20 * np.log10(spectrum[round(c - 24) : round(c + 25)].max()) for c in centre])


@pytest.fixture(scope="module")
def fits(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("fits")
    for midi in RECORDED:
        sounds = []
        for i, size in enumerate(SIZES):
            sound = np.pad(true_note(midi).with_size(size).render(seconds=1.6, rate=SOUND_RATE), (4000, 0))
            noise = np.random.default_rng([midi, i]).normal(0, 1e-4 * np.abs(sound).max(), len(sound))
            sounds.append(pianofit.recording_from_samples(sound + noise, SOUND_RATE, name=f"{midi}-{i}"))
        result = pianofit.fit(
            *sounds, setup=pianofit.Setup(excitation="pluck"), note=midi_to_note(midi), progress=False
        )
        result.save(folder / "keys" / f"guitar-{midi_to_note(midi)}", page=False)
    return folder


@pytest.fixture(scope="module")
def guitar(fits) -> Instrument:
    return pianofit.build_instrument(pianofit.load_keys(pianofit.find_fits([fits])), "guitar")


@pytest.mark.parametrize("midi", RECORDED)
def test_measured_modes_have_the_levels_of_the_recorded_pluck(guitar, midi):
    note, true = guitar.keys[midi].note, true_note(midi)
    assert note.size == pytest.approx(LOUDEST_VELOCITY)
    layers = guitar.keys[midi].fit.layers
    assert [layer.velocity for layer in layers] == pytest.approx([LOUDEST_VELOCITY / 3, LOUDEST_VELOCITY], rel=0.02)
    at = (float(true.f0), float(true.B), SOUND_RATE, 12)
    for layer, size in zip(layers, SIZES, strict=True):
        lead = round(note.pre_onset_s * SOUND_RATE)
        found = note.with_size(layer.velocity).render(seconds=1.5, rate=SOUND_RATE)[lead:]
        expected = true.with_size(size).render(seconds=1.5, rate=SOUND_RATE)
        difference = partial_levels(found, *at) - partial_levels(expected, *at)
        assert np.median(np.abs(difference)) < 0.5
        assert np.abs(difference).max() < 3


def test_a_guessed_key_is_near_its_true_sound(guitar):
    note, true = guitar.keys[BETWEEN].note, true_note(BETWEEN)
    assert guitar.keys[BETWEEN].state == "interpolated"
    assert float(note.B) == pytest.approx(float(true.B), rel=0.1)
    lead = round(note.pre_onset_s * SOUND_RATE)
    found = note.with_size(LOUDEST_VELOCITY).render(seconds=1.5, rate=SOUND_RATE)[lead:]
    expected = true.with_size(SIZES[-1]).render(seconds=1.5, rate=SOUND_RATE)
    levels = [
        partial_levels(sound, float(own.f0), float(own.B), SOUND_RATE, 10)
        for sound, own in ((found, note), (expected, true))
    ]
    # The body differs by 8 dB from one third of an octave to the next.
    assert np.sqrt(np.mean((levels[0] - levels[1]) ** 2)) < 6


def test_the_laws_have_no_hammer_and_no_literature_of_pianos(guitar):
    assert not {"M_H/M_S", "F/M_S", "local_exponent", "mu", "skin"} & set(guitar.laws)
    assert guitar.laws["B"].literature is None
    # Notches of the body look like nodes of the string.
    assert guitar.laws["x0/L"].value[45 - 21] == pytest.approx(0.09 / 0.65, rel=0.25)
    pitch = [float(key.note.f0) for key in guitar.keys.values()]
    np.testing.assert_allclose(np.diff(np.log2(pitch)), 1 / 12, atol=0.005)


def test_a_file_has_the_same_instrument(guitar, tmp_path):
    pianofit.write_instrument(tmp_path / "instrument.json", guitar)
    again = pianofit.load_instrument(tmp_path / "instrument.json")
    assert again.law is PLUCK
    for midi in (45, BETWEEN):
        sounds = [piano.note(midi, 90).render(seconds=0.5, rate=SOUND_RATE) for piano in (guitar, again)]
        assert sounds[1] == pytest.approx(sounds[0], abs=1e-6 * np.abs(sounds[0]).max())


def test_a_fit_that_is_loaded_plays_all_its_plucks_with_one_gain(fits):
    folder = fits / "keys" / "guitar-A2"
    result = pianofit.Result.load(folder)
    sizes = [float(note.size) for note in result.minima_notes[0]]
    gains = {float(note.gain) for note in result.minima_notes[0]}
    if result.note.modal_response is not None:
        assert len(gains) == 1
        assert max(sizes) / min(sizes) == pytest.approx(3, rel=0.02)


def test_another_position_moves_the_measured_levels_with_the_string(guitar):
    note = guitar.keys[45].note
    moved = note.with_stroke(0.325)
    k = note.modal_response.partial
    size = np.abs(moved.modal_response.pattern[0])
    # A pluck in the middle does not excite even partials.
    assert size[k % 2 == 0].max() < 1e-6 * size[k % 2 == 1].max()


def test_tuning_needs_pitch_and_inharmonicity_alone(fits):
    found = pianofit.tuning(fits)
    key = found.keys[45 - 21]
    assert key.recorded
    assert key.f0.value == pytest.approx(110.0, rel=1e-3)
    assert key.B.interval[0] < 6e-5 < key.B.interval[1]
    assert key.unison_cents is None


# --- exports and bad input --------------------------------------------------------------------------------------------


def test_exports_play_the_pluck(guitar, tmp_path):
    options = pianofit.ExportOptions(2, seconds=0.5)
    for format_name in ("sfz", "decent-sampler"):
        made = pianofit.export_sampler(guitar, tmp_path / format_name, [45, 57], options, to=format_name)
        assert made.samples == 4  # no resonance
    with pytest.raises(ParameterError, match="una_corda"):
        pianofit.export_sampler(guitar, tmp_path / "soft", [45], options._replace(una_corda=True))


def test_modal_json_plays_the_pluck(guitar, tmp_path):
    write_modal_json(tmp_path / "guitar.json", guitar, [45])
    spec = importlib.util.spec_from_file_location("modal_player", PLAYER)
    player = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(player)
    sound = np.array(player.play(json.loads((tmp_path / "guitar.json").read_text()), 45, 127, 1.0)).mean(axis=0)
    note = guitar.note(45, 127)
    expected = note.render(seconds=1.0, rate=RATE)
    begin = max(len(expected) - len(sound), 0)
    levels = [
        partial_levels(x, float(note.f0), float(note.B), RATE, 10) for x in (np.pad(sound, (0, RATE)), expected[begin:])
    ]
    np.testing.assert_allclose(levels[0], levels[1], atol=0.5)


def test_struck_and_plucked_fits_do_not_mix(fits, tmp_path):
    files = [*pianofit.find_fits([fits]), write_fit(tmp_path, 72, fit_document(true_piano(72), ERRORS), "piano")]
    with pytest.raises(FitError, match="struck") as error:
        pianofit.load_keys(files)
    assert "piano-C5" in str(error.value)
    assert "guitar-" in str(error.value)


def test_a_file_with_a_hammer_on_a_plucked_key_is_refused(guitar, tmp_path):
    pianofit.write_instrument(tmp_path / "instrument.json", guitar)
    content = json.loads((tmp_path / "instrument.json").read_text())
    content["keys"][3]["hammer"] = {"K_H": 1e9, "mu": 0.1, "p": 2.5, "M_H": 0.01}
    (tmp_path / "instrument.json").write_text(json.dumps(content))
    with pytest.raises(FitError, match=r"keys\[3\].hammer"):
        pianofit.load_instrument(tmp_path / "instrument.json")


def test_what_needs_a_hammer_says_so(guitar, fits, tmp_path):
    pianofit.write_instrument(tmp_path / "instrument.json", guitar)
    with pytest.raises(ParameterError, match="plucked"):
        load_source(pianofit.NoteOptions(around=tmp_path / "instrument.json"))
    with pytest.raises(ParameterError, match="plucked"):
        pianofit.prior_of_key(pianofit.load_keys(pianofit.find_fits([fits])), 52)
