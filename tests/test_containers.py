"""Containers of sound: lossless ones give the samples of a WAV, and a file that is not whole is refused."""

from __future__ import annotations

import io
import struct
import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
import soundfile as sf
from bad_files import RATE, encoded, note

from pianofit.analysis import analyse
from pianofit.errors import RecordingError
from pianofit.io.audio import LOSSY, STEPS, _Stream, decode, layout_of
from pianofit.io.containers import SOUNDS, _mp3_header, audio_of, is_sound
from pianofit.recording.recording import load_recording, recording_from_samples
from pianofit.result.warnings import mixed_format_warnings

SUBTYPES = ("PCM_16", "PCM_24", "PCM_32", "FLOAT", "DOUBLE")
LOSSLESS = [(container, subtype) for container in ("RF64", "W64", "AIFF", "CAF", "AU") for subtype in SUBTYPES]
COMPRESSED = [("OGG", "VORBIS"), ("OGG", "OPUS"), ("MP3", "MPEG_LAYER_III")]


def sound() -> np.ndarray:
    return np.stack([note(), -0.5 * note()], axis=1)


@pytest.mark.parametrize(("container", "subtype"), LOSSLESS)
def test_a_lossless_container_holds_what_a_wav_holds(container, subtype):
    expected, rate, _ = decode(encoded(sound(), "WAV", subtype))
    frames, found, kind = decode(encoded(sound(), container, subtype))
    assert np.array_equal(frames, expected)
    assert (found, kind) == (rate, subtype)


def test_bw64_is_rf64_with_another_name():
    rf64 = encoded(sound(), "RF64", "PCM_24")
    assert np.array_equal(decode(b"BW64" + rf64[4:])[0], decode(rf64)[0])


def test_the_format_of_an_aiff_may_follow_its_sound():
    data = encoded(note(), "AIFF", "PCM_16")
    begin, end = data.index(b"COMM"), data.index(b"SSND")
    chunk = data[begin : begin + 26]
    moved = data[:begin] + data[begin + 26 : end] + data[end:] + chunk
    assert np.array_equal(decode(moved)[0], decode(data)[0])


def test_skipped_chunks_take_no_memory():
    """A file may hold millions of empty chunks, each of another kind."""
    data = (
        b"RIFF"
        + bytes(4)
        + b"WAVE"
        + b"".join(struct.pack("<4sI", struct.pack("<I", kind), 0) for kind in range(20_000))
    )
    tracemalloc.start()
    with pytest.raises(RecordingError, match="no data chunk"):
        audio_of(data)
    assert tracemalloc.get_traced_memory()[1] < len(data) / 10
    tracemalloc.stop()


@pytest.mark.parametrize("container", ["WAV", "RF64", "W64", "AIFF", "CAF"])
def test_chunks_of_other_kinds_are_skipped(container):
    data = encoded(note(), container, "PCM_16")
    begin, filler = {
        "WAV": (12, struct.pack("<4sI", b"junk", 5) + bytes(6)),
        "RF64": (12 + 8 + 28, struct.pack("<4sI", b"junk", 5) + bytes(6)),
        "W64": (40, b"junk" + data[44:56] + struct.pack("<Q", 29) + bytes(8)),
        "AIFF": (12, struct.pack(">4sI", b"junk", 5) + bytes(6)),
        "CAF": (8 + 12 + 32, struct.pack(">4sq", b"junk", 5) + bytes(5)),
    }[container]
    padded = data[:begin] + filler + data[begin:]
    assert audio_of(padded) == padded
    with pytest.raises(RecordingError, match="truncated"):
        audio_of(padded[:-2])


@pytest.mark.parametrize(("container", "subtype"), [*COMPRESSED, *LOSSLESS[::5]])
def test_a_file_that_was_cut_anywhere_is_refused(container, subtype):
    rate = 24_000 if subtype == "OPUS" else RATE
    data = encoded(note(), container, subtype, rate)
    assert layout_of(data).frames >= len(note())
    cuts = np.random.default_rng(0).integers(1, len(data) - 2, 40)
    for cut in [1, 4, 11, 12, 20, 40, *cuts.tolist(), len(data) - 2]:
        with pytest.raises(RecordingError):
            audio_of(data[:cut])


@pytest.mark.parametrize(("container", "subtype"), COMPRESSED)
def test_lossy_sound_is_read_with_a_warning(tmp_path, container, subtype):
    rate = 24_000 if subtype == "OPUS" else RATE
    (tmp_path / "a.ogg").write_bytes(encoded(note(440.0, rate=rate), container, subtype, rate))
    recording = load_recording(tmp_path / "a.ogg")
    assert any(LOSSY[subtype] in warning and "lossy" in warning for warning in recording.warnings)
    f0 = analyse(recording, note="A4").f0
    assert abs(1200 * np.log2(f0 / 440.0)) < 1.0  # the pitch survives compression


