"""Prediction of a recording that took no part in the fit.

Only hammer velocity, gain and pitch are fitted to it. The residual of its partial levels is the prediction error.
"""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..analysis import SAME_KEY_CENTS, Analysis, analyse, cents_above, hz_to_note, law_frequency
from ..criterion import level_error_db
from ..dsp.knock_band import centre
from ..errors import AnalysisError, FitError, ParameterError, WrongNoteError, check_range, check_type
from ..excitation import StrokeParameter
from ..felt import law_of
from ..inference.observation_tables import pitch_above
from ..inference.priors import KNOCK_SD, LEVEL, log_gain
from ..io.files import printable, short_repr
from ..io.number_format import LARGEST, counted, is_number
from ..model.note import Note
from ..model.output_path import SAME_PARTIAL_TOLERANCE
from ..recording.recording import Recording, Source, to_recording
from ..threads import numerical_settings
from .comparison import audible_partials

# Velocities are searched within this range, m/s,
SLOWEST, FASTEST = 0.05, 12.0
# on a grid of this size, 1.4 % apart, before the best is refined. A force that lasts several periods of a partial has a
# spectrum of lobes, so treble levels rise and fall dozens of times over the range.
GRID_SIZE = 384
# A velocity within this ratio of an end of the range counts as at the limit.
LIMIT_RATIO = 1.001
FEWEST_PARTIALS = 3
# Objective at a velocity whose contact does not end.
ENDLESS_CONTACT_COST = 1e6


@dataclass(frozen=True, eq=False)
class Prediction:
    """Prediction of one recording by a fit."""

    stroke_value: float  # hammer velocity, m/s, or plucking position, m
    gain_db: float  # relative to the gain of the fit
    pitch_offset_cents: float  # relative to the pitch of the fit
    error_db: float  # rms over partials, one gain removed
    partials: int
    level: np.ndarray  # dB, predicted, with velocity discrepancy [partials]
    note: Note  # of the best minimum, without velocity discrepancy
    at_search_limit: bool = False  # if True, the value of the stroke could not be determined

    @property
    def stroke(self) -> StrokeParameter:
        """The parameter of the stroke."""
        return law_of(self.note.hammer).stroke

    @property
    def velocity(self) -> float:
        """The hammer velocity, m/s.

        Raises
        ------
        ParameterError
            If the string is not struck by a hammer.
        """
        if self.stroke.name != "v_H0":
            raise ParameterError(f"velocity: the string has no hammer; use stroke_value, its {self.stroke.name}")
        return self.stroke_value

    def __repr__(self) -> str:
        limit = ", at the limit of the searched range" if self.at_search_limit else ""
        return (
            f"Prediction({self.error_db:.2f} dB over {counted(self.partials, 'partial')} at {self.stroke.name} "
            f"= {self.stroke_value:.3g} {self.stroke.unit}"
            f"{limit}, {self.pitch_offset_cents:+z.2f} cents and {self.gain_db:+z.1f} dB from the fit)"
        )


