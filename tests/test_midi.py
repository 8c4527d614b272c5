"""Songs: every MIDI file that common players read, and files that cannot be read."""

from __future__ import annotations

import contextlib
import io
import struct

import mido
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from instrument_cases import true_instrument

from pianofit.errors import RecordingError
from pianofit.playback import Song, load_song, render_song
from pianofit.playback.midi import MOST_NOTES, read_song
from pianofit.playback.pedals import PedalRange, key_motions, releases

END = b"\0\xff\x2f\0"
BEAT = b"\x83\x60"  # 480 ticks
NOTE = b"\0\x90\x3c\x50" + BEAT + b"\x80\x3c\x40" + END
PLAYED = {60: [(0.0, 80), (0.5, 0)]}


def track(events: bytes, size: int | None = None) -> bytes:
    return b"MTrk" + struct.pack(">I", len(events) if size is None else size) + events


def song(*tracks: bytes, form: int = 1, division: int = 480) -> bytes:
    """A MIDI file from bytes of tracks."""
    return b"MThd" + struct.pack(">IHHH", 6, form, len(tracks), division) + b"".join(track(x) for x in tracks)


def read(data: bytes) -> Song:
    return read_song(data, "song")


def midi_bytes(*messages: mido.Message | mido.MetaMessage, **options: int) -> bytes:
    stream = io.BytesIO()
    mido.MidiFile(ticks_per_beat=480, tracks=[mido.MidiTrack(messages)], **options).save(file=stream)
    return stream.getvalue()


def on(note: int, velocity: int = 80, time: int = 0, channel: int = 0) -> mido.Message:
    return mido.Message("note_on", note=note, velocity=velocity, time=time, channel=channel)


def test_a_song_is_read_in_time():
    found = read_song(midi_bytes(
        mido.MetaMessage("set_tempo", tempo=500_000),
        on(60), on(64, 70, 480), mido.Message("control_change", control=64, value=64),
        mido.MetaMessage("set_tempo", tempo=1_000_000, time=480),
        on(60, 0, 480), mido.Message("note_off", note=64, time=240), on(62, 50, channel=9),
        mido.Message("control_change", control=64, value=63, time=480), on(60, 5, channel=3), on(60, 6, channel=4),
        on(60, 0, 480, channel=3), on(60, 0, 480, channel=4), mido.Message("note_off", note=61),
    ), "song")  # fmt: skip
    assert found.keys == {60: [(0.0, 80), (2.0, 0), (3.5, 6), (5.5, 0)], 64: [(0.5, 70), (2.5, 0)]}
    assert found.pedal == [(0.5, 64), (3.5, 63)]
    assert found.release_velocities[64, 2.5] == 64
    assert (found.notes, found.seconds) == (4, 5.5)


def test_notes_that_no_piano_has_are_left_out_and_counted():
    """Sample players use notes below A0 as key switches."""
    played = (on(60), on(60, 0, 480))
    alone, found = (read_song(midi_bytes(*more, *played), "song") for more in ((), (on(20), on(109), on(20, 0))))
    assert found == alone._replace(ignored_notes=2)


BAD_SONGS = {
    "text": (b"no song at all", "no MIDI header"),
    "short": (b"MThd\0\0\0\6\0\0\0\1\1", "header is cut short"),
    "no track": (b"MThd\0\0\0\6\0\1\0\1\1\xe0", "holds no note"),
    "no notes": (midi_bytes(mido.MetaMessage("set_tempo", tempo=500_000)), "holds no note"),
    "drums": (midi_bytes(on(60, channel=9)), "holds no note"),
    "beyond": (midi_bytes(on(20), on(109)), "holds no note from A0 to C8 outside channel 10"),
    "long": (midi_bytes(on(60), *[on(60, 1, 2**27) for _ in range(2)]), "lasts more than 30 minutes"),
    "many": (midi_bytes(*[on(60, 1, 1)] * (MOST_NOTES + 1)), "more than 100,000 notes"),
    "type 2": (song(b"", NOTE, form=2), "type 2"),
    "type 3": (song(NOTE, form=3), "type 3"),
    "no ticks": (song(NOTE, division=0), "0 ticks a beat"),
    "smpte": (song(NOTE, division=0xFB28), "5 frames"),
    "smpte without ticks": (song(NOTE, division=0xE700), "0 ticks"),
}


