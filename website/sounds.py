"""Sounds of the site, made by the program itself from published values. Equal sources give equal sounds."""

from __future__ import annotations

import io
from collections.abc import Iterator

import numpy as np
import soundfile

import pianofit
from pianofit.synthetic import demo_recording

RATE = 44_100  # Hz
SECONDS = 2.0  # of a single note
VELOCITIES = {"soft": 0.8, "mezzo": 2.0, "loud": 5.0}  # m/s, of the hammer
# A broken chord: MIDI key and its start, s. Each key is held for NOTE seconds; the pedal, if used, until PEDAL_UP.
CHORD = ((48, 0.0), (55, 0.25), (60, 0.5), (64, 0.75), (67, 1.0), (72, 1.25))
NOTE, PEDAL_UP = 0.2, 3.0  # s
MIDI_VELOCITY = 70
FULL_SCALE = 0.1  # of 1 N at the bridge: full scale is 10 N, above the force of the loudest stroke used here


def sound_files() -> dict[str, bytes]:
    """Return the sounds of the pages.

    Returns
    -------
    Path below the site's folder, to the content of a FLAC file.
    """
    return {f"sounds/{name}.flac": _flac(samples) for name, samples in _sounds()}


def _sounds() -> Iterator[tuple[str, np.ndarray]]:
    yield "demo", demo_recording().samples
    p = pianofit.preset("chabassier-F3")
    note = pianofit.Note(p.string, p.hammer, p.geometry, "bridge-force", gain=1.0)
    strokes = {name: note.render(velocity, seconds=SECONDS, rate=RATE) for name, velocity in VELOCITIES.items()}
    loudest = max(np.abs(samples).max() for samples in strokes.values())
    yield from ((f"note-{name}", 0.9 * samples / loudest) for name, samples in strokes.items())
    instrument = _literature()
    for name, pedal in (("chord-without-pedal", []), ("chord-with-pedal", [(0.0, 127), (PEDAL_UP, 0)])):
        yield name, pianofit.render_song(instrument, _chord(pedal), rate=RATE).samples.mean(axis=0)


def _literature() -> pianofit.Instrument:
    """Return an instrument with typical parameters at all 88 keys."""
    presets = {midi: pianofit.typical(midi) for midi in range(21, 109)}
    keys = {
        midi: pianofit.Key(pianofit.Note(it.string, it.hammer, it.geometry, "bridge-force", gain=FULL_SCALE))
        for midi, it in presets.items()
    }
    return pianofit.Instrument("literature", keys)


def _chord(pedal: list[tuple[float, int]]) -> pianofit.Song:
    keys = {key: [(start, MIDI_VELOCITY), (start + NOTE, 0)] for key, start in CHORD}
    return pianofit.Song(keys, pedal, seconds=PEDAL_UP, notes=len(CHORD))


def _flac(samples: np.ndarray) -> bytes:
    file = io.BytesIO()
    soundfile.write(file, samples / max(1.0, np.abs(samples).max()), RATE, format="FLAC", subtype="PCM_16")
    return file.getvalue()
