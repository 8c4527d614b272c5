"""Labelled synthetic notes: independent of processes and interruptions, equal to their labels, from the priors."""

from __future__ import annotations

import csv
import json
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import soundfile
from instrument_cases import ERRORS, fit_document, piano_of, rung, true_note, write_fit
from typer.testing import CliRunner, Result

import pianofit
from pianofit import NoteOptions, OutputError, ParameterError, note_from_labels, notes, write_dataset
from pianofit.cli import app
from pianofit.conversions import midi_of
from pianofit.dataset.labelled_note import BLOCK
from pianofit.dataset.random_notes import PATH_FREQUENCIES, NotePrior, draw_path
from pianofit.dataset.source import load_source
from pianofit.excitation import hammer
from pianofit.inference import priors
from pianofit.instrument import write_instrument
from pianofit.io.files import PEAK_LIMIT
from pianofit.literature import reference_compression, typical
from pianofit.model.simulate import simulate
from pianofit.parameters import PARAMETERS

# Few modes and short sounds, so that blocks take a second.
SMALL = NoteOptions(keys=("C5", "C6"), seconds=0.02)


def run(*words: object) -> Result:
    return CliRunner().invoke(app, [str(word) for word in words])


def files(folder: Path) -> dict[str, bytes]:
    return {str(f.relative_to(folder)): f.read_bytes() for f in folder.rglob("*") if f.is_file() and f.name != ".lock"}


def rows(folder: Path) -> list[dict[str, str]]:
    with (folder / "notes.csv").open(encoding="utf-8", newline="") as table:
        return list(csv.DictReader(table))


def test_a_note_depends_on_its_seed_and_number_only():
    few, more = list(notes(3, seed=4, options=SMALL)), list(notes(9, seed=4, options=SMALL))
    for one, other in zip(few, more, strict=False):
        assert one.labels == other.labels
        assert np.abs(one.samples - other.samples).max() < 1e-12
    assert few[0].labels != next(notes(1, seed=5, options=SMALL)).labels
    noisy = NoteOptions(keys=SMALL.keys, seconds=SMALL.seconds, path=True, noise_db=50.0)
    for one, other in zip(few, notes(3, seed=4, options=noisy), strict=True):  # options that only add to the sound
        assert one.note.string == other.note.string
        assert one.note.hammer == other.note.hammer


def test_processes_interruptions_and_extensions_do_not_change_a_data_set(tmp_path):
    """The reference is one run in one process; another run is interrupted, extended, and goes on in two processes."""
    count = 2 * BLOCK + 20
    write_dataset(tmp_path / "whole", count, seed=2, options=SMALL, progress=False)

    class StoppedError(Exception):
        pass

    def interrupt(_: str, done: float) -> None:
        if done > 0:
            raise StoppedError

    parts = tmp_path / "parts"
    with pytest.raises(StoppedError):
        write_dataset(parts, BLOCK + 5, seed=2, options=SMALL, progress=interrupt)
    assert not (parts / "notes.csv").exists()
    (parts / "blocks" / ".00001").mkdir()  # a block that was being written
    (parts / "blocks" / ".00001" / "0000512.flac").write_bytes(b"half")
    resumed = write_dataset(parts, BLOCK + 5, seed=2, options=SMALL, progress=False)
    assert resumed.made == 5
    extended = write_dataset(parts, count, seed=2, options=SMALL, processes=2, progress=False)
    assert extended.made == count - BLOCK
    assert files(parts) == files(tmp_path / "whole")
    assert write_dataset(parts, count, seed=2, options=SMALL, progress=False).made == 0
    (parts / "blocks" / ".DS_Store").touch()  # of a file manager
    (parts / "blocks" / "00002" / f"{2 * BLOCK:07}.flac").unlink()
    assert write_dataset(parts, count, seed=2, options=SMALL, progress=False).made == count - 2 * BLOCK
    (parts / "blocks" / ".DS_Store").unlink()
    assert files(parts) == files(tmp_path / "whole")


