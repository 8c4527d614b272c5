"""How a key rings, as files hold it: the modes in `fit.json`, the knock as a sound beside it."""

from __future__ import annotations

import base64
import io
from pathlib import Path
from typing import Any

import numpy as np

from .errors import FitError
from .io.audio import RATES
from .io.files import MOST_CHANNELS, array_of, encode_pcm, is_increasing, read_file, require_finite
from .model.modal_response import ModalResponse, VelocityGain

__all__ = ["KNOCK_FILE", "encode_knock", "read_ringing", "ringing_document"]

KNOCK_FILE = "knock.flac"
# Bytes of a knock at the most: half a second of eight channels at the highest rate.
LARGEST_KNOCK = 2**23
# Samples of one at the most: half a second at the highest rate, however few bytes they take.
MOST_FRAMES = RATES[1] // 2
# Modes at the most that a file may hold.
MOST_MODES = 4096
# Strokes at the most: a library has some dozens of layers.
MOST_STROKES = 256
# Parts that modes take in a stroke at the most: far more than hammers differ by.
MOST_PART = 1e6
# Frequencies, Hz, decays, 1/s, and patterns at the most, far beyond any: what is computed of them stays finite.
LARGEST_NUMBER = 1e12
# What the files begin with that may hold a knock: a page writes WAV, a fit FLAC.
MAGIC = {"flac": b"fLaC", "wav": b"RIFF"}
WAY_OUT = "give the files that pianofit fit wrote"


def ringing_document(ringing: ModalResponse, *, whole: bool = False) -> dict[str, Any]:
    """The modes as columns, Hz and 1/s, patterns per channel, participation per stroke, and the knock.

    The knock is the file beside the document, or the `whole` of it.

    A knock within the document is FLAC of 16 bits in base64: half of what 24 bits take, and what is lost lies 80 dB or
    more below a note's peak.
    """
    pole, error = ringing.pole, ringing.pole_error
    modes = {
        "partial": ringing.number, "frequency": np.imag(pole) / (2 * np.pi), "frequency_error": error / (2 * np.pi),
        "decay": -np.real(pole), "decay_error": error,
    }  # fmt: skip
    part = ringing.participation
    strokes = None if part is None else {"velocity": part.velocity.tolist(), "strokes": _rows(part.factor)}
    flac = encode_knock(ringing, 16 if whole else 24)
    knock = None
    if flac is not None:
        held = {"flac": base64.b64encode(flac).decode()} if whole else {"file": KNOCK_FILE}
        knock = held | {"scale": float(np.abs(ringing.knock).max()), "rate": ringing.rate}
    return {
        "modes": {name: column.tolist() for name, column in modes.items()}, "pattern": _rows(ringing.pattern),
        "participation": strokes, "knock": knock,
    }  # fmt: skip


def _rows(values: np.ndarray) -> list[dict[str, list[float]]]:
    """Complex rows, in JSON."""
    return [{"real": np.real(row).tolist(), "imag": np.imag(row).tolist()} for row in values]


def encode_knock(ringing: ModalResponse, bits: int = 24) -> bytes | None:
    """The knock over its largest sample as FLAC; None without one."""
    size = float(np.abs(ringing.knock).max(initial=0.0))
    return encode_pcm(ringing.knock / size, ringing.rate, "flac", bits) if size else None


