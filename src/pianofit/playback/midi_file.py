"""A tolerant reader of standard MIDI files: channel messages in time order.

Playback needs notes, controllers and tempo. Other events and chunks are skipped by their lengths, so none of them can
make a song unreadable. An event that cannot be read ends its track: earlier events are kept, and a remark reports it.
The format is that of the MIDI Association, "Standard MIDI Files 1.0" (RP-001).
"""

from __future__ import annotations

import struct
from bisect import bisect_right
from collections.abc import Iterator
from typing import NamedTuple

SYSEX, ESCAPE, META = 0xF0, 0xF7, 0xFF
END_OF_TRACK, SET_TEMPO = 0x2F, 0x51
# Data bytes of system messages, which a file should not hold; all others have none.
SYSTEM_LENGTHS = {0xF1: 1, 0xF2: 2, 0xF3: 1}
# SMPTE frames per second by the negated first byte of the division. 29 means 29.97, drop frame.
FRAME_RATES = {24: 24.0, 25: 25.0, 29: 30_000 / 1001, 30: 30.0}


class MidiError(Exception):
    """A file without a readable track; the message gives the reason."""


class MidiEvent(NamedTuple):
    """One channel message."""

    seconds: float  # from the start of the file
    kind: int  # upper half of the status byte, 8 to 14
    channel: int  # 0 to 15
    first: int  # data bytes, 0 to 127
    second: int


class MidiFile(NamedTuple):
    """Channel messages of a file, with its length and damage."""

    events: list[MidiEvent]  # ascending in time; simultaneous events in the order of tracks
    seconds: float  # to the end of the last track
    remarks: list[str]  # sentences without a full stop, on incomplete tracks


def parse_midi(data: bytes) -> MidiFile:
    """Read the file from the first MIDI header in `data` on. A RIFF wrapper before it is skipped."""
    begin = data.find(b"MThd")
    if begin < 0:
        raise MidiError("it has no MIDI header, MThd")
    try:
        size, file_type, declared, division = struct.unpack_from(">IHHH", data, begin + 4)
    except struct.error:
        raise MidiError("its header is cut short") from None
    ticks, smpte = _ticks(division)
    tracks = list(_tracks(data, begin + 8 + max(size, 6)))  # the rest of a longer header is ignored
    if file_type > 2 or (file_type == 2 and len(tracks) > 1):
        raise MidiError("type 2, whose tracks are separate songs" if file_type == 2 else f"type {file_type} is unknown")
    clock = _Clock([] if smpte else [tempo for track in tracks for tempo in track.tempos], ticks, smpte)
    messages = sorted((message for track in tracks for message in track.messages), key=lambda message: message[0])
    events = [MidiEvent(clock(tick), status >> 4, status & 15, *rest) for tick, status, *rest in messages]
    return MidiFile(events, clock(max((track.tick for track in tracks), default=0)), _remarks(tracks, declared, clock))


def _ticks(division: int) -> tuple[float, bool]:
    """Ticks per beat, or per second in SMPTE time; and whether it is SMPTE time."""
    if not division:
        raise MidiError("0 ticks a beat")
    if division < 2**15:
        return division, False
    frames, ticks = 256 - (division >> 8), division & 255
    if frames not in FRAME_RATES or not ticks:
        raise MidiError(f"{ticks} ticks a frame of {frames} frames a second")
    return FRAME_RATES[frames] * ticks, True


class _Clock:
    """Time of a tick, s, from all tempo changes of a file."""

    def __init__(self, tempos: list[tuple[int, int]], ticks: float, smpte: bool) -> None:
        # Until a file sets a tempo, a beat lasts 0.5 s.
        self.ticks, self.seconds, self.beat_seconds = [0], [0.0], [1.0 if smpte else 0.5]
        self.division = ticks  # ticks per beat, or per second
        for tick, tempo in sorted(tempos, key=lambda tempo: tempo[0]):
            now = self(tick)
            self.ticks.append(tick)
            self.seconds.append(now)
            self.beat_seconds.append(tempo / 1e6)

    def __call__(self, tick: int) -> float:
        i = bisect_right(self.ticks, tick) - 1
        return self.seconds[i] + (tick - self.ticks[i]) * self.beat_seconds[i] / self.division


