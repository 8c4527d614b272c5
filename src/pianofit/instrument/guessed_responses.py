"""Modal responses of keys that were never recorded, from the fields of the recorded keys and the keyboard laws.

A key that was never recorded takes the predictions of the fields (`measured_fields`) at its own partials:

    frequency   of the string model
    level       of the string model, struck by the hammer of the laws, plus the predicted level; the level of a single
                partial deviates from its prediction, so the prediction is that of its power
    decay       the predicted decay curve, dB over time in units of the decay of the laws. It is a sum of two
                exponentials: it keeps prompt sound and aftersound, without beats of single partials
    channels    phases and differences of channels as predicted, where neighbouring partials and keys agree; the rest is
                drawn

Its knock is that of `guessed_knocks`.
"""

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from ..conversions import DB, HALF_WIDTH_95, LOWEST_KEY
from ..dsp.level import level_energy
from ..felt import law_of
from ..model.modal_response import ModalResponse, VelocityGain
from ..model.note import Note
from ..schema.instrument import KeyboardLaw
from .fields import NOTHING, FieldPoints
from .guessed_knocks import guess_knock, static_part
from .instrument import Key
from .key_quantities import key_quantities, note_from_quantities
from .measured_fields import (
    MOST_PARTIALS,
    TIMES,
    VELOCITIES,
    KeyFields,
    Partials,
    RecordedKey,
    StringLaw,
    measure_fields,
    string_partials,
)

# Decay rates of the exponentials, over that of the laws.
RATIOS = np.geomspace(0.02, 200, 41)
# Steps by which they are refined, the damping of the first, its factor after each, and the largest change of a
# logarithm. They say how fast the steps converge, not where: with 20 steps the squared error is 0.6 % smaller.
REFINEMENTS = 5
FIRST_DAMPING = 1e-2
DAMPING_FACTOR = 10.0
LONGEST_STEP = 1.0
# Curves are compared down to this level below their start, dB.
DOWN = 60.0
# Fewest partials of a guessed key.
FEWEST_PARTIALS = 3
# Partials of a guessed key end half a semitone above the highest partials of the recorded keys.
MARGIN_OCTAVES = 0.5 / 12
# Seed of the drawn phases.
SEED = 0


# Laws of the string that a guess needs, besides those of the hammers of the recorded keys.
STRING_LAWS = ("b1", "d2", "x0/L")


def missing_laws(keys: Mapping[int, Key], laws: Mapping[str, KeyboardLaw]) -> list[str]:
    """Return the names of laws that the guessed keys need and that are not there."""
    if not any(key.is_guessed for key in keys.values()):
        return []
    hammers = (law_of(key.note.hammer).key_quantities for key in keys.values() if key.fit is not None)
    return sorted({*STRING_LAWS, *(name for names in hammers for name in names)} - {*laws})


def keyboard_string_law(laws: Mapping[str, KeyboardLaw], midi: int) -> StringLaw:
    """Return the values of the keyboard laws for the string of a key."""
    i, strike = midi - LOWEST_KEY, laws["x0/L"]
    sd = math.log(float(strike.high[i] / strike.low[i])) / (2 * HALF_WIDTH_95)
    return StringLaw(float(laws["b1"].value[i]), float(laws["d2"].value[i]), math.hypot(sd, strike.scatter))


def recorded_keys(keys: Mapping[int, Key], laws: Mapping[str, KeyboardLaw]) -> list[RecordedKey]:
    """Return the recorded keys with their laws, in ascending order."""
    return [_recorded(midi, key, laws) for midi, key in sorted(keys.items()) if laws and key.fit is not None]


def _recorded(midi: int, key: Key, laws: Mapping[str, KeyboardLaw]) -> RecordedKey:
    law = law_of(key.note.hammer)
    # The laws replace the hammer of a recorded key.
    hammer = {name: float(laws[name].value[midi - LOWEST_KEY]) for name in law.key_quantities}
    struck = note_from_quantities(key_quantities(key.note, midi) | hammer, midi, key.note.quantity, law)
    velocities = key.fit.velocities if key.fit and key.fit.velocities else (float(key.note.size),)
    law_note = key.note._replace(hammer=struck.hammer)
    return RecordedKey(midi, key.note, law_note, keyboard_string_law(laws, midi), tuple(map(float, velocities)))


