"""Files of a library: the rows that list them, their places inside the root folder, and the root notes in them.

Manifests are often written on another system. Their separators may be backslashes, and their names may differ from the
disk in case or in the composition of accents. Separators are translated. Differing names are only suggested.
"""

import functools
import os
import struct
import unicodedata
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO, NamedTuple

from ..errors import SetupError
from ..io.files import printable

MAX_RECORDINGS = 64  # recordings of one key: the memory of a joint fit grows with them
MAX_CHUNKS = 1000  # read in one file: real files have fewer than 20
# Names and formats of the chunks that begin with a root note: its offset is 12 bytes in "smpl" of RIFF, else 0.
ROOT_NOTE_CHUNKS = {b"smpl": "<12xI", b"inst": "B", b"INST": "B"}
CHUNK_BYTES = 16  # bytes read of each chunk


class Row(NamedTuple):
    """One recording as listed, all texts unchanged."""

    where: str  # such as "line 7"
    file: str
    note: str
    instrument: str = ""
    layer: str = ""
    velocity: str = ""  # MIDI velocity, or any other name of a layer
    v_H0: str = ""  # measured hammer velocity, m/s
    group: str = ""
    role: str = ""
    midi_velocity: float | None = None  # middle of the range of an SFZ region


def files_in(folder: Path) -> list[str]:
    """Paths, relative to a folder, of all files in it, sorted. Hidden files and results of fits are excluded."""
    paths = []
    for place, inner, files in os.walk(folder):
        if Path(place) != folder and {"fit.json", "ledger"} & {*inner, *files}:
            inner.clear()
            continue
        inner[:] = [name for name in inner if not name.startswith(".")]
        paths += [(Path(place) / file).relative_to(folder).as_posix() for file in files if not file.startswith(".")]
    return sorted(paths)


def find_file(text: str, base: Path, root: Path) -> Path:
    """Absolute path of the file that a manifest names, after links are followed.

    Parameters
    ----------
    text : name in the manifest. A backslash separates folders, unless the disk has a file of exactly that name.
    base : the folder that the name is relative to.
    root : the folder, resolved, that the file must lie in.

    Raises
    ------
    SetupError
        If the file does not exist, is not a file, or lies outside `root`.
    """
    shown = printable(text)
    try:
        file = (base / text).resolve()
        if "\\" in text and not file.exists():
            file = (base / text.replace("\\", "/")).resolve()
        if not file.is_relative_to(root):
            raise SetupError(f"{shown} leads out of {printable(root)}; allow a larger folder with --root")
        if not file.is_file():
            if file.exists():
                raise SetupError(f"{shown}: is a folder or a device; name a file")
            near = _suggestion(file, base.resolve(), root)
            raise SetupError(f"{shown}: no such file" + (f"; did you mean {printable(near)}?" if near else ""))
        str(file).encode()
    except (OSError, ValueError, RuntimeError):  # a name too long, circular links, a name that is not UTF-8
        raise SetupError(f"{shown} is not a usable path; rename the file") from None
    return file


def _suggestion(file: Path, base: Path, root: Path) -> str:
    """Path on the disk, inside `root`, that differs from `file` only in case or composition; empty if none exists."""
    path = root
    for part in file.relative_to(root).parts:
        if not (path / part).exists():
            part = _names(path, path.stat().st_mtime_ns).get(_folded(part), "") if path.is_dir() else ""
            if not part:
                return ""
        path = path / part
    return (path.relative_to(base) if path.is_relative_to(base) else path).as_posix()


@functools.lru_cache(maxsize=16)
def _names(folder: Path, _changed: int) -> dict[str, str]:
    """Names in a folder by their folded form, cached until the folder changes."""
    return {_folded(entry.name): entry.name for entry in sorted(folder.iterdir(), reverse=True)}


def _folded(name: str) -> str:
    """A name without case and with composed accents."""
    return unicodedata.normalize("NFC", name).casefold()


def root_note(file: Path) -> int | None:
    """MIDI number of the root note in the chunks of a WAV, AIFF or FLAC. None if it has none or cannot be read."""
    try:
        with file.open("rb") as stream:
            chunks = dict(reversed([*_chunks(stream)]))  # the first of each name
    except OSError:
        return None
    for kind, form in ROOT_NOTE_CHUNKS.items():
        if len(content := chunks.get(kind, b"")) >= struct.calcsize(form):
            (note,) = struct.unpack_from(form, content)
            return int(note) if note <= 127 else None
    return None


def _chunks(stream: BinaryIO) -> Iterator[tuple[bytes, bytes]]:
    """Names of the chunks in a file, and the first bytes of each.

    A FLAC file made from a WAV may keep the chunks of the WAV in metadata blocks of the application `riff`.
    """
    head = stream.read(4)
    flac, form, last = head == b"fLaC", "<4sI" if head == b"RIFF" else ">4sI", 0
    if not flac and head not in (b"RIFF", b"FORM"):
        return
    offset, size_of_header = (4, 4) if flac else (12, 8)
    for _ in range(MAX_CHUNKS):
        stream.seek(offset)
        header = stream.read(size_of_header)
        if last or len(header) < size_of_header:
            return
        if flac:
            last, block, size = header[0] & 0x80, header[0] & 0x7F, int.from_bytes(header[1:], "big")
            content = stream.read(min(size, 12 + CHUNK_BYTES))
            if block == 2 and content[:4] == b"riff":  # APPLICATION: name, header and content of a chunk
                yield content[4:8], content[12:]
            offset += 4 + size
        else:
            kind, size = struct.unpack(form, header)
            yield kind, stream.read(min(size, CHUNK_BYTES))
            offset += 8 + size + size % 2