def _tracks(data: bytes, at: int) -> Iterator[_Track]:
    """All track chunks from `at` on. Where no chunk begins, as after a wrong length, search for the next track."""
    while 0 <= at <= len(data) - 8:
        name, size = struct.unpack_from(">4sI", data, at)
        end = at + 8 + size
        if name == b"MTrk":
            track = _Track(data, at + 8, min(end, len(data)))
            track.read(truncated=end > len(data))
            yield track
            at = end if end <= len(data) else track.at
        else:
            at = end if end <= len(data) else data.find(b"MTrk", at + 1)


class _EventError(Exception):
    """An event that cannot be read; the message describes the damage to its track."""


class _Track:
    """One track: its channel messages (tick, status, two data bytes), tempo changes (tick, µs per beat) and end."""

    def __init__(self, data: bytes, at: int, end: int) -> None:
        self.data, self.at, self.end = data, at, end
        self.tick = 0
        self.messages: list[tuple[int, int, int, int]] = []
        self.tempos: list[tuple[int, int]] = []
        self.damage = ""  # reason, if it could not be read to its end

    def read(self, truncated: bool) -> None:
        """Read all events; `truncated` means that the file ends before the chunk."""
        running = 0  # running status, for channel messages without a status byte
        try:
            while self.at < self.end:
                tick, status = self.tick + self._number(), self._byte()
                if status == META:
                    self.tick = tick
                    if self._is_last():
                        return
                elif status in (SYSEX, ESCAPE):
                    self._skip(self._number())
                elif status > SYSEX:
                    self._skip(SYSTEM_LENGTHS.get(status, 0))
                else:
                    running = self._message(tick, status, running)
                self.tick = tick
            if truncated:
                raise _EventError("is cut short")
        except _EventError as error:
            self.damage = str(error)

    def _is_last(self) -> bool:
        """Read a meta event, from its kind on, and return whether it ends the track.

        A tempo event counts only with three bytes and a value above zero.
        """
        kind, data = self._byte(), self._skip(self._number())
        if kind == SET_TEMPO and len(data) == 3 and any(data):
            self.tempos.append((self.tick, int.from_bytes(data)))
        return kind == END_OF_TRACK

    def _message(self, tick: int, first: int, running: int) -> int:
        """Read a channel message that begins with byte `first` and return its status. Data above 127 are clipped."""
        if first >= 0x80:
            running, first = first, self._byte()
        if not running:
            raise _EventError("is damaged")
        second = 0 if running >> 4 in (0xC, 0xD) else self._byte()  # program changes and channel pressure have one byte
        self.messages.append((tick, running, min(first, 127), min(second, 127)))
        return running

    def _byte(self) -> int:
        return self._skip(1)[0]

    def _number(self) -> int:
        """Read a number of variable length: up to four bytes of seven bits, the highest bit set in all but the last."""
        number = 0
        for _ in range(4):
            byte = self._byte()
            number = number << 7 | byte & 0x7F
            if byte < 0x80:
                return number
        raise _EventError("is damaged")

    def _skip(self, size: int) -> bytes:
        if size > self.end - self.at:
            raise _EventError("is cut short")
        self.at += size
        return self.data[self.at - size : self.at]


def _remarks(tracks: list[_Track], declared: int, clock: _Clock) -> list[str]:
    damaged = [(i, track) for i, track in enumerate(tracks, 1) if track.damage]
    remarks = []
    if len(tracks) < declared:
        remarks.append(f"the header declares {declared} track{'s' * (declared > 1)}, and the file has {len(tracks)}")
    if damaged:
        number, track = damaged[0]
        more = f", and {len(damaged) - 1} more are damaged" if len(damaged) > 1 else ""
        remarks.append(f"track {number} {track.damage} after {clock(track.tick):.1f} s{more}; the rest is played")
    return remarks
