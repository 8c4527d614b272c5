"""Modal JSON: its players in plain Python and JavaScript against `Note.render_channels`."""

from __future__ import annotations

import importlib.util
import json
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from instrument_cases import piano_of, rung, true_note

from pianofit.cli.program import main
from pianofit.errors import ParameterError
from pianofit.export.modal_json import RATE, VELOCITIES, write_modal_json
from pianofit.instrument import Instrument, write_instrument

EXAMPLES = Path(__file__).parents[1] / "examples" / "players"
SECONDS = 0.4


@pytest.fixture(scope="module")
def grand() -> Instrument:
    """One key with a measured response and one without."""
    return piano_of({64: rung(64), 76: true_note(76)})


@pytest.fixture(scope="module")
def file(grand, tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("modes") / "grand.json"
    done = write_modal_json(path, grand, [64, 76])
    assert (done.keys, done.bytes) == (2, path.stat().st_size)
    return path


def levels(sound: np.ndarray, hz: np.ndarray) -> np.ndarray:
    """Level of each partial after the attack, dB [channels, partials]."""
    part = sound[:, round(0.05 * RATE) :]
    time = np.arange(part.shape[1]) / RATE
    turn = np.hanning(len(time)) * np.exp(-2j * np.pi * np.outer(hz, time))
    return 20 * np.log10(np.abs(part @ turn.T) / len(time) + 1e-30)


def rendered(grand: Instrument, midi: int, velocity: int) -> np.ndarray:
    note = grand.note(midi, velocity)
    return note.render_channels(note.strike(RATE), RATE, round(SECONDS * RATE), round(0.012 * RATE))


def check(sound: np.ndarray, grand: Instrument, midi: int, velocity: int) -> None:
    expected = rendered(grand, midi, velocity)
    hz = grand.note(midi, velocity).frequencies(8)
    mine, theirs = levels(sound, hz), levels(expected, hz)
    strong = theirs > theirs.max() - 50
    assert strong.sum() >= 5
    assert np.abs(mine - theirs)[strong].max() < 0.5
    if velocity in VELOCITIES and grand.keys[midi].note.modal_response is not None:
        attack = slice(0, round(0.03 * RATE))
        assert np.sum((sound - expected)[:, attack] ** 2) < 1e-5 * np.sum(expected[:, attack] ** 2)


@pytest.mark.parametrize(("midi", "velocity"), [(64, 64), (64, 30), (76, 100)])
def test_the_python_player_plays_what_render_plays(file, grand, midi, velocity):
    spec = importlib.util.spec_from_file_location("modal_player", EXAMPLES / "modal_player.py")
    player = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(player)
    check(np.array(player.play(json.loads(file.read_text()), midi, velocity, SECONDS)), grand, midi, velocity)


@pytest.mark.skipif(shutil.which("node") is None, reason="needs node")
@pytest.mark.parametrize(("midi", "velocity"), [(64, 47), (64, 64), (76, 127)])
def test_the_javascript_player_plays_what_render_plays(file, grand, midi, velocity):
    program = f"""
import {{ readFileSync }} from "node:fs";
import {{ play }} from "{(EXAMPLES / "modal_player.js").as_uri()}";
const sound = play(JSON.parse(readFileSync("{file}", "utf8")), {midi}, {velocity}, {SECONDS});
process.stdout.write(JSON.stringify(sound.map((channel) => Array.from(channel))));
"""
    done = subprocess.run(
        ["node", "--input-type=module", "-e", program], capture_output=True, text=True, check=True, timeout=120
    )
    check(np.array(json.loads(done.stdout)), grand, midi, velocity)


def test_the_file_states_strokes_and_physics(file, grand):
    key = json.loads(file.read_text())["keys"][0]
    forces = key["forces"]
    assert [force["midi_velocity"] for force in forces] == list(VELOCITIES)
    contact = [force["contact_ms"] for force in forces]
    assert contact == sorted(contact, reverse=True)  # harder strokes touch the string for a shorter time
    impulse = np.array([sum(force["impulses"]) for force in forces])
    momentum = key["hammer"]["M_H"] * np.array([force["velocity"] for force in forces])
    assert ((impulse > momentum) & (impulse < 2 * momentum)).all()  # the hammer bounces and loses energy
    assert key["string"]["c"] == pytest.approx(float(grand.keys[64].note.string.c))


def test_an_unknown_key_leaves_no_file(grand, tmp_path):
    with pytest.raises(ParameterError, match="key 30 "):
        write_modal_json(tmp_path / "grand.json", grand, [64, 30])
    assert not list(tmp_path.iterdir())


def test_the_command_writes_one_file(grand, tmp_path, capsys):
    write_instrument(tmp_path / "instrument.json", grand)
    command = ["export", str(tmp_path / "instrument.json"), "--format", "modal-json", "--keys", "E4", "--json"]
    assert main([*command, "--out", str(tmp_path / "modes.json")]) == 0
    assert json.loads(capsys.readouterr().out)["keys"] == 1
    assert json.loads((tmp_path / "modes.json").read_text())["keys"][0]["midi"] == 64
    assert main([*command, "--out", str(tmp_path / "modes")]) == 1
    assert main([*command, "--out", str(tmp_path / "other.json"), "--velocity-layers", "4"]) == 1
    assert sorted(p.name for p in tmp_path.iterdir()) == ["instrument.json", "modes.json"]
