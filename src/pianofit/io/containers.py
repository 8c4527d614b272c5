"""Checks of sound containers: each header is compared with the bytes that follow it, before the file is decoded.

libsndfile reads a truncated file as a shorter sound. A recording of a decaying note must be complete. Therefore all
chunks, pages or frames of a container must be complete, and must hold as much sound as the header states.
"""

import struct
import zlib
from collections.abc import Callable
from typing import NamedTuple

from ..errors import RecordingError
from .files import printable

# Suffixes of supported files, with the name of each format. All other lists of suffixes are derived from this one.
SOUNDS = {
    ".wav": "WAV",
    ".flac": "FLAC",
    ".aif": "AIFF",
    ".aiff": "AIFF",
    ".aifc": "AIFF",
    ".w64": "Wave64",
    ".rf64": "RF64",
    ".bw64": "RF64",
    ".caf": "CAF",
    ".au": "AU",
    ".snd": "AU",
    ".ogg": "OGG",
    ".oga": "OGG",
    ".opus": "OGG",
    ".mp3": "MP3",
}
RATES = (8_000, 384_000)  # Hz
RESAVE = "save it as WAV (PCM 16, 24, 32 or float) or FLAC"
# Largest valid size of a data chunk with a 32 bit length, bytes. Recorders write a larger one until the end.
LARGEST_CHUNK = 0x7FFF0000
CODECS = {1: "PCM", 2: "MS ADPCM", 3: "float", 6: "A-law", 7: "u-law", 17: "IMA ADPCM", 49: "GSM", 85: "MP3"}
PCM, FLOAT = "PCM", "float"
EXACT = {(PCM, 16), (PCM, 24), (PCM, 32), (FLOAT, 32), (FLOAT, 64)}  # (codec, bits) without loss
AIFC_CODECS = {
    b"NONE": PCM,
    b"twos": PCM,
    b"sowt": PCM,
    b"in24": PCM,
    b"in32": PCM,
    b"fl32": FLOAT,
    b"FL32": FLOAT,
    b"fl64": FLOAT,
    b"FL64": FLOAT,
}
AU_CODECS = {3: (PCM, 16), 4: (PCM, 24), 5: (PCM, 32), 6: (FLOAT, 32), 7: (FLOAT, 64)}
W64_TAIL = {
    b"riff": "2e91cf11a5d628db04c10000",
    b"wave": "f3acd3118cd100c04f8edb8a",
}  # last bytes of GUIDs; all other chunks as wave
OTHERS = {
    b"RIFX": "a big-endian WAV file",
    b"MThd": "a MIDI file",
    b"wvpk": "a WavPack file",
    b"MAC ": "a Monkey's Audio file",
    b"\x30\x26\xb2\x75": "a WMA file",
    b"ADIF": "an AAC file",
}
OGG_PAGE = struct.Struct("<4sBBqIIIB")
OGG_BEGIN, OGG_END = 2, 4  # flags of the first and last page of a stream
REVERSED = bytes(int(f"{byte:08b}"[::-1], 2) for byte in range(256))
# MPEG audio layer III: kbit/s by index, for version 1 and for versions 2 and 2.5; sample rates of version 1 in Hz.
MP3_KBITS = (
    (0, 32, 40, 48, 56, 64, 80, 96, 112, 128, 160, 192, 224, 256, 320),
    (0, 8, 16, 24, 32, 40, 48, 56, 64, 80, 96, 112, 128, 144, 160),
)
MP3_RATES = (44_100, 48_000, 32_000)
MP3_XING_KBITS = 9  # index of the bit rate of an added Xing frame


class Chunks(NamedTuple):
    """The layout of a container's chunks."""

    head: struct.Struct  # kind and size of a chunk
    begin: int  # offset of the first chunk, bytes
    align: int  # bytes
    counted: int = 0  # bytes of the head that are included in the size


