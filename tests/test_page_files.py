"""Files of the page's engine, in node: an instrument that is saved, MIDI files that are read and written."""

from __future__ import annotations

import base64
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from instrument_cases import piano_of, uneven_note
from page_cases import RATE, early, error_db, play, ringing_note, run

from pianofit.cli import main
from pianofit.instrument import Instrument, load_instrument
from pianofit.instrument.noise_floor import NoiseFloor
from pianofit.instrument.release_noise import ReleaseNoise
from pianofit.playback import load_song
from pianofit.playback.midi import read_song
from pianofit.schema.bridge import BridgeAdmittance
from pianofit.schema.dampers import Dampers
from pianofit.schema.instrument import LARGEST_INSTRUMENT, KeyValue
from pianofit.web.payload import encode_instrument, encode_note
from pianofit.web.write import PAGE_BYTES, SCRIPT_BYTES, write_playable_page

BLOCKS = 375  # 1 s
WITHIN = -80.0  # dB
VOLUME = 2.0
ALL = {"mass": 1.3, "loss": 2.0}
CHANGES = {
    52: {**ALL, "force": 2.0, "strike": 0.8, "p": 0.0},
    60: {**ALL, "inharmonicity": 1.7, "mu": 0.5},
    64: {"p": 0.0},
}


def piano() -> Instrument:
    """Three keys: one rings by its modes, one by its law, and one was never recorded."""
    notes = {52: ringing_note(52), 60: uneven_note(60), 64: ringing_note(64)}
    values = {"M_H/M_S": KeyValue(1.0, (0.5, 2.0)), "p": KeyValue(2.5, (2.4, 2.7))}
    states = {52: "pulled", 64: "interpolated"}
    bare = piano_of(notes, recorded=(52, 60))
    keys = {midi: replace(key, values=values, state=states.get(midi)) for midi, key in bare.keys.items()}
    return replace(bare, keys=keys)


def saved(instrument: Instrument, changes: dict[int, dict[str, float]], volume: float = VOLUME) -> bytes:
    """The instrument.json that the page writes."""
    document, _ = encode_instrument(instrument, PAGE_BYTES - SCRIPT_BYTES)
    return run([{"instrument": document, "changes": changes, "volume": volume}])[0][0]


def read_saved(data: bytes, folder: Path) -> Instrument:
    (folder / "instrument.json").write_bytes(data)
    return load_instrument(folder)


def test_a_saved_instrument_sounds_as_the_page_plays_it(tmp_path):
    own, changed = piano(), read_saved(saved(piano(), CHANGES), tmp_path)
    events = [[0, "noteOn", 60, 2.5]]
    for midi, key in own.keys.items():
        entry = encode_note(key.note, midi)
        (sound,) = play([{"keys": {60: entry}, "changes": CHANGES[midi], "events": events, "blocks": BLOCKS}])
        expected = changed.keys[midi].note.render(2.5, seconds=1.0, rate=RATE, mono=False)
        assert error_db(VOLUME * sound[:, early(key.note) :], expected) < WITHIN
    again, _ = encode_instrument(changed, PAGE_BYTES)  # a page of what a page saved
    rows = {row["midi"]: row for row in again["keys"]}
    (sound,) = play([{"keys": {60: rows[52]}, "events": events, "blocks": BLOCKS}])
    expected = changed.keys[52].note.render(2.5, seconds=1.0, rate=RATE, mono=False)
    assert error_db(sound[:, early(own.keys[52].note) :], expected) < WITHIN


def test_a_saved_instrument_says_which_keys_were_changed(tmp_path):
    """A slider that is back where it was changes nothing. A changed value loses the interval of the fitted one."""
    found = read_saved(saved(piano(), CHANGES, volume=1.0), tmp_path)
    assert found.changed == [52, 60]
    assert {midi: key.state for midi, key in found.keys.items()} == {52: "changed", 60: "changed", 64: "interpolated"}
    assert found.recorded == [52, 60]
    assert (found.name, found.velocity.at_64, found.velocity.rise) == ("twin", 1.3, 1.5)
    values = {midi: set(key.values) for midi, key in found.keys.items()}
    assert values == {52: {"p"}, 60: {"p"}, 64: {"M_H/M_S", "p"}}
    assert found.keys[64].values["p"] == KeyValue(2.5, (2.4, 2.7))
    changes = {midi: key.changes for midi, key in found.keys.items()}
    assert changes == {52: {k: x for k, x in CHANGES[52].items() if k != "p"}, 60: CHANGES[60], 64: None}
    assert not any("volume" in warning for warning in found.warnings)
    assert found.keys[64].note.hammer.M_H == ringing_note(64).hammer.M_H


