"""Keys, velocity ranges and samples of an SFZ instrument, as rows of a manifest.

A sample belongs to the key at which it was recorded, `pitch_keycenter`, independent of the range of its regions. A
region is used only if a key struck with all pedals up starts it. Other regions are left out and counted by reason. No
single region makes a library fail.
"""

from __future__ import annotations

import hashlib
import os
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import NamedTuple

from ..analysis.note_names import midi_to_note, note_to_midi
from ..analysis.pitch import check_pitch, find_pitch
from ..analysis.spectrum import spectrum
from ..conversions import hertz_of, midi_of
from ..errors import AnalysisError, PianofitError, SetupError
from ..io.files import printable, read_file
from ..recording.recording import MAX_BYTES, load_recording
from .manifest import MAX_LISTED, MAX_RECORDINGS, Row
from .paths import find_file
from .root_note import root_note
from .sfz_opcodes import unrecognised_opcodes
from .sfz_text import SfzText, regions

__all__ = ["sfz_rows"]

DEFAULT_ROOT = 60  # MIDI number: default root note of a region in the SFZ format
DEFAULT_ROOT_NAME = midi_to_note(DEFAULT_ROOT)
MAX_PARTIAL_HZ = 12_000.0  # Hz: highest partial used to find the pitch of a sample, as in an analysis
PEDALS = (64, 66, 67)  # controllers: sustain, sostenuto, una corda
KEY_TRIGGERS = ("attack", "first", "legato")  # triggers by a pressed key
# Opcodes that select among the regions of a key. One stroke starts all regions in which they are equal, as far as
# controllers allow it.
_SELECTOR = re.compile(r"(?:lo|hi)(?:key|vel|rand)|key|seq_\w+|sw_\w+|xf\w+")
_CONTROLLER_START = re.compile(r"(?:on|start)_(?:lo|hi)(?:hd)?cc\d+")
_INTEGER = re.compile(r"(-?\d{1,3})(?:\.0*)?", re.ASCII)

# Why a region is left out.
NO_SAMPLE = "without a recorded sample"
BY_CONTROLLER = "that only a controller starts"
ON_RELEASE = "on release"
PEDAL_DOWN = "with a pedal down"
EMPTY_RANGE = "whose range of keys or velocities is empty"
NO_NOTE = "whose root note is not that of a piano key"


class _Sample(NamedTuple):
    """The sample of a region."""

    number: int  # of the region
    file: str  # relative to the SFZ file, with slashes
    root: int  # MIDI number
    layer: str


@dataclass
class _Library:
    """Content of an SFZ file."""

    source: Path
    root: Path  # resolved; all files must lie in it
    left_out: Counter[str] = field(default_factory=Counter)  # regions by reason
    opcodes: set[str] = field(default_factory=set)
    switches: set[str] = field(default_factory=set)  # keys that choose an articulation
    samples: dict[str, dict[int, _Sample]] = field(default_factory=dict)  # by file and root note
    at_once: dict[tuple, set[str]] = field(default_factory=dict)  # files that one stroke starts, by note and choice
    rootless: list[str] = field(default_factory=list)  # files without the root note that their region refers to


def sfz_rows(source: Path, root: Path, transpose: int = 0) -> tuple[list[Row], list[str]]:
    """Rows of an SFZ file, one for each sample, and remarks on regions and samples that are not used.

    Parameters
    ----------
    root : the folder that all files must lie in.
    transpose : semitones that will be added to every note.

    Raises
    ------
    SetupError
        Naming the file, if it cannot be read or if no region can be used.
    """
    text = SfzText(source, root)
    library = _Library(source, text.root)
    for number, region in enumerate(regions(text), 1):
        if reason := _add(library, number, region, transpose):
            library.left_out[reason] += 1
    if not library.samples:
        raise SetupError(f"{printable(source)}: has no region with a sample that a struck key starts"
                         f"{_counts(library.left_out, ' (', ')')}; give another SFZ file")  # fmt: skip
    chosen = [_at_one_root(library, [*roots.values()]) for roots in library.samples.values()]
    distinct, copies = _without_copies(library, chosen)
    kept, thinned = _thinned(distinct)
    recoded = [printable(file.name) for file in text.recoded]
    remarks = [
        *_remarks(library, chosen),
        _listed("copies of another sample of the same key, left out", copies),
        _listed(f"keys with more than {MAX_RECORDINGS} samples, of which {MAX_RECORDINGS} are used", thinned),
        _listed("text that is not UTF-8, read as Windows-1252", recoded),
    ]
    rows = [Row(f"region {s.number}", s.file, midi_to_note(s.root), layer=s.layer) for s in kept]
    return rows, [remark for remark in remarks if remark]


