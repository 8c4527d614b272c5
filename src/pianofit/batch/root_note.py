"""The root note in an audio file: the `smpl` or `inst` chunk of a WAV, or the `INST` chunk of an AIFF.

A FLAC file made from a WAV may keep the chunks of the WAV in metadata blocks of the application `riff`.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

__all__ = ["root_note"]

MAX_CHUNKS = 1000  # read in one file: real files have fewer than 20
MAX_MIDI = 127  # MIDI number
# Offset and format of the root note in a chunk: RIFF "smpl" (its unity note), "inst", AIFF "INST".
ROOT_NOTE_FORMATS = {b"smpl": (12, "<I"), b"inst": (0, "B"), b"INST": (0, "B")}
CHUNK_BYTES = 16  # bytes read of each chunk


def root_note(file: Path) -> int | None:
    """MIDI number of the root note in the chunks of a file. None if it has none or cannot be read."""
    try:
        with file.open("rb") as stream:
            chunks = dict(reversed([*_chunks(stream)]))
    except OSError:
        return None
    for kind, (offset, form) in ROOT_NOTE_FORMATS.items():
        if len(content := chunks.get(kind, b"")) >= offset + struct.calcsize(form):
            (note,) = struct.unpack_from(form, content, offset)
            return int(note) if note <= MAX_MIDI else None
    return None


def _chunks(stream: BinaryIO) -> Iterator[tuple[bytes, bytes]]:
    """Names of the chunks in a file, and the first bytes of each."""
    head = stream.read(4)
    if head == b"fLaC":
        yield from _flac_chunks(stream)
        return
    if head not in (b"RIFF", b"FORM"):
        return
    form, offset = ("<4sI" if head == b"RIFF" else ">4sI"), 12
    for _ in range(MAX_CHUNKS):
        stream.seek(offset)
        if len(header := stream.read(8)) < 8:
            return
        kind, size = struct.unpack(form, header)
        yield kind, stream.read(min(size, CHUNK_BYTES))
        offset += 8 + size + size % 2


def _flac_chunks(stream: BinaryIO) -> Iterator[tuple[bytes, bytes]]:
    """Names and first bytes of the chunks in the metadata blocks of a FLAC file."""
    offset, last = 4, 0
    for _ in range(MAX_CHUNKS):
        stream.seek(offset)
        header = stream.read(4)
        if last or len(header) < 4:
            return
        last, kind, size = header[0] & 0x80, header[0] & 0x7F, int.from_bytes(header[1:], "big")
        content = stream.read(min(size, 12 + CHUNK_BYTES))
        if kind == 2 and content[:4] == b"riff":  # APPLICATION: a chunk's header and content follow
            yield content[4:8], content[12:]
        offset += 4 + size
