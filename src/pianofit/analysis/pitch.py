"""Pitch and partial numbers: the comb of a stiff string is matched to the peaks of a spectrum.

A comb k f0 √(1 + B k²) is good if its teeth lie at peaks *and* the peaks lie at teeth. The first criterion alone would
select twice the pitch, the second alone half of it. The score is their product. The partials near the best comb are
then collected from low to high numbers, and the law is refitted at each stage.
"""

from __future__ import annotations

from numbers import Real

import numpy as np

from ..errors import AnalysisError, WrongNoteError, check_type
from .distortion import MIN_HEIGHT, TREBLE_PARTIALS, exclude_distortion
from .inharmonicity import B_RANGE, CENTS, FrequencyLaw, frequency_law, local_deviation
from .note_names import hz_to_note, note_to_hz
from .spectrum import Spectrum

__all__ = ["check_pitch", "find_pitch", "number_partials", "typical_B"]

LOWEST, HIGHEST = 25.0, 4500.0  # Hz, A0 to C8 with room for tuning
_TEETH = 16
_FULL_EVIDENCE = 30.0  # dB above the floor, above which the evidence of a peak does not grow
_TOLERANCE = 0.04  # spacings of a comb's teeth, within which a peak belongs to a tooth
_EVIDENT = 3  # in a recorded note at least one in so many teeth is a clear peak
_STAGES = (_TEETH, 20, 27, 36, 48, 64, 82, 100)  # numbers up to which partials are collected
_CLEAR = 10.0  # dB above the floor, of a peak that predicts the frequencies of the next ones
_FAINT = 0.05  # score of a given note, below which it is too faint
_RIVAL = 1.4  # factor by which the score of another pitch must be larger to reject a given note

_Numbering = tuple[float, np.ndarray, np.ndarray, FrequencyLaw]  # merit, k [partials], Hz [partials], law


def typical_B(f0: np.ndarray | float) -> np.ndarray:
    """Inharmonicity of a typical piano string at `f0` Hz: smallest near 100 Hz, increasing towards both ends.

    A smooth curve through textbook figures (Fletcher and Rossing, The Physics of Musical Instruments, 12.3), within
    a factor of three. It only starts searches.
    """
    octave = np.log2(np.asarray(f0, float) / 100.0)
    return 1.5e-4 * np.where(octave < 0, 2.0 ** (-0.6 * octave), 2.0 ** (1.2 * octave))


def _comb(f0: np.ndarray, B: np.ndarray) -> np.ndarray:
    """Teeth [candidates, teeth] in Hz."""
    k = np.arange(1, _TEETH + 1)
    return k * f0[:, None] * np.sqrt(1 + B[:, None] * k**2)


def _comb_score(comb: np.ndarray, spec: Spectrum, tolerance: np.ndarray | float, top: float) -> np.ndarray:
    """Match of teeth to peaks: weighted mean over teeth of the evidence of the nearest peak [candidates].

    Low teeth have the largest weights. Evidence grows from 0 to 1 with the height of the peak above the floor, and
    falls to 0 at a distance `tolerance` (Hz) from the tooth.
    """
    place = np.clip(np.searchsorted(spec.peak, comb), 1, len(spec.peak) - 1)
    left, right = spec.peak[place - 1], spec.peak[place]
    nearest = np.where(comb - left < right - comb, place - 1, place)
    evidence = np.minimum(spec.height / _FULL_EVIDENCE, 1.0)[nearest]
    value = evidence * np.maximum(1 - np.abs(spec.peak[nearest] - comb) / tolerance, 0.0)
    weight = (comb < top) / np.sqrt(np.arange(1, comb.shape[1] + 1))
    return np.sum(weight * value, 1) / np.maximum(np.sum(weight, 1), 1e-9)


def _explained(comb: np.ndarray, spec: Spectrum, tolerance: float, top: float) -> float:
    """Match of peaks to teeth: weighted share of the peaks below the last tooth that lie near a tooth.

    Near means within `tolerance` times the first tooth. The weight of a peak is its strength above 50 dB below the
    strongest peak, reduced near the floor, so that rumble and noise do not dominate.
    """
    below = spec.peak < min(top, comb[-1] + comb[0] / 2)
    peak = spec.peak[below]
    weight = np.maximum(spec.strength[below] - (np.max(spec.strength) - 50.0), 0.0)
    weight = weight * np.minimum(spec.height[below] / _FULL_EVIDENCE, 1.0)
    near = np.min(np.abs(peak[:, None] - comb), axis=1, initial=np.inf) < tolerance * comb[0]
    return float(np.sum(weight * near) / max(np.sum(weight), 1e-9))


