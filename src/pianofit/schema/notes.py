"""Notes of a fit: string, hammer, geometry, gain, output path and modal response, each checked before use."""

import os
from dataclasses import replace
from pathlib import Path

from ..errors import FitError, ParameterError, check_type
from ..excitation import HAMMER, OTHERS, Excitation
from ..felt import ALL_PARAMETERS, LAWS, FeltLaw, check_hammer
from ..io.files import printable, short_repr
from ..model.note import Note
from ..model.simulate import check_geometry
from ..parameters import HAMMER_NAMES, STRING_NAMES, Geometry, String, check
from ..transducer import TRANSDUCERS
from .fit import HINT, Fit, Minimum, NoteFile, PathEntry, RecordingFit, fit_path, read_note_file
from .quantities import Quantities


def load_note(path: str | os.PathLike[str], felt: FeltLaw | None = None) -> tuple[Note, int]:
    """Read the note of a `fit.json` at its best minimum, and the sample rate of its reference recording, Hz.

    Parameters
    ----------
    path : a `fit.json`, or its folder, written by `pianofit fit` or `Result.save`, or a `note.json` of the page.
    felt : the felt law of the fit, if it is your own. The file has only its name.

    Returns
    -------
    A `Note`, and the rate, Hz.

    Raises
    ------
    FitError
        If an entry is missing, of another type, or out of range; the message names file and entry.

    Examples
    --------
    With the folder that the example of `fit` saves:

    >>> import pianofit
    >>> note, rate = pianofit.load_note("fit/fit.json")
    >>> note.render(3.0, seconds=0.5, rate=rate).shape
    (22050,)
    """
    path = fit_path(path)
    record = read_note_file(path)
    note = note_of(record, path.parent, printable(path), felt)
    return note, int(record.recordings[record.reference_index].rate)


def note_of(record: NoteFile, folder: Path | None, name: str, felt: FeltLaw | None = None) -> Note:
    """Return the note of the reference recording at the best minimum; errors as of `load_note`, beginning with `name`.

    A knock that is a file lies in `folder`.
    """
    values, law = {n: quantity.value for n, quantity in record.parameters.items()}, law_of_fit(record, name, felt)
    where = f"{name}: parameters"
    hammer = (*(HAMMER_NAMES if law.hammers else ()), *law.hammer_parameters) if law.has_contact else ()
    needed = (*STRING_NAMES, *hammer)
    if missing := [n for n in (*needed, "L", "M_S", "x0", "width") if n not in values]:
        raise FitError(f"{where}.{missing[0]} is missing; {HINT}")
    own = {n: values[n] for n in (*needed, *(n for n in ALL_PARAMETERS if n in values))}
    try:
        hammer = law.make_hammer(own)
        check_hammer(hammer, where)
        string = String(**check({n: values[n] for n in STRING_NAMES}, where))
    except ParameterError as error:
        raise FitError(str(error)) from None
    on_string = TRANSDUCERS[record.pickup.quantity].on_string
    pickup = values.get("pickup", 0.0) if on_string else 0.5 * values["L"]
    geometry = Geometry(values["L"], values["M_S"], values["x0"], values["width"], pickup)
    try:
        check_geometry(geometry, record.pickup.quantity)
    except ParameterError as error:
        raise FitError(f"{name}: L, M_S, x0, width and pickup are not consistent: {error}") from None
    fitted, path = record.modal_response, record.pickup.path
    response = None if fitted is None else fitted.response
    return Note(
        string,
        hammer,
        geometry,
        record.pickup.quantity,
        record.recordings[record.reference_index].gain,
        None if path is None else path.output_path,
        None if response is None else response.response(folder, name),
    )


def law_of_fit(record: NoteFile, name: str, felt: FeltLaw | None = None) -> Excitation:
    """Return the excitation that a file names; a felt law from outside the package must be given as `felt`."""
    if felt is not None:
        check_type("felt=", felt, FeltLaw, "a FeltLaw")
    if record.excitation != HAMMER:
        if felt is not None:
            raise FitError(
                f"{name}: its string is {OTHERS[record.excitation].words.verb}, without a felt; remove felt="
            )
        return OTHERS[record.excitation]
    if felt is not None and record.felt != felt.name:
        raise FitError(f"{name}: its felt law is {record.felt!r}, not {felt.name!r}; give the law of the fit")
    if felt is None and record.felt not in LAWS:
        raise FitError(
            f"{name}: its felt law, {short_repr(record.felt)}, is not part of pianofit; give it "
            "as load_note(path, felt=law), or Result.load(folder, felt=law)"
        )
    return LAWS[record.felt] if felt is None else felt