@pytest.mark.parametrize("form", ["flac", "wav", "npz"])
def test_labels_match_the_sounds(form, tmp_path):
    options = NoteOptions(seconds=0.3, layers=2, path=True)
    write_dataset(tmp_path, 6, seed=3, options=options, format=form, progress=False)
    step = {"flac": 2.0**-23, "wav": 2.0**-24, "npz": 2.0**-24}[form]
    table = rows(tmp_path)
    assert len(table) == 12
    for i, row in enumerate(table):
        if form == "npz":
            stored = np.load(tmp_path / row["file"])
            sound, rate = stored["samples"][i], int(stored["rate"])
            assert (stored["number"][i], stored["layer"][i]) == (int(row["number"]), int(row["layer"]))
        else:
            sound, rate = soundfile.read(tmp_path / row["file"])
        again = note_from_labels(row).render(seconds=0.3, rate=rate)
        assert np.abs(sound - again).max() <= step


def test_the_schema_describes_every_column(tmp_path):
    write_dataset(tmp_path, 2, seed=3, options=NoteOptions(keys=("C5", "C6"), seconds=0.02, path=True), progress=False)
    schema = json.loads((tmp_path / "dataset.json").read_text())
    assert [column["name"] for column in schema["columns"]] == list(rows(tmp_path)[0])
    assert all(column["meaning"] for column in schema["columns"])
    units = {column["name"]: column["unit"] for column in schema["columns"]}
    assert {name: units[name] for name in PARAMETERS} == {name: own.unit for name, own in PARAMETERS.items()}
    assert schema["path_frequencies_hz"] == pytest.approx(PATH_FREQUENCIES.tolist())
    assert (schema["seed"], schema["count"], schema["options"]["keys"]) == (3, 2, ["C5", "C6"])


def test_a_fit_that_was_replaced_is_read_again(tmp_path):
    place = tmp_path / "instrument.json"
    pitch = []
    for midi in (60, 67):
        write_instrument(place, piano_of({midi: true_note(midi)}))
        made = next(notes(1, options=NoteOptions(around=str(tmp_path), seconds=0.02)))
        pitch.append(made.labels["f0"])
    assert pitch[1] > 1.3 * pitch[0]


def test_layers_differ_in_velocity_and_noise_only():
    made = list(notes(4, options=NoteOptions(keys=("C5", "C6"), seconds=0.1, layers=3, noise_db=(40.0, 60.0))))
    for first in range(0, 12, 3):
        layers = [one.labels for one in made[first : first + 3]]
        speeds = [own.pop("v_H0") for own in layers]
        assert speeds == sorted(speeds)
        assert [own.pop("layer") for own in layers] == [1, 2, 3]
        assert layers[0] == layers[1] == layers[2]
        assert max(np.abs(one.samples).max() for one in made[first : first + 3]) == pytest.approx(PEAK_LIMIT)


def test_noise_has_its_level_and_is_white():
    options = NoteOptions(keys=("C5", "C5"), seconds=0.5, noise_db=30.0)
    seen = []
    for one in notes(3, options=options):
        clean = note_from_labels(one.labels).render(seconds=0.5)
        noise = one.samples - clean
        assert noise.std() == pytest.approx(one.noise_rms, rel=0.02)
        assert 20 * np.log10(clean.std() / one.noise_rms) == pytest.approx(30.0, abs=0.01)
        assert abs(np.corrcoef(noise[1:], noise[:-1])[0, 1]) < 0.03
        seen.append(noise / noise.std())
    assert abs(np.mean(seen[0] * seen[1])) < 0.03


