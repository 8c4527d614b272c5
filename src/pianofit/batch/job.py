"""A unit of work: one key, all that its fit depends on, and the hash of that.

Two units with one hash have one result, bit for bit on one kind of processor with one number of threads: the hash is
over the recordings' contents, what is known of them, the settings, and the code and libraries that make the numbers.
Paths and times are no part of it. A worker gets a unit and returns the bytes of the files; it writes nothing of its
own but a scratch folder that it takes away.
"""

from __future__ import annotations

import errno
import functools
import hashlib
import json
import re
import socket
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Mapping, Sequence
from importlib import metadata
from math import log2
from pathlib import Path
from typing import NamedTuple

from .. import __version__
from ..analysis import analyse
from ..analysis.note_names import SAME_KEY, hz_to_note, note_to_hz, note_to_midi
from ..errors import AnalysisError, OutputError, PianofitError, RecordingError
from ..io.files import DISK_FULL, printable, read_file, replace_strings, write_error
from ..io.number_format import counted
from ..recording.recording import MAX_BYTES, layout_of, load_recording
from .manifest import Key

__all__ = ["JobResult", "Settings", "Source", "Job", "fit_unit", "make_unit", "versions"]

SCHEMA = 1
# A name is wrong when the string sounds further from it than this, cents; old pianos and stretched trebles do not.
PITCH_TOLERANCE = 60.0
FEWEST = 3  # partials that a recording needs next to others, as in a fit
# What is wrong with the disk and not with a unit: the batch stops, and no unit counts as failed.
NO_DISK = (*DISK_FULL, errno.EROFS)


class Settings(NamedTuple):
    """What all keys of a batch share."""

    seed: int = 0
    channel: str = "average"
    page: bool = True
    setup: str = ""  # the text of a setup.toml without recordings


class Source(NamedTuple):
    """One recording of a unit."""

    path: str  # absolute
    name: str  # unique within the unit
    sha256: str
    velocity: float | None = None  # m/s
    group: str = ""
    stroke: str = ""
    layer: str = ""  # this and the following describe the recording, and are no part of the hash
    channels: int = 0
    rate: int = 0  # Hz
    wrong: str = ""  # why it cannot be read


class Job(NamedTuple):
    """One key to fit."""

    key: str
    note: str
    sources: tuple[Source, ...]
    settings: Settings
    versions: dict[str, str]

    @property
    def parts(self) -> dict[str, str]:
        """Hashes of the inputs, the settings and the versions."""
        inputs = [self.note, [(s.name, s.sha256, s.velocity, s.group, s.stroke) for s in self.sources]]
        return {"inputs": _hash(inputs), "settings": _hash(self.settings), "versions": _hash(self.versions)}

    @property
    def hash(self) -> str:
        """Hash of all that the result depends on."""
        return _hash([SCHEMA, self.parts])

    @property
    def setup(self) -> str:
        """The text of its `setup.toml`; empty if nothing is known."""
        entries = [
            "\n[[recording]]\n" + "".join(f"{k} = {json.dumps(v)}\n" for k, v in entry.items() if v not in (None, ""))
            for s in self.sources
            if (s.velocity, s.group, s.stroke) != (None, "", "")
            for entry in [{"file": s.name, "v_H0": s.velocity, "group": s.group, "stroke": s.stroke}]
        ]
        return self.settings.setup + "".join(entries)


class JobResult(NamedTuple):
    """What came of a unit: files, or why there are none."""

    files: dict[str, bytes]
    error: str = ""  # the reason, empty if it was fitted
    sounds_like: str = ""  # the note that it sounds like, where that is not its name
    left_out: tuple[dict[str, str], ...] = ()  # recordings that could not be used: file, and reason
    detail: str = ""  # a traceback, where the program is at fault
    seconds: float = 0.0
    memory: int = 0  # largest resident set of the worker so far, bytes
    stop: bool = False  # nothing else can be done here either, such as on a full disk


def _hash(document: object) -> str:
    return hashlib.sha256(json.dumps(document, sort_keys=True, ensure_ascii=True).encode()).hexdigest()


@functools.cache
def versions() -> dict[str, str]:
    """Versions of the program, its code, and the libraries that make the numbers."""
    code = hashlib.sha256()
    for file in sorted(Path(__file__).parents[1].rglob("*.py")):
        code.update(file.read_bytes())
    found = {name: metadata.version(name) for name in ("jax", "jaxlib", "numpy", "scipy")}
    return {"pianofit": __version__, "code": code.hexdigest()[:16], **found}


def make_unit(key: Key, settings: Settings) -> Job:
    """A key with the contents of its recordings hashed.

    Raises `RecordingError` when a recording cannot be read, or two of the key are the same.
    """
    sources: list[Source] = []
    for sample, name in zip(key.samples, _names(key), strict=True):
        data = read_file(sample.file, MAX_BYTES, RecordingError)
        digest = hashlib.sha256(data).hexdigest()
        for other in sources:
            if other.sha256 == digest:
                raise RecordingError(
                    f"{printable(sample.file)} and {printable(other.path)} are the same recording; list it once"
                )
        given = sample.velocity, sample.group, sample.stroke, sample.layer
        sources.append(Source(str(sample.file), name, digest, *given, *_layout(data)))
    return Job(key.name, key.note, tuple(sources), settings, versions())


