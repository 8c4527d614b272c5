"""A job: one key, everything that its fit depends on, and a hash of that.

Two jobs with the same hash have the same result, bit for bit, on one kind of processor with one number of threads. The
hash covers the contents of the recordings, their given values, the settings, and the versions of code and libraries.
It does not cover paths and times. A worker receives a job and returns the bytes of the result files. It writes only
into a scratch folder, which it removes.
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
from pathlib import Path
from typing import NamedTuple

from .. import __version__
from ..analysis import analyse
from ..analysis.note_names import SAME_KEY_CENTS, cents_above, hz_to_note, note_to_hz, note_to_midi
from ..errors import AnalysisError, OutputError, PianofitError, RecordingError
from ..io.files import DISK_FULL, printable, read_file, replace_strings, write_error
from ..io.number_format import counted
from ..recording.recording import MAX_BYTES, layout_of, load_recording
from .manifest import Key

__all__ = ["JobResult", "Settings", "Source", "Job", "fit_job", "make_job", "versions"]

SCHEMA = 1
# cents: a note name further than this from the pitch is wrong. Old pianos and stretched trebles stay below.
PITCH_TOLERANCE = 60.0
MIN_PARTIALS = 3  # partials that a recording needs if the key has others, as in a fit
# Errors of the disk, not of a job: the batch stops, and no job counts as failed.
DISK_ERRORS = (*DISK_FULL, errno.EROFS)


class Settings(NamedTuple):
    """Settings that all keys of a batch share."""

    seed: int = 0
    channel: str = "average"
    page: bool = True
    setup: str = ""  # text of a setup.toml without recordings


class Source(NamedTuple):
    """One recording of a job."""

    path: str  # absolute
    name: str  # unique within the job
    sha256: str
    velocity: float | None = None  # m/s
    group: str = ""
    stroke: str = ""
    layer: str = ""  # this and the following describe the recording and are not part of the hash
    channels: int = 0
    rate: int = 0  # Hz
    error: str = ""  # why it cannot be read


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
        """Hash of everything that the result depends on."""
        return _hash([SCHEMA, self.parts])

    @property
    def setup(self) -> str:
        """Text of its `setup.toml`; empty if no values are given."""
        entries = [
            "\n[[recording]]\n" + "".join(f"{k} = {json.dumps(v)}\n" for k, v in entry.items() if v not in (None, ""))
            for s in self.sources
            if (s.velocity, s.group, s.stroke) != (None, "", "")
            for entry in [{"file": s.name, "v_H0": s.velocity, "group": s.group, "stroke": s.stroke}]
        ]
        return self.settings.setup + "".join(entries)


class JobResult(NamedTuple):
    """Result of a job: its files, or the reason of its failure."""

    files: dict[str, bytes]
    error: str = ""  # reason of the failure; empty if the key was fitted
    detected_note: str = ""  # if it differs from the note of the key
    left_out: tuple[dict[str, str], ...] = ()  # recordings that could not be used: file and reason
    detail: str = ""  # traceback of an unexpected error
    seconds: float = 0.0
    memory: int = 0  # largest resident set of the worker so far, bytes
    stop: bool = False  # True if other jobs would fail in the same way, such as on a full disk


def _hash(document: object) -> str:
    return hashlib.sha256(json.dumps(document, sort_keys=True, ensure_ascii=True).encode()).hexdigest()


@functools.cache
def versions() -> dict[str, str]:
    """Versions of the program, its code, and its numerical libraries."""
    code = hashlib.sha256()
    for file in sorted(Path(__file__).parents[1].rglob("*.py")):
        code.update(file.read_bytes())
    libraries = {name: metadata.version(name) for name in ("jax", "jaxlib", "numpy", "scipy")}
    return {"pianofit": __version__, "code": code.hexdigest()[:16], **libraries}


def make_job(key: Key, settings: Settings) -> Job:
    """Create the job of a key, with hashes of its recordings.

    Raises `RecordingError` if a recording cannot be read, or if two recordings of the key are identical.
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
    """Channels and rate of a recording, and the reason if it cannot be read."""
    try:
        layout = layout_of(data)
    except RecordingError as error:
        return 0, 0, str(error)
    return layout.channels, layout.rate, ""