def test_the_parameters_have_the_priors_of_a_fit():
    """Means and standard deviations of logarithms about the literature's key, without 1 % at each end."""
    prior = NotePrior(NoteOptions(), load_source(NoteOptions()), 0)
    drawn = [prior.draw(number) for number in range(2000)]
    keys = np.array([one.midi for one in drawn])
    assert (keys.min(), keys.max()) == (21, 108)
    z, cut = {}, 0.951  # standard deviation of a normal variable between its 1 % and 99 % points
    first = [one.layers[0] for one in drawn]
    z["M_H"] = [np.log(n.hammer.M_H / typical(float(m)).hammer.M_H) / 0.4 for n, m in zip(first, keys, strict=True)]
    z["v_H0"] = [np.log(n.hammer.v_H0 / hammer.VELOCITY) / hammer.VELOCITY_SD for n in first]
    z["x0"] = [np.log(n.geometry.strike_position / n.geometry.length / 0.12) / 0.2 for n in first]
    z["p"] = [np.log(n.hammer.p / typical(float(m)).hammer.p) / 0.2 for n, m in zip(first, keys, strict=True)]
    for name, values in z.items():
        assert abs(np.mean(values)) < 0.08, name
        assert np.std(values) == pytest.approx(cut, abs=0.06), name
    force = [pianofit.SoftHammer(*n.hammer) for n in first]
    u = [reference_compression(midi_of(float(n.f0))) for n in first]
    force = [h.K_H * (x * x / (x + h.skin)) ** h.p for h, x in zip(force, u, strict=True)]
    assert abs(np.corrcoef(np.log(force) - np.log(keys), z["p"])[0, 1]) < 0.15  # p changes with the force held
    cents = [100 * (midi_of(float(n.f0)) - m) for n, m in zip(first, keys, strict=True)]
    assert 15 < np.std(cents) < 30
    decades = np.log10([float(n.B) for n in first])
    assert decades.min() > -6
    assert decades.max() < -0.5


def test_output_paths_have_the_size_and_length_of_their_prior():
    paths = np.array([draw_path(np.random.default_rng(i)).db for i in range(400)])
    (size, length), tau = priors.LEVEL.median[1:3], priors.PATH[0]
    assert np.median(paths.std(axis=0)) == pytest.approx(np.hypot(size, tau), rel=0.25)
    near, far = (np.mean(paths[:, 10] * paths[:, 10 + n]) / size**2 for n in (1, 12))
    assert near > 0.5
    assert abs(far) < 0.35
    assert 3 * length < 12 / 3  # four octaves are far


def test_a_long_contact_is_rendered_as_alone():
    """A slow and heavy hammer stays on a bass string beyond the first stored steps."""
    it = typical("A0")
    heavy = it.hammer._replace(K_H=it.hammer.K_H / 300, v_H0=0.1)
    light = pianofit.Note(it.string, it.hammer, it.geometry, "velocity", 0.3)
    slow = light._replace(hammer=heavy)
    assert len(simulate(slow.string, slow.hammer, slow.geometry, quantity="velocity").pulse.force) > 1024
    for note, sound in zip((light, slow), pianofit.render_notes([light, slow], seconds=0.3), strict=True):
        alone = note.render(seconds=0.3)
        assert np.abs(sound - alone).max() < 1e-9 * np.abs(alone).max()


def test_notes_are_drawn_around_an_instrument_and_a_fit(tmp_path):
    central = {60: rung(60), 64: rung(64)}
    write_instrument(tmp_path / "instrument.json", piano_of(central))
    options = NoteOptions(seconds=0.2, around=str(tmp_path / "instrument.json"), spread=0.0, modal_response=True)
    for one in notes(4, options=options):
        centre = central[one.midi]
        assert one.note.string == pytest.approx(centre.string)
        assert float(one.note.hammer.M_H) == pytest.approx(float(centre.hammer.M_H))
        again = note_from_labels(one.labels, centre).render(seconds=0.2)
        shift = round(centre.pre_onset_s * one.rate)
        assert one.labels["onset"] == pytest.approx(shift / one.rate)
        assert np.abs(again - one.samples).max() < 1e-6
    fit = write_fit(tmp_path / "fit", 52, fit_document(true_note(52), ERRORS))
    around = NoteOptions(seconds=0.1, around=fit.parent, spread=0.3, path=True)
    for same in (around, replace(around, around=str(fit.parent))):  # a path or a text
        assert write_dataset(tmp_path / "set", 1, options=same, progress=False).sounds == 1
    made = list(notes(6, options=around))
    assert {one.midi for one in made} == {52}
    assert np.ptp([one.labels["M_H"] for one in made]) > 0
    assert all(one.note.path is not None for one in made)


