"""Arrays and sounds of the page, computed from the result of a fit.

The covariance of a fit is that of logarithms. The static force K_H u^p of the felt at compression u has the logarithm
log F = log K_H + p log u, whose derivative by log p is p log u. Its 95 % band follows from the covariance by these
derivatives. The band of other felt laws follows from their own derivatives in the same way, to first order.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from ..analysis import law_frequency
from ..conversions import HALF_WIDTH_95
from ..errors import FitError, ParameterError
from ..felt import law_of
from ..felt.steps import static_force
from ..io.files import reference_row
from ..modal_response import AUDIBLE_RANGE_DB, band, kernel_seconds, mel_edges, mel_power
from ..model import Simulation
from ..model.modal_response import decays_and_beats
from ..parameters import PARAMETERS
from ..result import Covariance, Result
from ..result.reload import initial_note, stored_levels
from .figure_data import (
    ContactCurves,
    Envelope,
    Felt,
    FigureData,
    IdentifiabilityData,
    LevelCurves,
    ModalResponseCurves,
    RecordingCurves,
    Strokes,
)
from .identifiability_text import half_interval

if TYPE_CHECKING:
    from ..result import FittedRecording

__all__ = [
    "contact_curves", "curves_of", "envelopes_of", "felt_of", "has_intervals", "identifiability_of",
    "largest_compression", "level_curves", "modal_response_curves", "paths_of", "recordings_of", "reference_curves",
    "spectrum_db", "strokes_of",
]  # fmt: skip

ATTACK_S = 0.03
# Damping of the spectra, 1/s. The peaks are narrow enough to separate partials and wide enough to be visible.
SPECTRUM_SIGMA = 8.0
HIGHEST_FREQUENCY = 12_000.0  # Hz, of the spectra: higher partials are weak
STROKES = 7  # velocities of the slider
STROKE_SECONDS = 2.5
# Recordings whose velocities differ by less than this ratio do not define a range of velocities. The slider then goes
# down and up by the second ratio.
SMALLEST_RANGE = 1.3
DEFAULT_RANGE = 2.0
# Points of the loop of a stroke and of the felt law, more than a picture resolves.
LOOP_POINTS = 400
FELT_POINTS = 48
LARGEST_EXPONENT = 300.0  # so that exp does not overflow
# A conditional variance below this share of the marginal variance is rounding error.
ROUNDING = 1e-10
# Parameters that are shown as part of an invariant.
IN_INVARIANTS = ("c", "kappa", "M_H", "x0")
ENVELOPES = 6  # partials whose envelopes are shown
ENVELOPE_SECONDS = 3.0  # after the onset
MARGIN_SECONDS = 0.2  # kept at both ends for the analysis windows
# Points of an envelope, which is smoother than their spacing.
ENVELOPE_POINTS = 400
# Window of the spectrogram, s: a compromise between the length of the knock and the bandwidth of a partial.
WINDOW_SECONDS = 0.09
MEL_BANDS = 96


# --- the reference recording ------------------------------------------------------------------------------------------


def curves_of(result: Result) -> FigureData:
    """Return all curves and sounds of the page.

    Raises
    ------
    FitError
        If the fit was loaded from a file and a recording is missing or was changed.
    """
    result = result.with_recordings()
    return replace(
        reference_curves(result),
        recordings=recordings_of(result),
        reference_index=result.reference_index,
        paths=paths_of(result),
        felt=felt_of(result),
        identifiability=identifiability_of(result),
        strokes=strokes_of(result),
        ringing=modal_response_curves(result),
    )


def reference_curves(result: Result) -> FigureData:
    """Return the curves and sounds of the reference recording.

    Raises
    ------
    FitError
        If the fit was loaded from a file and a recording is missing or was changed.
    """
    result = result.with_recordings()
    recording, analysis, reference, note = result.recording, result.analysis, result.reference, result.note
    rate, onset, partials, k = recording.rate, recording.onset, reference.partials, reference.partials.number
    initial, fitted, contact = result.initial, result.fitted, contact_curves(result)
    highest = min(0.5 * rate, HIGHEST_FREQUENCY, float(law_frequency(analysis.f0, analysis.B, k.max() + 2)))
    mono = {"measured": recording.samples, "initial": initial.samples, "fitted": fitted.samples}
    spectra = {name: spectrum_db(samples[onset:], rate, highest) for name, samples in mono.items()}
    attack = slice(onset, onset + int(ATTACK_S * rate))
    f0, B = (result.document["derived"][name] for name in ("f0", "B"))
    sounds = {"original": recording.samples if reference.final.frames is None else recording.frames}
    if reference.ringing is None:
        sounds |= {"initial": initial.samples, "fitted": reference.sound}
    else:
        sounds |= {"fitted": reference.sound, "string model": fitted.samples}
    return FigureData(
        frequency=spectra["measured"][0],
        spectra={name: level for name, (_, level) in spectra.items()},
        borders=tuple(result.document["criterion"]["borders"]),
        attack_ms=1e3 * np.arange(len(recording.samples[attack])) / rate,
        attack={name: x[attack] for name, x in (mono | {"fitted": reference.final.samples}).items()},
        number=k,
        frequency_cents=_cents(partials.frequency, k * f0),
        frequency_cents_error=1200 / np.log(2) * partials.frequency_error / partials.frequency,
        frequency_cents_law=_cents(law_frequency(f0, B, k), k * f0),
        decay=partials.decay,
        decay_error=partials.decay_error,
        decay_law=note.string.b1 + note.string.b2 * (k * np.pi / note.geometry.length) ** 2,
        levels={"measured": reference.level, "initial": initial.level, "fitted": fitted.level},
        level_error=partials.level_error,
        path=None if note.path is None else note.path.at(partials.frequency),
        force_ms=contact.force_ms,
        force=contact.force,
        compression=contact.compression,
        sound_rate=rate,
        sounds=sounds,
    )


def contact_curves(result: Result) -> ContactCurves:
    """Return the contact of the reference recording before and after the fit.

    It is simulated again if the fit was loaded from a file.
    """
    if result.recordings:
        strokes = {"initial": result.initial.simulation, "fitted": result.fitted.simulation}
    else:
        notes = {"initial": initial_note(result, result.reference_index), "fitted": result.note}
        strokes = {name: note.strike(_rate(result)) for name, note in notes.items()}
    # 10 % longer than the last contact.
    steps = max(int(1.1 * stroke.last_touch / float(stroke.modes.step)) + 2 for stroke in strokes.values())
    return ContactCurves(
        force_ms=1e3 * float(strokes["fitted"].modes.step) * np.arange(steps),
        force={name: _pad(stroke.pulse.force, steps) for name, stroke in strokes.items()},
        compression={name: 1e3 * _pad(stroke.pulse.compression, steps) for name, stroke in strokes.items()},
    )


def level_curves(result: Result) -> LevelCurves:
    """Return the levels of the partials of the reference recording, from `fit.json`."""
    levels = stored_levels(result.document, result.reference_index)
    return LevelCurves(
        number=levels["number"].astype(int), level_error=levels["error"],
        levels={name: levels[name] for name in ("measured", "initial", "fitted")},
    )  # fmt: skip


def spectrum_db(samples: np.ndarray, rate: int, top: float) -> tuple[np.ndarray, np.ndarray]:
    """Return frequencies, Hz, and levels, dB, up to `top`, Hz, of the spectrum of the samples times exp(-σt)."""
    n = min(len(samples), int(14 / SPECTRUM_SIGMA * rate))
    size = 2 ** int(np.ceil(np.log2(n)))
    value = np.abs(np.fft.rfft(samples[:n] * np.exp(-SPECTRUM_SIGMA * np.arange(n) / rate), size)) / rate
    keep = slice(1, int(top * size / rate))
    return np.fft.rfftfreq(size, 1 / rate)[keep], 20 * np.log10(np.maximum(value[keep], 1e-15))


def _cents(frequency: np.ndarray, reference: np.ndarray) -> np.ndarray:
    return 1200 * np.log2(frequency / reference)


def _pad(values, size: int) -> np.ndarray:
    """Return `values` [size], cut or filled with NaN, which is not drawn."""
    values = np.asarray(values)[:size]
    return np.pad(values, (0, size - len(values)), constant_values=np.nan)


# --- every recording, and the note at other velocities ----------------------------------------------------------------


def recordings_of(result: Result) -> tuple[RecordingCurves, ...]:
    """Return the curves and sounds of every recording, in the given order."""
    return tuple(_recording(place, fitted) for place, fitted in enumerate(result.recordings, start=1))


def _recording(place: int, fitted: FittedRecording) -> RecordingCurves:
    partials, recording, pulse = fitted.partials, fitted.recording, fitted.fitted.simulation.pulse
    compression, force = np.asarray(pulse.compression), np.asarray(pulse.force)
    end = int(np.flatnonzero(compression > 0)[-1]) + 2 if (compression > 0).any() else 0
    shown = slice(0, end, max(1, end // LOOP_POINTS))
    contact = np.where(compression > 0, 1.0, np.nan)[shown]
    return RecordingCurves(
        place=place,
        velocity=float(fitted.fitted.note.hammer.v_H0),
        error_db=fitted.levels["fitted_db"],
        number=partials.number,
        level=fitted.level,
        level_error=partials.level_error,
        level_fitted=fitted.fitted.level,
        compression=1e3 * compression[shown] * contact,
        force=force[shown] * contact,
        sound_rate=recording.rate,
        onset=recording.onset / recording.rate,
        sound_original=recording.samples,
        sound_fitted=fitted.final.samples,
    )


def paths_of(result: Result) -> tuple[tuple[np.ndarray, np.ndarray], ...]:
    """Return the output path of each path group at its partials, Hz and dB; empty for calibrated recordings."""
    paths = {}
    for fitted, row in zip(result.recordings, result.document["recordings"], strict=True):
        path = fitted.fitted.note.path
        if path is not None:
            paths.setdefault(row["group"], (path.frequency, path.db))
    return tuple(paths[group] for group in sorted(paths))


def strokes_of(result: Result) -> Strokes | None:
    """Return the note of the reference recording at several velocities; None if fewer than two can be rendered.

    The range is from the softest to the loudest recording, or from half to twice the velocity of a single one. The
    sounds are means of the channels and begin `pre_onset_s` before the contact.
    """
    velocities = np.array([fitted.fitted.note.hammer.v_H0 for fitted in result.recordings])
    low, high = float(velocities.min()), float(velocities.max())
    is_recorded_range = high / low > SMALLEST_RANGE
    if not is_recorded_range:
        middle, bounds = np.sqrt(low * high), PARAMETERS["v_H0"]
        low, high = max(middle / DEFAULT_RANGE, bounds.lower), min(middle * DEFAULT_RANGE, bounds.upper)
    note, rate = result.note, result.recording.rate
    sounds = {}
    for velocity in np.geomspace(low, high, STROKES):
        stroke = note._replace(hammer=note.hammer._replace(v_H0=float(velocity)))
        try:
            onset = round(stroke.pre_onset_s * rate)
            sounds[float(velocity)] = stroke.render_stroke(rate, int(STROKE_SECONDS * rate), onset)[0]
        except (FitError, ParameterError):  # a contact that does not end cannot be rendered
            continue
    if len(sounds) < 2:
        return None
    rendered = np.array([*sounds])
    first = int(np.abs(np.log(rendered / note.hammer.v_H0)).argmin())
    return Strokes(rendered, tuple(sounds.values()), rate, first, is_recorded_range)


# --- the felt, and uncertainties --------------------------------------------------------------------------------------


def has_intervals(result: Result) -> bool:
    """Return whether this fit has intervals; fits with the recipes of the paper do not."""
    return any(quantity.interval for quantity in result.parameters.values())


def largest_compression(result: Result) -> float:
    """Return the largest compression of the felt in all strokes of the fit, m."""
    pulses = [fitted.fitted.simulation.pulse for fitted in result.recordings] or [_fastest_stroke(result).pulse]
    return max(float(np.max(pulse.compression)) for pulse in pulses)


def felt_of(result: Result, reach: float | None = None) -> Felt:
    """Return the static law with its band, up to the compression `reach`, m; that of the strokes if None."""
    hammer = result.note.hammer
    u = (largest_compression(result) if reach is None else reach) * np.linspace(0.0, 1.0, FELT_POINTS + 1)[1:]
    names, cov = _shared_covariance(result)
    cov = cov if has_intervals(result) else 0 * cov

    def curve(slow: bool) -> np.ndarray:
        force, derivatives = static_force(u, hammer, slow)
        zero = np.zeros(len(u))
        return _band(force, np.stack([derivatives.get(name, zero) for name in names], axis=1), cov)

    law = law_of(hammer)
    return Felt(1e3 * u, curve(False), curve(True) if law.slow else None, law.formula)


def _fastest_stroke(result: Result) -> Simulation:
    """Simulate the stroke with the largest hammer velocity of a fit that was loaded from a file."""
    notes = result.minima_notes[0]
    return notes[int(np.argmax([float(note.hammer.v_H0) for note in notes]))].strike(_rate(result))


def _rate(result: Result) -> int:
    """Return the sample rate of the reference recording, Hz."""
    return int(result.document["recordings"][result.reference_index]["rate"])


def _shared_covariance(result: Result) -> tuple[tuple[str, ...], np.ndarray]:
    """Return names and covariance of the parameters that all strokes share.

    Without a measured velocity it is conditional on the velocity of the reference recording. Otherwise the common
    scale of the velocities, which only the prior determines, would dominate the uncertainty of the felt.
    """
    full = result.covariance.matrix
    names = tuple(name for name in result.covariance.names if not name.startswith("v_H0"))
    cov = full
    velocity = result.parameters.get("v_H0")
    if velocity is not None and velocity.status == "scaled":
        fixed = len(names) + reference_row(result.document["recordings"])[1]["stroke"]
        if cov[fixed, fixed] > 0:
            cov = cov - np.outer(cov[fixed], cov[fixed]) / cov[fixed, fixed]
            # Parameters that vary only with the scale are fixed now, apart from rounding errors.
            cov = np.where(np.diag(cov) > ROUNDING * np.diag(full), cov, 0.0)
    return names, cov[: len(names), : len(names)]


def _band(value: np.ndarray, derivative: np.ndarray, cov: np.ndarray) -> np.ndarray:
    """Return [3, n]: `value` [n] and the ends of its 95 % interval, by the `derivative` [n, names] of its logarithm."""
    sd = np.sqrt(np.maximum(np.einsum("ni,ij,nj->n", derivative, cov, derivative), 0.0))
    half = np.minimum(HALF_WIDTH_95 * sd, LARGEST_EXPONENT)
    return value * np.exp(np.stack([0 * half, -half, half]))


def identifiability_of(result: Result) -> IdentifiabilityData | None:
    """Return uncertainties of invariants and parameters, and correlations; None without intervals."""
    names, cov = _shared_covariance(result)
    correlation = Covariance(names, cov).correlation
    if not (has_intervals(result) and correlation.names):
        return None
    document = result.document
    entries = [(name, entry, True) for name, entry in document["invariants"].items()]
    entries += [(name, entry, False) for name, entry in document["parameters"].items() if name not in IN_INVARIANTS]
    halves = [(name, half_interval(entry), is_invariant) for name, entry, is_invariant in entries]
    return IdentifiabilityData(
        correlation.names,
        correlation.matrix,
        tuple((name, half, is_invariant) for name, half, is_invariant in halves if half is not None),
    )


# --- the modal response -----------------------------------------------------------------------------------------------


def modal_response_curves(result: Result) -> ModalResponseCurves | None:
    """Return the curves of the modal response, for the reference recording; None if the fit did not estimate it."""
    if "ringing" not in result.document:
        return None
    reference = result.reference
    recording, response = reference.recording, result.note.ringing
    n = 2 * round(WINDOW_SECONDS * recording.rate / 2)
    end = recording.onset + round((ENVELOPE_SECONDS + MARGIN_SECONDS) * recording.rate)
    (time, measured), (_, played) = (
        mel_power(samples[:end], recording.rate, recording.onset, n, MEL_BANDS)
        for samples in (recording.samples, reference.final.samples)
    )
    # At least one frame, also of a very short recording.
    frames = time <= max(min(ENVELOPE_SECONDS, time[-1] - WINDOW_SECONDS), 0.0)
    time, measured, played = time[frames], measured[frames], played[frames]
    floor = max(float(measured.max()), 1e-30) * 10 ** (-AUDIBLE_RANGE_DB / 10)
    strongest = sorted(reference.partials.number[np.argsort(reference.level)[-ENVELOPES:]].tolist())
    return ModalResponseCurves(
        envelopes=envelopes_of(result, strongest),
        time=time,
        frequency=mel_edges(n, MEL_BANDS, recording.rate)[1:-1],
        measured=10 * np.log10(measured + floor).T,
        played=10 * np.log10(played + floor).T,
        decays=() if response is None else tuple(decays_and_beats(response)),
    )


def envelopes_of(result: Result, numbers: list[int]) -> tuple[Envelope, ...]:
    """Return the envelopes of these partials of the reference recording, of the mean of its channels."""
    result = result.with_recordings()
    reference = result.reference
    rate, onset, partials = reference.recording.rate, reference.recording.onset, reference.partials
    begin = max(onset - round(MARGIN_SECONDS * rate), 0)
    section = slice(begin, onset + round((ENVELOPE_SECONDS + MARGIN_SECONDS) * rate))
    sounds = [reference.recording.samples, reference.fitted.samples]
    sounds += [reference.ringing.samples] if reference.ringing else []
    x = np.stack([sound[section] for sound in sounds])
    spectrum, count, f0, B = np.fft.rfft(x), x.shape[-1], result.analysis.f0, result.analysis.B
    envelopes = []
    for k in numbers:
        centre = float(partials.frequency[partials.number == k][0])
        spacing = float(np.diff(law_frequency(f0, B, np.array([k, k + 1])))[0])
        b = band(spectrum, count, rate, centre, kernel_seconds(spacing))
        time = b.time - (onset - begin) / rate
        end = min(ENVELOPE_SECONDS, (count - onset + begin) / rate - b.kernel)
        at = np.flatnonzero((time >= 0) & (time <= end))
        at = at[:: max(1, len(at) // ENVELOPE_POINTS)]
        db = 20 * np.log10(np.maximum(2 * np.abs(b.values[:, at]), 1e-15))
        envelopes.append(Envelope(k, centre, time[at], db[0], db[1], db[2] if len(db) > 2 else None))
    return tuple(envelopes)
