"""The work of a worker: it fits one job and returns the bytes of the result files.

It writes only into a scratch folder, which it removes. A recording that cannot be used is left out if others can be
used.
"""

import errno
import hashlib
import socket
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from ..analysis import analyse
from ..analysis.note_names import SAME_KEY_CENTS, cents_above, hz_to_note, note_to_hz, note_to_midi
from ..errors import AnalysisError, OutputError, PianofitError, RecordingError
from ..io.files import DISK_FULL, printable, read_file, replace_paths, write_error
from ..io.number_format import counted
from ..recording.recording import MAX_BYTES, load_recording
from ..schema.decode import encode_json
from ..schema.extras import EXTRAS_FILE
from .extras import measure_extras
from .job import Job, UnusedFile, versions
from .manifest import Role

# cents: a note name further than this from the pitch is wrong. Old pianos and stretched trebles stay below.
PITCH_TOLERANCE = 60.0
MIN_PARTIALS = 3  # partials that a recording needs if the key has others, as in a fit
# Errors of the disk, not of a job: the batch stops, and no job counts as failed.
DISK_ERRORS = (*DISK_FULL, errno.EROFS)


@dataclass(frozen=True)
class JobResult:
    """Result of a job: its files, or the reason of its failure."""

    files: dict[str, bytes]
    error: str = ""  # reason of the failure; empty if the key was fitted
    detected_note: str = ""  # if it differs from the note of the key
    left_out: tuple[UnusedFile, ...] = ()  # recordings that could not be used
    detail: str = ""  # traceback of an unexpected error
    seconds: float = 0.0
    memory: int = 0  # largest resident set of the worker so far, bytes
    lost: bool = False  # True if the worker died, so that the job is tried again
    stop: bool = False  # True if other jobs would fail in the same way, such as on a full disk


ReportStage = Callable[[str], None]
# Arguments: a job, the bytes of its recordings, a scratch folder, and a function that receives each stage.
Work = Callable[[Job, Sequence[bytes] | None, str | None, ReportStage], JobResult]


def fit_job(
    job: Job,
    contents: Sequence[bytes] | None = None,
    scratch: str | None = None,
    report_stage: ReportStage = lambda _: None,
) -> JobResult:
    """Fit one job and return its files. Errors of the job are returned, not raised.

    Parameters
    ----------
    contents : bytes of the recordings; None to read them at their paths.
    scratch : folder in which a temporary folder is created.
    report_stage : called with the name of every stage when it begins.
    """
    began = time.monotonic()
    try:
        if other := _other_versions(job):
            return JobResult({}, other, stop=True)
        with tempfile.TemporaryDirectory(dir=scratch, prefix="pianofit-") as place:
            result = _fit_in(Path(place), job, contents, report_stage)
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
    return replace(result, seconds=time.monotonic() - began, memory=_peak_memory())


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


def _fit_in(place: Path, job: Job, contents: Sequence[bytes] | None, report_stage: ReportStage) -> JobResult:
    """Fit in the folder `place`. Recordings that cannot be used are left out if others can be used."""
    staged = _stage_inputs(place, job, contents)
    roles: dict[Path, Role] = {file: source.role for file, source in zip(staged, job.sources, strict=True)}
    files = [file for file, role in roles.items() if role == "note"]
    # Messages, tables and pages contain names of files, and no folders of this machine.
    paths = {str(file): source.path for file, source in zip(roles, job.sources, strict=True)}
    names = {scratch: printable(Path(path).name) for scratch, path in paths.items()}
    unusable: dict[Path, str] = {}
    try:
        try:
            outputs = _fit(job, files, paths, place, report_stage) if files else {}
        except OutputError:
            raise
        except PianofitError:
            report_stage("each recording alone")
            unusable = _unusable(files, job)
            files = [file for file in files if file not in unusable]
            if not unusable or not files:
                raise
            outputs = _fit(job, files, paths, place, report_stage)
    except OutputError:
        raise
    except PianofitError as error:
        reason = next(iter(unusable.values())) if unusable and not files else str(error)
        if len(unusable) > 1 and not files:
            reason = f"none of its {len(unusable)} recordings can be used: {reason}"
        detected_note = _detected_note(job, files or [*unusable])
        return JobResult({}, replace_paths(reason, names), detected_note=detected_note)
    report_stage("dampers and noise")
    used: dict[Path, Role] = {file: role for file, role in roles.items() if file not in unusable}
    extras, others = measure_extras(used, paths, job.note, job.settings.channel)
    if not outputs and len(others) == len(roles):
        return JobResult({}, replace_paths(next(iter(others.values())), names))
    unusable |= others
    left_out = (UnusedFile(paths[str(file)], replace_paths(reason, names)) for file, reason in unusable.items())
    return JobResult(outputs | {EXTRAS_FILE: encode_json(extras)}, left_out=tuple(left_out))


