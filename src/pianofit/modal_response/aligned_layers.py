"""Layers of a key with common onset, sample rate and length, and without glide, so that they can share poles."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import signal
from scipy.interpolate import CubicSpline

from ..analysis import Analysis
from ..model.modal_response import PRE_ONSET_S, resample
from ..recording.recording import Recording

__all__ = ["SPAN", "AlignedLayers", "align_layers"]

# Modes are estimated from this time after the onset, s. Most aftersounds have shown their decay by then.
SPAN = 3.3
# A glide is removed only if it exceeds so many of its standard errors.
SIGNIFICANT_GLIDE = 3.0


@dataclass(frozen=True)
class AlignedLayers:
    """The layers of a key, cut at their onsets, at one rate and of one length."""

    samples: np.ndarray  # full scale = 1 [layers, channels, samples]
    before: np.ndarray  # the `PRE_ONSET_S` seconds before the onsets [layers, channels, samples]
    rate: int  # Hz
    seconds: np.ndarray  # of each layer, before silence was appended [layers]


def align_layers(recordings: Sequence[Recording], analyses: Sequence[Analysis]) -> AlignedLayers:
    """Cut recordings at their onsets, bring them to one rate and length, and remove their glides.

    The rate is the highest of all recordings. The length is at most a little over `SPAN`. Channels are kept separate if
    all recordings have the same number of channels, and averaged otherwise.
    """
    rate = max(recording.rate for recording in recordings)
    keep_channels = len({len(recording.frames) for recording in recordings}) == 1
    lead, longest_allowed = round(PRE_ONSET_S * rate), round((SPAN + 0.2) * rate)
    layers = []
    for recording, analysis in zip(recordings, analyses, strict=True):
        x = resample(recording.frames if keep_channels else recording.samples[None], recording.rate, rate)
        onset = round(recording.onset * rate / recording.rate)
        x = np.pad(x, ((0, 0), (max(lead - onset, 0), 0)))
        x = x[:, max(onset - lead, 0) :][:, : lead + longest_allowed]
        layers.append(_without_glide(x, rate, lead, analysis))
    longest = max(x.shape[-1] for x in layers)
    padded = np.stack([np.pad(x, ((0, 0), (0, longest - x.shape[-1]))) for x in layers])
    seconds = np.array([(x.shape[-1] - lead) / rate for x in layers])
    return AlignedLayers(padded[..., lead:], padded[..., :lead], rate, seconds)


def _without_glide(x: np.ndarray, rate: int, lead: int, analysis: Analysis) -> np.ndarray:
    """Resample a sound in time so that its pitch is constant [channels, samples].

    A string's tension falls during the decay and changes all partials by one factor. A rising pitch comes from beating
    and is left unchanged, as is a glide that is not significant.
    """
    if analysis.glide_start <= SIGNIFICANT_GLIDE * analysis.glide_error:
        return x
    time = (np.arange(x.shape[-1]) - lead) / rate
    fine = CubicSpline(time[0] + np.arange(2 * len(time)) / (2 * rate), signal.resample_poly(x, 2, 1, axis=-1), axis=-1)
    # A given phase is reached later when the pitch does not fall.
    return fine(np.interp(time, time + analysis.glide_model.phase_advance_s(np.maximum(time, 0.0)), time))
