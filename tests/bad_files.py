"""Bad files, for the corpus of bad inputs: recordings and setups that their gates must refuse."""

from __future__ import annotations

import functools
import io
import os
import struct
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import soundfile

RATE = 22_050


@dataclass(frozen=True)
class BadInput:
    """One bad input; an argument that begins with @ is a path in the folder."""

    id: str
    build: Callable[[Path], None]
    args: tuple[str, ...]
    message: str
    code: int = 1
    gate: str = ""  # "recording", "setup", or "" for the command line's own

    def arguments(self, folder: Path) -> list[str]:
        """Return the command line, to follow the program's name."""
        return [f"{folder}{arg[1:]}" if arg.startswith("@") else arg for arg in self.args]

    def bad_file(self, folder: Path) -> str:
        """Return the path of the file that its gate must refuse."""
        return self.arguments(folder)[1 if self.gate == "recording" else 5]

    def is_explained_by(self, output: str) -> bool:
        """Say whether the message appears, in whatever case and however a terminal broke the line."""
        return "".join(self.message.lower().split()) in "".join(output.lower().split())


# --- sounds and files ----------------------------------------------------------------------------------------------


@functools.cache
def note(f0: float = 440.0, seconds: float = 1.0, rate: int = RATE, lead: float = 0.02) -> np.ndarray:
    """Damped partials of a slightly stiff string after a quiet lead-in, peak 0.5 [samples]."""
    rng = np.random.default_rng(1)
    t = np.arange(round(seconds * rate)) / rate
    k = np.arange(1, min(20, int(0.4 * rate / f0)) + 1)[:, None]
    sound = (np.sin(2 * np.pi * k * f0 * np.sqrt(1 + 3e-4 * k**2) * t) * np.exp(-(1 + 0.05 * k**2) * t) / k).sum(axis=0)
    sound = np.concatenate([np.zeros(round(lead * rate)), 0.5 * sound / np.abs(sound).max()])
    return sound + 1e-5 * rng.normal(size=len(sound))


def encoded(samples: np.ndarray, file_format: str = "WAV", subtype: str | None = None, rate: int = RATE) -> bytes:
    """Return a sound file's bytes."""
    stream = io.BytesIO()
    soundfile.write(stream, samples, rate, format=file_format, subtype=subtype)
    return stream.getvalue()


def wav(sound: bytes, codec: int = 1, channels: int = 1, rate: int = RATE, align: int = 0, size: int = -1) -> bytes:
    """Return a 16 bit WAV by hand, with any header."""
    align = align or channels * 2
    chunk = struct.pack("<HHIIHH", codec, channels, rate, min(rate * align, 2**32 - 1), align, 16)
    data = struct.pack("<4sI", b"data", len(sound) if size < 0 else size) + sound
    body = b"WAVE" + struct.pack("<4sI", b"fmt ", 16) + chunk + data
    return struct.pack("<4sI", b"RIFF", len(body)) + body


def pcm16(samples: np.ndarray) -> bytes:
    return (np.clip(samples, -1, 1) * 32767).astype("<i2").tobytes()


def file(name: str, content: Callable[[], bytes] | bytes) -> Callable[[Path], None]:
    """Return a builder of one file."""

    def build(folder: Path) -> None:
        (folder / name).write_bytes(content if isinstance(content, bytes) else content())

    return build


def nothing(folder: Path) -> None:
    """Build no file."""


def good(folder: Path) -> None:
    """Build good.wav, an A4 with nothing wrong."""
    (folder / "good.wav").write_bytes(encoded(note()))


def flipped(data: bytes, at: int) -> bytes:
    return data[:at] + bytes([data[at] ^ 0xFF]) + data[at + 1 :]


def set_bytes(data: bytes, at: int, values: bytes) -> bytes:
    return data[:at] + values + data[at + len(values) :]


def caf_unfinished(data: bytes) -> bytes:
    """A CAF whose sound has no length, as a recorder leaves it that lost power."""
    return set_bytes(data, data.index(b"data") + 4, b"\xff" * 8)


def mp3_frames(data: bytes) -> list[int]:
    """Where the frames of an MP3 of one rate begin."""
    return [at for at in range(len(data)) if data[at : at + 2] == data[:2]]


def sparse(folder: Path) -> None:
    """Build a file of 2 GiB that takes no room."""
    with (folder / "huge.wav").open("wb") as stream:
        stream.write(wav(b"", size=2**31 - 2**17))
        stream.truncate(2**31)


