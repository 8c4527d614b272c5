"""Writer of the Faust program: one voice, and the tables of all requested keys."""

import math
import os
from collections.abc import Callable, Iterator, Sequence
from string import Template
from typing import NamedTuple

import numpy as np

from ...errors import ParameterError
from ...instrument import Instrument
from ...io.files import PEAK_LIMIT, check_ending, printable, replace_file
from ...model.modal_response import FILTER_REACH
from ...playback.midi import SWITCH
from ...playback.pedals import PedalRange
from ...playback.voice import CHANNELS, KNOCK_RATES, StringVoice
from ...report.html import asset
from ...schema.dampers import LAST_DAMPER, Dampers
from ...threads import numerical_settings
from ..layers import LARGEST_TRANSPOSITION, LOUDEST
from ..samples import LEVEL_SECONDS, render_stroke
from .tables import KNOCK_SHAPES, MARGIN, RATE, VELOCITIES, KeyTables, LowRankSignals, tabulate_key, tabulate_knock

# Largest number of resonators per voice: 16 voices then use a quarter of one core, see benchmarks/faust.py.
MODES = 128
# Resonators that are switched on and off together: few branches per sample, and few resonators computed in vain.
GROUP = 8
# Largest number of table entries: a program of 12 MB. The time limit of the Faust compiler is two minutes by default.
MOST_NUMBERS = 2_500_000


class FaustSummary(NamedTuple):
    """Contents of the written program."""

    keys: int  # keys with tables
    unrecorded: int  # keys with tables that were never recorded
    modes: int  # resonators per voice
    omitted_modes: int  # modes beyond that number, over all keys
    knock_rate: int | None  # Hz; None without knocks, or if they exceed the table size
    table_entries: int  # entries of all tables
    gain_db: float  # of all keys


