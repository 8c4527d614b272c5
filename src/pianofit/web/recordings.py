"""Recordings of the keys of an instrument for a page: cut at the stroke, 16-bit FLAC in base64."""

import math
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import FitError, ParameterError
from ..instrument import Instrument
from ..io.files import printable
from ..model.note import Note
from ..playback.voice import CHANNELS
from ..recording.recording import load_recording
from ..report.sound import excerpt
from ..schema.instrument import Layer
from ..schema.modal_response import encode_embedded

# Lengths of a layer, s. The longest is used for which all layers fit into `ROOM`, bytes of the page.
LENGTHS = (4.0, 3.0, 2.0)
ROOM = 30_000_000
# Sample rate of the page, Hz. Higher rates are reduced by an integer factor.
HIGHEST_RATE = 48_000


def recorded_layers(instrument: Instrument) -> dict[int, list[dict[str, Any]]]:
    """Encode all layers by key, soft to loud: `name` of the recording, hammer `velocity`, m/s, and sound `flac`.

    Each sound begins at the same time before the hammer contact as the computed sound of its key.

    Raises
    ------
    FitError
        If the instrument has no layers, or a recording is missing or was changed.
    ParameterError
        If the layers are too large.
    """
    sounds = {
        midi: [(layer, *_read(layer, key.note)) for layer in key.fit.layers]
        for midi, key in instrument.keys.items()
        if key.fit and key.fit.layers
    }
    if not sounds:
        raise FitError("--recordings: the fits name no recordings; give the folder that pianofit batch wrote")
    size = 0
    for seconds in LENGTHS:
        encoded = {midi: [_encode(*sound, seconds) for sound in own] for midi, own in sounds.items()}
        size = sum(len(layer["flac"]) for layers in encoded.values() for layer in layers)
        if size <= ROOM:
            return encoded
    raise ParameterError(
        f"--recordings: {LENGTHS[-1]:g} s of every layer take {size / 1e6:.0f} MB, and a page has room for "
        f"{ROOM / 1e6:.0f} MB; choose fewer keys"
    )


def _read(layer: Layer, note: Note) -> tuple[np.ndarray, int]:
    """Read a recording from the beginning of the computed sound of its key, with as many channels; and its rate."""
    recording = load_recording(layer.file)
    if recording.sha256 != layer.sha256:
        raise FitError(f"{printable(layer.file)}: is not the recording that was fitted; run pianofit batch again")
    channels = 1 if note.modal_response is None else min(note.modal_response.channels, CHANNELS)
    samples = recording.samples[None] if channels == 1 else recording.frames[:channels]
    begin = round((layer.contact - note.pre_onset_s) * recording.rate)
    return np.pad(samples, ((0, 0), (max(-begin, 0), 0)))[:, max(begin, 0) :], recording.rate


def _encode(layer: Layer, samples: np.ndarray, rate: int, seconds: float) -> dict[str, Any]:
    """Encode the first seconds with a fade-out and the peak at full scale. The page matches loudness itself."""
    factor = math.ceil(rate / HIGHEST_RATE)
    kept = excerpt(samples, rate, 0.0, seconds, factor)
    kept /= max(float(np.abs(kept).max(initial=0.0)), 1e-12)
    flac = encode_embedded(kept, round(rate / factor))
    return {"name": printable(Path(layer.file).name), "velocity": layer.velocity, "flac": flac}
