"""Root notes in the chunks of audio files, and samples whose region refers to them."""

from __future__ import annotations

import struct

import pytest
from test_batch_sfz import library, tone

from pianofit.batch import read_keys
from pianofit.batch.library_files import root_note
from pianofit.io.files import encode_pcm


def riff(*chunks: tuple[bytes, bytes], big: bool = False) -> bytes:
    order = ">" if big else "<"
    body = b"".join(
        struct.pack(f"{order}4sI", name, len(data)) + data + b"\0" * (len(data) % 2) for name, data in chunks
    )
    kind = b"AIFF" if big else b"WAVE"
    return struct.pack(f"{order}4sI", b"FORM" if big else b"RIFF", 4 + len(body)) + kind + body


SMPL = struct.pack("<9I", 0, 0, 22_676, 54, 0, 0, 0, 0, 0)
WAV = encode_pcm(0.5 * tone(174.6)[None], 22_050, "wav", 16)
FLAC = encode_pcm(0.5 * tone(174.6)[None], 22_050, "flac", 16)
FOREIGN = b"riffsmpl" + struct.pack("<I", len(SMPL)) + SMPL
NAMING = {
    "smpl": (riff((b"fmt ", WAV[20:36]), (b"odd ", b"x"), (b"data", WAV[44:]), (b"smpl", SMPL)), 54),
    "smpl-first": (riff((b"smpl", SMPL), (b"data", WAV[44:])), 54),
    "inst": (riff((b"data", b""), (b"inst", bytes([54, 0, 0, 0, 127, 1, 127]))), 54),
    "aiff": (riff((b"COMM", b"x" * 18), (b"INST", bytes([54, 0, 0, 127, 1, 127] + [0] * 14)), big=True), 54),
    "flac": (FLAC[:4] + struct.pack(">I", 2 << 24 | len(FOREIGN)) + FOREIGN + FLAC[4:], 54),
    "none": (WAV, None),
    "flac-none": (FLAC, None),
    "wild": (riff((b"smpl", b"\xff" * 36)), None),
    "short": (riff((b"smpl", SMPL[:8])), None),
    "cut": (riff((b"smpl", SMPL))[:24], None),
    "long": (b"RIFF\0\0\0\0WAVE" + struct.pack("<4sI", b"data", 2**32 - 1), None),
    "other": (b"OggS" + b"\0" * 50, None),
    "empty": (b"", None),
}


@pytest.mark.parametrize("name", NAMING)
def test_the_root_note_that_a_file_names(tmp_path, name):
    data, note = NAMING[name]
    (tmp_path / "a.wav").write_bytes(data)
    assert root_note(tmp_path / "a.wav") == note


def test_no_file_names_no_root_note(tmp_path):
    assert root_note(tmp_path / "a.wav") is None
    assert root_note(tmp_path) is None


@pytest.mark.parametrize(
    ("data", "opcodes", "note"),
    [
        (NAMING["smpl"][0], "", "Fs3"),  # the root note in the file, although its pitch is F3
        (NAMING["smpl"][0], "octave_offset=1", "Fs3"),  # offsets apply only to notes in the text
        (WAV, "key=50", "D3"),
        (WAV, "", "F3"),  # its pitch
        (b"no sound", "", "C4"),  # the format's default
    ],
)
def test_a_root_note_that_is_left_to_the_sample(tmp_path, data, opcodes, note):
    source = library(tmp_path, f"<region> lokey=50 hikey=55 {opcodes} pitch_keycenter=sample sample=a.wav")
    (tmp_path / "a.wav").write_bytes(data)
    keys, remarks = read_keys(source)
    assert [k.name for k in keys] == [note]
    assert any("a.wav" in remark for remark in remarks) == (note != "Fs3")
