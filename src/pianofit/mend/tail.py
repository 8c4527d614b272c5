"""The tail of a recording, continued by the modes of its key.

The modes of a key decay as its fit says. How loud each is, and in which phase, is measured in the recording itself, in
the last seconds that are still above the noise. There the recording fades into its own continuation. Both have the same
phases, so that neither level nor slope changes.

The joint is the latest time at which no fade is detected. A file that somebody has faded out falls faster than the
modes of its key. The joint can lie within the first half of a fade. Where noise prevails, it lies earlier as well.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ..dsp.bands import Bands, fast_length
from ..dsp.common_poles import Signals, fit_amplitudes
from ..dsp.damped_sums import powers, sum_damped_modes
from ..modal_response import partial_band
from ..model.modal_response import ModalResponse
from ..model.note import Note

# Time before the joint in which amplitudes are measured, s. Modes of one partial differ by some tenths of a hertz.
MEASURED = 1.5
# Shortest such time, s, and its earliest start after the onset: before, the attack and the knock still sound.
LEAST_MEASURED, EARLIEST = 0.5, 0.15
# Length of the crossfade before the joint, s: several periods of the lowest partial, and short against the decay.
CROSSFADE = 0.2
# Step between the joints that are tried, s.
STEP = 0.1
# Largest difference of level, dB, and of slope, dB/s, between a recording and its continuation. A step of 1 dB is just
# audible. A slope measured over a second is uncertain by about this much where few partials are left.
LARGEST_STEP, LARGEST_SLOPE = 1.0, 4.0
# A recording is faded out if the median of its partials falls by so much, dB, below their modes: within the last third
# of the measured time, or in the last frames. A linear fade of one second falls by 8 and 20 dB.
FADED_LAST, FADED_END = 2.0, 3.0
# Once a fade is seen, its start is where this share of the fall is left.
START_OF_FADE = 0.25
# The last frames, s.
LAST = 0.1
# A partial counts if it exceeds the noise next to it by this factor.
ABOVE_NOISE = 2.0
# Ratio of the rms of noise to the median of its magnitude (Rayleigh).
RMS_OF_MEDIAN = 1.2
# Averaging time of envelopes, s.
ENVELOPE = 0.06
# Largest frequency of a partial relative to that in the modes of its key: a constant, Hz, and two cents. Layers of a
# key differ in pitch.
OFFSET, RELATIVE_OFFSET = 0.1, 1.2e-3
# Frequencies are tried in steps of this share of a period of the measured time.
PHASE_STEP = 0.1
# Factors of a partial's decay rates that are tried: range and number; and the standard deviation of their logarithms.
# Chosen on three pianos: the median of benchmarks/mend.py is 0.83 dB with 0.1, and 0.89 dB with 0.2.
DECAY_FACTORS, DECAY_SD = (0.25, 4.0, 41), 0.1
# Partials of a string without measured modes. Higher ones have decayed before any joint.
STRING_PARTIALS = 60
# A continued sound ends where its level falls below this, dB re full scale, and fades over this share of its length.
SILENT_DB, FADE = -100.0, 0.05


class PartialModes(NamedTuple):
    """Modes of one partial of a key."""

    pole: np.ndarray  # complex, 1/s [modes]
    frequency: float  # Hz
    spacing: float  # Hz, to the nearest other partial


class Continuation(NamedTuple):
    """How a recording goes on after its joint."""

    joint: int  # sample
    pole: np.ndarray  # complex, 1/s [modes]
    amplitude: np.ndarray  # at the joint, complex [channels, modes]
    step_db: float  # level of the recording over that of the modes, before the joint
    slope_db: float  # the same of their slopes, dB/s


class _Band(NamedTuple):
    """A partial in a recording."""

    modes: PartialModes
    bands: Bands
    noise: np.ndarray  # rms magnitude of the noise [channels]


def modes_of_key(note: Note) -> list[PartialModes]:
    """Return the modes of a key by partial: measured ones, or those of its string if none were measured."""
    if note.modal_response is not None:
        return _grouped(note.modal_response)
    number = np.arange(1, STRING_PARTIALS + 1)
    hz, length = note.frequencies(STRING_PARTIALS), note.geometry.length
    rate = note.string.b1 + note.string.b2 * (number * np.pi / length) ** 2
    poles = -np.asarray(rate) + 2j * np.pi * hz
    return [PartialModes(pole[None], float(f), float(note.f0)) for pole, f in zip(poles, hz, strict=True)]


def _grouped(response: ModalResponse) -> list[PartialModes]:
    numbers = np.unique(response.partial)
    poles = [response.pole[response.partial == number] for number in numbers]
    hz = np.array([float(np.imag(pole).mean()) / (2 * np.pi) for pole in poles])
    if len(hz) < 2:
        return [PartialModes(pole, f, f) for pole, f in zip(poles, hz, strict=True)]
    gaps = np.diff(hz)
    spacing = np.minimum(np.r_[gaps[:1], gaps], np.r_[gaps, gaps[-1:]])
    return [PartialModes(pole, float(f), float(s)) for pole, f, s in zip(poles, hz, spacing, strict=True)]


def continue_by_modes(sound: np.ndarray, rate: int, onset: int, modes: Sequence[PartialModes]) -> Continuation | str:
    """Find the latest joint of a recording and its modes there, or say why there is none.

    Parameters
    ----------
    sound : recording [channels, samples].
    rate : Hz.
    onset : sample of the onset.
    modes : of the key.
    """
    ringing = sound[:, onset:]
    seconds = ringing.shape[-1] / rate
    first = EARLIEST + LEAST_MEASURED
    if seconds < first:
        return f"it rings for {seconds:.2f} s; at least {first:.2f} s are needed"
    bands = _bands(ringing, rate, modes)
    if not bands:
        return "no partial of its key lies below half of its sample rate"
    tolerance = 1.0
    for joint in np.arange(seconds, first, -STEP):
        parts = [found for band in bands if (found := _partial_at(band, float(joint))) is not None]
        if not parts:
            continue  # noise alone
        if _falls(parts) > tolerance:
            tolerance = START_OF_FADE
            continue
        found = _joined(parts, float(joint))
        if abs(found.step_db) > LARGEST_STEP or abs(found.slope_db) > LARGEST_SLOPE:
            return (
                f"at {joint:.1f} s its level differs by {found.step_db:+z.1f} dB and its slope by "
                f"{found.slope_db:+z.1f} dB/s from the modes of its key"
            )
        return found._replace(joint=onset + round(float(joint) * rate))
    return "it is noise, or faded out, from the start"


def lengthen(sound: np.ndarray, rate: int, onset: int, seconds: float, by: Continuation) -> np.ndarray:
    """Return the recording with its continuation, up to `seconds` after the onset [channels, samples]."""
    fade = min(round(CROSSFADE * rate), by.joint)
    begin, end = by.joint - fade, onset + round(seconds * rate)
    start = by.amplitude * np.exp(-by.pole * (fade / rate))
    tail = sum_damped_modes(by.pole, start, rate, max(end - begin, fade))
    weight = 0.5 - 0.5 * np.cos(np.pi * (np.arange(fade) + 0.5) / fade)
    tail[:, :fade] = weight * tail[:, :fade] + (1 - weight) * sound[:, begin : by.joint]
    whole = np.concatenate([sound[:, :begin], tail], axis=-1)
    return end_in_silence(whole, by.joint)


def end_in_silence(sound: np.ndarray, least: int) -> np.ndarray:
    """Cut a sound [channels, samples] where it becomes silent, after `least` samples, and fade out its end."""
    loud = np.flatnonzero(np.abs(sound).max(axis=0) > 10 ** (SILENT_DB / 20))
    sound = sound[:, : max(int(loud.max(initial=0)) + 1, least)].copy()
    fade = min(max(round(FADE * sound.shape[-1]), 2), sound.shape[-1] - least)
    sound[:, sound.shape[-1] - fade :] *= 0.5 + 0.5 * np.cos(np.pi * np.arange(1, fade + 1) / max(fade, 1))
    return sound


def _bands(ringing: np.ndarray, rate: int, modes: Sequence[PartialModes]) -> list[_Band]:
    """Bands of the partials below half of the rate."""
    size = fast_length(ringing.shape[-1])
    spectrum, seconds = np.fft.rfft(ringing, size), ringing.shape[-1] / rate
    found = []
    for own in modes:
        if own.frequency + own.spacing > rate / 2:
            continue
        band = partial_band(spectrum, size, rate, own.frequency, own.spacing)
        beside = partial_band(spectrum, size, rate, own.frequency + own.spacing / 2, own.spacing)
        late = beside.frames_within(0.8 * seconds, seconds - beside.window / 2)
        found.append(_Band(own, band, RMS_OF_MEDIAN * np.median(np.abs(beside.z[:, late]), axis=-1)))
    return found


class _Partial(NamedTuple):
    """A partial before a joint. Energies are those of the first and last third, and of the last frames [3]."""

    pole: np.ndarray  # of its continuation, complex, 1/s [modes]
    amplitude: np.ndarray  # at the joint, complex [channels, modes]
    recorded: np.ndarray
    expected: np.ndarray  # by the decay of the key's modes
    continued: np.ndarray  # by the decay of its continuation


def _falls(parts: Sequence[_Partial]) -> float:
    """How far the end of a recording falls below the modes of its key, relative to what counts as a fade."""
    # A fade acts on all partials alike, and beats do not. So the median shows it.
    difference = [10 * np.log10(part.recorded / part.expected) for part in parts]
    _, last, end = np.median(difference, axis=0)
    return float(max(-last / FADED_LAST, -end / FADED_END))


def _joined(parts: Sequence[_Partial], joint: float) -> Continuation:
    """Continuation at a joint, s after the onset."""
    recorded, continued = (np.sum([getattr(p, name) for p in parts], axis=0) for name in ("recorded", "continued"))
    first, last, _ = 10 * np.log10(recorded / continued)
    slope = float(last - first) / ((joint - max(joint - MEASURED, EARLIEST)) * 2 / 3)
    poles, amplitudes = [part.pole for part in parts], [part.amplitude for part in parts]
    return Continuation(0, np.concatenate(poles), np.concatenate(amplitudes, axis=-1), float(last), slope)


def _partial_at(band: _Band, joint: float) -> _Partial | None:
    """Continuation of a partial; None if it does not exceed the noise."""
    b = band.bands
    frames = b.frames_within(max(joint - MEASURED, EARLIEST) + b.window / 2, joint - b.window / 2, least=6)
    z, time = b.z[:, frames], b.time[frames]
    third, last = max(len(time) // 3, 1), max(round(LAST / b.step), 1)
    if (np.sqrt((np.abs(z[:, -third:]) ** 2).mean(axis=-1)) < ABOVE_NOISE * band.noise).all():
        return None
    signals = Signals(z, 1 / (_envelope(z, b.step) + band.noise[:, None] + 1e-30), b.step)
    turn = 2j * np.pi * float(b.centre)
    tuned = _in_tune(band.modes.pole - turn, signals, b)
    pole, own = _with_decay(tuned, signals, b)
    at_joint = 2 * own / b.gain(pole) * np.exp(pole * (joint - time[0]) + turn * joint)

    def energies(values: np.ndarray) -> np.ndarray:
        power = np.sum(np.abs(values) ** 2, axis=0)
        return np.array([power[:third].sum(), power[-third:].sum(), power[-last:].sum()])

    # The modes of a partial would follow a fade, so that its end takes no part here.
    begin = Signals(z[:, :-third], signals.weight[:, :-third], b.step)
    expected = fit_amplitudes(tuned, begin) @ powers(tuned * b.step, len(time))
    continued = own @ powers(pole * b.step, len(time))
    return _Partial(pole + turn, at_joint, energies(z), energies(expected), energies(continued))


def _envelope(z: np.ndarray, step: float) -> np.ndarray:
    """Smoothed magnitude of signals [channels, frames]."""
    width = min(max(round(ENVELOPE / step), 1), z.shape[-1])
    kernel = np.ones(width)
    count = np.convolve(np.ones(z.shape[-1]), kernel, "same")
    return np.sqrt(np.array([np.convolve(np.abs(row) ** 2, kernel, "same") / count for row in z]))


def _in_tune(relative: np.ndarray, signals: Signals, b: Bands) -> np.ndarray:
    """Poles of a partial moved by the one frequency that fits best."""
    reach, duration = OFFSET + RELATIVE_OFFSET * float(b.centre), signals.step * signals.values.shape[-1]
    steps = int(np.ceil(reach * duration / PHASE_STEP))
    poles = relative + 2j * np.pi * np.linspace(-reach, reach, 2 * steps + 1)[:, None]
    return poles[np.argmin(_errors(poles, signals)[0])]


def _with_decay(pole: np.ndarray, signals: Signals, b: Bands) -> tuple[np.ndarray, np.ndarray]:
    """Poles with their decay rates times the most probable factor, and their amplitudes [channels, modes]."""
    log_factor = np.log(np.geomspace(*DECAY_FACTORS))
    poles = pole + np.real(pole) * np.expm1(log_factor)[:, None]
    error, amplitude = _errors(poles, signals)
    # Twice the negative log posterior of complex samples, of which the band has `noise_width` a second.
    independent = signals.values.size * signals.step * b.noise_width
    best = np.argmin(2 * independent * np.log(error) + (log_factor / DECAY_SD) ** 2)
    return poles[best], amplitude[best]


def _errors(poles: np.ndarray, signals: Signals) -> tuple[np.ndarray, np.ndarray]:
    """Sums of squares that sets of poles [sets, modes] leave, and their amplitudes [sets, channels, modes]."""
    amplitude = fit_amplitudes(poles, signals)
    modelled = amplitude @ powers(poles * signals.step, signals.values.shape[-1])
    return np.sum(np.abs((signals.values - modelled) * signals.weight) ** 2, axis=(-2, -1)) + 1e-300, amplitude