def _candidates(spec: Spectrum, low: float, high: float, top: float) -> np.ndarray:
    """The best f0 in `low`..`high` by the match of teeth with a wide tolerance: a few in every half octave."""
    f0 = low * 2.0 ** (np.arange(0, np.log2(high / low) * 1200 + 1, 6) / 1200)
    score = np.zeros(len(f0))
    for factor in 2.0 ** np.arange(-2, 3.1, 0.5):
        score = np.maximum(score, _comb_score(_comb(f0, factor * typical_B(f0)), spec, 0.08 * f0[:, None], top))
    is_maximum = np.concatenate([[True], score[1:] > score[:-1]]) & np.concatenate([score[:-1] >= score[1:], [True]])
    group = np.round(2 * np.log2(f0 / low)).astype(int)
    chosen: list[int] = []
    for g in np.unique(group):
        peaks = np.flatnonzero(is_maximum & (group == g))
        chosen.extend(peaks[np.argsort(score[peaks])[::-1][:6]])
    return f0[chosen]


def _best(spec: Spectrum, low: float, high: float, top: float) -> tuple[float, float, float]:
    """Best comb with f0 in `low`..`high`: (score, f0, B)."""
    best = (0.0, low, float(typical_B(low)))
    if len(spec.peak) < 2:
        return best
    for rough in _candidates(spec, low, high, top):
        f, b = np.meshgrid(
            rough * (1 + np.linspace(-0.012, 0.012, 17)),
            typical_B(rough) * 2.0 ** np.arange(-3, 3.1, 0.3),
            indexing="ij",
        )
        comb = _comb(f.ravel(), np.clip(b.ravel(), *B_RANGE))
        scores = _comb_score(comb, spec, 0.03 * rough, top)
        i = int(np.argmax(scores))
        score = float(scores[i]) * _explained(comb[i], spec, _TOLERANCE, top)
        if score > best[0]:
            best = (score, float(f.flat[i]), float(b.flat[i]))
    return best


def _evident(spec: Spectrum, f0: float, B: float, top: float) -> bool:
    """True if enough teeth of a comb are peaks above the noise; a single peak can be any sound."""
    comb = _comb(np.array([f0]), np.array([B]))[0]
    comb = comb[comb < top]
    clear = spec.peak[spec.height > _CLEAR]
    matched = np.abs(comb[:, None] - clear).min(axis=1, initial=np.inf) < _TOLERANCE * f0
    return int(matched.sum()) >= max(2, len(comb) / _EVIDENT)


def check_pitch(frequency: float, name: str) -> None:
    """Raise an `AnalysisError` about `name` if `frequency` (Hz) is outside the range of a piano."""
    if not LOWEST * 0.9 <= frequency <= HIGHEST * 1.1:
        raise AnalysisError(f"{name} is outside the range of a piano; give one from {LOWEST:g} to {HIGHEST:g} Hz")


def find_pitch(spec: Spectrum, *, top: float, note: str | int | None, f0: float | None) -> tuple[float, float]:
    """Rough f0 (Hz) and B of the note in `spec`.

    Raises
    ------
    AnalysisError
        If no comb of partials is detected, or if it is clearly not that of the given note (or f0).
    """
    if f0 is not None:
        check_type("f0=", f0, Real, "a frequency in Hz")
    requested = f0 if f0 is not None else (note_to_hz(note) if note is not None else None)
    name = f"note {note}" if f0 is None else f"f0={f0:g} Hz"
    if requested is not None:
        check_pitch(requested, name)
    free = _best(spec, LOWEST, HIGHEST, top)
    if requested is None:
        strongest_fits = (
            len(spec.peak) > 0 and abs(spec.peak[np.argmax(spec.strength)] - free[1]) < _TOLERANCE * free[1]
        )
        if free[0] < 0.08 or not (strongest_fits or _evident(spec, *free[1:], top)):
            raise WrongNoteError("no pitch detected in the recording; give the note (--note) or the frequency (--f0)")
        return free[1], free[2]
    near = _best(spec, requested * 2 ** (-1 / 12), requested * 2 ** (1 / 12), top)
    faint, differs = near[0] < _FAINT, abs(np.log2(free[1] / near[1])) > 1 / 24
    if differs and (faint or free[0] > _RIVAL * near[0]) and _evident(spec, *free[1:], top):
        raise WrongNoteError(
            f"{name} is not in the recording, which sounds like {hz_to_note(free[1])} ({free[1]:.1f} Hz); "
            f"give that note (--note) or the frequency (--f0)"
        )
    if faint:
        raise AnalysisError(
            f"{name} is too faint: its partials are barely above the noise; give a cleaner recording, or check the note"
        )
    return near[1], near[2]