def test_a_saved_instrument_keeps_what_is_beyond_its_strings(tmp_path):
    """Bridge, dampers, release noises and noise floor; sounds have the volume of the page."""
    bridge = BridgeAdmittance((100.0, 900.0), (1e-3, 2e-3), (5e-4, 1e-3), (2e-3, 4e-3), "recordings", 12)
    dampers = Dampers(20.0, 50.0, 0.4, source="recordings", keys=(52, 60))
    release = ReleaseNoise({52: np.random.default_rng(1).normal(size=(2, 4000)) / 10}, 44_100)
    noise = NoiseFloor(np.array([100.0, 1000.0]), np.array([[1e-9, 2e-9], [3e-9, 4e-9]]))
    own = replace(piano(), bridge=bridge, dampers=dampers, release=release, noise=noise)
    found = read_saved(saved(own, CHANGES), tmp_path)
    assert (found.bridge, found.dampers) == (bridge, dampers)
    assert found.release is not None
    assert found.release.rate == 44_100
    assert found.release.sounds[52][:, : release.sounds[52].shape[-1]] == pytest.approx(
        VOLUME * release.sounds[52], abs=1e-4
    )
    assert found.noise is not None
    assert found.noise.density == pytest.approx(VOLUME**2 * noise.density)


def test_every_command_takes_a_saved_instrument(tmp_path, capsys):
    file, song = tmp_path / "instrument.json", tmp_path / "song.mid"
    file.write_bytes(saved(piano(), CHANGES))
    song.write_bytes(recorded([on(0.0, 60, 80), off(0.2, 60)]))
    assert main(["page", str(file), "--out", str(tmp_path / "piano.html")]) == 0
    assert "2 were changed by hand" in (tmp_path / "piano.html").read_text()
    assert main(["play", str(file), str(song), "--out", str(tmp_path / "song.wav")]) == 0
    options = ["--keys", "C4", "--velocity-layers", "1", "--seconds", "0.5", "--licence", "CC0"]
    assert main(["export", str(file), *options, "--out", str(tmp_path / "sampler")]) == 0
    assert "changed by hand on the page to play: C4" in (tmp_path / "sampler" / "README.txt").read_text()
    assert load_instrument(tmp_path).changed == [52, 60]
    capsys.readouterr()


def test_a_whole_page_is_saved_within_what_is_read(tmp_path):
    """Knocks take four times as much as on the page, which has whole numbers."""
    text = saved(piano_of({midi: ringing_note(midi) for midi in range(21, 109)}), {})
    assert PAGE_BYTES < len(text) < LARGEST_INSTRUMENT
    assert len(read_saved(text, tmp_path).keys) == 88


def test_the_script_leaves_the_room_for_an_instrument_that_is_counted_on(tmp_path):
    write_playable_page(tmp_path / "piano.html", piano())
    size = len(json.dumps(encode_instrument(piano(), PAGE_BYTES)[0]))
    assert (tmp_path / "piano.html").stat().st_size - size < SCRIPT_BYTES
    assert (encode_instrument(piano(), PAGE_BYTES)[1] or 0.0) < -75  # nearly the best encoding


# MIDI files.


def chunk(name: bytes, *data: int) -> bytes:
    return name + len(data).to_bytes(4, "big") + bytes(data)


def midi_file(*tracks: bytes, form: int = 1, division: int = 480) -> bytes:
    count = sum(track.startswith(b"MTrk") for track in tracks)
    return chunk(b"MThd", 0, form, 0, count, division >> 8, division & 255) + b"".join(tracks)


def track(*data: int) -> bytes:
    return chunk(b"MTrk", *data, 0, 0xFF, 0x2F, 0)


BEAT = (0x83, 0x60)  # 480 ticks, 0.5 s at the tempo that files begin with
DOWN, UP, UP_AND_ON = (0, 0x90, 60, 80), (*BEAT, 0x80, 60, 64), (0, 0x90, 60, 80)
PLAIN = midi_file(track(*DOWN, *UP))


def read(data: bytes) -> dict:
    return json.loads(run([{"song": base64.b64encode(data).decode()}])[0][0])


def on(at: float, midi: int, velocity: float) -> dict:
    return {"at": at, "do": "on", "midi": midi, "velocity": velocity}


