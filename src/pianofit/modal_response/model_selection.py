"""Choice of a key's render model by cross-validation: string model alone, with modes, or with modes and knock.

A response estimated from a recording always improves the synthesis of that recording. So every inner layer is left out
in turn. Patterns and knock of the other layers, driven by the force of the left-out stroke, are compared with the
recording. The key uses its modes, or its modes and knock, only if they predict the recordings better than the string
model.
"""

import dataclasses
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np

from ..dsp.filters import resample
from ..dsp.loudness import log_mel_distances
from ..model.modal_response import PRE_ONSET_S, ForcePulse, ModalResponse, force_pulse
from ..model.note import Note
from ..result import FittedRecording, Result
from ..schema.modal_response import RENDER_MODELS, FittedModalResponse, LayerEntry, ModalResponseEntry, RenderModel
from ..threads import cores, numerical_settings
from .aligned_layers import AlignedLayers, align_layers
from .modes import PartialModes, modes_of
from .shared_response import SharedResponse, estimate_shared_response


class _LayerGroup(NamedTuple):
    """The recordings of a key in one path group, by rising size of the stroke."""

    place: list[int]  # index in the fit
    fitted: list[FittedRecording]
    aligned: AlignedLayers
    forces: list[ForcePulse]
    gain: np.ndarray  # from the fit; of plucks that of the reference recording [layers]

    def modes(self) -> list[PartialModes]:
        """The modes of all partials."""
        return modes_of(self.aligned, [layer.analysis for layer in self.fitted])


@numerical_settings()
def fit_modal_response(result: Result, progress: Callable[[str, float], None]) -> Result:
    """The fit with a modal response in its notes: aftersound, beating, knock and channels.

    A calibrated fit keeps the string model, because nothing between its string and its file is unknown. So does a fit
    whose partials exceed the noise by too little for modes.
    """
    if result.fit.reference.gain_status == "given":
        return result
    progress("ringing", 0.95)
    layers = _layers(result)
    modes = layers.modes()
    if not modes:
        return result
    response = estimate_shared_response(layers.aligned, modes, layers.forces, layers.gain)
    distances = _left_out_distances(layers, modes, response)
    best = min(RENDER_MODELS, key=lambda name: distances[name]) if distances else RENDER_MODELS[-1]
    return _attached(result, layers, response, best, distances)


def _layers(result: Result) -> _LayerGroup:
    place = result.fit.path_groups[result.fit.reference.path_group]
    note_of = _notes(result, place)
    place.sort(key=lambda i: float(note_of[i].size))
    fitted = [result.recordings[i] for i in place]
    aligned = align_layers([layer.recording for layer in fitted], [layer.analysis for layer in fitted])
    gain = np.array([note_of[i].gain for i in place])
    forces = [force_pulse(x.fitted.simulation, note_of[i].hammer) for i, x in zip(place, fitted, strict=True)]
    return _LayerGroup(place, fitted, aligned, forces, gain)


def _notes(result: Result, place: list[int]) -> dict[int, Note]:
    """The notes of recordings through the path of the reference recording, with its gain if they are plucks."""
    gain = float(result.recordings[result.fit.reference_index].fitted.note.gain)
    return {i: result.recordings[i].fitted.note.with_gain(gain) for i in place}


def _left_out_distances(
    layers: _LayerGroup, modes: Sequence[PartialModes], response: SharedResponse
) -> dict[RenderModel, float] | None:
    """Mean distance of left-out layers by render model, dB; None with one layer."""
    count = len(layers.fitted)
    inner = range(1, count - 1) if count > 2 else range(count) if count > 1 else ()
    with ThreadPoolExecutor(cores()) as threads:
        rows = list(threads.map(lambda out: _distances(layers, modes, response, out), inner))
    return {name: float(np.mean([row[name] for row in rows])) for name in RENDER_MODELS} if rows else None


def _distances(
    layers: _LayerGroup, modes: Sequence[PartialModes], response: SharedResponse, out: int
) -> dict[RenderModel, float]:
    """Distance of layer `out` from its prediction by the other layers, by render model, dB."""
    aligned, rest = layers.aligned, [i for i in range(len(layers.fitted)) if i != out]
    others = AlignedLayers(aligned.samples[rest], aligned.before[rest], aligned.rate, aligned.seconds[rest])
    modes = [_of_layers(m, rest) for m in modes]
    without = estimate_shared_response(others, modes, [layers.forces[i] for i in rest], layers.gain[rest])
    ringing, rate, lead = without.response, aligned.rate, round(PRE_ONSET_S * aligned.rate)
    count = round(aligned.seconds[out] * rate)
    target = np.concatenate([aligned.before[out], aligned.samples[out]], axis=-1).mean(axis=0)[: lead + count]
    delay = response.delay[out] - float(np.median(response.delay[rest] - without.delay))
    late = max(round(delay * rate), 0)

    def sound_of(key: ModalResponse) -> np.ndarray:
        sound = key.sound(layers.forces[out], rate, lead + count).mean(axis=0)
        return np.pad(sound, (late, 0))[: len(target)]

    string_only = _render_string_model(layers.fitted[out], rate, lead)
    sounds = (string_only, sound_of(ringing.without_knock()), sound_of(ringing))
    return dict(zip(RENDER_MODELS, log_mel_distances(target, sounds, rate, lead), strict=True))


def _of_layers(modes: PartialModes, which: list[int]) -> PartialModes:
    """The modes with amplitudes, offsets and noise of these layers only."""
    return dataclasses.replace(
        modes, **{name: getattr(modes, name)[which] for name in ("amplitude", "offset", "noise", "snr")}
    )


def _render_string_model(layer: FittedRecording, rate: int, lead: int) -> np.ndarray:
    """The layer rendered by the string model alone, from `lead` samples before its onset."""
    recording = layer.recording
    sound = resample(layer.fitted.samples, recording.rate, rate)
    return np.pad(sound, (lead, 0))[round(recording.onset * rate / recording.rate) :]


def _attached(
    result: Result,
    layers: _LayerGroup,
    response: SharedResponse,
    model: RenderModel,
    distances: dict[RenderModel, float] | None,
) -> Result:
    """The result with the modal response in its notes, sounds and record, per unit of a recording's gain."""
    entries = tuple(
        LayerEntry(layer.recording.path, float(late)) for layer, late in zip(layers.fitted, response.delay, strict=True)
    )
    chosen = FittedModalResponse(render_model=model, leave_one_out_db=distances, layers=entries)
    if model == RENDER_MODELS[0]:
        return dataclasses.replace(result, fit=dataclasses.replace(result.fit, modal_response=chosen))
    ringing = response.response if model == RENDER_MODELS[-1] else response.response.without_knock()
    recordings, best = list(result.recordings), list(result.minima_notes[0])
    gain = float(best[result.fit.reference_index].gain)
    for place, late in zip(layers.place, response.delay, strict=True):
        best[place] = best[place].with_gain(gain)._replace(modal_response=ringing)
        recordings[place] = recordings[place].add_modal_response(ringing, float(late), gain)
    chosen = dataclasses.replace(chosen, response=ModalResponseEntry.of(ringing))
    return dataclasses.replace(
        result,
        fit=dataclasses.replace(result.fit, modal_response=chosen),
        recordings=tuple(recordings),
        minima_notes=(tuple(best), *result.minima_notes[1:]),
    )