# --- audio files -----------------------------------------------------------------------------------------------------


def audio(name: str, content: Callable[[], bytes] | bytes, message: str, file_name: str = "") -> BadInput:
    """Return an entry that analyses one bad file."""
    file_name = file_name or f"{name}.wav"
    args = ("analyse", f"@/{file_name}", "--note", "A4")
    return BadInput(f"audio-{name}", file(file_name, content), args, message, gate="recording")


def special(name: str, build: Callable[[Path], None], message: str, file_name: str) -> BadInput:
    """Return an entry that fits one thing that is no ordinary file."""
    args = ("fit", f"@/{file_name}", "--note", "A4", "--out", "@/out")
    return BadInput(f"path-{name}", build, args, message, gate="recording")


def spoiled(value: float) -> bytes:
    """Return a float WAV with one sample that is no number."""
    samples = note().copy()
    samples[5000] = value
    return encoded(samples, subtype="FLOAT")


AUDIO = [
    audio("empty", b"", "is empty"),
    audio("text", b"this is not a sound\n" * 20, "is text"),
    audio("web-page", b"<!DOCTYPE html>\n<title>404 Not Found</title>", "is text"),
    audio("garbage", bytes(range(128, 256)) * 40, "unknown format"),
    audio("truncated", lambda: encoded(note())[:20_000], "truncated"),
    audio("cut-in-header", lambda: encoded(note())[:30], "fmt chunk of 10 bytes"),
    audio("riff-only", b"RIFF\x00\x00\x00\x00WAVE", "truncated"),
    audio("data-size-zero", lambda: wav(pcm16(note()), size=0), "unfinished header"),
    audio("data-size-unknown", lambda: wav(pcm16(note()), size=0xFFFFFFFF), "unfinished header"),
    audio("no-samples", wav(b""), "unfinished header"),
    audio("short-fmt", b"RIFF\x20\x00\x00\x00WAVEfmt \x04\x00\x00\x00\x01\x00\x01\x00data\x04\x00\x00\x00abcd", "fmt"),
    audio("data-before-fmt", b"RIFF\x20\x00\x00\x00WAVEdata\x04\x00\x00\x00abcd", "no fmt chunk"),
    audio("wrong-frame-size", lambda: wav(pcm16(note()), align=3), "frames of 3 bytes"),
    audio("eight-bit", lambda: encoded(note(), subtype="PCM_U8"), "8 bit PCM"),
    audio("u-law", lambda: encoded(note(), subtype="ULAW"), "u-law"),
    audio("a-law", lambda: encoded(note(), subtype="ALAW"), "A-law"),
    audio("ima-adpcm", lambda: encoded(note(), subtype="IMA_ADPCM"), "IMA ADPCM"),
    audio("ms-adpcm", lambda: encoded(note(), subtype="MS_ADPCM"), "MS ADPCM"),
    audio("gsm", lambda: encoded(note(), subtype="GSM610"), "GSM"),
    audio("unknown-codec", lambda: wav(pcm16(note()), codec=0x1234), "codec 4660"),
    audio("big-endian", b"RIFX" + bytes(100), "big-endian"),
    audio("rf64-no-ds64", lambda: encoded(note(), "RF64").replace(b"ds64", b"junk"), "no ds64"),
    audio("rf64-truncated", lambda: encoded(note(), "RF64")[:-2], "truncated"),
    audio("wave64-truncated", lambda: encoded(note(), "W64")[:-2], "truncated"),
    audio("wave64-negative-chunk", lambda: set_bytes(encoded(note(), "W64"), 56, bytes(8)), "fmt chunk of"),
    audio("mp3-no-frames", b"ID3\x03" + bytes(400), "MP3", "note.mp3"),
    audio("mp3-named-wav", b"\xff\xfb\x90\xc4" + bytes(400), "MP3"),
    audio("mp3-truncated", lambda: encoded(note(), "MP3")[:-2], "truncated", "cut.mp3"),
    audio("mp3-frames-missing", lambda: encoded(note(), "MP3")[: mp3_frames(encoded(note(), "MP3"))[-1]], "truncated"),
    audio("mp3-damaged", lambda: flipped(encoded(note(), "MP3"), mp3_frames(encoded(note(), "MP3"))[5]), "damaged"),
    audio("mpeg-layer-ii", b"\xff\xfd\x90\xc4" + bytes(400), "another layer"),
    audio("ogg-truncated", lambda: encoded(note(), "OGG")[:-2], "truncated", "note.ogg"),
    audio("ogg-no-last-page", lambda: encoded(note(), "OGG")[: encoded(note(), "OGG").rindex(b"OggS")], "truncated"),
    audio("ogg-damaged", lambda: flipped(encoded(note(), "OGG"), 5_000), "damaged", "note.ogg"),
    audio("ogg-two-streams", lambda: encoded(note(), "OGG") * 2, "several streams", "note.ogg"),
    audio("aiff-truncated", lambda: encoded(note(), "AIFF")[:-2], "truncated", "note.aiff"),
    audio("aiff-false-length", lambda: set_bytes(encoded(note(), "AIFF"), 22, b"\x7f\xff\xff\xff"), "truncated"),
    audio("aiff-rate-absurd", lambda: set_bytes(encoded(note(), "AIFF"), 28, b"\x7f\xff"), "sample rate"),
    audio("aiff-compressed", lambda: encoded(note(), "AIFF", "IMA_ADPCM"), "ima4", "note.aifc"),
    audio("au-truncated", lambda: encoded(note(), "AU")[:-2], "truncated", "note.au"),
    audio("au-length-unknown", lambda: set_bytes(encoded(note(), "AU"), 8, b"\xff" * 4), "unfinished header", "n.au"),
    audio("caf-truncated", lambda: encoded(note(), "CAF")[:-2], "truncated", "note.caf"),
    audio("caf-rate-nan", lambda: set_bytes(encoded(note(), "CAF"), 20, b"\x7f\xf8" + bytes(6)), "sample rate"),
    audio("caf-length-unknown", lambda: caf_unfinished(encoded(note(), "CAF")), "unfinished header", "note.caf"),
    audio("m4a", b"\x00\x00\x00\x20ftypM4A \x00\x00\x00\x00" + bytes(100), "M4A", "note.m4a"),
    audio("midi", b"MThd\x00\x00\x00\x06\x00\x01\x00\x01\x00\x60" + bytes(40), "MIDI", "note.mid"),
    audio("flac-truncated", lambda: encoded(note(), "FLAC")[:9_000], "truncated", "truncated.flac"),
    audio("flac-header-only", lambda: encoded(note(), "FLAC")[:42], "truncated", "header.flac"),
    audio("flac-cut-in-header", lambda: encoded(note(), "FLAC")[:20], "truncated", "cut.flac"),
    audio("flac-damaged", lambda: flipped(encoded(note(), "FLAC"), 9_000), "damaged", "damaged.flac"),
    audio("flac-eight-bit", lambda: encoded(note(), "FLAC", "PCM_S8"), "16 or 24 bit", "eight.flac"),
    audio("flac-long", lambda: encoded(np.zeros(8_000 * 660), "FLAC", rate=8_000), "at most 600", "long.flac"),
    audio("nine-channels", lambda: encoded(np.repeat(note()[:, None], 9, axis=1)), "9 channels"),
    audio("no-channels", lambda: wav(pcm16(note()), channels=0, align=2), "0 channels"),
    audio("rate-zero", lambda: wav(pcm16(note()), rate=0), "sample rate of 0 Hz"),
    audio("rate-low", lambda: wav(pcm16(note()), rate=4_000), "sample rate of 4000 Hz"),
    audio("rate-absurd", lambda: wav(pcm16(note()), rate=2_000_000_000), "sample rate of 2000000000 Hz"),
    audio("nan", lambda: spoiled(np.nan), "NaN or infinite"),
    audio("infinite", lambda: spoiled(np.inf), "NaN or infinite"),
    audio("integer-valued-floats", lambda: encoded(note() * 2.0**31, subtype="FLOAT"), "times full scale"),
    audio("silent", lambda: encoded(np.zeros(RATE)), "silent"),
    audio("constant", lambda: encoded(np.full(RATE, 0.25)), "silent"),
    audio("last-bit-only", lambda: wav(pcm16(np.arange(RATE) % 2 / 32767)), "silent"),
    audio("noise-only", lambda: encoded(0.1 * np.random.default_rng(2).normal(size=RATE)), "above its noise"),
    audio("channels-cancel", lambda: encoded(np.stack([note(), -note()], axis=1)), "cancel"),
    audio("clipped-beyond-use", lambda: encoded(np.clip(50 * note(), -1, 1)), "clipped beyond use"),
    audio("sixty-milliseconds", lambda: encoded(note()[:1323]), "lasts 60.0 ms; at least 80 ms are needed"),
    audio("ten-milliseconds", lambda: encoded(note()[:220]), "lasts 10.0 ms"),
    audio("onset-at-the-end", lambda: encoded(note(seconds=0.03, lead=0.5)), "after its onset"),
    audio("name-with-newline", b"hello", "a\\nb.wav", "a\nb.wav"),
    audio("name-with-escape", b"hello", "\\x1b[31mred.wav", "\x1b[31mred.wav"),
    audio("name-with-html", b"hello", "<img src=x onerror=alert(1)>.wav", "<img src=x onerror=alert(1)>.wav"),
]
PATHS = [
    special("missing", nothing, "no such file", "missing.wav"),
    special("missing-folder", nothing, "no such file", "nowhere/note.wav"),
    special("folder", lambda folder: (folder / "note.wav").mkdir(), "is a folder", "note.wav"),
    special("file-as-folder", good, "cannot be read", "good.wav/note.wav"),
    special("loop", lambda folder: (folder / "loop.wav").symlink_to("loop.wav"), "cannot be read", "loop.wav"),
    special("dangling", lambda folder: (folder / "dangling.wav").symlink_to("gone"), "no such file", "dangling.wav"),
    special("name-too-long", nothing, "cannot be read", "n" * 300 + ".wav"),
    special("pipe", lambda folder: os.mkfifo(folder / "pipe.wav"), "pipe or a device", "pipe.wav"),
    special("device", lambda folder: (folder / "zero.wav").symlink_to("/dev/zero"), "pipe or a device", "zero.wav"),
    special("two-gibibytes", sparse, "MiB", "huge.wav"),
]

