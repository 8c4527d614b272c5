"""A synthetic piano for benchmarks. All keys have the modes and knocks of keys with five stereo layers.

Numbers of partials and modes are those that fits of a grand find: 85 partials with 248 modes at A0, 31 with 106 at C4.
Levels, decays, knocks and how modes take part in strokes are drawn at random about what such fits show. It shows
what an instrument costs, not how one sounds.

    python benchmarks/synthetic_piano.py OUT.JSON [--keys A0-C8]        written as an instrument.json
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from pianofit.analysis.note_names import parse_keys
from pianofit.instrument import Instrument, Key, VelocityCurve, write_instrument
from pianofit.literature import typical
from pianofit.model.modal_response import PRE_ONSET_S, ModalResponse, VelocityGain
from pianofit.model.note import Note
from pianofit.schema.instrument import FitSummary

CHANNELS = 2
RATE = 48_000  # Hz
# The highest partial, Hz.
HIGHEST = 9_000.0
MOST_PARTIALS = 85
# Modes of a partial: 3 in the mean.
MODES = (2, 3, 4)
# Velocities of the layers, m/s.
STROKES = np.array([0.4, 0.8, 1.6, 2.8, 4.5])
# How far a mode's part in a stroke wanders from layer to layer, relative.
WANDER = 0.1
# How long a knock lasts after the contact, s.
KNOCK_SECONDS = 0.4
# Its decay, 1/s.
KNOCK_DECAY = 15.0
# Its standard deviation at the contact, file units over N s, relative to modes of 1 for the first partial.
KNOCK_LEVEL = 0.05
# Where a first-order lowpass begins to take its treble, Hz.
KNOCK_CORNER = 400.0
# A hammer at MIDI velocity 64, m/s.
AT_64 = 1.3
# The rise of the logarithm of the velocity from there to 127.
RISE = 1.5


def measured_note(midi: int) -> Note:
    """One key."""
    random, it = np.random.default_rng(midi), typical(midi)
    note = Note(it.string, it.hammer, it.geometry, "bridge-force", 1.0)
    partials = note.frequencies(MOST_PARTIALS)
    partials = partials[: max(int((partials < HIGHEST).sum()), 1)]
    number = np.repeat(np.arange(1, len(partials) + 1), random.choice(MODES, len(partials)))
    law = it.string.b1 + it.string.b2 * (number * np.pi / it.geometry.length) ** 2
    split = 1 + 3e-4 * random.normal(size=len(number))
    pole = -law * random.uniform(0.3, 2.0, len(number)) + 2j * np.pi * partials[number - 1] * split
    level = np.exp(random.normal(0.0, 1.0, (CHANNELS, len(number)))) / number
    pattern = level * np.exp(2j * np.pi * random.uniform(size=level.shape))
    away = WANDER * (random.normal(size=(len(STROKES), len(number), 2)) @ np.array([1.0, 1j]))
    part = VelocityGain(STROKES, 1 + np.cumsum(away, axis=0))
    ringing = ModalResponse(number, pole, np.full(len(number), 0.01), pattern, _knock(random), RATE, part)
    return note._replace(modal_response=ringing)


def _knock(random: np.random.Generator) -> np.ndarray:
    count = round((PRE_ONSET_S + KNOCK_SECONDS) * RATE)
    white = np.fft.rfft(random.normal(size=(CHANNELS, count)))
    low = np.fft.irfft(white / (1 + 1j * np.fft.rfftfreq(count, 1 / RATE) / KNOCK_CORNER), count)
    late = np.arange(count) / RATE - PRE_ONSET_S
    return KNOCK_LEVEL * low / low.std() * np.exp(-KNOCK_DECAY * np.maximum(late, 0)) * (1 - np.exp(-np.arange(count)))


def piano(keys: Iterable[int]) -> Instrument:
    """An instrument of these keys, all recorded."""
    return Instrument(
        "made", {midi: Key(measured_note(midi), fit=FitSummary()) for midi in keys}, VelocityCurve(AT_64, RISE)
    )


def main() -> None:
    """Write the file."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--keys", default="A0-C8")
    asked = parser.parse_args()
    write_instrument(asked.out, piano(parse_keys(asked.keys)))
    print(f"{asked.out}: {asked.out.stat().st_size / 1e6:.1f} MB")


if __name__ == "__main__":
    main()
