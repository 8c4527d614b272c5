"""Content of a `fit.json`: frozen records whose fields are the keys of the file. In memory a fit is the same records.

All that a fit reports is here, in SI units unless a name says otherwise. `NoteFile` is the part that defines a note.
The page to play writes it alone.
"""

from __future__ import annotations

import os
import platform
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from msgspec import Meta

from .. import __version__
from ..errors import FitError
from ..excitation import HAMMER, STROKES
from ..felt import DEFAULT_LAW
from ..io.containers import RATES
from ..io.files import path_name, printable, replace_paths, short_repr
from ..key_prior import KeyPrior
from ..model.output_path import OutputPath, VelocityDiscrepancy
from .decode import MidiVelocity, Number, convert, load_json
from .derived import Derived
from .diagnostics import Diagnostics
from .modal_response import FittedModalResponse
from .quantities import Covariance, Quantities, Status

FIT_SCHEMA = 8
# Kinds of the files that hold a note.
KINDS = ("fit", "note")
# Largest fit.json, bytes.
LARGEST_FIT = 2**24
# Largest number of points of an output path, far more than a string has partials.
MOST_POINTS = 4096
# Most strokes of a velocity discrepancy: a library has some dozens of layers.
MOST_STROKES = 256
HINT = "give the file that pianofit fit wrote"
# Levels are compared up to this frequency, Hz, since few hammers reach beyond it,
LEVEL_TOP = 6000.0
# and within this range of the strongest partial, dB, since other sounds lie below it.
LEVEL_RANGE = 60.0

Rate = Annotated[int, Meta(ge=RATES[0], le=RATES[1])]
PickupQuantity = Literal["velocity", "displacement", "bridge-force", "pressure", "magnetic-pickup"]
ExcitationName = Literal["hammer", "pluck"]


@dataclass(frozen=True, eq=False)
class VelocityDiscrepancyEntry:
    """Velocity discrepancy of an output path."""

    velocity: np.ndarray  # m/s, increasing [strokes]
    db: np.ndarray  # [strokes, partials]

    def __post_init__(self) -> None:
        velocity, db = self.velocity, self.db
        increasing = velocity.ndim == 1 and len(velocity) > 0 and (np.diff(velocity, prepend=0.0) > 0).all()
        if not (increasing and db.ndim == 2 and len(velocity) == len(db) <= MOST_STROKES and np.abs(db).max() <= 300):
            raise ValueError(
                f"Expected 1 to {MOST_STROKES} increasing velocities above 0, m/s, and for each one level of at most "
                "300 dB for every partial"
            )


@dataclass(frozen=True, eq=False)
class PathEntry:
    """An output path at its partials, Hz and dB [partials]."""

    frequency: np.ndarray
    db: np.ndarray
    velocity_discrepancy: VelocityDiscrepancyEntry | None = None

    def __post_init__(self) -> None:
        discrepancy = self.velocity_discrepancy
        partials = len(self.db) if self.db.ndim == 1 else 0
        increasing = partials and self.frequency.ndim == 1 and (np.diff(self.frequency, prepend=0.0) > 0).all()
        if not increasing or self.db.shape != self.frequency.shape or partials > MOST_POINTS:
            raise ValueError(f"Expected increasing frequencies and as many values of db, at most {MOST_POINTS}")
        if np.abs(self.db).max() > 300.0:
            raise ValueError(f"db reaches {np.abs(self.db).max():.3g} dB but must be at most 300")
        if discrepancy is not None and discrepancy.db.shape[1] != partials:
            raise ValueError("velocity_discrepancy must have a level for every partial")

    @classmethod
    def of(cls, path: OutputPath | None) -> PathEntry | None:
        """Return the entry of a path; None if there is none."""
        if path is None:
            return None
        own = path.velocity_discrepancy
        return cls(path.frequency, path.db, None if own is None else VelocityDiscrepancyEntry(*own))

    @property
    def output_path(self) -> OutputPath:
        """The path of the model."""
        entry = self.velocity_discrepancy
        discrepancy = None if entry is None else VelocityDiscrepancy(entry.velocity, entry.db)
        return OutputPath(self.frequency, self.db, discrepancy)


@dataclass(frozen=True)
class Pickup:
    """The recorded quantity, and the output path between the string and the file."""

    quantity: PickupQuantity
    path: PathEntry | None = None  # of the reference recording, at the best minimum
    paths: dict[str, PathEntry] = field(default_factory=dict)  # by number of the path group, if there are several


@dataclass(frozen=True)
class BandValue:
    """Eq. 19 before and after the fit."""

    initial: Number
    final: Number


