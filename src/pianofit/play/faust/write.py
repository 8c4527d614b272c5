"""One Faust program that is an instrument: a voice, and the tables of all sampled keys."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterator, Sequence
from string import Template
from typing import NamedTuple

import numpy as np

from ...errors import ParameterError
from ...io import CEILING, one_line, replace_file
from ...keyboard.document import Instrument
from ...model.modal import EDGE
from ...report.kit import asset
from ...threads import one_blas_thread
from ..layers import LOUDEST
from ..samples import LEVEL_SECONDS, stroke
from ..strings import CHANNELS, KNOCK_RATES, PlayedString, damper_rate
from .tables import KNOCK_SHAPES, MARGIN, RATE, SHAPES, VELOCITIES, Key, kept_at, key_of

__all__ = ["MODES", "Program", "write_faust"]

# Resonators of a voice: 16 voices then take less than a core's time, see benchmarks/faust.py.
MODES = 128
# Numbers of all tables: Faust takes the longer the more there are, and gives up after two minutes by default.
MOST_NUMBERS = 240_000
MIDI_KEYS = 128


class Program(NamedTuple):
    """What was written."""

    keys: int  # with tables of their own
    guesses: int  # of them, never recorded
    modes: int  # of a voice
    left_out: int  # modes of keys that have more
    knock_rate: int | None  # Hz, at which knocks are kept; none where there is none, or no room for them
    numbers: int  # in all tables
    gain_db: float  # of all


@one_blas_thread()
def write_faust(
    path: str | os.PathLike[str], instrument: Instrument, keys: Sequence[int], *, licence: str | None = None,
    progress: Callable[[str, float], None] = lambda *_: None,
) -> Program:  # fmt: skip
    """Write `path`, a .dsp, whole or not at all; the loudest stroke of the loudest key peaks at -1 dBFS.

    Raises `ParameterError` for a key that the instrument does not have, a felt that cannot be played, or more keys than
    there is room for; `OutputError` if `path` cannot be written.
    """
    if not keys:
        raise ParameterError("keys=[]: give the MIDI keys that are to have tables of their own")
    for key in keys:
        instrument.note(key, 64)
    channels, peak, found = min(instrument.channels, CHANNELS), 0.0, []
    for i, midi in enumerate(keys):
        string = PlayedString(instrument.note(midi, LOUDEST), midi, RATE)
        peak = max(peak, float(np.abs(stroke(instrument, string, LOUDEST, LEVEL_SECONDS)).max()))
        found.append(key_of(instrument, midi, MODES, channels))
        progress("tables", 0.98 * (i + 1) / len(keys))
    gain = CEILING / peak if peak > 0 else 1.0
    kept, numbers = _within(found, keys)
    modes = max(len(key.pole) for key in kept)
    text = _text(instrument, keys, kept, channels, modes, gain, licence)
    replace_file(path, text.encode())
    return Program(
        len(keys), len(instrument.unrecorded(keys)), modes, sum(key.left_out for key in kept),
        kept[0].knock_rate if _knocks(kept) else None, numbers, 20 * math.log10(gain),
    )  # fmt: skip


def _knocks(keys: Sequence[Key]) -> bool:
    return any(key.knock.any() for key in keys)


def _within(found: Sequence[Key], keys: Sequence[int]) -> tuple[list[Key], int]:
    """Keys with their knocks at the highest rate that leaves room, or without, and how many numbers they are."""
    size = 0
    for rate in (*KNOCK_RATES, None):
        kept = [kept_at(key, rate) for key in found]
        size = sum(_numbers(key, _knocks(kept)) for key in kept)
        if size <= MOST_NUMBERS:
            return kept, size
    raise ParameterError(
        f"{len(keys)} keys need {size:,} numbers, and Faust compiles {MOST_NUMBERS:,}; ask for fewer --keys"
    )


def _numbers(key: Key, knocks: bool) -> int:
    """How many a key has in the tables: complex ones count twice."""
    knock = knocks * (key.knock.size + key.knock_weights.size)
    modes = key.pole.size + key.pattern.size + key.participation.size
    return 2 * modes + key.shapes.size + key.weights.size + key.stroke.size + knock


def _text(
    instrument: Instrument, keys: Sequence[int], kept: Sequence[Key], channels: int, modes: int, gain: float,
    licence: str | None,
) -> str:  # fmt: skip
    knocks = _knocks(kept)
    heard = [f"below*(at(mode_re_{c}, k)*re - at(mode_im_{c}, k)*im)" for c in range(channels)]
    added = [f"+(knock(knock_{c}))" if knocks else "_" for c in range(channels)]
    through = ", ".join(["_"] * channels)
    lead = instrument.lead
    return Template(asset("instrument.dsp", "pianofit.play.faust")).substitute(
        name=_quoted(instrument.name or "piano"), licence=_quoted(licence or "none was given"),
        modes=modes, rank=SHAPES, knocks=KNOCK_SHAPES, velocities=len(VELOCITIES), rate=RATE,
        knock_rate=kept[0].knock_rate, touch=_digits(max(lead - EDGE / RATE, 0.0) - MARGIN / RATE),
        tables="\n".join(_tables(keys, kept, channels, gain, knocks)), heard=", ".join(heard),
        sum=f"({through}) : ({', '.join(added)})",
    )  # fmt: skip


def _tables(keys: Sequence[int], kept: Sequence[Key], channels: int, gain: float, knocks: bool) -> Iterator[str]:
    """Waveforms: columns of rows one after the other, with where each row begins."""
    nearest = [int(np.argmin(np.abs(np.array(keys) - midi))) for midi in range(MIDI_KEYS)]
    yield _waveform("row_of_key", nearest)
    yield _waveform("key_of_row", keys)
    yield _waveform("damper_of_row", [damper_rate(key) for key in keys])
    count = [len(key.pole) for key in kept]
    yield _waveform("mode_count", count)
    yield _waveform("mode_begin", 1 + np.cumsum([0, *count[:-1]]))
    yield _waveform("mode_decay", [1.0, *np.concatenate([-np.real(key.pole) for key in kept])])
    yield _waveform("mode_omega", [1.0, *np.concatenate([np.imag(key.pole) for key in kept])])
    for c in range(channels):
        pattern = gain * np.concatenate([key.pattern[c] for key in kept])
        yield _waveform(f"mode_re_{c}", [0.0, *np.real(pattern)])
        yield _waveform(f"mode_im_{c}", [0.0, *np.imag(pattern)])
    yield _waveform("stroke_count", [len(key.participation) for key in kept])
    yield _waveform("stroke_of_velocity", np.concatenate([key.stroke for key in kept]))
    yield _waveform("part_begin", np.cumsum([0, *(key.participation.size for key in kept[:-1])]))
    parts = np.concatenate([key.participation.ravel() for key in kept])
    yield _waveform("part_re", np.real(parts))
    yield _waveform("part_im", np.imag(parts))
    yield from _shaped("force", [key.shapes for key in kept], [key.weights for key in kept])
    yield _waveform("force_shapes", np.concatenate([key.shapes.ravel() for key in kept]))
    if knocks:
        yield from _shaped("knock", [key.knock[0] for key in kept], [key.knock_weights for key in kept])
        for c in range(channels):
            yield _waveform(f"knock_{c}", gain * np.concatenate([key.knock[c].ravel() for key in kept]))


def _shaped(name: str, shapes: Sequence[np.ndarray], weights: Sequence[np.ndarray]) -> Iterator[str]:
    """Where the shapes of each row begin, how long each of them is, and their weights."""
    yield _waveform(f"{name}_begin", np.cumsum([0, *(x.size for x in shapes[:-1])]))
    yield _waveform(f"{name}_size", [x.shape[-1] for x in shapes])
    yield _waveform(f"{name}_weights", np.concatenate([x.ravel() for x in weights]))


def _waveform(name: str, values: Sequence[float] | np.ndarray) -> str:
    return f"{name} = waveform{{{','.join(map(_digits, values))}}};"


def _digits(value: float) -> str:
    """As many as single precision has."""
    return f"{value:.8g}"


def _quoted(text: str) -> str:
    return one_line(text).replace("\\", "/").replace('"', "'")
