"""The recordings of an instrument's keys, as a page holds them: cut at the stroke, FLAC of 16 bits in base64."""

from __future__ import annotations

import base64
import math
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import FitError, ParameterError
from ..instrument.collect_fits import Layer
from ..instrument.document import Instrument
from ..io.files import encode_pcm, printable
from ..model.note import Note
from ..playback.voice import CHANNELS
from ..recording.recording import load_recording
from ..report.sound import excerpt

__all__ = ["recorded_layers"]

# Seconds that are kept of every layer: the most that leaves all of them `ROOM`, bytes of the page.
LENGTHS = (4.0, 3.0, 2.0)
ROOM = 30_000_000
# Hz, the page's own: what has more is brought down by a whole factor.
HIGHEST_RATE = 48_000


def recorded_layers(instrument: Instrument) -> dict[int, list[dict[str, Any]]]:
    """By key, soft to loud: the `name` of a recording, its hammer `velocity`, m/s, and its sound, `flac`.

    A sound begins when that of the instrument's key does whose hammer touches the string at the same time.

    Raises `FitError` if no layer is known, or a recording is not there any more; `ParameterError` if they take too much
    room.
    """
    if not any(instrument.layers.values()):
        raise FitError("--recordings: the fits name no recordings; give the folder that pianofit batch wrote")
    sounds = {
        midi: [_read(layer, instrument.notes[midi]) for layer in layers] for midi, layers in instrument.layers.items()
    }
    size = 0
    for seconds in LENGTHS:
        found = {
            midi: [
                {
                    "name": printable(Path(layer.file).name),
                    "velocity": layer.velocity,
                    "flac": _encoded(*sound, seconds),
                }
                for layer, sound in zip(instrument.layers[midi], sounds[midi], strict=True)
            ]
            for midi in sounds
        }
        size = sum(len(layer["flac"]) for layers in found.values() for layer in layers)
        if size <= ROOM:
            return found
    raise ParameterError(
        f"--recordings: {LENGTHS[-1]:g} s of every layer take {size / 1e6:.0f} MB, and a page has room for "
        f"{ROOM / 1e6:.0f} MB; take fewer keys"
    )


def _read(layer: Layer, note: Note) -> tuple[np.ndarray, int]:
    """A recording from where its key's own sound begins, in as many channels, and its rate."""
    recording = load_recording(layer.file)
    if recording.sha256 != layer.sha256:
        raise FitError(f"{printable(layer.file)}: is not the recording that was fitted; run pianofit batch again")
    channels = 1 if note.ringing is None else min(note.ringing.channels, CHANNELS)
    samples = recording.samples[None] if channels == 1 else recording.frames[:channels]
    begin = round((layer.contact - note.pre_onset_s) * recording.rate)
    return np.pad(samples, ((0, 0), (max(-begin, 0), 0)))[:, max(begin, 0) :], recording.rate


def _encoded(samples: np.ndarray, rate: int, seconds: float) -> str:
    """Its first seconds, faded out, with its peak at full scale: what it is compared with gets its loudness."""
    factor = math.ceil(rate / HIGHEST_RATE)
    kept = excerpt(samples, rate, 0.0, seconds, factor)
    kept /= max(float(np.abs(kept).max(initial=0.0)), 1e-12)
    return base64.b64encode(encode_pcm(kept, round(rate / factor), "flac", 16)).decode()
