"""Keys, velocity ranges and samples of an SFZ instrument, as rows of a manifest.

A sample belongs to the key that it was recorded at, `pitch_keycenter`, however far the regions stretch it. A region
counts only if a key that is struck with all pedals up starts it. Other regions are left out, and counted by reason: a
library is not refused for what one region holds.
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
from .manifest import MAX_TAKES, NAMED, Row
from .paths import find_file
from .root_note import root_note
from .sfz_opcodes import not_of_today
from .sfz_text import SfzText, regions

__all__ = ["sfz_rows"]

DEFAULT_ROOT = 60  # MIDI number of the root note of a region that names none, by the format
DEFAULT = midi_to_note(DEFAULT_ROOT)
TOP = 12_000.0  # Hz: highest partial that a sample's pitch is sought by, as in an analysis
PEDALS = (64, 66, 67)  # controllers: sustain, sostenuto, una corda
STRUCK = ("attack", "first", "legato")  # triggers by a key that is pressed
# Opcodes by which the strokes of a key choose among its regions. One stroke starts all regions in which they are equal,
# as far as controllers let it.
_CHOICE = re.compile(r"(?:lo|hi)(?:key|vel|rand)|key|seq_\w+|sw_\w+|xf\w+")
_STARTED = re.compile(r"(?:on|start)_(?:lo|hi)(?:hd)?cc\d+")
_WHOLE = re.compile(r"(-?\d{1,3})(?:\.0*)?", re.ASCII)

# Why a region is left out.
NO_SAMPLE = "without a recorded sample"
BY_CONTROLLER = "that only a controller starts"
ON_RELEASE = "on release"
PEDAL_DOWN = "with a pedal down"
NEVER = "whose range of keys or velocities is empty"
NO_NOTE = "whose root note is not that of a piano key"


class _Sample(NamedTuple):
    """The sample of a region."""

    number: int  # of the region
    file: str  # relative to the SFZ file, with slashes
    root: int  # MIDI number
    layer: str


@dataclass
class _Library:
    """What an SFZ file holds."""

    source: Path
    root: Path  # resolved; all files must lie in it
    left_out: Counter[str] = field(default_factory=Counter)  # regions by reason
    opcodes: set[str] = field(default_factory=set)
    switches: set[str] = field(default_factory=set)  # keys that choose an articulation
    samples: dict[str, dict[int, _Sample]] = field(default_factory=dict)  # by file and root note
    at_once: dict[tuple, set[str]] = field(default_factory=dict)  # files that one stroke starts, by note and choice
    rootless: list[str] = field(default_factory=list)  # files without the root note that the region asks them for


def sfz_rows(source: Path, root: Path, transpose: int = 0) -> tuple[list[Row], list[str]]:
    """Rows of an SFZ file, one for each sample, and remarks on what was left out.

    Parameters
    ----------
    root : the folder that all files must lie in.
    transpose : semitones that will be added to every note.

    Raises
    ------
    SetupError
        Naming the file, if it cannot be read or if no region is left.
    """
    text = SfzText(source, root)
    library = _Library(source, text.root)
    for number, region in enumerate(regions(text), 1):
        if reason := _add(library, number, region, transpose):
            library.left_out[reason] += 1
    if not library.samples:
        raise SetupError(f"{printable(source)}: has no region with a sample that sounds when a key is struck"
                         f"{_counts(library.left_out, ' (', ')')}; give another SFZ file")  # fmt: skip
    chosen = [_at_one_root(library, [*roots.values()]) for roots in library.samples.values()]
    once, copies = _without_copies(library, chosen)
    kept, thinned = _thinned(once)
    recoded = [printable(file.name) for file in text.recoded]
    remarks = [
        *_remarks(library, chosen),
        _listed("copies of another sample of the same key, left out", copies),
        _listed(f"keys with more than {MAX_TAKES} samples, of which as many are used", thinned),
        _listed("text that is not UTF-8, read as Windows-1252", recoded),
    ]
    rows = [Row(f"region {s.number}", s.file, midi_to_note(s.root), layer=s.layer) for s in kept]
    return rows, [remark for remark in remarks if remark]


def _add(library: _Library, number: int, region: dict[str, str], transpose: int) -> str:
    """Add a region's sample to the library, or return why it is left out."""
    library.opcodes |= region.keys()
    if reason := _why_not(region):
        return reason
    path = (region.get("default_path", "") + _unquoted(region["sample"])).replace("\\", "/")
    file = os.path.normpath(path.lstrip("/"))  # all paths are relative in SFZ
    note = _root(library, region, file)
    if note is None or not _of_a_piano(note + transpose):
        return NO_NOTE
    library.switches |= {region["sw_last"]} if "sw_last" in region else set()
    softest, hardest = _whole(region, "lovel", 1), _whole(region, "hivel", 127)
    found = _Sample(number, file, note, f"v{softest:03d}-{hardest:03d} {PurePosixPath(file).with_suffix('')}")
    choice = tuple(sorted(item for item in region.items() if _CHOICE.fullmatch(item[0])))
    library.at_once.setdefault((note, choice), set()).add(file)
    roots = library.samples.setdefault(file, {})
    # The same sample in several regions is one recording.
    roots[note] = min(roots.get(note, found), found, key=lambda s: s.layer)
    return ""


def _without_copies(library: _Library, samples: Sequence[_Sample]) -> tuple[list[_Sample], list[str]]:
    """Samples whose files differ from those of their key before them, and the names of the others."""
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
    """At most `MAX_TAKES` samples of each key, evenly over its layers, and the notes of keys that had more."""
    keys: dict[int, list[_Sample]] = {}
    for s in samples:
        keys.setdefault(s.root, []).append(s)
    kept: list[_Sample] = []
    for found in keys.values():
        ordered, step = sorted(found, key=lambda s: s.layer), max(len(found) / MAX_TAKES, 1.0)
        kept += [ordered[int(i * step)] for i in range(min(len(found), MAX_TAKES))]
    return sorted(kept, key=lambda s: s.number), [midi_to_note(k) for k, s in keys.items() if len(s) > MAX_TAKES]


