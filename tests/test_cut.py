"""A long recording is found to be the strokes that it was made of, and cut at them without a change of a sample."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest
import soundfile
from instrument_cases import rung

from pianofit.analysis.strokes import find_strokes
from pianofit.batch.cut_recording import cut_recording
from pianofit.cli.program import main
from pianofit.errors import RecordingError, SetupError

RATE = 44_100
NOTES = {40: "E2", 52: "E3", 67: "G4", 84: "C6"}
VELOCITIES = (3.0, 0.7, 1.7)


@pytest.fixture(scope="module")
def session() -> tuple[np.ndarray, list[tuple[int, str, float]]]:
    """Strokes that are damped just before the next, and a knock on wood: sound, and (onset, note, velocity)."""
    random, at, truth = np.random.default_rng(0), RATE // 2, []
    samples = np.zeros((2, 30 * RATE))
    for midi, name in NOTES.items():
        note = rung(midi)
        for velocity in VELOCITIES:
            sound = note.render(velocity, seconds=4.0, rate=RATE, mono=False)
            sound = 0.5 * sound / 10 / np.abs(note.render(3.0, seconds=0.5)).max()
            gap = round(RATE * random.uniform(0.9, 2.5))
            damped = np.exp(-50 * np.maximum(np.arange(sound.shape[1]) - gap + 0.15 * RATE, 0) / RATE)
            samples[:, at : at + sound.shape[1]] += sound * damped
            truth.append((at + round(note.pre_onset_s * RATE), name, velocity))
            at += gap
    knock = at + RATE
    samples[:, knock : knock + 2000] += 0.02 * random.normal(size=2000) * np.exp(-np.arange(2000) / 300)
    truth.append((knock, "", 0.0))
    samples = samples[:, : knock + RATE]
    return samples + 1e-5 * random.normal(size=samples.shape), truth


@pytest.fixture(scope="module")
def file(session, tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("session") / "session.wav"
    soundfile.write(path, session[0].T, RATE, subtype="PCM_24")
    return path


@pytest.mark.parametrize("samples", [100, 1000])
def test_a_click_at_the_very_end_is_not_a_sure_stroke(samples):
    """Its step is incomplete."""
    sound = 1e-5 * np.random.default_rng(0).normal(size=(1, 2 * RATE + 200))
    sound[0, -samples:] += 0.3
    assert all("lasts" in stroke.doubt or "no pitch" in stroke.doubt for stroke in find_strokes(sound, RATE))


def test_an_abrupt_end_is_not_a_stroke():
    note = rung(60)
    sound = note.render(2.0, seconds=4.0, rate=RATE, mono=False)[:1, : 2 * RATE]
    (stroke,) = find_strokes(sound / np.abs(sound).max(), RATE)
    assert stroke.note == "C4"
    assert not stroke.doubt


def test_all_strokes_are_found_and_named(session):
    samples, truth = session
    found = find_strokes(samples, RATE)
    notes = [(onset, name) for onset, name, _ in truth if name]
    sure = [stroke for stroke in found if not stroke.doubt]
    assert [stroke.note for stroke in sure] == [name for _, name in notes]
    assert np.abs(np.array([stroke.onset for stroke in sure]) - [onset for onset, _ in notes]).max() < 0.015 * RATE
    (knock,) = (stroke for stroke in found if stroke.doubt)
    assert knock.onset == pytest.approx(truth[-1][0], abs=0.015 * RATE)


def test_files_hold_the_samples_of_the_recording(session, file, tmp_path):
    before = file.read_bytes()
    listed = cut_recording(file, tmp_path / "cut")
    assert file.read_bytes() == before
    whole, _ = soundfile.read(file, always_2d=True)
    written = [stroke for stroke in listed if stroke.file]
    assert sorted(p.name for p in (tmp_path / "cut").iterdir()) == sorted([*(s.file for s in written), "strokes.csv"])
    for stroke in written:
        part, rate = soundfile.read(tmp_path / "cut" / stroke.file, always_2d=True)
        end = round(stroke.end_s * RATE)
        assert rate == RATE
        assert np.array_equal(part, whole[end - len(part) : end])
        assert 0.04 < stroke.start_s - (end - len(part)) / RATE < 0.06 or stroke.number > 1


def test_layers_are_in_the_order_of_velocity(session, file):
    """Each note was struck at 3, 0.7 and 1.7 m/s."""
    listed = [stroke for stroke in cut_recording(file, None) if stroke.file]
    for name in NOTES.values():
        assert [stroke.layer for stroke in listed if stroke.note == name] == [3, 1, 2]
    assert listed[0].file == "E2-L3.flac"


def test_the_command_lists_without_writing(file, tmp_path, capsys):
    assert main(["cut", str(file), "--dry-run", "--json"]) == 0
    listed = json.loads(capsys.readouterr().out)
    assert len(listed) == 13
    assert list(file.parent.iterdir()) == [file]
    assert main(["cut", str(file), "--out", str(tmp_path / "cut"), "--pattern", "{note} {number}"]) == 0
    with (tmp_path / "cut" / "strokes.csv").open() as text:
        rows = list(csv.DictReader(text))
    assert (rows[0]["file"], rows[-1]["file"]) == ("E2 1.flac", "")


@pytest.mark.parametrize(("pattern", "message"), [
    ("{note}", "names 3 strokes"), ("{note.__class__}{number}", "no fields but"), ("{number", "no fields but"),
    ("../{number}", "cannot be a file name"), ("", "cannot be a file name"), ("{number}\n", "cannot be a file name"),
    ("\udcff{number}", "cannot be a file name"), ("ü" * 130 + "{number}", "cannot be a file name"),
])  # fmt: skip
def test_bad_patterns_write_nothing(session, tmp_path, pattern, message):
    """Three strokes of one key."""
    samples, truth = session
    short = tmp_path / "short.wav"
    soundfile.write(short, samples[:, : truth[3][0] - RATE // 5].T, RATE, subtype="PCM_24")
    with pytest.raises(SetupError, match=message):
        cut_recording(short, tmp_path / "cut", pattern)
    assert not (tmp_path / "cut").exists()


@pytest.mark.parametrize(("subtype", "gain"), [("FLOAT", 8.0), ("DOUBLE", 8.0), ("PCM_32", 1.0), ("PCM_16", 1.0)])
def test_every_kind_of_sample_is_kept(session, tmp_path, subtype, gain):
    """Floats may exceed full scale."""
    samples, truth = session
    path = tmp_path / "long.wav"
    soundfile.write(path, gain * samples[:, : truth[1][0]].T, RATE, subtype=subtype)
    whole, _ = soundfile.read(path, always_2d=True)
    (stroke,) = (stroke for stroke in cut_recording(path, tmp_path / "cut") if stroke.file)
    part, _ = soundfile.read(tmp_path / "cut" / stroke.file, always_2d=True)
    end = round(stroke.end_s * RATE)
    assert np.array_equal(part, whole[end - len(part) : end])
    assert soundfile.info(tmp_path / "cut" / stroke.file).subtype == subtype


def test_a_recording_may_last_longer_than_a_note(session, tmp_path):
    samples, truth = session
    sound = np.zeros(610 * RATE)
    sound[: truth[1][0]] = samples[0, : truth[1][0]]
    soundfile.write(tmp_path / "long.flac", sound[::4], RATE // 4)
    assert any(stroke.note == "E2" for stroke in cut_recording(tmp_path / "long.flac", None))


def test_bad_recordings_are_refused(tmp_path):
    text, noise, nan = tmp_path / "text.wav", tmp_path / "noise.wav", tmp_path / "nan.wav"
    soundfile.write(nan, np.r_[0.1, np.nan, np.zeros(RATE)], RATE, subtype="FLOAT")
    text.write_text("no sound")
    soundfile.write(noise, 0.1 * np.random.default_rng(0).normal(size=3 * RATE), RATE)
    for path in (text, noise, nan, tmp_path / "missing.wav"):
        with pytest.raises(RecordingError, match=path.name):
            cut_recording(path, tmp_path / "cut")
    assert not (tmp_path / "cut").exists()
    assert main(["cut", str(noise)]) == 1


def test_the_original_is_never_replaced(session, tmp_path):
    path = tmp_path / "E2-L3.flac"
    soundfile.write(path, session[0].T, RATE, subtype="PCM_24")
    with pytest.raises(SetupError, match="would be replaced"):
        cut_recording(path, tmp_path, force=True)
