"""Decodes the bytes of a sound file to frames, or raises an error with the reason.

The container is checked first (`containers.py`), because libsndfile reads a truncated file as a shorter sound.
"""

import contextlib
import io
import itertools
import os
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ..errors import RecordingError
from .containers import RESAVE, audio_of, check_layout
from .files import printable, read_file

STEPS = {"PCM_16": 2.0**-15, "PCM_24": 2.0**-23, "PCM_32": 2.0**-31}  # quantiser steps; full scale = 1
LARGEST_SAMPLE = 1e6  # full scale = 1; a file of floats above it has another unit
EXACT = (*STEPS, "FLOAT", "DOUBLE")
# Subtypes of libsndfile with lossy compression, and their names.
LOSSY = {"VORBIS": "Vorbis", "OPUS": "Opus", "MPEG_LAYER_III": "MP3"}


class Layout(NamedTuple):
    """The properties of a sound from the header of its file."""

    channels: int
    rate: int  # Hz
    frames: int
    subtype: str  # the name in libsndfile


class Longest(NamedTuple):
    """The longest sound that is read."""

    seconds: float
    values: int  # samples times channels
    hint: str


ONE_NOTE = Longest(600.0, 2**27, "cut out one note")  # 1 GiB of float64


class _Stream(io.BytesIO):
    """Bytes for a decoder. A seek before their beginning is recorded, because an exception would print a traceback."""

    seek_before_start = False

    def seek(self, offset: int, whence: int = 0) -> int:
        """Seek as in a file, but never before the beginning."""
        origin = (0, self.tell(), self.getbuffer().nbytes)[whence]
        self.seek_before_start |= origin + offset < 0
        return super().seek(max(origin + offset, 0))


def decode(data: bytes, longest: Longest = ONE_NOTE) -> tuple[np.ndarray, int, str]:
    """Return frames [samples, channels], the rate in Hz, and the subtype."""
    frames, layout = _read(data, True, longest)
    if len(frames) < layout.frames:
        raise RecordingError(f"is truncated: {len(frames)} of {layout.frames} samples; copy or export it again")
    return frames, layout.rate, layout.subtype


def decode_file(path: Path, limit: int, longest: Longest = ONE_NOTE) -> tuple[np.ndarray, int, str]:
    """Read a file of at most `limit` bytes and `decode` it, with `check_samples`. Errors begin with the file."""
    data = read_file(path, limit, RecordingError)
    try:
        decoded = decode(data, longest)
        check_samples(*decoded[:2])
        return decoded
    except RecordingError as error:
        raise RecordingError(f"{printable(path)}: {error}") from None


def check_length(channels: int, rate: float, frames: int, longest: Longest = ONE_NOTE) -> None:
    """Raise a `RecordingError` if the channels, the rate in Hz or the number of frames are out of range."""
    check_layout(channels, rate)
    if frames == 0:
        raise RecordingError("holds no samples; export it again")
    limit = min(longest.seconds, longest.values / channels / rate)
    if frames > limit * rate:
        raise RecordingError(f"lasts {frames / rate:.1f} s, must be at most {limit:.1f} s; {longest.hint}")


def check_samples(frames: np.ndarray, rate: int) -> None:
    """Raise a `RecordingError` for samples [samples, channels] that are not finite, or far above full scale."""
    if not np.isfinite(frames).all():
        first = int(np.argmin(np.isfinite(frames).all(axis=1)))
        raise RecordingError(f"has a NaN or infinite sample at {first / rate:.4f} s; export it again")
    if (peak := max(frames.max(initial=0.0), -frames.min(initial=0.0))) > LARGEST_SAMPLE:  # without a copy
        raise RecordingError(f"reaches {peak:.3g} times full scale; scale it to within ±1")


def layout_of(data: bytes) -> Layout:
    """Return the layout from the header, with the checks of `decode`, but without decoding the sound."""
    return _read(data, False, ONE_NOTE)[1]


def _read(data: bytes, with_frames: bool, longest: Longest) -> tuple[np.ndarray, Layout]:
    import soundfile

    audio = audio_of(data)
    stream = _Stream(audio)
    damage_check = _mp3_damage_check() if audio[:1] == b"\xff" else contextlib.nullcontext()
    try:
        with damage_check, soundfile.SoundFile(stream) as file:
            if file.frames > 2**60:
                raise RecordingError("has no length in its header (a streamed FLAC); encode it again")
            check_length(file.channels, file.samplerate, file.frames, longest)
            if file.subtype not in (*EXACT, *LOSSY):
                raise RecordingError(f"holds {file.subtype} samples, must be 16 or 24 bit; {RESAVE}")
            # Block by block [block, channels], so that a false length does not allocate memory.
            blocks = (file.read(2**18, dtype="float64", always_2d=True) for _ in itertools.count())
            frames = (
                np.concatenate([*itertools.takewhile(len, blocks)]) if with_frames else np.empty((0, file.channels))
            )
            if stream.seek_before_start:
                raise RecordingError("is damaged: its header points before its beginning; copy or export it again")
            return frames, Layout(file.channels, file.samplerate, file.frames, file.subtype)
    except (soundfile.SoundFileError, ValueError) as problem:
        reason = printable(getattr(problem, "error_string", problem)).strip(" .")
        raise RecordingError(f"is damaged or truncated ({reason}); copy or export it again") from None


@contextlib.contextmanager
def _mp3_damage_check() -> Iterator[None]:
    """Raise if the MP3 decoder reports damage: mpg123 conceals it and only writes a message to stderr."""
    try:
        stderr = os.dup(2)
    except OSError:  # closed
        yield
        return
    with tempfile.TemporaryFile() as messages:
        os.dup2(messages.fileno(), 2)
        try:
            yield
        finally:
            os.dup2(stderr, 2)
            os.close(stderr)
        messages.seek(0)
        if b"libmpg123" in messages.read():
            raise RecordingError("is damaged: the MP3 decoder cannot read a frame; copy or export it again")