@pytest.mark.parametrize("name", BAD_SONGS)
def test_a_bad_song_is_refused_in_one_line(name, tmp_path):
    data, message = BAD_SONGS[name]
    file = tmp_path / "bad.mid"
    file.write_bytes(data)
    with pytest.raises(RecordingError, match=message) as caught:
        load_song(file)
    assert "bad.mid: " in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_song_that_is_no_file_is_refused(tmp_path):
    with pytest.raises(RecordingError, match=r"none\.mid: "):
        load_song(tmp_path / "none.mid")
    big = tmp_path / "big.mid"
    big.write_bytes(b"MThd" + bytes(2**21))
    with pytest.raises(RecordingError, match="2 MiB"):
        load_song(big)


@given(st.binary(max_size=80), st.integers(0, 60), st.integers(0, 20))
def test_no_bytes_bring_the_reader_down(noise, at, length):
    good = midi_bytes(on(60), on(64, 70, 48), on(60, 0, 48), on(64, 0, 48))
    with contextlib.suppress(RecordingError):
        read_song(good[:at] + noise + good[at + length :], "noise")


TOLERATED = {
    "type 0": song(NOTE, form=0),
    "type 2 of one track": song(NOTE, form=2),
    "a key signature of nine sharps": song(b"\0\xff\x59\2\x09\0" + NOTE),
    "a tempo of two bytes": song(b"\0\xff\x51\2\x09\0" + NOTE),
    "a tempo of zero": song(b"\0\xff\x51\3\0\0\0" + NOTE),
    "invalid text, an unknown meta event": song(b"\0\xff\1\2\xff\xfe\0\xff\x7b\1\x90" + NOTE),
    "system exclusive, whole and in parts": song(b"\0\xf0\3\x90\x40\xf7\0\xf0\1\x90\0\xf7\2\x40\xf7" + NOTE),
    "system messages that no file should hold": song(b"\0\xf8\0\xf2\x3c\x50\0\xf4" + NOTE),
    "running status across other events": song(b"\0\x90\x3c\x50\0\xff\1\1a\0\xf0\1\xf7\0\xf8" + BEAT + b"\x3c\0" + END),
    "a velocity above 127": song(NOTE.replace(b"\x3c\x40", b"\x3c\xc0")),
    "programs and pressures": song(b"\0\xc0\1\0\xd0\x90\0\xe0\0\x40\0\xa0\x3c\x50" + NOTE),
    "no end of track": song(NOTE[: -len(END)]),
    "more after the end of track": song(NOTE + b"\0\x90\x3c\x50"),
    "an empty track": song(b"", NOTE),
    "a vendor's chunk": song(NOTE).replace(b"MTrk", b"XFIH\0\0\0\4MTrkMTrk"),
    "a vendor's chunk at the end": song(NOTE) + b"XFKM\0\0\0\4abcd",
    "a longer header": song(NOTE).replace(b"\6\0\1\0\1\1\xe0", b"\x08\0\1\0\1\1\xe0ab"),
    "a byte between two tracks": song(b"", NOTE).replace(b"\0\0\0\0MTrk", b"\0\0\0\0\0MTrk"),
    "a track of unknown length": song(NOTE)[:18] + b"\xff\xff\xff\xff" + NOTE,
    "a RIFF wrapper": b"RIFF\x40\0\0\0RMIDdata\x2b\0\0\0" + song(NOTE) + b"\0LIST\4\0\0\0INFO",
}


@pytest.mark.parametrize("name", TOLERATED)
def test_what_a_player_does_not_need_is_skipped(name):
    found = read(TOLERATED[name])
    assert found.keys == PLAYED
    assert not found.remarks


def test_a_damaged_track_is_played_up_to_the_damage_and_named():
    whole = b"\0\x90\x40\x50" + BEAT + b"\x40\0"
    both = song(whole + END, NOTE)
    for damaged in (both[:-8], both[:-4], both[:-2], song(whole + END, NOTE[:4] + b"\x80\x80\x80\x80\x80")):
        found = read(damaged)
        assert found.keys[64] == [(0.0, 80), (0.5, 0)]
        assert found.keys[60][0] == (0.0, 80)
        assert "track 2" in found.remarks[0]
    lost = read(both[: -len(track(NOTE))])
    assert (list(lost.keys), len(lost.remarks)) == ([64], 1)
    assert "2 tracks" in lost.remarks[0]
    with pytest.raises(RecordingError, match=r"song: .*track 1"):
        read(song(b"\x3c\x50" + NOTE))  # data bytes without a message


