"""A MIDI file as a pianist's fingers and right foot: keys that go down and up, and the sustain pedal.

All channels but the tenth (drums) play on the one piano. A key is held while any channel holds it. The pedal is a
switch at half its way (controller 64, 64 of 127); other controllers, the soft and the middle pedal among them, do
nothing. Tempo changes count.

Strokes of one key may overlap. A note-off then ends the oldest stroke of its key and channel, so the damper falls when
as many strokes are ended as were begun.
"""

from __future__ import annotations

import os
from collections import Counter, defaultdict
from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

from ..errors import RecordingError
from ..instrument.collect_fits import HIGHEST_KEY, LOWEST_KEY
from ..io.files import printable, read_file
from .midi_file import MidiError, MidiFile, parse_midi

__all__ = ["MOST_NOTES", "MOST_SONG_SECONDS", "Song", "load_song", "read_song"]

LARGEST_SONG = 2**21  # bytes; 100,000 notes take about half of it
MOST_NOTES = 100_000
MOST_SONG_SECONDS = 1800.0
NOTE_OFF, NOTE_ON, CONTROL = 8, 9, 11
SUSTAIN, DOWN, DRUMS = 64, 64, 9
SOUND_OFF, NOTES_OFF = 120, 123
# In place of a velocity: the end of one stroke, and of all strokes of a channel.
END, END_ALL = 0, -1


class Song(NamedTuple):
    """Times in s from the first event; every list ascends in time."""

    keys: dict[int, list[tuple[float, int]]]  # MIDI key -> (time, velocity 1 to 127; 0 when it goes up)
    pedal: Sequence[tuple[float, int]]  # (time, 1 when it goes down or is moved while down; 0 when it goes up)
    seconds: float  # to the last event
    notes: int
    ignored_notes: int = 0  # more notes, that no piano has
    remarks: Sequence[str] = ()  # what of the file could not be read


def load_song(path: str | os.PathLike[str]) -> Song:
    """The song in a standard MIDI file, of at most 100,000 notes and 30 min.

    Reads types 0 and 1, and type 2 with one track, also inside a RIFF wrapper (RMID). Events and chunks that a player
    does not need are skipped. Of a damaged track the events before the damage are played; `Song.remarks` says so.

    Parameters
    ----------
    path : of the file.

    Raises
    ------
    RecordingError
        Naming the file and what is wrong: no MIDI, no notes that a piano has, too many, too long.
    """
    data = read_file(path, LARGEST_SONG, RecordingError)
    return read_song(data, printable(path))


def read_song(data: bytes, name: str) -> Song:
    """The song in a file's bytes; see `load_song`."""
    try:
        return _song(parse_midi(data), name)
    except MidiError as error:
        raise RecordingError(f"{name}: cannot be read as MIDI ({error}); save it again as type 0 or 1") from None


def _song(file: MidiFile, name: str) -> Song:
    """Walk through all events in time."""
    if file.seconds > MOST_SONG_SECONDS:
        raise RecordingError(f"{name}: lasts more than {MOST_SONG_SECONDS / 60:g} minutes; cut it into parts")
    pedal, notes = _Pedal(), Counter[bool]()
    fingers = defaultdict[int, defaultdict[int, list[_Move]]](lambda: defaultdict(list))  # key, channel -> moves
    struck = defaultdict[int, set[int]](set)  # channel -> keys that it moved since it last released all
    for order, (now, kind, channel, first, second) in enumerate(file.events):
        if channel == DRUMS:
            continue
        if kind == CONTROL and first == SUSTAIN:
            pedal.move(now, channel, int(second >= DOWN))
        elif kind == CONTROL and first in (SOUND_OFF, NOTES_OFF):
            for key in struck.pop(channel, ()):
                fingers[key][channel].append(_Move(order, now, END_ALL))
        elif kind in (NOTE_ON, NOTE_OFF):
            velocity = second if kind == NOTE_ON else END
            there = LOWEST_KEY <= first <= HIGHEST_KEY  # else it is another player's switch
            notes[there] += velocity > 0
            if there:
                struck[channel].add(first)
                fingers[first][channel].append(_Move(order, now, velocity))
    _check_count(notes[True], name, file.remarks)
    keys = {key: events for key, channels in fingers.items() if (events := _held(channels))}
    return Song(keys, pedal.events, file.seconds, notes[True], notes[False], file.remarks)


def _check_count(notes: int, name: str, remarks: Sequence[str]) -> None:
    if notes > MOST_NOTES:
        raise RecordingError(f"{name}: has more than {MOST_NOTES:,} notes; cut it into parts")
    if not notes:
        said = f" ({'; '.join(remarks)})" if remarks else ""
        raise RecordingError(f"{name}: holds no note from A0 to C8{said}; give a MIDI file with notes, or transpose it")


class _Move(NamedTuple):
    """One event of a key."""

    order: float  # in the file
    seconds: float
    velocity: int  # of a stroke; else END or END_ALL


def _held(channels: dict[int, list[_Move]]) -> list[tuple[float, int]]:
    """Strokes of a key, and when it goes up: whenever no channel has a stroke that is not yet ended."""
    moves = sorted((move, channel) for channel, own in channels.items() for move in _completed(own))
    open_strokes, events = Counter[int](), []
    for (_, now, velocity), channel in moves:
        before = open_strokes.total()
        if velocity > 0:
            open_strokes[channel] += 1
            events.append((now, velocity))
        else:
            open_strokes[channel] = max(open_strokes[channel] - 1, 0) if velocity == END else 0
            if before and not open_strokes.total():
                events.append((now, 0))
    return events


def _completed(moves: list[_Move]) -> list[_Move]:
    """Moves of one key by one channel, with an end for every stroke whose own is missing.

    Such a stroke ends at a stray note-off of the same time (a note without length, its end written first), else where
    the channel strikes the key again. Without either it is held to the end of the song.
    """
    open_strokes: list[int] = []
    stray = set[float]()
    for i, move in enumerate(moves):
        if move.velocity > 0:
            open_strokes.append(i)
        elif move.velocity == END_ALL:
            open_strokes.clear()
        elif open_strokes:
            open_strokes.pop()
        else:
            stray.add(move.seconds)
    ends, strokes = [], [i for i, move in enumerate(moves) if move.velocity > 0]
    after = dict(pairwise(strokes))
    for i in open_strokes:
        if moves[i].seconds in stray:
            ends.append(_Move(moves[i].order + 0.5, moves[i].seconds, END))
        elif i in after:
            ends.append(_Move(moves[after[i]].order - 0.5, moves[after[i]].seconds, END))
    return [*moves, *ends]


class _Pedal:
    """The pedal, which is down while any channel holds it down."""

    def __init__(self) -> None:
        self.by: set[int] = set()
        self.events: list[tuple[float, int]] = []

    def move(self, now: float, channel: int, down: int) -> None:
        """A channel holds it down, or lets it go."""
        if down or self.by == {channel}:
            self.events.append((now, down))
        (self.by.add if down else self.by.discard)(channel)