RIFF = Chunks(struct.Struct("<4sI"), 12, 2)
FORM = Chunks(struct.Struct(">4sI"), 12, 2)
W64 = Chunks(struct.Struct("<16sQ"), 40, 8, 24)
CAF = Chunks(struct.Struct(">4sq"), 8, 1)
Place = tuple[int, int]  # offset and size of the content of a chunk, bytes


def is_sound(name: str) -> bool:
    """True if the suffix of a file name belongs to a supported format."""
    return name.lower().endswith(tuple(SOUNDS))


def readable_formats() -> str:
    """The supported formats, for messages and help texts."""
    *first, last = dict.fromkeys(SOUNDS.values())
    return f"{', '.join(first)} or {last}"


def audio_of(data: bytes) -> bytes:
    """Check the container of a file and return the part to decode.

    Raises `RecordingError` for an unsupported format or codec, and for an incomplete file.
    """
    kind = _kind(data)
    if kind is None:
        raise RecordingError(f"is {_guess(data)}; {RESAVE}")
    return kind(data)


def check_layout(channels: int, rate: float) -> None:
    """Raise a `RecordingError` if the channels or the rate in Hz are out of range."""
    if not 1 <= channels <= 8:
        raise RecordingError(f"has {channels} channels, must have 1 to 8; export the microphone of the note alone")
    if not (RATES[0] <= rate <= RATES[1] and rate == int(rate)):
        raise RecordingError(f"has a sample rate of {rate:.15g} Hz, must be {RATES[0]} to {RATES[1]}; resample it")


def _kind(data: bytes) -> Callable[[bytes], bytes] | None:
    """The function that checks this container; None for an unsupported format."""
    if data[:4] in (b"RIFF", b"RF64", b"BW64") and data[8:12] == b"WAVE":
        return _wav
    if data[:4] == b"FORM" and data[8:12] in (b"AIFF", b"AIFC"):
        return _aiff
    if data[:16] == _guid(b"riff") and data[24:40] == _guid(b"wave"):
        return _wave64
    if data[:4] == b"fLaC":
        return lambda flac: flac
    if _mp3_header(data, 0) or data[:3] == b"ID3":
        return _mp3
    return {b"caff": _caf, b".snd": _au, b"OggS": _ogg}.get(data[:4])


# --- chunks ----------------------------------------------------------------------------------------------------------


def _chunks(data: bytes, layout: Chunks, *wanted: bytes) -> dict[bytes, Place]:
    """The first chunk of each of the `wanted` kinds. All others are skipped, because a file may have millions."""
    chunks: dict[bytes, Place] = {}
    position = layout.begin
    while position + layout.head.size <= len(data) and len(chunks) < len(wanted):
        kind, size = layout.head.unpack_from(data, position)
        position, size = position + layout.head.size, size - layout.counted
        if kind in wanted:
            chunks.setdefault(kind, (position, size))
        if size < 0:
            break
        position += size + -size % layout.align
    return chunks


def _wav(data: bytes) -> bytes:
    """Check WAV, RF64 and BW64. The last two have lengths of 64 bits in a separate chunk."""
    long = [b"ds64"] * (data[:4] != b"RIFF")
    chunks = _chunks(data, RIFF, *long, b"fmt ", b"data")
    largest = LARGEST_CHUNK
    if long and b"data" in chunks:
        begin, size = chunks.get(b"ds64", (0, 0))
        if size < 16 or begin + size > len(data):
            raise RecordingError("has no ds64 chunk with its length; export it again")
        if chunks[b"data"][1] == 2**32 - 1:
            chunks[b"data"] = chunks[b"data"][0], struct.unpack_from("<Q", data, begin + 8)[0]
            largest = 2**63
    _check_wave(data, chunks.get(b"fmt "), chunks.get(b"data"), largest)
    return b"RF64" + data[4:] if data[:4] == b"BW64" else data  # the two have the same layout


def _wave64(data: bytes) -> bytes:
    chunks = _chunks(data, W64, _guid(b"fmt "), _guid(b"data"))
    _check_wave(data, chunks.get(_guid(b"fmt ")), chunks.get(_guid(b"data")), 2**63)
    return data


