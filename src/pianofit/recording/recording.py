"""The one gate for audio: a sound file, or an array, becomes a `Recording`, or an error that says why not.

Everything past this gate may rely on it: mono float64, finite, not silent, with its onset, offset, noise floor and
clipping measured.
"""

from __future__ import annotations

import hashlib
import math
import os
from collections.abc import Sequence
from dataclasses import dataclass
from numbers import Real

import numpy as np

from ..errors import ParameterError, RecordingError, check_type
from ..io.audio import LOSSY, STEPS, check_layout, decode, is_sound, layout_of, readable_formats
from ..io.files import printable, read_file, short_repr
from ..io.number_format import counted
from .onset import find_sounds, forward_mean, without_drift

__all__ = [
    "INSIDE",
    "Recording",
    "Source",
    "to_recording",
    "check_channel",
    "is_sound",
    "layout_of",
    "load_recording",
    "load_recordings",
    "readable_formats",
    "recording_from_samples",
]

CHANNELS = ("average", "left", "right", *"12345678")
MAX_BYTES = 2**30
INSIDE = 0.05  # the first sample over the peak: a note that was cut into begins with a step
MIN_SECONDS = 0.08  # after the onset: two periods of the lowest key
LEAD_SECONDS = 0.05  # before it: a shorter lead-in does not show the noise
CANCELS = 4.0  # 6 dB; inverting channels of spaced microphones gains less than 5 dB, of a reversed one more
LOST = 0.01  # of the channels' energy; an average below it holds only the differences between the channels
FLAT = 3  # samples; the shortest run at an extreme that counts as cut off
CUT = 0.25  # of the largest sample; a lower extreme is the edge of a one-sided wave
DITHER = 2.5  # steps; triangular dither spreads a cut-off top over two, and half a step covers rounding
SHARP = 4.0  # spreads by which the slope must lead past the top; unclipped notes reach 2.3
NAMED_SILENCE = 0.1  # s; longer digital silence at the end of a file is reported


@dataclass(frozen=True, eq=False, repr=False)
class Recording:
    """One struck note, as every later step sees it."""

    samples: np.ndarray  # float64 [samples], mono, offset removed, ±1 = digital full scale
    frames: np.ndarray  # float64 [channels, samples], of the channels that `samples` is the mean of, likewise
    rate: int  # Hz
    onset: int  # index of the first sample of the attack
    noise_rms: float  # of the noise floor, full scale = 1
    dc: float  # the offset removed, full scale = 1
    clipped: int  # samples in flat runs (3 or more) at an extreme where the wave was cut off, at any level
    path: str
    sha256: str  # of the file's bytes
    channels: int  # in the file
    channel: str  # "mono", "average", "left", "right", "3" ...
    subtype: str  # "PCM_16" ..., as libsndfile names it
    warnings: tuple[str, ...]

    @property
    def seconds(self) -> float:
        """Length of the whole recording, s."""
        return len(self.samples) / self.rate

    def __repr__(self) -> str:
        return (
            f"Recording {printable(self.path)}: {self.seconds:.2f} s at {self.rate} Hz, {self.channel} ({self.subtype})"
        )


# What a recording is given as.
Source = str | os.PathLike[str] | tuple[np.ndarray, int] | Recording


def load_recordings(recordings: Sequence[Source], channel: str = "average") -> list[Recording]:
    """Recordings from files, from arrays with their rates, and as they are.

    Raises `RecordingError` for a sound that cannot be used; `ParameterError` for what is no recording, or another
    channel.
    """
    return [to_recording(source, channel, f"recording {at}") for at, source in enumerate(recordings, 1)]


def to_recording(source: Source, channel: str = "average", name: str = "recording") -> Recording:
    """One of them; `name` is what messages call an array."""
    if isinstance(source, Recording):
        return source
    if isinstance(source, str | os.PathLike):
        return load_recording(source, channel=channel)
    if isinstance(source, tuple) and len(source) == 2:
        return recording_from_samples(*source, name=name)
    raise ParameterError(
        f"{name} = {short_repr(source)} must be a path, a Recording, or (samples, rate); give each as an argument of its own"
    )


