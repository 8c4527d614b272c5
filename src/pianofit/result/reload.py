"""A fit read back: its notes from `fit.json` alone, and its recordings from their files, played beside it again.

The document holds what a fit found, and the levels that it compared. Recordings and their analyses are made again, from
files whose SHA-256 must be the recorded one, so that they are what the fit was made of.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from ..analysis import Analysis, analyse
from ..errors import AnalysisError, FitError, ParameterError, RecordingError
from ..fit_file import WAY_OUT, read_path
from ..io.files import array_of, printable, reference_of, require_finite, table_of
from ..model.note import Note
from ..parameters import STRING_NAMES, String, check
from ..recording.recording import Recording, Source, to_recording
from ..threads import one_blas_thread
from .comparison import RecordingComparison
from .result import FittedRecording, Result

__all__ = ["every_note", "initial_note", "levels_of", "recalled"]

AGAIN = "fit the recordings again"
# An analysis is of the note that was fitted if its pitch is within this, cents, of the string's.
SAME = 30.0
# Of the table of levels that a recording has.
COLUMNS = ("number", "measured", "error", "initial", "fitted")


# --- notes ------------------------------------------------------------------------------------------------------------


def every_note(document: dict[str, Any], mixture: Sequence[Note], name: str) -> tuple[tuple[Note, ...], ...]:
    """The notes of all minima for every recording [minima][recordings], from those of the reference.

    Raises
    ------
    FitError
        Naming the file and the entry that cannot be used.
    """
    rows = document["recordings"]
    if not all(isinstance(row, dict) for row in rows):
        raise FitError(f"{name}: every entry of recordings must be a table; {WAY_OUT}")
    struck = [_velocities(document, rows, which, float(note.hammer.v_H0)) for which, note in enumerate(mixture)]
    return tuple(
        tuple(_of_row(document, at, note, velocity, name) for at, velocity in enumerate(velocities))
        for note, velocities in zip(mixture, struck, strict=True)
    )


def _velocities(document: dict[str, Any], rows: list[dict], which: int, own: float) -> list[Any]:
    """The velocity of every recording's stroke at one minimum."""
    if not which:
        return [row.get("v_H0", own) for row in rows]
    found = array_of(document["minima"][which].get("velocities"), None).tolist()
    strokes = [row.get("stroke") for row in rows]
    return [found[s] if isinstance(s, int) and 0 <= s < len(found) else own for s in strokes]


def _of_row(document: dict[str, Any], at: int, note: Note, velocity: Any, name: str) -> Note:
    """The reference's `note` as that of another recording."""
    (place, reference), row = reference_of(document["recordings"]), document["recordings"][at]
    where = f"{name}: recordings[{at}]"
    if at == place:
        return note
    cents, gain, v = (
        require_finite(value, f"{where}.{key}", WAY_OUT)
        for key, value in (("cents", row.get("cents", 0.0)), ("gain", row.get("gain")), ("v_H0", velocity))
    )
    try:
        c = float(note.string.c) * 2 ** (cents / 1200)
        check({"v_H0": v, "c": c}, where)
    except (OverflowError, ParameterError) as error:
        raise FitError(str(error)) from None
    own = note.with_velocity(v)._replace(string=note.string._replace(c=c), gain=gain)
    if row.get("group") == reference.get("group"):
        return own
    paths = document["pickup"].get("paths")
    path = paths.get(str(row.get("group"))) if isinstance(paths, dict) else None
    return own._replace(path=read_path(path, f"{name}: pickup.paths", WAY_OUT), ringing=None)


def initial_note(result: Result, at: int) -> Note:
    """What a fit began with, of one recording, without a gain and a path.

    Raises
    ------
    FitError
        If the file is an older one and does not hold it.
    """
    table, row = result.document["parameters"], result.document["recordings"][at]
    values = {name: entry.get("initial") for name, entry in table.items()} | {"v_H0": row.get("v_H0_initial")}
    values = {
        name: require_finite(value, f"initial {name}", AGAIN) for name, value in values.items() if value is not None
    }
    note = result.minima_notes[0][at]
    try:
        string = String(**check({name: values[name] for name in STRING_NAMES}, "initial"))
        hammer = type(note.hammer)(**{name: values[name] for name in note.hammer._fields})
        geometry = note.geometry._replace(strike_position=values["x0"], width=values["width"])
    except KeyError as missing:
        raise FitError(f"this fit.json does not hold the initial {missing.args[0]}; {AGAIN}") from None
    return Note(string, hammer, geometry, note.quantity, 1.0)