def read_ringing(entry: Any, folder: Path | None, name: str) -> ModalResponse | None:
    """What `ringing_document` wrote; None where a key rings by its law.

    The knock lies in the document, as FLAC or WAV in base64, or else in `folder`, unless that is None. Modes may lack
    their errors, which then count as none, and a participation.

    Raises `FitError`, opening with `name`, if an entry or the knock is missing, of another kind, or out of range.
    """
    if entry is None or (isinstance(entry, dict) and entry.get("by") == "law"):
        return None
    if not isinstance(entry, dict):
        raise FitError(f"{name}: ringing must be a table; {WAY_OUT}")
    modes = entry["modes"] if isinstance(entry.get("modes"), dict) else {}
    names = ("partial", "frequency", "decay", *(["decay_error"] if "decay_error" in modes else []))
    table, parts = array_of([modes.get(name) for name in names], None, None), _parts(entry.get("pattern"))
    whole = 1 <= table.shape[1] == parts.shape[2] <= MOST_MODES and len(parts) <= MOST_CHANNELS
    if not (whole and (np.abs(table) <= LARGEST_NUMBER).all() and (np.abs(parts) <= LARGEST_NUMBER).all()):
        raise FitError(
            f"{name}: ringing needs as many numbers up to {LARGEST_NUMBER:g} in every column and pattern; {WAY_OUT}"
        )
    number, frequency, decay, error = (*table, np.zeros(table.shape[1]))[:4]
    if not ((frequency > 0).all() and (decay > 0).all() and (error >= 0).all()):
        raise FitError(f"{name}: ringing has frequencies, decays or errors that are not above 0; {WAY_OUT}")
    if not ((number % 1 == 0) & (number >= 1) & (number <= MOST_MODES)).all():
        raise FitError(f"{name}: ringing has partials whose numbers are not 1, 2, 3 ...; {WAY_OUT}")
    part = _participation(entry.get("participation"), len(number), name)
    pole, pattern = -decay + 2j * np.pi * frequency, parts[:, 0] + 1j * parts[:, 1]
    knock, rate = _knock(entry.get("knock"), folder, len(parts), name)
    return ModalResponse(number.astype(int), pole, error, pattern, knock, rate, part)


def _parts(rows: Any) -> np.ndarray:
    """What `_rows` wrote [rows, real and imaginary, columns]; empty, if it did not."""
    tables = [row if isinstance(row, dict) else {} for row in rows] if isinstance(rows, list) else []
    return array_of([[row.get("real"), row.get("imag")] for row in tables], None, 2, None)


def _participation(entry: Any, modes: int, name: str) -> VelocityGain | None:
    if entry is None:
        return None
    table: dict[str, Any] = entry if isinstance(entry, dict) else {}
    velocity, parts = array_of(table.get("velocity"), None), _parts(table.get("strokes"))
    known = 1 <= len(velocity) <= MOST_STROKES and parts.shape == (len(velocity), 2, modes)
    if not (known and (np.abs(parts) <= MOST_PART).all()):
        raise FitError(
            f"{name}: participation needs, for each of 1 to {MOST_STROKES} velocities, a number up to {MOST_PART:g} "
            f"for every mode; {WAY_OUT}"
        )
    if not (is_increasing(velocity) and velocity[-1] <= LARGEST_NUMBER):
        raise FitError(f"{name}: velocities of participation must rise from above 0; {WAY_OUT}")
    return VelocityGain(velocity, parts[:, 0] + 1j * parts[:, 1])


def _knock(entry: Any, folder: Path | None, channels: int, name: str) -> tuple[np.ndarray, int]:
    if entry is None:
        return np.zeros((channels, 0)), RATES[0]
    import soundfile

    if not isinstance(entry, dict):
        raise FitError(f"{name}: ringing.knock must be a table; {WAY_OUT}")
    scale = require_finite(entry.get("scale"), f"{name}: ringing.knock.scale", WAY_OUT)
    # Wherever the document says, no other file is opened.
    kind = "wav" if "wav" in entry else "flac"
    if folder is None or kind in entry:
        path = f"{name}: ringing.knock.{kind}"
        held = _decoded(entry.get(kind), path)
    else:
        path = folder / KNOCK_FILE
        held = read_file(path, LARGEST_KNOCK, FitError)
    if held[:4] != MAGIC[kind]:  # no other decoder is let near it
        raise FitError(f"{path}: is no {kind.upper()} file; {WAY_OUT}")
    try:
        samples, rate = soundfile.read(io.BytesIO(held), frames=MOST_FRAMES, always_2d=True)
    except soundfile.LibsndfileError as problem:
        raise FitError(f"{path}: cannot be read ({problem.error_string}); {WAY_OUT}") from None
    if not (scale > 0 and np.isfinite(samples).all()):
        raise FitError(f"{path}: has samples that are no finite numbers, or a scale that is not above 0; {WAY_OUT}")
    if samples.shape[1] != channels or not RATES[0] <= rate <= RATES[1]:
        raise FitError(f"{path}: has {samples.shape[1]} channels at {rate} Hz and is not this fit's knock; {WAY_OUT}")
    return scale * samples.T, rate


def _decoded(text: Any, where: str) -> bytes:
    try:
        if isinstance(text, str) and len(text) <= LARGEST_KNOCK:
            return base64.b64decode(text, validate=True)
    except ValueError:
        pass
    raise FitError(f"{where} is no base64 of at most {LARGEST_KNOCK / 2**20:g} MiB; {WAY_OUT}")