def load_recording(path: str | os.PathLike[str], *, channel: str = "average") -> Recording:
    """Read a sound file of 8 to 384 kHz and 1 to 8 channels.

    WAV, AIFF, Wave64, RF64, CAF and AU hold PCM of 16, 24 or 32 bit, or floats; FLAC holds 16 or 24 bit. OGG Vorbis,
    Opus and MP3 are read with a warning, because lossy compression alters decays and weak partials.

    Parameters
    ----------
    path : of the file.
    channel : "average", "left", "right", or the channel's number, "1" to "8".

    Returns
    -------
    A `Recording`: samples [samples], ±1 = full scale, rate in Hz, onset and noise floor.

    Raises
    ------
    RecordingError
        Naming the file, what is wrong with it, and the way out.
    ParameterError
        When `channel` is none of the above.

    Examples
    --------
    >>> import pathlib, numpy as np, pianofit
    >>> _ = pathlib.Path("tone.wav").write_bytes(pianofit.encode_wav(np.sin(np.arange(44_100) / 30), 44_100))
    >>> pianofit.load_recording("tone.wav")
    Recording tone.wav: 1.00 s at 44100 Hz, mono (FLOAT)
    """
    check_channel(channel)
    data = read_file(path, MAX_BYTES, RecordingError)
    try:
        frames, rate, subtype = decode(data)
        used, chosen = _choose(frames, channel)
        facts = {"sha256": hashlib.sha256(data).hexdigest(), "channels": frames.shape[1], "subtype": subtype}
        return _measure(used, rate, STEPS.get(subtype, 0.0), path=os.fspath(path), channel=chosen, **facts)
    except RecordingError as error:
        raise RecordingError(f"{printable(os.fspath(path))}: {error}") from None


def check_channel(channel: str) -> None:
    """Refuse by a `ParameterError` what is no channel of a file."""
    if not (isinstance(channel, str) and channel in CHANNELS):
        raise ParameterError(f"channel={printable(channel)!r} must be average, left, right, or a number from 1 to 8")


def recording_from_samples(samples: np.ndarray, rate: int, *, name: str = "samples") -> Recording:
    """Make a `Recording` of an array; the same checks as a file's.

    Parameters
    ----------
    samples : real floats [samples], ±1 = full scale.
    rate : Hz, 8,000 to 384,000.
    name : what messages call it.

    Returns
    -------
    A `Recording`, as `load_recording` makes it.

    Raises
    ------
    RecordingError
        Naming `name`, what is wrong, and the way out.

    Examples
    --------
    >>> import numpy as np, pianofit
    >>> pianofit.recording_from_samples(np.sin(np.arange(44_100) / 30), 44_100, name="a tone").seconds
    1.0
    """
    check_type("rate=", rate, Real, "a number of Hz, such as 44100")
    array, name = np.asarray(samples), printable(name)
    if array.ndim != 1:
        raise RecordingError(f"{name}: shape {array.shape} must be [samples]; choose or average the channels first")
    if not np.issubdtype(array.dtype, np.floating):
        raise RecordingError(f"{name}: {array.dtype} samples must be floats; divide them by their full scale")
    array = array.astype(np.float64)
    facts = {"sha256": hashlib.sha256(array.tobytes()).hexdigest(), "channels": 1, "subtype": "DOUBLE"}
    try:
        check_layout(1, rate, len(array))
        return _measure(array[:, None], int(rate), 0.0, path=name, channel="mono", **facts)
    except RecordingError as error:
        raise RecordingError(f"{name}: {error}") from None


def _choose(frames: np.ndarray, channel: str) -> tuple[np.ndarray, str]:
    """Return the frames of the channels to average [samples, chosen], and what to call them."""
    count = frames.shape[1]
    if channel == "average":
        return frames, "mono" if count == 1 else "average"
    number = {"left": 1, "right": 2}.get(channel) or int(channel)
    if number > count:
        raise RecordingError(f"has {counted(count, 'channel')}, so channel={channel!r} must be 1 to {count}")
    return frames[:, number - 1 : number], "mono" if count == 1 else channel


