"""The modal response of a key in files: modes as columns, and the knock as a sound."""

from __future__ import annotations

import base64
import io
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from ..errors import FitError
from ..io.containers import RATES
from ..io.files import MAX_CHANNELS, encode_pcm, read_file
from ..model.modal_response import ModalResponse, VelocityGain
from .decode import Number

KNOCK_FILE = "knock.flac"
# Names of the render models, the simplest first; "string model" uses no measured modes.
RenderModel = Literal["string model", "modes", "modes and knock"]
RENDER_MODELS: tuple[RenderModel, ...] = ("string model", "modes", "modes and knock")
# Largest file of a knock, bytes: half a second of eight channels at the highest rate.
LARGEST_KNOCK = 2**23
# Most samples of a knock: half a second at the highest rate. A small compressed file could hold more.
MOST_FRAMES = RATES[1] // 2
# Lowest sample rate of a knock, Hz: instruments that a page saves have the reduced rates of the page.
LOWEST_RATE = 4_000
# Most modes, and most strokes, in a file: a library has some dozens of layers.
MOST_MODES, MOST_STROKES = 4096, 256
# Largest velocity gain as a factor, far beyond the differences between strokes.
LARGEST_VELOCITY_GAIN = 1e6
# Largest frequency, Hz, decay, 1/s, and amplitude: far beyond real ones, and all computations stay finite.
LARGEST_NUMBER = 1e12
# First bytes of the formats that may hold a knock. A page writes WAV, a fit writes FLAC.
MAGIC = {"flac": b"fLaC", "wav": b"RIFF"}
HINT = "give the files that pianofit fit wrote"


@dataclass(frozen=True, eq=False)
class ComplexRow:
    """Complex numbers."""

    real: np.ndarray
    imag: np.ndarray

    def __post_init__(self) -> None:
        if self.real.shape != self.imag.shape or self.real.ndim != 1:
            raise ValueError("Expected real and imaginary parts of one length")

    @classmethod
    def rows(cls, values: np.ndarray) -> tuple[ComplexRow, ...]:
        """Return the rows of a complex matrix."""
        return tuple(cls(np.real(row), np.imag(row)) for row in values)


def _matrix(rows: tuple[ComplexRow, ...]) -> np.ndarray:
    return np.array([row.real + 1j * row.imag for row in rows])


@dataclass(frozen=True, eq=False)
class ModeTable:
    """Modes as columns [modes]."""

    partial: np.ndarray
    frequency: np.ndarray  # Hz
    decay: np.ndarray  # 1/s
    frequency_error: np.ndarray | None = None  # standard errors; 0 if None
    decay_error: np.ndarray | None = None

    def __post_init__(self) -> None:
        columns = [column for column in vars(self).values() if column is not None]
        if {column.shape for column in columns} != {(len(columns[0]),)} or not 1 <= len(columns[0]) <= MOST_MODES:
            raise ValueError(f"Expected 1 to {MOST_MODES} modes in columns of one length")
        if max(np.abs(column).max() for column in columns) > LARGEST_NUMBER:
            raise ValueError(f"Expected numbers up to {LARGEST_NUMBER:g}")
        if min(self.frequency.min(), self.decay.min()) <= 0 or (
            self.decay_error is not None and self.decay_error.min() < 0
        ):
            raise ValueError("Expected frequencies and decays above 0, and errors of 0 or more")
        if not ((self.partial % 1 == 0) & (self.partial >= 1) & (self.partial <= MOST_MODES)).all():
            raise ValueError(f"Expected partials that are whole numbers from 1 to {MOST_MODES}")
        object.__setattr__(self, "partial", self.partial.astype(int))