BAD = {
    "--count 0": ["--count", 0],
    "--seed -1": ["--seed", -1],
    "--keys C6-C2": ["--keys", "C6-C2"],
    "--keys H2-C5": ["--keys", "H2-C5"],
    "--keys C2..C6": ["--keys", "C2..C6"],
    "one range": ["--keys", "C4,C6"],
    "--seconds 0.0": ["--seconds", 0],
    "--rate 10": ["--rate", 10],
    "--layers 0": ["--layers", 0],
    "--spread -1.0": ["--spread", -1],
    "--noise 60.0-40.0": ["--noise", "60-40"],
    "--noise 300.0": ["--noise", "300"],
    "--modal-response": ["--modal-response"],
    "--processes 0": ["--processes", 0],
    "no such file": ["--around", "absent.json"],
}


@pytest.mark.parametrize("word", BAD)
def test_a_bad_option_is_one_line_and_writes_nothing(word, tmp_path):
    done = run("dataset", "--out", tmp_path / "out", *BAD[word])
    assert done.exit_code == 1
    assert done.stderr.count("\n") == 1
    assert word in done.stderr
    assert not (tmp_path / "out").exists()


def test_other_folders_and_other_data_sets_are_not_touched(tmp_path):
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.txt").write_text("mine")
    with pytest.raises(OutputError, match="holds no data set"):
        write_dataset(tmp_path / "mine", 2, options=SMALL)
    assert files(tmp_path / "mine") == {"thesis.txt": b"mine"}
    write_dataset(tmp_path / "set", 3, options=SMALL, progress=False)
    before = files(tmp_path / "set")
    for change in ({"seed": 1}, {"format": "wav"}, {"options": NoteOptions(seconds=0.02)}, {"count": 2}):
        given = {"count": 3, "options": SMALL, "progress": False} | change
        with pytest.raises(OutputError, match=r"give|ask"):
            write_dataset(tmp_path / "set", **given)
    assert files(tmp_path / "set") == before
    with pytest.raises(ParameterError, match="column"):
        note_from_labels({"c": "300"})


def test_the_command_reports_what_it_made(tmp_path):
    words = ("--count", 3, "--keys", "C5-C6", "--seconds", 0.02, "--processes", 1)
    done = run("dataset", "--out", tmp_path / "a", *words, "--json")
    assert done.exit_code == 0
    assert {k: v for k, v in json.loads(done.stdout).items() if k != "seconds"} == {
        "folder": str(tmp_path / "a"),
        "notes": 3,
        "sounds": 3,
        "made": 3,
    }
    assert "3 notes were there before" in run("dataset", "--out", tmp_path / "a", *words).stdout


def test_an_interrupted_command_is_one_line_and_goes_on(tmp_path):
    words = ["dataset", "--out", str(tmp_path), "--count", str(2 * BLOCK), "--keys", "C5-C6", "--seconds", "0.02"]
    command = [sys.executable, "-m", "pianofit", *words, "--processes", "2"]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    while not (tmp_path / "dataset.json").exists():
        time.sleep(0.05)
    process.send_signal(signal.SIGINT)
    message = process.communicate()[1]
    assert process.returncode == 130
    assert message.count("\n") == 1
    assert not (tmp_path / "notes.csv").exists()
    assert run(*words, "--processes", 1).exit_code == 0
    assert len(rows(tmp_path)) == 2 * BLOCK


def test_a_contact_grid_is_sufficient_and_not_wasteful():
    for key, speed in (("A0", 0.5), ("C7", 4.0)):
        it = typical(key)
        hammer = it.hammer._replace(v_H0=speed)
        grid = pianofit.contact_grid(it.string, hammer, it.geometry)
        stroke = simulate(it.string, hammer, it.geometry)
        assert grid.rate == pytest.approx(1 / float(stroke.modes.step))
        assert grid.n_modes == len(stroke.modes.pole)
        modes = pianofit.mode_table(it.string, it.geometry, rate=grid.rate, n_modes=grid.n_modes)
        assert pianofit.strike(modes, hammer, steps=grid.steps).contact_ended
        assert not pianofit.strike(modes, hammer, steps=grid.steps - 32, whole=False).contact_ended
