"""A MIDI file as a pianist's fingers and right foot: keys that go down and up, and the sustain pedal.

All channels but the tenth (drums) play on the one piano. A key is held while any channel holds it. The pedal is a
switch at half its way (controller 64, 64 of 127); other controllers, the soft and the middle pedal among them, do
nothing. Tempo changes count.
"""

from __future__ import annotations

import io
import os
from collections import defaultdict
from collections.abc import Sequence
from typing import Any, NamedTuple

from ..errors import RecordingError
from ..io import one_line, read_file
from ..keyboard.gather import HIGHEST_KEY, LOWEST_KEY

__all__ = ["MOST_NOTES", "MOST_SONG_SECONDS", "Song", "load_song", "read_song"]

LARGEST_SONG = 2**21  # bytes; 100,000 notes take about half of it
MOST_NOTES = 100_000
MOST_SONG_SECONDS = 1800.0
SUSTAIN, DOWN, DRUMS = 64, 64, 9
SOUND_OFF, NOTES_OFF = 120, 123


class Song(NamedTuple):
    """Times in s from the first event; every list ascends in time."""

    keys: dict[int, list[tuple[float, int]]]  # MIDI key -> (time, velocity 1 to 127; 0 when it goes up)
    pedal: Sequence[tuple[float, int]]  # (time, 1 when it goes down or is moved while down; 0 when it goes up)
    seconds: float  # to the last event
    notes: int
    beyond: int = 0  # more notes, that no piano has


def load_song(path: str | os.PathLike[str]) -> Song:
    """The song in a standard MIDI file (type 0 or 1), of at most 100,000 notes and 30 min.

    Raises `RecordingError`, naming the file and what is wrong: no MIDI, no notes that a piano has, too many, too long.
    """
    data = read_file(path, LARGEST_SONG, RecordingError)
    return read_song(data, one_line(path))


def read_song(data: bytes, name: str) -> Song:
    """The song in a file's bytes; see `load_song`."""
    import mido

    if not data.startswith(b"MThd"):
        raise RecordingError(f"{name}: not a MIDI file (it does not begin with MThd); give a standard MIDI file")
    try:
        file = mido.MidiFile(file=io.BytesIO(data), clip=True)
        if file.type == 2:
            raise ValueError("type 2, whose tracks are songs of their own")
        if not 0 < file.ticks_per_beat < 2**15:
            raise ValueError(f"{file.ticks_per_beat} ticks a beat; SMPTE time is not read")
        return _read(file, name)
    except RecordingError:
        raise
    except Exception as error:  # whatever a broken file makes of the parser
        reason = one_line(str(error).splitlines()[0] if str(error) else type(error).__name__)
        raise RecordingError(f"{name}: cannot be read as MIDI ({reason}); save it again as type 0 or 1") from None


def _read(file: Any, name: str) -> Song:
    """Walk through all tracks in time."""
    keys, pedal, now, count = defaultdict[int, _Held](_Held), _Held(), 0.0, [0, 0]
    for message in file:
        now += message.time
        if now > MOST_SONG_SECONDS:
            raise RecordingError(f"{name}: lasts more than {MOST_SONG_SECONDS / 60:g} minutes; cut it into parts")
        if getattr(message, "channel", DRUMS) == DRUMS:
            continue
        if message.is_cc(SUSTAIN):
            pedal.move(now, message.channel, int(message.value >= DOWN))
        elif message.is_cc(SOUND_OFF) or message.is_cc(NOTES_OFF):
            for key in keys.values():
                key.move(now, message.channel, 0)
        elif message.type in ("note_on", "note_off"):
            velocity = message.velocity if message.type == "note_on" else 0
            there = LOWEST_KEY <= message.note <= HIGHEST_KEY  # else it is another player's switch
            count[there] += velocity > 0
            if there:
                keys[message.note].move(now, message.channel, velocity)
    _check_count(count[True], name)
    found = {key: held.events for key, held in keys.items() if held.events}
    return Song(found, pedal.events, now, count[True], count[False])


def _check_count(notes: int, name: str) -> None:
    if notes > MOST_NOTES:
        raise RecordingError(f"{name}: has more than {MOST_NOTES:,} notes; cut it into parts")
    if not notes:
        raise RecordingError(f"{name}: holds no note from A0 to C8; give a MIDI file with notes, or transpose it")


class _Held:
    """A key or the pedal, which is down while any channel holds it down."""

    def __init__(self) -> None:
        self.by: set[int] = set()
        self.events: list[tuple[float, int]] = []

    def move(self, now: float, channel: int, how: int) -> None:
        """A channel holds it down, `how` above 0, or lets it go."""
        if how or self.by == {channel}:
            self.events.append((now, how))
        (self.by.add if how else self.by.discard)(channel)