def _names(key: Key) -> list[str]:
    """A name for every recording, derived from its file name. Its stem is unique within the key."""
    names: list[str] = []
    stems = [s.file.stem.casefold() for s in key.samples]
    for i, sample in enumerate(key.samples):
        prefix = f"{sample.group or sample.file.parent.name}-" if stems.count(stems[i]) > 1 else ""
        stem = re.sub(r"[^\w.#+ ()-]", "_", prefix + sample.file.stem)[:100]
        used = {Path(n).stem.casefold() for n in names}
        unique = stem if stem.casefold() not in used else f"{stem}-{i + 1}"
        names.append(unique + sample.file.suffix.lower())
    return names


def fit_job(
    job: Job,
    contents: Sequence[bytes] | None = None,
    scratch: str | None = None,
    report_progress: Callable[[str], None] = lambda _: None,
) -> JobResult:
    """Fit one job and return its files. Errors of the job are returned, not raised.

    Parameters
    ----------
    contents : bytes of the recordings; None to read them at their paths.
    scratch : folder in which a temporary folder is created.
    report_progress : called with the name of every stage when it begins.
    """
    began = time.monotonic()
    try:
        if other := _other_versions(job):
            return JobResult({}, other, stop=True)
        with tempfile.TemporaryDirectory(dir=scratch, prefix="pianofit-") as place:
            result = _fit_in(Path(place), job, contents, report_progress)
    except PianofitError as error:
        full = isinstance(error.__cause__, OSError) and error.__cause__.errno in DISK_ERRORS
        result = JobResult({}, str(error), stop=full)
    except OSError as error:
        reason = write_error(scratch or tempfile.gettempdir(), error, "check that disk")
        result = JobResult({}, f"{socket.gethostname()}: {reason}", stop=error.errno in DISK_ERRORS)
    except MemoryError:
        result = JobResult({}, "not enough memory; give fewer or shorter recordings, or increase --memory")
    except Exception as error:
        reason = printable(f"the program failed with {type(error).__name__}: {error}")[:300]
        result = JobResult({}, reason, detail=traceback.format_exc())
    return result._replace(seconds=time.monotonic() - began, memory=_peak_memory())


def _peak_memory() -> int:
    """Largest resident set of this process, bytes."""
    if sys.platform == "win32":
        return 0
    import resource

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024


def _other_versions(job: Job) -> str:
    """Reason if this worker has other versions than the batch; else empty."""
    for name, wanted in job.versions.items():
        if (here := versions().get(name)) != wanted:
            return f"the worker on {socket.gethostname()} has {name} {here}, the batch {wanted}; install the same there"
    return ""


def _fit_in(
    place: Path, job: Job, contents: Sequence[bytes] | None, report_progress: Callable[[str], None]
) -> JobResult:
    """Fit in the folder `place`. Recordings that cannot be used are left out if others can be used."""
    files = _stage_inputs(place, job, contents)
    (out := place / "out").mkdir()
    left_out: list[tuple[Path, str]] = []
    try:
        try:
            _fit(job, files, place, out, report_progress)
        except OutputError:
            raise
        except PianofitError:
            report_progress("each recording alone")
            left_out = _unusable(files, job)
            files = [f for f in files if f not in [bad for bad, _ in left_out]]
            if not left_out or not files:
                raise
            _fit(job, files, place, out, report_progress)
    except OutputError:
        raise
    except PianofitError as error:
        reason = left_out[0][1] if left_out and not files else str(error)
        if len(left_out) > 1 and not files:
            reason = f"none of its {len(left_out)} recordings can be used: {reason}"
        detected_note = _detected_note(job, files or [f for f, _ in left_out])
        return JobResult({}, replace_strings(reason, _file_names(place, job)), detected_note=detected_note)
    outputs = {file.name: file.read_bytes() for file in sorted(out.iterdir())}
    if job.setup:
        outputs["setup.toml"] = job.setup.encode()
    paths, names = _paths(place, job), _file_names(place, job)
    unused = [{"file": paths[str(file)], "reason": replace_strings(reason, names)} for file, reason in left_out]
    return JobResult(outputs, left_out=tuple(unused))


def _paths(place: Path, job: Job) -> dict[str, str]:
    """Original paths of the recordings by their paths in the scratch folder, whose name differs in every run."""
    return {str(place / "in" / source.name): source.path for source in job.sources}


def _file_names(place: Path, job: Job) -> dict[str, str]:
    """File names by the same paths, for messages. Tables and pages must not contain folders of this machine."""
    return {scratch: printable(Path(path).name) for scratch, path in _paths(place, job).items()}


