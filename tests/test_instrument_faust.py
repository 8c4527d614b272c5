"""An instrument as a Faust program, compiled by the Faust of Debian and rendered by that of DawDreamer."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from instrument_cases import piano_of, rung, true_instrument, true_note
from typer.testing import CliRunner

from pianofit.cli import app
from pianofit.errors import ParameterError
from pianofit.export.faust import tables, write, write_faust
from pianofit.instrument import Instrument
from pianofit.model.modal_response import VelocityGain
from pianofit.playback import PlayOptions, Song, render_song
from pianofit.playback.pedals import PedalRange
from pianofit.schema.dampers import Dampers

RATE = 48_000
OWN, ONE, LAW = 50, 55, 67  # ONE has one measured stroke
BLOCK = 64  # samples
DAMPERS = Dampers(bass=15.0, treble=30.0, slope=0.5)


def piano() -> Instrument:
    """Two keys with modal responses in two channels, and one string model with an output path in one channel."""
    note = rung(OWN)
    assert note.modal_response is not None
    short = note._replace(modal_response=note.modal_response._replace(knock=note.modal_response.knock[:, :2_000]))
    one = rung(ONE)
    assert one.modal_response is not None
    assert one.modal_response.velocity_gain is not None
    part = VelocityGain(np.array([1.0]), one.modal_response.velocity_gain.factor[1:])
    one = one._replace(modal_response=one.modal_response._replace(velocity_gain=part).without_knock())
    notes = {OWN: short, ONE: one, LAW: true_note(LAW)}
    return replace(piano_of(notes, recorded=(OWN, ONE), name='a "piano"\n'), dampers=DAMPERS)


@pytest.fixture(scope="module")
def program(tmp_path_factory) -> tuple[Path, write.FaustSummary]:
    file = tmp_path_factory.mktemp("out") / "piano.dsp"
    return file, write_faust(file, piano(), [OWN, ONE, LAW], licence="CC0")


@pytest.fixture(scope="module")
def player(program) -> Callable[..., np.ndarray]:
    """[(key, MIDI velocity, begin, end)], seconds -> output of the Faust program [channels, samples].

    Pedals are given by their names, as lists of (time, value).
    """
    dawdreamer = pytest.importorskip("dawdreamer")
    engine = dawdreamer.RenderEngine(RATE, BLOCK)
    voice = engine.make_faust_processor("piano")
    voice.num_voices = 4
    voice.dynamic_voices = False  # otherwise a voice ends 30 ms after its release
    assert voice.set_dsp_string(program[0].read_text())
    assert voice.compile()
    engine.load_graph([(voice, [])])

    names = {entry["label"]: entry["name"] for entry in voice.get_parameters_description()}

    def play(
        notes: list[tuple[int, int, float, float]], seconds: float, **pedals: list[tuple[float, int]]
    ) -> np.ndarray:
        voice.clear_midi()
        for label in ("pedal", "sostenuto"):
            values = np.zeros(round(seconds * RATE))
            for at, value in pedals.get(label, []):
                values[round(at * RATE) :] = value
            voice.set_automation(names[label], values)
        for key, velocity, begin, end in notes:
            voice.add_midi_note(key, velocity, begin, end - begin)
        engine.render(seconds)
        return voice.get_audio()

    return play


def levels(sound: np.ndarray, frequencies: np.ndarray) -> np.ndarray:
    """Levels of partials over one second from 0.1 s on, dB [channels, partials]."""
    size = np.abs(np.fft.rfft(sound[:, RATE // 10 : RATE // 10 + RATE] * np.hanning(RATE), axis=-1))
    near = [size[:, round(f) - 3 : round(f) + 4].max(axis=-1) for f in frequencies]
    return 20 * np.log10(np.array(near).T + 1e-12)


@pytest.mark.skipif(shutil.which("faust") is None, reason="needs the faust compiler")
def test_debians_faust_compiles_it(program, tmp_path):
    made = subprocess.run(
        ["faust", "-lang", "cpp", str(program[0]), "-o", str(tmp_path / "piano.cpp")], capture_output=True, text=True
    )
    assert made.returncode == 0, made.stderr
    text = (tmp_path / "piano.cpp").read_text()
    assert "getNumOutputs() {\n\t\treturn 2;" in text
    for control in ("freq", "gain", "gate"):
        assert f'"{control}"' in text
    assert "[nvoices:16]" in text


@pytest.mark.parametrize("velocity", [1, 25, 64, 127])
@pytest.mark.parametrize("key", [OWN, ONE, LAW])
def test_every_partial_has_renders_level(program, player, key, velocity):
    """Partials within 60 dB of the strongest agree within 0.1 dB in every channel.

    Velocity 64 is between two tabulated velocities. Velocities 1 and 127 are outside the measured strokes of the
    velocity gain. One key has only one measured stroke.
    """
    gain = 10 ** (program[1].gain_db / 20)
    note = piano().note(key, velocity)
    expected = gain * np.atleast_2d(note.render(seconds=1.5, rate=RATE, mono=False)) * np.ones((2, 1))
    found = player([(key, velocity, 0.0, 1.9)], 2.0)
    late = 0 if key != LAW else round(0.012 * RATE)
    frequencies = note.frequencies(40 if key == LAW else 10)
    frequencies = frequencies[frequencies < 20_000]
    a, b = levels(expected, frequencies), levels(found[:, late:], frequencies)
    strong = a > a.max() - 60
    assert strong.sum() >= (10 if velocity > 1 else 6)
    assert np.abs(b - a)[strong].max() < 0.1
    assert np.mean((found[:, late : late + RATE] - expected[:, :RATE]) ** 2) < 1e-3 * np.mean(expected[:, :RATE] ** 2)


def test_strokes_beyond_those_known_are_beyond(program):
    """The preceding test relies on velocities outside the measured strokes."""
    ringing = piano().keys[OWN].note.modal_response
    assert ringing is not None
    assert ringing.velocity_gain is not None
    slowest, fastest = ringing.velocity_gain.velocity[[0, -1]]
    assert piano().note(OWN, 1).hammer.v_H0 < slowest
    assert piano().note(OWN, 127).hammer.v_H0 > fastest


def added_rates(sound: np.ndarray, held: np.ndarray, begin: float, end: float) -> np.ndarray:
    """Rates at which eight partials of `LAW` decay faster than in a held note, 1/s, each over windows of 40 ms."""
    time = np.arange(round(0.04 * RATE)) / RATE
    probe = np.hanning(len(time)) * np.exp(-2j * np.pi * np.outer(partials(), time))
    level = [np.abs(probe @ x[round(t * RATE) :][: len(time)]) for t in (begin, end) for x in (sound, held)]
    return np.log(level[0] / level[1] * level[3] / level[2]) / (end - begin)


def partials() -> np.ndarray:
    return true_note(LAW).frequencies(8)


@pytest.mark.parametrize("value", [0, 30, 50, 63, 64, 127])
def test_every_partial_is_damped_as_in_the_engine(player, value):
    """By the law of the instrument over frequency, times the contact of a half pedal."""
    held = player([(LAW, 90, 0.0, 1.5)], 2.0)[0]
    sound = player([(LAW, 90, 0.0, 0.5)], 2.0, pedal=[(0.0, value)])[0]
    expected = PedalRange().contact(value) * DAMPERS.rates(LAW, partials())
    assert added_rates(sound, held, 0.52, 0.58) == pytest.approx(expected, rel=0.02, abs=0.05)


@pytest.mark.parametrize("held", [0.02, 0.1])
def test_a_short_note_is_as_long_as_in_a_song(program, player, held):
    """Stroke and damper are equally late, so the energy of a short note is that of `render_song`."""
    song = Song({LAW: [(0.0, 90), (held, 0)]}, (), held, 1)
    played = render_song(piano(), song, RATE, options=PlayOptions(resonance=0.0))
    gain = 10 ** ((program[1].gain_db - played.gain_db) / 20)
    found = player([(LAW, 90, 0.0, held)], 1.0)[0]
    assert 10 * np.log10(np.sum(found**2) / np.sum((gain * played.samples[0]) ** 2)) == pytest.approx(0, abs=0.2)


def test_pedals_catch_what_still_rings_and_nothing_clicks(player):
    """The right pedal stops the damper; the middle pedal holds keys that are down, and no others."""
    held = player([(LAW, 90, 0.0, 2.0)], 2.0)[0]
    note, rates = [(LAW, 90, 0.0, 0.5)], DAMPERS.rates(LAW, partials())
    caught = player(note, 2.0, pedal=[(0.56, 127)])[0]
    assert added_rates(caught, held, 0.6, 1.0) == pytest.approx(0 * rates, abs=0.05)
    assert added_rates(caught, held, 0.4, 0.6) * 0.2 == pytest.approx(0.06 * rates, rel=0.05)
    middle = player(note, 2.0, sostenuto=[(0.3, 127), (1.0, 0)])[0]
    assert added_rates(middle, held, 0.5, 0.9) == pytest.approx(0 * rates, abs=0.05)
    assert added_rates(middle, held, 1.02, 1.08) == pytest.approx(rates, rel=0.02)
    late = player([(LAW, 90, 0.1, 0.5)], 2.0, sostenuto=[(0.05, 127)])[0]
    assert added_rates(late, held, 0.52, 0.58) == pytest.approx(rates, rel=0.02)
    # Above the partials, the release adds no energy to that of the stroke.
    high = np.abs(np.fft.rfft(middle[round(0.9 * RATE) : round(1.1 * RATE)] * np.hanning(round(0.2 * RATE))))[4_000:]
    assert high.max() < 1e-3 * np.abs(middle).max()


def test_keys_without_a_damper_are_transposed_from_such_keys(tmp_path):
    write_faust(tmp_path / "a.dsp", true_instrument(), [60, 90, 93])
    text = (tmp_path / "a.dsp").read_text()
    row = [int(x) for x in re.findall(r"row_of_key = waveform\{([\d,]*)", text)[0].split(",")]
    assert [row[key] for key in (59, 74, 76, 89, 90, 91, 92, 93, 108)] == [0, 0, 1, 1, 1, 2, 2, 2, 2]


def test_voices_add_and_other_keys_are_transposed(player):
    alone = [player([(key, 80, 0.2, 0.9)], 1.0) for key in (OWN, LAW)]
    both = player([(OWN, 80, 0.2, 0.9), (LAW, 80, 0.2, 0.9)], 1.0)
    assert np.abs(both - alone[0] - alone[1]).max() < 1e-4 * np.abs(both).max()
    assert np.abs(both[:, : RATE // 5 - 600]).max() < 1e-6
    found = player([(LAW + 2, 80, 0.0, 1.4)], 1.5)
    f1 = true_note(LAW).frequencies(1)[0] * 2 ** (2 / 12)
    size = np.abs(np.fft.rfft(found[0, :RATE] * np.hanning(RATE)))
    assert np.argmax(size[round(f1) - 20 : round(f1) + 21]) - 20 + round(f1) == pytest.approx(f1, abs=1)


def test_a_fast_decay_through_a_slow_path_has_no_gain_without_bounds():
    path, pole = np.exp(-np.arange(20_000) / 2_000), np.array([-4_000.0 + 2e4j, -1.0 + 2e3j])
    gain = tables._gain(path, pole)
    assert np.abs(gain).max() < np.exp(tables.MOST_GROWN) * path.sum()
    exact = 1 / (1 - np.exp(-1 / 2_000 - pole[1] / tables.RATE))
    assert abs(gain[1] / exact - 1) < 1e-3


def test_the_command_writes_one_file_and_says_what_is_a_guess(tmp_path, monkeypatch):
    monkeypatch.setattr("pianofit.instrument.load_instrument", lambda *_: piano())
    words = ["export", "i.json", "--format", "faust", "--keys", "G4", "--out"]
    done = CliRunner().invoke(app, [*words, str(tmp_path / "a.dsp")])
    assert done.exit_code == 0, done.output
    assert "1 key" in done.output
    text = (tmp_path / "a.dsp").read_text()
    assert "declare name \"a 'piano'/n\";" in text
    assert [file.name for file in tmp_path.iterdir()] == ["a.dsp"]
    assert CliRunner().invoke(app, [*words, str(tmp_path / "a.dsp")]).exit_code == 1
    done = CliRunner().invoke(app, [*words, str(tmp_path / "a.dsp"), "--force", "--json"])
    assert json.loads(done.stdout)["unrecorded"] == 1
    for more, message in (
        (["a.cpp"], ".dsp"),
        (["b.dsp", "--velocity-layers", "4", "--sample-format", "wav"], "--velocity-layers 4, --sample-format wav"),
    ):
        refused = CliRunner().invoke(app, [*words, str(tmp_path / more[0]), *more[1:]])
        assert refused.exit_code == 1
        assert message in refused.output


def test_knocks_give_way_where_there_is_no_room(tmp_path, monkeypatch):
    monkeypatch.setattr(write, "MOST_NUMBERS", 8_000)
    slower = write_faust(tmp_path / "a.dsp", piano(), [OWN])
    assert slower.knock_rate is not None
    assert slower.knock_rate < write.KNOCK_RATES[0]
    monkeypatch.setattr(write, "MOST_NUMBERS", 4_000)
    done = write_faust(tmp_path / "a.dsp", piano(), [OWN])
    assert done.knock_rate is None
    assert done.table_entries <= 4_000
    tables = [line for line in (tmp_path / "a.dsp").read_text().splitlines() if "waveform{" in line]
    held = sum(line.count(",") + 1 for line in tables)
    # Further entries: the row of every MIDI key, and the offsets of the rows of each table.
    assert done.table_entries <= held <= done.table_entries + 128 + 4 * len(tables)
    assert not re.search(r"^knock_shape", (tmp_path / "a.dsp").read_text(), re.MULTILINE)
    monkeypatch.setattr(write, "MOST_NUMBERS", 100)
    with pytest.raises(ParameterError, match="fewer --keys"):
        write_faust(tmp_path / "a.dsp", piano(), [OWN])
    with pytest.raises(ParameterError, match="key 20"):
        write_faust(tmp_path / "a.dsp", true_instrument(), [20])
