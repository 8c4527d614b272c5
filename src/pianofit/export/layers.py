"""Key ranges and velocity crossfades of a sampler.

Layers are struck at velocities from 1 to 127. Between two layers a and b both sound. Their sum has the level L(v) of
the model at the played velocity v, with t rising from 0 to 1:

    x(v) = L(v) ((1 - t) a/L_a + t b/L_b) / |(1 - t) a/L_a + t b/L_b|

Two strokes on one string have the same modes, so that time-aligned layers add in amplitude and not in power. The
remaining difference is described by their correlation, from which the level of the sum is computed in advance.

Programs that convert sampler files reduce such curves to a power law. `xfade` therefore leaves the crossfade to the
player: (1 - t) a + t b, which every program with crossfades knows. `plain` plays one layer at its own level.
"""

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from ..analysis.note_names import midi_to_note
from ..conversions import HIGHEST_KEY, LOWEST_KEY
from ..schema.dampers import LAST_DAMPER

# MIDI velocities of strokes.
SOFTEST, LOUDEST = 1, 127
# How layers meet: curves of gain over velocity, crossfades of the player, or one layer at each velocity.
BLENDS = ("curves", "xfade", "plain")
# No sample is transposed further than this, semitones.
LARGEST_TRANSPOSITION = 6


class Zone(NamedTuple):
    """One sample of a key, with its gain over velocity."""

    velocity: int  # MIDI, of the stroke
    low: int  # range of velocities in which it sounds
    high: int
    gain: np.ndarray  # amplitude at each velocity of the range, at most 1 [high - low + 1]
    sample_gain: float  # of the sample itself; above 1 where a crossfade needs it louder than its stroke


class Sample(NamedTuple):
    """A written sample and the velocities at which it sounds."""

    zone: Zone
    file: str  # relative to the folder of the sampler


class SampledKey(NamedTuple):
    """One sampled key, with the range of keys that it plays."""

    midi: int
    low: int  # range of keys that it plays
    high: int
    damper: float  # decay rate that the damper adds at the fundamental, 1/s; 0 without damper
    strokes: Sequence[Sample]
    soft: Sequence[Sample] = ()  # strokes with the left pedal down, if they were sampled
    resonance: Sample | None = None  # what free strings add to a stroke with the right pedal down


class ReleaseSample(NamedTuple):
    """The noise of one key that is let go, at the release velocity of the recordings."""

    midi: int
    file: str
    gain_db: float


class SamplerContent(NamedTuple):
    """All that the text of a sampler refers to."""

    title: str
    keys: Sequence[SampledKey]
    releases: Sequence[ReleaseSample]
    blend: str  # one of `BLENDS`


