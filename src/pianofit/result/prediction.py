"""What a fitted note sounds like at a velocity that it was not fitted to.

Of a recording that took no part in the fit only the hammer's velocity, the gain and the pitch are free. What is left of
its partials' levels is the error of the prediction.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from numbers import Real
from typing import Any

import numpy as np
from scipy.optimize import fminbound

from ..analysis import SAME_KEY, Analysis, analyse, cents_above, hz_to_note
from ..criterion import level_error_db
from ..errors import AnalysisError, FitError, ParameterError, WrongNoteError, check_type
from ..inference.priors import LEVEL, VELOCITY, VELOCITY_SPREAD, log_gain
from ..io.files import printable, short_repr
from ..io.number_format import counted
from ..model.note import SLOWEST, Note
from ..model.output_path import SAME_PARTIAL
from ..recording.recording import Recording, Source, to_recording
from ..threads import one_blas_thread
from .comparison import audible_partials
from .result import Result

__all__ = ["Prediction", "predict_recording"]

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
    velocity_at_search_limit: bool = (
        False  # whether the velocity is an end of the range that was searched, and no finding
    )

    def __repr__(self) -> str:
        end = ", an end of the range searched" if self.velocity_at_search_limit else ""
        return (
            f"Prediction({self.error_db:.2f} dB over {counted(self.partials, 'partial')} at {self.velocity:.3g} m/s"
            f"{end}, {self.cents:+.2f} cents and {self.gain_db:+.1f} dB from the fit)"
        )


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
    mixture = [(1.0, notes)] if isinstance(notes, Note) else _mixture(notes)
    if not mixture:
        raise ParameterError("notes=[] holds no note; give a fit, a note, or notes with their shares")
    gains, (_, first) = gains or (0.0,), mixture[0]
    analysis = _of_the_key(analysis, first)
    p = analysis.partials
    chosen = audible_partials(p.frequency, p.level) & _detected(first, p.number)
    if chosen.sum() < FEWEST:
        raise FitError(f"only {counted(int(chosen.sum()), 'partial')} of the fit above the noise; {FEWEST} are needed")
    played = [(share, *_at_best(note, analysis, chosen, gains)) for share, note in mixture]
    total = sum(share for share, *_ in played)
    level = np.sum([share / total * (one + gain) for share, _, one, gain in played], axis=0)
    _, velocity, _, gain = played[0]
    cents = cents_above(analysis.f0, first.f0)
    note = first.with_cents(cents).with_velocity(velocity)._replace(gain=first.gain * 10 ** (gain / 20))
    found = level_error_db(level[chosen], p.level[chosen])
    at_end = not SLOWEST * SAME < velocity < FASTEST / SAME
    return Prediction(velocity, gain, cents, found, int(chosen.sum()), level, note, at_end)


def _mixture(notes: Sequence[tuple[float, Note]]) -> list[tuple[float, Note]]:
    must = "a fit, a note, or a list of (share, note)"
    check_type("notes=", notes, list | tuple, must)
    for pair in notes:
        check_type("notes: ", pair, tuple | list, must)
        if len(pair) != 2 or not isinstance(pair[1], Note):
            raise ParameterError(f"notes: {short_repr(pair)} must be (share, note)")
        check_type("notes: the share ", pair[0], Real, "a number")
    return [*notes]


def _of_the_key(source: Analysis | Source, note: Note) -> Analysis:
    """The analysis of a recording; if it is of another key than the note, the error names that key."""
    name, like = "analysis", ""
    if isinstance(source, Analysis):
        found = source
    else:
        recording = to_recording(source)
        name, found = printable(recording.path), _analysed(recording, note.f0)
    if found is not None:
        if abs(cents_above(found.f0, note.f0)) <= SAME_KEY:
            return found
        like = f", and sounds like {hz_to_note(found.f0)} ({found.f0:.1f} Hz)"
    raise WrongNoteError(
        f"{name}: is not of the fit's key, {hz_to_note(note.f0)} ({note.f0:.1f} Hz){like}; give a recording of the "
        "same key"
    )


def _analysed(recording: Recording, f0: float) -> Analysis | None:
    """The analysis at the pitch `f0`, Hz, or else at the recording's own; None if it has none."""
    try:
        return analyse(recording, f0=f0)
    except WrongNoteError:
        with suppress(AnalysisError):
            return analyse(recording)
    return None


def _at_best(
    note: Note, analysis: Analysis, chosen: np.ndarray, gains: Sequence[float]
) -> tuple[float, np.ndarray, float]:
    """The most probable velocity by levels and priors, m/s, the note's levels, dB [partials], and their gain.

    Many partials leave priors no say; three can suit a velocity that nobody plays.
    """
    p = analysis.partials

    def cost(log_velocity: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Minus the log posterior, levels [velocities, partials], gains, dB; infinite where a contact does not end."""
        velocity = np.exp(log_velocity)
        level = note.levels(velocity, int(p.number.max()))[:, p.number - 1]
        if note.path is not None:
            level = level + note.path.velocity_discrepancy_db(_frequency(note, p.number), velocity)
        ends = np.isfinite(level.sum(axis=1))
        residual = np.where(ends[:, None], p.level - level, 0.0)[:, chosen]
        gain = residual.mean(axis=1)
        value = 0.5 * ((residual - gain[:, None]) ** 2).sum(axis=1) / LEVEL.median[0] ** 2
        belief = 0.5 * ((log_velocity - np.log(VELOCITY)) / VELOCITY_SPREAD) ** 2
        return np.where(ends, value + belief - np.array([log_gain(x, gains) for x in gain]), np.inf), level, gain

    tried = np.log(np.geomspace(SLOWEST, FASTEST, TRIED))
    value = cost(tried)[0]
    tried, value = tried[np.isfinite(value)], value[np.isfinite(value)]
    if not len(tried):
        raise FitError("no velocity gives a finite sound; is this the fit of the same key?")
    best = int(np.argmin(value))
    around = tried[[max(best - 1, 0), min(best + 1, len(tried) - 1)]]
    found: Any = fminbound(lambda x: min(cost(np.array([x]))[0][0], WORST), *around, xtol=1e-4)
    _, (level,), (gain,) = cost(np.array([found]))
    return float(np.exp(found)), level, float(gain)


def _detected(note: Note, number: np.ndarray) -> np.ndarray:
    """Which partials the fit heard [partials]: of the others nobody knows how loud the path lets them through."""
    if note.path is None:
        return np.ones(len(number), bool)
    return np.abs(np.log(_frequency(note, number)[:, None] / note.path.frequency)).min(axis=1) < SAME_PARTIAL


def _frequency(note: Note, number: np.ndarray) -> np.ndarray:
    """Where the note's string has partials, Hz; real ones lie beside it, the higher the further."""
    return note.frequencies(int(number.max()))[number - 1]
