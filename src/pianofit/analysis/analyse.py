"""Measures one recording: the table of partials, and the frequency law and decay law of the string."""

from collections.abc import Sequence
from dataclasses import replace
from numbers import Real

import numpy as np

from ..conversions import CENTS
from ..dsp.bands import kaiser_bands
from ..errors import AnalysisError, ParameterError, WrongNoteError, check_type
from ..recording.recording import Recording, Source, to_recording
from ..threads import numerical_settings
from .analysis_result import Analysis, Partials
from .baseband_fit import FittedBands, absent_level_bounds, fit_bands
from .glide import PitchGlide, glide_detected, glide_windows, remove_glide
from .inharmonicity import DecayLaw, FrequencyLaw, decay_law, frequency_law, local_deviation, tension_share
from .measure_knock import measure_knock
from .note_names import cents_above, hz_to_note, midi_to_note, note_to_hz, note_to_midi
from .numbering import number_partials
from .partials import LEAST_SNR, measure_partials
from .pitch import check_length, find_pitch
from .second_stroke import detect_second_stroke
from .spectrum import highest_partial, noise_between
from .warnings import analysis_warnings


@numerical_settings()
def analyse(recording: Source, *, note: str | int | None = None, f0: float | None = None) -> Analysis:
    """Detect and measure the partials of one struck note.

    Parameters
    ----------
    recording : a path, a `Recording`, or (samples, rate), as for `fit`.
    note : name, such as "F#2", or MIDI number. The pitch is searched within a semitone of it.
    f0 : the same in Hz. A note that is given too must be within a semitone of it.

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
    named = None if note is None else note_to_hz(note)  # before the recording is blamed
    if named is not None and f0 is not None:
        check_type("f0=", f0, Real, "a frequency in Hz")
        if not (f0 > 0 and abs(cents_above(f0, named)) <= 100.0):
            raise ParameterError(f"f0={f0:g} Hz is not note {note}, {named:.1f} Hz; give one of them")
    recording = to_recording(recording)
    rate = recording.rate
    samples = np.asarray(recording.samples, float)[recording.onset :][: 20 * rate]  # the end adds no information
    try:
        rough_f0, rough_B = find_pitch(samples, rate, note=note, f0=f0)
        check_length(len(samples) / rate, rough_f0)
    except AnalysisError as error:
        raise type(error)("; ".join((f"{recording.path}: {error}", *recording.warnings))) from None
    number, frequency, law = number_partials(samples, rate, rough_f0, rough_B)
    _check_partials(recording.path, number, law, note, f0)
    return _measure_all(recording, samples, number, frequency, law, note)


def check_analyses(analyses: Sequence[Analysis] | None, count: int) -> None:
    """Raise a `ParameterError` unless each of `count` recordings has an analysis; None means that none were given."""
    if analyses is None:
        return
    check_type("analyses=", analyses, list | tuple, "a list of what analyse returned")
    for analysis in analyses:
        check_type("analyses: ", analysis, Analysis, "what analyse returned")
    if len(analyses) != count:
        raise ParameterError(f"{len(analyses)} analyses were given for {count} recordings; give one for each")


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
) -> Analysis:
    """Measure the partials `number` at `frequency` (Hz) [partials] near the rough `law`, and fit the laws."""
    skip = min(0.005, 0.05 * (len(samples) / recording.rate))  # s; the contact has ended by then, or nearly
    fitted = _fit_all(samples, recording.rate, skip, number, frequency, law)
    share = tension_share(law.B, number)
    windows = glide_windows(fitted, share)
    glides = glide_detected(windows)
    # A single partial in a late window follows the glide only if a glide was detected. Otherwise it follows its beats.
    usable = windows if glides else [window for window in windows if np.isfinite(window[3])]
    glide_cents = float(usable[0][2] - usable[-1][2]) if len(usable) > 1 else 0.0
    removed, glide_error = PitchGlide(0.0, 1.0), 0.0
    if glides:
        fitted, removed, glide_error = remove_glide(fitted, windows, share)
    table, level_law = measure_partials(number, fitted, glides)
    keep = _plausible(table, _expected_frequencies(law, number, frequency, number), law.f0) & ~fitted.drifted
    keep[keep] = _near_law(number[keep], table.frequency[keep], table.total_error("frequency")[keep])
    if not keep.any():
        raise AnalysisError(f"{recording.path}: no partial of {law.f0:.1f} Hz was detected above the noise")
    if not keep.all():  # a rejected peak must not contribute to the errors of its neighbours
        fitted = fitted.select(keep)
        table, level_law = measure_partials(number[keep], fitted, glides)
    refined, losses = _laws(table, law.B)
    absent = _absent(table.number, refined, highest_partial(recording.rate))
    absent_frequency = _expected_frequencies(refined, table.number, table.frequency, absent)
    bound = absent_level_bounds(samples, recording.rate, absent_frequency, losses(absent), refined.f0, skip)
    table = replace(table, absent=absent, absent_bound=bound)
    significant_cents = glide_cents if glides else 0.0
    knock, knock_error = measure_knock(recording, refined.f0)
    return Analysis(
        f0=refined.f0,
        f0_error=refined.f0_error,
        B=refined.B,
        B_error=refined.B_error,
        b1=losses.b1,
        b1_error=losses.b1_error,
        d2=losses.d2,
        d2_error=losses.d2_error,
        partials=table,
        scatter_cents=refined.scatter,
        scatter_decay=losses.scatter,
        glide_cents=glide_cents,
        glide=tuple((a, b, refined.f0 * float(np.exp(c / CENTS))) for a, b, c, _ in windows),
        noise_density=fitted.density,
        note=None if note is None else midi_to_note(note_to_midi(note)),
        warnings=analysis_warnings(note, refined, losses, table, significant_cents, detect_second_stroke(fitted)),
        glide_error=glide_error,
        glide_start=removed.start_cents,
        glide_tau=removed.tau,
        level_law=(level_law.b1, level_law.d2),
        knock=knock,
        knock_error=knock_error,
    )


def _fit_all(
    samples: np.ndarray, rate: int, skip: float, number: np.ndarray, frequency: np.ndarray, law: FrequencyLaw
) -> FittedBands:
    """Fit one exponential to each partial, and measure the noise between the partials."""
    # A bandwidth above 100 Hz adds no information about a partial that decays slowly.
    spacing = min(0.97 * law.f0, max(100.0, 0.1 * law.f0))
    bands = kaiser_bands(samples, rate, frequency, spacing, skip)
    expected = _expected_frequencies(law, number, frequency, np.arange(1, int(number.max()) + 6))
    density = noise_between(samples, rate, expected, frequency, law.f0, min(0.05, 0.1 * (len(samples) / rate)))
    fitted = fit_bands(bands, density)
    return replace(fitted, density=np.maximum(density, 1e-20 * float(np.max(np.abs(fitted.z))) ** 2))


def _laws(table: Partials, B: float) -> tuple[FrequencyLaw, DecayLaw]:
    """Frequency law and decay law of the string. A single partial is fitted with this `B`."""
    fixed_B = B if len(table) < 2 else None
    return (
        frequency_law(table.number, table.frequency, table.total_error("frequency"), B=fixed_B),
        decay_law(table.number, table.decay, table.total_error("decay")),
    )


def _expected_frequencies(law: FrequencyLaw, number: np.ndarray, frequency: np.ndarray, k: np.ndarray) -> np.ndarray:
    """Expected frequencies of partials `k`, Hz: the law plus the deviation of detected neighbours."""
    return law(k) * np.exp(local_deviation(number, law.deviation(number, frequency), k) / CENTS)


def _plausible(table: Partials, expected: np.ndarray, f0: float) -> np.ndarray:
    """Partials above the noise whose values are determined, bool [partials]."""
    near = np.abs(table.frequency - expected) < 0.25 * f0
    determined = (table.level_error < 10.0) & (table.total_error("frequency") < 0.1 * f0)
    return (table.snr > LEAST_SNR) & near & determined & (table.decay < 300.0)


def _near_law(k: np.ndarray, frequency: np.ndarray, error: np.ndarray) -> np.ndarray:
    """Partials near the law of the majority, or as far from it as their neighbours, bool [partials].

    A peak farther than 12 cents and six standard deviations from the frequency that its neighbours predict is not a
    partial.
    """
    if len(k) < 4:
        return np.ones(len(k), bool)
    law = frequency_law(k, frequency, error)
    deviation = law.deviation(k, frequency)
    others = ~np.eye(len(k), dtype=bool)
    expected = np.concatenate([local_deviation(k[o], deviation[o], k[[i]]) for i, o in enumerate(others)])
    sd = np.hypot(law.deviation_sd(k), CENTS * error / frequency)
    return np.abs(deviation - expected) < np.maximum(6.0 * sd, 12.0)


def _absent(number: np.ndarray, law: FrequencyLaw, top: float) -> np.ndarray:
    """Numbers of the partials below `top` Hz that are not in `number`."""
    candidates = np.arange(1, max(int(number.max()), int(top / law.f0)) + 1)
    return np.setdiff1d(candidates[law(candidates) < top], number)
