"""Partials of a treble string next to the distortion of the recorder.

A recorder that overloads adds tones at multiples and sums of the strong partials' frequencies. The partials of a stiff
string lie above the multiples of the first one, and in the treble the spectrum resolves the two. With few partials a
comb of B = 0 then explains the multiples and nothing else. A string with the right B explains its partials, and as
distortion all sums of them, which include the multiples.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from .inharmonicity import CENTS, law_frequency
from .spectrum import Spectrum

__all__ = ["FEW", "SEEN", "beside_distortion"]

FEW = 12  # partials; where more have room, most of them lie apart from the few tones of distortion and outvote these
SEEN = 3.0  # dB above the floor, of a peak that is more than noise
_KEPT = 12.0  # cents; a real treble partial lies this near to the law of the others
_GAIN = 20.0  # dB, of peaks that only the stiffer string explains: noise near the tones of a wrong B adds up to 10


def beside_distortion(
    spec: Spectrum, first: float, B: float, stiffer: np.ndarray, top: float
) -> tuple[Spectrum, float, float]:
    """The peaks that are not distortion, with f0 (Hz) and B of the string: `B`, unless another explains clearly more.

    Parameters
    ----------
    first : frequency of the first partial, Hz
    B, stiffer : as found without regard to distortion; and what to compare with it [any number]
    top : frequency up to which partials are looked for, Hz
    """
    tried = [B, *stiffer.tolist()]
    height, distortion = zip(*(_explained(spec, first, x, top) for x in tried), strict=True)
    best = int(np.argmax(height - _GAIN * (np.arange(len(tried)) > 0)))
    keep = ~distortion[best]
    rest = replace(spec, peak=spec.peak[keep], height=spec.height[keep], strength=spec.strength[keep])
    return rest, first / float(np.sqrt(1 + tried[best])), tried[best]


def _explained(spec: Spectrum, first: float, B: float, top: float) -> tuple[float, np.ndarray]:
    """Height, dB, of the peaks that a string of this B and its distortion explain, and which are distortion [peaks]."""
    comb = law_frequency(first / np.sqrt(1 + B), B, np.arange(1, FEW + 1))
    comb = comb[comb < top]
    near = np.maximum(spec.resolution, _KEPT / CENTS * comb)
    seen = np.where(spec.height > SEEN, spec.height, 0.0)
    height = seen[:, None] * np.maximum(1 - ((spec.peak[:, None] - comb) / near) ** 2, 0.0)  # [peaks, partials]
    partial = height.argmax(axis=0)[height.max(axis=0) > 0]
    distortion = _distortion(spec, partial, top) & (height.max(axis=1) == 0)
    return float(height.max(axis=0).sum() + seen[distortion].sum()), distortion


def _distortion(spec: Spectrum, partial: np.ndarray, top: float) -> np.ndarray:
    """Whether each peak can be distortion of the peaks `partial`, indices [partials]; bool [peaks].

    A tone that a partial takes part in is weaker than the partial.
    """
    found = np.zeros(len(spec.peak), bool)
    strongest = partial[np.argsort(-spec.strength[partial])]
    for count, weakest in enumerate(strongest, 1):
        tone = _tones(spec.peak[strongest[:count]], top)
        place = np.searchsorted(tone, spec.peak)
        near = np.minimum(spec.peak - tone[place - 1], tone[place] - spec.peak) < spec.resolution
        found |= near & (spec.strength < spec.strength[weakest])
    return found


def _tones(frequency: np.ndarray, top: float) -> np.ndarray:
    """Sums below `top` of the frequencies, Hz [partials], and sums of one or two less another one; between ± ∞."""
    total, tones = frequency, [np.array([-np.inf, np.inf])]
    while len(total):
        total = np.unique(np.round((total[:, None] + frequency).ravel(), 1))
        total = total[total < top]
        tones.append(total)
    for i, less in enumerate(frequency):
        others = np.delete(frequency, i)
        tones += [others - less, (others[:, None] + others - less).ravel()]
    return np.sort(np.concatenate(tones))