def off(at: float, midi: int, velocity: int = 64) -> dict:
    return {"at": at, "do": "off", "midi": midi, "velocity": velocity}


def pedal(at: float, value: int, controller: int = 64) -> dict:
    return {"at": at, "do": "control", "controller": controller, "value": value}


@pytest.mark.parametrize(
    ("data", "remarks"),
    [
        (PLAIN, 0),
        (midi_file(track(*DOWN, *BEAT, 60, 0), form=0), 0),  # running status, a note-on of velocity 0
        (midi_file(track(0, 0xFF, 0x59, 2, 9, 0, *DOWN, *UP)), 0),  # a key signature that does not exist
        (midi_file(chunk(b"XFIH", 1, 2, 3), track(*DOWN, *UP)), 0),
        (b"RIFF" + (8 + len(PLAIN)).to_bytes(4, "little") + b"RMIDdata" + bytes(4) + PLAIN, 0),
        (midi_file(track(0, 0xF0, 3, 1, 2, 0xF7, *DOWN, 0, 0xC0, 5, 0, 0xD0, 5, *UP)), 0),  # sysex, program, pressure
        (midi_file(track(*DOWN, *UP)[:-3]), 1),  # the end is missing
        (midi_file(track(*DOWN, *UP, 0, 0xFF, 1, 0x7F, 65)), 1),  # a text longer than its track
        (midi_file(track(0, 0x99, 40, 9), track(*DOWN, *UP)), 0),  # drums
        (midi_file(track(0, 0xFF, 0x51, 3, 3, 0xD0, 0x90), track(0, 0x90, 60, 80, 0x87, 0x40, 0x80, 60, 0)), 0),
        (midi_file(track(0, 0x90, 60, 80, 25, 0x80, 60, 64), division=0xE732), 0),  # 25 frames of 50 ticks a second
    ],
)
def test_songs_are_read_tolerantly(data, remarks):
    song = read(data)
    seconds = 0.02 if data[13:14] == b"\x32" else 0.5
    velocity = song["events"][-1]["velocity"]
    assert velocity in (0, 64)
    assert song["events"] == [on(0, 60, 80), {**off(0, 60, velocity), "at": pytest.approx(seconds)}]
    assert (song["notes"], song["beyond"], len(song["remarks"])) == (1, 0, remarks)


def test_a_key_is_released_when_all_its_strokes_have_ended():
    on_first = track(*DOWN, *BEAT, 0x90, 60, 80, 0, 0x80, 60, 64, *BEAT, 0x80, 60, 64)
    off_first = track(*DOWN, *UP, *UP_AND_ON, *UP)
    expected = [on(0, 60, 80), on(0.5, 60, 80), off(1.0, 60)]
    assert read(midi_file(on_first))["events"] == expected
    events = read(midi_file(off_first))["events"]
    assert [event for event in events if event["at"] != 0.5 or event["do"] == "on"] == expected
    # Two channels on one key: it goes up with the second.
    both = track(*DOWN, 0, 0x91, 60, 70, *UP, *BEAT, 0x81, 60, 0)
    assert read(midi_file(both))["events"] == [on(0, 60, 80), off(1.0, 60, 0)]


def test_what_a_song_holds_at_its_end_is_let_go_3_s_later():
    held = read(midi_file(track(*DOWN, 0, 0xB0, 64, 127, *BEAT, 0x90, 110, 3)))
    assert held["events"] == [on(0, 60, 80), pedal(0, 127), off(3.5, 60), pedal(3.5, 0)]
    assert (held["notes"], held["beyond"], held["seconds"]) == (1, 1, 0.5)


