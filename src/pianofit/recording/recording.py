"""Reads all audio: a sound file or an array becomes a `Recording`, or raises an error with the reason.

A `Recording` is mono float64, finite and not silent. Its onset, offset, noise floor and clipping are measured.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Sequence
from dataclasses import dataclass
from numbers import Real

import numpy as np

from ..errors import ParameterError, RecordingError, check_type
from ..io.audio import LOSSY, STEPS, check_length, check_samples, decode
from ..io.files import printable, read_file, short_repr
from .measurements import checked_channel, count_clipped, noise_rms, offset, opposite_channels, select_channels
from .onset import find_sounds

MAX_BYTES = 2**30
MAX_FIRST_SAMPLE = 0.05  # first sample over the peak, above which the file begins inside the note, with a step
MIN_SECONDS = 0.08  # after the onset; two periods of the lowest key
REPORTED_SILENCE = 0.1  # s; longer digital silence at the end of a file is reported


@dataclass(frozen=True, eq=False, repr=False)
class Recording:
    """One struck note, checked and measured."""

    samples: np.ndarray  # float64 [samples], mono, offset removed, ±1 = digital full scale
    frames: np.ndarray  # float64 [channels, samples], the channels whose mean is `samples`, each without offset
    rate: int  # Hz
    onset: int  # index of the first sample of the attack
    noise_rms: float  # rms of the noise floor, full scale = 1
    dc: float  # offset that was removed, full scale = 1
    clipped: int  # samples in flat runs (3 or more) at an extreme where the wave was clipped, at any level
    path: str
    sha256: str  # of the file's bytes
    channels: int  # number of channels in the file
    channel: str  # "mono", "average", "left", "right", "3" ...
    subtype: str  # "PCM_16" ..., the name in libsndfile
    warnings: tuple[str, ...]

    @property
    def seconds(self) -> float:
        """Length of the whole recording, s."""
        return len(self.samples) / self.rate

    def has_sound_of(self, other: Recording) -> bool:
        """Return true if both hold the same samples, possibly in files of different formats."""
        # The offset differs in all other recordings, and is compared faster.
        return (self.rate, self.dc) == (other.rate, other.dc) and np.array_equal(self.samples, other.samples)

    def __repr__(self) -> str:
        return (
            f"Recording {printable(self.path)}: {self.seconds:.2f} s at {self.rate} Hz, {self.channel} ({self.subtype})"
        )


# The forms in which a recording can be given.
Source = str | os.PathLike[str] | tuple[np.ndarray, int] | Recording


def load_recordings(recordings: Sequence[Source], channel: str | int = "average") -> list[Recording]:
    """Convert paths and (samples, rate) to recordings; items that are recordings are returned unchanged.

    Raises `RecordingError` for a sound that cannot be used, and `ParameterError` for another type or channel.
    """
    checked_channel(channel)
    return [to_recording(source, channel, f"recording {at}") for at, source in enumerate(recordings, 1)]


def to_recording(source: Source, channel: str | int = "average", name: str = "recording") -> Recording:
    """Convert one source to a recording; messages use `name` for an array."""
    if isinstance(source, Recording):
        return source
    if isinstance(source, str | os.PathLike):
        return load_recording(source, channel=channel)
    if isinstance(source, tuple) and len(source) == 2:
        return recording_from_samples(*source, name=name)
    raise ParameterError(
        f"{name} = {short_repr(source)} must be a path, a Recording, or (samples, rate); give each separately"
    )


def load_recording(path: str | os.PathLike[str], *, channel: str | int = "average") -> Recording:
    """Read a sound file of 8 to 384 kHz and 1 to 8 channels.

    WAV, AIFF, Wave64, RF64, CAF and AU hold PCM of 16, 24 or 32 bit, or floats; FLAC holds 16 or 24 bit. OGG Vorbis,
    Opus and MP3 are read with a warning, because lossy compression changes decay rates and weak partials.

    Parameters
    ----------
    path : path of the file.
    channel : "average", "left", "right", or the number of a channel, 1 to 8.

    Returns
    -------
    A `Recording`: samples [samples], ±1 = full scale, rate in Hz, onset and noise floor.

    Raises
    ------
    RecordingError
        If the file cannot be used. The message names the file, the reason and a remedy.
    ParameterError
        If `channel` is none of the above.

    Examples
    --------
    >>> import pathlib, numpy as np, pianofit
    >>> _ = pathlib.Path("tone.wav").write_bytes(pianofit.encode_wav(np.sin(np.arange(44_100) / 30), 44_100))
    >>> pianofit.load_recording("tone.wav")
    Recording tone.wav: 1.00 s at 44100 Hz, mono (FLOAT)
    """
    channel = checked_channel(channel)
    data = read_file(path, MAX_BYTES, RecordingError)
    try:
        frames, rate, subtype = decode(data)
        used, name = select_channels(frames, channel)
        info = {"sha256": hashlib.sha256(data).hexdigest(), "channels": frames.shape[1], "subtype": subtype}
        return _measure(used, rate, STEPS.get(subtype, 0.0), path=os.fspath(path), channel=name, **info)
    except RecordingError as error:
        raise RecordingError(f"{printable(os.fspath(path))}: {error}") from None


def recording_from_samples(samples: np.ndarray, rate: int, *, name: str = "samples") -> Recording:
    """Make a `Recording` from an array, with the checks that files pass.

    Parameters
    ----------
    samples : real floats [samples], ±1 = full scale.
    rate : Hz, 8,000 to 384,000.
    name : name of the array in messages.

    Returns
    -------
    A `Recording`, as `load_recording` makes it.

    Raises
    ------
    RecordingError
        If the samples cannot be used. The message states `name`, the reason and a remedy.

    Examples
    --------
    >>> import numpy as np, pianofit
    >>> pianofit.recording_from_samples(np.sin(np.arange(44_100) / 30), 44_100, name="a tone").seconds
    1.0
    """
    check_type("rate=", rate, Real, "a number in Hz, such as 44100")
    array, name = np.asarray(samples), printable(name)
    if array.dtype.kind not in "iuf":
        raise RecordingError(f"{name}: samples are {array.dtype}; give an array of floats")
    if array.ndim != 1:
        raise RecordingError(f"{name}: shape {array.shape} must be [samples]; choose or average the channels first")
    if not np.issubdtype(array.dtype, np.floating):
        raise RecordingError(f"{name}: {array.dtype} samples must be floats; divide them by their full scale")
    array = array.astype(np.float64)
    info = {"sha256": hashlib.sha256(array.tobytes()).hexdigest(), "channels": 1, "subtype": "DOUBLE"}
    try:
        check_length(1, rate, len(array))
        return _measure(array[:, None], int(rate), 0.0, path=name, channel="mono", **info)
    except RecordingError as error:
        raise RecordingError(f"{name}: {error}") from None


def _measure(used: np.ndarray, rate: int, step: float, **info) -> Recording:
    """Make the recording of the channels `used` [samples, selected], quantised in steps of `step`."""
    mono, warnings = _checked_mean(used, rate, step), opposite_channels(used, rate)
    # Digital silence at the end is not part of the decay, nor is it the noise of the room.
    end = int(np.flatnonzero(used.any(axis=1))[-1]) + 1
    silence, used, mono = len(used) - end, used[:end], mono[:end]
    *earlier, onset = find_sounds(mono - offset(mono), rate, step)
    if len(mono) - onset < MIN_SECONDS * rate:
        remaining = 1000 * (len(mono) - onset) / rate
        raise RecordingError(f"ends {remaining:.1f} ms after its onset; at least {1000 * MIN_SECONDS:g} ms are needed")
    dc = offset(max(mono[:onset], mono[onset:], key=len))
    samples = mono - dc
    noise = noise_rms(samples, onset, rate)
    clipped, clipping_warnings = count_clipped(used, onset, rate, step)
    warnings += clipping_warnings
    if earlier:
        before = (onset - earlier[0]) / rate
        warnings += (f"a sound {before:.2f} s before the note is not analysed; if it is the note, cut the file there",)
    if onset == 0 and abs(samples[0]) > MAX_FIRST_SAMPLE * np.abs(samples).max():
        warnings += ("the file begins inside the note: the onset is its first sample, and the attack is incomplete",)
    if silence > REPORTED_SILENCE * rate:
        warnings += (f"{silence / rate:.2f} s of digital silence at the end were removed",)
    if codec := LOSSY.get(info["subtype"]):
        warnings += (f"{codec} is lossy compression, which changes decay rates and weak partials",)
    if abs(dc) > 0.01:
        warnings += (f"an offset of {dc:.3g} of full scale was removed",)
    frames = samples[None] if used.shape[1] == 1 else np.stack([x - offset(x) for x in used.T])
    for array in (samples, frames):
        array.setflags(write=False)
    return Recording(samples, frames, rate, onset, max(noise, step / 12**0.5), dc, clipped, warnings=warnings, **info)


def _checked_mean(used: np.ndarray, rate: int, step: float) -> np.ndarray:
    """Return the mean of the channels [samples]; raise if they hold no sound."""
    check_samples(used, rate)
    if len(used) < MIN_SECONDS * rate:
        raise RecordingError(f"lasts {1000 * len(used) / rate:.1f} ms; at least {1000 * MIN_SECONDS:g} ms are needed")
    mono, flat = used.mean(axis=1), max(1e-9, 2 * step)
    if np.ptp(mono) <= flat and np.ptp(used, axis=0).max() <= 2 * flat:
        raise RecordingError(f"is silent (peak to peak {np.ptp(mono):.2g} of full scale); record it again")
    return mono
