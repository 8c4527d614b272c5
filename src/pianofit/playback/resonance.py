"""The sound of free strings that others excite over the bridge.

Every key is first rendered as if it were alone (`song`). Here the amplitudes that its strings then have are followed
together with what the other strings add, in steps of `HOP_SECONDS`. The sound of the added amplitudes is computed at a
reduced rate. Between two steps each amplitude changes linearly in the frame that turns with its mode. So nothing
clicks. This change begins after its step, so that a program that plays in real time computes the same.

A string is free as far as its damper is lifted. A struck string keeps what others added. Not modelled: the effect of
the added motion on the contact with the hammer.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from ..dsp.filters import resample
from ..instrument import Instrument
from ..model.modal_response import ForcePulse
from .free_strings import HIGHEST, FreeStrings

# Step of the amplitudes, s: bridges and dampers act within some ten milliseconds. It is four blocks of the page.
HOP_SECONDS = 512 / 48_000
# Delay of a change of the amplitudes at the reduced rate, samples: the reach of the filter of the resampling.
RESAMPLING_REACH = 10
# Smallest ratio of the reduced rate to the highest frequency: room for the filter of the resampling.
RATE_RATIO = 2.2
# Steps whose sound is computed at once.
CHUNK_HOPS = 128
# Share of audible modes above which the silent ones are computed as well.
MOST_AUDIBLE = 0.8
# Largest amplitude of the sound that counts as silence, file units: -160 dB.
SILENCE = 1e-8


# Share of the motion of the bridge that strings have in common, by default. Points of a soundboard some decimetres
# apart move together only in part. Chosen: with 1, as for strings at one point, notes in the middle of the keyboard
# ring two to four times as long under the pedal (benchmarks/resonance.py). Measured ones ring a little longer.
RESONANCE = 0.3


class Stroke(NamedTuple):
    """A stroke as the key alone plays it."""

    midi: int
    touch: int  # sample of the first touch
    end: int  # sample at which the modes ring freely
    state: np.ndarray  # of the voice's modes at `end`, complex [modes]
    force: ForcePulse


def hop_samples(rate: int) -> tuple[int, int]:
    """Return the samples of a hop, and how many of them are one sample of the added sound."""
    ratio = max(int(rate / (RATE_RATIO * HIGHEST)), 1)
    return max(round(HOP_SECONDS * rate / ratio), 1) * ratio, ratio


def hop_count(samples: int, rate: int) -> int:
    """Return the number of hops of a sound of so many samples, with one for its end."""
    return -(-samples // hop_samples(rate)[0]) + 1


def mean_contact(contacts: Sequence[tuple[int, float]], hops: int, rate: int) -> np.ndarray:
    """Return the mean contact of a damper in each hop, 0 to 1 [hops].

    `contacts` has the samples at which the contact changes, and its values. Before the first it is 1.
    """
    sample, contact = np.array([(-1, 1.0), *contacts]).T
    edges = np.arange(hops + 1) * hop_samples(rate)[0]
    sums = np.concatenate([[0.0], np.cumsum(np.diff(sample) * contact[:-1])])
    i = np.searchsorted(sample, edges, side="right") - 1
    return np.diff(sums[i] + (edges - sample[i]) * contact[i]) / hop_samples(rate)[0]


def render_resonance(
    instrument: Instrument,
    strokes: Sequence[Stroke],
    contact: np.ndarray,
    rate: int,
    samples: int,
    common: float = RESONANCE,
    progress: Callable[[float], None] = lambda _: None,
) -> np.ndarray:
    """Render what the strings add to each other [channels, samples], from the first touch at sample 0 on.

    Parameters
    ----------
    instrument : all its keys take part.
    strokes : of all keys.
    contact : contact of the dampers in each hop, by `mean_contact`, for the keys in ascending order [keys, hops]. Keys
        without a damper are always free.
    rate : sample rate, Hz.
    samples : length.
    common : as for `CoupledModes`.
    progress : called with the finished fraction.
    """
    free = FreeStrings(instrument, rate, common)
    contact[[not free.damping[modes].any() for modes in free.modes.values()]] = 0.0
    if not (np.count_nonzero(contact < 1, axis=0) > 1).any():  # no two strings are ever free
        return np.zeros((len(free.sound), samples))
    hop, ratio = hop_samples(rate)
    reduced, hops = hop // ratio, contact.shape[1]
    player = _Player(free, strokes, contact, hop, rate)
    window = _hop_window(free.pole, reduced, rate / ratio)
    out = np.zeros((len(free.sound), (hops + 1) * reduced + RESAMPLING_REACH))
    for first in range(0, hops, CHUNK_HOPS):
        count = min(CHUNK_HOPS, hops - first)
        amplitude = player.advance(first, count)
        progress((first + count) / hops)
        if amplitude is None:
            continue
        audible = (np.abs(amplitude).max(axis=0) * np.abs(free.sound).max(axis=0)) > SILENCE
        if not audible.any():
            continue
        chosen = slice(None) if audible.mean() > MOST_AUDIBLE else audible  # a choice copies the window
        rows = window[chosen].reshape(-1, window.shape[-1])
        driven = np.ascontiguousarray(amplitude[:, chosen] * free.sound[:, None, chosen])  # [channels, hops, modes]
        pieces = driven.view(float).reshape(-1, len(rows)) @ rows
        for channel, sound in zip(out, pieces.reshape(len(out), count, -1), strict=True):
            _overlap_add(channel[RESAMPLING_REACH + first * reduced :], sound, reduced)
    whole = resample(out, 1, ratio) if ratio > 1 else out
    return whole[:, :samples]


class _Player:
    """Amplitudes of all modes from hop to hop."""

    def __init__(
        self,
        free: FreeStrings,
        strokes: Sequence[Stroke],
        contact: np.ndarray,
        hop: int,
        rate: int,
    ) -> None:
        self.free, self.hop, self.rate = free, hop, rate
        self.strokes = sorted(strokes, key=lambda stroke: stroke.end)
        self.at = 0  # next stroke
        self.alone = np.zeros(len(free.pole), complex)
        self.added = np.zeros(len(free.pole), complex)
        self.contacts, self.contact = contact, np.full(len(free.keys), -1.0)
        self.lift = self.half = np.zeros(0)
        self.free_half = np.exp(0.5 * hop / rate * free.pole)

    def advance(self, first: int, count: int) -> np.ndarray | None:
        """Added amplitudes at `count` hops from `first` on, complex [hops, modes]; None if all are silent."""
        edges = np.arange(first, first + count + 1) * self.hop
        contact = np.ascontiguousarray(self.contacts[:, first : first + count].T, float)
        found = np.zeros((count, len(self.added)), complex)
        if np.abs(self.added * self.free.sound).max(initial=0.0) <= SILENCE:
            self.added[:] = 0.0
        for i in range(count):
            found[i] = self.added
            self._step(contact[i])
            while self.at < len(self.strokes) and self.strokes[self.at].end <= edges[i + 1]:
                self._strike(self.strokes[self.at], int(edges[i + 1]), contact[i])
                self.at += 1
        return found if found.any() else None

    def _step(self, contact: np.ndarray) -> None:
        """Advance all amplitudes by one hop."""
        free, seconds = self.free, self.hop / self.rate
        if not np.array_equal(contact, self.contact):
            self.contact, of_mode = contact, contact[free.key_index]
            self.half = self.free_half * np.exp(-0.5 * seconds * of_mode * free.damping)
            self.lift = 1 - of_mode
        if np.count_nonzero(contact < 1) > 1:
            self.alone, self.added = free.coupled.step(self.alone, self.added, self.half, self.lift, seconds)
        else:  # no two strings are free
            self.alone, self.added = self.alone * self.half**2, self.added * self.half**2

    def _strike(self, stroke: Stroke, now: int, contact: np.ndarray) -> None:
        """Take over the state of a struck key, and excite all other free strings."""
        free, own = self.free, self.free.modes[stroke.midi]
        damped = free.pole - contact[free.key_index] * free.damping
        before = self.alone[own].copy()
        since = (now - stroke.end) / self.rate
        self.alone[own] = free.amplitudes(stroke.midi, stroke.state) * np.exp(damped[own] * since)
        if not np.count_nonzero(contact < 1) > 1:
            return
        since = (now - stroke.touch) / self.rate
        self.added += self.lift * free.excited_by(stroke.midi, stroke.force) * np.exp(damped * since)
        # The exchange during the rest of this hop, to first order.
        struck = np.zeros(len(self.alone), complex)
        struck[own] = self.alone[own] - before
        self.added -= since * free.coupled.exchange(struck, self.lift)


def _hop_window(pole: np.ndarray, reduced: int, rate: float) -> np.ndarray:
    """Sound of a unit real and imaginary amplitude [modes, 2, 2 reduced], from `RESAMPLING_REACH` samples on."""
    sample = np.arange(2 * reduced)
    turn = np.exp(np.outer(pole, (sample + RESAMPLING_REACH) / rate)) * (1 - np.abs(sample / reduced - 1))
    return np.stack([np.real(turn), -np.imag(turn)], axis=1)


def _overlap_add(out: np.ndarray, pieces: np.ndarray, reduced: int) -> None:
    """Add pieces of two hops each [hops, 2 reduced], which begin one hop apart."""
    size = len(pieces) * reduced
    out[:size] += pieces[:, :reduced].ravel()
    out[reduced : reduced + size] += pieces[:, reduced:].ravel()
