"""One Faust program that is an instrument: a voice, and the tables of all sampled keys."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterator, Sequence
from string import Template
from typing import NamedTuple

import numpy as np

from ...errors import ParameterError
from ...instrument.document import Instrument
from ...io.files import PEAK_LIMIT, printable, replace_file
from ...model.modal_response import EDGE
from ...playback.voice import CHANNELS, KNOCK_RATES, StringVoice, damper_rate
from ...report.html import asset
from ...threads import one_blas_thread
from ..layers import LOUDEST
from ..samples import LEVEL_SECONDS, stroke
from .tables import KNOCK_SHAPES, MARGIN, RATE, VELOCITIES, KeyTables, LowRankSignals, key_of, knock_at

__all__ = ["MODES", "Program", "write_faust"]

# Resonators of a voice at the most: 16 voices then take a quarter of a core's time, see benchmarks/faust.py.
MODES = 128
# Of them so many are computed, or not, together: as few branches a sample as leave little that is in vain.
GROUP = 8
# Numbers of all tables: a program of 12 MB. Faust gives up after two minutes by default.
MOST_NUMBERS = 2_500_000
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
        string = StringVoice(instrument.note(midi, LOUDEST), midi, RATE)
        peak = max(peak, float(np.abs(stroke(instrument, string, LOUDEST, LEVEL_SECONDS)).max()))
        found.append(key_of(instrument, midi, MODES, channels))
        progress("tables", 0.98 * (i + 1) / len(keys))
    gain = PEAK_LIMIT / peak if peak > 0 else 1.0
    rate, knocks, numbers = _within(found)
    modes = max(len(key.pole) for key in found)
    tables = [*_tables(keys, found, channels, gain), *(_knocks(knocks, channels, gain) if rate else ())]
    text = _text(instrument, tables, found, channels, rate, licence)
    replace_file(path, text.encode())
    return Program(
        len(keys), len(instrument.unrecorded_keys(keys)), modes, sum(key.left_out for key in found), rate, numbers,
        20 * math.log10(gain),
    )  # fmt: skip


def _within(found: Sequence[KeyTables]) -> tuple[int | None, list[LowRankSignals], int]:
    """The highest rate of knocks, Hz, that leaves room; knocks at it, or none; and how many numbers all are."""
    size = sum(key.numbers for key in found)
    for rate in KNOCK_RATES if any(key.knock[2].size for key in found) else ():
        knocks = [knock_at(key, rate) for key in found]
        whole = size + sum(knock.numbers for knock in knocks)
        if whole <= MOST_NUMBERS:
            return rate, knocks, whole
    if size <= MOST_NUMBERS:
        return None, [], size
    raise ParameterError(
        f"{len(found)} keys need {size:,} numbers, and Faust compiles {MOST_NUMBERS:,}; ask for fewer --keys"
    )


def _text(
    instrument: Instrument, tables: Sequence[str], kept: Sequence[KeyTables], channels: int, knock_rate: int | None,
    licence: str | None,
) -> str:  # fmt: skip
    modes = max(len(key.pole) for key in kept)
    return Template(asset("instrument.dsp", "pianofit.export.faust")).substitute(
        name=_quoted(instrument.name or "piano"), licence=_quoted(licence or "none was given"),
        channels=channels, groups=-(-modes // GROUP), group=GROUP, velocities=len(VELOCITIES), rate=RATE,
        rank=max(len(key.force.scale) for key in kept), knock_rank=KNOCK_SHAPES, knock_rate=knock_rate or RATE,
        margin=MARGIN,
        touch=_digits(max(instrument.lead - EDGE / RATE, 0.0) - MARGIN / RATE), tables="\n".join(tables),
        knock="+(knock(c))" if knock_rate else "_",
    )  # fmt: skip


def _tables(keys: Sequence[int], kept: Sequence[KeyTables], channels: int, gain: float) -> Iterator[str]:
    """Columns of rows one after the other, with where each row begins."""
    nearest = [int(np.argmin(np.abs(np.array(keys) - midi))) for midi in range(MIDI_KEYS)]
    yield _table("row_of_key", nearest)
    yield _table("key_of_row", keys)
    yield _table("damper_of_row", [damper_rate(key) for key in keys])
    count = [len(key.pole) for key in kept]
    yield _table("mode_count", count)
    yield _table("mode_begin", np.cumsum([0, *count[:-1]]))
    yield _table("mode_decay", np.concatenate([-np.real(key.pole) for key in kept]))
    yield _table("mode_omega", np.concatenate([np.imag(key.pole) for key in kept]))
    for c in range(channels):
        pattern = gain * np.concatenate([key.pattern[c] for key in kept])
        yield _table(f"mode_re({c})", np.real(pattern))
        yield _table(f"mode_im({c})", np.imag(pattern))
    yield _table("stroke_count", [len(key.participation) for key in kept])
    yield _table("stroke_of_velocity", np.concatenate([key.stroke for key in kept]))
    yield _table("part_scale", [key.participation_scale for key in kept])
    yield _table("part_begin", _begins([key.participation[0] for key in kept]))
    for c, name in enumerate(("part_re", "part_im")):
        yield _table(name, np.concatenate([key.participation[c].ravel() for key in kept]))
    forces = [key.force for key in kept]
    yield from _shapes("force", forces)
    yield _table("force_shape", np.concatenate([force.shape[0].T.ravel() for force in forces]))


def _knocks(knocks: Sequence[LowRankSignals], channels: int, gain: float) -> Iterator[str]:
    """The same of knocks."""
    yield from _shapes("knock", [knock._replace(loud=gain * knock.loud) for knock in knocks])
    for c in range(channels):
        yield _table(f"knock_shape({c})", np.concatenate([knock.shape[c].T.ravel() for knock in knocks]))


def _shapes(name: str, found: Sequence[LowRankSignals]) -> Iterator[str]:
    """All but the shapes themselves, which stand sample by sample: where those of a row begin, how long they are."""
    yield _table(f"{name}_rank", [len(x.scale) for x in found])
    yield _table(f"{name}_size", [x.shape.shape[-1] for x in found])
    yield _table(f"{name}_begin", _begins([x.shape[0] for x in found]))
    yield _table(f"{name}_scale_begin", _begins([x.scale for x in found]))
    yield _table(f"{name}_scale", np.concatenate([x.scale for x in found]))
    yield _table(f"{name}_part_begin", _begins([x.part for x in found]))
    yield _table(f"{name}_part", np.concatenate([x.part.ravel() for x in found]))
    yield _table(f"{name}_loud", np.concatenate([x.loud for x in found]))


def _begins(tables: Sequence[np.ndarray]) -> np.ndarray:
    """Where each begins, of tables one after the other."""
    return np.cumsum([0, *(x.size for x in tables[:-1])])


def _table(name: str, values: Sequence[float] | np.ndarray) -> str:
    """A box with one input, the index."""
    return f"{name} = waveform{{{','.join(map(_digits, values))}}}, int : rdtable;"


def _digits(value: float) -> str:
    """As many as single precision has, and all of a whole number."""
    return str(value) if isinstance(value, int | np.integer) else f"{value:.8g}"


def _quoted(text: str) -> str:
    return printable(text).replace("\\", "/").replace('"', "'")