def number_partials(spec: Spectrum, f0: float, B: float, *, top: float) -> tuple[np.ndarray, np.ndarray, FrequencyLaw]:
    """Number the peaks of `spec`: k [partials], their frequencies (Hz), and the frequency law fitted to them.

    In the treble, distortion is distinguished from partials and excluded (distortion.py).
    """
    numbering = _best_numbering(spec, f0, B, top)
    _, number, frequency, law = numbering
    if law(TREBLE_PARTIALS) < top or not len(number) or number[0] != 1:
        return numbering[1:]
    candidates = np.clip(typical_B(law.f0) * 2.0 ** np.arange(-3, 3.01, 0.125), *B_RANGE)
    return _best_numbering(*exclude_distortion(spec, float(frequency[0]), law.B, candidates, top), top)[1:]


def _best_numbering(spec: Spectrum, f0: float, B: float, top: float) -> _Numbering:
    """The numbering that collects most peaks: its merit, k [partials], their frequencies (Hz), and the law.

    It is also computed from a B one sixth lower and higher, with the same eighth partial. Strings of one note can
    differ in B, and a comb of few teeth determines f0 and B only jointly.
    """
    best: _Numbering | None = None
    for factor in (1.0, 0.85, 1.18):
        start = factor * B
        law = FrequencyLaw(f0 * float(np.sqrt((1 + 64 * B) / (1 + 64 * start))), 0.0, start, 0.0, 0.0, 0.0)
        merit, number, frequency, law = _collect(spec, law, top)
        if best is None or merit > 1.02 * best[0]:
            best = merit, number, frequency, law
    assert best is not None  # noqa: S101
    return best


def _collect(spec: Spectrum, law: FrequencyLaw, top: float) -> _Numbering:
    """Collect partials from low to high numbers, with the law refitted at each stage."""
    merit, number, frequency = 0.0, np.array([], int), np.array([])
    for last in _STAGES:
        for _ in range(2):
            k = np.arange(1, last + 1)
            merit, number, frequency = _assign(spec, k[law(k) < top], law)
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
    number, frequency, total = [], [], 0.0
    spacing = law(k + 1) - law(k)
    clear: list[tuple[int, float]] = []  # partial, and its deviation from the law, cents
    for n, law_hz, reach in zip(k, law(k), np.maximum(0.2 * spacing, spec.step), strict=True):
        f = law_hz * float(np.exp(_predicted_deviation(clear, n) / CENTS))
        low, high = np.searchsorted(spec.peak, [f - reach, f + reach])
        if low == high:
            continue
        merit = spec.height[low:high] - 40.0 * ((spec.peak[low:high] - f) / reach) ** 2
        best = int(np.argmax(merit))
        if merit[best] > MIN_HEIGHT:
            number.append(n)
            frequency.append(spec.peak[low + best])
            total += float(merit[best])
            if spec.height[low + best] > _CLEAR:
                clear.append((int(n), CENTS * float(np.log(frequency[-1] / law_hz))))
    return total, np.array(number, int), np.array(frequency)


def _predicted_deviation(clear: list[tuple[int, float]], n: int) -> float:
    """Deviation of partial `n` from the law, cents, predicted from the clear peaks below it."""
    number, deviation = np.array(clear).reshape(-1, 2).T
    return float(local_deviation(number, deviation, np.array([n]))[0])
