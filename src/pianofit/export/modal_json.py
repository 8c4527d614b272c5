"""Export to modal JSON: modes, patterns, knocks and forces of every key, for engines that play modes.

    sound(t) = F(t) ∗ (Re Σ_m g_m(v) P_m e^{p_m t} + knock(t, v))

A program that reads it needs a resonator a mode and a short convolution. `examples/players/modal_player.py` and
`examples/players/modal_player.js` are such programs, of some 40 lines.
"""

import os
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from ..analysis.note_names import midi_to_note
from ..felt import law_of
from ..instrument import Instrument
from ..io.files import replace_file
from ..model.modal_response import FILTER_REACH, PRE_ONSET_S, ModalResponse
from ..model.note import Note
from ..model.output_path import at_velocity
from ..playback.cached_strike import StringTables, strike_string, string_tables
from ..schema.decode import encode_json
from ..schema.modes_file import ForceEntry, ModeColumns, ModesFile, ModesKey, integers
from ..threads import numerical_settings

RATE = 48_000  # Hz
# MIDI velocities of the forces: between two neighbours the level of a partial changes by about 5 dB at most, so that a
# linear crossfade is within 0.3 dB of the right level.
VELOCITIES = (*range(1, 121, 7), 127)
# Digits of the numbers in the file: -100 dB.
DIGITS = 6


class ModalSummary(NamedTuple):
    """Contents of the written file."""

    keys: int
    unrecorded: int  # keys that were never recorded
    modes: int  # of all keys
    bytes: int


@numerical_settings()
def write_modal_json(
    path: str | os.PathLike[str],
    instrument: Instrument,
    keys: Sequence[int],
    *,
    licence: str | None = None,
    progress: Callable[[str, float], None] = lambda *_: None,
) -> ModalSummary:
    """Write an instrument as modal JSON, completely or not at all.

    Parameters
    ----------
    path : file to write.
    instrument : as `load_instrument` returns it.
    keys : MIDI numbers.
    licence : licence of the recordings, for the file.
    progress : called with the name of the step and the finished fraction.

    Returns
    -------
    A `ModalSummary`.

    Raises
    ------
    ParameterError
        For a key that the instrument lacks.
    OutputError
        If the file cannot be written.
    """
    entries = []
    for i, midi in enumerate(keys):
        entries.append(_key(instrument, midi))
        progress("modes", (i + 1) / len(keys))
    record = ModesFile(
        name=instrument.name,
        licence=licence,
        rate=RATE,
        lead=FILTER_REACH,
        knock_lead=round(PRE_ONSET_S * RATE),
        channels=instrument.channels,
        keys=tuple(entries),
    )
    content = encode_json(record)
    replace_file(path, content)
    modes = sum(len(entry.modes.frequency) for entry in entries)
    return ModalSummary(len(entries), len(instrument.unrecorded(keys)), modes, len(content))


def _key(instrument: Instrument, midi: int) -> ModesKey:
    note = instrument.note(midi, 64)
    table = string_tables(note, RATE)
    measured = note.modal_response
    response = _string_response(note, table) if measured is None else measured.scale_gain(note.gain).at(RATE)
    return ModesKey(
        midi,
        midi_to_note(midi),
        instrument.keys[midi].state,
        ModeColumns(
            response.partial,
            _rounded(np.imag(response.pole) / (2 * np.pi)),
            _rounded(-np.real(response.pole)),
            _rounded(instrument.dampers.rates(midi, np.imag(response.pole) / (2 * np.pi))),
        ),
        _rounded(np.stack([np.real(response.pattern), np.imag(response.pattern)], axis=1)),
        *integers(response.knock),
        *integers(response.knock_changes()),
        tuple(_force(instrument, midi, velocity, table, response) for velocity in VELOCITIES),
        _numbers(note.string, note.geometry),
        {name: x for name, x in _numbers(note.hammer).items() if name != law_of(note.hammer).size},
        dict(instrument.keys[midi].values),
    )


def _force(
    instrument: Instrument, midi: int, velocity: int, table: StringTables, response: ModalResponse
) -> ForceEntry:
    """Strike the key at rest."""
    _, force = strike_string(table, instrument.note(midi, velocity).hammer, f"key {midi}")
    gain = response.velocity_gain
    factor = np.ones(len(response.pole), complex) if gain is None else gain.at(force.velocity)
    strokes = len(response.knock_changes())
    share = at_velocity(gain.velocity, np.eye(strokes), force.velocity) if gain and strokes else np.zeros(0)
    amplitude = np.abs(response.pattern * factor * force.drive(response.pole))
    return ForceEntry(
        velocity,
        force.velocity,
        1e3 * (len(force.force) * force.step),
        _rounded(force.at(RATE)),
        _rounded(np.stack([np.real(factor), np.imag(factor)])),
        _rounded(20 * np.log10(np.linalg.norm(amplitude, axis=0) + 1e-30)),
        _rounded(share),
    )


def _numbers(*values: Any) -> dict[str, float]:
    """Return the fields of named tuples of the model."""
    return {name: float(x) for each in values for name, x in each._asdict().items()}


def _string_response(note: Note, table: StringTables) -> ModalResponse:
    """Modes of the string model through the levels of its output path, for a key without a measured response."""
    pole = np.asarray(table.modes.pole)
    db = 0.0 if note.path is None else note.path.at(np.imag(pole) / (2 * np.pi))
    pattern = table.per_impulse * 10 ** (np.asarray(db) / 20)
    sounding = np.flatnonzero((np.abs(pattern) > 0) & (np.imag(pole) < np.pi * RATE))
    number = 1 + sounding
    return ModalResponse(
        number, pole[sounding], np.zeros(len(sounding)), pattern[None, sounding], np.zeros((1, 0)), RATE
    )


def _rounded(values: np.ndarray) -> np.ndarray:
    """Round to `DIGITS` significant digits."""
    size = 10.0 ** (DIGITS - 1 - np.floor(np.log10(np.maximum(np.abs(values), 1e-300))))
    return np.where(np.abs(values) > 1e-290, np.round(values * size) / size, 0.0)
