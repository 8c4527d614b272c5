"""From a recording to the table of partials and the two laws of its string."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..conversions import BEAT
from ..errors import AnalysisError, WrongNoteError, check_type
from ..recording.recording import Recording, Source, to_recording
from .analysis_result import Analysis, Partials
from .baseband_fit import first_fits, has_drifted
from .demodulation import demodulate
from .glide import LEAST, PitchGlide, glide_detected, glide_windows, remove_glide
from .inharmonicity import B_RANGE, CENTS, DecayLaw, FrequencyLaw, decay_law, frequency_law, local_deviation
from .level import bounds
from .note_names import cents_above, hz_to_note, midi_to_note, note_to_hz, note_to_midi
from .partials import LEAST_SNR, PartialTable, decay_law_covariance, measure_partials, systematic
from .pitch import find_pitch, track
from .second_strike import detect_second_strike
from .spectrum import noise_between, spectrum

__all__ = ["analyse", "beating_warning", "check_analyses", "count_beating"]

_SKIP = 0.005  # s; the contact is over by then or all but
_LONGEST = 20.0  # s; what comes later adds nothing
_TOP = 12000.0  # Hz
_WIDEST = 100.0  # Hz; more bandwidth than this brings no more information about a slow partial
_WORST_LEVEL = 10.0  # dB; a level less sure than this is no level
_LEAST_DECAY = 1e-3  # 1/s; nothing decays more slowly
_OUTLIER = 6.0  # standard deviations from where its neighbours lead, beyond which a peak belongs to something else,
_OUTLIER_CENTS = 12.0  # and cents, whichever is more


def analyse(recording: Source, *, note: str | int | None = None, f0: float | None = None) -> Analysis:
    """Find and measure the partials of one struck note.

    Parameters
    ----------
    recording : a path, a `Recording`, or samples with their rate, as `fit` takes them.
    note : its name, such as "F#2", or MIDI number; the pitch is then sought within a semitone of it.
    f0 : the same, in Hz; goes before `note`.

    Returns
    -------
    An `Analysis`: f0 in Hz, B, b1 and d2 in 1/s with standard errors, and the table of `Partials` [partials].

    Raises
    ------
    RecordingError
        If the sound cannot be used.
    AnalysisError
        When the recording is too short, or enough of its partials are not there; a WrongNoteError when the note is not.

    Examples
    --------
    >>> import pianofit
    >>> it = pianofit.preset("chabassier-F3")
    >>> sound = pianofit.simulate(it.string, it.hammer, it.geometry, quantity="bridge-force").waveform(44_100, 88_200)
    >>> found = pianofit.analyse(pianofit.recording_from_samples(0.5 * sound / abs(sound).max(), 44_100), note="F3")
    >>> f"{found.f0:.1f} Hz, B = {found.B:.2g}, {len(found.partials)} partials"
    '175.0 Hz, B = 0.00017, 55 partials'
    """
    recording = to_recording(recording)
    rate = recording.rate
    samples = np.asarray(recording.samples, float)[recording.onset :][: int(_LONGEST * rate)]
    seconds = len(samples) / rate
    top = min(0.45 * rate, _TOP)
    try:
        rough_f0, rough_B = find_pitch(spectrum(samples, rate, 0.5), top=top, note=note, f0=f0)
    except AnalysisError as error:
        raise type(error)("; ".join((f"{recording.path}: {error}", *recording.warnings))) from None
    if seconds * rough_f0 < 10:
        raise AnalysisError(
            f"{recording.path}: {seconds:.2f} s after the onset is too short for a note of {rough_f0:.1f} Hz; "
            f"give {10 / rough_f0:.2f} s or more"
        )
    close = spectrum(samples, rate, float(np.clip(30 / rough_f0, 0.15, 1.0)))
    number, frequency, law = track(close, rough_f0, rough_B, top=top)
    _refuse(recording.path, number, law, note, f0)
    return _measure_all(recording, samples, number, frequency, law, note, top)


def check_analyses(analyses: Sequence[Analysis] | None) -> None:
    """Refuse by a `ParameterError` what are no analyses of recordings; None are those that were not given."""
    if analyses is not None:
        check_type("analyses=", analyses, list | tuple, "a list of what analyse returned")
        for analysis in analyses:
            check_type("analyses: ", analysis, Analysis, "what analyse returned")


def _refuse(path: str, number: np.ndarray, law: FrequencyLaw, note: str | int | None, f0: float | None) -> None:
    """Raise when there are no partials, or only every second or third of a pitch that was asked for."""
    if len(number) == 0:
        raise AnalysisError(f"{path}: no partial of {law.f0:.1f} Hz stands out of the noise; check the note")
    for multiple in (2, 3):
        if (note is not None or f0 is not None) and len(number) >= 4 and np.mean(number % multiple == 0) > 0.9:
            found = multiple * law.f0
            raise WrongNoteError(
                f"{path}: only every partial number {multiple} of {note or f0} is there, so it sounds like "
                f"{hz_to_note(found)} ({found:.1f} Hz); give that note (--note) or the frequency (--f0)"
            )


def _measure_all(
    recording: Recording,
    samples: np.ndarray,
    number: np.ndarray,
    frequency: np.ndarray,
    law: FrequencyLaw,
    note: str | int | None,
    top: float,
) -> Analysis:
    rate, seconds = recording.rate, len(samples) / recording.rate
    spacing = min(0.97 * law.f0, max(_WIDEST, 0.1 * law.f0))
    skip = min(_SKIP, 0.05 * seconds)
    bands = demodulate(samples, rate, frequency, spacing, skip)
    z, fit = first_fits(bands)
    expected = _expected_frequencies(law, number, frequency, np.arange(1, int(number.max()) + 6))
    density = noise_between(samples, rate, expected, frequency, law.f0, min(0.05, 0.1 * seconds))
    density = np.maximum(density, 1e-20 * float(np.max(np.abs(z))) ** 2)
    windows = glide_windows(bands, z, fit, density)
    glides = glide_detected(windows)
    # Where a fall is sure, one partial that lasts tells how it goes on; where not, it tells of its own beat.
    heard = windows if glides else [row for row in windows if np.isfinite(row[3])]
    fall = heard[0][2] - heard[-1][2] if len(heard) > 1 else 0.0
    taken, left = PitchGlide(0.0, 1.0), 0.0
    if glides:
        bands, z, fit, taken, left = remove_glide(bands, z, fit, density, windows)
    rows = measure_partials(number, bands, z, fit, density, glides)
    keep = _plausible(rows, _expected_frequencies(law, number, frequency, number), law.f0) & ~has_drifted(bands, fit)
    keep[keep] = _on_law(number[keep], rows.frequency[keep], rows.whole_error("frequency")[keep])
    if not keep.any():
        raise AnalysisError(f"{recording.path}: no partial of {law.f0:.1f} Hz stands out of the noise")
    if not keep.all():  # what is no partial tells nothing of its neighbours
        number, density = number[keep], density[keep]
        rows = measure_partials(number, bands.select(keep), z[keep], fit.kept(keep), density, glides)
    again = detect_second_strike(bands.select(keep), z[keep], density)
    fine, losses = _laws(number, rows, law.B)
    absent = _absent(number, fine, top)
    bound = bounds(
        samples, rate, _expected_frequencies(fine, number, rows.frequency, absent), losses(absent), fine.f0, skip
    )
    table = _table(number, rows, absent, bound)
    glide = tuple((a, b, fine.f0 * float(np.exp(c / CENTS))) for a, b, c, _ in windows)
    return Analysis(
        fine.f0,
        fine.f0_error,
        fine.B,
        fine.B_error,
        losses.b1,
        losses.b1_error,
        losses.d2,
        losses.d2_error,
        table,
        fine.scatter,
        losses.scatter,
        float(fall),
        glide,
        density,
        None if note is None else midi_to_note(note_to_midi(note)),
        (
            *_wrong_note_message(note, fine.f0),
            *_at_bound(fine),
            *_warnings(table, losses, float(fall) if glides else 0.0, again),
        ),
        left,
        *taken,
        (rows.level_law.b1, rows.level_law.d2),
    )


def _laws(number: np.ndarray, rows: PartialTable, B: float) -> tuple[FrequencyLaw, DecayLaw]:
    """The string's two laws; of a single partial with this `B`."""
    held = B if len(number) < 2 else None
    error = rows.whole_error("frequency")
    return (
        frequency_law(number, rows.frequency, error, B=held),
        decay_law(number, np.maximum(rows.decay, _LEAST_DECAY), rows.whole_error("decay")),
    )