def _layout(data: bytes) -> tuple[int, int, str]:
    """Channels and rate of a recording, or why it cannot be read."""
    try:
        layout = layout_of(data)
    except RecordingError as error:
        return 0, 0, str(error)
    return layout.channels, layout.rate, ""


def _names(key: Key) -> list[str]:
    """A name for every recording, unique within the key by its stem, from the file's own name."""
    names: list[str] = []
    stems = [s.file.stem.casefold() for s in key.samples]
    for i, sample in enumerate(key.samples):
        prefix = f"{sample.group or sample.file.parent.name}-" if stems.count(stems[i]) > 1 else ""
        stem = re.sub(r"[^\w.#+ ()-]", "_", prefix + sample.file.stem)[:100]
        taken = {Path(n).stem.casefold() for n in names}
        unique = stem if stem.casefold() not in taken else f"{stem}-{i + 1}"
        names.append(unique + sample.file.suffix.lower())
    return names


def fit_unit(
    unit: Job,
    contents: Sequence[bytes] | None = None,
    scratch: str | None = None,
    report_progress: Callable[[str], None] = lambda _: None,
) -> JobResult:
    """Fit one unit and return its files; never raises for what the unit is at fault for.

    Without `contents`, the recordings' bytes, these are read at their paths. `scratch` is where a temporary folder is
    made, and `tell` is called with the name of every stage as it begins.
    """
    began = time.monotonic()
    try:
        if other := _other_versions(unit):
            return JobResult({}, other, stop=True)
        with tempfile.TemporaryDirectory(dir=scratch, prefix="pianofit-") as place:
            found = _fit_in(Path(place), unit, contents, report_progress)
    except PianofitError as error:
        full = isinstance(error.__cause__, OSError) and error.__cause__.errno in NO_DISK
        found = JobResult({}, str(error), stop=full)
    except OSError as error:
        wrong = write_error(scratch or tempfile.gettempdir(), error, "see to that disk")
        found = JobResult({}, f"{socket.gethostname()}: {wrong}", stop=error.errno in NO_DISK)
    except MemoryError:
        found = JobResult({}, "not enough memory; give fewer recordings, shorter ones, or --memory more")
    except Exception as error:
        reason = printable(f"the program failed with {type(error).__name__}: {error}")[:300]
        found = JobResult({}, reason, detail=traceback.format_exc())
    return found._replace(seconds=time.monotonic() - began, memory=_peak())


def _peak() -> int:
    """Largest resident set of this process, bytes."""
    if sys.platform == "win32":
        return 0
    import resource

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024


def _other_versions(unit: Job) -> str:
    """Why this worker may not compute what would then be called another program's; empty if it may."""
    for name, wanted in unit.versions.items():
        if (here := versions().get(name)) != wanted:
            return f"the worker on {socket.gethostname()} has {name} {here}, the batch {wanted}; install the same there"
    return ""


def _fit_in(
    place: Path, unit: Job, contents: Sequence[bytes] | None, report_progress: Callable[[str], None]
) -> JobResult:
    """Fit in the folder `place`; recordings that cannot be used are left out if others can."""
    files = _stage_inputs(place, unit, contents)
    (out := place / "out").mkdir()
    left_out: list[tuple[Path, str]] = []
    try:
        try:
            _fit(unit, files, place, out, report_progress)
        except OutputError:
            raise
        except PianofitError:
            report_progress("each recording alone")
            left_out = _unusable(files, unit)
            files = [f for f in files if f not in [bad for bad, _ in left_out]]
            if not left_out or not files:
                raise
            _fit(unit, files, place, out, report_progress)
    except OutputError:
        raise
    except PianofitError as error:
        astray = left_out[0][1] if left_out and not files else str(error)
        every = f"none of its {len(left_out)} recordings can be used: " if len(left_out) > 1 and not files else ""
        like = _sounds_like(unit, files or [f for f, _ in left_out])
        return JobResult({}, replace_strings(every + astray, _file_names(place, unit)), sounds_like=like)
    outputs = {file.name: file.read_bytes() for file in sorted(out.iterdir())}
    if unit.setup:
        outputs["setup.toml"] = unit.setup.encode()
    paths, names = _paths(place, unit), _file_names(place, unit)
    named = [{"file": paths[str(file)], "reason": replace_strings(reason, names)} for file, reason in left_out]
    return JobResult(outputs, left_out=tuple(named))


def _paths(place: Path, unit: Job) -> dict[str, str]:
    """The recordings' own paths by those that they have in the scratch folder, whose name changes by the run."""
    return {str(place / "in" / source.name): source.path for source in unit.sources}


