"""A piece on a modelled piano: the first bars of Bach's C major prelude (BWV 846), written here as MIDI.

Without an argument the instrument has published parameters, `pianofit.typical` at every key. The argument can be the
instrument.json that `pianofit instrument` made from your fits:

    python 04_play.py [INSTRUMENT.JSON]

Every bar is one chord, broken twice. Its two lowest notes are held, and the pedal changes with the harmony. The example
needs mido to write the MIDI file: pip install mido.
"""

from __future__ import annotations

import sys
from pathlib import Path

import mido

import pianofit

BARS = """C4 E4 G4 C5 E5, C4 D4 A4 D5 F5, B3 D4 G4 D5 F5, C4 E4 G4 C5 E5, C4 E4 A4 E5 A5, C4 D4 F#4 A4 D5,
B3 D4 G4 D5 G5, B3 C4 E4 G4 C5, A3 C4 E4 G4 C5, D3 A3 D4 F#4 C5, G3 B3 D4 G4 B4, C3 G3 C4 E4 C5"""
ORDER = (0, 1, 2, 3, 4, 2, 3, 4)  # order of the notes of a chord in half a bar
BEATS_A_MINUTE, TICKS = 66, 120  # ticks in a sixteenth
STEPS = {"C": 0, "D": 2, "E": 4, "F": 5, "G": 7, "A": 9, "B": 11}


def key(note: str) -> int:
    """Return the MIDI number of a note such as F#4."""
    return 12 * (int(note[-1]) + 1) + STEPS[note[0]] + note.count("#")


def write_prelude(path: Path, bars: int) -> None:
    """Write the piece as a MIDI file: time, duration and velocity of each note."""
    events = []
    for half in range(2 * bars):
        chord = [key(note) for note in BARS.split(",")[half // 2].split()]
        start = 8 * half * TICKS
        if half % 2 == 0:
            events += [(start, 0, mido.Message("control_change", control=64, value=0)),
                       (start + TICKS // 4, 1, mido.Message("control_change", control=64, value=127))]  # fmt: skip
        for i, note in enumerate(ORDER):
            down = start + i * TICKS
            up = start + 8 * TICKS - 10 if i < 2 else down + TICKS - 10
            velocity = 62 - 2 * i + 3 * (half // 2 % 4)
            events += [(down, 2, mido.Message("note_on", note=chord[note], velocity=velocity)),
                       (up, 0, mido.Message("note_off", note=chord[note]))]  # fmt: skip
    track = mido.MidiTrack([mido.MetaMessage("set_tempo", tempo=mido.bpm2tempo(BEATS_A_MINUTE))])
    before = 0
    for now, _, message in sorted(events, key=lambda event: event[:2]):
        track.append(message.copy(time=now - before))
        before = now
    mido.MidiFile(type=0, ticks_per_beat=4 * TICKS, tracks=[track]).save(path)


def literature() -> pianofit.Instrument:
    """Return an instrument with typical parameters of a grand piano; its sound is the bridge force, full scale 10 N."""
    keys = {}
    for midi in range(21, 109):
        it = pianofit.typical(midi)
        keys[midi] = pianofit.Key(pianofit.Note(it.string, it.hammer, it.geometry, "bridge-force", gain=0.1))
    return pianofit.Instrument("literature", keys)


def main() -> None:
    """Write the MIDI file, play it, and write the sound."""
    instrument = pianofit.load_instrument(sys.argv[1]) if len(sys.argv) > 1 else literature()
    write_prelude(Path("prelude.mid"), bars=len(BARS.split(",")))
    song = pianofit.load_song("prelude.mid")
    done = pianofit.render_song(instrument, song, rate=48_000)
    pianofit.write_wav("prelude.wav", done.samples, 48_000)
    print(f"{song.notes} notes, {done.restrikes} of them on a string that still sounds")
    seconds = done.samples.shape[-1] / 48_000
    print(f"{seconds:.1f} s, peak {abs(done.samples).max():.3f}, limited by {done.limited_db:.1f} dB")


if __name__ == "__main__":
    main()
