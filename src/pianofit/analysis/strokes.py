"""Strokes in one long recording of many: their onsets, pitches and loudness.

A stroke makes the spectrum rise in most of its bands within some 30 ms, also while an earlier note rings. The rise of a
band is counted from the noise of the file, so that noise makes none. The onset within a rise is found as in a recording
of a single note. A stroke is sure if its sound has the partials of a string and outlasts a noise.
"""

from dataclasses import dataclass

import numpy as np

from ..dsp.loudness import k_weighted_mean_square
from ..errors import AnalysisError
from ..recording.onset import find_onset
from .inharmonicity import law_frequency
from .note_names import cents_above, hz_to_note, note_to_hz
from .pitch import find_pitch

# Steps and length of the frames in which levels are measured, s. A frame is short against the attack of a bass note.
STEP, FRAME = 0.01, 0.04
# Bands: their lowest edge, Hz, and their number to an octave. Rumble and steps lie below.
LOWEST, PER_OCTAVE = 100.0, 2
HIGHEST = 10_000.0  # Hz
# Levels are compared over this many steps, and count from this much above the noise of their band, dB.
AHEAD, ABOVE_NOISE = 3, 6.0
# Mean rise over the bands that makes an onset, dB, and the shortest time between two, s. Beats rise more slowly, and no
# pianist repeats a note faster.
RISE, APART = 6.0, 0.1
# Sound before an onset that belongs to it: knocks begin earlier, s.
BEFORE = 0.05
# Largest level of a band relative to the file's loudest, dB: a level below is silence.
SILENT_DB = -120.0
# A sure stroke lasts this long above the noise, s, and its pitch is this near to a key, cents.
LASTS, NEAR_KEY = 0.3, 45.0
# Time after the onset in which loudness is measured, s.
LOUDNESS_SECONDS = 1.0
# Span over which levels are averaged for the end of a stroke, s: single frames of noise vary by several dB.
SILENT_FOR = 0.2
# A sure stroke raises the lowest partials of its pitch, so many of them, by this much in the median, dB, in spans
# before and after the onset of this length, s. Partials that rang before do not rise.
PARTIALS, RISEN, COMPARED = 6, 6.0, 0.15


@dataclass(frozen=True)
class Stroke:
    """One stroke of a long recording. Times are in samples."""

    onset: int
    end: int  # the onset of the next stroke, or the begin of silence
    note: str  # nearest key; empty without a pitch
    cents: float  # of its first partial, from that key in equal temperament; NaN without a pitch
    loudness_db: float  # K-weighted, of the first second, dB
    doubt: str  # why it may not be a note; empty if it is sure


def find_strokes(samples: np.ndarray, rate: int) -> list[Stroke]:
    """Find the strokes of a long recording [channels, samples], in order of time, unsure ones included."""
    # Channels of opposite phase would cancel in their mean.
    mono = samples[np.argmax(np.einsum("cs,cs->c", samples, samples))]
    levels = _band_levels(mono, rate)
    noise = np.quantile(levels, 0.1, axis=0) + ABOVE_NOISE
    onsets = [_refined(mono, rate, round(i * STEP * rate)) for i in _rises(np.maximum(levels, noise))]
    onsets = [a for i, a in enumerate(onsets) if i == 0 or a - onsets[i - 1] >= APART * rate]
    # The sound just before an onset belongs to it.
    limits = [*(onset - round(BEFORE * rate) for onset in onsets[1:]), samples.shape[1]]
    return [
        _stroke(samples, mono, rate, onset, _end(levels, noise, rate, onset, limit))
        for onset, limit in zip(onsets, limits[: len(onsets)], strict=True)
    ]


def _band_levels(mono: np.ndarray, rate: int) -> np.ndarray:
    """Level of bands at steps, dB [steps, bands]. A frame begins at its step, and lies within the file.

    A frame over an abrupt end would have a wide spectrum, as a stroke has.
    """
    step, size = round(STEP * rate), round(FRAME * rate)
    padded = np.pad(mono, (0, size))
    top = min(HIGHEST, 0.45 * rate)
    edges = LOWEST * 2.0 ** (np.arange(int(PER_OCTAVE * np.log2(top / LOWEST)) + 1) / PER_OCTAVE)
    hz = np.fft.rfftfreq(size, 1 / rate)
    band = np.searchsorted(edges, hz, side="right") - 1
    window, frames = np.hanning(size), np.arange(0, max(len(mono) - size, 0) + 1, step)
    levels = np.empty((len(frames), len(edges) - 1))
    for first in range(0, len(frames), 4096):
        part = np.stack([padded[at : at + size] for at in frames[first : first + 4096]])
        power = np.abs(np.fft.rfft(part * window, axis=1)) ** 2
        sums = np.stack([power[:, band == b].mean(axis=1) for b in range(len(edges) - 1)], axis=1)
        levels[first : first + 4096] = 10 * np.log10(sums + 1e-30)
    return np.maximum(levels, levels.max(initial=-300.0) + SILENT_DB)