def _stage_inputs(place: Path, job: Job, contents: Sequence[bytes] | None) -> list[Path]:
    """Copy the recordings into one folder, under their names in the job, and check their hashes."""
    (folder := place / "in").mkdir()
    files = []
    for i, source in enumerate(job.sources):
        data = read_file(source.path, MAX_BYTES, RecordingError) if contents is None else contents[i]
        if hashlib.sha256(data).hexdigest() != source.sha256:
            raise RecordingError(
                f"{printable(Path(source.path).name)}: has changed since the batch began; run it again"
            )
        files.append(folder / source.name)
        files[-1].write_bytes(data)
    return files


def _fit(job: Job, files: list[Path], place: Path, out: Path, report_progress: Callable[[str], None]) -> None:
    """Fit `files` into `out`. The results contain the original paths.

    Raises `AnalysisError` if the pitch is not that of the note.
    """
    from ..fitting import fit
    from ..model.program_cache import enable_program_cache

    setup = None
    if job.setup:
        setup = place / "setup.toml"
        setup.write_text(job.setup, encoding="utf-8")
    enable_program_cache()
    result = fit(
        *files, setup=setup, note=job.note, channel=job.settings.channel, seed=job.settings.seed,
        progress=_once_per_stage(report_progress),
    )  # fmt: skip
    if reason := _wrong_note(job.note, result.document["derived"]["f0"]):
        raise AnalysisError(reason)
    result.document.update(replace_strings(result.document, _paths(place, job)))
    result.save(out, force=True, page=False)
    if job.settings.page:
        report_progress("page")
        result.report(out, title=f"{job.key}: " + ", ".join(printable(file.name) for file in files))


def _unusable(files: list[Path], job: Job) -> list[tuple[Path, str]]:
    """Recordings that cannot be analysed or belong to another key, with the reason."""
    failed, pitches = [], {}
    for file in files:
        try:
            analysis = analyse(load_recording(file, channel=job.settings.channel), note=job.note)
            if len(analysis.partials) < MIN_PARTIALS and len(files) > 1:
                failed.append((file, f"{file}: only {counted(len(analysis.partials), 'partial')} above its noise"))
            else:
                pitches[file] = analysis.f0
        except PianofitError as error:
            failed.append((file, str(error)))
    return failed + [
        (file, f"{file}: sounds at {pitches[file]:.1f} Hz, nearer to {hz_to_note(pitches[file])}, and the other "
         f"recordings of {job.note} at {key:.1f} Hz")
        for file, key in _of_another_key(pitches, job.note).items()
    ]  # fmt: skip


def _of_another_key(pitches: Mapping[Path, float], note: str) -> dict[Path, float]:
    """Recordings of another key than `note`, each with the pitch of the key, Hz. Empty if no recording is of the key.

    A string has one pitch. The key is the largest set of recordings within `SAME_KEY` of one another whose pitch agrees
    with `note`. If two sets are equally large, the set nearest to the note is used.
    """

    def cents(a: float, b: float) -> float:
        return abs(cents_above(a, b))

    set_sizes = {
        f0: sum(cents(f0, other) <= SAME_KEY_CENTS for other in pitches.values())
        for f0 in pitches.values()
        if not _wrong_note(note, f0)
    }
    if not set_sizes:
        return {}
    key = max(set_sizes, key=lambda f0: (set_sizes[f0], -cents(f0, note_to_hz(note))))
    return {file: key for file, f0 in pitches.items() if cents(f0, key) > SAME_KEY_CENTS}


def _detected_note(job: Job, files: list[Path]) -> str:
    """The note detected in most recordings, if it differs from the note of the key; else empty."""
    notes = []
    for file in files:
        try:
            notes.append(hz_to_note(analyse(load_recording(file, channel=job.settings.channel)).f0))
        except PianofitError:
            continue
    common = max(notes, key=notes.count, default="")
    differs = common and note_to_midi(common) != note_to_midi(job.note)
    return common if differs and 2 * notes.count(common) > len(notes) else ""


def _wrong_note(note: str, f0: float) -> str:
    """Reason if the pitch `f0` (Hz) does not agree with `note`; else empty."""
    cents = cents_above(f0, note_to_hz(note))
    if abs(cents) <= PITCH_TOLERANCE:
        return ""
    return (f"note {note} is {note_to_hz(note):.1f} Hz, but the string sounds at {f0:.1f} Hz, {cents:+.0f} cents from "
            f"it: {hz_to_note(f0)}")  # fmt: skip


def _once_per_stage(report_progress: Callable[[str], None]) -> Callable[[str, float], None]:
    """A progress function of a fit that reports every stage once, when it begins."""
    last = ""

    def progress(stage: str, _: float) -> None:
        nonlocal last
        if stage != last:
            last = stage
            report_progress(stage)

    return progress
