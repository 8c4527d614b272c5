"""Which partial is which: the comb of a stiff string laid over the peaks of a spectrum.

A comb k f0 √(1 + B k²) is good when its teeth find peaks *and* the peaks find teeth. The first alone would choose
twice the pitch, the second alone half of it; the score is their product. Near the best comb the partials are then
collected from the bottom up, the law refitted to what was found so far before each further reach.
"""

from __future__ import annotations

from numbers import Real

import numpy as np

from ..errors import AnalysisError, WrongNoteError, check_type
from .distortion import FEW, SEEN, beside_distortion
from .inharmonicity import B_RANGE, CENTS, FrequencyLaw, frequency_law, local_deviation
from .note_names import hz_to_note, note_to_hz
from .spectrum import Spectrum

__all__ = ["check_pitch", "find_pitch", "track", "typical_B"]

LOWEST, HIGHEST = 25.0, 4500.0  # Hz, A0 to C8 with room for tuning
_TEETH = 16
_PRESENT = 30.0  # dB above the floor at which a tooth has found all it can find
_AWAY = 0.04  # spacings of a comb's teeth, within which a peak belongs to a tooth
_EVIDENT = 3  # one in so many teeth of a note that is there is a sure peak
_REACH = (_TEETH, 20, 27, 36, 48, 64, 82, 100)  # partials to collect, step by step
_SURE = 10.0  # dB above the floor, of a peak that shows where the next ones are
_FAINT = 0.05  # score of a given note below which it is too faint
_RIVAL = 1.4  # another pitch must score this much better before a given note is refused

_Found = tuple[float, np.ndarray, np.ndarray, FrequencyLaw]  # merit, k [partials], Hz [partials], law


def typical_B(f0: np.ndarray | float) -> np.ndarray:
    """Inharmonicity of an ordinary piano string at `f0` Hz: least near 100 Hz, rising to both ends.

    A smooth curve through textbook figures (Fletcher and Rossing, The Physics of Musical Instruments, 12.3), good to a
    factor of three: it starts searches and decides nothing.
    """
    octave = np.log2(np.asarray(f0, float) / 100.0)
    return 1.5e-4 * np.where(octave < 0, 2.0 ** (-0.6 * octave), 2.0 ** (1.2 * octave))


def _comb(f0: np.ndarray, B: np.ndarray) -> np.ndarray:
    """Teeth [candidates, teeth] in Hz."""
    k = np.arange(1, _TEETH + 1)
    return k * f0[:, None] * np.sqrt(1 + B[:, None] * k**2)


def _comb_score(comb: np.ndarray, spec: Spectrum, away: np.ndarray | float, top: float) -> np.ndarray:
    """How well teeth find peaks: mean over teeth, low ones counting most, of the nearest peak's evidence; [candidates].

    Evidence runs from 0 to 1 with the peak's height above the floor, and falls to 0 at `away` (Hz) from the tooth.
    """
    place = np.clip(np.searchsorted(spec.peak, comb), 1, len(spec.peak) - 1)
    left, right = spec.peak[place - 1], spec.peak[place]
    nearest = np.where(comb - left < right - comb, place - 1, place)
    evidence = np.minimum(spec.height / _PRESENT, 1.0)[nearest]
    value = evidence * np.maximum(1 - np.abs(spec.peak[nearest] - comb) / away, 0.0)
    weight = (comb < top) / np.sqrt(np.arange(1, comb.shape[1] + 1))
    return np.sum(weight * value, 1) / np.maximum(np.sum(weight, 1), 1e-9)


def _explained(comb: np.ndarray, spec: Spectrum, away: float, top: float) -> float:
    """How well peaks find teeth: share of their weight, below the last tooth, within `away` of the pitch of a tooth.

    A peak weighs what it rises above 50 dB below the strongest, and the less the nearer it is to the floor, so that
    neither rumble nor noise outvotes the note.
    """
    below = spec.peak < min(top, comb[-1] + comb[0] / 2)
    peak = spec.peak[below]
    weight = np.maximum(spec.strength[below] - (np.max(spec.strength) - 50.0), 0.0)
    weight = weight * np.minimum(spec.height[below] / _PRESENT, 1.0)
    near = np.min(np.abs(peak[:, None] - comb), axis=1, initial=np.inf) < away * comb[0]
    return float(np.sum(weight * near) / max(np.sum(weight), 1e-9))


def _candidates(spec: Spectrum, low: float, high: float, top: float) -> np.ndarray:
    """Find the most promising f0 in `low`..`high`, by teeth alone with a wide tolerance: a few in every half octave."""
    f0 = low * 2.0 ** (np.arange(0, np.log2(high / low) * 1200 + 1, 6) / 1200)
    score = np.zeros(len(f0))
    for factor in 2.0 ** np.arange(-2, 3.1, 0.5):
        score = np.maximum(score, _comb_score(_comb(f0, factor * typical_B(f0)), spec, 0.08 * f0[:, None], top))
    higher = np.concatenate([[True], score[1:] > score[:-1]]) & np.concatenate([score[:-1] >= score[1:], [True]])
    group = np.round(2 * np.log2(f0 / low)).astype(int)
    chosen: list[int] = []
    for g in np.unique(group):
        peaks = np.flatnonzero(higher & (group == g))
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
        hit = _comb_score(comb, spec, 0.03 * rough, top)
        i = int(np.argmax(hit))
        score = float(hit[i]) * _explained(comb[i], spec, _AWAY, top)
        if score > best[0]:
            best = (score, float(f.flat[i]), float(b.flat[i]))
    return best


