"""A finished fit made to ring: the modes and the knock of its key, kept where they bring layers nearer that gave none.

What a layer's own recording gave would always bring its synthesis nearer to that recording. So every inner layer is
left out in turn: the patterns and the knock of the others, driven by the force of that layer's stroke, are laid beside
its recording, and the key rings by its modes, or by its modes and its knock, only if that is nearer than its law.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np

from ..modal_response_file import ringing_document
from ..model.modal_response import PRE_ONSET_S, ForcePulse, ModalResponse, force_of, resampled
from ..result import FittedRecording, Result
from ..threads import cores, one_blas_thread
from .aligned_layers import AlignedLayers, align_layers
from .distance import log_mel_distances
from .modes import PartialModes, modes_of
from .shared_response import SharedResponse, estimate_shared_response

__all__ = ["RENDER_MODELS", "fit_modal_response", "modal_response_of"]

# What a key can ring by, the simplest first.
RENDER_MODELS = ("law", "modes", "modes and knock")


class _LayerGroup(NamedTuple):
    """The recordings of a key that went through one path, by hammer velocity; the loudest, the last, leads."""

    place: list[int]  # in the fit
    fitted: list[FittedRecording]
    heard: AlignedLayers
    forces: list[ForcePulse]
    gain: np.ndarray  # that the fit found for each [layers]

    def modes(self) -> list[PartialModes]:
        """Of all partials."""
        return modes_of(self.heard, [layer.analysis for layer in self.fitted])


@one_blas_thread()
def fit_modal_response(result: Result, progress: Callable[[str, float], None] = lambda *_: None) -> Result:
    """The fit with notes that ring as its recordings do: with their aftersound, beats, knock and channels.

    A calibrated fit keeps its law: between its string and its file lies nothing that is unknown. So does one whose
    partials stand too little above the noise to show modes.
    """
    if result.document["recordings"][result.reference_index]["gain_status"] == "given":
        return result
    progress("ringing", 0.95)
    layers = _layers(result)
    modes = layers.modes()
    if not modes:
        return result
    key = estimate_shared_response(layers.heard, modes, layers.forces, layers.gain)
    distances = _left_out(layers, modes, key)
    rung = min(RENDER_MODELS, key=lambda name: distances[name]) if distances else RENDER_MODELS[-1]
    return _attached(result, layers, key, rung, distances)


@one_blas_thread()
def modal_response_of(result: Result) -> ModalResponse | None:
    """Modes and knock of a fitted key, as the result's note would hold them, whether or not they bring it nearer.

    None where no partial stands above the noise long enough to show its modes.
    """
    layers = _layers(result)
    modes = layers.modes()
    if not modes:
        return None
    key = estimate_shared_response(layers.heard, modes, layers.forces, layers.gain)
    return key.ringing


def _layers(result: Result) -> _LayerGroup:
    rows = result.document["recordings"]
    group = rows[result.reference_index]["group"]
    place = [i for i, row in enumerate(rows) if row["group"] == group]
    place.sort(key=lambda i: result.recordings[i].fitted.note.hammer.v_H0)
    fitted = [result.recordings[i] for i in place]
    heard = align_layers([layer.recording for layer in fitted], [layer.analysis for layer in fitted])
    gain = np.array([layer.fitted.note.gain for layer in fitted])
    forces = [force_of(x.fitted.simulation, float(x.fitted.note.hammer.v_H0)) for x in fitted]
    return _LayerGroup(place, fitted, heard, forces, gain)


def _left_out(layers: _LayerGroup, modes: Sequence[PartialModes], key: SharedResponse) -> dict[str, float]:
    """Mean distance, dB, of layers that gave neither patterns nor knock, by what they ring by; of one layer none."""
    count = len(layers.fitted)
    inner = range(1, count - 1) if count > 2 else range(count) if count > 1 else ()
    with ThreadPoolExecutor(cores()) as threads:
        rows = list(threads.map(lambda out: _distances(layers, modes, key, out), inner))
    return {rung: float(np.mean([row[rung] for row in rows])) for rung in RENDER_MODELS} if rows else {}


def _distances(layers: _LayerGroup, modes: Sequence[PartialModes], key: SharedResponse, out: int) -> dict[str, float]:
    heard, rest = layers.heard, [i for i in range(len(layers.fitted)) if i != out]
    others = AlignedLayers(heard.samples[rest], heard.before[rest], heard.rate, heard.seconds[rest])
    known = [_of_layers(m, rest) for m in modes]
    without = estimate_shared_response(others, known, [layers.forces[i] for i in rest], layers.gain[rest])
    ringing, rate, lead = without.ringing, heard.rate, round(PRE_ONSET_S * heard.rate)
    count = round(heard.seconds[out] * rate)
    target = np.concatenate([heard.before[out], heard.samples[out]], axis=-1).mean(axis=0)[: lead + count]
    late = max(round((key.delay[out] - float(np.median(key.delay[rest] - without.delay))) * rate), 0)

    def of(one: ModalResponse) -> np.ndarray:
        sound = one.sound(layers.forces[out], rate, lead + count).mean(axis=0)
        return np.pad(sound, (late, 0))[: len(target)]

    sounds = (_render_string_model(layers.fitted[out], rate, lead), of(ringing.without_knock()), of(ringing))
    return dict(zip(RENDER_MODELS, log_mel_distances(target, sounds, rate, lead), strict=True))


def _of_layers(modes: PartialModes, which: list[int]) -> PartialModes:
    """The modes as these layers alone show them."""
    return dataclasses.replace(
        modes, **{name: getattr(modes, name)[which] for name in ("amplitude", "offset", "noise", "snr")}
    )


def _render_string_model(layer: FittedRecording, rate: int, lead: int) -> np.ndarray:
    """The layer as the string's law plays it, from `lead` samples before its onset."""
    recording = layer.recording
    sound = resampled(layer.fitted.samples, recording.rate, rate)
    return np.pad(sound, (lead, 0))[round(recording.onset * rate / recording.rate) :]


def _attached(
    result: Result, layers: _LayerGroup, key: SharedResponse, rung: str, distances: dict[str, float]
) -> Result:
    """The result with the key's ringing in its notes, sounds and document; per unit of a recording's gain."""
    rows = [
        {"file": layer.recording.path, "contact_s": float(late)}
        for layer, late in zip(layers.fitted, key.delay, strict=True)
    ]
    said: dict = {"by": rung, "left_out_db": distances or None, "layers": rows}
    if rung == "law":
        return dataclasses.replace(result, document=result.document | {"ringing": said})
    ringing = key.ringing if rung == RENDER_MODELS[-1] else key.ringing.without_knock()
    recordings, best = list(result.recordings), list(result.minima_notes[0])
    for place, late in zip(layers.place, key.delay, strict=True):
        best[place] = best[place]._replace(ringing=ringing)
        recordings[place] = recordings[place].ringing_by(ringing, float(late))
    said |= ringing_document(ringing)
    notes = (tuple(best), *result.minima_notes[1:])
    return dataclasses.replace(
        result, document=result.document | {"ringing": said}, recordings=tuple(recordings), minima_notes=notes
    )  # fmt: skip