def _rises(levels: np.ndarray) -> list[int]:
    """Steps at which the mean rise of all bands is largest within `APART` and above `RISE`."""
    if len(levels) <= AHEAD:
        return []
    before = np.concatenate([np.repeat(levels.min(axis=0)[None], AHEAD, axis=0), levels[:-AHEAD]])
    rise = np.maximum(levels - before, 0.0).mean(axis=1)
    reach = round(APART / STEP)
    padded = np.pad(rise, reach)
    largest = np.lib.stride_tricks.sliding_window_view(padded, 2 * reach + 1).max(axis=1)
    return np.flatnonzero((rise >= RISE) & (rise == largest)).tolist()


def _refined(mono: np.ndarray, rate: int, near: int) -> int:
    """Sample at which the sound of a rise begins."""
    first, last = max(near - round(2 * BEFORE * rate), 0), min(near + round(4 * BEFORE * rate), len(mono))
    part = mono[first:last]
    if not np.abs(part).max(initial=0.0) > 0:
        return near
    found = first + find_onset(part, rate, 0.0)
    return found if abs(found - near) <= 2 * BEFORE * rate else near


def _end(levels: np.ndarray, noise: np.ndarray, rate: int, onset: int, limit: int) -> int:
    """Sample at which all bands have fallen to the noise, at most `limit`. Levels are means over `SILENT_FOR`."""
    step, span = round(STEP * rate), round(SILENT_FOR / STEP)
    first = min(onset // step, len(levels) - 1)  # the last frame begins before the end
    sums = np.cumsum(np.pad(levels[first : max(limit // step, first + 1)], ((1, span), (0, 0)), mode="edge"), axis=0)
    loud = ((sums[span:-1] - sums[: -span - 1]) / span > noise).any(axis=1)
    last = int(np.flatnonzero(loud)[-1]) + 1 if loud.any() else 0
    return min(onset + max(last, 1) * step + round(FRAME * rate), limit)


def _stroke(samples: np.ndarray, mono: np.ndarray, rate: int, onset: int, end: int) -> Stroke:
    """Measure a stroke."""
    part = samples[:, onset : min(end, onset + round(LOUDNESS_SECONDS * rate))]
    loudness = 10 * np.log10(sum(k_weighted_mean_square(channel, rate) for channel in part) + 1e-30)
    note, cents, doubt = "", float("nan"), ""
    try:
        f0, B = find_pitch(mono[onset:end], rate)
        note = hz_to_note(f0)
        cents = cents_above(f0, note_to_hz(note))
        partials = law_frequency(f0, B, np.arange(1, PARTIALS + 1))
        if _rise(mono, rate, onset, partials[partials < 0.45 * rate]) < RISEN:
            doubt = f"{note} may be an earlier note that still rings"
    except AnalysisError:
        doubt = "no pitch"
    if end - onset < LASTS * rate:
        doubt = doubt or f"lasts {(end - onset) / rate:.2f} s"
    elif abs(cents) > NEAR_KEY:
        doubt = doubt or f"{cents:+z.0f} cents from {note}"
    return Stroke(onset, end, note, cents, float(loudness), doubt)


def _rise(mono: np.ndarray, rate: int, onset: int, partials: np.ndarray) -> float:
    """Median rise of partials, Hz, at an onset, dB. Before the file begins there is silence."""
    size = round(COMPARED * rate)
    before, after = np.pad(mono[max(onset - size, 0) : onset], (max(size - onset, 0), 0)), mono[onset : onset + size]
    if not len(partials) or len(after) < size:
        return np.inf
    turn = np.hanning(size) * np.exp(-2j * np.pi * np.outer(partials, np.arange(size) / rate))
    levels = [20 * np.log10(np.abs(turn @ part) + 1e-12) for part in (before, after)]
    return float(np.median(levels[1] - levels[0]))
