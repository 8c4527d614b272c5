"""From a fit's result to what the page draws: arrays only, all computed before.

The covariance of a fit is that of logarithms, so what is a product of powers is known to the length of one vector: the
felt's static force K_H u^p at compression u has log F = log K_H + p log u, whose change with log p is p log u. Of other
laws the curve is as well known as its own changes by its parameters say.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..analysis import law_frequency
from ..conversions import NORMAL
from ..errors import FitError, ParameterError
from ..felt import law_of
from ..io.files import reference_of
from ..modal_response import HEARD, band, kernel_seconds, mel_edges, mel_power
from ..model import Simulation, static_force
from ..model.decay import decays_and_beats
from ..parameters import PARAMETERS
from ..result import Covariance, Result
from ..result.reload import initial_note, levels_of
from .figure_data import (
    ContactCurves,
    Envelope,
    Felt,
    FigureData,
    IdentifiabilityData,
    LevelCurves,
    RecordingCurves,
    RingingCurves,
    Strokes,
)
from .identifiability_text import half_interval

__all__ = [
    "contact_curves", "curves_of", "envelopes_of", "felt_of", "has_intervals", "known_of", "level_curves", "paths_of",
    "reached", "recordings_of", "reference_curves", "ringing_curves", "spectrum_db", "strokes_of",
]  # fmt: skip

ATTACK = 0.03  # s
SPECTRUM_SIGMA = 8.0  # 1/s: lines fine enough to tell partials apart, wide enough to see
TOP = 12_000.0  # Hz, of the spectra: little is above
STROKES = 7  # of the slider over velocities
SECONDS = 2.5  # of each of them
# Recordings closer than this in velocity, as a ratio, give no range;
NARROW = 1.3
# the slider then goes so far down and up, as a ratio.
WIDER = 2.0
# Points of the felt's loop and of its law, more than a picture shows.
LOOP_POINTS = 400
FELT_POINTS = 48
FARTHEST = 300.0  # of an exponent: e to it is no overflow
# A variance below this share of what it was is rounding.
HELD = 1e-10
# Parameters that an invariant stands for.
COMBINED = ("c", "kappa", "M_H", "x0")
# Partials whose envelopes are shown.
PARTIALS = 6
# How long after the onset, s, and how much more of a sound is cut at both ends, for the windows.
SHOWN = 3.0
MORE = 0.2
# Points of an envelope, which is smoother than they are apart.
ENVELOPE_POINTS = 400
# Window, s, of the picture over time and frequency: between a knock's time and a partial's width.
WINDOW = 0.09
BANDS = 96  # of it, mel


# --- the reference recording ------------------------------------------------------------------------------------------


def curves_of(result: Result) -> FigureData:
    """Everything the page shows of one fit; errors as of `Result.with_recordings`."""
    result = result.with_recordings()
    return replace(
        reference_curves(result),
        recordings=recordings_of(result),
        reference_index=result.reference_index,
        paths=paths_of(result),
        felt=felt_of(result),
        known=known_of(result),
        strokes=strokes_of(result),
        ringing=ringing_curves(result),
    )


def reference_curves(result: Result) -> FigureData:
    """What is shown of the reference recording alone.

    Raises `FitError` if the fit was read back, and a recording is not at its place or was changed.
    """
    result = result.with_recordings()
    r, a, heard = result.recording, result.analysis, result.reference
    rate, onset, p, k = r.rate, r.onset, heard.partials, heard.partials.number
    before, after, contact = result.initial, result.fitted, contact_curves(result)
    top = min(0.5 * rate, TOP, float(law_frequency(a.f0, a.B, k.max() + 2)))
    sounds = {"measured": r.samples, "initial": before.samples, "fitted": after.samples}
    spectra = {name: spectrum_db(x[onset:], rate, top) for name, x in sounds.items()}
    attack = slice(onset, onset + int(ATTACK * rate))
    v = result.note
    f0, B = (result.document["derived"][name] for name in ("f0", "B"))
    original = {"original": r.samples if heard.as_played.frames is None else r.frames}
    return FigureData(
        frequency=spectra["measured"][0], spectra={name: level for name, (_, level) in spectra.items()},
        borders=tuple(result.document["criterion"]["borders"]),
        attack_ms=1e3 * np.arange(len(r.samples[attack])) / rate,
        attack={name: x[attack] for name, x in (sounds | {"fitted": heard.as_played.samples}).items()},
        number=k,
        frequency_cents=_cents(p.frequency, k * f0),
        frequency_cents_error=1200 / np.log(2) * p.frequency_error / p.frequency,
        frequency_cents_law=_cents(law_frequency(f0, B, k), k * f0),
        decay=p.decay, decay_error=p.decay_error,
        decay_law=v.string.b1 + v.string.b2 * (k * np.pi / v.geometry.length) ** 2,
        levels={"measured": heard.level, "initial": before.level, "fitted": after.level}, level_error=p.level_error,
        path=None if v.path is None else v.path.at(p.frequency),
        force_ms=contact.force_ms, force=contact.force, compression=contact.compression,
        sound_rate=rate,
        sounds=original | ({"initial": before.samples, "fitted": heard.sound} if heard.ringing is None else
                           {"fitted": heard.sound, "law": after.samples}),
    )  # fmt: skip


def contact_curves(result: Result) -> ContactCurves:
    """The reference's stroke before and after the fit; of a fit that was read back it is struck anew."""
    if result.recordings:
        strokes = {"initial": result.initial.simulation, "fitted": result.fitted.simulation}
    else:
        notes = {"initial": initial_note(result, result.reference_index), "fitted": result.note}
        strokes = {name: note.strike(_rate(result)) for name, note in notes.items()}
    # Until the last of the contacts is over, and a tenth more.
    steps = max(int(1.1 * one.last_touch / float(one.modes.step)) + 2 for one in strokes.values())
    return ContactCurves(
        force_ms=1e3 * float(strokes["fitted"].modes.step) * np.arange(steps),
        force={name: _pad(one.pulse.force, steps) for name, one in strokes.items()},
        compression={name: 1e3 * _pad(one.pulse.compression, steps) for name, one in strokes.items()},
    )


