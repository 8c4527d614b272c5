"""Measures one recording: the table of partials, and the frequency law and decay law of the string."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..conversions import BEATING_DB
from ..errors import AnalysisError, WrongNoteError, check_type
from ..recording.recording import Recording, Source, to_recording
from .analysis_result import Analysis, Partials
from .baseband_fit import first_fits, has_drifted
from .demodulation import demodulate
from .glide import LEAST_GLIDE, PitchGlide, glide_detected, glide_windows, remove_glide
from .inharmonicity import B_RANGE, CENTS, DecayLaw, FrequencyLaw, decay_law, frequency_law, local_deviation
from .level import absent_level_bounds
from .note_names import cents_above, hz_to_note, midi_to_note, note_to_hz, note_to_midi
from .partials import LEAST_SNR, PartialTable, decay_law_covariance, measure_partials, systematic
from .pitch import find_pitch, number_partials
from .second_stroke import detect_second_stroke
from .spectrum import noise_between, spectrum

__all__ = ["analyse", "beating_warning", "check_analyses", "count_beating"]

_SKIP = 0.005  # s after the onset; the contact has ended by then, or nearly
_LONGEST = 20.0  # s after the onset; later samples add no information
_TOP = 12000.0  # Hz, highest frequency searched for partials
_WIDEST = 100.0  # Hz; a larger bandwidth adds no information about a partial that decays slowly
_WORST_LEVEL = 10.0  # dB; a partial whose level has a larger error is rejected
_LEAST_DECAY = 1e-3  # 1/s, lower bound of reported decay rates
# A peak farther than both from the frequency that its neighbours predict is not a partial.
_OUTLIER = 6.0  # standard deviations
_OUTLIER_CENTS = 12.0


def analyse(recording: Source, *, note: str | int | None = None, f0: float | None = None) -> Analysis:
    """Detect and measure the partials of one struck note.

    Parameters
    ----------
    recording : a path, a `Recording`, or (samples, rate), as for `fit`.
    note : name, such as "F#2", or MIDI number. The pitch is searched within a semitone of it.
    f0 : the same in Hz. It takes precedence over `note`.

    Returns
    -------
    An `Analysis`: f0 in Hz, B, b1 and d2 in 1/s with standard errors, and the table of `Partials` [partials].

    Raises
    ------
    RecordingError
        If the recording cannot be used.
    AnalysisError
        If the recording is too short, or too few partials are detected. A `WrongNoteError` if it holds another note.

    Examples
    --------
    >>> import pianofit
    >>> p = pianofit.preset("chabassier-F3")
    >>> sound = pianofit.simulate(p.string, p.hammer, p.geometry, quantity="bridge-force").waveform(44_100, 88_200)
    >>> recording = pianofit.recording_from_samples(0.5 * sound / abs(sound).max(), 44_100)
    >>> analysis = pianofit.analyse(recording, note="F3")
    >>> f"{analysis.f0:.1f} Hz, B = {analysis.B:.2g}, {len(analysis.partials)} partials"
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
    resolved = spectrum(samples, rate, float(np.clip(30 / rough_f0, 0.15, 1.0)))
    number, frequency, law = number_partials(resolved, rough_f0, rough_B, top=top)
    _check_partials(recording.path, number, law, note, f0)
    return _measure_all(recording, samples, number, frequency, law, note, top)


def check_analyses(analyses: Sequence[Analysis] | None) -> None:
    """Raise a `ParameterError` unless all items are analyses; None means that none were given."""
    if analyses is not None:
        check_type("analyses=", analyses, list | tuple, "a list of what analyse returned")
        for analysis in analyses:
            check_type("analyses: ", analysis, Analysis, "what analyse returned")