@numerical_settings()
def predict_recording(
    notes: Note | Sequence[tuple[float, Note]],
    analysis: Analysis | Source,
    *,
    gains: Sequence[float] | None = None,
) -> Prediction:
    """Predict a recording by notes, at the velocity that explains its partial levels best.

    A fit predicts with `Result.predict`.

    Parameters
    ----------
    notes : one note, or pairs of posterior weight and note, such as `Result.mixture`. Each note has its own best
        velocity. The predicted levels, dB, are the weighted mean over the notes. Note, velocity and pitch are those of
        the first.
    analysis : analysis of the recording, see `analyse`, or the recording in any form that `fit` takes.
    gains : gains of the recordings that were fitted through the same output path, dB relative to that of the note. If
        they agree, the loudness of the recording helps to determine the velocity.

    Returns
    -------
    A `Prediction`: velocity in m/s, predicted levels [partials] and their rms error in dB.

    Raises
    ------
    FitError
        If too few partials are above the noise, or no velocity gives a finite sound.
    RecordingError, AnalysisError
        If the recording cannot be used, is too short, or is of another key.

    Examples
    --------
    >>> import pianofit
    >>> it = pianofit.typical(53)
    >>> note = pianofit.Note(it.string, it.hammer, it.geometry, "bridge-force", gain=0.01)
    >>> recording = pianofit.recording_from_samples(note.render(3.0, seconds=2.0), 44_100)
    >>> prediction = pianofit.predict_recording(note, recording)
    >>> f"{prediction.velocity:.1f} m/s, {prediction.error_db:.1f} dB"
    '3.0 m/s, 0.0 dB'
    """
    mixture = [(1.0, notes)] if isinstance(notes, Note) else _mixture(notes)
    if not mixture:
        raise ParameterError("notes=[] is empty; give a note, or notes with their weights")
    gains, (_, first) = _checked(gains), mixture[0]
    analysis = _same_key_analysis(analysis, first)
    p = analysis.partials
    chosen = audible_partials(p.frequency, p.level) & _detected(first, p.number)
    if chosen.sum() < FEWEST_PARTIALS:
        detected = counted(int(chosen.sum()), "partial")
        raise FitError(
            f"only {detected} of the fit above the noise, but {FEWEST_PARTIALS} are needed; give a cleaner recording"
        )
    fitted = [(weight, *_fit_velocity(note, analysis, chosen, gains)) for weight, note in mixture]
    total = sum(weight for weight, *_ in fitted)
    level = np.sum([weight / total * (levels + gain) for weight, _, levels, gain in fitted], axis=0)
    _, velocity, _, gain = fitted[0]
    B = float(first.B)
    cents = pitch_above(p, p.number, law_frequency(float(first.f0), B, p.number), 0.0, B)
    note = first.with_cents(cents).with_stroke(velocity)._replace(gain=first.gain * 10 ** (gain / 20))
    error = level_error_db(level[chosen], p.level[chosen])
    low, *_, high = scanned_values(first)
    at_limit = not low * LIMIT_RATIO < velocity < high / LIMIT_RATIO
    return Prediction(velocity, gain, cents, error, int(chosen.sum()), level, note, at_limit)


def _checked(gains: Any) -> Sequence[float]:
    """Return the gains of other recordings, dB; 0 if there are none."""
    levels = [0.0] if gains is None or (isinstance(gains, Sequence | np.ndarray) and len(gains) == 0) else gains
    if isinstance(levels, str) or not all(map(is_number, np.ravel(np.asarray(levels, object)))):
        raise ParameterError(f"gains={short_repr(gains)} must be numbers in dB")
    return [float(level) for level in np.ravel(levels)]


def _mixture(notes: Sequence[tuple[float, Note]]) -> list[tuple[float, Note]]:
    expected = "a note, or a list of (weight, note)"
    check_type("notes=", notes, list | tuple, expected)
    for pair in notes:
        check_type("notes: ", pair, tuple | list, expected)
        if len(pair) != 2 or not isinstance(pair[1], Note):
            raise ParameterError(f"notes: {short_repr(pair)} must be (weight, note)")
        check_range("notes: the weight ", pair[0], 0.0, LARGEST)
    if notes and not any(weight for weight, _ in notes):
        raise ParameterError("notes: all weights are 0; give a weight above 0")
    return [*notes]


def _same_key_analysis(source: Analysis | Source, note: Note) -> Analysis:
    """The analysis of a recording of the note's key; the error for another key names it."""
    name, detected = "analysis", ""
    if isinstance(source, Analysis):
        analysis = source
    else:
        recording = to_recording(source)
        name, analysis = printable(recording.path), _analyse_near(recording, note.f0)
    if analysis is not None:
        if abs(cents_above(analysis.f0, note.f0)) <= SAME_KEY_CENTS:
            return analysis
        detected = f", but {hz_to_note(analysis.f0)} ({analysis.f0:.1f} Hz)"
    raise WrongNoteError(
        f"{name}: the key is not that of the fit, {hz_to_note(note.f0)} ({note.f0:.1f} Hz){detected}; give a "
        "recording of the same key"
    )


