"""Mended recordings: tails against the sounds that were cut off, levels, onsets, added sounds, untouched originals."""

from __future__ import annotations

import csv
import hashlib
import json
from pathlib import Path

import numpy as np
import pytest
import soundfile
from instrument_cases import ERRORS, RATE, fit_document, rung, write_fit

from pianofit.cli.program import main
from pianofit.errors import FitError, ParameterError, SetupError
from pianofit.mend import MendOptions, mend_library
from pianofit.mend.tail import CROSSFADE, Continuation, PartialModes, continue_by_modes, lengthen
from pianofit.schema.decode import builtins_of
from pianofit.schema.modal_response import FittedModalResponse, ModalResponseEntry

ONSET = RATE // 10
CUT = 2.0  # s
KEYS = (48, 50)
VELOCITIES = {"soft": 0.7, "loud": 4.0}


def beating(decay: float = 1.0) -> list[PartialModes]:
    """Partials of two modes, which beat by 0.4 Hz and have a double decay."""
    hz = 220.0 * np.arange(1, 9)
    poles = [
        decay * np.array([-3.0, -0.5]) - 0.1 * k + 2j * np.pi * (f + np.array([0.0, 0.4])) for k, f in enumerate(hz)
    ]
    return [PartialModes(pole, float(f), 220.0) for pole, f in zip(poles, hz, strict=True)]


def sound_of(modes: list[PartialModes], seconds: float, noise: float = 1e-5) -> np.ndarray:
    """A stereo recording of these modes, with a silent begin and noise."""
    random, pole = np.random.default_rng(0), np.concatenate([m.pole for m in modes])
    amplitude = np.exp(2j * np.pi * random.uniform(size=(2, len(pole)))) * random.uniform(0.01, 0.05, (2, len(pole)))
    ringing = np.real(amplitude @ np.exp(pole[:, None] * np.arange(round(seconds * RATE)) / RATE))
    sound = np.concatenate([np.zeros((2, ONSET)), ringing], axis=1)
    return sound + noise * random.normal(size=sound.shape)


def found(sound: np.ndarray, modes: list[PartialModes]) -> Continuation:
    continuation = continue_by_modes(sound, RATE, ONSET, modes)
    assert isinstance(continuation, Continuation), continuation
    return continuation