@numerical_settings()
def write_faust(
    path: str | os.PathLike[str],
    instrument: Instrument,
    keys: Sequence[int],
    *,
    licence: str | None = None,
    progress: Callable[[str, float], None] = lambda *_: None,
) -> FaustSummary:
    """Write a Faust program, completely or not at all. The loudest stroke of the loudest key peaks at -1 dBFS.

    Parameters
    ----------
    path : file to write, whose name ends in .dsp.
    instrument : as `load_instrument` returns it.
    keys : MIDI keys to tabulate, ascending. The others are transposed from the nearest one.
    licence : licence of the source, in the words of the user.
    progress : called with the name of the step and the finished fraction.

    Returns
    -------
    Numbers of keys, resonators and table entries, the rate of the knocks, and the common gain.

    Raises
    ------
    ParameterError
        For a key that the instrument lacks, a felt law that cannot be played, or tables that are too large.
    OutputError
        If `path` cannot be written.

    Examples
    --------
    >>> import pianofit
    >>> pianofit.write_faust("piano.dsp", pianofit.load_instrument("instrument.json"), [60, 64]).unrecorded
    0
    """
    check_ending(path, ".dsp")
    if not keys:
        raise ParameterError("keys=[]: give the MIDI keys to tabulate")
    for key in keys:
        instrument.note(key, 64)
    channels, peak, key_tables = min(instrument.channels, CHANNELS), 0.0, []
    for i, midi in enumerate(keys):
        string = StringVoice(instrument.note(midi, LOUDEST), midi, RATE)
        peak = max(peak, float(np.abs(render_stroke(instrument, string, LOUDEST, LEVEL_SECONDS)).max()))
        key_tables.append(tabulate_key(instrument, midi, MODES, channels))
        progress("tables", 0.98 * (i + 1) / len(keys))
    gain = PEAK_LIMIT / peak if peak > 0 else 1.0
    rate, knocks, numbers = _fit_knocks(key_tables)
    definitions = [*_damper_tables(keys, key_tables, instrument.dampers)]
    definitions += _key_tables(keys, key_tables, channels, gain)
    if rate:
        definitions += _knock_tables(knocks, channels, gain)
    modes = max(len(key.pole) for key in key_tables)
    program = Template(asset("instrument.dsp", "pianofit.export.faust")).substitute(
        name=_quoted(instrument.name or "piano"),
        licence=_quoted(licence or "not given"),
        channels=channels,
        groups=-(-modes // GROUP),
        group=GROUP,
        velocities=len(VELOCITIES),
        rate=RATE,
        rank=max(len(key.force.scale) for key in key_tables),
        knock_rank=KNOCK_SHAPES,
        knock_rate=rate or RATE,
        margin=MARGIN,
        touch=_digits(max(instrument.pre_onset_s - FILTER_REACH / RATE, 0.0) - MARGIN / RATE),
        switch=SWITCH,
        slope=_digits(instrument.dampers.slope),
        pedal_low=_digits(PedalRange().low),
        pedal_high=_digits(PedalRange().high),
        tables="\n".join(definitions),
        knock="+(knock(c))" if rate else "_",
    )
    replace_file(path, program.encode())
    return FaustSummary(
        keys=len(keys),
        unrecorded=len(instrument.unrecorded(keys)),
        modes=modes,
        omitted_modes=sum(key.left_out for key in key_tables),
        knock_rate=rate,
        table_entries=numbers,
        gain_db=20 * math.log10(gain),
    )


def _fit_knocks(key_tables: Sequence[KeyTables]) -> tuple[int | None, list[LowRankSignals], int]:
    """Highest rate of knocks, Hz, within the table size; the knocks, or none; and the number of all table entries."""
    size = sum(key.numbers for key in key_tables)
    for rate in KNOCK_RATES if any(key.knock[2].size for key in key_tables) else ():
        knocks = [tabulate_knock(key, rate) for key in key_tables]
        total = size + sum(knock.numbers for knock in knocks)
        if total <= MOST_NUMBERS:
            return rate, knocks, total
    if size <= MOST_NUMBERS:
        return None, [], size
    raise ParameterError(
        f"{len(key_tables)} keys need {size:,} table entries, more than {MOST_NUMBERS:,}; choose fewer --keys"
    )


def _damper_tables(keys: Sequence[int], key_tables: Sequence[KeyTables], dampers: Dampers) -> Iterator[str]:
    """Definitions of the rates that dampers add at the fundamental, and to the mode that they damp most slowly."""
    hertz = [np.abs(np.imag(key.pole)) / (2 * np.pi) for key in key_tables]
    at_fundamental = [dampers.rate(midi) for midi in keys]
    yield _table("damper_of_row", at_fundamental)
    slowest = [
        dampers.rates(midi, hz).min(initial=rate) for midi, hz, rate in zip(keys, hertz, at_fundamental, strict=True)
    ]
    yield _table("slowest_of_row", slowest)


def _key_tables(keys: Sequence[int], key_tables: Sequence[KeyTables], channels: int, gain: float) -> Iterator[str]:
    """Definitions of all tables except the knocks. Rows of keys are concatenated, with the offset of each row."""
    # A key without damper is transposed from another one if possible, and a key with damper likewise.
    sampled, midi = np.array(keys), np.arange(128)[:, None]
    other_side = (sampled <= LAST_DAMPER) != (midi <= LAST_DAMPER)
    yield _table("row_of_key", np.argmin(np.abs(sampled - midi) + LARGEST_TRANSPOSITION * other_side, axis=1))
    yield _table("key_of_row", keys)
    count = [len(key.pole) for key in key_tables]
    yield _table("mode_count", count)
    yield _table("mode_begin", np.cumsum([0, *count[:-1]]))
    yield _table("mode_decay", np.concatenate([-np.real(key.pole) for key in key_tables]))
    yield _table("mode_omega", np.concatenate([np.imag(key.pole) for key in key_tables]))
    for c in range(channels):
        pattern = gain * np.concatenate([key.pattern[c] for key in key_tables])
        yield _table(f"mode_re({c})", np.real(pattern))
        yield _table(f"mode_im({c})", np.imag(pattern))
    yield _table("stroke_count", [len(key.velocity_gain) for key in key_tables])
    yield _table("stroke_of_velocity", np.concatenate([key.stroke for key in key_tables]))
    yield _table("part_scale", [key.velocity_gain_scale for key in key_tables])
    yield _table("part_begin", _begins([key.velocity_gain[0] for key in key_tables]))
    for c, name in enumerate(("part_re", "part_im")):
        yield _table(name, np.concatenate([key.velocity_gain[c].ravel() for key in key_tables]))
    forces = [key.force for key in key_tables]
    yield from _shapes("force", forces)
    yield _table("force_shape", np.concatenate([force.shape[0].T.ravel() for force in forces]))


def _knock_tables(knocks: Sequence[LowRankSignals], channels: int, gain: float) -> Iterator[str]:
    """Definitions of the tables of knocks."""
    yield from _shapes("knock", [knock._replace(loud=gain * knock.loud) for knock in knocks])
    for c in range(channels):
        yield _table(f"knock_shape({c})", np.concatenate([knock.shape[c].T.ravel() for knock in knocks]))


def _shapes(name: str, signals: Sequence[LowRankSignals]) -> Iterator[str]:
    """Definitions of ranks, sizes, offsets, scales and coefficients of signals, without the shapes themselves."""
    yield _table(f"{name}_rank", [len(x.scale) for x in signals])
    yield _table(f"{name}_size", [x.shape.shape[-1] for x in signals])
    yield _table(f"{name}_begin", _begins([x.shape[0] for x in signals]))
    yield _table(f"{name}_scale_begin", _begins([x.scale for x in signals]))
    yield _table(f"{name}_scale", np.concatenate([x.scale for x in signals]))
    yield _table(f"{name}_part_begin", _begins([x.part for x in signals]))
    yield _table(f"{name}_part", np.concatenate([x.part.ravel() for x in signals]))
    yield _table(f"{name}_loud", np.concatenate([x.loud for x in signals]))


def _begins(tables: Sequence[np.ndarray]) -> np.ndarray:
    """Offsets of concatenated tables."""
    return np.cumsum([0, *(x.size for x in tables[:-1])])


def _table(name: str, values: Sequence[float] | np.ndarray) -> str:
    """Definition of a table as a Faust box with one input, the index."""
    return f"{name} = waveform{{{','.join(map(_digits, values))}}}, int : rdtable;"


def _digits(value: float) -> str:
    """Text of a number: an integer in full, otherwise the digits of single precision."""
    return str(value) if isinstance(value, int | np.integer) else f"{value:.8g}"


def _quoted(text: str) -> str:
    return printable(text).replace("\\", "/").replace('"', "'")
