"""Numbers of the partials: the peaks near the comb of the pitch are collected from low to high numbers.

The law is refitted at each stage. In the treble, partials lie next to the distortion of the recorder. An overloaded
recorder adds tones at multiples and sums of the strong partials' frequencies. The partials of a stiff string lie above
the multiples of the first one, and in the treble the spectrum resolves the two. With few partials, a comb of B = 0
explains only the multiples. A string with the correct B explains its partials, and all their sums as distortion. These
sums include the multiples.
"""

import math
from bisect import bisect_left
from dataclasses import replace

import numpy as np

from ..conversions import CENTS
from .inharmonicity import B_RANGE, NEIGHBOURS, FrequencyLaw, frequency_law, law_frequency, median_line
from .pitch import CLEAR, typical_B
from .spectrum import Spectrum, highest_partial, spectrum

_STAGES = (16, 20, 27, 36, 48, 64, 82, 100)  # numbers up to which partials are collected
_MIN_HEIGHT = 3.0  # dB above the floor, of a peak that is not noise
_TREBLE_PARTIALS = 12  # with more in range, most partials lie apart from the few distortion tones and outweigh them
_TOLERANCE = 12.0  # cents, largest distance of a treble partial from the law of the others
_MIN_GAIN = 20.0  # dB of additionally explained peaks needed to change B; noise near tones of a wrong B adds up to 10

_Numbering = tuple[float, np.ndarray, np.ndarray, FrequencyLaw]  # merit, k [partials], Hz [partials], law


def number_partials(samples: np.ndarray, rate: int, f0: float, B: float) -> tuple[np.ndarray, np.ndarray, FrequencyLaw]:
    """Number the peaks of a note of this rough pitch: k [partials], frequencies (Hz), and the law fitted to them."""
    spec, top = spectrum(samples, rate, float(np.clip(30 / f0, 0.15, 1.0))), highest_partial(rate)
    _, number, frequency, law = _best_numbering(spec, f0, B, top)
    if law(_TREBLE_PARTIALS) < top or not len(number) or number[0] != 1:
        return number, frequency, law
    candidates = np.clip(typical_B(law.f0) * 2.0 ** np.arange(-3, 3.01, 0.125), *B_RANGE)
    return _best_numbering(*_exclude_distortion(spec, float(frequency[0]), law.B, candidates, top), top)[1:]


def _best_numbering(spec: Spectrum, f0: float, B: float, top: float) -> _Numbering:
    """The numbering that collects most peaks.

    It is also computed from a B one sixth lower and higher, with the same eighth partial. Strings of one note can
    differ in B, and a comb of few teeth determines f0 and B only jointly.
    """
    starts = [(f0 * float(np.sqrt((1 + 64 * B) / (1 + 64 * b))), b) for b in (B, 0.85 * B, 1.18 * B)]
    best, *others = (_collect(spec, FrequencyLaw(f, 0.0, b, 0.0, 0.0, 0.0), top) for f, b in starts)
    for other in others:
        best = other if other[0] > 1.02 * best[0] else best
    return best


def _collect(spec: Spectrum, law: FrequencyLaw, top: float) -> _Numbering:
    """Collect partials from low to high numbers, with the law refitted at each stage."""
    merit, number, frequency = 0.0, np.array([], int), np.array([])
    for last in _STAGES:
        for _ in range(2):
            k, previous = np.arange(1, last + 1), frequency
            merit, number, frequency = _assign(spec, k[law(k) < top], law)
            if np.array_equal(frequency, previous):  # so the law does not change
                break
            if len(number) >= 4:
                error = np.full(len(number), spec.resolution / 20) + 5e-4 * frequency
                law = frequency_law(number, frequency, error)
            elif len(number):
                law = frequency_law(number, frequency, 5e-4 * frequency, B=law.B)
        if law(last) > top:
            break
    return merit, number, frequency, law


def _assign(spec: Spectrum, k: np.ndarray, law: FrequencyLaw) -> tuple[float, np.ndarray, np.ndarray]:
    """Select a peak for each partial: high, and within a fifth of the spacing of the predicted frequency."""
    peak, height = spec.peak.tolist(), spec.height.tolist()
    number, frequency, total = [], [], 0.0
    reaches = np.maximum(0.2 * (law(k + 1) - law(k)), spec.step)
    clear: list[float] = []  # partials
    deviation: list[float] = []  # of them from the law, cents
    for n, law_hz, reach in zip(k.tolist(), law(k).tolist(), reaches.tolist(), strict=True):
        f = law_hz
        if len(clear) >= NEIGHBOURS:
            f *= math.exp(median_line(clear[-NEIGHBOURS:], deviation[-NEIGHBOURS:], n) / CENTS)
        low, high = bisect_left(peak, f - reach), bisect_left(peak, f + reach)
        merits = [height[i] - 40.0 * ((peak[i] - f) / reach) ** 2 for i in range(low, high)]
        if max(merits, default=0.0) > _MIN_HEIGHT:
            best = low + merits.index(max(merits))
            number.append(n)
            frequency.append(peak[best])
            total += max(merits)
            if height[best] > CLEAR:
                clear.append(n)
                deviation.append(CENTS * math.log(peak[best] / law_hz))
    return total, np.array(number, int), np.array(frequency)


def _exclude_distortion(
    spec: Spectrum, first: float, B: float, candidates: np.ndarray, top: float
) -> tuple[Spectrum, float, float]:
    """The peaks that are not distortion, with f0 (Hz) and B of the string.

    B was fitted without regard to distortion. It changes if one of the `candidates` explains clearly more.
    """
    tried = [B, *candidates.tolist()]
    height, distortion = zip(*(_explained(spec, first, x, top) for x in tried), strict=True)
    best = int(np.argmax(height - _MIN_GAIN * (np.arange(len(tried)) > 0)))
    keep = ~distortion[best]
    remaining = replace(spec, peak=spec.peak[keep], height=spec.height[keep], strength=spec.strength[keep])
    return remaining, first / float(np.sqrt(1 + tried[best])), tried[best]


def _explained(spec: Spectrum, first: float, B: float, top: float) -> tuple[float, np.ndarray]:
    """Total height, dB, of the peaks that this B and its distortion explain, and the distortion, bool [peaks]."""
    comb = law_frequency(first / np.sqrt(1 + B), B, np.arange(1, _TREBLE_PARTIALS + 1))
    comb = comb[comb < top]
    near = np.maximum(spec.resolution, _TOLERANCE / CENTS * comb)
    significant = np.where(spec.height > _MIN_HEIGHT, spec.height, 0.0)
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