def test_pedals_and_releases_are_those_of_the_player():
    """Random moves of all controllers in several channels, and release velocities."""
    random = np.random.default_rng(2)
    for _ in range(5):
        data = [0, 0x90, 60, 80]
        for _ in range(200):
            channel, key = int(random.integers(0, 3)), int(random.integers(60, 64))
            value = int(random.integers(0, 128))
            data += [int(random.integers(1, 60))]
            data += [
                [0xB0 + channel, int(random.choice([64, 66, 67, 1])), value],
                [0x90 + channel, key, value],
                [0x80 + channel, key, value],
            ][random.integers(0, 3)]
        file = midi_file(track(*data))
        events, song = read(file)["events"], read_song(file, "song.mid")
        events = [e for e in events if e["at"] <= song.seconds]
        for controller, moves in ((64, song.pedal), (66, song.sostenuto), (67, song.una_corda)):
            own = [
                (e["at"], e["value"]) for e in events if e.get("controller") == controller and e["at"] <= song.seconds
            ]
            assert own == [(pytest.approx(t), value) for t, value in moves]
        for key, moves in song.keys.items():
            own = [e for e in events if e.get("midi") == key and e["at"] <= song.seconds]
            assert [(e["at"], e["velocity"] * (e["do"] == "on")) for e in own] == [
                (pytest.approx(t), v) for t, v in moves
            ]
            ends = [e["velocity"] for e in own if e["do"] == "off"]
            assert ends == [song.release_velocities.get((key, t), 64) for t, velocity in moves if not velocity]


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (b"", "MThd"), (b"MThd\0\0", "header"), (b"ID3 no song", "MThd"), (midi_file(), "no note"),
        (midi_file(track(), track(), form=2), "type 2"), (midi_file(track(), form=7), "type 7"),
        (midi_file(track(*DOWN, *UP), division=0), "0 ticks"), (midi_file(track(0, 0x90, 10, 9)), "no note"),
        (midi_file(track(0x80, 0x80, 0x80, 0x80, 0x80)), "damaged"),
        (midi_file(track(*DOWN, 0xFF, 0xFF, 0xFF, 0x7F, 0x80, 60, 0), division=1), "30 minutes"),
    ],
)  # fmt: skip
def test_a_file_that_is_no_song_is_refused_in_a_line(data, said):
    words = read(data)["error"]
    assert said in words
    assert "\n" not in words


def test_no_damage_of_a_song_is_worse_than_a_line():
    random = np.random.default_rng(5)
    whole = midi_file(track(*DOWN, 0, 0xB0, 64, 127, *UP, *UP_AND_ON, *UP), chunk(b"XFIH", 1, 2), track(*DOWN, *UP))
    jobs = []
    for _ in range(300):
        data = bytearray(whole)
        for at in random.integers(0, len(data), random.integers(1, 5)):
            data[at] = random.integers(256)
        jobs.append({"song": base64.b64encode(data[: random.integers(1, len(data) + 1)]).decode()})
    for (text,) in run(jobs):
        song = json.loads(text)
        assert ("error" in song) or song["notes"] > 0
        times = [event["at"] for event in song.get("events", ())]
        assert times == sorted(times)


def recorded(events: list[dict], longest: float = 600) -> bytes:
    return run([{"record": {"longest": longest, "events": events}}])[0][0]


def test_what_was_played_is_a_midi_file(tmp_path: Path):
    events = [pedal(1.0, 40), pedal(1.1, 100, 66), on(5.0, 60, 80), on(5.25, 64, 1), off(5.5, 60, 30), on(5.5, 60, 127),
              pedal(5.8, 55), pedal(5.9, 70, 67), pedal(6.0, 0),
              {"at": 6.1, "do": "volume", "volume": 2}, off(6.5, 60), {"at": 7.0, "do": "panic"}]  # fmt: skip
    data = recorded(events)
    (tmp_path / "piano.mid").write_bytes(data)
    song = load_song(tmp_path / "piano.mid")
    near = lambda times: pytest.approx(times, abs=1e-3)  # noqa: E731
    assert list(map(tuple, song.pedal)) == [(near(0), 40), (near(0.8), 55), (near(1.0), 0)]
    assert list(map(tuple, song.sostenuto)) == [(near(0), 100)]
    assert list(map(tuple, song.una_corda)) == [(near(0.9), 70)]
    assert next(iter(song.release_velocities.values())) == 30
    assert [tuple(event) for event in song.keys[60]] == [
        (near(0), 80), (near(0.5), 0), (near(0.5), 127), (near(1.5), 0)
    ]  # fmt: skip
    assert [tuple(event) for event in song.keys[64]] == [(near(0.25), 1), (near(2.0), 0)]  # silenced
    own = read(data)
    assert [event["do"] for event in own["events"]].count("on") == own["notes"] == song.notes == 3


def test_a_record_keeps_its_last_minutes_and_the_pedal_of_their_begin():
    events = [pedal(0.0, 90), on(1.0, 50, 60), *(on(100.0 + i, 60 + i, 70) for i in range(3)), off(105.0, 50)]
    song = read_song(recorded(events, longest=30), "piano.mid")
    assert sorted(song.keys) == [60, 61, 62]
    assert [tuple(event) for event in song.pedal] == [(pytest.approx(0, abs=1e-6), 90)]
    assert song.seconds == pytest.approx(2.0, abs=1e-3)