def _analyse_near(recording: Recording, f0: float) -> Analysis | None:
    """The analysis at pitch `f0`, Hz, or else at the detected pitch; None if no pitch is detected."""
    try:
        return analyse(recording, f0=f0)
    except WrongNoteError:
        with suppress(AnalysisError):
            return analyse(recording)
    return None


def _fit_velocity(
    note: Note, analysis: Analysis, chosen: np.ndarray, gains: Sequence[float]
) -> tuple[float, np.ndarray, float]:
    """The most probable velocity, m/s, the levels of the note, dB [partials], and their gain, dB.

    The priors matter for few partials: three can agree with a velocity that no pianist plays.
    """
    p, law = analysis.partials, law_of(note.hammer)
    median, sd = law.stroke.prior(note.geometry)
    fitted_knock = note.path is not None and note.path.has(centre(float(note.f0)))
    measured_knock = analysis.knock if fitted_knock and np.isfinite(analysis.knock) else None
    precision = np.full(chosen.sum(), LEVEL.median[0] ** -2)
    precision = np.append(precision, 0.0 if measured_knock is None else 1 / (KNOCK_SD**2 + analysis.knock_error**2))

    def cost(log_velocity: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Negative log posterior (infinite if a contact does not end), levels [velocities, partials], gains, dB."""
        velocity = np.exp(log_velocity)
        level, knock = note.levels_of_strokes(velocity, int(p.number.max()))
        level = level[:, p.number - 1]
        if note.path is not None:
            level = level + note.path.velocity_discrepancy_db(_frequency(note, p.number), velocity)
        finite = np.isfinite(level.sum(axis=1))
        residual = np.column_stack([(p.level - level)[:, chosen], (measured_knock or 0.0) - knock])
        residual = np.where(finite[:, None], residual, 0.0)
        gain = residual @ precision / precision.sum()
        misfit = 0.5 * (residual - gain[:, None]) ** 2 @ precision
        prior = 0.5 * ((log_velocity - np.log(median)) / sd) ** 2
        of_gain = np.array([log_gain(x, gains, law.gain_deviations) for x in gain])
        return np.where(finite, misfit + prior - of_gain, np.inf), level, gain

    grid = np.log(scanned_values(note))
    value = cost(grid)[0]
    grid, value = grid[np.isfinite(value)], value[np.isfinite(value)]
    if not len(grid):
        raise FitError("no stroke gives a finite sound; check that the fit is of the same key")
    best = int(np.argmin(value))
    bracket = grid[[max(best - 1, 0), min(best + 1, len(grid) - 1)]]
    from scipy.optimize import fminbound  # only predictions need it

    log_velocity: Any = fminbound(lambda x: min(cost(np.array([x]))[0][0], ENDLESS_CONTACT_COST), *bracket, xtol=1e-4)
    _, (level,), (gain,) = cost(np.array([log_velocity]))
    return float(np.exp(log_velocity)), level, float(gain)


def scanned_values(note: Note) -> np.ndarray:
    """Values of the stroke's parameter that a prediction compares, ascending."""
    law = law_of(note.hammer)
    if law.has_contact:
        return np.geomspace(SLOWEST, FASTEST, GRID_SIZE)
    low, high = law.stroke.bounds(note.geometry)
    return np.linspace(low, high, GRID_SIZE)


def _detected(note: Note, number: np.ndarray) -> np.ndarray:
    """True for partials that the fit observed [partials]; the output path is unknown at the others."""
    if note.path is None:
        return np.ones(len(number), bool)
    return np.abs(np.log(_frequency(note, number)[:, None] / note.path.frequency)).min(axis=1) < SAME_PARTIAL_TOLERANCE


def _frequency(note: Note, number: np.ndarray) -> np.ndarray:
    """Partial frequencies of the string model, Hz. Measured ones deviate from them, high ones most."""
    return note.frequencies(int(number.max()))[number - 1]
