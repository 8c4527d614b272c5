"""The layers of a key made ready: cut at their onsets, at one rate, of one length, and without their glide."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import signal
from scipy.interpolate import CubicSpline

from ..analysis import Analysis
from ..model.modal_response import PRE_ONSET_S, resampled
from ..recording.recording import Recording

__all__ = ["SPAN", "AlignedLayers", "align_layers"]

# How long after the onset modes are looked for, s: most of an aftersound has shown its decay by then.
SPAN = 3.3
# Standard errors by which a pitch must fall to be taken for a fall.
SURE = 3.0


@dataclass(frozen=True)
class AlignedLayers:
    """The layers of a key, cut at their onsets, at one rate and of one length."""

    samples: np.ndarray  # full scale = 1 [layers, channels, samples]
    before: np.ndarray  # what precedes them, `LEAD` s [layers, channels, samples]
    rate: int  # Hz
    seconds: np.ndarray  # of each layer, before silence was appended [layers]


def align_layers(recordings: Sequence[Recording], analyses: Sequence[Analysis]) -> AlignedLayers:
    """Cut at the onsets, all at the highest rate and of one length, a little over `SPAN` at most; without their glide.

    Channels are kept apart where all recordings have as many, and averaged otherwise.
    """
    rate = max(recording.rate for recording in recordings)
    apart = len({len(recording.frames) for recording in recordings}) == 1
    lead, most = round(PRE_ONSET_S * rate), round((SPAN + 0.2) * rate)
    cut = []
    for recording, analysis in zip(recordings, analyses, strict=True):
        x = resampled(recording.frames if apart else recording.samples[None], recording.rate, rate)
        onset = round(recording.onset * rate / recording.rate)
        x = np.pad(x, ((0, 0), (max(lead - onset, 0), 0)))
        cut.append(_level_pitch(x[:, max(onset - lead, 0) :][:, : lead + most], rate, lead, analysis))
    longest = max(x.shape[-1] for x in cut)
    whole = np.stack([np.pad(x, ((0, 0), (0, longest - x.shape[-1]))) for x in cut])
    seconds = np.array([(x.shape[-1] - lead) / rate for x in cut])
    return AlignedLayers(whole[..., lead:], whole[..., :lead], rate, seconds)


def _level_pitch(x: np.ndarray, rate: int, lead: int, analysis: Analysis) -> np.ndarray:
    """The sound at its own pitch from begin to end [channels, samples]: played faster where it is flat.

    A string's tension falls as it decays, and all its partials with it, by one factor. A pitch that rises is none of
    that but a beat, and one that is not surely another stays.
    """
    if analysis.glide_start <= SURE * analysis.glide_error:
        return x
    time = (np.arange(x.shape[-1]) - lead) / rate
    fine = CubicSpline(time[0] + np.arange(2 * len(time)) / (2 * rate), signal.resample_poly(x, 2, 1, axis=-1), axis=-1)
    # What sounds at t sounds later where the pitch does not fall.
    return fine(np.interp(time, time + analysis.glide_model.phase_advance_s(np.maximum(time, 0.0)), time))
