"""Keys, velocity ranges and samples of an SFZ instrument, as rows of a manifest.

A sample belongs to the key at which it was recorded, `pitch_keycenter`, independent of the range of its regions. A
region is used only if a key struck with all pedals up starts it. Other regions are left out and counted by reason. No
single region makes a library fail.
"""

import contextlib
import hashlib
import os
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

from ..analysis.note_names import midi_to_note, note_to_midi
from ..analysis.pitch import check_pitch, find_pitch
from ..conversions import hertz_of, midi_of
from ..errors import AnalysisError, PianofitError, SetupError
from ..io.files import printable, read_file
from ..io.number_format import counted, first_of
from ..recording.recording import MAX_BYTES, load_recording
from .library_files import MAX_RECORDINGS, Row, find_file, root_note
from .sfz_text import SfzText, regions, unrecognised_opcodes

DEFAULT_ROOT = 60  # MIDI number: default root note of a region in the SFZ format
PEDALS = (64, 66, 67)  # controllers: sustain, sostenuto, una corda
KEY_TRIGGERS = ("attack", "first", "legato")  # triggers by a pressed key
# Opcodes that select among the regions of a key. One stroke starts all regions in which they are equal, as far as
# controllers allow it.
_SELECTOR = re.compile(r"(?:lo|hi)(?:key|vel|rand)|key|seq_\w+|sw_\w+|xf\w+")
_CONTROLLER_START = re.compile(r"(?:on|start)_(?:lo|hi)(?:hd)?cc\d+")
_INTEGER = re.compile(r"(-?\d{1,3})(?:\.0*)?", re.ASCII)


class _Sample(NamedTuple):
    """The sample of a region."""

    number: int  # of the region
    file: str  # relative to the SFZ file, with slashes
    root: int  # MIDI number
    layer: str
    midi_velocity: float | None  # middle of its range; None if it sounds at all velocities


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

    def find(self, file: str) -> Path | None:
        """Path of a sample. None if it cannot be used, which is reported with all other rows."""
        try:
            return find_file(file, self.source.parent, self.root)
        except SetupError:
            return None


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
    library = _Library(source, root.resolve())
    text = SfzText(source, library.root)
    for number, region in enumerate(regions(text), 1):
        if reason := _add(library, number, region, transpose):
            library.left_out[reason] += 1
    left_out = ", ".join(f"{counted(n, 'region')} {reason}" for reason, n in library.left_out.most_common())
    if not library.samples:
        why = f"has no region with a sample that a struck key starts{f' ({left_out})' if left_out else ''}"
        raise SetupError(f"{printable(source)}: {why}; give another SFZ file")
    chosen = [_at_one_root(library, [*roots.values()]) for roots in library.samples.values()]
    distinct, copies = _without_copies(library, chosen)
    kept, thinned = _thinned(distinct)
    lists = {
        "left out": [left_out] if left_out else [],
        **_remarks(library, chosen),
        "copies of another sample of the same key, left out": copies,
        f"keys with more than {MAX_RECORDINGS} samples, of which {MAX_RECORDINGS} are used": thinned,
        "text that is not UTF-8, read as Windows-1252": [printable(file.name) for file in text.recoded],
    }
    count, rows = Counter[tuple[int, str]](), []
    for s in kept:
        count[s.root, s.layer] += 1
        number = count[s.root, s.layer]
        # Samples of a key with one range of velocities, such as round robins, are numbered from the second on.
        layer = s.layer if number == 1 else f"{s.layer} {number}"
        rows.append(Row(f"region {s.number}", s.file, midi_to_note(s.root), layer=layer, midi_velocity=s.midi_velocity))
    return rows, [f"{heading}: {first_of(names)}" for heading, names in lists.items() if names]


def _add(library: _Library, number: int, region: dict[str, str], transpose: int) -> str:
    """Add the sample of a region to the library, or return the reason why it is left out."""
    library.opcodes |= region.keys()
    if reason := _reason_left_out(region):
        return reason
    path = (region.get("default_path", "") + _unquoted(region["sample"])).replace("\\", "/")
    file = os.path.normpath(path.lstrip("/"))  # all paths are relative in SFZ
    note = _root(library, region, file)
    if note is None or not _is_piano_key(note + transpose):
        return "whose root note is not that of a piano key"
    library.switches |= {region["sw_last"]} if "sw_last" in region else set()
    softest, hardest = _integer(region, "lovel", 1), _integer(region, "hivel", 127)
    layer = f"v{softest:03d}-{hardest:03d}"
    middle = 0.5 * (max(softest, 1) + hardest)
    sample = _Sample(number, file, note, layer, None if softest <= 1 and hardest >= 127 else middle)
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
    files = {s.file: file for s in samples if (file := library.find(s.file))}
    sizes = {name: file.stat().st_size for name, file in files.items()}
    count = Counter((s.root, sizes.get(s.file)) for s in samples)
    for s in samples:
        content: object = s.file
        if s.file in files and count[s.root, sizes[s.file]] > 1:  # only files of one size can be equal
            content = hashlib.sha256(read_file(files[s.file], MAX_BYTES, SetupError)).digest()
        if kept.setdefault((s.root, content), s) is not s:
            copies.append(printable(s.file))
    return [*kept.values()], copies


