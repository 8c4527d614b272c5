"""Files of a modal response: the modes in `fit.json`, and the knock as a sound file next to it."""

from __future__ import annotations

import base64
import io
from pathlib import Path
from typing import Any

import numpy as np

from .errors import FitError
from .io.audio import RATES
from .io.files import MAX_CHANNELS, array_of, encode_pcm, is_increasing, read_file, require_finite
from .model.modal_response import ModalResponse, VelocityGain

__all__ = ["KNOCK_FILE", "encode_knock", "read_modal_response", "modal_response_document"]

KNOCK_FILE = "knock.flac"
# Largest file of a knock, bytes: half a second of eight channels at the highest rate.
LARGEST_KNOCK = 2**23
# Most samples of a knock: half a second at the highest rate. A small compressed file could hold more.
MOST_FRAMES = RATES[1] // 2
# Most modes in a file.
MOST_MODES = 4096
# Most strokes in a file: a library has some dozens of layers.
MOST_STROKES = 256
# Largest velocity gain as a factor, far beyond the differences between strokes.
LARGEST_VELOCITY_GAIN = 1e6
# Largest frequency, Hz, decay, 1/s, and pattern: far beyond real ones, and all computations stay finite.
LARGEST_NUMBER = 1e12
# First bytes of the formats that may hold a knock. A page writes WAV, a fit writes FLAC.
MAGIC = {"flac": b"fLaC", "wav": b"RIFF"}
HINT = "give the files that pianofit fit wrote"


def modal_response_document(ringing: ModalResponse, *, whole: bool = False) -> dict[str, Any]:
    """The modes as columns, Hz and 1/s, patterns per channel, velocity gain per stroke, and the knock.

    The entry of the knock names the file `KNOCK_FILE`. With `whole` it contains the knock itself, as FLAC of 16 bits in
    base64. This takes half the size of 24 bits. The quantisation error lies 80 dB or more below a note's peak.
    """
    pole, error = ringing.pole, ringing.pole_error
    modes = {
        "partial": ringing.number,
        "frequency": np.imag(pole) / (2 * np.pi),
        "frequency_error": error / (2 * np.pi),
        "decay": -np.real(pole),
        "decay_error": error,
    }
    part = ringing.velocity_gain
    strokes = None if part is None else {"velocity": part.velocity.tolist(), "strokes": _rows(part.factor)}
    flac = encode_knock(ringing, 16 if whole else 24)
    knock = None
    if flac is not None:
        data = {"flac": base64.b64encode(flac).decode()} if whole else {"file": KNOCK_FILE}
        knock = data | {"scale": float(np.abs(ringing.knock).max()), "rate": ringing.rate}
    return {
        "modes": {name: column.tolist() for name, column in modes.items()},
        "pattern": _rows(ringing.pattern),
        "participation": strokes,
        "knock": knock,
    }


def _rows(values: np.ndarray) -> list[dict[str, list[float]]]:
    """Complex rows for JSON."""
    return [{"real": np.real(row).tolist(), "imag": np.imag(row).tolist()} for row in values]


def encode_knock(ringing: ModalResponse, bits: int = 24) -> bytes | None:
    """The knock, normalised to its largest sample, as FLAC; None if there is none."""
    size = float(np.abs(ringing.knock).max(initial=0.0))
    return encode_pcm(ringing.knock / size, ringing.rate, "flac", bits) if size else None