def _stage_inputs(place: Path, job: Job, contents: Sequence[bytes] | None) -> list[Path]:
    """Copy the recordings into one folder, under their names in the job, and check their hashes."""
    (folder := place / "in").mkdir()
    files = []
    for i, source in enumerate(job.sources):
        data = read_file(source.path, MAX_BYTES, RecordingError) if contents is None else contents[i]
        if hashlib.sha256(data).hexdigest() != source.sha256:
            name = printable(Path(source.path).name)
            raise RecordingError(f"{name}: has changed since the batch began; run it again")
        files.append(folder / source.name)
        files[-1].write_bytes(data)
    return files


def _fit(
    job: Job, files: list[Path], paths: Mapping[str, str], place: Path, report_stage: ReportStage
) -> dict[str, bytes]:
    """Fit `files`, and return the contents of the result files by their names. They contain the original paths.

    Raises `AnalysisError` if the pitch is not that of the note.
    """
    from ..fitting import fit
    from ..program_folder import enable_program_cache

    setup, outputs = None, {}
    if job.setup:
        setup = place / "setup.toml"
        setup.write_text(job.setup, encoding="utf-8")
        outputs = {setup.name: job.setup.encode()}
    enable_program_cache()
    settings, stages = job.settings, [""]

    def progress(stage: str, _: float) -> None:
        if stage != stages[-1]:  # every stage is reported once, when it begins
            stages.append(stage)
            report_stage(stage)

    result = fit(*files, setup=setup, note=job.note, channel=settings.channel, seed=settings.seed, progress=progress)
    if reason := _wrong_note(job.note, result.fit.derived.f0):
        raise AnalysisError(reason)
    result = replace(result, fit=result.fit.with_paths(paths))
    (out := place / "out").mkdir(exist_ok=True)
    result.save(out, force=True, page=False)
    if settings.page:
        report_stage("page")
        result.report(out, title=f"{job.key}: " + ", ".join(printable(file.name) for file in files))
    return {file.name: file.read_bytes() for file in sorted(out.iterdir())} | outputs


def _unusable(files: list[Path], job: Job) -> dict[Path, str]:
    """Recordings that cannot be analysed or belong to another key, with the reason."""
    reasons, pitches = {}, {}
    for file in files:
        try:
            analysis = analyse(load_recording(file, channel=job.settings.channel), note=job.note)
        except PianofitError as error:
            reasons[file] = str(error)
            continue
        if len(analysis.partials) < MIN_PARTIALS and len(files) > 1:
            reasons[file] = f"{file}: only {counted(len(analysis.partials), 'partial')} above its noise"
        else:
            pitches[file] = analysis.f0
    for file, key in _of_another_key(pitches, job.note).items():
        found = f"sounds at {pitches[file]:.1f} Hz, nearer to {hz_to_note(pitches[file])}"
        reasons[file] = f"{file}: {found}, and the other recordings of {job.note} at {key:.1f} Hz"
    return reasons


def _of_another_key(pitches: Mapping[Path, float], note: str) -> dict[Path, float]:
    """Recordings of another key than `note`, each with the pitch of the key, Hz. Empty if no recording is of the key.

    A string has one pitch. The key is the largest set of recordings within `SAME_KEY_CENTS` of one another whose pitch
    agrees with `note`. If two sets are equally large, the set nearest to the note is used.
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
    nominal = note_to_hz(note)
    cents = cents_above(f0, nominal)
    if abs(cents) <= PITCH_TOLERANCE:
        return ""
    sounds = f"the string sounds at {f0:.1f} Hz, {cents:+z.0f} cents from it: {hz_to_note(f0)}"
    return f"note {note} is {nominal:.1f} Hz, but {sounds}"
