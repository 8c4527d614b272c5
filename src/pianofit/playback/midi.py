"""A MIDI file as movements of keys and pedals.

All channels except the tenth (drums) play on one piano. A key is down while any channel holds it. Controllers 64, 66
and 67 are the right, middle and left pedal; the highest value of all channels counts. Other controllers have no
effect. Tempo changes are applied.

Strokes of one key may overlap. A note-off then ends the newest open stroke of its key and channel. The damper falls
when as many strokes have ended as have begun. Strokes of one key at one time are one stroke, the hardest, because a key
has one hammer. The middle and left pedals act on the simultaneous strokes that follow them in the file.
"""

from __future__ import annotations

import os
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from itertools import groupby, pairwise
from types import MappingProxyType
from typing import NamedTuple

from ..conversions import HIGHEST_KEY, LOWEST_KEY
from ..errors import RecordingError
from ..io.files import printable, read_file
from .midi_file import MidiError, MidiEvent, MidiFile, parse_midi

LARGEST_SONG = 2**21  # bytes; 100,000 notes take about half of it
MOST_NOTES = 100_000
MOST_SONG_SECONDS = 1800.0
# Kinds of channel messages, controllers, and the channel of drums, from 0.
NOTE_OFF, NOTE_ON, CONTROL = 8, 9, 11
SUSTAIN, SOSTENUTO, SOFT, SOUND_OFF, NOTES_OFF = 64, 66, 67, 120, 123
RESET = 121  # "reset all controllers" releases the pedals
# Value from which on MIDI defines a pedal as down.
SWITCH = 64
DRUMS = 9
# Time between simultaneous movements of keys and of the middle or left pedal, s: far less than a sample, and above the
# rounding of times. The right pedal acts on all keys alike, so that its order is inaudible.
APART = 1e-9
# Place of an end that the file lacks, after the stroke that it ends or before the next one, in events.
NEXT_TO = 0.25
# Values in place of a velocity: the end of one stroke, and of all strokes of a channel.
END, END_ALL = 0, -1


class Song(NamedTuple):
    """Times in s from the first event; every list ascends in time."""

    keys: dict[int, list[tuple[float, int]]]  # MIDI key -> (time, velocity 1 to 127, or 0 for a release)
    pedal: Sequence[tuple[float, int]]  # (time, position of the right pedal, 0 to 127)
    seconds: float  # to the last event
    notes: int
    ignored_notes: int = 0  # notes outside A0 to C8
    remarks: Sequence[str] = ()  # parts of the file that could not be read
    sostenuto: Sequence[tuple[float, int]] = ()  # (time, position of the middle pedal, 0 to 127)
    una_corda: Sequence[tuple[float, int]] = ()  # (time, position of the left pedal, 0 to 127)
    # Release velocities, 0 to 127, by key and time, where the file states them.
    release_velocities: Mapping[tuple[int, float], int] = MappingProxyType({})

    def at_tempo(self, factor: float) -> Song:
        """Return the song `factor` times as fast."""

        def moved(events: Sequence[tuple[float, int]]) -> list[tuple[float, int]]:
            return [(t / factor, value) for t, value in events]

        return self._replace(
            keys={key: moved(events) for key, events in self.keys.items()},
            pedal=moved(self.pedal),
            sostenuto=moved(self.sostenuto),
            una_corda=moved(self.una_corda),
            seconds=self.seconds / factor,
            release_velocities={(key, t / factor): value for (key, t), value in self.release_velocities.items()},
        )

    def with_touch(self, exponent: float) -> Song:
        """Return the song with MIDI velocities v as 127 (v/127)^exponent: below 1 louder, above 1 softer."""

        def touched(velocity: int) -> int:
            return max(round(127 * (velocity / 127) ** exponent), 1) if velocity else 0

        keys = {key: [(t, touched(velocity)) for t, velocity in events] for key, events in self.keys.items()}
        return self if exponent == 1 else self._replace(keys=keys)


def load_song(path: str | os.PathLike[str]) -> Song:
    """Read a standard MIDI file of at most 100,000 notes and 30 min.

    Reads types 0 and 1, and type 2 with one track, also inside a RIFF wrapper (RMID). Events and chunks that playback
    does not need are skipped. A damaged track is played up to the damage, and `Song.remarks` names it.

    Parameters
    ----------
    path : path of the file.

    Returns
    -------
    A `Song`.

    Raises
    ------
    RecordingError
        Names the file and the reason: not MIDI, no notes from A0 to C8, too many notes, too long.

    Examples
    --------
    >>> import pianofit
    >>> song = pianofit.load_song("melody.mid")
    >>> song.notes, sorted(song.keys)
    (4, [60, 64, 67])
    """
    data = read_file(path, LARGEST_SONG, RecordingError)
    return read_song(data, printable(path))


def read_song(data: bytes, name: str) -> Song:
    """Read a song from the bytes of a file; see `load_song`."""
    try:
        return _song(parse_midi(data), name)
    except MidiError as error:
        raise RecordingError(f"{name}: cannot be read as MIDI ({error}); save it again as type 0 or 1") from None


