"""The honest test: what a fitted note sounds like at a velocity that it was not fitted to.

Of a recording that took no part in the fit only the hammer's velocity, the gain and the pitch are free. What is left of
its partials' levels is the error of the prediction. Beside it stand what needs no model: the nearest recorded layer in
its place, and the best blend, in decibels, of its two neighbours.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import fminbound

from ..analysis import Analysis, analyse
from ..criterion import level_error_db
from ..errors import FitError
from ..fit_file import gains_of
from ..model.note import SLOWEST, Note
from ..model.path import SAME_PARTIAL
from ..parameters import PARAMETERS, check_seed
from ..recording import Recording, Source
from ..setup import Setup
from ..threads import one_blas_thread
from . import Result
from .fit import fit_recordings
from .listener import scored
from .observations import string_law
from .priors import LEVEL, VELOCITY, VELOCITY_SPREAD, log_gain

__all__ = ["Prediction", "cross_validate", "predict_recording"]

# Velocities up to this, m/s, are tried; they begin at `SLOWEST`.
FASTEST = 12.0
# So many are, 1.4 % apart, before the best is refined: a force that lasts several periods of a partial has a spectrum
# of lobes, and levels in the treble rise and fall dozens of times between the slowest and the fastest.
TRIED = 384
# As a ratio: nearer to an end of their range than this is at the end.
SAME = 1.001
FEWEST = 3
# Of a velocity with a contact that does not end, beside others.
WORST = 1e6


@dataclass(frozen=True)
class Prediction:
    """A recording beside the same note as the fit would play it."""

    velocity: float  # m/s
    gain_db: float  # over the fit's own
    cents: float  # over the fit's own
    error_db: float  # rms over partials, one gain removed
    partials: int
    level: np.ndarray  # dB, predicted, with what strokes of like velocity leave [partials]
    note: Note  # of the first minimum, without that
    at_end: bool = False  # whether the velocity is an end of the range that was searched, and no finding


@one_blas_thread()
def predict_recording(
    notes: Result | Note | Sequence[tuple[float, Note]],
    analysis: Analysis | Source,
    *,
    gains: Sequence[float] | None = None,
) -> Prediction:
    """Play a fit at the velocity that suits a recording's levels best.

    Parameters
    ----------
    notes : a fit, one note, or those of several minima with their shares. Each is struck at the velocity that suits it;
        the prediction is the mean of their levels, dB, by their shares, and the note, velocity and pitch are the
        first's.
    analysis : of the recording, see `analyse`, or the recording in any form that `fit` takes.
    gains : of the recordings that were fitted through the same path, dB over the note's own: where they agree, how loud
        the recording is tells how hard the string was struck. A fit has its own (`Result.gains`); of notes alone none
        are known.

    Returns
    -------
    A `Prediction`: velocity in m/s, predicted levels [partials] and their rms error in dB.

    Raises
    ------
    FitError
        If too few partials stand above the noise, or no velocity gives a finite sound.
    RecordingError, AnalysisError
        If the recording cannot be used, is too short, or of another key.

    Examples
    --------
    >>> import pianofit
    >>> it = pianofit.typical(53)
    >>> note = pianofit.Note(it.string, it.hammer, it.geometry, "bridge-force", gain=0.01)
    >>> recording = pianofit.recording_from_samples(note.render(3.0, seconds=2.0), 44_100)
    >>> found = pianofit.predict_recording(note, recording)
    >>> f"{found.velocity:.1f} m/s, {found.error_db:.1f} dB"
    '3.0 m/s, 0.0 dB'
    """
    if isinstance(notes, Result):
        notes, gains = notes.mixture, notes.gains if gains is None else gains
    mixture = [(1.0, notes)] if isinstance(notes, Note) else list(notes)
    gains, (_, first) = gains or (0.0,), mixture[0]
    analysis = analysis if isinstance(analysis, Analysis) else analyse(analysis, f0=_pitch(first))
    p = analysis.partials
    chosen = scored(p.frequency, p.level) & _heard(first, p.number)
    if chosen.sum() < FEWEST:
        raise FitError(f"only {int(chosen.sum())} partials of the fit stand above the noise; {FEWEST} are needed")
    played = [(share, *_at_best(note, analysis, chosen, gains)) for share, note in mixture]
    total = sum(share for share, *_ in played)
    level = np.sum([share / total * (one + gain) for share, _, one, gain in played], axis=0)
    _, velocity, _, gain = played[0]
    cents = 1200 * float(np.log2(analysis.f0 / _pitch(first)))
    note = first.tuned(cents).struck(velocity)._replace(gain=first.gain * 10 ** (gain / 20))
    found = level_error_db(level[chosen], p.level[chosen])
    slowest, fastest = _range()
    at_end = not slowest * SAME < velocity < fastest / SAME
    return Prediction(velocity, gain, cents, found, int(chosen.sum()), level, note, at_end)


def _range() -> tuple[float, float]:
    """The slowest and the fastest hammer that are tried, m/s."""
    return max(SLOWEST, PARAMETERS["v_H0"].lower), min(FASTEST, PARAMETERS["v_H0"].upper)


def _at_best(
    note: Note, analysis: Analysis, chosen: np.ndarray, gains: Sequence[float]
) -> tuple[float, np.ndarray, float]:
    """The most probable velocity by levels and priors, m/s, the note's levels, dB [partials], and their gain.

    Many partials leave priors no say; three can suit a velocity that nobody plays.
    """
    p = analysis.partials

    def levels(velocity: np.ndarray) -> np.ndarray:
        """Of the recording's partials [velocities, partials]."""
        level = note.levels(velocity, int(p.number.max()))[:, p.number - 1]
        return level if note.path is None else level + note.path.wandering(_frequency(note, p.number), velocity)

    def cost(log_velocity: np.ndarray, level: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Minus the log posterior, and the gain, dB [velocities]."""
        residual = (p.level - level)[:, chosen]
        gain = residual.mean(axis=1)
        value = 0.5 * ((residual - gain[:, None]) ** 2).sum(axis=1) / LEVEL.median[0] ** 2
        belief = 0.5 * ((log_velocity - np.log(VELOCITY)) / VELOCITY_SPREAD) ** 2
        return value + belief - np.array([log_gain(x, gains) for x in gain]), gain

    tried = np.log(np.geomspace(*_range(), TRIED))
    level = levels(np.exp(tried))
    ends = np.isfinite(level).all(axis=1)
    if not ends.any():
        raise FitError("no velocity gives a finite sound; is this the fit of the same key?")
    tried, level = tried[ends], level[ends]
    best = int(np.argmin(cost(tried, level)[0]))

    def at(log_velocity: float) -> tuple[float, np.ndarray, float]:
        level = levels(np.exp([log_velocity]))
        if not np.isfinite(level).all():
            return WORST, level[0], 0.0
        value, gain = cost(np.array([log_velocity]), level)
        return float(value[0]), level[0], float(gain[0])

    around = tried[[max(best - 1, 0), min(best + 1, len(tried) - 1)]]
    found: Any = fminbound(lambda x: at(x)[0], *around, xtol=1e-4)
    return float(np.exp(found)), *at(found)[1:]


def _heard(note: Note, number: np.ndarray) -> np.ndarray:
    """Which partials the fit heard [partials]: of the others nobody knows how loud the path lets them through."""
    if note.path is None:
        return np.ones(len(number), bool)
    return np.abs(np.log(_frequency(note, number)[:, None] / note.path.frequency)).min(axis=1) < SAME_PARTIAL


def _frequency(note: Note, number: np.ndarray) -> np.ndarray:
    """Where the note's string has partials, Hz; real ones lie beside it, the higher the further."""
    return string_law(np.log(np.array(note.string)), number, note.geometry.length)[0][0]


def _pitch(note: Note) -> float:
    return note.string.c / (2 * note.geometry.length)


def cross_validate(
    recordings: Sequence[Recording],
    analyses: Sequence[Analysis],
    setup: Setup,
    *,
    seed: int = 0,
    progress: Callable[[str, float], None] = lambda *_: None,
) -> tuple[dict, Result]:
    """Leave out each hammer stroke in turn, fit the others, and predict it at every microphone.

    A stroke's other recordings share its velocity, so they are left out with it. Neighbours are of the same group: how
    loud another microphone hears each partial says nothing of this one.

    Parameters
    ----------
    recordings, analyses : three or more of one key, each with its analysis, see `load_recording` and `analyse`.
    setup : what was known beforehand.
    seed : of the searches.
    progress : called with what is being fitted, and the fraction done.

    Returns
    -------
    `recordings`, in order of velocity, each with `file`, `v_H0` (in the fit of all), `predicted_v_H0`, `predicted_db`
    and `partials` (None where no other recording shares the path), `nearest_db` (None without a neighbour), `blend_db`
    (None at a group's ends) and `inner`; `median_inner_db` and `worst_inner_db` (None without an inner recording);
    `messages`. With it the fit of all recordings.

    Raises
    ------
    FitError
        For fewer than three strokes, and as `fit` does.

    Examples
    --------
    >>> recordings = [pianofit.load_recording(name) for name in ("soft.wav", "mezzo.wav", "loud.wav")]
    >>> analyses = [pianofit.analyse(recording, note="F#2") for recording in recordings]
    >>> found, result = pianofit.cross_validate(recordings, analyses, pianofit.Setup())  # four fits
    >>> found["median_inner_db"]
    """
    check_seed(seed)
    count = len(recordings)
    if count < 3:
        few = "1 recording is" if count == 1 else f"{count} recordings are"
        raise FitError(f"{few} too few to leave one out; give three or more")
    whole = fit_recordings(recordings, analyses, setup, seed=seed)
    heard = whole.document["recordings"]
    strokes = list(dict.fromkeys(row["stroke"] for row in heard))
    if len(strokes) < 3:
        raise FitError(
            f"{count} recordings of {len(strokes)} stroke{'s' * (len(strokes) > 1)} are too few to leave one stroke "
            "out; give three or more"
        )
    predicted: dict[int, Prediction | None] = {}
    for place, stroke in enumerate(strokes):
        progress(f"without stroke {place + 1} of {len(strokes)}", (place + 1) / (len(strokes) + 1))
        rest = [j for j in range(count) if heard[j]["stroke"] != stroke]
        fit = fit_recordings([recordings[j] for j in rest], [analyses[j] for j in rest], setup, seed=seed)
        for i in (j for j in range(count) if heard[j]["stroke"] == stroke):
            predicted[i] = _predicted(fit, whole, rest, i, analyses[i])
    order = sorted(range(count), key=lambda i: heard[i]["v_H0"])
    rows = [_row(i, predicted[i], _around(i, order, heard), heard, analyses) for i in order]
    inner = [row["predicted_db"] for row in rows if row["inner"]]
    found = {
        "recordings": rows,
        "median_inner_db": float(np.median(inner)) if inner else None,
        "worst_inner_db": float(max(inner)) if inner else None,
        "messages": [
            f"{Path(row['file']).name} is not predicted: no other stroke was recorded through its path, which is "
            "therefore unknown."
            for row in rows
            if row["predicted_db"] is None
        ]
        + [
            f"{Path(recordings[i].path).name} is predicted at {p.velocity:.3g} m/s, an end of the range searched: its "
            "velocity is not found."
            for i, p in predicted.items()
            if p is not None and p.at_end
        ],
    }
    return found, whole


def _around(i: int, order: list[int], heard: list[dict]) -> list[int]:
    """The recordings of the same group next to this one in velocity: two, or one at the group's ends, or none."""
    group = [j for j in order if heard[j]["group"] == heard[i]["group"]]
    place = group.index(i)
    return group[max(place - 1, 0) : place] + group[place + 1 : place + 2]


def _row(i: int, found: Prediction | None, around: list[int], heard: list[dict], analyses: Sequence[Analysis]) -> dict:
    """What came of one recording that was left out."""
    return {
        "file": heard[i]["file"],
        "v_H0": heard[i]["v_H0"],
        "predicted_v_H0": found.velocity if found else None,
        "predicted_db": found.error_db if found else None,
        "partials": found.partials if found else None,
        "nearest_db": min((_apart(analyses[i], analyses[j]) for j in around), default=None),
        "blend_db": _blend(analyses[i], *(analyses[j] for j in around)) if len(around) == 2 else None,
        "inner": len(around) == 2,
    }


def _predicted(fit: Result, whole: Result, rest: list[int], left_out: int, analysis: Analysis) -> Prediction | None:
    """The recording left out by the minima's notes through its path; None if no other went through it."""
    rows = whole.document["recordings"]
    for place, j in enumerate(rest):
        if rows[j]["group"] == rows[left_out]["group"]:
            notes = [(share, notes[place]) for share, notes in zip(fit.shares, fit.notes, strict=True)]
            return predict_recording(notes, analysis, gains=gains_of(fit.document, place))
    return None


def _common(analysis: Analysis, others: Sequence[Analysis]) -> tuple[np.ndarray, list[np.ndarray]]:
    """Levels [partials] of those that are scored and stand above the noise in all."""
    p = analysis.partials
    number = p.number[scored(p.frequency, p.level)]
    for other in others:
        number = np.intersect1d(number, other.partials.number)
    level = [a.partials.level[np.searchsorted(a.partials.number, number)] for a in (analysis, *others)]
    return level[0], level[1:]


def _apart(analysis: Analysis, other: Analysis) -> float:
    """The error, dB, of one layer in another's place."""
    level, (instead,) = _common(analysis, [other])
    return level_error_db(instead, level)


def _blend(analysis: Analysis, below: Analysis, above: Analysis) -> float:
    """The error, dB, of the best blend of two neighbours, in decibels."""
    level, (low, high) = _common(analysis, [below, above])
    slope, miss = high - low - (high - low).mean(), level - low - (level - low).mean()
    share = np.clip((slope @ miss) / max(slope @ slope, 1e-300), 0.0, 1.0)
    return level_error_db(low + share * (high - low), level)