def read_modal_response(entry: Any, folder: Path | None, name: str) -> ModalResponse | None:
    """Read the entry that `ringing_document` wrote; None if the key uses the string model alone.

    The knock is in the document, as FLAC or WAV in base64, or else a file in `folder`. Missing errors of modes count as
    0. The velocity gain is optional.

    Raises `FitError`, beginning with `name`, if an entry or the knock is missing, of the wrong type, or out of range.
    """
    if entry is None or (isinstance(entry, dict) and entry.get("by") == "law"):
        return None
    if not isinstance(entry, dict):
        raise FitError(f"{name}: ringing must be a table; {HINT}")
    modes = entry["modes"] if isinstance(entry.get("modes"), dict) else {}
    names = ("partial", "frequency", "decay", *(["decay_error"] if "decay_error" in modes else []))
    table, parts = array_of([modes.get(name) for name in names], None, None), _parts(entry.get("pattern"))
    consistent = 1 <= table.shape[1] == parts.shape[2] <= MOST_MODES and len(parts) <= MAX_CHANNELS
    if not (consistent and (np.abs(table) <= LARGEST_NUMBER).all() and (np.abs(parts) <= LARGEST_NUMBER).all()):
        raise FitError(
            f"{name}: ringing needs columns and patterns of equal length, with numbers up to {LARGEST_NUMBER:g}; {HINT}"
        )
    number, frequency, decay, error = (*table, np.zeros(table.shape[1]))[:4]
    if not ((frequency > 0).all() and (decay > 0).all() and (error >= 0).all()):
        raise FitError(f"{name}: frequencies and decays of ringing must be above 0, errors 0 or more; {HINT}")
    if not ((number % 1 == 0) & (number >= 1) & (number <= MOST_MODES)).all():
        raise FitError(f"{name}: partials of ringing must be whole numbers from 1 to {MOST_MODES}; {HINT}")
    part = _velocity_gain(entry.get("participation"), len(number), name)
    pole, pattern = -decay + 2j * np.pi * frequency, parts[:, 0] + 1j * parts[:, 1]
    knock, rate = _knock(entry.get("knock"), folder, len(parts), name)
    return ModalResponse(number.astype(int), pole, error, pattern, knock, rate, part)


def _parts(rows: Any) -> np.ndarray:
    """Read the rows that `_rows` wrote [rows, real and imaginary, columns]; empty if they are malformed."""
    tables = [row if isinstance(row, dict) else {} for row in rows] if isinstance(rows, list) else []
    return array_of([[row.get("real"), row.get("imag")] for row in tables], None, 2, None)


def _velocity_gain(entry: Any, modes: int, name: str) -> VelocityGain | None:
    if entry is None:
        return None
    table: dict[str, Any] = entry if isinstance(entry, dict) else {}
    velocity, parts = array_of(table.get("velocity"), None), _parts(table.get("strokes"))
    consistent = 1 <= len(velocity) <= MOST_STROKES and parts.shape == (len(velocity), 2, modes)
    if not (consistent and (np.abs(parts) <= LARGEST_VELOCITY_GAIN).all()):
        raise FitError(
            f"{name}: participation needs 1 to {MOST_STROKES} velocities, and for each one a number up to "
            f"{LARGEST_VELOCITY_GAIN:g} for every mode; {HINT}"
        )
    if not (is_increasing(velocity) and velocity[-1] <= LARGEST_NUMBER):
        raise FitError(f"{name}: velocities of participation must rise from above 0; {HINT}")
    return VelocityGain(velocity, parts[:, 0] + 1j * parts[:, 1])


def _knock(entry: Any, folder: Path | None, channels: int, name: str) -> tuple[np.ndarray, int]:
    if entry is None:
        return np.zeros((channels, 0)), RATES[0]
    import soundfile

    if not isinstance(entry, dict):
        raise FitError(f"{name}: ringing.knock must be a table; {HINT}")
    scale = require_finite(entry.get("scale"), f"{name}: ringing.knock.scale", HINT)
    # Only this file is opened, whatever name the document contains.
    kind = "wav" if "wav" in entry else "flac"
    if folder is None or kind in entry:
        path = f"{name}: ringing.knock.{kind}"
        data = _decoded(entry.get(kind), path)
    else:
        path = folder / KNOCK_FILE
        data = read_file(path, LARGEST_KNOCK, FitError)
    if data[:4] != MAGIC[kind]:  # no other decoder may read the data
        raise FitError(f"{path}: is not a {kind.upper()} file; {HINT}")
    try:
        samples, rate = soundfile.read(io.BytesIO(data), frames=MOST_FRAMES, always_2d=True)
    except soundfile.LibsndfileError as problem:
        raise FitError(f"{path}: cannot be read ({problem.error_string}); {HINT}") from None
    if not (scale > 0 and np.isfinite(samples).all()):
        raise FitError(f"{path}: samples must be finite, and the scale must be above 0; {HINT}")
    if samples.shape[1] != channels or not RATES[0] <= rate <= RATES[1]:
        raise FitError(f"{path}: has {samples.shape[1]} channels at {rate} Hz, which does not match this fit; {HINT}")
    return scale * samples.T, rate


def _decoded(text: Any, where: str) -> bytes:
    try:
        if isinstance(text, str) and len(text) <= LARGEST_KNOCK:
            return base64.b64decode(text, validate=True)
    except ValueError:
        pass
    raise FitError(f"{where} must be base64 of at most {LARGEST_KNOCK / 2**20:g} MiB; {HINT}")
