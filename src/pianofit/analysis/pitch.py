"""Pitch: the comb of a stiff string is matched to the peaks of a spectrum.

A comb k f0 √(1 + B k²) is good if its teeth lie at peaks *and* the peaks lie at teeth. The first criterion alone would
select twice the pitch, the second alone half of it. The score is their product.
"""

from numbers import Real

import numpy as np

from ..errors import AnalysisError, WrongNoteError, check_type
from .inharmonicity import B_RANGE, law_frequency
from .note_names import hz_to_note, note_to_hz
from .spectrum import Spectrum, highest_partial, spectrum

LOWEST, HIGHEST = 25.0, 4500.0  # Hz, A0 to C8 with room for tuning
_TEETH = np.arange(1, 17)  # numbers of the partials of a comb
_FULL_EVIDENCE = 30.0  # dB above the floor, above which the evidence of a peak does not grow
_TOLERANCE = 0.04  # spacings of a comb's teeth, within which a peak belongs to a tooth
LEAST_PERIODS = 10  # in a recording: its partials must be separate
CLEAR = 10.0  # dB above the floor, of a peak that is hardly noise
_FAINT = 0.05  # score of a given note, below which it is too faint
_RIVAL = 1.4  # factor by which the score of another pitch must be larger to reject a given note


def typical_B(f0: np.ndarray | float) -> np.ndarray:
    """Inharmonicity of a typical piano string at `f0` Hz: smallest near 100 Hz, increasing towards both ends.

    A smooth curve through textbook figures (Fletcher and Rossing, The Physics of Musical Instruments, 12.3), within
    a factor of three. It only starts searches.
    """
    octave = np.log2(np.asarray(f0, float) / 100.0)
    return 1.5e-4 * np.where(octave < 0, 2.0 ** (-0.6 * octave), 2.0 ** (1.2 * octave))


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
    weight = (comb < top) / np.sqrt(_TEETH)
    return np.sum(weight * value, 1) / np.maximum(np.sum(weight, 1), 1e-9)


def _explained(comb: np.ndarray, spec: Spectrum, top: float) -> float:
    """Match of peaks to teeth: weighted share of the peaks below the last tooth that lie near a tooth.

    The weight of a peak is its strength above 50 dB below the strongest peak, reduced near the floor, so that rumble
    and noise do not dominate.
    """
    below = spec.peak < min(top, comb[-1] + comb[0] / 2)
    weight = np.maximum(spec.strength[below] - (np.max(spec.strength) - 50.0), 0.0)
    weight = weight * np.minimum(spec.height[below] / _FULL_EVIDENCE, 1.0)
    near = np.min(np.abs(spec.peak[below][:, None] - comb), axis=1, initial=np.inf) < _TOLERANCE * comb[0]
    return float(np.sum(weight * near) / max(np.sum(weight), 1e-9))


def _candidates(spec: Spectrum, low: float, high: float, top: float) -> np.ndarray:
    """The best f0 in `low`..`high` by the match of teeth with a wide tolerance: a few in every half octave."""
    f0 = low * 2.0 ** (np.arange(0, np.log2(high / low) * 1200 + 1, 6) / 1200)
    score = np.zeros(len(f0))
    for factor in 2.0 ** np.arange(-2, 3.1, 0.5):
        comb = law_frequency(f0[:, None], (factor * typical_B(f0))[:, None], _TEETH)
        score = np.maximum(score, _comb_score(comb, spec, 0.08 * f0[:, None], top))
    is_maximum = np.concatenate([[True], score[1:] > score[:-1]]) & np.concatenate([score[:-1] >= score[1:], [True]])
    group = np.round(2 * np.log2(f0 / low)).astype(int)
    peaks = [np.flatnonzero(is_maximum & (group == g)) for g in np.unique(group)]
    return f0[np.concatenate([own[np.argsort(score[own])[::-1][:6]] for own in peaks])]


def _best(spec: Spectrum, low: float, high: float, top: float) -> tuple[float, float, float]:
    """Best comb with f0 in `low`..`high`: (score, f0, B)."""
    best = (0.0, low, float(typical_B(low)))
    if len(spec.peak) < 2:
        return best
    for rough in _candidates(spec, low, high, top):
        near = rough * (1 + np.linspace(-0.012, 0.012, 17)), typical_B(rough) * 2.0 ** np.arange(-3, 3.1, 0.3)
        f0, B = (x.ravel() for x in np.meshgrid(*near, indexing="ij"))
        comb = law_frequency(f0[:, None], np.clip(B, *B_RANGE)[:, None], _TEETH)
        scores = _comb_score(comb, spec, 0.03 * rough, top)
        i = int(np.argmax(scores))
        score = float(scores[i]) * _explained(comb[i], spec, top)
        if score > best[0]:
            best = (score, float(f0[i]), float(B[i]))
    return best


def _evident(spec: Spectrum, f0: float, B: float, top: float) -> bool:
    """True if at least one in three teeth of a comb is a peak above the noise; a single peak can be any sound."""
    comb = law_frequency(f0, B, _TEETH)
    comb = comb[comb < top]
    clear = spec.peak[spec.height > CLEAR]
    matched = np.abs(comb[:, None] - clear).min(axis=1, initial=np.inf) < _TOLERANCE * f0
    return int(matched.sum()) >= max(2, len(comb) / 3)


def check_pitch(frequency: float, name: str) -> None:
    """Raise an `AnalysisError` about `name` if `frequency` (Hz) is outside the range of a piano."""
    if not LOWEST * 0.9 <= frequency <= HIGHEST * 1.1:
        raise AnalysisError(f"{name} is outside the range of a piano; give one from {LOWEST:g} to {HIGHEST:g} Hz")


def check_length(seconds: float, f0: float) -> None:
    """Raise an `AnalysisError` if the sound after the onset is shorter than `LEAST_PERIODS` of f0, Hz."""
    if seconds * f0 < LEAST_PERIODS:
        raise AnalysisError(
            f"{seconds:.2f} s after the onset is too short for a note of {f0:.1f} Hz; "
            f"give {LEAST_PERIODS / f0:.2f} s or more"
        )


def find_pitch(
    samples: np.ndarray, rate: int, *, note: str | int | None = None, f0: float | None = None
) -> tuple[float, float]:
    """Rough f0 (Hz) and B of the note that begins with `samples`.

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
    spec, top = spectrum(samples, rate, 0.5), highest_partial(rate)
    free = _best(spec, LOWEST, HIGHEST, top)
    if requested is None:
        strongest = spec.peak[[np.argmax(spec.strength)]] if len(spec.peak) else spec.peak
        strongest_fits = (np.abs(strongest - free[1]) < _TOLERANCE * free[1]).any()
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