def _thinned(samples: Sequence[_Sample]) -> tuple[list[_Sample], list[str]]:
    """At most `MAX_RECORDINGS` samples of each key, spread evenly over its layers, and the notes of keys with more."""
    keys: dict[int, list[_Sample]] = {}
    for s in samples:
        keys.setdefault(s.root, []).append(s)
    kept: list[_Sample] = []
    for of_key in keys.values():
        ordered, step = sorted(of_key, key=lambda s: (s.layer, s.file)), max(len(of_key) / MAX_RECORDINGS, 1.0)
        kept += [ordered[int(i * step)] for i in range(min(len(of_key), MAX_RECORDINGS))]
    return sorted(kept, key=lambda s: s.number), [midi_to_note(k) for k, s in keys.items() if len(s) > MAX_RECORDINGS]


def _remarks(library: _Library, chosen: Sequence[_Sample]) -> dict[str, list[str]]:
    """Names of keys, samples and opcodes by the remark that applies to them."""
    several = [
        f"{printable(s.file)} ({' and '.join(map(midi_to_note, roots))}, {midi_to_note(s.root)} used)"
        for s in chosen
        if len(roots := library.samples[s.file]) > 1
    ]
    switches = sorted(library.switches) if len(library.switches) > 1 else []
    together = sorted({note for (note, _), files in library.at_once.items() if len(files) > 1})
    return {
        "keys where one stroke starts several samples, by microphones or controllers, which are not separated; "
        "to separate them, write a CSV with a column mic": [*map(midi_to_note, together)],
        "samples at several root notes": several,
        "samples with pitch_keycenter=sample whose file has no root note; "
        f"key, pitch or {midi_to_note(DEFAULT_ROOT)} is used": [*dict.fromkeys(library.rootless)],
        "articulations that are not separated, by key switch": switches,
        "opcodes with an older name, or that SFZ does not define": unrecognised_opcodes(library.opcodes),
    }


def _reason_left_out(region: dict[str, str]) -> str:
    """Reason why no key struck with all pedals up starts a region; empty if one does."""
    sample = region.get("sample", "")
    low, high = (_note(region.get(end, region.get("key", ""))) for end in ("lokey", "hikey"))
    if not sample or sample.startswith("*") or region.get("end") == "-1":  # a generator such as *sine; muted
        return "without a recorded sample"
    if region.get("trigger", "attack") not in KEY_TRIGGERS:
        return "on release"
    if any(map(_CONTROLLER_START.fullmatch, region)) or (high is not None and high < 0):
        return "that only a controller starts"
    if any(_integer(region, f"locc{pedal}", 0) > 0 for pedal in PEDALS):
        return "with a pedal down"
    no_keys = (low or 0) > (127 if high is None else high)
    no_velocities = _integer(region, "hivel", 127) < max(_integer(region, "lovel", 1), 1)
    return "whose range of keys or velocities is empty" if no_keys or no_velocities else ""


def _root(library: _Library, region: dict[str, str], file: str) -> int | None:
    """MIDI number of the key at which a sample was recorded; None if its text is not a note."""
    text = region.get("pitch_keycenter", region.get("key"))
    if text == "sample":
        path = library.find(file)
        if path and (in_file := root_note(path)) is not None:
            return in_file
        library.rootless.append(printable(file))
        text = region.get("key")
        if text is None and (midi := _detected_pitch(library, file)) is not None:
            return round(midi)
    if text is None and _integer(region, "pitch_keytrack", 100) == 0 and region.get("lokey") == region.get("hikey"):
        text = region.get("lokey")  # not transposed, on one key
    if text is None:
        return DEFAULT_ROOT
    if (note := _note(text)) is None:
        return None
    return note + 12 * _integer(region, "octave_offset", 0) + _integer(region, "note_offset", 0)


def _at_one_root(library: _Library, samples: Sequence[_Sample]) -> _Sample:
    """One sample at several root notes, at the root note nearest to its pitch. The first if it has no pitch."""
    midi = _detected_pitch(library, samples[0].file) if len(samples) > 1 else None
    return samples[0] if midi is None else min(samples, key=lambda s: abs(s.root - midi))


def _detected_pitch(library: _Library, file: str) -> float | None:
    """Pitch of a sample as a fractional MIDI number; None if it has none or cannot be read."""
    if (path := library.find(file)) is None:
        return None
    try:
        recording = load_recording(path)
        return midi_of(find_pitch(recording.samples[recording.onset :], recording.rate)[0])
    except PianofitError:
        return None


def _is_piano_key(midi: int) -> bool:
    with contextlib.suppress(AnalysisError):
        check_pitch(hertz_of(min(midi, 127)), "note")
        return True
    return False


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