@pytest.mark.parametrize(
    ("frames", "ticks", "rate"), [(24, 10, 240), (25, 40, 1000), (29, 4, 120_000 / 1001), (30, 80, 2400)]
)
def test_smpte_time_counts_seconds_whatever_the_tempo(frames, ticks, rate):
    data = song(b"\0\xff\x51\3\1\0\0" + NOTE, division=(256 - frames) << 8 | ticks)
    assert read(data).keys[60] == [(0.0, 80), (pytest.approx(480 / rate), 0)]


def test_a_tempo_holds_for_all_tracks_from_its_own_time_on():
    tempo = b"\x81\x70\xff\x51\3\x0f\x42\x40" + END  # 1 s a beat after 240 ticks
    for tracks in ((tempo, NOTE), (NOTE, tempo)):
        assert read(song(*tracks)).keys[60] == [(0.0, 80), (0.25 + 0.5, 0)]


def moves(*events: tuple[int, int]) -> bytes:
    """A track of events (ticks since the last, velocity) of one key."""
    return b"".join(bytes([ticks, 0x90, 60, velocity]) for ticks, velocity in events) + END


def pressed(*events: tuple[int, int]) -> list[tuple[float, int]]:
    """Movements of the key, in beats of one tick."""
    return [(2 * now, how) for now, how in read(song(moves(*events), division=1)).keys[60]]


def test_a_key_is_released_when_all_its_strokes_have_ended():
    assert pressed((0, 80), (1, 70), (0, 0), (1, 0)) == [(0, 80), (1, 70), (2, 0)]
    assert pressed((0, 80), (1, 0), (0, 70), (1, 0)) == [(0, 80), (1, 0), (1, 70), (2, 0)]
    assert pressed((0, 80), (1, 70), (1, 0), (1, 0)) == [(0, 80), (1, 70), (3, 0)]
    assert pressed((0, 80), (1, 70), (1, 60), (1, 0), (1, 0), (1, 0)) == [(0, 80), (1, 70), (2, 60), (5, 0)]


def pedal(controller: int, value: int = 127, time: int = 0) -> mido.Message:
    return mido.Message("control_change", control=controller, value=value, time=time)


@pytest.mark.parametrize(
    ("messages", "motions"),
    [
        ([on(60), pedal(66), on(60, 0, 480), pedal(66, 0, 480)], [(0, 80, 0), (1, 0, 1)]),
        ([pedal(66), on(60), on(60, 0, 480), pedal(66, 0, 480)], [(0, 80, 0), (0.5, 0, 1)]),
        ([on(60), on(60, 0, 480), pedal(66), pedal(66, 0, 480)], [(0, 80, 0), (0.5, 0, 1)]),
        ([on(60), pedal(66, 127, 480), on(60, 0), pedal(66, 0, 480)], [(0, 80, 0), (1, 0, 1)]),
        ([on(60), pedal(123, 0, 480), pedal(66), pedal(66, 0, 480)], [(0, 80, 0), (0.5, 0, 1)]),
    ],
)
def test_the_middle_pedal_holds_the_keys_that_are_down_before_it(messages, motions):
    song = read_song(midi_bytes(*messages), "song")
    found = [(m.seconds, m.velocity, m.contact) for m in key_motions(song, 60, PedalRange(), 9.0)]
    np.testing.assert_allclose(found, motions, atol=1e-6)


def test_the_left_pedal_softens_the_strokes_after_it():
    song = read_song(midi_bytes(on(60), pedal(67), on(64), on(60, 0, 480), on(64, 0)), "song")
    soft = [key_motions(song, key, PedalRange(), 9.0)[0].soft for key in (60, 64)]
    assert soft == [0.0, 1.0]


def test_the_release_velocity_of_a_tick_with_pedals_is_kept():
    end = mido.Message("note_off", note=60, velocity=99, time=0)
    song = read_song(midi_bytes(pedal(66, 0), on(60), pedal(66, 127, 480), end, on(60)), "song")
    ((_, held),) = releases(song, 60)
    assert held == pytest.approx(0.5)
    assert [song.release_velocities[60, at] for at, _ in releases(song, 60)] == [99]


def test_strokes_of_one_key_at_one_time_are_the_hardest_of_them():
    song = read_song(midi_bytes(on(60, 40), on(60, 90, channel=1), on(60, 70, channel=2), on(60, 0, 480)), "song")
    assert song.keys[60] == [(0.0, 90)]