def level_curves(result: Result) -> LevelCurves:
    """The levels of the reference's partials; `fit.json` holds them."""
    levels = levels_of(result.document, result.reference_index)
    return LevelCurves(
        number=levels["number"].astype(int), level_error=levels["error"],
        levels={name: levels[name] for name in ("measured", "initial", "fitted")},
    )  # fmt: skip


def spectrum_db(samples: np.ndarray, rate: int, top: float) -> tuple[np.ndarray, np.ndarray]:
    """Frequencies, Hz, and levels, dB, of the spectrum under exp(-σt), up to `top`, Hz, as pages show it."""
    n = min(len(samples), int(14 / SPECTRUM_SIGMA * rate))
    size = 2 ** int(np.ceil(np.log2(n)))
    value = np.abs(np.fft.rfft(samples[:n] * np.exp(-SPECTRUM_SIGMA * np.arange(n) / rate), size)) / rate
    keep = slice(1, int(top * size / rate))
    return np.fft.rfftfreq(size, 1 / rate)[keep], 20 * np.log10(np.maximum(value[keep], 1e-15))


def _cents(frequency: np.ndarray, reference: np.ndarray) -> np.ndarray:
    return 1200 * np.log2(frequency / reference)


def _pad(values, size: int) -> np.ndarray:
    """`values` [size]: cut, or filled with what nothing looks like."""
    values = np.asarray(values)[:size]
    return np.pad(values, (0, size - len(values)), constant_values=np.nan)


# --- every recording, and the note between them -----------------------------------------------------------------------


def recordings_of(result: Result) -> tuple[RecordingCurves, ...]:
    """Every recording, in the order given."""
    return tuple(_recording(place, heard) for place, heard in enumerate(result.recordings, start=1))


