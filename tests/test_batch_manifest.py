"""Keys from manifests and folders. Problems are reported by name before anything starts."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import pytest

from pianofit.batch import Settings, make_job, read_keys
from pianofit.errors import RecordingError, SetupError
from pianofit.setup import Setup


def touch(folder: Path, *names: str) -> None:
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(name.encode())


def manifest(folder: Path, text: str | bytes, name: str = "m.csv") -> Path:
    (folder / name).parent.mkdir(exist_ok=True)
    (folder / name).write_bytes(text if isinstance(text, bytes) else text.encode())
    return folder / name


def shown(keys) -> dict[str, list[str]]:
    return {k.name: [s.file.name for s in k.samples] for k in keys}


def test_rows_of_one_instrument_and_note_are_one_key(tmp_path):
    touch(tmp_path, "a.wav", "b.wav", "c.flac", "d.wav")
    text = "file,note,instrument,layer,v_H0,group,licence\na.wav,F#2,CP 80,p,0.8,close,x\n" \
           "b.wav,Gb2,CP 80,f,2.5,close,x\nc.flac,42,grand,f,,,x\nd.wav,A0,grand,,,,x\n"  # fmt: skip
    keys, remarks = read_keys(manifest(tmp_path, text))
    assert shown(keys) == {"CP-80-Fs2": ["a.wav", "b.wav"], "grand-A0": ["d.wav"], "grand-Fs2": ["c.flac"]}
    assert [(s.velocity, s.group) for s in keys[0].samples] == [(0.8, "close"), (2.5, "close")]
    assert len(remarks) == 1
    assert remarks[0].endswith(": licence")


@pytest.mark.parametrize(
    "text", ["file;note\na.wav;C4\n", "﻿note\tfile\r\nC4\ta.wav\r\n", '"file","note"\n"a.wav","60"']
)
def test_what_a_spreadsheet_writes_is_read(tmp_path, text):
    touch(tmp_path, "a.wav")
    keys, _ = read_keys(manifest(tmp_path, text))
    assert shown(keys) == {"C4": ["a.wav"]}


def test_velocities_and_groups_become_the_setup_of_the_fit(tmp_path):
    touch(tmp_path, "close/C4.wav", "room/C4.wav")
    text = 'file,note,v_H0,group\nclose/C4.wav,C4,1.25,close\nroom/C4.wav,C4,,"a ""b"" 🎹"\n'
    (key,), _ = read_keys(manifest(tmp_path, text))
    job = make_job(key, Settings(setup="[string]\nlength = 0.6\n"))
    (tmp_path / "setup.toml").write_text(job.setup, encoding="utf-8")
    setup = Setup.from_toml(tmp_path / "setup.toml")
    assert setup.length == 0.6
    assert [(t.file, t.v_H0, t.group) for t in setup.recordings] == [
        ("close-C4.wav", 1.25, "close"), ("a _b_ _-C4.wav", None, 'a "b" 🎹')
    ]  # fmt: skip


def test_one_layer_at_two_microphones_is_one_strike(tmp_path):
    touch(tmp_path, *(f"grand-A0-{layer}-{mic}.flac" for layer in ("L2", "L4") for mic in ("close", "decca")),
          "grand-A0-L3-close.flac")  # fmt: skip
    (key,), _ = read_keys(tmp_path, pattern="{instrument}-{note}-{layer}-{mic}.flac")
    assert [(s.group, s.stroke) for s in key.samples] == [
        ("close", "L2"), ("decca", "L2"), ("close", ""), ("close", "L4"), ("decca", "L4"),
    ]  # fmt: skip
    job = make_job(key, Settings())
    (tmp_path / "setup.toml").write_text(job.setup, encoding="utf-8")
    layers = Setup.from_toml(tmp_path / "setup.toml").recordings
    assert [(t.file, t.group, t.stroke) for t in layers][:3] == [
        ("grand-A0-L2-close.flac", "close", "L2"), ("grand-A0-L2-decca.flac", "decca", "L2"),
        ("grand-A0-L3-close.flac", "close", None),
    ]  # fmt: skip
    apart = replace(job, sources=tuple(replace(s, stroke="") for s in job.sources))
    assert apart.hash != job.hash


def test_a_layer_of_one_microphone_is_no_strike_of_another_key(tmp_path):
    touch(tmp_path, "C4-p.wav", "D4-p.wav")
    keys, _ = read_keys(tmp_path, pattern="{note}-{layer}")
    assert [s.stroke for key in keys for s in key.samples] == ["", ""]


def test_a_folder_is_read_by_the_names_of_its_files(tmp_path):
    touch(tmp_path, "cp80-Fs2-FF.flac", "cp80-Fs2-PP.flac", "grand-A0-L2-decca.flac", "grand-A0-L2-close.flac",
          "grand-Bb3-L2.wav", "notes.txt", ".hidden-C4-x.wav", "other.wav")  # fmt: skip
    keys, remarks = read_keys(tmp_path, pattern="{instrument}-{note}-{layer}[-{group}]")
    assert shown(keys) == {
        "cp80-Fs2": ["cp80-Fs2-FF.flac", "cp80-Fs2-PP.flac"],
        "grand-A0": ["grand-A0-L2-close.flac", "grand-A0-L2-decca.flac"],
        "grand-As3": ["grand-Bb3-L2.wav"],
    }
    assert [s.group for s in keys[1].samples] == ["close", "decca"]
    assert remarks == ["recordings that do not fit the pattern: 1, such as other.wav"]


def test_octaves_can_be_counted_otherwise(tmp_path):
    touch(tmp_path, "C3.wav")
    assert shown(read_keys(tmp_path, pattern="{note}", transpose=12)[0]) == {"C4": ["C3.wav"]}
    with pytest.raises(SetupError, match=r"MIDI 148 with --transpose 100"):
        read_keys(tmp_path, pattern="{note}", transpose=100)


@pytest.mark.parametrize("header", ["v_H0", "V_h0", "velocity (m/s)", "Velocity [m/s]", "velocity_m_s", "velocity m/s"])
def test_a_column_with_a_unit_holds_measured_velocities(tmp_path, header):
    touch(tmp_path, "a.wav", "b.wav")
    (key,), remarks = read_keys(manifest(tmp_path, f"file,note,{header}\na.wav,C4,1.25\nb.wav,C4,3\n"))
    assert [s.velocity for s in key.samples] == [1.25, 3.0]
    assert remarks == []


@pytest.mark.parametrize("header", ["velocity", "MIDI velocity", "velocity_midi"])
def test_a_velocity_without_a_unit_is_midis_and_names_the_layer(tmp_path, header):
    """127 and 16 are MIDI velocities. Read as m/s they would be wrong by a factor of 20."""
    touch(tmp_path, "a.wav", "b.wav", "c.wav")
    text = f"file,note,{header},mic\na.wav,C4,16,near\nb.wav,C4,127,near\nc.wav,C4,127,far\n"
    (key,), remarks = read_keys(manifest(tmp_path, text))
    assert [(s.velocity, s.layer, s.stroke) for s in key.samples] == [
        (None, "v016", ""), (None, "v127", "v127"), (None, "v127", "v127")
    ]  # fmt: skip
    assert "v_H0" in remarks[0]
    setup = tmp_path / "setup.toml"
    setup.write_text(make_job(key, Settings()).setup)
    given = Setup.from_toml(setup).recordings
    assert [(entry.v_H0, entry.midi_velocity) for entry in given] == [(None, 16.0), (None, 127.0), (None, 127.0)]


def test_a_velocity_in_a_pattern_is_midis_unless_it_is_called_v_h0(tmp_path):
    touch(tmp_path, "C4-2.wav", "C4-16.wav")
    (key,), remarks = read_keys(tmp_path, pattern="{note}-{velocity}")
    assert [(s.velocity, s.layer) for s in key.samples] == [(None, "v016"), (None, "v002")]
    assert "v_H0" in remarks[0]
    (key,), remarks = read_keys(tmp_path, pattern="{note}-{v_H0}")
    assert ([s.velocity for s in key.samples], remarks) == ([16.0, 2.0], [])


def test_a_fraction_in_a_pattern_is_not_a_midi_velocity(tmp_path):
    touch(tmp_path, "C4-0.8.wav")
    with pytest.raises(SetupError, match="v_H0"):
        read_keys(tmp_path, pattern="{note}-{velocity}")


def test_backslashes_separate_folders(tmp_path):
    touch(tmp_path, "soft/a.wav", "loud/b.wav")
    keys, _ = read_keys(manifest(tmp_path, "file,note\nsoft\\a.wav,C4\n.\\loud\\b.wav,C4\n"))
    assert shown(keys) == {"C4": ["b.wav", "a.wav"]}
    with pytest.raises(SetupError, match="leads out of"):
        read_keys(manifest(tmp_path / "soft", "file,note\n..\\loud\\b.wav,C4\n"))


@pytest.mark.skipif(os.name == "nt", reason="a backslash always separates folders there")
def test_a_backslash_that_is_in_a_name_on_the_disk_stays(tmp_path):
    touch(tmp_path, "a\\b.wav", "a/b.wav")
    (key,), _ = read_keys(manifest(tmp_path, "file,note\na\\b.wav,C4\n"))
    assert key.samples[0].file.name == "a\\b.wav"


@pytest.mark.parametrize(
    ("listed", "on_disk"),
    [("samples/a.WAV", "Samples/A.wav"), ("Fl\u00fcgel.wav", "Flu\u0308gel.wav"), ("A.wav", "a.wav")],
)
def test_a_name_that_differs_from_the_disks_in_case_or_accents_has_a_hint(tmp_path, listed, on_disk):
    touch(tmp_path, on_disk)
    if (tmp_path / listed).exists():
        pytest.skip("this disk finds the file by either name")
    with pytest.raises(SetupError, match=f"did you mean {on_disk}"):
        read_keys(manifest(tmp_path, f"file,note\n{listed},C4\n"))


def test_no_folder_outside_the_root_is_listed_for_a_hint(tmp_path):
    touch(tmp_path, "in/x.csv", "Secret.wav")
    with pytest.raises(SetupError) as caught:
        read_keys(manifest(tmp_path / "in", "file,note\n../secret.wav,C4\n"))
    assert "Secret" not in str(caught.value)


HOSTILE = {
    "outside": ("file,note\n../x.wav,C4", r"line 2: \.\./x\.wav leads out of .*--root"),
    "absolute": ("file,note\n/etc/passwd,C4", "line 2: /etc/passwd leads out of"),
    "link": ("file,note\nlink.wav,C4", r"line 2: link\.wav leads out of"),
    "missing": ("file,note\na.wav,C4\nb.wav,C4\nz.wav,C4\ny.wav,D4", r"line 4: z\.wav: no such file; line 5: y\.wav"),
    "folder": ("file,note\n.,C4", "line 2: .: is a folder"),
    "twice": ("file,note\na.wav,C4\n./a.wav,D4", "line 3: ./a.wav is also line 2"),
    "layer-twice": ("file,note,layer\na.wav,C4,p\nb.wav,C4,p", "line 3: C4 has a second 'p'"),
    "strike": ("file,note,layer,mic,v_H0\na.wav,C4,p,x,1\nb.wav,C4,p,y,2", "line 3: C4 'p' has velocity 2 and 1"),
    "slug": ("file,note,instrument\na.wav,C4,A b\nb.wav,C4,A-b", "would share the folder A-b-C4"),
    "note": ("file,note\na.wav,H4", "line 2: note 'H4' is not a note name"),
    "midi": ("file,note\na.wav,128", "line 2: note '128'"),
    "no-piano": ("file,note\na.wav,D9", "line 2: note D9 is outside the range of a piano"),
    "v_H0": ("file,note,v_H0\na.wav,C4,64", "line 2: v_H0 '64' must be a number from 0.01 to 20 m/s"),
    "nan": ("file,note,v_H0\na.wav,C4,nan", "line 2: v_H0 'nan'"),
    "too-fast": (
        "file,note,velocity\na.wav,C4,128",
        "line 2: velocity 128 is a MIDI velocity and must be from 1 to 127",
    ),
    "no-midi": ("file,note,velocity\na.wav,C4,1.25", "line 2: velocity '1.25' .* v_H0"),
    "no-column": ("path,note\na.wav,C4", "the header has no column 'file'"),
    "column-twice": ("file,note,note\na.wav,C4,C4", "column 'note' twice"),
    "cells": ("file,note\na.wav,C4,x", "line 2 has 3 cells, the header 2"),
    "quote": ('file,note\n"a.wav,C4', "line 2: "),
    "empty": ("file,note\n", "no recording"),
    "nothing": ("", "is empty"),
    "latin": ("file,note\nfl\u00fcgel.wav,C4".encode("latin-1"), "byte 0xfc on line 2 is not UTF-8"),
    "utf-16": ("file,note\na.wav,C4".encode("utf-16"), "UTF-16"),
    "zero": (b"file,note\na\0.wav,C4", "zero byte on line 2"),
    "control": ("file,note\na\x1b[31m.wav,C4", r"a\\x1b\[31m\.wav: no such file"),
    "long": (f"file,note\n{'x' * 300}.wav,C4", "no such file|not a usable path"),
    "many": ("file,note\n" + "x.wav,C4\n" * 10_000, "9995 more"),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_a_hostile_manifest_is_refused_by_name(tmp_path, name):
    text, expected = HOSTILE[name]
    (tmp_path / "in").mkdir()
    touch(tmp_path, "x.wav", "in/a.wav", "in/b.wav")
    (tmp_path / "in" / "link.wav").symlink_to(tmp_path / "x.wav")
    with pytest.raises(SetupError, match=expected) as caught:
        read_keys(manifest(tmp_path / "in", text))
    assert str(caught.value).isprintable()
    assert "m.csv" in str(caught.value)


def test_a_larger_root_lets_links_and_parents_in(tmp_path):
    (tmp_path / "in").mkdir()
    touch(tmp_path, "x.wav", "y.wav")
    (tmp_path / "in" / "link.wav").symlink_to(tmp_path / "x.wav")
    keys, _ = read_keys(manifest(tmp_path / "in", "file,note\nlink.wav,C4\n../y.wav,C4"), root=tmp_path)
    assert shown(keys) == {"C4": ["x.wav", "y.wav"]}


def test_ten_thousand_rows_are_read(tmp_path):
    names = [f"{note}{octave}-{i}.wav" for note in "CDEFGAB" for octave in range(1, 8) for i in range(1, 60)]
    touch(tmp_path, *names)
    lines = [f"{n},{n.split('-')[0]},{n.split('-')[1]},i" for n in names]
    more = [f"{i}.wav,C4,,i{i}" for i in range(10_000 - len(lines))]
    touch(tmp_path, *(line.split(",")[0] for line in more))
    keys, _ = read_keys(manifest(tmp_path, "\n".join(["file,note,layer,instrument", *lines, *more])))
    assert sum(len(k.samples) for k in keys) == 10_000


@pytest.mark.parametrize("pattern", ["{layer}", "{note}-{what}", "{note}-{note}", "{note}]", "[[{note}]]", "{note}["])
def test_a_pattern_that_cannot_be_meant(tmp_path, pattern):
    touch(tmp_path, "C4.wav")
    with pytest.raises(SetupError, match="--pattern"):
        read_keys(tmp_path, pattern=pattern)


def test_a_pattern_that_fits_nothing(tmp_path):
    touch(tmp_path, "C4.wav")
    with pytest.raises(SetupError, match=r"C4\.wav.*pattern"):
        read_keys(tmp_path, pattern="{instrument}_{note}")
    with pytest.raises(SetupError, match=r"\.txt"):
        read_keys(manifest(tmp_path, "x", "empty/x.txt").parent)


def test_two_takes_of_one_content_are_refused(tmp_path):
    touch(tmp_path, "a.wav", "b.wav")
    (tmp_path / "b.wav").write_bytes(b"a.wav")
    (key,), _ = read_keys(manifest(tmp_path, "file,note\na.wav,C4\nb.wav,C4"))
    with pytest.raises(RecordingError, match=r"b\.wav and .*a\.wav"):
        make_job(key, Settings())


def test_the_hash_is_of_contents_and_settings_not_of_places(tmp_path):
    def job(folder: str, settings: Settings = Settings(), content: bytes = b"x"):  # noqa: B008
        (tmp_path / folder).mkdir(exist_ok=True)
        (tmp_path / folder / "a.wav").write_bytes(content)
        (key,), _ = read_keys(manifest(tmp_path / folder, "file,note\na.wav,C4"))
        return make_job(key, settings)

    first = job("one")
    assert job("two").hash == first.hash
    assert job("one", content=b"y").hash != first.hash
    assert job("one", Settings(seed=1)).hash != first.hash
    assert replace(first, versions={"pianofit": "0"}).hash != first.hash


def test_roles_are_read_from_a_column_and_only_strokes_enter_the_fit(tmp_path):
    touch(tmp_path, "a.wav", "b.wav", "c.wav", "d.wav")
    text = (
        "file,note,layer,v_H0,role\na.wav,C4,p,1.0,\nb.wav,C4,p,1.0,Damped\n"
        "c.wav,C4,,,release: string silent\nd.wav,C4,f,2.0,note\n"
    )
    (key,), _ = read_keys(manifest(tmp_path, text))
    assert [s.role for s in key.samples] == ["note", "damped", "release", "note"]
    assert not any(s.stroke for s in key.samples)
    job = make_job(key, Settings())
    assert job.setup.count("[[recording]]") == 2
    as_note = replace(key, samples=tuple(replace(s, role="note") for s in key.samples))
    assert make_job(as_note, Settings()).hash != job.hash


@pytest.mark.parametrize(("text", "nearest"), [("relase", "release"), ("damp", "damped"), ("notes", "note")])
def test_an_unknown_role_names_the_nearest_one(tmp_path, text, nearest):
    touch(tmp_path, "a.wav")
    with pytest.raises(SetupError, match=rf"line 2: role '{text}' .* nearest is {nearest}"):
        read_keys(manifest(tmp_path, f"file,note,role\na.wav,C4,{text}\n"))


@pytest.mark.parametrize(
    ("name", "role"),
    [
        ("grand-C4-soft.wav", "note"),
        ("grand-C4-release.wav", "release"),
        ("grand-C4-rel.wav", "release"),
        ("grand-C4-noteoff.wav", "release"),
        ("grand-C4-KeyRelease.wav", "release"),
        ("grand-C4-damped.wav", "damped"),
        ("grand-C4-undamped.wav", "note"),
        ("grand-C4-relaxed.wav", "note"),
    ],
)
def test_words_in_file_names_tell_the_role(tmp_path, name, role):
    touch(tmp_path, "grand-C4-loud.wav", "grand-D4-soft.wav", name)
    keys, _ = read_keys(tmp_path)
    assert {s.file.name: s.role for key in keys for s in key.samples}[name] == role


def test_a_pattern_may_name_the_role(tmp_path):
    touch(tmp_path, "damped/C4.wav", "note/C4.wav")
    (key,), _ = read_keys(tmp_path, pattern="{role}/{note}")
    assert [s.role for s in key.samples] == ["damped", "note"]