def _measure(used: np.ndarray, rate: int, step: float, **facts) -> Recording:
    """Make the recording of the channels `used` [samples, chosen], quantised in steps of `step`."""
    mono, warnings = _audible(used, rate, step), _opposite(used, rate)
    # Digital silence at the end is neither the note's decay nor the room's noise.
    end = int(np.flatnonzero(used.any(axis=1))[-1]) + 1
    silence, used, mono = len(used) - end, used[:end], mono[:end]
    *earlier, onset = find_sounds(mono - _offset(mono), rate, step)
    dc = _offset(max(mono[:onset], mono[onset:], key=len))
    samples = mono - dc
    noise = _noise_rms(samples, onset, rate)
    if len(samples) - onset < MIN_SECONDS * rate:
        left = 1000 * (len(samples) - onset) / rate
        raise RecordingError(f"ends {left:.1f} ms after its onset; at least {1000 * MIN_SECONDS:g} ms are needed")
    clipped, cut = _clipping(used, onset, rate, step)
    warnings += cut
    if earlier:
        before = (onset - earlier[0]) / rate
        warnings += (
            f"a sound begins {before:.2f} s before the note and is not analysed; cut the file there if it is the note",
        )
    if onset == 0 and abs(samples[0]) > INSIDE * np.abs(samples).max():
        warnings += ("the file begins inside the note: the onset is its first sample, and the attack is incomplete",)
    if silence > NAMED_SILENCE * rate:
        warnings += (f"{silence / rate:.2f} s of digital silence at its end were left out",)
    if codec := LOSSY.get(facts["subtype"]):
        warnings += (f"{codec} is lossy compression, which alters decay rates and weak partials",)
    if abs(dc) > 0.01:
        warnings += (f"an offset of {dc:.3g} of full scale was removed",)
    frames = samples[None] if used.shape[1] == 1 else np.stack([x - _offset(x) for x in used.T])
    for held in (samples, frames):
        held.setflags(write=False)
    return Recording(samples, frames, rate, onset, max(noise, step / 12**0.5), dc, clipped, warnings=warnings, **facts)


def _audible(used: np.ndarray, rate: int, step: float) -> np.ndarray:
    """Return the mean of the channels [samples]; refuse what holds no sound."""
    if not np.isfinite(used).all():
        bad = int(np.argmin(np.isfinite(used).all(axis=1)))
        raise RecordingError(f"has a NaN or infinite sample at {bad / rate:.4f} s; export it again")
    if np.abs(used).max() > 1e6:
        raise RecordingError(f"reaches {np.abs(used).max():.3g} times full scale; scale it to within ±1")
    if len(used) < MIN_SECONDS * rate:
        raise RecordingError(f"lasts {1000 * len(used) / rate:.1f} ms; at least {1000 * MIN_SECONDS:g} ms are needed")
    mono, flat = used.mean(axis=1), max(1e-9, 2 * step)
    if np.ptp(mono) <= flat and np.ptp(used, axis=0).max() <= 2 * flat:
        raise RecordingError(f"is silent (peak to peak {np.ptp(mono):.2g} of full scale); record it again")
    return mono


def _opposite(used: np.ndarray, rate: int) -> tuple[str, ...]:
    """Report channels of `used` [samples, channels] that are opposite in phase to the others, so that they cancel.

    The signs of the strongest principal component add the channels up. An average of far less energy than theirs
    with these signs cancels. One of less than a hundredth of the channels' own energy is not the note.
    """
    if used.shape[1] == 1:
        return ()
    covariance = np.cov([without_drift(column, rate) for column in used.T])
    channels, average = len(covariance), float(covariance.mean())
    _, directions = np.linalg.eigh(covariance)
    sign = np.where(directions[:, -1] < 0, -1, 1)
    if sign.sum() < 0 or (sign.sum() == 0 and sign[0] < 0):  # fewer channels, or the second of two, are opposite
        sign = -sign
    added = float(sign @ covariance @ sign) / channels**2
    if average * CANCELS >= added:
        return ()
    own = float(np.trace(covariance)) / channels
    loss = 10 * math.log10(own / max(average, 1e-30 * own))
    numbers = ", ".join(str(i + 1) for i in np.flatnonzero(sign < 0))
    words = (
        f"channel {numbers} is opposite in phase to the others: their average is {loss:.1f} dB weaker than they "
        f"are; choose one with --channel, or invert channel {numbers}"
    )
    if average < LOST * own:
        raise RecordingError(f"its channels cancel when averaged: {words}")
    return (words,)


def _offset(x: np.ndarray) -> float:
    """Mean under a Hann window: it takes 4π²/(ωT)³ of a partial ω in, a plain one 1/(ωT), 750 times more at 27.5 Hz."""
    window = np.hanning(len(x) + 2)[1:-1]
    return float(window @ x / window.sum())


