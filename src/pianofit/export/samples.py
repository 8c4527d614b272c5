"""The samples of a key: the sound of each stroke, its first sample, and the level of the key over velocity.

A resonance sample is the sound that free strings add to one stroke with the right pedal down, as in `pianofit play`.
The motion of free strings follows the force of the hammer, so its level over velocity is that of the stroke.
"""

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy.interpolate import PchipInterpolator

from ..instrument import Instrument
from ..io.files import PEAK_LIMIT
from ..model.note import arrival
from ..playback.resonance import Stroke, hop_count, render_resonance
from ..playback.voice import CHANNELS, StringVoice
from .layers import LOUDEST, SOFTEST, Zone, blend_layers, crossfade_layers, layer_velocities

# By default the loudest sample has this peak, dB re full scale.
PEAK_LIMIT_DB = 20 * math.log10(PEAK_LIMIT)
# By default a sample ends this far below its peak, dB, or after the requested time. The fade is this fraction of its
# length.
SILENT_DB = 110.0
FADE = 0.05
# A sample begins just before it first reaches this level below its peak, dB: dispersion makes high partials arrive
# first.
BEGINS_DB = 80.0
# Samples that are kept before that point.
BEFORE = 16
# Level, correlation and peak are measured over this time from the beginning, s, which contains the loudest moment.
LEVEL_SECONDS = 1.0
# Number of velocities at which the level is measured, in addition to the layers. Between them the level is smooth. It
# is not a power law in the treble, where the spectrum of the force has its first zero.
LEVELS = 22
# Largest shift of a stroke against the next louder one, s: a softer stroke has a longer contact, and the centre of its
# force comes later. Neighbouring layers need at most 0.4 ms.
LARGEST_SHIFT = 1e-3


class ExportOptions(NamedTuple):
    """Number, length and format of the samples."""

    layers: int = 8  # per key
    seconds: float = 8.0  # largest length of a sample
    rate: int = 48_000  # Hz
    kind: str = "flac"
    blend: str = "curves"  # of layers over velocity: curves, xfade or plain
    resonance: bool = True  # a sample of the free strings for each key
    una_corda: bool = False  # layers with the left pedal down
    peak_db: float = PEAK_LIMIT_DB  # of the loudest sample, dB re full scale
    trim_db: float = SILENT_DB  # a sample ends this far below its peak, dB


class KeySamples(NamedTuple):
    """Gain curves, sample positions and peak of a key, measured before its samples are written."""

    zones: list[Zone]
    begin: list[int]  # first sample of each zone within `stroke`; negative if silence comes first
    peak: float  # of the loudest layer, file units
    whole: Zone  # gain over all velocities of a sample that is struck at the middle layer