@dataclass(frozen=True)
class Criterion:
    """The paper's criterion, eq. 19, on the sounds of one recording."""

    bands: dict[str, BandValue]  # `global`, and those of `band1` to `band3` with a partial
    excluded_bands: tuple[str, ...]
    sigma: Number  # damping, 1/s
    borders: Annotated[tuple[Number, ...], Meta(min_length=4, max_length=4)]  # of the three bands, Hz


@dataclass(frozen=True)
class LevelErrors:
    """Rms errors of the levels of the partials up to `LEVEL_TOP` and within `LEVEL_RANGE`, dB, one gain removed."""

    initial_db: Number
    fitted_db: Number
    initial_hammer_db: Number | None  # of the initial hammer at its best velocities and output path
    partials: int


@dataclass(frozen=True, eq=False)
class PartialLevels:
    """Compared levels of one recording, dB in the unit of the pickup [partials]."""

    number: np.ndarray
    measured: np.ndarray
    error: np.ndarray  # one standard deviation of the measured levels
    initial: np.ndarray
    fitted: np.ndarray

    def __post_init__(self) -> None:
        if len({column.shape for column in vars(self).values()}) != 1 or self.number.ndim != 1 or not len(self.number):
            raise ValueError("Expected columns of one length, with at least one partial")
        if not ((self.number % 1 == 0) & (self.number >= 1)).all():
            raise ValueError("number must hold whole numbers of at least 1")
        object.__setattr__(self, "number", self.number.astype(int))


@dataclass(frozen=True, kw_only=True)
class NoteRecording:
    """The entries of a reference recording that a note needs."""

    gain: Number  # file units per unit of the pickup
    rate: Rate  # Hz


@dataclass(frozen=True, kw_only=True)
class RecordingFit(NoteRecording):
    """One recording, its stroke and the errors of the fit."""

    file: str
    sha256: str
    channel: str
    onset_s: Number
    stroke_value: Number  # of the stroke's parameter, `Fit.stroke_name`: v_H0, m/s, or x0, m
    stroke_interval: tuple[Number, Number] | None
    stroke_status: Status
    stroke_initial: Number | None
    note: str | None  # of the analysis
    gain_status: Literal["given", "fitted"]
    is_reference: bool
    pitch_offset_cents: Number  # over the pitch of the reference
    path_group: int
    stroke: int
    criterion: Criterion
    levels: LevelErrors
    partials: PartialLevels
    midi_velocity: MidiVelocity | None = None  # of the layer in its library, if the setup gives it


@dataclass(frozen=True, eq=False)
class Minimum:
    """One minimum of the objective."""

    weight: Number  # of the posterior
    negative_log_posterior: Number
    parameters: dict[str, Number]
    stroke_values: np.ndarray  # of the strokes' parameter: velocities, m/s, or plucking positions, m [strokes]
    path_db: np.ndarray | None  # at the frequencies of `Pickup.path`
    path_velocity_discrepancy: VelocityDiscrepancyEntry | None
    covariance: Covariance | None = None  # of the logarithms of the parameters and velocities

    def values(self, fit: Fit) -> dict[str, float]:
        """Return the parameters with that of the reference stroke of `fit`."""
        strokes, index = self.stroke_values, fit.reference.stroke
        own = {fit.stroke_name: float(strokes[index])} if 0 <= index < len(strokes) else {}
        return own | self.parameters


@dataclass(frozen=True)
class DrawsFile:
    """The file of the posterior draws."""

    file: str
    sha256: str


@dataclass(frozen=True, eq=False, kw_only=True)
class NoteFile:
    """The entries that define a note."""

    schema: int = FIT_SCHEMA
    program: str = "pianofit"
    kind: str = "note"
    parameters: Quantities
    recordings: tuple[NoteRecording, ...]
    pickup: Pickup
    excitation: ExcitationName = HAMMER
    felt: str = DEFAULT_LAW.name  # name of the felt law; "pluck" without a hammer
    modal_response: FittedModalResponse | None = None

    def __post_init__(self) -> None:
        if not self.recordings:
            raise ValueError("recordings is empty")

    @property
    def reference_index(self) -> int:
        """Index of the reference recording; a note has only this one."""
        return 0