def _remarks(library: _Library, chosen: Sequence[_Sample]) -> list[str]:
    """What to say of the library as a whole; empty texts for what does not apply."""
    several = [
        f"{printable(s.file)} ({' and '.join(map(midi_to_note, roots))}, {midi_to_note(s.root)} used)"
        for s in chosen
        if len(roots := library.samples[s.file]) > 1
    ]
    together = sorted({note for (note, _), files in library.at_once.items() if len(files) > 1})
    return [
        _counts(library.left_out, "left out: "),
        _listed(
            "keys of which one stroke starts several samples, by microphones or controllers, which are not separated; "
            "a CSV with a column mic separates them",
            [midi_to_note(note) for note in together],
        ),
        _listed("samples at several root notes", several),
        _listed(
            f"samples that do not name the root note that pitch_keycenter=sample asks for; key, pitch or {DEFAULT} "
            "is used",
            list(dict.fromkeys(library.rootless)),
        ),
        _listed("articulations that are not separated, by key switch", sorted(library.switches))
        if len(library.switches) > 1
        else "",
        _listed("opcodes with an older name, or that SFZ does not define", not_of_today(library.opcodes)),
    ]


def _why_not(region: dict[str, str]) -> str:
    """Why no key that is struck with all pedals up starts a region; empty if one does."""
    sample = region.get("sample", "")
    low, high = (_note(region.get(end, region.get("key", ""))) for end in ("lokey", "hikey"))
    if not sample or sample.startswith("*") or region.get("end") == "-1":  # a generator such as *sine; muted
        return NO_SAMPLE
    if region.get("trigger", "attack") not in STRUCK:
        return ON_RELEASE
    if any(map(_STARTED.fullmatch, region)) or (high is not None and high < 0):
        return BY_CONTROLLER
    if any(_whole(region, f"locc{pedal}", 0) > 0 for pedal in PEDALS):
        return PEDAL_DOWN
    keys = (low or 0) > (127 if high is None else high)
    hardest = _whole(region, "hivel", 127)
    return NEVER if keys or hardest < max(_whole(region, "lovel", 1), 1) else ""


def _root(library: _Library, region: dict[str, str], file: str) -> int | None:
    """MIDI number of the key that a sample was recorded at; None if the text for it is not a note."""
    text = region.get("pitch_keycenter", region.get("key"))
    if text == "sample":
        if (named := _named_by(library, file)) is not None:
            return named
        library.rootless.append(printable(file))
        text = region.get("key")
        if text is None and (midi := _by_pitch(library, file)) is not None:
            return round(midi)
    if text is None and _whole(region, "pitch_keytrack", 100) == 0 and region.get("lokey") == region.get("hikey"):
        text = region.get("lokey")  # not transposed, on one key
    if text is None:
        return DEFAULT_ROOT
    note = _note(text)
    return None if note is None else note + 12 * _whole(region, "octave_offset", 0) + _whole(region, "note_offset", 0)


def _named_by(library: _Library, file: str) -> int | None:
    """MIDI number of the root note that a file names."""
    try:
        return root_note(find_file(file, library.source.parent, library.root))
    except SetupError:  # a missing file is reported with all other rows
        return None


def _at_one_root(library: _Library, found: Sequence[_Sample]) -> _Sample:
    """Of one sample at several root notes: at the one nearest to its pitch, or the first if no pitch is found."""
    midi = _by_pitch(library, found[0].file) if len(found) > 1 else None
    return found[0] if midi is None else min(found, key=lambda s: abs(s.root - midi))


def _by_pitch(library: _Library, file: str) -> float | None:
    """MIDI number, with its fraction, of the pitch of a sample; None if it has none or cannot be read."""
    try:
        recording = load_recording(find_file(file, library.source.parent, library.root))
        sound = recording.samples[recording.onset :]
        top = min(0.45 * recording.rate, TOP)
        return midi_of(find_pitch(spectrum(sound, recording.rate, 0.5), top=top, note=None, f0=None)[0])
    except PianofitError:
        return None


def _of_a_piano(midi: int) -> bool:
    try:
        check_pitch(hertz_of(midi), "note")
    except AnalysisError:
        return False
    return 0 <= midi <= 127


def _note(text: str) -> int | None:
    """MIDI number, -1 included, of a number or a note name; None for other texts."""
    if whole := _WHOLE.fullmatch(text):
        return int(whole[1])
    try:
        return note_to_midi(text)
    except AnalysisError:
        return None


def _whole(region: dict[str, str], opcode: str, default: int) -> int:
    whole = _WHOLE.fullmatch(region.get(opcode, ""))
    return int(whole[1]) if whole else default


def _unquoted(text: str) -> str:
    return text[1:-1] if len(text) > 1 and text[0] == text[-1] and text[0] in "\"'" else text


def _counts(counter: Counter[str], before: str, after: str = "") -> str:
    """How many regions there are for each reason; empty without any."""
    parts = [f"{n} region{'s' * (n > 1)} {reason}" for reason, n in counter.most_common()]
    return before + ", ".join(parts) + after if parts else ""


def _listed(what: str, names: Sequence[str]) -> str:
    """What there is, how often, and the first names; empty without any."""
    more = f" and {len(names) - NAMED} more" if len(names) > NAMED else ""
    return f"{what}: {', '.join(names[:NAMED])}{more}" if names else ""