@dataclass(frozen=True, eq=False)
class VelocityGainEntry:
    """Velocity gain: a complex factor of each mode for each stroke, at increasing velocities, m/s."""

    velocity: np.ndarray
    strokes: tuple[ComplexRow, ...]

    def __post_init__(self) -> None:
        velocity, sizes = self.velocity, {len(row.real) for row in self.strokes}
        if velocity.ndim != 1 or not 1 <= len(velocity) <= MOST_STROKES or len(velocity) != len(self.strokes):
            raise ValueError(f"Expected 1 to {MOST_STROKES} velocities, and a row for each")
        if len(sizes) != 1 or np.abs(_matrix(self.strokes)).max(initial=0.0) > LARGEST_VELOCITY_GAIN:
            raise ValueError(f"Expected a number up to {LARGEST_VELOCITY_GAIN:g} for every mode")
        if not ((np.diff(velocity, prepend=0.0) > 0).all() and velocity[-1] <= LARGEST_NUMBER):
            raise ValueError("Expected velocities that rise from above 0")


@dataclass(frozen=True)
class Knock:
    """A knock: a file next to this one, or the sound itself in base64, divided by `scale`."""

    scale: Number  # full scale in units of the amplitudes
    rate: int | None = None  # Hz
    file: str | None = None
    flac: str | None = None
    wav: str | None = None

    def __post_init__(self) -> None:
        if not self.scale > 0:
            raise ValueError("Expected a scale above 0")

    def samples(self, folder: Path | None, channels: int, name: str) -> tuple[np.ndarray, int]:
        """Return the knock [channels, samples] and its rate, Hz; only `KNOCK_FILE` of the `folder` is opened."""
        if folder is None or self.flac is not None or self.wav is not None:
            samples, rate = decode_embedded(self.flac, self.wav, f"{name}: modal_response.knock", channels)
        else:
            path = folder / KNOCK_FILE
            samples, rate = decode_sound(read_file(path, LARGEST_KNOCK, FitError), "flac", path, channels)
        return self.scale * samples, rate


@dataclass(frozen=True, kw_only=True)
class ModalResponseEntry:
    """Modes, their amplitudes per channel, velocity gain and knock."""

    modes: ModeTable
    modal_amplitudes: tuple[ComplexRow, ...]  # of each channel, in file units per N s, divided by a recording's gain
    velocity_gain: VelocityGainEntry | None = None
    knock: Knock | None = None

    def __post_init__(self) -> None:
        rows, modes = self.modal_amplitudes, len(self.modes.partial)
        if not 1 <= len(rows) <= MAX_CHANNELS or {len(row.real) for row in rows} != {modes}:
            raise ValueError(f"Expected amplitudes of every mode for 1 to {MAX_CHANNELS} channels")
        if np.abs(_matrix(rows)).max() > LARGEST_NUMBER:
            raise ValueError(f"Expected amplitudes up to {LARGEST_NUMBER:g}")
        if self.velocity_gain is not None and len(self.velocity_gain.strokes[0].real) != modes:
            raise ValueError("Expected a velocity gain of every mode")

    @classmethod
    def of(cls, response: ModalResponse, *, embed_knock: bool = False) -> ModalResponseEntry:
        """Return the entry of a response. The knock is the file `KNOCK_FILE`, or with `embed_knock` in the entry."""
        pole, error, gain = response.pole, response.pole_error, response.velocity_gain
        modes = ModeTable(response.partial, np.imag(pole) / (2 * np.pi), -np.real(pole), error / (2 * np.pi), error)
        scale, sound, knock = float(np.abs(response.knock).max(initial=0.0)), encode_knock(response), None
        if sound is not None:
            place = {"flac": base64.b64encode(sound).decode()} if embed_knock else {"file": KNOCK_FILE}
            knock = Knock(scale, response.rate, **place)
        return cls(
            modes=modes,
            modal_amplitudes=ComplexRow.rows(response.pattern),
            velocity_gain=None if gain is None else VelocityGainEntry(gain.velocity, ComplexRow.rows(gain.factor)),
            knock=knock,
        )

    def response(self, folder: Path | None, name: str) -> ModalResponse:
        """Return the response of the model. The knock is inside the entry, or else a file in `folder`.

        Raises `FitError` if the knock cannot be read. The message begins with `name` or with its path.
        """
        table, gain, amplitudes = self.modes, self.velocity_gain, _matrix(self.modal_amplitudes)
        error = np.zeros(len(table.decay)) if table.decay_error is None else table.decay_error
        knock, rate = np.zeros((len(amplitudes), 0)), RATES[0]
        if self.knock is not None:
            knock, rate = self.knock.samples(folder, len(amplitudes), name)
        pole = -table.decay + 2j * np.pi * table.frequency
        factor = None if gain is None else VelocityGain(gain.velocity, _matrix(gain.strokes))
        return ModalResponse(table.partial, pole, error, amplitudes, knock, rate, factor)


