"""Recorded keys that are moved towards what the rest of the instrument predicts for them.

Three properties of a key change by the same amount, from 0 (as recorded) to 1:

    decay       the decay rates of all modes get one factor. At 1, the mean of the logarithms of the early decays of the
                partials is that of the prediction. The partials keep their levels
    brightness  the slope over octaves of the levels of the partials, relative to the prediction, is removed
    level       the gain moves the level of a stroke at 4 m/s to the keyboard law

Decay and brightness are predicted by the fields of the other recorded keys (`measured_fields`). A key without modal
response, and the only recorded key, change their level alone.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from ..conversions import LOWEST_KEY
from ..model.modal_response import ModalResponse
from ..model.note import Note
from ..schema.instrument import KeyboardLaw
from .guessed_keys import recorded_keys
from .guessed_knocks import static_part
from .instrument import Key
from .key_quantities import LOUDEST_VELOCITY, stroke_level
from .measured_fields import (
    NOTHING,
    TIMES,
    Cells,
    KeyFields,
    RecordedKey,
    average_in_cells,
    early_ratio,
    expected_force,
    measure_fields,
    partial_energies,
    partials_of,
    spectrum,
)

# Exponent of the energy of a critical band in its loudness (Stevens 1955). Weights of the energy itself would leave the
# slope to the loudest one or two partials, and it would then change all others by tens of dB.
LOUDNESS_EXPONENT = 0.3
# Rounds in which the factor of the decay rates is computed. Each reduces its error to less than half.
ROUNDS = 20


def even_out(keys: Mapping[int, Key], laws: Mapping[str, KeyboardLaw], amount: float) -> dict[int, Key]:
    """Return the recorded keys, moved towards the prediction of all others by an amount from 0 to 1."""
    if amount == 0:
        return dict(keys)
    recorded = recorded_keys(keys, laws)
    fields = measure_fields(recorded)
    level = {key.midi: float(laws["level"].value[key.midi - LOWEST_KEY]) for key in recorded}
    return {
        key.midi: replace(keys[key.midi], note=_at_level(key.note, _even(key, fields, amount), level[key.midi], amount))
        for key in recorded
    }


def _at_level(recorded: Note, note: Note, law: float, amount: float) -> Note:
    """Return the note with a gain that moves the level of the recorded note to that of the law by the amount."""
    own = stroke_level(recorded)
    return note._replace(gain=note.gain * 10 ** ((own + amount * (law - own) - stroke_level(note)) / 20))


def _even(key: RecordedKey, fields: KeyFields | None, amount: float) -> Note:
    """Return the note of a key with another decay and brightness."""
    response = key.note.modal_response
    if fields is None or response is None or len(fields.keys) < 2:
        return key.note
    own, curve, level = leave_out(fields, key.midi)
    factor = decay_factor(own.curve, curve, own.points.size)
    slope, centre = brightness(own.points.octave, own.level - level, cell_loudness(key, response))
    faster = with_decay(key, response, factor**amount)
    octave = np.log2(np.imag(response.pole) / (2 * np.pi))
    changed = faster._replace(pattern=faster.pattern * 10 ** (-amount * slope * (octave - centre) / 20))
    return key.note._replace(modal_response=with_knock(response, changed))


def leave_out(fields: KeyFields, midi: int) -> tuple[Cells, np.ndarray, np.ndarray]:
    """Return the cells of a key, and the decay curves [points, times] and levels [points] predicted by the others."""
    is_own = fields.cells.points.key == midi
    own, others = _select(fields.cells, is_own), fields._replace(cells=_select(fields.cells, ~is_own))
    curve, level = (
        others.predict(shape.weights(others.cells.points, own.points), values)
        for shape, values in ((fields.curve_shape, others.cells.curve), (fields.level_shape, others.cells.level))
    )
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


def brightness(octave: np.ndarray, level: np.ndarray, weight: np.ndarray) -> tuple[float, float]:
    """Return the slope of levels over octaves by weighted least squares, dB, and the mean octave."""
    centre = float(np.average(octave, weights=weight))
    width = float(np.average((octave - centre) ** 2, weights=weight))
    return float(np.average((octave - centre) * level, weights=weight)) / max(width, NOTHING), centre


def cell_loudness(key: RecordedKey, response: ModalResponse) -> np.ndarray:
    """Return the loudness of the cells in a stroke at 4 m/s, up to a factor [points]."""
    numbers, string = partials_of(key, response)
    velocity = np.array([LOUDEST_VELOCITY])
    energy = np.array([partial_energies(response, response.partial == k, velocity)[0] for k in numbers])
    energy *= expected_force(spectrum(key.note, LOUDEST_VELOCITY), string.frequency) ** 2
    mean, size = average_in_cells(np.log2(string.frequency))
    return (mean(energy) * size) ** LOUDNESS_EXPONENT


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