def levels_of(document: dict[str, Any], at: int) -> dict[str, np.ndarray]:
    """The partials' levels that were compared of one recording, dB [partials], by `COLUMNS`.

    Raises
    ------
    FitError
        If the file is an older one, or holds something else.
    """
    table = document["recordings"][at].get("partials")
    columns = array_of([table.get(name) for name in COLUMNS] if isinstance(table, dict) else None, len(COLUMNS), None)
    if not columns.size:
        raise FitError(f"this fit.json does not hold the levels of recordings[{at}]; {AGAIN}")
    return dict(zip(COLUMNS, columns, strict=True))


# --- recordings -------------------------------------------------------------------------------------------------------


@one_blas_thread()
def recalled(result: Result, sources: Sequence[Source] = ()) -> Result:
    """A fit that was read back with its recordings, from their recorded places or from `sources`, in their order.

    Raises
    ------
    FitError
        Naming the file that is missing, or is not the one that was fitted.
    """
    rows = result.document["recordings"]
    if sources and len(sources) != len(rows):
        raise FitError(f"{len(sources)} recordings were given, and the fit is of {len(rows)}; give all, in their order")
    found = [_read(row, source) for row, source in zip(rows, sources or [row.get("file") for row in rows], strict=True)]
    own = [
        _analysed(recording, row, note)
        for recording, row, note in zip(found, rows, result.minima_notes[0], strict=True)
    ]
    analyses = [analysis.with_decay_law(own[result.reference_index]) for analysis in own]
    pairs = enumerate(zip(found, analyses, strict=True))
    return replace(result, recordings=tuple(_beside(result, at, *pair) for at, pair in pairs))


def _read(row: dict, source: Any) -> Recording:
    """One recording, if it is the one that was fitted."""
    name = printable(row.get("file"))
    channel = str(row.get("channel", "average"))
    try:
        recording = to_recording(source, "average" if channel == "mono" else channel, name)
    except (ParameterError, RecordingError) as error:
        raise FitError(f"{error}, or give the fit's recording as result.with_recordings(path)") from None
    if recording.sha256 != row.get("sha256"):
        raise FitError(
            f"{printable(recording.path)}: is not the recording of this fit (SHA-256), or was changed; give that one, "
            "as result.with_recordings(path)"
        )
    return recording


def _analysed(recording: Recording, row: dict, note: Note) -> Analysis:
    """The analysis of the note that was fitted: of its name, or else of its pitch."""
    name = row.get("note") if isinstance(row.get("note"), str) else None
    try:
        found = analyse(recording, note=name)
        if abs(1200 * np.log2(found.f0 / float(note.f0))) < SAME:
            return found
    except (AnalysisError, ParameterError):
        pass
    try:
        return analyse(recording, f0=float(note.f0))
    except (AnalysisError, ParameterError) as error:
        raise FitError(str(error)) from None


def _beside(result: Result, at: int, recording: Recording, analysis: Analysis) -> FittedRecording:
    """One recording beside what the model makes of it, as when it was fitted."""
    row, note, held = result.document["recordings"][at], result.minima_notes[0][at], levels_of(result.document, at)
    gain = float(note.gain) if row.get("gain_status") == "given" else None
    listener = RecordingComparison.of(recording, analysis, None if gain is None else 1.0 / gain)
    plain = note._replace(gain=1.0, ringing=None)
    begins = None if gain is None else listener.begins(plain)
    sounds = {
        "initial": listener.play(initial_note(result, at), gain, begins, listener.level),
        "fitted": listener.play(plain, float(note.gain), begins, listener.level),
    }
    initial, fitted = (
        replace(sound, level=listener.at(held[name], held["number"].astype(int))) for name, sound in sounds.items()
    )
    criterion, levels = (table_of(row, key, f"recordings[{at}]", WAY_OUT) for key in ("criterion", "levels"))
    heard = FittedRecording(initial, fitted, listener.level, recording, analysis, criterion, levels)
    return heard if note.ringing is None else heard.ringing_by(note.ringing, _contact(result, at))


def _contact(result: Result, at: int) -> float:
    """When the hammer touched after one recording's onset, s, by the order in which `ringing` has its group's."""
    rows, layers = result.document["recordings"], result.document["ringing"].get("layers")
    place = [i for i, row in enumerate(rows) if row.get("group") == rows[at].get("group")]
    place.sort(key=lambda i: float(result.minima_notes[0][i].hammer.v_H0))
    layers = layers if isinstance(layers, list) else []
    late = layers[place.index(at)].get("contact_s") if len(layers) == len(place) else None
    return require_finite(late, "ringing.layers contact_s", WAY_OUT)
