"""Reloading of a fit: its notes from `fit.json` alone, its recordings and their sounds from the original files.

The document has the results of the fit and the compared levels. Recordings are read and analysed again, from files
whose SHA-256 must equal the stored one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from ..analysis import SAME_KEY_CENTS, Analysis, analyse, cents_above
from ..errors import AnalysisError, FitError, ParameterError, RecordingError
from ..fit_file import HINT, read_output_path
from ..io.files import array_of, printable, reference_row, require_finite, require_table
from ..model.note import Note
from ..parameters import STRING_NAMES, String, check
from ..recording.recording import Recording, Source, to_recording
from ..threads import one_blas_thread
from .comparison import RecordingComparison
from .fitted_recording import FittedRecording

if TYPE_CHECKING:
    from .result import Result

__all__ = ["every_note", "initial_note", "stored_levels", "reload_recordings"]

_FIT_AGAIN = "fit the recordings again"
# Columns of the table of levels.
COLUMNS = ("number", "measured", "error", "initial", "fitted")


# --- notes ------------------------------------------------------------------------------------------------------------


def every_note(document: dict[str, Any], mixture: Sequence[Note], name: str) -> tuple[tuple[Note, ...], ...]:
    """The notes of all minima for every recording [minima][recordings], from those of the reference recording.

    Raises
    ------
    FitError
        If an entry is invalid; the message names file and entry.
    """
    rows = document["recordings"]
    if not all(isinstance(row, dict) for row in rows):
        raise FitError(f"{name}: every entry of recordings must be a table; {HINT}")
    by_minimum = [_velocities(document, rows, which, float(note.hammer.v_H0)) for which, note in enumerate(mixture)]
    return tuple(
        tuple(_note_of_row(document, index, note, velocity, name) for index, velocity in enumerate(velocities))
        for note, velocities in zip(mixture, by_minimum, strict=True)
    )


def _velocities(document: dict[str, Any], rows: list[dict], which: int, default: float) -> list[Any]:
    """The velocity of every recording's stroke at one minimum."""
    if not which:
        return [row.get("v_H0", default) for row in rows]
    velocities = array_of(document["minima"][which].get("velocities"), None).tolist()
    strokes = [row.get("stroke") for row in rows]
    return [velocities[s] if isinstance(s, int) and 0 <= s < len(velocities) else default for s in strokes]


def _note_of_row(document: dict[str, Any], index: int, note: Note, velocity: Any, name: str) -> Note:
    """The note of recording `index`, from the `note` of the reference recording."""
    (first, reference), row = reference_row(document["recordings"]), document["recordings"][index]
    where = f"{name}: recordings[{index}]"
    if index == first:
        return note
    cents, gain, v = (
        require_finite(value, f"{where}.{key}", HINT)
        for key, value in (("cents", row.get("cents", 0.0)), ("gain", row.get("gain")), ("v_H0", velocity))
    )
    try:
        c = float(note.string.c) * 2 ** (cents / 1200)
        check({"v_H0": v, "c": c}, where)
    except (OverflowError, ParameterError) as error:
        raise FitError(str(error)) from None
    tuned = note.with_velocity(v)._replace(string=note.string._replace(c=c), gain=gain)
    if row.get("group") == reference.get("group"):
        return tuned
    paths = document["pickup"].get("paths")
    path = paths.get(str(row.get("group"))) if isinstance(paths, dict) else None
    return tuned._replace(path=read_output_path(path, f"{name}: pickup.paths", HINT), ringing=None)


def initial_note(result: Result, index: int) -> Note:
    """The initial note of one recording, without gain and output path.

    Raises
    ------
    FitError
        If the document has no initial values.
    """
    table, row = result.document["parameters"], result.document["recordings"][index]
    values = {name: entry.get("initial") for name, entry in table.items()} | {"v_H0": row.get("v_H0_initial")}
    values = {
        name: require_finite(value, f"initial {name}", _FIT_AGAIN)
        for name, value in values.items()
        if value is not None
    }
    note = result.minima_notes[0][index]
    try:
        string = String(**check({name: values[name] for name in STRING_NAMES}, "initial"))
        hammer = type(note.hammer)(**{name: values[name] for name in note.hammer._fields})
        geometry = note.geometry._replace(strike_position=values["x0"], width=values["width"])
    except KeyError as missing:
        raise FitError(f"this fit.json has no initial {missing.args[0]}; {_FIT_AGAIN}") from None
    return Note(string, hammer, geometry, note.quantity, 1.0)


