"""The bytes of a sound file become frames, or an error that says why not.

The container is checked first (`containers.py`), because libsndfile reads a file that was cut short as a shorter sound.
"""

from __future__ import annotations

import contextlib
import io
import itertools
import os
import tempfile
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from ..errors import RecordingError
from .containers import RATES, RESAVE, SOUNDS, audio_of, check_layout, is_sound, readable_formats
from .files import printable

__all__ = [
    "LOSSY", "RATES", "SOUNDS", "STEPS", "Layout", "check_layout", "decode", "is_sound", "layout_of",
    "readable_formats",
]  # fmt: skip

STEPS = {"PCM_16": 2.0**-15, "PCM_24": 2.0**-23, "PCM_32": 2.0**-31}  # of the quantiser; full scale = 1
EXACT = (*STEPS, "FLOAT", "DOUBLE")
# Subtypes of libsndfile that do not keep the sound as it was, with the name of each.
LOSSY = {"VORBIS": "Vorbis", "OPUS": "Opus", "MPEG_LAYER_III": "MP3"}


class Layout(NamedTuple):
    """The properties of a sound by the header of its file."""

    channels: int
    rate: int  # Hz
    frames: int
    subtype: str  # as libsndfile names it


class _Stream(io.BytesIO):
    """Bytes that a decoder reads. A seek to before their begin is noted, because soundfile would print a traceback."""

    astray = False

    def seek(self, offset: int, whence: int = 0) -> int:
        """Move as a file does, but never to before the begin."""
        begin = (0, self.tell(), self.getbuffer().nbytes)[whence]
        self.astray |= begin + offset < 0
        return super().seek(max(begin + offset, 0))


def decode(data: bytes) -> tuple[np.ndarray, int, str]:
    """Return frames [samples, channels], the rate in Hz, and the subtype."""
    frames, layout = _read(data, whole=True)
    if len(frames) < layout.frames:
        raise RecordingError(f"is truncated: {len(frames)} of {layout.frames} samples; copy or export it again")
    return frames, layout.rate, layout.subtype


def layout_of(data: bytes) -> Layout:
    """The layout by the header, checked as `decode` checks it; the sound itself is not decoded."""
    return _read(data, whole=False)[1]


def _read(data: bytes, whole: bool) -> tuple[np.ndarray, Layout]:
    import soundfile

    audio = audio_of(data)
    stream = _Stream(audio)
    concealed = _damage_named() if audio[:1] == b"\xff" else contextlib.nullcontext()
    try:
        with concealed, soundfile.SoundFile(stream) as file:
            if file.frames > 2**60:
                raise RecordingError("does not say how long it is (a FLAC that was streamed); encode it again")
            check_layout(file.channels, file.samplerate, file.frames)
            if file.subtype not in (*EXACT, *LOSSY):
                raise RecordingError(f"holds {file.subtype} samples, must be 16 or 24 bit; {RESAVE}")
            # Block by block [block, channels], so that a false length cannot claim memory.
            blocks = (file.read(2**18, dtype="float64", always_2d=True) for _ in itertools.count())
            frames = np.concatenate([*itertools.takewhile(len, blocks)]) if whole else np.empty((0, file.channels))
            if stream.astray:
                raise RecordingError("is damaged: its header leads to before its begin; copy or export it again")
            return frames, Layout(file.channels, file.samplerate, file.frames, file.subtype)
    except (soundfile.SoundFileError, ValueError) as problem:
        reason = printable(getattr(problem, "error_string", problem)).strip(" .")
        raise RecordingError(f"is damaged or truncated ({reason}); copy or export it again") from None


@contextlib.contextmanager
def _damage_named() -> Iterator[None]:
    """Refuse an MP3 that its decoder finds damaged: mpg123 conceals the damage, and only writes of it to stderr."""
    try:
        kept = os.dup(2)
    except OSError:  # closed
        yield
        return
    with tempfile.TemporaryFile() as said:
        os.dup2(said.fileno(), 2)
        try:
            yield
        finally:
            os.dup2(kept, 2)
            os.close(kept)
        said.seek(0)
        if b"libmpg123" in said.read():
            raise RecordingError("is damaged: the MP3 decoder cannot read a frame; copy or export it again")