def _guid(kind: bytes) -> bytes:
    return kind + bytes.fromhex(W64_TAIL.get(kind, W64_TAIL[b"wave"]))


def _check_wave(data: bytes, layout: Place | None, sound: Place | None, largest: int) -> None:
    """Check the format chunk and the sound chunk of a WAV. The size of the sound must be below `largest`."""
    if layout is not None:
        _check_wave_format(data[layout[0] : sum(layout)])
    elif sound is not None:
        raise RecordingError("has no fmt chunk before its sound; export it again")
    _check_sound(data, sound, "data", largest)


def _check_wave_format(chunk: bytes) -> None:
    if len(chunk) < 16:
        raise RecordingError(f"has a fmt chunk of {len(chunk)} bytes, must be at least 16; export it again")
    codec, channels, rate, _, align, bits = struct.unpack_from("<HHIIHH", chunk)
    if codec == 0xFFFE and len(chunk) >= 40:  # WAVE_FORMAT_EXTENSIBLE: the sub-format GUID begins with the codec
        (codec,) = struct.unpack_from("<H", chunk, 24)
    _check_format(CODECS.get(codec, f"codec {codec}"), bits, channels, rate, align)


def _check_format(codec: str, bits: int, channels: int, rate: float, align: int | None = None) -> None:
    if (codec, bits) not in EXACT:
        raise RecordingError(f"holds {f'{bits} bit ' if bits else ''}{codec} sound; {RESAVE}")
    check_layout(channels, rate)
    if align not in (None, channels * bits // 8):
        raise RecordingError(f"has frames of {align} bytes for {channels} channels of {bits} bit; export it again")


def _check_sound(data: bytes, sound: Place | None, name: str, largest: int = 2**63, stated: int = 0) -> None:
    """Compare the size of the sound with the bytes in the file, and with the size `stated` elsewhere."""
    if sound is None:
        raise RecordingError(f"is truncated: it ends before its sound (no {name} chunk); copy or export it again")
    begin, size = sound
    available = max(0, len(data) - begin)
    if not 0 < size < largest:  # empty, written by a pipe, or by a recorder that lost power
        raise RecordingError(f"has an unfinished header (data size {size}, {available} bytes follow); {RESAVE}")
    expected, complete = max(size, stated), min(available, size)
    if expected > complete:
        raise RecordingError(f"is truncated: it holds {complete} of {expected} bytes of sound; copy it again")


def _aiff(data: bytes) -> bytes:
    """Check AIFF and AIFC. The format chunk may follow the sound."""
    chunks = _chunks(data, FORM, b"COMM", b"SSND")
    compressed = data[8:12] == b"AIFC"
    begin, size = chunks.get(b"COMM", (0, 0))
    common = data[begin : begin + size]
    if len(common) < (22 if compressed else 18):
        _check_sound(data, chunks.get(b"SSND"), "SSND")
        raise RecordingError(f"has a COMM chunk of {len(common)} bytes; export it again")
    channels, frames, bits, exponent, mantissa = struct.unpack_from(">hIhHQ", common)
    codec = common[18:22] if compressed else b"NONE"
    rate = mantissa * 2.0 ** min(exponent - 16_383 - 63, 900)  # an extended float of 80 bits
    _check_format(AIFC_CODECS.get(codec, printable(codec.decode("latin-1"))), bits, channels, rate)
    place = chunks.get(b"SSND")
    offset = int.from_bytes(data[place[0] : place[0] + 4], "big") if place else 0
    sound = place and (place[0] + 8 + offset, place[1] - 8 - offset)
    _check_sound(data, sound, "SSND", stated=frames * channels * bits // 8)
    if frames == 0:
        raise RecordingError(f"has an unfinished header (0 frames); {RESAVE}")
    return data


def _au(data: bytes) -> bytes:
    if len(data) < 24:
        raise RecordingError("is truncated: it ends in its header; copy or export it again")
    _, begin, size, codec, rate, channels = struct.unpack_from(">4s5I", data)
    _check_format(*AU_CODECS.get(codec, (f"codec {codec}", 0)), channels, rate)
    _check_sound(data, (begin, size), "data", LARGEST_CHUNK)
    return data


def _caf(data: bytes) -> bytes:
    chunks = _chunks(data, CAF, b"desc", b"data")
    begin, size = chunks.get(b"desc", (0, 0))
    if size < 32 or begin + 32 > len(data):
        raise RecordingError("is truncated or has no desc chunk; copy or export it again")
    rate, codec, flags, align, _, channels, bits = struct.unpack_from(">d4s5I", data, begin)
    name = printable(codec.decode("latin-1")) if codec != b"lpcm" else FLOAT if flags & 1 else PCM
    _check_format(name, bits, channels, rate, align)
    place = chunks.get(b"data")
    _check_sound(data, place and (place[0] + 4, place[1] - 4), "data")  # the content begins with an edit count
    return data


# --- pages and frames ------------------------------------------------------------------------------------------------


def _ogg(data: bytes) -> bytes:
    """Check one stream of Vorbis or Opus in OGG: complete pages in order, with correct checksums (RFC 3533)."""
    position, number, serial = 0, 0, None
    while position < len(data):
        end, flags, page = _ogg_page(data, position)
        if number == 0:
            serial = page[0]
            _check_ogg_codec(data[position + 27 + data[position + 26] : end])
        if page != (serial, number) or bool(flags & OGG_BEGIN) != (number == 0):
            raise RecordingError(f"holds several streams, or page {number} is missing; {RESAVE}")
        position, number = end, number + 1
        if flags & OGG_END:
            if data[position : position + 4] == b"OggS":
                raise RecordingError(f"holds several streams; {RESAVE}")
            return data[:position]
    raise RecordingError(f"is truncated: it ends before the last page of its stream ({number} pages); copy it again")


def _ogg_page(data: bytes, begin: int) -> tuple[int, int, tuple[int, int]]:
    """Check a page; return its end, its flags, and its stream and page number."""
    body = begin + OGG_PAGE.size + (data[begin + 26] if begin + 26 < len(data) else 0)
    end = body + sum(data[begin + OGG_PAGE.size : body])
    if body > len(data) or end > len(data) or begin + OGG_PAGE.size > len(data):
        raise RecordingError("is truncated: it ends within a page; copy it again")
    magic, _, flags, _, serial, number, checksum, _ = OGG_PAGE.unpack_from(data, begin)
    if magic != b"OggS" or _ogg_checksum(data[begin : begin + 22] + bytes(4) + data[begin + 26 : end]) != checksum:
        raise RecordingError(f"is damaged: the page at byte {begin} has a wrong checksum; copy it again")
    return end, flags, (serial, number)


def _ogg_checksum(page: bytes) -> int:
    """The CRC of OGG: the polynomial of zlib with reversed bits, without the two inversions."""
    value = zlib.crc32(page.translate(REVERSED), 0xFFFFFFFF) ^ 0xFFFFFFFF
    return int(f"{value:032b}"[::-1], 2)


def _check_ogg_codec(packet: bytes) -> None:
    if packet[:7] == b"\x01vorbis" and len(packet) >= 16:
        check_layout(*struct.unpack_from("<BI", packet, 11))
    elif packet[:8] == b"OpusHead" and len(packet) >= 19:
        check_layout(packet[9], 48_000)
    else:
        raise RecordingError(f"is an OGG file that holds neither Vorbis nor Opus; {RESAVE}")


def _mp3(data: bytes) -> bytes:
    """Check MPEG layer III: complete frames, and as many as a Xing header states. Without this header, add one."""
    first = _after_id3(data)
    position, count, sound = first, 0, None
    while header := _mp3_header(data, position):
        size, rate, channels, _ = header
        if sound not in (None, (rate, channels)):
            raise RecordingError(f"is an MP3 file whose rate or channels change at byte {position}; {RESAVE}")
        sound = (rate, channels)
        if position + size > len(data):
            raise RecordingError(f"is truncated: its MP3 frame {count} is incomplete; copy it again")
        position, count = position + size, count + 1
    tail = data[position:]
    if sound is None or not (tail[:3] in (b"TAG", b"ID3") or tail[:8] == b"APETAGEX" or not tail.strip(b"\0")):
        raise RecordingError(f"is a damaged MP3 file: no frame of layer III begins at byte {position}; {RESAVE}")
    check_layout(sound[1], sound[0])
    stated = _xing_frames(data, first)
    if stated is None:  # libsndfile would extrapolate the length from the first frame, and read no further
        return _xing_frame(data[first : first + 4], count) + data[first:position]
    if stated > count - 1:
        raise RecordingError(f"is truncated: it holds {count - 1} of {stated} MP3 frames; copy it again")
    return data[first:position]


def _after_id3(data: bytes) -> int:
    """The byte at which the frames begin: after zeros and tags. Sizes of tags have 7 bits per byte."""
    position = 0
    while data[position : position + 3] == b"ID3" and position + 10 <= len(data):
        size = 0
        for byte in data[position + 6 : position + 10]:
            size = size << 7 | byte & 0x7F
        position += 10 + size + (10 if data[position + 5] & 0x10 else 0)
    return position + len(data[position:]) - len(data[position:].lstrip(b"\0"))


def _mp3_header(data: bytes, at: int) -> tuple[int, int, int, int] | None:
    """Size, rate in Hz, channels and bytes of side information of a frame of layer III; None if there is none."""
    if at + 4 > len(data) or data[at] != 0xFF or data[at + 1] & 0xE6 != 0xE2:
        return None
    version, bits, rate = data[at + 1] >> 3 & 3, data[at + 2] >> 4, data[at + 2] >> 2 & 3
    if version == 1 or bits in (0, 15) or rate == 3:
        return None
    hertz = MP3_RATES[rate] >> {3: 0, 2: 1, 0: 2}[version]
    size = (144 if version == 3 else 72) * 1000 * MP3_KBITS[version != 3][bits] // hertz + (data[at + 2] >> 1 & 1)
    channels = 1 if data[at + 3] >> 6 == 3 else 2
    return size, hertz, channels, {(3, 2): 32, (3, 1): 17, (2, 2): 17, (2, 1): 9}[3 if version == 3 else 2, channels]


def _xing_frames(data: bytes, first: int) -> int | None:
    """The number of frames stated by a Xing or Info header in the first frame; None without one."""
    header = _mp3_header(data, first)
    at = first + 4 + header[3] if header else 0
    if data[at : at + 4] not in (b"Xing", b"Info") or not data[at + 7 : at + 8] or not data[at + 7] & 1:
        return None
    return int.from_bytes(data[at + 8 : at + 12], "big")


def _xing_frame(head: bytes, count: int) -> bytes:
    """A first frame that states `count` frames, of the version, rate and channels of the four bytes of `head`."""
    # Without a checksum, and of 128 or 80 kbit/s: large enough for the header at all rates.
    head = bytes([head[0], head[1] | 1, MP3_XING_KBITS << 4 | head[2] & 0x0C, head[3]])
    size, _, _, side = _mp3_header(head, 0) or (0, 0, 0, 0)
    return (head + bytes(side) + b"Xing" + struct.pack(">II", 1, count)).ljust(size, b"\0")


def _guess(data: bytes) -> str:
    """Name the likely format of an unsupported file."""
    if data[:4] in OTHERS:
        return OTHERS[data[:4]]
    if data[4:8] == b"ftyp":
        return "an MP4 or M4A file"
    if data[0] == 0xFF and data[1:2] and data[1] & 0xE0 == 0xE0:
        return "an AAC file, or MPEG sound of another layer than III"
    text = data[:200].decode(errors="ignore")  # the last character may be incomplete
    if len(text.encode()) > len(data[:200]) - 4 and all(c.isprintable() or c in "\t\r\n" for c in text):
        return f'text (it begins "{printable(text[:20])}")'
    return f"of an unknown format (it begins with bytes {data[:4].hex()})"