def _check_partials(path: str, number: np.ndarray, law: FrequencyLaw, note: str | int | None, f0: float | None) -> None:
    """Raise if no partial was detected, or only every second or third partial of the given pitch."""
    if len(number) == 0:
        raise AnalysisError(f"{path}: no partial of {law.f0:.1f} Hz was detected above the noise; check the note")
    for multiple in (2, 3):
        if (note is not None or f0 is not None) and len(number) >= 4 and np.mean(number % multiple == 0) > 0.9:
            detected_f0 = multiple * law.f0
            raise WrongNoteError(
                f"{path}: only partials {multiple}, {2 * multiple} ... of {note or f0} were detected, so it sounds "
                f"like {hz_to_note(detected_f0)} ({detected_f0:.1f} Hz); give that note (--note) or frequency (--f0)"
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
    """Measure the partials `number` at `frequency` (Hz) [partials] near the rough `law`, and fit the laws."""
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
    # A single partial in a late window follows the glide only if a glide was detected. Otherwise it follows its beats.
    usable = windows if glides else [window for window in windows if np.isfinite(window[3])]
    glide_cents = float(usable[0][2] - usable[-1][2]) if len(usable) > 1 else 0.0
    removed, glide_error = PitchGlide(0.0, 1.0), 0.0
    if glides:
        bands, z, fit, removed, glide_error = remove_glide(bands, z, fit, density, windows)
    measured = measure_partials(number, bands, z, fit, density, glides)
    keep = _plausible(measured, _expected_frequencies(law, number, frequency, number), law.f0)
    keep &= ~has_drifted(bands, fit)
    keep[keep] = _near_law(number[keep], measured.frequency[keep], measured.total_error("frequency")[keep])
    if not keep.any():
        raise AnalysisError(f"{recording.path}: no partial of {law.f0:.1f} Hz was detected above the noise")
    if not keep.all():  # a rejected peak must not contribute to the errors of its neighbours
        number, density = number[keep], density[keep]
        measured = measure_partials(number, bands.select(keep), z[keep], fit.select(keep), density, glides)
    second_stroke_s = detect_second_stroke(bands.select(keep), z[keep], density)
    refined, losses = _laws(number, measured, law.B)
    absent = _absent(number, refined, top)
    absent_frequency = _expected_frequencies(refined, number, measured.frequency, absent)
    bound = absent_level_bounds(samples, rate, absent_frequency, losses(absent), refined.f0, skip)
    table = _table(number, measured, absent, bound)
    glide_table = tuple((a, b, refined.f0 * float(np.exp(c / CENTS))) for a, b, c, _ in windows)
    return Analysis(
        refined.f0,
        refined.f0_error,
        refined.B,
        refined.B_error,
        losses.b1,
        losses.b1_error,
        losses.d2,
        losses.d2_error,
        table,
        refined.scatter,
        losses.scatter,
        glide_cents,
        glide_table,
        density,
        None if note is None else midi_to_note(note_to_midi(note)),
        (
            *_wrong_note_message(note, refined.f0),
            *_bound_warning(refined),
            *_warnings(table, losses, glide_cents if glides else 0.0, second_stroke_s),
        ),
        glide_error,
        *removed,
        (measured.level_law.b1, measured.level_law.d2),
    )


def _laws(number: np.ndarray, measured: PartialTable, B: float) -> tuple[FrequencyLaw, DecayLaw]:
    """Frequency law and decay law of the string. A single partial is fitted with this `B`."""
    fixed_B = B if len(number) < 2 else None
    error = measured.total_error("frequency")
    return (
        frequency_law(number, measured.frequency, error, B=fixed_B),
        decay_law(number, np.maximum(measured.decay, _LEAST_DECAY), measured.total_error("decay")),
    )


def _expected_frequencies(law: FrequencyLaw, number: np.ndarray, frequency: np.ndarray, k: np.ndarray) -> np.ndarray:
    """Expected frequencies of partials `k`, Hz: the law plus the deviation of detected neighbours."""
    return law(k) * np.exp(local_deviation(number, CENTS * np.log(frequency / law(number)), k) / CENTS)


def _plausible(measured: PartialTable, expected: np.ndarray, f0: float) -> np.ndarray:
    """Partials above the noise whose values are determined, bool [partials]."""
    near = np.abs(measured.frequency - expected) < 0.25 * f0
    determined = (measured.level_error < _WORST_LEVEL) & (measured.total_error("frequency") < 0.1 * f0)
    return (measured.snr > LEAST_SNR) & near & determined & (measured.decay < 300.0)


def _near_law(k: np.ndarray, frequency: np.ndarray, error: np.ndarray) -> np.ndarray:
    """Partials near the law of the majority, or as far from it as their neighbours, bool [partials]."""
    if len(k) < 4:
        return np.ones(len(k), bool)
    law = frequency_law(k, frequency, error)
    deviation = CENTS * np.log(frequency / law(k))
    others = ~np.eye(len(k), dtype=bool)
    expected = np.concatenate([local_deviation(k[o], deviation[o], k[[i]]) for i, o in enumerate(others)])
    sd = np.hypot(law.deviation_sd(k), CENTS * error / frequency)
    return np.abs(deviation - expected) < np.maximum(_OUTLIER * sd, _OUTLIER_CENTS)


def _absent(number: np.ndarray, law: FrequencyLaw, top: float) -> np.ndarray:
    """Numbers of the partials below `top` Hz that are not in `number`."""
    candidates = np.arange(1, max(int(number.max()), int(top / law.f0)) + 1)
    return np.setdiff1d(candidates[law(candidates) < top], number)


def _table(number: np.ndarray, measured: PartialTable, absent: np.ndarray, bound: np.ndarray) -> Partials:
    return Partials(
        number=number,
        frequency=measured.frequency,
        frequency_error=measured.frequency_error,
        frequency_systematic=systematic(number, measured.frequency_systematic_sd),
        decay=np.maximum(measured.decay, _LEAST_DECAY),
        decay_error=measured.decay_error,
        decay_systematic=systematic(number, measured.decay_systematic_sd),
        level=measured.level,
        level_error=measured.level_error,
        level_systematic=systematic(number, measured.level_systematic_sd)
        + decay_law_covariance(number, measured.level_decay_sensitivity_s, measured.level_law),
        level_decay_sensitivity_s=measured.level_decay_sensitivity_s,
        snr=measured.snr,
        beating=measured.beating,
        absent=absent,
        absent_bound=bound,
    )


def _wrong_note_message(note: str | int | None, f0: float) -> tuple[str, ...]:
    """The warning of a recording whose pitch lies nearer to another key than to the given note."""
    cents = 0.0 if note is None else cents_above(f0, note_to_hz(note))
    if abs(cents) <= 50:
        return ()
    name, side = midi_to_note(note_to_midi(str(note))), "above" if cents > 0 else "below"
    return (
        f"the pitch lies {abs(cents):.0f} cents {side} {name}, nearer to {hz_to_note(f0)}: check the note's name, or "
        "how the instrument is tuned",
    )


def _bound_warning(law: FrequencyLaw) -> tuple[str, ...]:
    """The warning of a B at either end of the searched range."""
    if not np.isfinite(law.B_error) or law.B not in B_RANGE:
        return ()
    if B_RANGE[0] == law.B:
        return (
            f"B is at its lower bound, {law.B:g}: the partials are harmonic, and those of a stiff string are not; "
            "check that the recording holds one string without effects",
        )
    return (f"B is at its upper bound, {law.B:g}: check the note (--note), and that the partials belong to one string",)


def _warnings(table: Partials, losses: DecayLaw, glide_cents: float, second_stroke_s: float | None) -> tuple[str, ...]:
    warnings = []
    if second_stroke_s is not None:
        warnings.append(
            f"most partials rise again about {second_stroke_s:.2f} s after the onset: a second stroke changes the "
            "results; give a file of one stroke"
        )
    if len(table) == 1:
        warnings.append("only one partial detected: B is assumed, f0 depends on it, the losses are poorly determined")
    elif len(table) == 2:
        warnings.append("only 2 partials detected: B and the losses are poorly determined")
    if np.mean(table.decay <= _LEAST_DECAY) > 0.5:
        warnings.append(
            "most partials do not decay, so their decay rates are at the lower bound: a looped, reversed or compressed "
            "sound does not determine the losses"
        )
    if abs(glide_cents) > LEAST_GLIDE:
        warnings.append(
            f"the pitch {'falls' if glide_cents > 0 else 'rises'} by {abs(glide_cents):.1f} cents as the note decays"
        )
    if beats := beating_warning(table):
        warnings.append(beats)
    if losses.d2 < 2 * losses.d2_error and len(table) > 1:
        warnings.append("the decay rates do not determine how losses rise with frequency (d2 is not measurable)")
    return tuple(warnings)


def count_beating(table: Partials) -> int:
    """Number of partials whose log envelope deviates from one exponential by more than `BEAT` dB."""
    return int(np.sum(table.beating > BEATING_DB))


def beating_warning(table: Partials) -> str:
    """The warning of a recording whose partials beat; empty if none do."""
    deep = count_beating(table)
    if not deep:
        return ""
    return (
        f"{deep} of {len(table)} partials deviate from an exponential decay by more than {BEATING_DB:g} dB: several "
        "strings or polarisations beat, or the note was damped or cut"
    )
