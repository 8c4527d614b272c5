"""The table of a data set: one row a sound, with units, and notes from rows."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from ..analysis.note_names import midi_to_note
from ..errors import ParameterError
from ..felt import ALL_PARAMETERS, law_of, make_hammer
from ..model.note import Note
from ..model.output_path import OutputPath
from ..parameters import HAMMER_NAMES, STRING_NAMES, Geometry, String
from ..schema.dataset import Column, NoteOptions
from .random_notes import PATH_FREQUENCIES

if TYPE_CHECKING:
    from .labelled_note import LabelledNote

# Columns of sizes, and the fields of a `Geometry`.
SIZES = {"L": "length", "M_S": "mass", "x0": "strike_position", "width": "width", "pickup": "pickup"}
PATH_COLUMNS = [f"path_{i + 1}" for i in range(len(PATH_FREQUENCIES))]
COLUMNS = (
    Column("number", "", "number of the note, from 0"),
    Column("layer", "", "layer of the note, from 1, the softest"),
    Column("key", "", "name of the key"),
    Column("midi", "1", "MIDI number of the key"),
    Column("f0", "Hz", "fundamental frequency of the string without stiffness"),
    Column("B", "1", "inharmonicity: partial k lies at k f0 √(1 + B k²)"),
)
AFTER = (
    Column("L", "m", "string length"),
    Column("M_S", "kg", "string mass"),
    Column("x0", "m", "strike position"),
    Column("width", "m", "full width of the contact window"),
    Column("pickup", "m", "position of a pickup on the string; not used by a pickup at the bridge"),
    Column("quantity", "", "quantity of the pickup: velocity, displacement, bridge-force or pressure"),
    Column("gain", "1/(pickup unit)", "full scales of the file per unit of the pickup"),
    Column("onset", "s", "time of the first contact in the file"),
    Column("noise_rms", "1", "rms of the white noise, full scale = 1"),
)


def columns_of(options: NoteOptions, notes: Sequence[Note]) -> tuple[Column, ...]:
    """Return the columns of a data set about these central notes, after the column of the files."""
    names = dict.fromkeys([*STRING_NAMES, *HAMMER_NAMES])
    boxes = dict(ALL_PARAMETERS)
    for note in notes:
        boxes |= law_of(note.hammer).hammer_parameters
        names |= dict.fromkeys(note.hammer._fields)
    parameters = (Column(name, boxes[name].unit, boxes[name].meaning) for name in names)
    drawn = options.path and options.around is None
    path = [
        Column(name, "dB", f"output path at {frequency:.5g} Hz")
        for name, frequency in zip(PATH_COLUMNS, PATH_FREQUENCIES, strict=True)
        if drawn
    ]
    return (*COLUMNS, *parameters, *AFTER, *path)


def labels_of(made: LabelledNote) -> dict[str, Any]:
    """Return the row of a sound by column. Numbers are floats in SI units."""
    note = made.note
    labels = {"number": made.number, "layer": made.layer, "key": midi_to_note(made.midi), "midi": made.midi}
    labels |= {"f0": float(note.f0), "B": float(note.B)}
    labels |= {name: float(value) for part in (note.string, note.hammer) for name, value in part._asdict().items()}
    labels |= {name: float(getattr(note.geometry, field)) for name, field in SIZES.items()}
    onset = round(note.pre_onset_s * made.rate) / made.rate
    labels |= {"quantity": note.quantity, "gain": float(note.gain), "onset": onset, "noise_rms": made.noise_rms}
    if note.path is not None and note.path.frequency is PATH_FREQUENCIES:
        labels |= dict(zip(PATH_COLUMNS, note.path.db.tolist(), strict=True))
    return labels


def note_from_labels(labels: Mapping[str, Any], centre: Note | None = None) -> Note:
    """Return the note of a row of a data set's table, with its velocity and gain.

    Parameters
    ----------
    labels : the row by column; numbers may be texts, as `csv.DictReader` returns them.
    centre : for data drawn around a fitted key with `path=True` or `modal_response=True`, the note of the fit. The
        table does not contain its output path and modal response. Leave it out for other data: the path is added.

    Returns
    -------
    The `Note`. Without noise, `render` returns the samples of the file.

    Raises
    ------
    ParameterError
        If a column is missing, or is not a number.

    Examples
    --------
    >>> import numpy as np, pianofit
    >>> (made,) = pianofit.notes(1, options=pianofit.NoteOptions(seconds=0.2))
    >>> sound = pianofit.note_from_labels(made.labels).render(seconds=0.2)
    >>> bool(np.allclose(sound, made.samples, atol=1e-9))
    True
    """

    def number(name: str) -> float:
        try:
            return float(labels[name])
        except (KeyError, TypeError, ValueError):
            value = labels.get(name)
            raise ParameterError(f"labels=: column {name} is {value!r}, not a number; give a whole row") from None

    hammer = {name: number(name) for name in ALL_PARAMETERS if name not in STRING_NAMES and labels.get(name)}
    hammer |= {name: number(name) for name in HAMMER_NAMES}
    path = None if centre is None else centre.path
    if PATH_COLUMNS[0] in labels:
        path = OutputPath(PATH_FREQUENCIES, np.array([number(name) for name in PATH_COLUMNS]))
    string = String(*(number(name) for name in STRING_NAMES))
    note = Note(
        string,
        make_hammer(hammer, "labels="),
        Geometry(**{field: number(name) for name, field in SIZES.items()}),
        str(labels.get("quantity")),
        number("gain"),
        path,
    )
    if centre is None or centre.modal_response is None or not number("onset"):
        return note
    return note._replace(modal_response=centre.modal_response.scale_pitch(float(string.c / centre.string.c)))
