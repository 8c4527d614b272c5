"""An instrument whose recorded keys have modal responses, which unrecorded keys borrow."""

from __future__ import annotations

import copy
import json

import mido
import numpy as np
import pytest
import soundfile
from instrument_cases import ERRORS, PARTS, RATE, document_of, fit_document, rung, true_note, write_fit
from typer.testing import CliRunner

from pianofit.cli import app
from pianofit.errors import FitError
from pianofit.export import ExportOptions, export_sampler
from pianofit.instrument import build_instrument, find_fits, load_instrument, load_keys
from pianofit.instrument.interpolate_keys import REACH, interpolate_keys
from pianofit.model.modal_response import force_pulse
from pianofit.model.modes import mode_frequencies
from pianofit.schema.decode import builtins_of
from pianofit.schema.modal_response import FittedModalResponse, ModalResponseEntry, encode_knock


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Fits of D3, with a modal response, and of G5, without."""
    place = tmp_path_factory.mktemp("fits")
    note = rung(50)
    fitted = builtins_of(FittedModalResponse(response=ModalResponseEntry.of(note.modal_response)))
    file = write_fit(place, 50, fit_document(note, ERRORS) | {"modal_response": fitted})
    (file.parent / "knock.flac").write_bytes(encode_knock(note.modal_response))
    write_fit(place, 79, fit_document(true_note(79), ERRORS))
    return place


@pytest.fixture(scope="module")
def document(folder):
    return document_of(build_instrument(load_keys(find_fits([folder])), "twin"))


@pytest.fixture(scope="module")
def file(document, tmp_path_factory):
    path = tmp_path_factory.mktemp("built") / "instrument.json"
    path.write_text(json.dumps(document))
    return path


def test_a_recorded_key_sounds_as_its_fit(folder, file):
    """To the quantisation of a 16-bit knock, at any velocity: the laws do not change the force of its modes."""
    fit, own = load_keys(find_fits([folder]))[0].note, load_instrument(folder).keys[50].note
    played = load_instrument(file).keys[50].note
    for velocity in (0.5, 4.0):
        expected, sound = (x.render(velocity, seconds=1.0, mono=False) for x in (fit, own))
        assert np.abs(sound - expected).max() < 1e-9 * np.abs(expected).max()
        expected, sound = (x.render(velocity, seconds=1.0, mono=False) for x in (fit, played))
        assert np.abs(sound - expected).max() < 1e-4 * np.abs(expected).max()
        assert np.abs(sound - expected)[:, RATE // 2 :].max() < 1e-9 * np.abs(expected).max()


def test_keys_within_reach_borrow_and_others_ring_by_their_law(folder, file):
    built, read = (load_instrument(path).keys for path in (folder, file))
    for keys in (built, read):
        within = {*range(50 - REACH, 50 + REACH + 1)}
        assert {midi for midi, key in keys.items() if key.note.modal_response is not None} == within
        assert keys[79].note.modal_response is None
        assert keys[51].note.pre_onset_s > 0
    own, again = built[52].note.modal_response, read[52].note.modal_response
    assert own.pole == pytest.approx(again.pole, rel=1e-12)
    assert own.pattern == pytest.approx(again.pattern, rel=1e-12)


def test_a_borrowed_partial_has_its_laws_energy_and_its_neighbours_decay_curve():
    own, donor = true_note(52), rung(50)
    found = interpolate_keys({50: donor, 52: own}, [52])[52].modal_response
    law = own.string.b1 + own.string.b2 * (np.arange(1, 11) * np.pi / own.geometry.length) ** 2
    frequency = mode_frequencies(own.string, own.geometry.length, 10)
    times = np.array([0.0, 0.1, 0.3, 1.0, 3.0])  # in units of the inverse decay rate of the string model
    ratio, part = np.array(PARTS).T
    truth = 10 * np.log10(np.exp(-2 * np.outer(times, ratio)) @ part**2)  # without beating
    for k in range(1, 9):
        at = found.partial == k
        assert np.imag(found.pole[at]) / (2 * np.pi) == pytest.approx(frequency[k - 1], rel=1e-9)
        parts = np.exp(np.outer(times, np.real(found.pole[at]) / law[k - 1]))
        curve = 20 * np.log10(np.abs(parts @ found.pattern[0, at]))
        # The root of a sum of powers is not a sum of exponentials. Positive exponentials come this near.
        assert curve - curve[0] == pytest.approx(truth - truth[0], abs=0.5)
    # Its energy on the damped circle, in the mean of the channels, against a stroke of the string model, which other
    # code computes.
    bare, sigma = own._replace(path=None), 30.0
    borrowed = interpolate_keys({50: donor, 52: bare}, [52])[52].modal_response
    alone, stroke = bare.render_stroke(RATE, 2 * RATE)
    seconds = np.arange(len(alone)) / RATE
    for k in range(1, 8):
        at = borrowed.partial == k
        drive = force_pulse(stroke, float(bare.hammer.v_H0)).drive(borrowed.pole[at])
        part = np.abs(borrowed.pattern[:, at].mean(axis=0) * drive) * bare.gain
        envelope = np.exp(np.outer(seconds, np.real(borrowed.pole[at]))) @ part
        energy = (envelope**2 * np.exp(-2 * sigma * seconds)).sum()
        size = np.abs(alone @ np.exp(-(sigma + 2j * np.pi * frequency[k - 1]) * seconds)) / RATE * 2
        expected = (size * (sigma + law[k - 1])) ** 2 / (2 * (sigma + law[k - 1])) * RATE
        assert 10 * np.log10(energy / expected) == pytest.approx(0.0, abs=0.5)


BAD = {
    "modes": ({"modes": 1}, r"modal_response\.modes = 1 must be a table"),
    "uneven": ({"modes": {"partial": [1]}}, r"modal_response\.modes\.frequency is missing"),
    "no base64": ({"knock": {"flac": "?", "scale": 1.0}}, "base64"),
    "no sound": ({"knock": {"flac": "AAAA", "scale": 1.0}}, "FLAC"),
    "truncated": ({"knock": {"flac": "ZkxhQwAAAA==", "scale": 1.0}}, "cannot be read"),
    "text": ({"knock": {"flac": 7, "scale": 1.0}}, r"modal_response\.knock\.flac = 7 must be a text"),
    "scale": ({"knock": {"flac": "", "scale": None}}, "knock.scale"),
}


@pytest.mark.parametrize("name", BAD)
def test_a_hostile_ringing_is_refused(name, document, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    change, message = BAD[name]
    bad = copy.deepcopy(document)
    bad["keys"][50 - 21]["modal_response"] |= change
    (tmp_path / "bad.json").write_text(json.dumps(bad))
    with pytest.raises(FitError, match=message) as caught:
        load_instrument("bad.json")
    assert str(caught.value).startswith("bad.json: ")


def test_a_song_is_written_in_as_many_channels(file, tmp_path):
    track = mido.MidiTrack([mido.Message("note_on", note=50, velocity=80), mido.Message("note_off", note=50, time=480)])
    mido.MidiFile(tracks=[track]).save(tmp_path / "a.mid")
    words = ["play", file, tmp_path / "a.mid", "--out", tmp_path / "a.wav", "--json"]
    done = CliRunner().invoke(app, [str(word) for word in words])
    assert done.exit_code == 0, done.output
    assert json.loads(done.stdout)["channels"] == 2
    sound, _ = soundfile.read(tmp_path / "a.wav")
    assert sound.shape[1] == 2
    assert np.abs(sound[:, 0] - sound[:, 1]).max() > 0.1 * np.abs(sound).max()


def test_samples_are_the_models_strokes_in_stereo_with_their_contacts_aligned(file, tmp_path):
    """Each sample is the stroke shifted by whole samples, the soft one to earlier. A player plays both channels."""
    from pysfizz import Synth

    piano = load_instrument(file)
    export_sampler(piano, tmp_path / "out", [50, 79], ExportOptions(2, 0.3, RATE, "wav"))
    shifts, first = [], round(0.1 * RATE)
    for velocity in (1, 127):
        sound = soundfile.read(tmp_path / "out" / "samples" / f"050-D3-v{velocity:03}.wav")[0].T
        note = piano.note(50, velocity)
        expected = note.render_channels(note.strike(RATE), RATE, 2 * first, round(note.pre_onset_s * RATE))
        trial = range(-RATE // 500, RATE // 500)
        products = [np.vdot(np.roll(expected, m, axis=1)[:, :first], sound[:, :first]) for m in trial]
        shifts.append(trial[int(np.argmax(products))])
        part = slice(abs(shifts[-1]), first)
        same = np.roll(expected, shifts[-1], axis=1)[:, part]
        gain = np.vdot(same, sound[:, part]) / np.vdot(same, same)
        step = 2.0**-23  # 24 bits
        assert np.abs(sound[:, part] - gain * same).max() < max(1e-5 * np.abs(sound).max(), 1.1 * step)
        assert len(sound) == 2
    assert -RATE // 1000 <= shifts[0] - shifts[1] <= 0
    synth = Synth(sample_rate=RATE, block_size=512)
    assert synth.load_sfz_file(tmp_path / "out" / "twin.sfz", quiet=False)
    played = synth.render_note(50, 127, 0.3, 0.3)[:, :first]
    alike = np.corrcoef(np.concatenate([played, sound[:, :first]]))
    assert min(alike[0, 2], alike[1, 3]) > 0.999
    assert alike[0, 1] < 0.9
    assert soundfile.info(tmp_path / "out" / "samples" / "079-G5-v127.wav").channels == 1