def test_tags_around_an_mp3_are_not_sound():
    data = encoded(note(), "MP3")
    tag = b"ID3\x04\x00\x00\x00\x00\x01\x48" + b"\xff\xfb\x90\x00" * 50  # 200 bytes that look like frames
    tagged = tag + data + b"TAG" + bytes(125)
    assert audio_of(tagged) == audio_of(data)
    assert np.array_equal(decode(tagged)[0], decode(data)[0])


@pytest.mark.parametrize("reverse", [False, True])
@pytest.mark.parametrize(("rate", "channels"), [(44_100, 1), (44_100, 2), (22_050, 1), (8_000, 2)])
def test_an_mp3_of_variable_bit_rate_without_a_xing_header_is_read_to_its_end(rate, channels, reverse):
    """libsndfile would extrapolate its length from the first frame, whether that is large or small."""
    n = 3 * rate
    tone = 0.3 * np.sin(2 * np.pi * 440.0 / rate * np.arange(n)) * np.exp(-np.arange(n) / rate)
    noise = 0.2 * np.random.default_rng(0).standard_normal(n) * (np.arange(n) < rate)
    samples = np.stack([(tone + noise)[:: -1 if reverse else 1]] * channels, axis=1)
    stream = io.BytesIO()
    kind = {"format": "MP3", "subtype": "MPEG_LAYER_III", "bitrate_mode": "VARIABLE", "compression_level": 0.3}
    with sf.SoundFile(stream, "w", rate, channels, **kind) as file:
        file.write(samples)
    data = stream.getvalue()
    expected, _, _ = decode(data)
    size, *_ = _mp3_header(data, 0) or (0,)
    headless = data[size:]
    decoded, found, _ = decode(headless)
    assert found == rate
    assert n <= len(decoded) <= n + 5 * 1152
    best = min(range(3000), key=lambda at: np.abs(decoded[at : at + rate // 2] - expected[: rate // 2]).max())
    assert np.abs(decoded[best : best + n - 3000] - expected[: n - 3000]).max() < 1e-6
    with pytest.raises(RecordingError, match="truncated"):
        audio_of(headless[:-3])


def test_damage_within_an_mp3_is_refused_and_nothing_is_printed(capfd):
    data, draw = encoded(note(), "MP3"), np.random.default_rng(1)
    body = len(data) // 2
    spoilt = data[:body] + draw.bytes(200) + data[body + 200 :]
    with pytest.raises(RecordingError, match="damaged"):
        decode(spoilt)
    decode(data)
    assert capfd.readouterr().err == ""


def test_lossless_sound_is_read_without_a_warning(tmp_path):
    for container, subtype in LOSSLESS[::4]:
        (tmp_path / "a").write_bytes(encoded(note(), container, subtype))
        recording = load_recording(tmp_path / "a")
        assert recording.warnings == ()
        assert recording.noise_rms >= STEPS.get(subtype, 0.0) / 12**0.5


def test_recordings_of_a_key_that_differ_in_layout_are_named():
    mono, double = note(), recording_from_samples(note(rate=2 * RATE), 2 * RATE, name="/far/double.wav")
    one, stereo = (recording_from_samples(mono, RATE, name=f"/far/{name}.wav") for name in ("mono", "stereo"))
    stereo = replace(stereo, frames=np.stack([mono, mono]))
    assert mixed_format_warnings([one, one]) == []
    (channels,) = mixed_format_warnings([one, stereo])
    assert "channels (mono.wav 1, stereo.wav 2)" in channels
    (rates,) = mixed_format_warnings([one, double])
    assert f"mono.wav {RATE}" in rates
    assert "/far" not in channels + rates


def test_a_header_is_read_without_its_sound():
    layout = layout_of(encoded(sound(), "AIFF", "PCM_24"))
    assert layout == (2, RATE, len(note()), "PCM_24")


@pytest.mark.parametrize("ending", SOUNDS)
def test_endings_are_in_one_list(ending):
    assert is_sound(f"A note{ending.upper()}")
    assert not is_sound(f"note{ending}.txt")


@pytest.mark.parametrize(("offset", "whence", "astray"), [(-1, 0, True), (-5, 1, True), (-9, 2, True), (-4, 2, False)])
def test_a_seek_to_before_the_begin_is_noted_and_raises_nothing(offset, whence, astray):
    stream = _Stream(b"12345678")
    stream.read(4)
    stream.seek(offset, whence)
    assert stream.seek_before_start == astray
    assert stream.tell() == (0 if astray else 4)