def _file_names(place: Path, unit: Job) -> dict[str, str]:
    """The recordings' file names by the same, for messages: a table or a page names no folder of this machine."""
    return {scratch: printable(Path(path).name) for scratch, path in _paths(place, unit).items()}


def _stage_inputs(place: Path, unit: Job, contents: Sequence[bytes] | None) -> list[Path]:
    """The recordings under their names in a folder of their own, each as the unit knows it."""
    (folder := place / "in").mkdir()
    files = []
    for i, source in enumerate(unit.sources):
        data = read_file(source.path, MAX_BYTES, RecordingError) if contents is None else contents[i]
        if hashlib.sha256(data).hexdigest() != source.sha256:
            raise RecordingError(
                f"{printable(Path(source.path).name)}: has changed since the batch began; run it again"
            )
        files.append(folder / source.name)
        files[-1].write_bytes(data)
    return files


def _fit(unit: Job, files: list[Path], place: Path, out: Path, report_progress: Callable[[str], None]) -> None:
    """Fit `files` into `out`, where they have their own paths again.

    Raises `AnalysisError` if the string does not sound at its note.
    """
    from ..fitting import fit
    from ..model.program_cache import enable_program_cache

    setup = None
    if unit.setup:
        setup = place / "setup.toml"
        setup.write_text(unit.setup, encoding="utf-8")
    enable_program_cache()
    result = fit(
        *files, setup=setup, note=unit.note, channel=unit.settings.channel, seed=unit.settings.seed,
        progress=_changes(report_progress),
    )  # fmt: skip
    if wrong := _wrong_note(unit.note, result.document["derived"]["f0"]):
        raise AnalysisError(wrong)
    result.document.update(replace_strings(result.document, _paths(place, unit)))
    result.save(out, force=True, page=False)
    if unit.settings.page:
        report_progress("page")
        result.report(out, title=f"{unit.key}: " + ", ".join(printable(file.name) for file in files))


def _unusable(files: list[Path], unit: Job) -> list[tuple[Path, str]]:
    """Recordings that cannot be used for this key, and why: by themselves, or because they are of another key."""
    found, pitches = [], {}
    for file in files:
        try:
            analysis = analyse(load_recording(file, channel=unit.settings.channel), note=unit.note)
            if len(analysis.partials) < FEWEST and len(files) > 1:
                found.append((file, f"{file}: only {counted(len(analysis.partials), 'partial')} above its noise"))
            else:
                pitches[file] = analysis.f0
        except PianofitError as error:
            found.append((file, str(error)))
    return found + [
        (file, f"{file}: sounds at {pitches[file]:.1f} Hz, nearer to {hz_to_note(pitches[file])}, and the other "
         f"recordings of {unit.note} at {key:.1f} Hz")
        for file, key in _of_another_key(pitches, unit.note).items()
    ]  # fmt: skip


def _of_another_key(pitches: Mapping[Path, float], note: str) -> dict[Path, float]:
    """Recordings of another key than `note`, each with the pitch of the key, Hz; empty if no recording is of the key.

    One string has one pitch. The key is the largest set of recordings within `SAME_KEY` of one another whose pitch may
    have the name `note`; of equally large sets it is the one nearest to that name.
    """

    def apart(a: float, b: float) -> float:
        return abs(1200 * log2(a / b))

    sets = {
        f0: sum(apart(f0, other) <= SAME_KEY for other in pitches.values())
        for f0 in pitches.values()
        if not _wrong_note(note, f0)
    }
    if not sets:
        return {}
    key = max(sets, key=lambda f0: (sets[f0], -apart(f0, note_to_hz(note))))
    return {file: key for file, f0 in pitches.items() if apart(f0, key) > SAME_KEY}


def _sounds_like(unit: Job, files: list[Path]) -> str:
    """The note that most of the recordings sound like, if that is another than the key's; else nothing."""
    notes = []
    for file in files:
        try:
            notes.append(hz_to_note(analyse(load_recording(file, channel=unit.settings.channel)).f0))
        except PianofitError:
            continue
    common = max(notes, key=notes.count, default="")
    differs = common and note_to_midi(common) != note_to_midi(unit.note)
    return common if differs and 2 * notes.count(common) > len(notes) else ""


def _wrong_note(note: str, f0: float) -> str:
    """Why `note` is not the name of what sounds at `f0` (Hz); empty if it is."""
    cents = 1200 * log2(f0 / note_to_hz(note))
    if abs(cents) <= PITCH_TOLERANCE:
        return ""
    return (f"note {note} is {note_to_hz(note):.1f} Hz, but the string sounds at {f0:.1f} Hz, {cents:+.0f} cents from "
            f"it: {hz_to_note(f0)}")  # fmt: skip


def _changes(report_progress: Callable[[str], None]) -> Callable[[str, float], None]:
    """What tells every stage once, as it begins."""
    last = ""

    def progress(stage: str, _: float) -> None:
        nonlocal last
        if stage != last:
            last = stage
            report_progress(stage)

    return progress
