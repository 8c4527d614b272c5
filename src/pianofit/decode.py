"""The bytes of a WAV or FLAC file become frames, or an error that says why not.

Two things libsndfile would let through are read from the bytes here: a WAV whose header promises more sound than the
file holds, and codecs that throw sound away.
"""

from __future__ import annotations

import io
import itertools
import struct

import numpy as np

from .errors import RecordingError
from .io import one_line

__all__ = ["RATES", "STEPS", "check_layout", "decode"]

RATES = (8_000, 384_000)  # Hz
MAX_VALUES = 2**27  # samples times channels: 1 GiB of float64
MAX_SECONDS = 600.0
RESAVE = "save it as WAV (PCM 16, 24, 32 or float) or FLAC"
CODECS = {1: "PCM", 2: "MS ADPCM", 3: "float", 6: "A-law", 7: "u-law", 17: "IMA ADPCM", 49: "GSM", 85: "MP3"}
WAV_FORMATS = {(1, 16), (1, 24), (1, 32), (3, 32), (3, 64)}  # (codec, bits)
STEPS = {"PCM_16": 2.0**-15, "PCM_24": 2.0**-23, "PCM_32": 2.0**-31}  # of the quantiser; full scale = 1
MAGIC = {
    b"OggS": "an OGG file", b"FORM": "an AIFF file", b".snd": "an AU file", b"caff": "a CAF file",
    b"riff": "a Wave64 file", b"RF64": "an RF64 file", b"BW64": "a BW64 file", b"RIFX": "a big-endian WAV file",
    b"ID3\x03": "an MP3 file", b"ID3\x04": "an MP3 file", b"MThd": "a MIDI file", b"wvpk": "a WavPack file",
}  # fmt: skip


def decode(data: bytes) -> tuple[np.ndarray, int, str]:
    """Return frames [samples, channels], the rate in Hz, and the subtype."""
    import soundfile

    if data[:4] == b"RIFF" and data[8:12] == b"WAVE":
        _check_wav(data)
    elif data[:4] != b"fLaC":
        raise RecordingError(f"is {_guess(data)}, not WAV or FLAC; {RESAVE}")
    try:
        with soundfile.SoundFile(io.BytesIO(data)) as file:
            if file.frames > 2**60:
                raise RecordingError("does not say how long it is (a FLAC that was streamed); encode it again")
            check_layout(file.channels, file.samplerate, file.frames)
            if file.format == "FLAC" and file.subtype not in STEPS:
                raise RecordingError(f"holds {file.subtype} samples, must be 16 or 24 bit; {RESAVE}")
            # Block by block [block, channels], so that a false length cannot claim memory.
            blocks = (file.read(2**18, dtype="float64", always_2d=True) for _ in itertools.count())
            frames = np.concatenate([*itertools.takewhile(len, blocks)])
            promised, rate, subtype = file.frames, file.samplerate, file.subtype
    except (soundfile.SoundFileError, ValueError) as problem:
        reason = one_line(getattr(problem, "error_string", problem)).strip(" .")
        raise RecordingError(f"is damaged or truncated ({reason}); copy or export it again") from None
    if len(frames) < promised:
        raise RecordingError(f"is truncated: {len(frames)} of {promised} samples; copy or export it again")
    return frames, rate, subtype


def check_layout(channels: int, rate: int, frames: int) -> None:
    """Refuse channels, a rate in Hz or a number of frames that no recording of a note has."""
    if not 1 <= channels <= 8:
        raise RecordingError(f"has {channels} channels, must have 1 to 8; export the microphone of the note alone")
    if not (RATES[0] <= rate <= RATES[1] and rate == int(rate)):
        raise RecordingError(f"has a sample rate of {rate} Hz, must be {RATES[0]} to {RATES[1]}; resample it")
    if frames == 0:
        raise RecordingError("holds no samples; export it again")
    limit = min(MAX_SECONDS, MAX_VALUES / channels / rate)
    if frames > limit * rate:
        raise RecordingError(f"lasts {frames / rate:.1f} s, must be at most {limit:.1f} s; cut out one note")


def _check_wav(data: bytes) -> None:
    """Walk the chunks up to the sound, and compare what they promise with what is there."""
    position, has_format = 12, False
    while position + 8 <= len(data):
        kind, size = struct.unpack_from("<4sI", data, position)
        body = position + 8
        if kind == b"fmt ":
            _check_wav_format(data[body : body + size])
            has_format = True
        elif kind == b"data":
            held = len(data) - body
            if not has_format:
                raise RecordingError("has no fmt chunk before its sound; export it again")
            if size == 0 or size >= 0x7FFF0000:  # empty, written by a pipe, or by a recorder that lost power
                raise RecordingError(f"has an unfinished header (data size {size}, {held} bytes follow); {RESAVE}")
            if size > held:
                raise RecordingError(f"is truncated: {held} of {size} bytes of sound are there; copy it again")
            return
        position = body + size + size % 2
    raise RecordingError("is truncated: it ends before its sound (no data chunk); copy or export it again")


def _check_wav_format(chunk: bytes) -> None:
    if len(chunk) < 16:
        raise RecordingError(f"has a fmt chunk of {len(chunk)} bytes, must be at least 16; export it again")
    codec, channels, rate, _, align, bits = struct.unpack_from("<HHIIHH", chunk)
    if codec == 0xFFFE and len(chunk) >= 40:  # WAVE_FORMAT_EXTENSIBLE: the codec opens the sub-format's GUID
        (codec,) = struct.unpack_from("<H", chunk, 24)
    if (codec, bits) not in WAV_FORMATS:
        raise RecordingError(f"holds {bits} bit {CODECS.get(codec, f'codec {codec}')} sound; {RESAVE}")
    check_layout(channels, rate, 1)
    if align != channels * bits // 8:
        raise RecordingError(f"has frames of {align} bytes for {channels} channels of {bits} bit; export it again")


def _guess(data: bytes) -> str:
    """Name what a file that is neither WAV nor FLAC seems to be."""
    if data[:4] in MAGIC:
        return MAGIC[data[:4]]
    if data[4:8] == b"ftyp":
        return "an MP4 or M4A file"
    if data[0] == 0xFF and data[1:2] and data[1] & 0xE0 == 0xE0:
        return "an MP3 or AAC file"
    text = data[:200].decode(errors="ignore")  # the last letter may be cut in two
    if len(text.encode()) > len(data[:200]) - 4 and all(c.isprintable() or c in "\t\r\n" for c in text):
        return f'text (it begins "{one_line(text[:20])}")'
    return f"of an unknown format (it begins with bytes {data[:4].hex()})"
