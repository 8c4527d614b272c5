"""Recorded keys that are moved towards what the instrument predicts for them.

Three properties of a key change by the same amount, from 0 (as recorded) to 1:

    decay       the decay rates of all modes get one factor. At 1, the mean of the logarithms of the early decays of the
                partials is that predicted by the other keys. The partials keep their levels
    brightness  the slope over octaves of the levels of the partials, relative to a guess in place of the key, is
                removed
    level       the gain moves the level of a stroke at 4 m/s to the keyboard law

The predictions are those of the fields (`measured_fields`). A key with a few very loud or very faint partials differs
from the others in more than a slope. A slope that follows these partials, by weights of their energy or without the
key's own levels, makes it less like the guesses next to it than it was.

A key without modal response changes its level alone, and so does the only recorded key.
"""

from collections.abc import Mapping, Sequence

import numpy as np

from ..conversions import LOWEST_KEY
from ..model.modal_response import ModalResponse
from ..model.note import Note
from ..schema.instrument import KeyboardLaw
from .fields import NOTHING, Field
from .guessed_knocks import static_part
from .key_quantities import stroke_level
from .measured_fields import (
    TIMES,
    Cells,
    KeyFields,
    RecordedKey,
    early_ratio,
    partial_energies,
)

# Rounds in which the factor of the decay rates is computed. Each reduces its error to less than half.
ROUNDS = 20


def even_out(
    keys: Sequence[RecordedKey], laws: Mapping[str, KeyboardLaw], fields: KeyFields | None, amount: float
) -> dict[int, Note]:
    """Return the notes of recorded keys, moved by an amount from 0 to 1.

    Parameters
    ----------
    fields : of these keys; None without any modal response.
    """
    if amount == 0:
        return {key.midi: key.note for key in keys}
    law = {key.midi: float(laws["level"].value[key.midi - LOWEST_KEY]) for key in keys}
    return {key.midi: _at_level(key.note, _even(key, fields, amount), law[key.midi], amount) for key in keys}


def _at_level(recorded: Note, note: Note, law: float, amount: float) -> Note:
    """Return the note with a gain that moves the level of the recorded note to that of the law by the amount."""
    own = stroke_level(recorded)
    return note._replace(gain=note.gain * 10 ** ((own + amount * (law - own) - stroke_level(note)) / 20))


def _even(key: RecordedKey, fields: KeyFields | None, amount: float) -> Note:
    """Return the note of a key with another decay and brightness."""
    response = key.note.modal_response
    if fields is None or response is None or len(fields.keys) < 2:
        return key.note
    own, curve, level = predict_key(fields, key.midi)
    factor = decay_factor(own.curve, curve, own.points.size)
    slope, centre = brightness_slope(own, level)
    faster = with_decay(key, response, factor**amount)
    octave = np.log2(np.imag(response.pole) / (2 * np.pi))
    changed = faster._replace(pattern=faster.pattern * 10 ** (-amount * slope * (octave - centre) / 20))
    return key.note._replace(modal_response=with_knock(response, changed))


def predict_key(fields: KeyFields, midi: int) -> tuple[Cells, np.ndarray, np.ndarray]:
    """Return the cells of a key, their decay curves [points, times] by the other keys, and levels of a guess [points].

    A key that has no near neighbours would predict its own decay.
    """
    is_own = fields.cells.points.key == midi
    own, others = _select(fields.cells, is_own), _select(fields.cells, ~is_own)
    curve = others.points.predict(Field(others.points, fields.curve.shape).weights(own.points), others.curve)
    level = fields.cells.points.predict(fields.level.weights(own.points), fields.cells.level)
    return own, curve, level


def _select(cells: Cells, chosen: np.ndarray) -> Cells:
    points = cells.points._make(column[chosen] for column in cells.points)
    return Cells(points, *(values[chosen] for values in cells[1:]))


def decay_factor(own: np.ndarray, predicted: np.ndarray, size: np.ndarray) -> float:
    """Return the factor of all decay rates with which the mean log early decay is that of the prediction.

    Parameters
    ----------
    own, predicted : decay curves, dB [points, times].
    size : number of partials of each point [points].
    """
    log_factor, wanted = 0.0, np.log(early_ratio(predicted))
    for _ in range(ROUNDS):
        curve = np.array([np.interp(np.exp(log_factor) * TIMES, TIMES, row) for row in own])
        log_factor += float(np.average(wanted - np.log(early_ratio(curve)), weights=size))
    return float(np.exp(log_factor))


def brightness_slope(own: Cells, predicted: np.ndarray) -> tuple[float, float]:
    """Return the slope of the levels of a key over the predicted ones, dB per octave, and the mean octave."""
    octave, size = own.points.octave, own.points.size
    centre = float(np.average(octave, weights=size))
    width = float(np.average((octave - centre) ** 2, weights=size))
    return float(np.average((octave - centre) * (own.level - predicted), weights=size)) / max(width, NOTHING), centre


def with_decay(key: RecordedKey, response: ModalResponse, factor: float) -> ModalResponse:
    """Return the response with all decay rates times a factor. Its partials keep their levels."""
    faster = response._replace(pole=factor * np.real(response.pole) + 1j * np.imag(response.pole))
    size = np.ones(len(response.pole))
    for number in np.unique(response.partial):
        part = response.partial == number
        rows = (partial_energies(x, part, key.compared_velocities) for x in (response, faster))
        before, after = (np.log(np.maximum(row, NOTHING)).mean() for row in rows)
        size[part] = np.exp((before - after) / 2)
    return faster._replace(pattern=response.pattern * size)


def with_knock(before: ModalResponse, after: ModalResponse) -> ModalResponse:
    """Return the changed response with the knock that cancels the static deflection of its own modes."""
    knock, change = before.knock.copy(), static_part(after) - static_part(before)
    size = min(knock.shape[-1], change.shape[-1])
    knock[:, :size] += change[:, :size]
    return after._replace(knock=knock)