def measure_layers(instrument: Instrument, string: StringVoice, options: ExportOptions, soft: float) -> KeySamples:
    """Strike a key at the velocities of its layers and at `LEVELS` more, and measure levels and positions.

    `soft` is the position of the left pedal, 0 to 1.
    """
    velocities, seconds = layer_velocities(options.layers), min(options.seconds, LEVEL_SECONDS)
    measured = sorted({*velocities, *layer_velocities(LEVELS)})
    sounds = {velocity: render_stroke(instrument, string, velocity, seconds, soft) for velocity in measured}
    level_db = [10 * np.log10(max(np.mean(sound**2, axis=-1).sum(), 1e-30)) for sound in sounds.values()]
    layers = [sounds[velocity] for velocity in velocities]
    shifts, correlation = _align(layers, max(round(LARGEST_SHIFT * string.rate), 1))
    first = [0 if string.lead else max(int(np.argmax(_above(sound, BEGINS_DB))) - BEFORE, 0) for sound in layers]
    begin = min(f - shift for f, shift in zip(first, shifts, strict=True))
    # The curve is constant below the softest stroke, because an extrapolation is unreliable.
    curve = PchipInterpolator(measured, level_db)(np.clip(np.arange(LOUDEST + 1), SOFTEST, LOUDEST))
    peak = max(float(np.abs(sound).max()) for sound in layers)
    zones = blend_layers(options.blend, velocities, curve, correlation)
    (whole,) = crossfade_layers([velocities[len(velocities) // 2]], curve, [])
    return KeySamples(zones, [begin + shift for shift in shifts], peak, whole)


def render_sample(
    instrument: Instrument, string: StringVoice, velocity: int, begin: int, options: ExportOptions, soft: float
) -> np.ndarray:
    """A stroke [channels, samples] from sample `begin` on, with a fade-out."""
    sound = render_stroke(instrument, string, velocity, options.seconds + max(begin, 0) / string.rate, soft)
    return _cut(sound, begin, options)


def render_resonance_sample(
    instrument: Instrument, string: StringVoice, velocity: int, begin: int, options: ExportOptions
) -> np.ndarray:
    """Sound that free strings add to the stroke of `render_sample` with the right pedal down [channels, samples]."""
    string.reset()
    head = string.strike(instrument.note(string.midi, velocity).size)
    stroke = Stroke(string.midi, 0, head.shape[-1], string.modes.state, string.force)
    samples = round(options.seconds * string.rate) + max(begin, 0)
    lifted = np.zeros((len(instrument.keys), hop_count(samples, string.rate)))
    sound = render_resonance(instrument, [stroke], lifted, string.rate, samples)[:CHANNELS]
    return _cut(np.pad(sound, ((0, 0), (string.lead, 0))), begin, options)


def render_stroke(
    instrument: Instrument, string: StringVoice, velocity: int, seconds: float, soft: float = 0.0
) -> np.ndarray:
    """One stroke on the string at rest [channels, samples], from the contact on, or from the knock before it."""
    note = instrument.note(string.midi, velocity)
    string.reset()
    # Add the travel time of the wave to the pickup.
    samples = round((seconds + arrival(note.string, note.geometry, note.quantity)) * string.rate)
    head = string.strike(note.size, soft)
    sound = np.concatenate([head, string.ring(max(samples - head.shape[-1], 0))], axis=-1)
    return string.through_path(sound)[:CHANNELS, :samples]


def _above(sound: np.ndarray, below_db: float) -> np.ndarray:
    """Mask of the samples that are less than `below_db` below the peak of a sound [channels, samples]."""
    level = np.abs(sound).max(axis=0)
    return level > level.max() * 10 ** (-below_db / 20)


def _align(layers: Sequence[np.ndarray], farthest: int) -> tuple[list[int], list[float]]:
    """Delay of each layer relative to the loudest, samples, and its correlation with the next louder layer."""
    shifts, correlation = [0], []
    for soft, loud in reversed(list(pairwise(layers))):
        size = soft.shape[-1]
        spectra = [np.fft.rfft(x, 2 * size) for x in (soft, loud)]
        cross = np.fft.irfft((spectra[0] * spectra[1].conj()).sum(axis=0))
        near = np.arange(-farthest, farthest + 1)
        best = int(near[np.argmax(cross[near])])
        correlation.append(max(float(cross[best] / np.sqrt(np.sum(soft**2) * np.sum(loud**2))), 0.0))
        shifts.append(shifts[-1] + best)
    return shifts[::-1], correlation[::-1]


def _cut(sound: np.ndarray, begin: int, options: ExportOptions) -> np.ndarray:
    """A sound [channels, samples] from sample `begin` on, cut at the beginning of silence, with a fade-out."""
    sound = np.pad(sound[:, max(begin, 0) :], ((0, 0), (max(-begin, 0), 0)))[:, : round(options.seconds * options.rate)]
    loud = np.flatnonzero(_above(sound, options.trim_db))
    sound = sound[:, : max(int(loud[-1]) + 1 if loud.size else 1, options.rate // 20)].copy()
    fade = max(int(FADE * sound.shape[-1]), 2)
    sound[:, -fade:] *= 0.5 * (1 + np.cos(np.pi * np.arange(1, fade + 1) / fade))
    return sound