def with_guessed_responses(keys: Mapping[int, Key], laws: Mapping[str, KeyboardLaw]) -> dict[int, Key]:
    """Return all keys; those that are guessed get their modal responses, which files do not hold."""
    are_guessed = any(key.is_guessed for key in keys.values())
    fields = measure_fields(recorded_keys(keys, laws)) if are_guessed else None
    completed = dict(keys)
    for midi, key in keys.items():
        if key.is_guessed and fields is not None:
            response = guess_response(key.note, midi, keyboard_string_law(laws, midi), fields)
            completed[midi] = replace(key, note=key.note._replace(modal_response=response))
    return completed


def guess_response(note: Note, midi: int, law: StringLaw, fields: KeyFields) -> ModalResponse:
    """Return the modal response of a key, for a gain of 1.

    Parameters
    ----------
    note : the key with string and geometry of the keyboard laws.
    law : values of the laws for its string.
    """
    string = _audible_partials(note, midi, law, fields)
    rate = law.decay(np.arange(1, len(string.frequency) + 1))
    at, cells = FieldPoints.of_key(np.log2(string.frequency), midi), fields.cells
    weights = fields.level.weights(at)
    curves = cells.points.predict(fields.curve.weights(at), cells.curve)
    share, ratio = fit_exponentials(curves)
    decay = ratio * rate[:, None]
    energy = np.einsum("ki,kij,kj->k", share, level_energy(decay[:, :, None] + decay[:, None]), share)
    size = string.impulse * np.sqrt(level_energy(2 * rate) / energy)
    # The expected power of a partial, whose level is uncertain.
    level = cells.points.predict(weights, cells.level) + fields.level.variance(weights, at) / DB
    size *= 10 ** (level / 20)
    channels = size[:, None] * _draw_channels(weights, fields)
    i, j = np.nonzero(share)
    pole = -decay[i, j] + 2j * np.pi * string.frequency[i]
    pattern = (channels[i] * share[i, j, None]).T
    gain = VelocityGain(VELOCITIES, 10 ** (cells.points.predict(weights, cells.change)[i].T / 20) + 0j)
    empty = np.zeros((len(pattern), 0))
    response = ModalResponse(i + 1, pole, np.zeros(len(pole)), pattern, empty, fields.rate, gain)
    # A knock cancels the static deflection of the modes, as it does for recorded keys.
    static, knocks = static_part(response), fields.knocks
    return response._replace(knock=static if knocks is None else static + guess_knock(knocks, midi, response, static))


def _audible_partials(note: Note, midi: int, law: StringLaw, fields: KeyFields) -> Partials:
    """Partials up to the highest frequency that the recorded keys on both sides have."""
    string = string_partials(note, law.strike_sd)
    top = 2 ** (np.interp(midi, fields.keys, np.log2(fields.highest)) + MARGIN_OCTAVES)
    count = max(int(np.searchsorted(string.frequency, top)), FEWEST_PARTIALS)
    return Partials(string.frequency[:count], string.impulse[:count])


def _draw_channels(weights: np.ndarray, fields: KeyFields) -> np.ndarray:
    """Draw the phasors of the channels, with a mean over the channels of magnitude 1 [at, channels].

    A partial has the same draws in all keys, so that neighbouring keys differ by no more than their fields.
    """
    cells, random = fields.cells, np.random.default_rng(SEED)
    one, each = (_complex_normal(random, (MOST_PARTIALS, n))[: len(weights)] for n in (1, cells.side.shape[1]))
    phase = cells.points.predict(weights, cells.phasor)
    free = np.sqrt(np.maximum(1 - np.abs(phase) ** 2, 0.0))
    phase = np.exp(1j * np.angle(phase + free * one[:, 0]))
    side = cells.points.predict(weights, cells.side) - 1
    missing = np.maximum(cells.points.predict(weights, cells.side_power) - (np.abs(side) ** 2).mean(axis=1), 0.0)
    drawn = each - each.mean(axis=1, keepdims=True)
    drawn *= np.sqrt(missing / np.maximum((np.abs(drawn) ** 2).mean(axis=1), NOTHING))[:, None]
    return phase[:, None] * (1 + side - side.mean(axis=1, keepdims=True) + drawn)


