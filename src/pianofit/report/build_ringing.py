"""How the note rings, recorded and played: envelopes of partials, levels over time and frequency, decays and beats."""

from __future__ import annotations

import numpy as np

from ..analysis import law_frequency
from ..inference import Result
from ..model.decay import partial_decays
from ..ringing import HEARD, band, kernel_seconds, mel_edges, mel_power
from .curves import Envelope, RingingCurves

__all__ = ["envelopes_of", "ringing_curves"]

# Partials whose envelopes are shown.
PARTIALS = 6
# How long after the onset, s, and how much more of a sound is cut at both ends, for the windows.
SHOWN = 3.0
MORE = 0.2
# Points of an envelope, which is smoother than they are apart.
POINTS = 400
# Window, s, and mel bands of the picture over time and frequency: between a knock's time and a partial's width.
WINDOW, BANDS = 0.09, 96


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
        for x in (recording.samples, heard.played.samples)
    )
    frames = time <= max(min(SHOWN, time[-1] - WINDOW), 0.0)  # one at the least, of a very short recording
    time, one, other = time[frames], one[frames], other[frames]
    floor = max(float(one.max()), 1e-30) * 10 ** (-HEARD / 10)
    return RingingCurves(
        envelopes_of(result, _strongest(result)), time, mel_edges(n, BANDS, recording.rate)[1:-1],
        10 * np.log10(one + floor).T, 10 * np.log10(other + floor).T,
        () if ringing is None else tuple(partial_decays(ringing)),
    )  # fmt: skip


def _strongest(result: Result) -> list[int]:
    """Numbers of the strongest partials, rising."""
    number = result.reference.partials.number
    return sorted(number[np.argsort(result.reference.level)[-PARTIALS:]].tolist())


def envelopes_of(result: Result, numbers: list[int]) -> tuple[Envelope, ...]:
    """The envelopes of these partials of the reference, of the mean of its channels: recorded, by law, as it rings."""
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
        at = at[:: max(1, len(at) // POINTS)]
        db = 20 * np.log10(np.maximum(2 * np.abs(b.values[:, at]), 1e-15))
        found.append(Envelope(k, centre, time[at], db[0], db[1], db[2] if len(db) > 2 else None))
    return tuple(found)