def notes_of_fit(fit: Fit, folder: Path | None, name: str, felt: FeltLaw | None = None) -> tuple[tuple[Note, ...], ...]:
    """Return the notes of all minima for every recording [minima][recordings], the best minimum first.

    Only the notes of the best minimum have the modal response. Errors are those of `note_of`.
    """
    fits, names = [fit], [name]
    if len(fit.minima) > 1:
        names = [f"{name}: minima[{i}]" for i in range(len(fit.minima))]
        fits = [_at_minimum(fit, minimum, where) for minimum, where in zip(fit.minima, names, strict=True)]
        fits[1:] = (replace(other, modal_response=None) for other in fits[1:])
    notes = [note_of(own, folder, where, felt) for own, where in zip(fits, names, strict=True)]
    return tuple(
        tuple(_note_of_recording(fit, which, i, own, name) for i in range(len(fit.recordings)))
        for which, own in enumerate(notes)
    )


def _at_minimum(fit: Fit, minimum: Minimum, where: str) -> Fit:
    """Return the fit with the parameters and the output path of one minimum."""
    if lacking := fit.minima[0].parameters.keys() - minimum.parameters.keys():
        raise FitError(f"{where}.parameters.{min(lacking)} is missing; {HINT}")
    path = fit.pickup.path
    if path is not None:
        db = path.db if minimum.path_db is None else minimum.path_db
        try:
            path = PathEntry(path.frequency, db, minimum.path_velocity_discrepancy)
        except ValueError as error:
            raise FitError(f"{where}: path: {error}; {HINT}") from None
    own = (replace(q, value=minimum.parameters.get(q.name, q.value)) for q in fit.parameters.values())
    return replace(fit, parameters=Quantities.of(own), pickup=replace(fit.pickup, path=path))


def _note_of_recording(fit: Fit, which: int, index: int, note: Note, name: str) -> Note:
    """Return the note of one recording at one minimum, from the `note` of the reference recording there."""
    stroke, reference, where = fit.recordings[index], fit.reference, f"{name}: recordings[{index}]"
    if index == fit.reference_index:
        return note
    velocity = stroke.stroke_value
    if which:
        velocities = fit.minima[which].stroke_values
        velocity = (
            float(velocities[stroke.stroke]) if 0 <= stroke.stroke < len(velocities) else float(note.stroke_value)
        )
    c = float(note.string.c) * 2 ** min(stroke.pitch_offset_cents / 1200, 100.0)  # no larger, or it would overflow
    try:
        check({"c": c} | ({"v_H0": velocity} if fit.stroke_name == "v_H0" else {}), where)
    except ParameterError as error:
        raise FitError(str(error)) from None
    # The measured modes of all recordings are those of the reference.
    own = note._replace(modal_response=None, string=note.string._replace(c=c), gain=stroke.gain).with_stroke(velocity)
    if stroke.path_group == reference.path_group:
        response = note.modal_response
        return own if response is None else own.with_gain(note.gain)._replace(modal_response=response)
    path = fit.pickup.paths.get(str(stroke.path_group))
    return own._replace(path=None if path is None else path.output_path)


def initial_note(fit: Fit, stroke: RecordingFit, note: Note) -> Note:
    """Return the initial note of one recording, without gain and output path; `note` is the fitted one."""
    initial = {name: quantity.initial for name, quantity in fit.parameters.items()} | {
        fit.stroke_name: stroke.stroke_initial
    }
    values = {name: value for name, value in initial.items() if value is not None}
    try:
        string = String(**check({name: values[name] for name in STRING_NAMES}, "initial"))
        hammer = note.hammer._replace(**{name: values[name] for name in note.hammer._fields if name != "force"})
        geometry = note.geometry._replace(strike_position=values["x0"], width=values["width"])
    except KeyError as missing:
        raise FitError(f"this fit.json has no initial {missing.args[0]}; fit the recordings again") from None
    return Note(string, hammer, geometry, note.quantity, 1.0)
