"""Cut a long recording of many strokes into one file a stroke, named by note and layer.

The recording itself is not changed.
"""

import re
from collections import Counter
from collections.abc import Callable
from dataclasses import astuple, dataclass, fields
from pathlib import Path

import numpy as np

from ..analysis.strokes import BEFORE, Stroke, find_strokes
from ..errors import RecordingError, SetupError
from ..io.audio import Longest, decode_file
from ..io.files import LONGEST_STEM, encode_pcm, encode_wav, output_folder, printable, replace_file
from ..io.table_output import write_csv

# Largest recording to cut, bytes, and the longest: two hours of stereo of 24 bits at 48 kHz. Its decoding takes 12 GB,
# 18 bytes a sample.
LARGEST_LONG_RECORDING = 2**31
LONGEST_RECORDING = Longest(7200.0, 7200 * 48_000 * 2, "cut it into parts")
LIST = "strokes.csv"
PATTERN = "{note}-L{layer}"
# Letters that no file name has on every system.
FORBIDDEN = '/\\:*?"<>|'
# Bits of a FLAC that holds samples of these kinds exactly. Other kinds are written as WAV.
FLAC_BITS = {"PCM_16": 16, "PCM_24": 24}


@dataclass(frozen=True)
class CutStroke:
    """One stroke in the list of a cut recording."""

    number: int
    file: str  # empty if it was not written
    start_s: float  # of the onset
    end_s: float
    note: str
    cents: float | None
    loudness_db: float
    layer: int | None  # of its note, from the softest, 1
    doubt: str  # why it was not written


def cut_recording(
    path: Path,
    out: Path | None,
    pattern: str = PATTERN,
    *,
    force: bool = False,
    progress: Callable[[str, float], None] = lambda *_: None,
) -> list[CutStroke]:
    """Cut a long recording at its strokes.

    Parameters
    ----------
    path : recording.
    out : folder for the files and `strokes.csv`; None only lists the strokes.
    pattern : name of a file without its ending, with the fields {note}, {layer} and {number}.
    force : replace the folder.
    progress : called with the name of the step and the finished fraction.

    Returns
    -------
    All strokes. Unsure ones are listed with the reason and not written.

    Raises
    ------
    RecordingError
        If the file cannot be read, or holds no stroke.
    SetupError
        For a pattern with other fields, or that names two strokes alike.
    """
    frames, rate, kind = decode_file(path, LARGEST_LONG_RECORDING, LONGEST_RECORDING)
    progress("listening", 0.0)
    strokes = find_strokes(frames.T, rate)
    if all(stroke.doubt for stroke in strokes):
        raise RecordingError(f"{printable(path)}: no stroke with a pitch was found; give a recording of single notes")
    listed = _listed(strokes, rate, pattern, ".flac" if kind in FLAC_BITS else ".wav")
    if out is None:
        return listed
    if any((out / entry.file).resolve() == path.resolve() for entry in listed if entry.file):
        raise SetupError(f"{printable(path)}: would be replaced by one of its strokes; give another --out or --pattern")
    with output_folder(out, force, LIST) as folder:
        for i, (stroke, entry) in enumerate(zip(strokes, listed, strict=True)):
            if entry.file:
                first = max(stroke.onset - round(BEFORE * rate), 0)
                replace_file(folder / entry.file, _encoded(frames[first : stroke.end].T, rate, kind))
            progress("cutting", (i + 1) / len(strokes))
        write_csv(folder / LIST, [field.name for field in fields(CutStroke)], [astuple(stroke) for stroke in listed])
    return listed


def _encoded(samples: np.ndarray, rate: int, kind: str) -> bytes:
    """Return a file that holds samples of a kind exactly, as the decoder names it. FLAC would clip floats above ±1."""
    if kind in FLAC_BITS:
        return encode_pcm(samples, rate, "flac", FLAC_BITS[kind])
    if kind == "PCM_32":
        return encode_pcm(samples, rate, bits=32)
    return encode_wav(samples, rate, bits=64 if kind == "DOUBLE" else 32)


def _listed(strokes: list[Stroke], rate: int, pattern: str, ending: str) -> list[CutStroke]:
    """Number the strokes, and the layers of each note from the softest."""
    layers: dict[int, int] = {}
    for note in {stroke.note for stroke in strokes if not stroke.doubt}:
        own = [i for i, stroke in enumerate(strokes) if stroke.note == note and not stroke.doubt]
        own.sort(key=lambda i: strokes[i].loudness_db)
        layers |= {i: layer for layer, i in enumerate(own, start=1)}
    listed = [
        CutStroke(
            i + 1,
            _named(pattern, stroke.note, layers[i], i + 1) + ending if i in layers else "",
            round(stroke.onset / rate, 6),
            round(stroke.end / rate, 6),
            stroke.note,
            None if np.isnan(stroke.cents) else round(stroke.cents, 1),
            round(stroke.loudness_db, 1),
            layers.get(i),
            stroke.doubt,
        )
        for i, stroke in enumerate(strokes)
    ]
    names = Counter(entry.file for entry in listed if entry.file)
    if twice := [name for name, count in names.items() if count > 1]:
        count = names[twice[0]]
        raise SetupError(f"--pattern {pattern!r} names {count} strokes {twice[0]}; add {{layer}} or {{number}}")
    return listed


def _named(pattern: str, note: str, layer: int, number: int) -> str:
    """Return the name of a file. Fields are replaced as text, so that a pattern is never code."""
    values = {"note": note, "layer": str(layer), "number": str(number)}
    name = re.sub(r"\{([^{}]*)\}", lambda field: values.get(field[1], field[0]), pattern)
    if "{" in name or "}" in name:
        allowed = ", ".join(f"{{{field}}}" for field in values)
        raise SetupError(f"--pattern {pattern!r} must have no fields but {allowed}")
    unusable = not name.isprintable() or name.startswith(".") or any(letter in name for letter in FORBIDDEN)
    if unusable or not 1 <= len(name.encode(errors="replace")) <= LONGEST_STEM:
        wanted = f"1 to {LONGEST_STEM} bytes of printable characters, without {' '.join(FORBIDDEN)}"
        raise SetupError(f"--pattern {pattern!r} makes {name!r}, which cannot be a file name; give {wanted}")
    return name