def test_the_order_of_a_repeated_note_within_its_tick_is_inaudible():
    orders = (((4, 80), (4, 70), (0, 0), (4, 0)), ((4, 80), (4, 0), (0, 70), (4, 0)))
    piano = true_instrument([60])
    one, two = (render_song(piano, read(song(moves(*order), division=16)), 8_000).samples for order in orders)
    assert (one == two).all()
    late = one[0, round(0.3 * 8_000) : round(0.35 * 8_000)]  # the second stroke, 0.05 s old, is not damped
    assert np.abs(late).max() > 0.1 * np.abs(one).max()


def test_a_stroke_that_is_never_ended_ends_at_the_next():
    assert pressed((0, 80), (1, 70), (1, 0), (1, 60), (1, 0)) == [(0, 80), (1, 0), (1, 70), (2, 0), (3, 60), (4, 0)]
    assert pressed((0, 80), (1, 0), (1, 0), (1, 70)) == [(0, 80), (1, 0), (3, 70)]
    # Notes without length: the end of the second is written first.
    assert pressed((0, 80), (0, 0), (1, 0), (0, 70), (1, 60), (1, 0)) == [
        (0, 80), (0, 0), (1, 70), (1, 0), (2, 60), (3, 0)
    ]  # fmt: skip


def test_a_channel_ends_its_own_strokes():
    one, two = b"\0\x90\x3c\x50\1\x3c\0" + END, b"\0\x91\x3c\x40\3\x3c\0" + END
    assert read(song(one, two, division=1)).keys[60] == [(0.0, 80), (1.5, 0)]
    everything_off = b"\0\x90\x3c\x50\0\x3c\x46\1\xb0\x7b\0\1\x90\x3c\0\1\x3c\x14\1\x3c\0" + END
    assert read(song(everything_off, division=1)).keys[60] == [(0, 80), (0.5, 0), (1.5, 20), (2.0, 0)]


NOTES = st.tuples(st.integers(0, 400), st.integers(1, 200), st.integers(58, 61), st.integers(1, 127))


@given(st.lists(NOTES, min_size=1, max_size=12), st.randoms())
def test_a_key_is_held_while_any_of_its_strokes_is(notes, random):
    """The order of simultaneous events, which writers choose freely, has no effect."""
    events = [(start, note, velocity) for start, _, note, velocity in notes]
    events += [(start + length, note, 0) for start, length, note, _ in notes]
    random.shuffle(events)
    events.sort(key=lambda event: event[0])
    messages = [on(n, v, now - before) for (now, n, v), (before, *_) in zip(events, [(0, 0, 0), *events], strict=False)]
    found = read(midi_bytes(*messages))
    for key, key_events in found.keys.items():
        held = [(start, start + length) for start, length, note, _ in notes if note == key]
        for now in {x + 0.5 for x, *_ in events}:
            before = [velocity for at, velocity in key_events if at * 960 < now]
            assert bool(before and before[-1]) == any(start < now < stop for start, stop in held)


@given(st.lists(st.tuples(st.integers(0, 3), st.integers(0, 500), st.integers(0, 9)), max_size=30))
def test_times_are_those_that_mido_reads(events):
    """Mido is an independent reader of the same file."""
    tracks = [mido.MidiTrack() for _ in range(4)]
    for which, ticks, what in events:
        tempo = mido.MetaMessage("set_tempo", tempo=100_000 * (what + 1), time=ticks)
        tracks[which].append(on(40 + what, 80, ticks, channel=which) if what < 8 else tempo)
    stream = io.BytesIO()
    mido.MidiFile(tracks=[mido.MidiTrack([on(100)]), *tracks], ticks_per_beat=96).save(file=stream)
    now, expected = 0.0, set[tuple[float, int]]()  # strokes of a key at one time are one
    for message in mido.MidiFile(file=io.BytesIO(stream.getvalue())):
        now += message.time
        if message.type == "note_on":
            expected.add((now, message.note))
    found = read(stream.getvalue())
    strokes = sorted((at, key) for key, key_events in found.keys.items() for at, velocity in key_events if velocity)
    assert [key for _, key in strokes] == [key for _, key in sorted(expected)]
    assert [at for at, _ in strokes] == pytest.approx([at for at, _ in sorted(expected)], abs=1e-9)
    assert found.seconds == pytest.approx(now, abs=1e-9)


@pytest.mark.parametrize(
    "content", [b"MTrk\xff\xff\xff\xff", b"MTrk\0\0\0\0", b"MThd", b"abcd\xff\xff\xff\xff", b"\0\xb0\x7b\0"]
)
def test_a_hostile_file_is_refused_at_once(content):
    with pytest.raises(RecordingError):
        read(song() + content * (2**20 // len(content)))
