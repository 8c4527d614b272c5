"""A job: one key, everything that its fit depends on, and a hash of that.

Two jobs with the same hash have the same result, bit for bit, on one kind of processor with one number of threads. The
hash covers the contents of the recordings, their given values, the settings, and the versions of code and libraries.
It does not cover paths and times. Remarks on the jobs of a library, before any fit, are here too.
"""

import functools
import hashlib
import json
import re
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path

import msgspec

from .. import __version__
from ..errors import RecordingError
from ..io.audio import layout_of
from ..io.containers import is_sound, readable_formats
from ..io.files import code_digest, printable, read_file
from ..io.number_format import counted, first_of
from ..recording.recording import MAX_BYTES
from .library_files import files_in
from .manifest import Key, Role, Sample


@dataclass(frozen=True)
class Settings:
    """Settings that all keys of a batch share."""

    seed: int = 0
    channel: str = "average"
    page: bool = True
    setup: str = ""  # text of a setup.toml without recordings


@dataclass(frozen=True)
class Source:
    """One recording of a job."""

    path: str  # absolute
    name: str  # unique within the job
    sha256: str
    velocity: float | None = None  # m/s
    group: str = ""
    midi_velocity: float | None = None
    stroke: str = ""
    layer: str = ""  # this and the following describe the recording and are not part of the hash
    channels: int = 0
    rate: int = 0  # Hz
    error: str = ""  # why it cannot be read
    role: Role = "note"

    def row(self, folder: Path) -> list[str]:
        """Its path relative to a folder, what is given about it, and its layout, as text."""
        file, base = Path(self.path), folder.resolve()
        place = file.relative_to(base).as_posix() if file.is_relative_to(base) else file.name
        velocity = f"{self.velocity:g} m/s" if self.velocity is not None else ""
        role = "" if self.role == "note" else self.role
        given = {"role": role, "layer": self.layer, "velocity": velocity, "group": self.group}
        about = ", ".join(f"{name} {printable(value)}" for name, value in given.items() if value) or "no layer"
        return [printable(place), about, self.error or f"{counted(self.channels, 'channel')}, {self.rate} Hz"]


@dataclass(frozen=True)
class Job:
    """One key to fit."""

    key: str
    note: str
    sources: tuple[Source, ...]
    settings: Settings
    versions: dict[str, str]
    prior: str = ""  # table [prior] of a setup.toml, from the first fits of other keys

    @property
    def parts(self) -> dict[str, str]:
        """Hashes of the inputs, the settings and the versions, and of a prior."""
        given = [(s.name, s.sha256, s.velocity, s.group, s.midi_velocity, s.stroke, s.role) for s in self.sources]
        inputs = [self.note, given]
        parts = {"inputs": _hash(inputs), "settings": _hash(self.settings), "versions": _hash(self.versions)}
        return parts | ({"prior": _hash(self.prior)} if self.prior else {})

    @property
    def hash(self) -> str:
        """Hash of everything that the result depends on."""
        return _hash(self.parts)

    @property
    def setup(self) -> str:
        """Text of its `setup.toml`; empty if no values are given."""
        text = self.settings.setup + self.prior
        for s in (source for source in self.sources if source.role == "note"):
            given = {"v_H0": s.velocity, "group": s.group, "stroke": s.stroke, "midi_velocity": s.midi_velocity}
            if given := {name: value for name, value in given.items() if value not in (None, "")}:
                # The text of a JSON value is a TOML value, except for escaped surrogates.
                values = (f"{k} = {json.dumps(v, ensure_ascii=False)}\n" for k, v in ({"file": s.name} | given).items())
                text += "\n[[recording]]\n" + "".join(values)
        return text


@dataclass(frozen=True)
class UnusedFile:
    """A file that is not used."""

    file: str
    reason: str


def _hash(value: object) -> str:
    return hashlib.sha256(msgspec.json.encode(value, order="sorted")).hexdigest()


@functools.cache
def versions() -> dict[str, str]:
    """Versions of the program, its code, and its numerical libraries."""
    libraries = {name: metadata.version(name) for name in ("jax", "jaxlib", "numpy", "scipy")}
    return {"pianofit": __version__, "code": code_digest()[:16], **libraries}