@dataclass(frozen=True, eq=False, kw_only=True)
class Fit(NoteFile):
    """A fit: all that it reports."""

    recipe: str
    seed: int
    converged: bool
    identifiability_statement: str
    warnings: tuple[str, ...]  # the most important first
    invariants: Quantities  # quantities that do not depend on an assumed length or mass
    parameters: Quantities
    recordings: tuple[RecordingFit, ...]  # in the order given
    minima: tuple[Minimum, ...]  # by posterior weight; the paper's methods have none
    derived: Derived
    criterion: Criterion  # of the reference recording
    levels: LevelErrors  # of all recordings
    diagnostics: Diagnostics
    prior: KeyPrior | None = None  # of the other keys of the keyboard; None if the literature's was used
    draws: DrawsFile | None = None
    versions: dict[str, str] = field(default_factory=dict)
    kind: str = "fit"

    @property
    def reference_index(self) -> int:
        """Index of the reference recording: the marked one, or the first."""
        return next((i for i, recording in enumerate(self.recordings) if recording.is_reference), 0)

    @property
    def reference(self) -> RecordingFit:
        """The reference recording, which sets the pitch and is reported first."""
        return self.recordings[self.reference_index]

    @property
    def path_groups(self) -> dict[int, list[int]]:
        """Indices of the recordings by path group."""
        numbers = sorted({recording.path_group for recording in self.recordings})
        return {n: [i for i, r in enumerate(self.recordings) if r.path_group == n] for n in numbers}

    @property
    def covariance(self) -> Covariance | None:
        """Covariance of the logarithms at the best minimum; None without minima."""
        return self.minima[0].covariance if self.minima else None

    @property
    def stroke_name(self) -> str:
        """Name of the parameter that differs from stroke to stroke."""
        return STROKES[self.excitation].name

    @property
    def velocity_scale_open(self) -> bool:
        """True if one common factor of the velocities is unknown: neither a velocity nor the gain was given."""
        is_open = STROKES[self.excitation].scale_is_open
        return is_open and not any("given" in (own.gain_status, own.stroke_status) for own in self.recordings)

    @property
    def has_intervals(self) -> bool:
        """True if a parameter has an interval; fits by the paper's methods have none."""
        return any(quantity.interval for quantity in self.parameters.values())

    def with_paths(self, paths: Mapping[str, str]) -> Fit:
        """Return the fit with other paths of its recordings, new by old, in entries and in sentences."""

        def new(text: str) -> str:
            return replace_paths(text, paths)

        response = self.modal_response
        layers = () if response is None else (replace(layer, file=new(layer.file)) for layer in response.layers)
        return replace(
            self,
            identifiability_statement=new(self.identifiability_statement),
            warnings=tuple(map(new, self.warnings)),
            invariants=Quantities.of(
                replace(quantity, note=new(quantity.note)) for quantity in self.invariants.values()
            ),
            recordings=tuple(replace(recording, file=new(recording.file)) for recording in self.recordings),
            modal_response=response and replace(response, layers=tuple(layers)),
        )

    def relative_gains(self, index: int | None = None) -> tuple[float, ...]:
        """Gains of the recordings in the path group of one, dB relative to it; `index` is the reference if None."""
        own = self.recordings[self.reference_index if index is None else index]
        gains = [other.gain for other in self.recordings if other.path_group == own.path_group]
        if not own.gain:
            return (0.0,)
        return tuple(20 * np.log10(abs(gain / own.gain)) for gain in gains if gain) or (0.0,)


def package_versions() -> dict[str, str]:
    """Return the versions of the program and of the packages that its numbers depend on."""
    own = {"pianofit": __version__, "python": platform.python_version()}
    return own | {name: version(name) for name in ("jax", "numpy", "scipy")}


# --- reading ----------------------------------------------------------------------------------------------------------


def fit_path(path: str | os.PathLike[str]) -> Path:
    """Return the `fit.json` in a folder, or the file itself."""
    path_name(path)
    return Path(path) / "fit.json" if Path(path).is_dir() else Path(path)


def key_files(folder: Path, name: str = "fit.json") -> list[Path]:
    """Return the files of a name that a folder holds for its keys: in `keys/KEY`, or in folders, or in itself."""
    patterns = (f"keys/*/{name}", f"*/{name}", name)
    return next((found for pattern in patterns if (found := sorted(folder.glob(pattern)))), [])


def read_fit(path: str | os.PathLike[str]) -> Fit:
    """Read a `fit.json`; raise a `FitError` for any other file, which names the file and the entry."""
    return convert(_content(path), Fit, printable(path), HINT)


def read_note_file(path: str | os.PathLike[str]) -> NoteFile:
    """Read a `fit.json`, or a `note.json` of the page to play; errors as in `read_fit`."""
    content = _content(path)
    return convert(content, NoteFile if content.get("kind") == "note" else Fit, printable(path), HINT)


def _content(path: str | os.PathLike[str]) -> dict[str, Any]:
    content = load_json(path, LARGEST_FIT, "a fit.json", HINT)
    kind = content.get("kind", "fit") if isinstance(content, dict) else type(content).__name__
    if kind not in KINDS:
        raise FitError(f"{printable(path)}: is not a fit.json but of kind {short_repr(kind)}; {HINT}")
    schema = content.get("schema")
    if schema != FIT_SCHEMA:
        raise FitError(
            f"{printable(path)}: schema {schema!r} is not {FIT_SCHEMA}; fit again with this version of pianofit"
        )
    return content