def _add(library: _Library, number: int, region: dict[str, str], transpose: int) -> str:
    """Add the sample of a region to the library, or return the reason why it is left out."""
    library.opcodes |= region.keys()
    if reason := _reason_left_out(region):
        return reason
    path = (region.get("default_path", "") + _unquoted(region["sample"])).replace("\\", "/")
    file = os.path.normpath(path.lstrip("/"))  # all paths are relative in SFZ
    note = _root(library, region, file)
    if note is None or not _is_piano_note(note + transpose):
        return NO_NOTE
    library.switches |= {region["sw_last"]} if "sw_last" in region else set()
    softest, hardest = _integer(region, "lovel", 1), _integer(region, "hivel", 127)
    sample = _Sample(number, file, note, f"v{softest:03d}-{hardest:03d} {PurePosixPath(file).with_suffix('')}")
    choice = tuple(sorted(item for item in region.items() if _SELECTOR.fullmatch(item[0])))
    library.at_once.setdefault((note, choice), set()).add(file)
    roots = library.samples.setdefault(file, {})
    # The same sample in several regions is one recording.
    roots[note] = min(roots.get(note, sample), sample, key=lambda s: s.layer)
    return ""


def _without_copies(library: _Library, samples: Sequence[_Sample]) -> tuple[list[_Sample], list[str]]:
    """Samples without copies of an earlier sample of the same key, and the names of the copies."""
    kept: dict[tuple[int, object], _Sample] = {}
    copies: list[str] = []
    sizes = Counter((s.root, _size(library, s.file)) for s in samples)
    for s in samples:
        size = _size(library, s.file)
        # Only files of one size can be equal. A file that cannot be read is reported with all other rows.
        content = s.file if size < 0 or sizes[s.root, size] == 1 else _digest(library, s.file)
        if kept.setdefault((s.root, content), s) is not s:
            copies.append(printable(s.file))
    return [*kept.values()], copies


def _size(library: _Library, file: str) -> int:
    try:
        return find_file(file, library.source.parent, library.root).stat().st_size
    except (SetupError, OSError):
        return -1


def _digest(library: _Library, file: str) -> bytes:
    path = find_file(file, library.source.parent, library.root)
    return hashlib.sha256(read_file(path, MAX_BYTES, SetupError)).digest()


def _thinned(samples: Sequence[_Sample]) -> tuple[list[_Sample], list[str]]:
    """At most `MAX_RECORDINGS` samples of each key, spread evenly over its layers, and the notes of keys with more."""
    keys: dict[int, list[_Sample]] = {}
    for s in samples:
        keys.setdefault(s.root, []).append(s)
    kept: list[_Sample] = []
    for of_key in keys.values():
        ordered, step = sorted(of_key, key=lambda s: s.layer), max(len(of_key) / MAX_RECORDINGS, 1.0)
        kept += [ordered[int(i * step)] for i in range(min(len(of_key), MAX_RECORDINGS))]
    return sorted(kept, key=lambda s: s.number), [midi_to_note(k) for k, s in keys.items() if len(s) > MAX_RECORDINGS]


def _remarks(library: _Library, chosen: Sequence[_Sample]) -> list[str]:
    """Remarks on the library as a whole. A remark that does not apply is an empty text."""
    several = [
        f"{printable(s.file)} ({' and '.join(map(midi_to_note, roots))}, {midi_to_note(s.root)} used)"
        for s in chosen
        if len(roots := library.samples[s.file]) > 1
    ]
    together = sorted({note for (note, _), files in library.at_once.items() if len(files) > 1})
    return [
        _counts(library.left_out, "left out: "),
        _listed(
            "keys where one stroke starts several samples, by microphones or controllers, which are not separated; "
            "to separate them, write a CSV with a column mic",
            [midi_to_note(note) for note in together],
        ),
        _listed("samples at several root notes", several),
        _listed(
            "samples with pitch_keycenter=sample whose file has no root note; "
            f"key, pitch or {DEFAULT_ROOT_NAME} is used",
            list(dict.fromkeys(library.rootless)),
        ),
        _listed("articulations that are not separated, by key switch", sorted(library.switches))
        if len(library.switches) > 1
        else "",
        _listed("opcodes with an older name, or that SFZ does not define", unrecognised_opcodes(library.opcodes)),
    ]