def _expected_frequencies(law: FrequencyLaw, number: np.ndarray, frequency: np.ndarray, k: np.ndarray) -> np.ndarray:
    """Where partials `k` are to be expected, Hz: on the law, as far from it as those found nearby."""
    return law(k) * np.exp(local_deviation(number, CENTS * np.log(frequency / law(number)), k) / CENTS)


def _plausible(rows: PartialTable, expected: np.ndarray, f0: float) -> np.ndarray:
    """Tell which partials stand out of the noise and have numbers that mean something."""
    near = np.abs(rows.frequency - expected) < 0.25 * f0
    known = (rows.level_error < _WORST_LEVEL) & (rows.whole_error("frequency") < 0.1 * f0)
    return (rows.snr > LEAST_SNR) & near & known & (rows.decay < 300.0)


def _on_law(k: np.ndarray, frequency: np.ndarray, error: np.ndarray) -> np.ndarray:
    """Tell which partials keep to the law that most of them follow, or leave it with their neighbours."""
    if len(k) < 4:
        return np.ones(len(k), bool)
    law = frequency_law(k, frequency, error)
    away = CENTS * np.log(frequency / law(k))
    others = ~np.eye(len(k), dtype=bool)
    course = np.concatenate([local_deviation(k[o], away[o], k[[i]]) for i, o in enumerate(others)])
    away = np.abs(away - course)
    return away < np.maximum(_OUTLIER * np.hypot(law.deviation_sd(k), CENTS * error / frequency), _OUTLIER_CENTS)


