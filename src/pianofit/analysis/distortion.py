"""Partials of a treble string next to the distortion of the recorder.

An overloaded recorder adds tones at multiples and sums of the strong partials' frequencies. The partials of a stiff
string lie above the multiples of the first one, and in the treble the spectrum resolves the two. With few
partials, a comb of B = 0 explains only the multiples. A string with the correct B explains its partials, and all their
sums as distortion. These sums include the multiples.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from .inharmonicity import CENTS, law_frequency
from .spectrum import Spectrum

__all__ = ["TREBLE_PARTIALS", "MIN_HEIGHT", "exclude_distortion"]

TREBLE_PARTIALS = 12  # with more in range, most partials lie apart from the few distortion tones and outweigh them
MIN_HEIGHT = 3.0  # dB above the floor, of a peak that is not noise
_TOLERANCE = 12.0  # cents, largest distance of a treble partial from the law of the others
_MIN_GAIN = 20.0  # dB of additionally explained peaks needed to change B; noise near tones of a wrong B adds up to 10


def exclude_distortion(
    spec: Spectrum, first: float, B: float, candidates: np.ndarray, top: float
) -> tuple[Spectrum, float, float]:
    """The peaks that are not distortion, with f0 (Hz) and B of the string. B changes if another explains clearly more.

    Parameters
    ----------
    first : frequency of the first partial, Hz
    B : inharmonicity fitted without regard to distortion
    candidates : values to compare with it [candidates]
    top : highest frequency searched for partials, Hz
    """
    tried = [B, *candidates.tolist()]
    height, distortion = zip(*(_explained(spec, first, x, top) for x in tried), strict=True)
    best = int(np.argmax(height - _MIN_GAIN * (np.arange(len(tried)) > 0)))
    keep = ~distortion[best]
    remaining = replace(spec, peak=spec.peak[keep], height=spec.height[keep], strength=spec.strength[keep])
    return remaining, first / float(np.sqrt(1 + tried[best])), tried[best]


def _explained(spec: Spectrum, first: float, B: float, top: float) -> tuple[float, np.ndarray]:
    """Total height, dB, of the peaks that this B and its distortion explain, and the distortion, bool [peaks]."""
    comb = law_frequency(first / np.sqrt(1 + B), B, np.arange(1, TREBLE_PARTIALS + 1))
    comb = comb[comb < top]
    near = np.maximum(spec.resolution, _TOLERANCE / CENTS * comb)
    significant = np.where(spec.height > MIN_HEIGHT, spec.height, 0.0)
    height = significant[:, None] * np.maximum(1 - ((spec.peak[:, None] - comb) / near) ** 2, 0.0)  # [peaks, partials]
    partial = height.argmax(axis=0)[height.max(axis=0) > 0]
    distortion = _distortion(spec, partial, top) & (height.max(axis=1) == 0)
    return float(height.max(axis=0).sum() + significant[distortion].sum()), distortion


def _distortion(spec: Spectrum, partial: np.ndarray, top: float) -> np.ndarray:
    """Peaks that can be distortion of the peaks `partial`, indices [partials]; bool [peaks].

    A distortion tone is weaker than each partial that contributes to it.
    """
    distortion = np.zeros(len(spec.peak), bool)
    strongest = partial[np.argsort(-spec.strength[partial])]
    for count, weakest in enumerate(strongest, 1):
        tone = _tones(spec.peak[strongest[:count]], top)
        place = np.searchsorted(tone, spec.peak)
        near = np.minimum(spec.peak - tone[place - 1], tone[place] - spec.peak) < spec.resolution
        distortion |= near & (spec.strength < spec.strength[weakest])
    return distortion


def _tones(frequency: np.ndarray, top: float) -> np.ndarray:
    """Sums below `top` of the frequencies, Hz [partials], and sums of one or two minus another one; between ± ∞."""
    total, tones = frequency, [np.array([-np.inf, np.inf])]
    while len(total):
        total = np.unique(np.round((total[:, None] + frequency).ravel(), 1))
        total = total[total < top]
        tones.append(total)
    for i, subtracted in enumerate(frequency):
        others = np.delete(frequency, i)
        tones += [others - subtracted, (others[:, None] + others - subtracted).ravel()]
    return np.sort(np.concatenate(tones))