def _evident(spec: Spectrum, f0: float, B: float, top: float) -> bool:
    """Whether enough teeth of a comb are peaks that noise does not have; one peak alone can be any sound."""
    comb = _comb(np.array([f0]), np.array([B]))[0]
    comb = comb[comb < top]
    sure = spec.peak[spec.height > _SURE]
    found = np.abs(comb[:, None] - sure).min(axis=1, initial=np.inf) < _AWAY * f0
    return int(found.sum()) >= max(2, len(comb) / _EVIDENT)


def check_pitch(frequency: float, name: str) -> None:
    """Refuse a frequency, Hz, that no piano has, by an `AnalysisError` that calls it `name`."""
    if not LOWEST * 0.9 <= frequency <= HIGHEST * 1.1:
        raise AnalysisError(f"{name} is outside the range of a piano; give one from {LOWEST:g} to {HIGHEST:g} Hz")


def find_pitch(spec: Spectrum, *, top: float, note: str | int | None, f0: float | None) -> tuple[float, float]:
    """Rough f0 (Hz) and B of the note in `spec`.

    Raises
    ------
    AnalysisError
        When there is no comb of partials, or when it is clearly not the note (or f0) that was given.
    """
    if f0 is not None:
        check_type("f0=", f0, Real, "a frequency in Hz")
    wanted = f0 if f0 is not None else (note_to_hz(note) if note is not None else None)
    name = f"note {note}" if f0 is None else f"f0={f0:g} Hz"
    if wanted is not None:
        check_pitch(wanted, name)
    free = _best(spec, LOWEST, HIGHEST, top)
    if wanted is None:
        tone = len(spec.peak) > 0 and abs(spec.peak[np.argmax(spec.strength)] - free[1]) < _AWAY * free[1]
        if free[0] < 0.08 or not (tone or _evident(spec, *free[1:], top)):
            raise WrongNoteError("no pitch found in the recording; give the note (--note) or the frequency (--f0)")
        return free[1], free[2]
    near = _best(spec, wanted * 2 ** (-1 / 12), wanted * 2 ** (1 / 12), top)
    faint, away = near[0] < _FAINT, abs(np.log2(free[1] / near[1])) > 1 / 24
    if away and (faint or free[0] > _RIVAL * near[0]) and _evident(spec, *free[1:], top):
        raise WrongNoteError(
            f"{name} is not in the recording, which sounds like {hz_to_note(free[1])} ({free[1]:.1f} Hz); "
            f"give that note (--note) or the frequency (--f0)"
        )
    if faint:
        raise AnalysisError(
            f"{name} is too faint, as its partials hardly stand above the noise; give a cleaner recording, or check "
            "that this is the note"
        )
    return near[1], near[2]


def track(spec: Spectrum, f0: float, B: float, *, top: float) -> tuple[np.ndarray, np.ndarray, FrequencyLaw]:
    """Give the peaks of `spec` their numbers: k [partials], their frequencies (Hz), and the law through them.

    In the treble distortion lies apart from the partials, and is left out (distortion.py).
    """
    found = _tracked(spec, f0, B, top)
    _, number, frequency, law = found
    if law(FEW) < top or not len(number) or number[0] != 1:
        return found[1:]
    usual = np.clip(typical_B(law.f0) * 2.0 ** np.arange(-3, 3.01, 0.125), *B_RANGE)
    return _tracked(*beside_distortion(spec, float(frequency[0]), law.B, usual, top), top)[1:]


def _tracked(spec: Spectrum, f0: float, B: float, top: float) -> _Found:
    """The numbering that collects most peaks: its merit, k [partials], their frequencies (Hz), and the law.

    Tried with B a sixth lower and higher too, keeping the pitch of the eighth partial: two strings of one note can
    differ in B, and a comb over few teeth in f0 and B together.
    """
    best: _Found | None = None
    for factor in (1.0, 0.85, 1.18):
        start = factor * B
        law = FrequencyLaw(f0 * float(np.sqrt((1 + 64 * B) / (1 + 64 * start))), 0.0, start, 0.0, 0.0, 0.0)
        merit, number, frequency, law = _collect(spec, law, top)
        if best is None or merit > 1.02 * best[0]:
            best = merit, number, frequency, law
    assert best is not None  # noqa: S101
    return best


def _collect(spec: Spectrum, law: FrequencyLaw, top: float) -> _Found:
    """Collect partials from the bottom up, refitting the law before each further reach; merit comes first."""
    merit, number, frequency = 0.0, np.array([], int), np.array([])
    for last in _REACH:
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
    """Choose a peak for each partial: high, and within a fifth of the spacing of where the last ones lead."""
    number, frequency, total = [], [], 0.0
    spacing = law(k + 1) - law(k)
    sure: list[tuple[int, float]] = []  # partial, and how far it lies from the law, cents
    for n, straight, reach in zip(k, law(k), np.maximum(0.2 * spacing, spec.step), strict=True):
        f = straight * float(np.exp(_course(sure, n) / CENTS))
        low, high = np.searchsorted(spec.peak, [f - reach, f + reach])
        if low == high:
            continue
        merit = spec.height[low:high] - 40.0 * ((spec.peak[low:high] - f) / reach) ** 2
        best = int(np.argmax(merit))
        if merit[best] > SEEN:
            number.append(n)
            frequency.append(spec.peak[low + best])
            total += float(merit[best])
            if spec.height[low + best] > _SURE:
                sure.append((int(n), CENTS * float(np.log(frequency[-1] / straight))))
    return total, np.array(number, int), np.array(frequency)


def _course(sure: list[tuple[int, float]], n: int) -> float:
    """How far partial `n` should lie from the law, cents, by those found below it."""
    known, away = np.array(sure).reshape(-1, 2).T
    return float(local_deviation(known, away, np.array([n]))[0])