def _complex_normal(random: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
    return (random.normal(size=shape) + 1j * random.normal(size=shape)) / np.sqrt(2)


def fit_exponentials(curves: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Fit prompt sound and aftersound, two exponentials, to decay curves, dB [partials, times]: least relative errors.

    Returns amplitudes [partials, 2], of which the second may be 0, and decay rates over that of the laws [partials, 2].
    """
    used = curves > curves[:, :1] - DOWN
    amplitude, ratio = (np.array(column) for column in zip(*map(_nearest_pair, curves, used), strict=True))
    return _refine(amplitude, ratio, used / 10 ** (curves / 20))


def _nearest_pair(curve: np.ndarray, used: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Amplitudes and ratios of the two exponentials among `RATIOS` that are nearest to a curve [2], [2]."""
    amplitude = 10 ** (curve[used] / 20)
    parts = np.exp(-np.outer(TIMES[used], RATIOS)) / amplitude[:, None]
    gram, right = parts.T @ parts, parts.sum(axis=0)
    own, i, j = np.diag(gram), *np.triu_indices(len(RATIOS), 1)
    pair = np.stack([right[i] * own[j] - right[j] * gram[i, j], right[j] * own[i] - right[i] * gram[i, j]])
    pair = pair / (own[i] * own[j] - gram[i, j] ** 2)
    # The squared error is the number of times minus this.
    explained = np.where((pair >= 0).all(axis=0), right[i] * pair[0] + right[j] * pair[1], -np.inf)
    single, best = right**2 / own, int(np.argmax(explained))
    if explained[best] > single.max():
        return pair[:, best], RATIOS[[i[best], j[best]]]
    best = int(np.argmax(single))
    return np.array([right[best] / own[best], 0.0]), RATIOS[[best, best]]


def _refine(amplitude: np.ndarray, ratio: np.ndarray, scale: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Refine exponentials of the grid `RATIOS`, so that they change as smoothly from key to key as their curves.

    Levenberg and Marquardt's method, for all partials at once.

    Parameters
    ----------
    amplitude, ratio : of two exponentials [partials, 2].
    scale : one over the values of the curves, 0 where they do not count [partials, times].
    """

    def deviations(shape: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        parts = np.exp(shape[:, None, :2] - TIMES[:, None] * np.exp(shape[:, None, 2:])) * scale[..., None]
        return parts, parts.sum(axis=2) - (scale > 0)

    shape = np.log(np.maximum(np.concatenate([amplitude, ratio], axis=1), NOTHING))
    damping = np.full(len(shape), FIRST_DAMPING)
    parts, deviation = deviations(shape)
    for _ in range(REFINEMENTS):
        slopes = np.concatenate([parts, -TIMES[:, None] * np.exp(shape[:, None, 2:]) * parts], axis=2)
        normal = slopes.transpose(0, 2, 1) @ slopes
        normal += damping[:, None, None] * (normal * np.eye(4)) + NOTHING * np.eye(4)
        gradient = slopes.transpose(0, 2, 1) @ deviation[..., None]
        tried = shape - np.clip(np.linalg.solve(normal, gradient)[..., 0], -LONGEST_STEP, LONGEST_STEP)
        new_parts, new = deviations(tried)
        better = (new**2).sum(axis=1) < (deviation**2).sum(axis=1)
        shape, deviation = np.where(better[:, None], tried, shape), np.where(better[:, None], new, deviation)
        parts = np.where(better[:, None, None], new_parts, parts)
        damping = damping * np.where(better, 1 / DAMPING_FACTOR, DAMPING_FACTOR)
    return np.where(amplitude > 0, np.exp(shape[:, :2]), 0.0), np.exp(shape[:, 2:])