def _reason_left_out(region: dict[str, str]) -> str:
    """Reason why no key struck with all pedals up starts a region; empty if one does."""
    sample = region.get("sample", "")
    low, high = (_note(region.get(end, region.get("key", ""))) for end in ("lokey", "hikey"))
    if not sample or sample.startswith("*") or region.get("end") == "-1":  # a generator such as *sine; muted
        return NO_SAMPLE
    if region.get("trigger", "attack") not in KEY_TRIGGERS:
        return ON_RELEASE
    if any(map(_CONTROLLER_START.fullmatch, region)) or (high is not None and high < 0):
        return BY_CONTROLLER
    if any(_integer(region, f"locc{pedal}", 0) > 0 for pedal in PEDALS):
        return PEDAL_DOWN
    no_keys = (low or 0) > (127 if high is None else high)
    hardest = _integer(region, "hivel", 127)
    return EMPTY_RANGE if no_keys or hardest < max(_integer(region, "lovel", 1), 1) else ""


def _root(library: _Library, region: dict[str, str], file: str) -> int | None:
    """MIDI number of the key at which a sample was recorded; None if its text is not a note."""
    text = region.get("pitch_keycenter", region.get("key"))
    if text == "sample":
        if (in_file := _root_in_file(library, file)) is not None:
            return in_file
        library.rootless.append(printable(file))
        text = region.get("key")
        if text is None and (midi := _detected_pitch(library, file)) is not None:
            return round(midi)
    if text is None and _integer(region, "pitch_keytrack", 100) == 0 and region.get("lokey") == region.get("hikey"):
        text = region.get("lokey")  # not transposed, on one key
    if text is None:
        return DEFAULT_ROOT
    note = _note(text)
    return (
        None if note is None else note + 12 * _integer(region, "octave_offset", 0) + _integer(region, "note_offset", 0)
    )


def _root_in_file(library: _Library, file: str) -> int | None:
    """MIDI number of the root note in the chunks of a file."""
    try:
        return root_note(find_file(file, library.source.parent, library.root))
    except SetupError:  # a missing file is reported with all other rows
        return None


def _at_one_root(library: _Library, samples: Sequence[_Sample]) -> _Sample:
    """One sample at several root notes, at the root note nearest to its pitch. The first if it has no pitch."""
    midi = _detected_pitch(library, samples[0].file) if len(samples) > 1 else None
    return samples[0] if midi is None else min(samples, key=lambda s: abs(s.root - midi))


def _detected_pitch(library: _Library, file: str) -> float | None:
    """Pitch of a sample as a fractional MIDI number; None if it has none or cannot be read."""
    try:
        recording = load_recording(find_file(file, library.source.parent, library.root))
        sound = recording.samples[recording.onset :]
        top = min(0.45 * recording.rate, MAX_PARTIAL_HZ)
        return midi_of(find_pitch(spectrum(sound, recording.rate, 0.5), top=top, note=None, f0=None)[0])
    except PianofitError:
        return None


def _is_piano_note(midi: int) -> bool:
    try:
        check_pitch(hertz_of(midi), "note")
    except AnalysisError:
        return False
    return 0 <= midi <= 127


def _note(text: str) -> int | None:
    """MIDI number of a number or note name, or -1 for "-1"; None for other texts."""
    if whole := _INTEGER.fullmatch(text):
        return int(whole[1])
    try:
        return note_to_midi(text)
    except AnalysisError:
        return None


def _integer(region: dict[str, str], opcode: str, default: int) -> int:
    whole = _INTEGER.fullmatch(region.get(opcode, ""))
    return int(whole[1]) if whole else default


def _unquoted(text: str) -> str:
    return text[1:-1] if len(text) > 1 and text[0] == text[-1] and text[0] in "\"'" else text


def _counts(counter: Counter[str], before: str, after: str = "") -> str:
    """Number of regions for each reason; empty if there are none."""
    parts = [f"{n} region{'s' * (n > 1)} {reason}" for reason, n in counter.most_common()]
    return before + ", ".join(parts) + after if parts else ""


def _listed(heading: str, names: Sequence[str]) -> str:
    """A heading, the first names, and the number of further ones; empty if there are none."""
    more = f" and {len(names) - MAX_LISTED} more" if len(names) > MAX_LISTED else ""
    return f"{heading}: {', '.join(names[:MAX_LISTED])}{more}" if names else ""