def _song(file: MidiFile, name: str) -> Song:
    """Collect the movements of keys and pedal from all events in time order."""
    if file.seconds > MOST_SONG_SECONDS:
        raise RecordingError(f"{name}: lasts more than {MOST_SONG_SECONDS / 60:g} minutes; cut it into parts")
    notes, ignored = 0, 0
    release_velocities: dict[tuple[int, float], int] = {}
    key_events = defaultdict[int, defaultdict[int, list[_KeyEvent]]](lambda: defaultdict(list))  # by key and channel
    used_keys = defaultdict[int, set[int]](set)  # channel -> keys with events since its last "all notes off"
    places = _places(file.events)
    for order, (now, kind, channel, first, second) in enumerate(file.events):
        if channel == DRUMS:
            continue
        if kind == CONTROL and first in (SOUND_OFF, NOTES_OFF):
            for key in used_keys.pop(channel, ()):
                key_events[key][channel].append(_KeyEvent(order, now, END_ALL))
        elif kind in (NOTE_ON, NOTE_OFF):
            velocity = second if kind == NOTE_ON else END
            if LOWEST_KEY <= first <= HIGHEST_KEY:
                notes += velocity > 0
                used_keys[channel].add(first)
                key_events[first][channel].append(_KeyEvent(order, now, velocity))
                if kind == NOTE_OFF:
                    release_velocities[first, now] = second
            else:  # sample players use such notes as key switches
                ignored += velocity > 0
    _check_count(notes, name, file.remarks)
    moved = {key: events for key, channels in key_events.items() if (events := _merge_channels(channels))}
    keys = {key: [(_time(it.order, it.seconds, places), it.velocity) for it in own] for key, own in moved.items()}
    released = {
        (key, _time(it.order, it.seconds, places)): release_velocities[key, it.seconds]
        for key, own in moved.items()
        for it in own
        if not it.velocity and (key, it.seconds) in release_velocities
    }
    pedals = (_pedal(file.events, places, controller) for controller in (SUSTAIN, SOSTENUTO, SOFT))
    pedal, sostenuto, una_corda = pedals
    return Song(keys, pedal, file.seconds, notes, ignored, file.remarks, sostenuto, una_corda, released)


def _places(events: Sequence[MidiEvent]) -> list[int]:
    """Place of each event among the simultaneous ones, from 1; 0 where their order is inaudible."""
    places: list[int] = []
    for _, group in groupby(events, key=lambda event: event.seconds):
        simultaneous = list(group)
        controls = {event.first for event in simultaneous if event.kind == CONTROL}
        pedals = controls & {SOSTENUTO, SOFT, RESET}
        keys = controls & {SOUND_OFF, NOTES_OFF} or any(event.kind in (NOTE_ON, NOTE_OFF) for event in simultaneous)
        places += [place if pedals and keys else 0 for place in range(1, len(simultaneous) + 1)]
    return places


def _time(order: float, seconds: float, places: Sequence[int]) -> float:
    """Time of an event, moved by its place among the simultaneous ones."""
    nearest = round(order)
    return seconds + APART * (places[nearest] + order - nearest) if places[nearest] else seconds


def _pedal(events: Sequence[MidiEvent], places: Sequence[int], controller: int) -> list[tuple[float, int]]:
    """Times and positions of a pedal. The highest value of all channels counts."""
    held: dict[int, int] = {}
    combined: list[tuple[float, int]] = []
    for order, (seconds, kind, channel, first, second) in enumerate(events):
        if kind != CONTROL or channel == DRUMS or first not in (controller, RESET):
            continue
        held[channel] = 0 if first == RESET else second
        highest = max(held.values())
        if highest != (combined[-1][1] if combined else 0):
            combined.append((_time(order, seconds, places), highest))
    return combined


def _check_count(notes: int, name: str, remarks: Sequence[str]) -> None:
    if notes > MOST_NOTES:
        raise RecordingError(f"{name}: has more than {MOST_NOTES:,} notes; cut it into parts")
    if not notes:
        reason = f" ({'; '.join(remarks)})" if remarks else ""
        raise RecordingError(
            f"{name}: holds no note from A0 to C8 outside channel 10, the drums{reason}; give a MIDI file with "
            "notes, or transpose it"
        )


class _KeyEvent(NamedTuple):
    """One event of a key."""

    order: float  # position in the file
    seconds: float
    velocity: int  # of a stroke; otherwise END or END_ALL


def _merge_channels(channels: dict[int, list[_KeyEvent]]) -> list[_KeyEvent]:
    """Strokes and releases of one key. It is released when no channel has an open stroke left."""
    events_by_order = sorted((event, channel) for channel, own in channels.items() for event in _add_missing_ends(own))
    open_strokes, merged = Counter[int](), list[_KeyEvent]()
    for event, channel in events_by_order:
        before, velocity = open_strokes.total(), event.velocity
        if velocity > 0:
            open_strokes[channel] += 1
            if merged and merged[-1].velocity and merged[-1].seconds == event.seconds:
                event = event._replace(velocity=max(velocity, merged.pop().velocity))
            merged.append(event)
        else:
            open_strokes[channel] = max(open_strokes[channel] - 1, 0) if velocity == END else 0
            if before and not open_strokes.total():
                merged.append(event._replace(velocity=0))
    return merged


def _add_missing_ends(events: list[_KeyEvent]) -> list[_KeyEvent]:
    """Events of one key in one channel, with an end added for every stroke that has none.

    Such a stroke ends at a stray note-off of the same time, which is a note without length whose end was written first.
    Otherwise it ends at the next stroke of the key in this channel. A stroke with neither is held to the end of the
    song.
    """
    open_strokes: list[int] = []
    stray_times = set[float]()
    for i, event in enumerate(events):
        if event.velocity > 0:
            open_strokes.append(i)
        elif event.velocity == END_ALL:
            open_strokes.clear()
        elif open_strokes:
            open_strokes.pop()
        else:
            stray_times.add(event.seconds)
    ends, strokes = [], [i for i, event in enumerate(events) if event.velocity > 0]
    next_stroke = dict(pairwise(strokes))
    for i in open_strokes:
        if events[i].seconds in stray_times:
            ends.append(_KeyEvent(events[i].order + NEXT_TO, events[i].seconds, END))
        elif i in next_stroke:
            following = events[next_stroke[i]]
            ends.append(_KeyEvent(following.order - NEXT_TO, following.seconds, END))
    return [*events, *ends]