# --- setup.toml ------------------------------------------------------------------------------------------------------


def setup(name: str, given: str | bytes | Callable[[Path], None], message: str) -> BadInput:
    """Return an entry that fits a good recording with a bad setup."""
    build = given if callable(given) else file("setup.toml", given.encode() if isinstance(given, str) else given)
    args = ("fit", "@/good.wav", "--note", "A4", "--setup", "@/setup.toml", "--out", "@/out")
    return BadInput(f"setup-{name}", lambda folder: (good(folder), build(folder)), args, message, gate="setup")


SETUPS = [
    setup("missing", nothing, "no such file"),
    setup("folder", lambda folder: (folder / "setup.toml").mkdir(), "is a folder"),
    setup("empty", "", "is empty"),
    setup("not-utf8", b'[pickup]\nquantity = "v\xe9locity"\n', "line 2 is not UTF-8"),
    setup("syntax", "[string]\nlength 1.0\n", "line 2"),
    setup("twice", "[string]\nlength = 1.0\nlength = 2.0\n", "line 3"),
    setup("nested", "a = " + "[" * 20_000, "not valid TOML"),
    setup("long-integer", "[string]\nlength = " + "9" * 5_000 + "\n", "not valid TOML"),
    setup("unknown-table", "[strings]\nlength = 1.0\n", "did you mean string?"),
    setup("key-outside-table", "length = 1.0\n", "belongs in [string]"),
    setup("unknown-key", "[string]\nlenght = 1.0\n", "did you mean length?"),
    setup("key-in-wrong-table", "[string]\nposition = 0.1\n", "belongs in [strike] or [pickup]"),
    setup("unknown-parameter", "[fixed]\nx0 = 0.1\n", "allowed: c, kappa"),
    setup("parameter-case", "[initial]\nk_h = 1e9\n", "did you mean K_H?"),
    setup("table-is-number", "string = 1.0\n", "[string]"),
    setup(
        "single-recording",
        '[recording]\nfile = "a.wav"\n',
        "must be a list; begin each entry with a line [[recording]]",
    ),
    setup("unit-in-text", '[string]\nlength = "1 m"\n', "no quotes"),
    setup("boolean", "[string]\nlength = true\n", "length = True"),
    setup("date", "[string]\nmass = 2024-01-01\n", "mass"),
    setup("not-a-number", "[string]\nlength = nan\n", "length = nan"),
    setup("infinite", "[string]\nmass = inf\n", "mass = inf"),
    setup("centimetres", "[string]\nlength = 62\n", "length = 62 must be a number from 0.01 to 5 m"),
    setup("grams", "[string]\nmass = 6.18\n", "1 kg"),
    setup("hammer-in-grams", "[fixed]\nM_H = 6.79\n", "M_H = 6.79"),
    setup("negative", "[fixed]\nb1 = -0.5\n", "b1 = -0.5"),
    setup("zero-velocity", "[fixed]\nv_H0 = 0\n", "v_H0 = 0"),
    setup("huge-integer", f"[fixed]\nK_H = {10**400}\n", "K_H"),
    setup("quantity", '[pickup]\nquantity = "acceleration"\n', "acceleration"),
    setup("no-position", '[pickup]\nquantity = "velocity"\n', "needs a position"),
    setup("position-unused", "[pickup]\nposition = 0.3\n", "no meaning"),
    setup("scale-with-pressure", '[pickup]\nquantity = "pressure"\nscale = 2.0\n', "scale = 2 has no meaning"),
    setup("scale-zero", '[pickup]\nquantity = "bridge-force"\nscale = 0\n', "scale = 0"),
    setup("pickup-off-string", '[string]\nlength = 1\n[pickup]\nquantity = "velocity"\nposition = 1.5\n', "not on"),
    setup("strike-off-string", "[string]\nlength = 1.0\n[strike]\nposition = 1.2\n", "past the string length"),
    setup("window-past-agraffe", "[strike]\nposition = 0.01\nwidth = 0.03\n", "past the agraffe"),
    setup(
        "window-past-bridge",
        "[string]\nlength = 1\n[strike]\nposition = 0.99\nwidth = 0.03\n",
        "past the string length",
    ),
    setup("window-zero", "[strike]\nposition = 0.12\nwidth = 0.0\n", "width = 0.0"),
    setup(
        "stroke-two-velocities",
        '[[recording]]\nfile = "a.wav"\nstroke = "L4"\ngroup = "close"\nv_H0 = 2.0\n'
        '[[recording]]\nfile = "b.wav"\nstroke = "L4"\ngroup = "room"\nv_H0 = 3.0\n',
        "one stroke has one velocity",
    ),
    setup(
        "stroke-one-group",
        '[[recording]]\nfile = "a.wav"\nstroke = "L4"\ngroup = "close"\n'
        '[[recording]]\nfile = "b.wav"\nstroke = "L4"\ngroup = "close"\n',
        'both have group = "close"',
    ),
    setup(
        "stroke-no-group",
        '[[recording]]\nfile = "a.wav"\nstroke = "L4"\n[[recording]]\nfile = "b.wav"\nstroke = "L4"\n',
        "neither has a group",
    ),
    setup("stroke-number", '[[recording]]\nfile = "a.wav"\nstroke = 4\n', "stroke = 4 must be a text"),
    setup("bounds-one-number", "[bounds]\nK_H = [1e9]\n", "two numbers"),
    setup("bounds-number", "[bounds]\nK_H = 1e9\n", "two numbers"),
    setup("bounds-reversed", "[bounds]\nK_H = [1e12, 1e8]\n", "lower must be below upper"),
    setup("bounds-outside", "[bounds]\np = [0.5, 3.0]\n", "p = 0.5"),
    setup("initial-outside-bounds", "[initial]\nc = 310\n[bounds]\nc = [200, 300]\n", "outside its [bounds]"),
    setup("fixed-and-initial", "[fixed]\nv_H0 = 1\n[initial]\nv_H0 = 1\n", "and in [initial]"),
    setup("fixed-and-bounds", "[fixed]\nv_H0 = 1\n[bounds]\nv_H0 = [1, 2]\n", "and in [bounds]"),
    setup("recording-empty", "[[recording]]\n", "is empty"),
    setup("recording-file-number", "[[recording]]\nfile = 3\n", "file = 3"),
    setup("recording-twice", '[[recording]]\nfile = "a.wav"\n[[recording]]\nfile = "a.wav"\n', "twice"),
    setup("recording-and-fixed-velocity", "[fixed]\nv_H0 = 1\n[[recording]]\nv_H0 = 2\n", "also in [fixed]"),
    setup("recording-outside-bounds", "[bounds]\nv_H0 = [1, 2]\n[[recording]]\nv_H0 = 3\n", "outside its [bounds]"),
]