def key_ranges(keys: Sequence[int]) -> list[tuple[int, int]]:
    """Range of keys that each sampled key plays: half-way to its neighbours, and as far as allowed at both ends.

    If possible, keys with and without a damper are not played by one sampled key.
    """
    gaps = [b - a for a, b in pairwise(keys)]
    outside = 2 * LARGEST_TRANSPOSITION + 1
    below, above = [outside, *gaps], [*gaps, outside]
    spans = []
    for key, down, up in zip(keys, below, above, strict=True):
        low, high = key - min((down - 1) // 2, LARGEST_TRANSPOSITION), key + min(up // 2, LARGEST_TRANSPOSITION)
        spans.append((max(low, LOWEST_KEY), min(high, HIGHEST_KEY)))
    for i, (a, b) in enumerate(pairwise(keys)):
        in_reach = max(LAST_DAMPER - a, b - LAST_DAMPER - 1) <= LARGEST_TRANSPOSITION
        if a <= LAST_DAMPER < b and in_reach:
            spans[i], spans[i + 1] = (spans[i][0], LAST_DAMPER), (LAST_DAMPER + 1, spans[i + 1][1])
    return spans


def fill_gaps(keys: Sequence[int]) -> list[int]:
    """Sampled keys with the fewest evenly spaced additions that let every key between them be played."""
    filled = list(keys[:1])
    for low, high in pairwise(keys):
        parts = math.ceil((high - low) / (2 * LARGEST_TRANSPOSITION + 1))
        filled += [low + round(part * (high - low) / parts) for part in range(1, parts + 1)]
    return filled


def played_keys(keys: Sequence[SampledKey]) -> set[int]:
    """Keys of the piano with a sample in reach."""
    return {midi for key in keys for midi in range(key.low, key.high + 1)}


def silent_keys(keys: Sequence[SampledKey]) -> list[int]:
    """Keys of the piano without a sample in reach."""
    return sorted({*range(LOWEST_KEY, HIGHEST_KEY + 1)} - played_keys(keys))


def format_keys(keys: Sequence[int]) -> str:
    """Ascending keys as text, such as "A0 to B3, C#5", or "none"."""
    runs: list[list[int]] = []
    for midi in keys:
        if runs and midi == runs[-1][-1] + 1:
            runs[-1].append(midi)
        else:
            runs.append([midi])
    ends = [[midi_to_note(midi) for midi in dict.fromkeys((run[0], run[-1]))] for run in runs]
    return ", ".join(" to ".join(pair) for pair in ends) or "none"


def layer_velocities(count: int) -> list[int]:
    """MIDI velocities of `count` layers, from softest to loudest. A single layer is the loudest."""
    return [int(v) for v in np.round(np.linspace(SOFTEST, LOUDEST, count))] if count > 1 else [LOUDEST]


def blend_layers(
    blend: str, velocities: Sequence[int], level_db: np.ndarray, correlation: Sequence[float]
) -> list[Zone]:
    """Zones of the layers of a key, blended as `blend` says; see `crossfade_layers` for the other parameters."""
    if blend == "curves":
        return crossfade_layers(velocities, level_db, correlation)
    spans = _overlapping_spans(velocities)
    if blend == "plain":
        halves = [(a + b) // 2 for a, b in pairwise(velocities)]
        spans = [*zip([SOFTEST, *(half + 1 for half in halves)], [*halves, LOUDEST], strict=True)]
    return [
        Zone(struck, low, high, np.ones(high - low + 1), 1.0)
        for struck, (low, high) in zip(velocities, spans, strict=True)
    ]


def _overlapping_spans(velocities: Sequence[int]) -> list[tuple[int, int]]:
    """Range of velocities of each layer, up to those at which its neighbours are struck."""
    edges = [SOFTEST - 1, *velocities, LOUDEST + 1]
    return [(below + 1, above - 1) for below, above in zip(edges, edges[2:], strict=False)]


def crossfade_layers(velocities: Sequence[int], level_db: np.ndarray, correlation: Sequence[float]) -> list[Zone]:
    """Gain curves of the layers of a key.

    Parameters
    ----------
    velocities : MIDI velocities of the samples, ascending [layers].
    level_db : level at every MIDI velocity from 0 to 127 [128].
    correlation : correlation of each sample with the next louder one, aligned [layers - 1].
    """
    zones = []
    for i, (struck, (low, high)) in enumerate(zip(velocities, _overlapping_spans(velocities), strict=True)):
        span = np.arange(low, high + 1)
        gain = 10 ** ((level_db[span] - level_db[struck]) / 20)
        if i > 0:
            gain[span < struck] *= _crossfade(span[span < struck], low - 1, struck, correlation[i - 1])
        if i < len(velocities) - 1:
            gain[span > struck] *= _crossfade(span[span > struck], high + 1, struck, correlation[i])
        zones.append(Zone(struck, low, high, gain / gain.max(), float(gain.max())))
    return zones


def _crossfade(velocity: np.ndarray, other: int, struck: int, correlation: float) -> np.ndarray:
    """Amplitude of the sample struck at `struck` in its crossfade with `other`, both of level 1, the sum of level 1."""
    t = (velocity - other) / (struck - other)
    return t / np.sqrt(t**2 + (1 - t) ** 2 + 2 * t * (1 - t) * correlation)
