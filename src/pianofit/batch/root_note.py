"""The root note that an audio file names: in the `smpl` or `inst` chunk of a WAV, or the `INST` chunk of an AIFF.

A FLAC file that was made from a WAV may keep the WAV's chunks in metadata blocks of the application `riff`.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

__all__ = ["root_note"]

MAX_CHUNKS = 1000  # looked at in one file: real files have fewer than 20
HIGHEST = 127  # MIDI number
# Where the root note stands in a chunk's content, and its format: RIFF "smpl" (its unity note), "inst", AIFF "INST".
PLACES = {b"smpl": (12, "<I"), b"inst": (0, "B"), b"INST": (0, "B")}
NEEDED = 16  # bytes of a chunk's content that are read


def root_note(file: Path) -> int | None:
    """MIDI number of the root note in the file's own chunks; None if the file names none or cannot be read."""
    try:
        with file.open("rb") as stream:
            found = dict(reversed([*_chunks(stream)]))
    except OSError:
        return None
    for kind, (at, form) in PLACES.items():
        if len(content := found.get(kind, b"")) >= at + struct.calcsize(form):
            (note,) = struct.unpack_from(form, content, at)
            return int(note) if note <= HIGHEST else None
    return None


def _chunks(stream: BinaryIO) -> Iterator[tuple[bytes, bytes]]:
    """Names of the chunks, and the first bytes of each."""
    head = stream.read(4)
    if head == b"fLaC":
        yield from _flac_chunks(stream)
        return
    if head not in (b"RIFF", b"FORM"):
        return
    form, at = ("<4sI" if head == b"RIFF" else ">4sI"), 12
    for _ in range(MAX_CHUNKS):
        stream.seek(at)
        if len(header := stream.read(8)) < 8:
            return
        kind, size = struct.unpack(form, header)
        yield kind, stream.read(min(size, NEEDED))
        at += 8 + size + size % 2


def _flac_chunks(stream: BinaryIO) -> Iterator[tuple[bytes, bytes]]:
    """The same, from the metadata blocks of a FLAC file."""
    at, last = 4, 0
    for _ in range(MAX_CHUNKS):
        stream.seek(at)
        header = stream.read(4)
        if last or len(header) < 4:
            return
        last, kind, size = header[0] & 0x80, header[0] & 0x7F, int.from_bytes(header[1:], "big")
        content = stream.read(min(size, 12 + NEEDED))
        if kind == 2 and content[:4] == b"riff":  # APPLICATION: a chunk's header and content follow
            yield content[4:8], content[12:]
        at += 4 + size