def _noise_rms(x: np.ndarray, onset: int, rate: int) -> float:
    """Return the rms of the noise: of the lead-in above 20 Hz, or of the quietest second where there is none."""
    floor = _quiet_floor(x, rate)
    loudest = math.sqrt(forward_mean(x * x, round(0.02 * rate)).max())
    # 6 dB; plain noise varies by less than 1 dB. In a short file the partials of a low note fill the spectrum.
    if loudest < 2 * floor and len(x) > 0.5 * rate:
        raise RecordingError(f"nothing stands above its noise (rms {loudest:.2g}, noise {floor:.2g}); record it again")
    lead = x[: onset - round(0.001 * rate)] if onset > LEAD_SECONDS * rate else x[:1]
    if np.ptp(lead) == 0:  # none, or padded with zeros, which tells nothing
        return floor
    power = forward_mean(without_drift(lead, rate) ** 2, round(0.01 * rate))
    return math.sqrt(np.median(power))  # a median: a knock does not count


def _quiet_floor(x: np.ndarray, rate: int) -> float:
    """Return the rms of the noise under the quietest second, where partials may still ring.

    Partials are narrow: a running median over 100 Hz of the spectrum passes under them. The median of a noise
    spectrum's exponential distribution is ln 2 of its mean.
    """
    from scipy.ndimage import median_filter

    length = min(len(x), rate)
    starts = {*range(0, len(x) - length, length // 2), len(x) - length}
    frames = [f for s in sorted(starts) if np.ptp(f := x[s : s + length]) > 0]
    quietest = min(frames, key=lambda f: float(np.var(f)))
    window = np.hanning(length)
    power = np.abs(np.fft.rfft(quietest * window)) ** 2 / (window @ window)
    smooth = median_filter(power, max(round(100 * length / rate), 11))
    return math.sqrt(float(smooth.mean()) / math.log(2))


def _clipping(used: np.ndarray, onset: int, rate: int, step: float) -> tuple[int, tuple[str, ...]]:
    """Count the clipped samples of all channels used; a note that is mostly flat raises."""
    rest = [column - _offset(column) for column in used.T]
    runs = np.concatenate([_flat_runs(sign * column, step) for column in rest for sign in (1, -1)])
    if len(runs) == 0:
        return 0, ()
    lengths, first = runs[:, 1] - runs[:, 0], runs[:, 0].min() / rate
    early = lengths[(runs[:, 0] >= onset) & (runs[:, 0] < onset + 0.5 * rate)].sum()
    if early > 0.1 * used.shape[1] * min(0.5 * rate, len(used) - onset):
        raise RecordingError(f"is clipped beyond use: {early} samples of its first 0.5 s; record it with less gain")
    return int(lengths.sum()), (
        f"clipped: {lengths.sum()} samples are cut off, from {first:.3f} s; record it with less gain",
    )


def _flat_runs(y: np.ndarray, step: float) -> np.ndarray:
    """Return [runs, 2] the start and stop of the runs in which `y` was cut off at its highest value.

    A later gain moves the highest value to any level, and dither spreads it over two steps. A slow, unclipped wave also
    rests on its highest quantised value for some samples. It comes to rest there; a clipped wave arrives with a slope
    that would have carried it on by many steps.
    """
    top, spread = y.max(), DITHER * step
    if top < CUT * np.abs(y).max():
        return np.zeros((0, 2), int)
    runs = np.flatnonzero(np.diff(np.concatenate([[0], (y >= top - spread).astype(np.int8), [0]]))).reshape(-1, 2)
    runs = runs[runs[:, 1] - runs[:, 0] >= FLAT]
    if len(runs) == 0:
        return runs
    values = np.unique(y[y > 0.5 * top])
    sharp = SHARP * (spread + max(step, float(np.diff(values).min(initial=top))))
    padded = np.pad(y, 2, constant_values=top)  # a run that touches an end is judged by its other side
    start, stop = runs[:, 0] + 2, runs[:, 1] + 2
    entering = 2 * padded[start - 1] - padded[start - 2] - top
    leaving = 2 * padded[stop] - padded[stop + 1] - top
    return runs if np.any(np.maximum(entering, leaving) > sharp) else runs[:0]  # one ceiling for all runs