def _recording(place: int, heard) -> RecordingCurves:
    p, recording, pulse = heard.partials, heard.recording, heard.fitted.simulation.pulse
    compression, force = np.asarray(pulse.compression), np.asarray(pulse.force)
    last = int(np.flatnonzero(compression > 0)[-1]) + 2 if (compression > 0).any() else 0
    thin = slice(0, last, max(1, last // LOOP_POINTS))
    touching = np.where(compression > 0, 1.0, np.nan)[thin]
    return RecordingCurves(
        place, float(heard.fitted.note.hammer.v_H0), heard.levels["fitted_db"],
        p.number, heard.level, p.level_error, heard.fitted.level,
        1e3 * compression[thin] * touching, force[thin] * touching,
        recording.rate, recording.onset / recording.rate, recording.samples, heard.played.samples,
    )  # fmt: skip


def paths_of(result: Result) -> tuple[tuple[np.ndarray, np.ndarray], ...]:
    """The output path of each group at its partials: Hz and dB; none for a known pickup."""
    found = {}
    for heard, recording in zip(result.recordings, result.document["recordings"], strict=True):
        path = heard.fitted.note.path
        if path is not None:
            found.setdefault(recording["group"], (path.frequency, path.db))
    return tuple(found[group] for group in sorted(found))


def strokes_of(result: Result) -> Strokes | None:
    """The reference's note from the softest recording's velocity to the loudest's; of one, to half and to double.

    The mean of its channels, as it rings, from its `lead` before the contact.
    """
    own = np.array([heard.fitted.note.hammer.v_H0 for heard in result.recordings])
    low, high = float(own.min()), float(own.max())
    inside = high / low > NARROW
    if not inside:
        middle, box = np.sqrt(low * high), PARAMETERS["v_H0"]
        low, high = max(middle / WIDER, box.lower), min(middle * WIDER, box.upper)
    note, recording = result.note, result.recording
    played = []
    for velocity in np.geomspace(low, high, STROKES):
        struck = note._replace(hammer=note.hammer._replace(v_H0=float(velocity)))
        try:
            touch = round(struck.pre_onset_s * recording.rate)
            played.append(
                (float(velocity), struck.render_stroke(recording.rate, int(SECONDS * recording.rate), touch)[0])
            )
        except (FitError, ParameterError):  # a contact that does not end is no sound to choose
            continue
    if len(played) < 2:
        return None
    velocities = np.array([velocity for velocity, _ in played])
    first = int(np.abs(np.log(velocities / note.hammer.v_H0)).argmin())
    return Strokes(velocities, tuple(sound for _, sound in played), recording.rate, first, inside)


# --- the felt, and how well each thing is known -----------------------------------------------------------------------


def has_intervals(result: Result) -> bool:
    """Whether this fit says how far off it may be; the paper's recipes do not."""
    return any(quantity.interval for quantity in result.parameters.values())


def reached(result: Result) -> float:
    """The largest compression of the felt in all strokes of the fit, m."""
    pulses = [one.fitted.simulation.pulse for one in result.recordings] or [_hardest(result).pulse]
    return max(float(np.max(pulse.compression)) for pulse in pulses)


def felt_of(result: Result, reach: float | None = None) -> Felt:
    """The static law up to the compression `reach`, m, or all that was reached; with its band if the fit has one."""
    hammer = result.note.hammer
    u = (reached(result) if reach is None else reach) * np.linspace(0.0, 1.0, FELT_POINTS + 1)[1:]
    names, cov = _shared(result)
    cov = cov if has_intervals(result) else 0 * cov

    def curve(slow: bool) -> np.ndarray:
        force, slopes = static_force(u, hammer, slow)
        zero = np.zeros(len(u))
        return _band(force, np.stack([slopes.get(name, zero) for name in names], axis=1), cov)

    law = law_of(hammer)
    return Felt(1e3 * u, curve(False), curve(True) if law.slow else None, law.formula)


def _hardest(result: Result) -> Simulation:
    """The stroke of the fastest hammer of a fit that was read back, computed again."""
    notes = result.minima_notes[0]
    return notes[int(np.argmax([float(note.hammer.v_H0) for note in notes]))].strike(_rate(result))


def _rate(result: Result) -> int:
    """The reference recording's rate, Hz."""
    return int(result.document["recordings"][result.reference_index]["rate"])


def _shared(result: Result) -> tuple[tuple[str, ...], np.ndarray]:
    """Names and covariance of what all strokes share.

    Gauge-fixed at the reference velocity, where no velocity was measured: one common scale of the velocities, known by
    its prior alone, would else hide what the recordings say of the felt.
    """
    given = result.covariance.matrix
    names = tuple(name for name in result.covariance.names if not name.startswith("v_H0"))
    cov = given
    velocity = result.parameters.get("v_H0")
    if velocity is not None and velocity.status == "scaled":
        held = len(names) + reference_of(result.document["recordings"])[1]["stroke"]
        if cov[held, held] > 0:
            cov = cov - np.outer(cov[held], cov[held]) / cov[held, held]
            # What the scale alone moved is held now, but for rounding.
            cov = np.where(np.diag(cov) > HELD * np.diag(given), cov, 0.0)
    return names, cov[: len(names), : len(names)]


def _band(value: np.ndarray, change: np.ndarray, cov: np.ndarray) -> np.ndarray:
    """`value` [n] and the ends of its 95 % interval, from the `change` [n, names] of its logarithm: [3, n]."""
    sd = np.sqrt(np.maximum(np.einsum("ni,ij,nj->n", change, cov, change), 0.0))
    reach = np.minimum(NORMAL * sd, FARTHEST)
    return value * np.exp(np.stack([0 * reach, -reach, reach]))


def known_of(result: Result) -> IdentifiabilityData | None:
    """How well the parameters, and what needs no assumed scale, are known; None without intervals."""
    names, cov = _shared(result)
    correlation = Covariance(names, cov).correlation
    if not (has_intervals(result) and correlation.names):
        return None
    document = result.document
    entries = [(name, entry, True) for name, entry in document["invariants"].items()]
    entries += [(name, entry, False) for name, entry in document["parameters"].items() if name not in COMBINED]
    reaches = [(name, half_interval(entry), combined) for name, entry, combined in entries]
    return IdentifiabilityData(
        correlation.names, correlation.matrix,
        tuple((name, reach, combined) for name, reach, combined in reaches if reach is not None),
    )  # fmt: skip


# --- how the note rings -----------------------------------------------------------------------------------------------


def ringing_curves(result: Result) -> RingingCurves | None:
    """What the page shows of it, of the reference recording; None where the fit did not look for modes."""
    if "ringing" not in result.document:
        return None
    heard = result.reference
    recording, ringing = heard.recording, result.note.ringing
    n = 2 * round(WINDOW * recording.rate / 2)
    last = recording.onset + round((SHOWN + MORE) * recording.rate)
    (time, one), (_, other) = (
        mel_power(x[:last], recording.rate, recording.onset, n, BANDS)
        for x in (recording.samples, heard.as_played.samples)
    )
    frames = time <= max(min(SHOWN, time[-1] - WINDOW), 0.0)  # one at the least, of a very short recording
    time, one, other = time[frames], one[frames], other[frames]
    floor = max(float(one.max()), 1e-30) * 10 ** (-HEARD / 10)
    strongest = sorted(heard.partials.number[np.argsort(heard.level)[-PARTIALS:]].tolist())
    return RingingCurves(
        envelopes_of(result, strongest), time, mel_edges(n, BANDS, recording.rate)[1:-1],
        10 * np.log10(one + floor).T, 10 * np.log10(other + floor).T,
        () if ringing is None else tuple(decays_and_beats(ringing)),
    )  # fmt: skip


def envelopes_of(result: Result, numbers: list[int]) -> tuple[Envelope, ...]:
    """The envelopes of these partials of the reference, of the mean of its channels: recorded, by law, as it rings."""
    result = result.with_recordings()
    heard = result.reference
    rate, onset, partials = heard.recording.rate, heard.recording.onset, heard.partials
    begin = max(onset - round(MORE * rate), 0)
    cut = slice(begin, onset + round((SHOWN + MORE) * rate))
    sounds = [heard.recording.samples, heard.fitted.samples] + ([heard.ringing.samples] if heard.ringing else [])
    x = np.stack([sound[cut] for sound in sounds])
    spectrum, count, f0, B = np.fft.rfft(x), x.shape[-1], result.analysis.f0, result.analysis.B
    found = []
    for k in numbers:
        centre = float(partials.frequency[partials.number == k][0])
        spacing = float(np.diff(law_frequency(f0, B, np.array([k, k + 1])))[0])
        b = band(spectrum, count, rate, centre, kernel_seconds(spacing))
        time = b.time - (onset - begin) / rate
        at = np.flatnonzero((time >= 0) & (time <= min(SHOWN, (count - onset + begin) / rate - b.kernel)))
        at = at[:: max(1, len(at) // ENVELOPE_POINTS)]
        db = 20 * np.log10(np.maximum(2 * np.abs(b.values[:, at]), 1e-15))
        found.append(Envelope(k, centre, time[at], db[0], db[1], db[2] if len(db) > 2 else None))
    return tuple(found)