@dataclass(frozen=True)
class LayerEntry:
    """A layer of the modal response."""

    file: str
    contact_s: Number  # first contact after the onset


@dataclass(frozen=True, kw_only=True)
class FittedModalResponse:
    """The choice of a key's render model, and its modes unless the string model is used alone."""

    render_model: RenderModel = "modes and knock"
    leave_one_out_db: dict[RenderModel, Number] | None = None  # mean error of predicted layers by render model, dB
    layers: tuple[LayerEntry, ...] = ()  # soft to loud
    response: ModalResponseEntry | None = None

    @property
    def prediction_error_db(self) -> float | None:
        """Mean error of predicted layers by the render model that is used, dB; None if it was not tested."""
        return None if self.leave_one_out_db is None else self.leave_one_out_db.get(self.render_model)


def encode_knock(response: ModalResponse) -> bytes | None:
    """Return the knock, normalised to its largest sample, as FLAC of 24 bits; None if there is none.

    The laws of guessed knocks follow from faint parts of the recorded ones, which 16 bits would change by decibels.
    """
    size = float(np.abs(response.knock).max(initial=0.0))
    return encode_pcm(response.knock / size, response.rate, "flac") if size else None


def decode_sound(data: bytes, kind: str, path: object, channels: int | None = None) -> tuple[np.ndarray, int]:
    """Return the sound of a FLAC or WAV file [channels, samples] and its rate, Hz. Errors begin with `path`."""
    import soundfile

    if data[:4] != MAGIC[kind]:  # no other decoder may read the data
        raise FitError(f"{path}: is not a {kind.upper()} file; {HINT}")
    try:
        samples, rate = soundfile.read(io.BytesIO(data), frames=MOST_FRAMES, always_2d=True)
    except soundfile.LibsndfileError as problem:
        raise FitError(f"{path}: cannot be read ({problem.error_string}); {HINT}") from None
    if not np.isfinite(samples).all():
        raise FitError(f"{path}: samples must be finite; {HINT}")
    if samples.shape[1] != (channels or samples.shape[1]) or not LOWEST_RATE <= rate <= RATES[1]:
        raise FitError(f"{path}: has {samples.shape[1]} channels at {rate} Hz, which does not match this fit; {HINT}")
    return samples.T, rate


def encode_embedded(samples: np.ndarray, rate: int) -> str:
    """Return a short sound [channels, samples] as FLAC of 16 bits in base64.

    16 bits take half the size of 24, and are enough to listen to.
    """
    return base64.b64encode(encode_pcm(samples, rate, "flac", 16)).decode()


def decode_embedded(
    flac: str | None, wav: str | None, where: str, channels: int | None = None
) -> tuple[np.ndarray, int]:
    """Return a short sound from FLAC or WAV in base64, as `decode_sound`. Errors name `where` the entry is."""
    kind, text = ("flac", flac) if wav is None else ("wav", wav)
    data = None
    if text is not None and len(text) <= LARGEST_KNOCK:
        with suppress(ValueError):
            data = base64.b64decode(text, validate=True)
    if data is None:
        raise FitError(f"{where}.{kind} must be base64 of at most {LARGEST_KNOCK / 2**20:g} MiB; {HINT}")
    return decode_sound(data, kind, f"{where}.{kind}", channels)