def level(x: np.ndarray) -> np.ndarray:
    """Level in blocks of 50 ms, dB."""
    block = RATE // 20
    blocks = x[:, : x.shape[1] // block * block].reshape(len(x), -1, block)
    return 10 * np.log10((blocks**2).mean(axis=(0, 2)))


def test_a_cut_recording_gets_its_own_tail_again():
    modes = beating()
    whole = sound_of(modes, 6.0)
    cut = whole[:, : ONSET + round(CUT * RATE)]
    mended = lengthen(cut, RATE, ONSET, 6.0, found(cut, modes))
    kept = cut.shape[1] - round(CROSSFADE * RATE)
    np.testing.assert_array_equal(mended[:, :kept], cut[:, :kept])
    assert mended.shape == whole.shape
    audible = slice(kept, ONSET + round(5.0 * RATE))
    assert np.abs(level(mended[:, audible]) - level(whole[:, audible])).max() < 0.3
    # The waveform itself goes on, so that the joint is inaudible.
    joint = slice(kept, cut.shape[1] + RATE // 5)
    error = np.sqrt(np.mean((mended - whole)[:, joint] ** 2) / np.mean(whole[:, joint] ** 2))
    assert error < 0.01


def test_decays_that_differ_from_those_of_the_key_are_measured():
    cut = sound_of(beating(1.3), CUT)
    whole = sound_of(beating(1.3), 5.0)
    mended = lengthen(cut, RATE, ONSET, 5.0, found(cut, beating()))
    late = slice(ONSET + 3 * RATE, ONSET + 4 * RATE)
    assert np.abs(level(mended[:, late]) - level(whole[:, late])).max() < 1.0


@pytest.mark.parametrize("fade", [0.3, 1.0])
def test_a_fade_takes_little_part_in_the_tail(fade):
    modes = beating()
    whole = sound_of(modes, 6.0)
    faded = sound_of(modes, 4.0)
    count = round(fade * RATE)
    faded[:, -count:] *= np.linspace(1, 0, count)
    continuation = found(faded, modes)
    assert continuation.joint < faded.shape[1] - 0.35 * count
    mended = lengthen(faded, RATE, ONSET, 6.0, continuation)
    late = slice(ONSET + round(3.8 * RATE), ONSET + 5 * RATE)
    assert np.abs(np.mean(level(mended[:, late]) - level(whole[:, late]))) < 1.0


def test_what_does_not_decay_as_the_key_is_left():
    assert isinstance(continue_by_modes(sound_of(beating(0.05), CUT), RATE, ONSET, beating(8.0)), str)
    noise = 0.01 * np.random.default_rng(1).normal(size=(2, 3 * RATE))
    assert isinstance(continue_by_modes(noise, RATE, ONSET, beating()), str)
    assert isinstance(continue_by_modes(sound_of(beating(), 0.3), RATE, ONSET, beating()), str)


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> tuple[Path, Path]:
    """A library without the soft layer of one key and with a loud recording that is too soft, and its fits."""
    base = tmp_path_factory.mktemp("mend")
    library, fits = base / "library", base / "fits"
    library.mkdir()
    random = np.random.default_rng(3)
    for midi in KEYS:
        note, digests, velocities = rung(midi), [], []
        note = note._replace(gain=note.gain / 40)
        for layer, velocity in VELOCITIES.items():
            if (midi, layer) == (50, "soft"):
                continue
            sound = np.pad(note.render(velocity, seconds=CUT, rate=RATE, mono=False), ((0, 0), (RATE // 5, 0)))
            sound = sound * (0.5 if (midi, layer) == (48, "loud") else 1.0) + 1e-6 * random.normal(size=sound.shape)
            file = library / f"grand-{midi}-{layer}.wav"
            soundfile.write(file, sound.T, RATE, subtype="PCM_24")
            digests.append(hashlib.sha256(file.read_bytes()).hexdigest())
            velocities.append(velocity)
        document = fit_document(note, ERRORS, tuple(velocities))
        for recording, digest in zip(document["recordings"], digests, strict=True):
            recording["sha256"] = digest
        assert note.modal_response is not None
        entry = ModalResponseEntry.of(note.modal_response, embed_knock=True)
        document["modal_response"] = builtins_of(FittedModalResponse(response=entry))
        write_fit(fits, midi, document, "grand")
    return library, fits


def rows(folder: Path) -> list[dict[str, str]]:
    with (folder / "changes.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def test_a_library_is_mended(made, tmp_path, capsys):
    library, fits = made
    before = {file: file.read_bytes() for file in library.iterdir()}
    out = tmp_path / "mended"
    arguments = [
        "mend",
        library,
        "--fits",
        fits,
        "--out",
        out,
        "--tails",
        "5",
        "--even-levels",
        "1",
        "--onsets",
        "1",
        "--json",
    ]
    assert main([*map(str, arguments)]) == 0
    printed = json.loads(capsys.readouterr().out)
    listed = rows(out)
    assert [row["file"] for row in listed] == [change["file"] for change in printed]
    assert {file: file.read_bytes() for file in library.iterdir()} == before
    by_kind = {kind: [row for row in listed if row["change"] == kind] for kind in ("tail", "level", "onset", "added")}
    assert len(by_kind["tail"]) == len(before) == len(by_kind["onset"])
    # One layer of a recorded key, and two of each key between the recorded ones.
    assert len(by_kind["added"]) == 1 + 2 * (KEYS[-1] - KEYS[0] + 1 - len(KEYS))
    assert {row["file"] for row in listed} == {file.relative_to(out).as_posix() for file in out.rglob("*.wav")}
    for row in by_kind["tail"]:
        sound, rate = soundfile.read(out / row["file"])
        assert len(sound) / rate == pytest.approx(float(row["after"]), abs=0.06)
    gains = {row["file"]: float(row["after"]) - float(row["before"]) for row in by_kind["level"]}
    # The recording that is too soft by 6 dB gains 6 dB against its other layer.
    assert gains["grand-48-loud.wav"] - gains["grand-48-soft.wav"] == pytest.approx(6.0, abs=1.0)


def test_without_a_change_a_file_is_a_copy(made, tmp_path):
    library, fits = made
    changes, _ = mend_library(library, fits, tmp_path / "out", MendOptions(tails=0.0, fill=False))
    assert {change.change for change in changes} == {"unchanged"}
    for file in library.iterdir():
        assert (tmp_path / "out" / file.name).read_bytes() == file.read_bytes()


def csv_library(folder: Path, made: Path, name: str) -> Path:
    """A manifest of the library in which the soft layer has another name, and C#3 (49) lacks it."""
    soft = "".join(f"library/grand-{midi}-soft.wav,{midi},grand,{name}\n" for midi in KEYS if midi != 50)
    loud = "".join(f"library/grand-{midi}-loud.wav,{midi},grand,loud\n" for midi in KEYS)
    (folder / "m.csv").write_text("file,note,instrument,layer\n" + soft + loud)
    (folder / "library").symlink_to(made)
    return folder / "m.csv"


def test_names_of_layers_are_no_paths(made, tmp_path):
    library, fits = made
    before = {file: file.read_bytes() for file in library.iterdir()}
    manifest = csv_library(tmp_path, library, "/../../library/grand-48-soft")
    options = MendOptions(tails=0.0)
    changes, _ = mend_library(manifest, fits, tmp_path / "out", options, root=library)
    added = [change.file for change in changes if change.change == "added"]
    assert len(added) == len({*added}) > 1
    assert all((tmp_path / "out" / name).parent == tmp_path / "out" / "added" for name in added)
    assert {file: file.read_bytes() for file in library.iterdir()} == before
    other = tmp_path / "other"
    other.mkdir()
    manifest = csv_library(other, library, "loud/")
    with pytest.raises(SetupError, match="would both be"):
        mend_library(manifest, fits, other / "out", options, root=library)
    assert not (other / "out").exists()


def test_notes_that_the_fits_contradict_are_refused(made, tmp_path):
    library, fits = made
    (tmp_path / "library").mkdir()
    for midi in KEYS:
        (tmp_path / "library" / f"grand-{midi - 12}-loud.wav").write_bytes(
            (library / f"grand-{midi}-loud.wav").read_bytes()
        )
    options = MendOptions(tails=0.0, fill=False)
    with pytest.raises(SetupError, match="--transpose"):
        mend_library(tmp_path / "library", fits, None, options)
    changes, _ = mend_library(tmp_path / "library", fits, None, options, transpose=12)
    assert len(changes) == len(KEYS)


def test_a_forced_result_replaces_the_earlier_one(made, tmp_path):
    library, fits = made
    out = tmp_path / "out"
    mend_library(library, fits, out, MendOptions(tails=0.0))
    (out / "mine.txt").write_text("stays")
    assert (out / "added").is_dir()
    mend_library(library, fits, out, MendOptions(tails=0.0, fill=False), force=True)
    kept = {file.name for file in library.iterdir()}
    assert {file.name for file in out.iterdir()} == {*kept, "changes.csv", "mine.txt"}


def test_a_dry_run_writes_nothing(made, tmp_path, capsys):
    library, fits = made
    before = sorted(library.parent.rglob("*"))
    assert main(["mend", str(library), "--fits", str(fits), "--dry-run", "--tails", "5"]) == 0
    assert "grand-48-soft.wav" in capsys.readouterr().out
    assert sorted(library.parent.rglob("*")) == before


@pytest.mark.parametrize(
    ("change", "error"),
    [
        ({"options": MendOptions(even_levels=2.0)}, ParameterError),
        ({"options": MendOptions(tails=-1.0)}, ParameterError),
        ({"prefix": "cello"}, SetupError),
        ({"fits": "nothing"}, FitError),
        ({"out": "library/mended"}, SetupError),
        ({"out": "."}, SetupError),
    ],
)
def test_bad_input_writes_nothing(made, change, error):
    base = made[0].parent
    before = sorted(base.rglob("*"))
    given = {"options": MendOptions(), "fits": "fits", "out": "mended", "prefix": None} | change
    with pytest.raises(error):
        mend_library(
            base / "library", base / given["fits"], base / given["out"], given["options"], prefix=given["prefix"]
        )
    assert sorted(base.rglob("*")) == before


def test_fits_of_other_recordings_are_refused(made, tmp_path):
    _, fits = made
    soundfile.write(tmp_path / "grand-48-soft.wav", sound_of(beating(), 1.0).T, RATE)
    with pytest.raises(FitError):
        mend_library(tmp_path, fits, None, MendOptions())


def test_a_damaged_file_is_copied_and_named(made, tmp_path):
    library, fits = made
    copy = tmp_path / "copy"
    copy.mkdir()
    for file in library.iterdir():
        (copy / file.name).write_bytes(file.read_bytes())
    (copy / "grand-50-loud.wav").write_bytes(b"RIFF no sound")
    changes, _ = mend_library(copy, fits, tmp_path / "out", MendOptions(tails=3.0, fill=False))
    (damaged,) = (change for change in changes if change.file == "grand-50-loud.wav")
    assert damaged.change == "unchanged"
    assert "grand-50-loud.wav" in damaged.detail
    assert (tmp_path / "out" / "grand-50-loud.wav").read_bytes() == b"RIFF no sound"