def _absent(number: np.ndarray, law: FrequencyLaw, top: float) -> np.ndarray:
    """Numbers, not among `number`, of partials of the law below `top` Hz."""
    every = np.arange(1, max(int(number.max()), int(top / law.f0)) + 1)
    return np.setdiff1d(every[law(every) < top], number)


def _table(number: np.ndarray, rows: PartialTable, absent: np.ndarray, bound: np.ndarray) -> Partials:
    return Partials(
        number=number,
        frequency=rows.frequency,
        frequency_error=rows.frequency_error,
        frequency_systematic=systematic(number, rows.frequency_spread),
        decay=np.maximum(rows.decay, _LEAST_DECAY),
        decay_error=rows.decay_error,
        decay_systematic=systematic(number, rows.decay_spread),
        level=rows.level,
        level_error=rows.level_error,
        level_systematic=systematic(number, rows.level_spread)
        + decay_law_covariance(number, rows.level_lag, rows.level_law),
        level_decay_sensitivity_s=rows.level_lag,
        snr=rows.snr,
        beating=rows.beating,
        absent=absent,
        absent_bound=bound,
    )


def _wrong_note_message(note: str | int | None, f0: float) -> tuple[str, ...]:
    """What is said of a note that sounds nearer to another key than to the one whose name it was given."""
    cents = 0.0 if note is None else cents_above(f0, note_to_hz(note))
    if abs(cents) <= 50:
        return ()
    name, side = midi_to_note(note_to_midi(str(note))), "above" if cents > 0 else "below"
    return (
        f"the pitch lies {abs(cents):.0f} cents {side} {name}, nearer to {hz_to_note(f0)}: check the note's name, or "
        "how the instrument is tuned",
    )


def _at_bound(law: FrequencyLaw) -> tuple[str, ...]:
    """What is said of a B at either end of the range searched."""
    if not np.isfinite(law.B_error) or law.B not in B_RANGE:
        return ()
    if B_RANGE[0] == law.B:
        return (
            f"B is at its lower bound, {law.B:g}: the partials are harmonic, and a stiff string's are not; check that "
            "the sound is of one string, without effects",
        )
    return (f"B is at its upper bound, {law.B:g}: check the note (--note), and that the partials are of one string",)


def _warnings(table: Partials, losses: DecayLaw, fall: float, again: float | None) -> tuple[str, ...]:
    found = []
    if again is not None:
        found.append(
            f"most partials rise again about {again:.2f} s after the onset: a second stroke changes the results; give "
            "a file of one stroke"
        )
    if len(table) == 1:
        found.append("only one partial found: B is assumed, f0 rests on it, and the losses are hardly determined")
    elif len(table) == 2:
        found.append("only 2 partials found: B and the losses are hardly determined")
    if np.mean(table.decay <= _LEAST_DECAY) > 0.5:
        found.append(
            "most partials do not decay, so decay rates are the least that is looked for: a loop, a sound played "
            "backwards or a compressed one tells nothing of losses"
        )
    if abs(fall) > LEAST:
        found.append(f"the pitch {'falls' if fall > 0 else 'rises'} by {abs(fall):.1f} cents as the note decays")
    if beats := beating_warning(table):
        found.append(beats)
    if losses.d2 < 2 * losses.d2_error and len(table) > 1:
        found.append("the decay rates do not show how losses rise with frequency (d2 is not measurable)")
    return tuple(found)


def count_beating(table: Partials) -> int:
    """How many partials leave an even decay by more than `BEAT`."""
    return int(np.sum(table.beating > BEAT))


def beating_warning(table: Partials) -> str:
    """The warning of a recording whose partials beat; empty if none does."""
    deep = count_beating(table)
    if not deep:
        return ""
    return (
        f"{deep} of {len(table)} partials leave an even decay by more than {BEAT:g} dB: more than one string or "
        "polarisation, which beat, or a note that was damped or cut"
    )
