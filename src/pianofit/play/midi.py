"""A MIDI file as a pianist's fingers and right foot: keys that go down and up, and the sustain pedal.

All channels but the tenth (drums) play on the one piano. A key is held while any channel holds it. The pedal is a
switch at half its way (controller 64, 64 of 127); other controllers, the soft and the middle pedal among them, do
nothing. Tempo changes count.
"""

from __future__ import annotations

import io
import os
from typing import Any, NamedTuple

from ..analysis.notes import midi_to_note
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
    pedal: list[tuple[float, bool]]  # (time, down)
    seconds: float  # to the last event
    notes: int


def load_song(path: str | os.PathLike[str]) -> Song:
    """The song in a standard MIDI file (type 0 or 1), of at most 100,000 notes and 30 min.

    Raises `RecordingError`, naming the file and what is wrong: no MIDI, no notes, too many, too long, or keys no piano
    has.
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
    hands, pedal, now = _Hands(name), _Switch(), 0.0
    for message in file:
        now += message.time
        if now > MOST_SONG_SECONDS:
            raise RecordingError(f"{name}: lasts more than {MOST_SONG_SECONDS / 60:g} minutes; cut it into parts")
        if getattr(message, "channel", DRUMS) == DRUMS:
            continue
        if message.type == "control_change":
            if message.control == SUSTAIN:
                pedal.set(now, message.channel, message.value >= DOWN)
            elif message.control in (SOUND_OFF, NOTES_OFF):
                hands.all_up(now, message.channel)
        elif message.type == "note_on" and message.velocity > 0:
            hands.down(now, message.note, message.velocity, message.channel)
        elif message.type in ("note_on", "note_off"):
            hands.up(now, message.note, message.channel)
    if not hands.notes:
        raise RecordingError(f"{name}: holds no note for a piano; give a MIDI file with notes")
    return Song(hands.events, pedal.events, now, hands.notes)


class _Switch:
    """Something that is down while any channel holds it down."""

    def __init__(self) -> None:
        self.held: set[int] = set()
        self.events: list[tuple[float, bool]] = []

    def set(self, now: float, channel: int, down: bool) -> None:
        before = bool(self.held)
        (self.held.add if down else self.held.discard)(channel)
        if bool(self.held) != before:
            self.events.append((now, bool(self.held)))


class _Hands:
    """Keys and the channels that hold them."""

    def __init__(self, name: str) -> None:
        self.name, self.notes = name, 0
        self.events: dict[int, list[tuple[float, int]]] = {}
        self._held: dict[int, set[int]] = {}

    def down(self, now: float, key: int, velocity: int, channel: int) -> None:
        self.notes += 1
        if self.notes > MOST_NOTES:
            raise RecordingError(f"{self.name}: has more than {MOST_NOTES:,} notes; cut it into parts")
        if not LOWEST_KEY <= key <= HIGHEST_KEY:
            raise RecordingError(
                f"{self.name}: {midi_to_note(key)} (key {key}) at {now:.2f} s lies beyond a piano's "
                "A0 to C8; transpose it"
            )
        self._held.setdefault(key, set()).add(channel)
        self.events.setdefault(key, []).append((now, velocity))

    def up(self, now: float, key: int, channel: int) -> None:
        held = self._held.get(key, set())
        if channel in held:
            held.discard(channel)
            if not held:
                self.events[key].append((now, 0))

    def all_up(self, now: float, channel: int) -> None:
        for key in [key for key, held in self._held.items() if channel in held]:
            self.up(now, key, channel)