def make_job(key: Key, settings: Settings) -> Job:
    """Create the job of a key, with hashes of its recordings.

    Raises `RecordingError` if a recording cannot be read, or if two recordings of the key are identical.
    """
    sources: list[Source] = []
    for sample, name in zip(key.samples, _names(key.samples), strict=True):
        data = read_file(sample.file, MAX_BYTES, RecordingError)
        digest = hashlib.sha256(data).hexdigest()
        for other in sources:
            if other.sha256 == digest:
                same = f"{printable(sample.file)} and {printable(other.path)}"
                raise RecordingError(f"{same} are the same recording; list it once")
        given = sample.velocity, sample.group, sample.midi_velocity, sample.stroke, sample.layer
        sources.append(Source(str(sample.file), name, digest, *given, *_layout(data), sample.role))
    return Job(key.name, key.note, tuple(sources), settings, versions())


def _layout(data: bytes) -> tuple[int, int, str]:
    """Channels and rate of a recording, and the reason if it cannot be read."""
    try:
        layout = layout_of(data)
    except RecordingError as error:
        return 0, 0, str(error)
    return layout.channels, layout.rate, ""


def _names(samples: Sequence[Sample]) -> list[str]:
    """A name for every recording of a key, derived from its file name. Its stem is unique."""
    names: list[str] = []
    stems = [s.file.stem.casefold() for s in samples]
    for i, sample in enumerate(samples):
        prefix = f"{sample.group or sample.file.parent.name}-" if stems.count(stems[i]) > 1 else ""
        stem = re.sub(r"[^\w.#+ ()-]", "_", prefix + sample.file.stem)[:100]
        used = {Path(n).stem.casefold() for n in names}
        names.append((f"{stem}-{i + 1}" if stem.casefold() in used else stem) + sample.file.suffix.lower())
    return names


def layout_remarks(jobs: Sequence[Job]) -> list[str]:
    """Remarks on recordings whose channels or rates differ within a key, and on keys that differ from others."""
    within, between = [], []
    for quantity, title in (("channels", "channels"), ("rate", "sample rates")):
        files = {job.key: layout for job in jobs if (layout := _files_by_layout(job, quantity))}
        keys: dict[tuple[int, ...], list[str]] = {}
        for key, layout in files.items():
            keys.setdefault(tuple(sorted(layout)), []).append(key)
        within += [_mixture(quantity, values, keys[values], files) for values in keys if len(values) > 1]
        if len(keys) > 1:
            ordered = sorted(keys.items(), key=lambda entry: -len(entry[1]))
            groups = [f"{_amount(quantity, values)}: {first_of(names)}" for values, names in ordered]
            between.append(f"the keys differ in their {title}: {'; '.join(groups)}")
    return within + between


def _files_by_layout(job: Job, quantity: str) -> dict[int, list[str]]:
    """Names of the readable recordings by their channels or rate. Channels are ignored if the settings choose one."""
    files: dict[int, list[str]] = {}
    if quantity == "rate" or job.settings.channel == "average":
        for source in (s for s in job.sources if s.role == "note" and not s.error):
            files.setdefault(getattr(source, quantity), []).append(printable(Path(source.path).name))
    return files


def _mixture(
    quantity: str, values: tuple[int, ...], keys: Sequence[str], files: dict[str, dict[int, list[str]]]
) -> str:
    """Remark on the keys that mix these values. It names the files with the rarest one."""
    rare = min(values, key=lambda value: sum(len(files[key][value]) for key in keys))
    names = first_of([file for key in keys for file in files[key][rare]])
    effect, hint = f"and are resampled to {max(values)} Hz", ""
    if quantity == "channels":
        effect, hint = "so the sound of the key is mono", ". Leave these out, or choose one --channel for all"
    mixed = f"{first_of(keys)}: recordings with {_amount(quantity, values)} are mixed, {effect}"
    return f"{mixed}; {_amount(quantity, (rare,))}: {names}{hint}"


def _amount(quantity: str, values: tuple[int, ...]) -> str:
    text = " and ".join(map(str, values))
    return f"{text} Hz" if quantity == "rate" else f"{text} channel{'s' * (values != (1,))}"


def unused_files(source: Path, jobs: Sequence[Job]) -> list[UnusedFile]:
    """Files in the folder of a manifest that no key uses, with the reason."""
    folder = source if source.is_dir() else source.parent
    used = {file.path for job in jobs for file in job.sources}
    unused = []
    for name in files_in(folder):
        if str((folder / name).resolve()) in used:
            continue
        if is_sound(name):
            reason = "does not fit the pattern" if source.is_dir() else f"is not used by {printable(source.name)}"
            unused.append(UnusedFile(printable(name), reason))
        elif source.is_dir():
            unused.append(UnusedFile(printable(name), f"is none of {readable_formats()}"))
    return unused
