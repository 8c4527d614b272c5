"""A data set of synthetic notes: frozen records whose fields are the keys of its `dataset.json`."""

import os
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Literal

from msgspec import Meta

from ..errors import OutputError
from .decode import Number, load_record

DATASET_FILE = "dataset.json"
# Largest dataset.json, bytes.
LARGEST_DATASET = 2**20
HINT = "give the folder that pianofit dataset wrote, or another --out"
SoundFormat = Literal["flac", "wav", "npz"]
Whole = Annotated[int, Meta(ge=0)]
if TYPE_CHECKING:
    AnyPath = str | os.PathLike[str]
    Keys = tuple[str | int, str | int] | list[str | int] | list[str] | list[int]
    Levels = tuple[float, float] | list[float]
else:  # the types in files, which msgspec checks
    AnyPath, Keys, Levels = str, tuple[str | int, str | int], tuple[float, float]


@dataclass(frozen=True)
class NoteOptions:
    """Choice of synthetic notes, for `pianofit.notes` and `pianofit.write_dataset`.

    Without `around`, every note belongs to another piano: its string, hammer and felt are drawn from the priors about
    the literature's values for its key. With `around`, they are drawn about a fitted key.

    Parameters
    ----------
    keys : lowest and highest key, as names or MIDI numbers. All keys between them are equally probable.
    seconds : length of every sound, s.
    rate : sample rate, Hz.
    layers : strokes of every note, from soft to loud. They share string, hammer and gain.
    path : filter every note by an output path that is drawn from its prior. A fitted note keeps its own path.
    noise_db : level of white noise below the rms of the loudest layer, dB, or the lowest and highest level. If None,
        no noise.
    modal_response : render the measured modes and knock of a fitted key, in place of the string model.
    around : a `fit.json`, an `instrument.json`, or the folder of one.
    spread : factor of the priors' standard deviations, of all parameters except the velocity.

    Examples
    --------
    Three octaves, four layers a note, with an output path and noise:

    >>> import pianofit
    >>> options = pianofit.NoteOptions(keys=("C3", "C6"), layers=4, path=True, noise_db=(40.0, 70.0))
    >>> options.rate
    44100
    """

    keys: Keys | None = None
    seconds: float = 1.0
    rate: int = 44_100
    layers: int = 1
    path: bool = False
    noise_db: float | Levels | None = None
    modal_response: bool = False
    around: AnyPath | None = None
    spread: float = 1.0

    def __post_init__(self) -> None:
        if isinstance(self.around, os.PathLike):
            object.__setattr__(self, "around", os.fspath(self.around))


@dataclass(frozen=True)
class Column:
    """One column of the table of a data set."""

    name: str
    unit: str  # empty for names and files
    meaning: str


@dataclass(frozen=True, kw_only=True)
class DatasetFile:
    """The content of a `dataset.json`."""

    kind: Literal["dataset"] = "dataset"
    schema: int = 1
    pianofit: str  # version
    seed: Whole
    count: Whole  # notes
    format: SoundFormat
    options: NoteOptions
    around_sha256: str | None  # of the file that the notes are drawn around
    path_frequencies_hz: tuple[Number, ...]  # of the columns `path_...`
    columns: tuple[Column, ...]


def read_dataset_file(path: str | os.PathLike[str]) -> DatasetFile:
    """Read a `dataset.json`; raise an `OutputError` for any other file, which names the file and the entry."""
    return load_record(path, DatasetFile, LARGEST_DATASET, f"a {DATASET_FILE}", HINT, OutputError)
