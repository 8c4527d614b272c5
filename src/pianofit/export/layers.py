"""How a sampler divides keys and velocities: which key plays which sample, and how layers cross over.

Layers are struck at velocities from 1 to 127. Between two of them both are heard, each brought to the level that the
model has at the velocity played: with t going from 0 to 1,

    x(v) = L(v) ((1 - t) a/L_a + t b/L_b) / |(1 - t) a/L_a + t b/L_b|

Two strokes on one string have the same modes. Aligned in time they add like amplitudes, not like powers, and what is
left of a difference is in their correlation: the sum's own level is known before it is heard.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from ..analysis.note_names import midi_to_note, note_to_midi
from ..errors import AnalysisError, ParameterError
from ..instrument.collect_fits import HIGHEST_KEY, LOWEST_KEY

__all__ = [
    "LOUDEST", "SOFTEST", "SampledKey", "Zone", "crossfaded", "format_keys", "key_ranges", "parse_keys", "silent_keys",
    "velocities_of", "without_gaps",
]  # fmt: skip

# MIDI velocities of strokes.
SOFTEST, LOUDEST = 1, 127
# No sample is transposed further than this, semitones.
FARTHEST = 6


class Zone(NamedTuple):
    """One sample of a key, and how loud it is played."""

    velocity: int  # MIDI, it was struck at
    low: int  # velocities at which it is heard
    high: int
    gain: np.ndarray  # amplitude at each of them, at most 1 [high - low + 1]
    loudest: float  # what the sample is raised by for that: between far layers a soft one may have to be louder


class SampledKey(NamedTuple):
    """One key that a sampler plays from samples of its own, and the keys about it."""

    midi: int
    low: int  # keys that it plays
    high: int
    damper: float  # what it adds to every decay, 1/s; 0 without one
    zones: Sequence[Zone]
    files: Sequence[str]  # of each zone, from the sampler's folder


def parse_keys(text: str) -> list[int]:
    """Keys named on a command line: A0-C8, C2,E2,G2, "every 3" (semitones from A0), or a mixture by commas.

    Raises `ParameterError`, naming the part that is no key.
    """
    keys: set[int] = set()
    for part in (piece.strip() for piece in text.split(",")):
        every = re.fullmatch(r"every\s+([1-9]\d?)", part)
        ends = part.split("-")
        try:
            if every:
                keys.update(range(LOWEST_KEY, HIGHEST_KEY + 1, int(every[1])))
                continue
            low, high = (note_to_midi(end) for end in (ends if len(ends) == 2 else [part, part]))
        except AnalysisError:
            raise ParameterError(f"--keys {text!r}: {part!r} is no key; write C2,E2 or A0-C8 or 'every 3'") from None
        if not LOWEST_KEY <= low <= high <= HIGHEST_KEY:
            raise ParameterError(f"--keys {text!r}: {part!r} must lie from A0 to C8, the lower first")
        keys.update(range(low, high + 1))
    return sorted(keys)


def key_ranges(keys: Sequence[int]) -> list[tuple[int, int]]:
    """Which keys each sampled key plays: up to half-way to its neighbours, and as far at the two ends."""
    gaps = [b - a for a, b in pairwise(keys)]
    below = [gaps[0] if gaps else 1, *gaps]
    above = [*gaps, gaps[-1] if gaps else 1]
    spans = []
    for key, down, up in zip(keys, below, above, strict=True):
        low, high = key - min((down - 1) // 2, FARTHEST), key + min(up // 2, FARTHEST)
        spans.append((max(low, LOWEST_KEY), min(high, HIGHEST_KEY)))
    return spans


def without_gaps(keys: Sequence[int]) -> list[int]:
    """Sampled keys with as many more, evenly spaced, as let every key between them be played."""
    found = list(keys[:1])
    for low, high in pairwise(keys):
        parts = math.ceil((high - low) / (2 * FARTHEST + 1))
        found += [low + round(part * (high - low) / parts) for part in range(1, parts + 1)]
    return found


def silent_keys(keys: Sequence[SampledKey]) -> list[int]:
    """Keys of the piano that no sample plays."""
    played = {midi for key in keys for midi in range(key.low, key.high + 1)}
    return [midi for midi in range(LOWEST_KEY, HIGHEST_KEY + 1) if midi not in played]


def format_keys(keys: Sequence[int]) -> str:
    """Ascending keys as text: "A0 to B3, C#5"; "none" without any."""
    runs: list[list[int]] = []
    for midi in keys:
        if runs and midi == runs[-1][-1] + 1:
            runs[-1].append(midi)
        else:
            runs.append([midi])
    ends = [[midi_to_note(midi) for midi in dict.fromkeys((run[0], run[-1]))] for run in runs]
    return ", ".join(" to ".join(pair) for pair in ends) or "none"


def velocities_of(count: int) -> list[int]:
    """MIDI velocities of `count` layers, from the softest to the loudest stroke; the loudest alone, if one."""
    return [int(v) for v in np.round(np.linspace(SOFTEST, LOUDEST, count))] if count > 1 else [LOUDEST]


def crossfaded(velocities: Sequence[int], level_db: np.ndarray, alike: Sequence[float]) -> list[Zone]:
    """The layers of a key.

    Parameters
    ----------
    velocities : MIDI, ascending [layers], those of the samples.
    level_db : at every MIDI velocity from 0 to 127 [128].
    alike : correlation of each sample with the next louder one, aligned [layers - 1].
    """
    edges = [SOFTEST - 1, *velocities, LOUDEST + 1]
    zones = []
    for i, own in enumerate(velocities):
        low, high = (edges[i] + 1, edges[i + 2] - 1) if len(velocities) > 1 else (SOFTEST, LOUDEST)
        heard = np.arange(low, high + 1)
        gain = 10 ** ((level_db[heard] - level_db[own]) / 20)
        if i > 0:
            gain[heard < own] *= _share(heard[heard < own], edges[i], own, alike[i - 1])
        if i < len(velocities) - 1:
            gain[heard > own] *= _share(heard[heard > own], edges[i + 2], own, alike[i])
        zones.append(Zone(own, low, high, gain / gain.max(), float(gain.max())))
    return zones


def _share(velocity: np.ndarray, other: int, own: int, alike: float) -> np.ndarray:
    """Of a sample struck at `own` beside one struck at `other`, both of level 1, in a sum of level 1."""
    t = (velocity - other) / (own - other)
    return t / np.sqrt(t**2 + (1 - t) ** 2 + 2 * t * (1 - t) * alike)