def stored_levels(document: dict[str, Any], index: int) -> dict[str, np.ndarray]:
    """The compared levels of one recording, dB [partials], by `COLUMNS`.

    Raises
    ------
    FitError
        If the document has no valid table of levels.
    """
    table = document["recordings"][index].get("partials")
    columns = array_of([table.get(name) for name in COLUMNS] if isinstance(table, dict) else None, len(COLUMNS), None)
    if not columns.size:
        raise FitError(f"this fit.json has no levels of recordings[{index}]; {_FIT_AGAIN}")
    return dict(zip(COLUMNS, columns, strict=True))


# --- recordings -------------------------------------------------------------------------------------------------------


@one_blas_thread()
def reload_recordings(result: Result, sources: Sequence[Source] = ()) -> Result:
    """A reloaded fit with its recordings, read from their stored paths or from `sources`, in their order.

    Raises
    ------
    FitError
        If a file is missing or is not the one that was fitted; the message names it.
    """
    rows = result.document["recordings"]
    if sources and len(sources) != len(rows):
        raise FitError(f"{len(sources)} recordings were given, but the fit has {len(rows)}; give all, in their order")
    recordings = [
        _read(row, source) for row, source in zip(rows, sources or [row.get("file") for row in rows], strict=True)
    ]
    own = [
        _analyse_fitted_note(recording, row, note)
        for recording, row, note in zip(recordings, rows, result.minima_notes[0], strict=True)
    ]
    analyses = [analysis.with_decay_law(own[result.reference_index]) for analysis in own]
    pairs = enumerate(zip(recordings, analyses, strict=True))
    return replace(result, recordings=tuple(_compare(result, index, *pair) for index, pair in pairs))


def _read(row: dict, source: Any) -> Recording:
    """Read one recording and check that it is the fitted one."""
    name = printable(row.get("file"))
    channel = str(row.get("channel", "average"))
    try:
        recording = to_recording(source, "average" if channel == "mono" else channel, name)
    except (ParameterError, RecordingError) as error:
        raise FitError(f"{error}, or give the recording of the fit as result.with_recordings(path)") from None
    if recording.sha256 != row.get("sha256"):
        raise FitError(
            f"{printable(recording.path)}: is not the recording of this fit, or was changed (SHA-256); give the "
            "original as result.with_recordings(path)"
        )
    return recording


def _analyse_fitted_note(recording: Recording, row: dict, note: Note) -> Analysis:
    """The analysis at the name of the fitted note, or else at its pitch."""
    name = row.get("note") if isinstance(row.get("note"), str) else None
    try:
        analysis = analyse(recording, note=name)
        if abs(cents_above(analysis.f0, float(note.f0))) <= SAME_KEY_CENTS:
            return analysis
    except (AnalysisError, ParameterError):
        pass
    try:
        return analyse(recording, f0=float(note.f0))
    except (AnalysisError, ParameterError) as error:
        raise FitError(str(error)) from None


def _compare(result: Result, index: int, recording: Recording, analysis: Analysis) -> FittedRecording:
    """Compare one recording with the model, as during the fit."""
    row, note = result.document["recordings"][index], result.minima_notes[0][index]
    stored = stored_levels(result.document, index)
    gain = float(note.gain) if row.get("gain_status") == "given" else None
    comparison = RecordingComparison.of(recording, analysis, None if gain is None else 1.0 / gain)
    number = stored["number"].astype(int)
    measured = comparison.levels_at_partials(stored["measured"], number)
    plain = note._replace(gain=1.0, ringing=None)
    begins = None if gain is None else comparison.contact_onset(plain)
    sounds = {
        "initial": comparison.render(initial_note(result, index), gain, begins, measured),
        "fitted": comparison.render(plain, float(note.gain), begins, measured),
    }
    initial, fitted = (
        replace(sound, level=comparison.levels_at_partials(stored[name], number)) for name, sound in sounds.items()
    )
    criterion, levels = (require_table(row, key, f"recordings[{index}]", HINT) for key in ("criterion", "levels"))
    compared = FittedRecording(initial, fitted, measured, recording, analysis, criterion, levels)
    return compared if note.ringing is None else compared.ringing_by(note.ringing, _contact_delay(result, index))


def _contact_delay(result: Result, index: int) -> float:
    """Time from the onset to the first contact, s. The layers of `ringing` are the path group in order of velocity."""
    rows, layers = result.document["recordings"], result.document["ringing"].get("layers")
    group = [i for i, row in enumerate(rows) if row.get("group") == rows[index].get("group")]
    group.sort(key=lambda i: float(result.minima_notes[0][i].hammer.v_H0))
    layers = layers if isinstance(layers, list) else []
    delay = layers[group.index(index)].get("contact_s") if len(layers) == len(group) else None
    return require_finite(delay, "ringing.layers contact_s", HINT)
