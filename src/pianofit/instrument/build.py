"""From the fits of single keys to a whole instrument.

Each of the `LAW_QUANTITIES` has a keyboard law (`laws`). The output path has a law over keys and frequency. A fitted
key combines its fit with the laws. Any other key takes the values of the laws. The values are converted to notes, so
that every key can be played.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from ..analysis.note_names import midi_to_note
from ..conversions import HALF_WIDTH_95, HIGHEST_KEY, LOWEST_KEY
from ..dsp.knock import BAND
from ..errors import ParameterError
from ..io.number_format import counted
from ..model.output_path import OutputPath
from ..schema.instrument import KeyboardLaw, KeyValue, OwnFit, ValueState, VelocityCurve
from .collect_fits import KeyFit
from .instrument import Instrument, Key
from .interpolate_keys import with_interpolated_responses
from .key_quantities import LAW_QUANTITIES, is_force, key_quantities, literature, note_from_quantities
from .laws import ENOUGH_KEYS, Law, fit_law

KEYS = np.arange(LOWEST_KEY, HIGHEST_KEY + 1)
# The state of a key is the first of these that any of its values has.
WORST_FIRST: tuple[ValueState, ...] = ("outlier", "pulled", "fitted")
# A value is pulled if the law moved it by more than this many of its own standard deviations.
PULLED = 0.5
# Standard deviations of the output path's law, dB: common to all keys, drift over the keyboard, single partials.
COMMON_DB, DRIFT_DB, ROUGH_DB = 6.0, 4.0, 4.0
# Their lengths, octaves and keys.
OCTAVES, DRIFT_KEYS = 1.0, 15.0
THIRDS = 20.0 * 2 ** (np.arange(31) / 3)  # Hz
# Prior of the velocity curve: standard deviations of the logarithm at MIDI velocity 64, and of its rise.
VELOCITY_PRIOR_SD = (0.7, 0.5)
# Standard deviation of the logarithm of a layer's velocity about the curve, and the smallest rise of the curve.
LAYER_SD, LEAST_RISE = 0.4, 0.3


def build_instrument(keys: Sequence[KeyFit], name: str = "") -> Instrument:
    """Combine the fits of single keys to an instrument of 88 keys.

    Parameters
    ----------
    keys : fits in ascending order of keys, as `load_keys` returns them.
    name : name of the instrument.

    Returns
    -------
    An `Instrument` with a note for every key. Keys that were never recorded follow from smooth laws over the keyboard.

    Raises
    ------
    ParameterError
        Without any fit.

    Examples
    --------
    >>> from pathlib import Path
    >>> import pianofit
    >>> pianofit.build_instrument(pianofit.load_keys(pianofit.find_fits([Path("batch")], "cp80")), "my CP80")
    Instrument('my CP80', 88 keys, 2 recorded)
    """
    if not keys:
        raise ParameterError("no fit was given; an instrument needs at least one fit.json")
    own = [key_quantities(key.note, key.midi) for key in keys]
    base = {n: np.array([literature(int(m)).get(n, 1.0) for m in KEYS]) for n in LAW_QUANTITIES}
    base["gain"] = _mean_gain(keys, own, base)
    columns = {n: _column(n, keys, np.array([o[n] for o in own]), base[n]) for n in LAW_QUANTITIES}
    paths, fitted = _path_law(keys), {key.midi: j for j, key in enumerate(keys)}
    built = {int(midi): _key(int(midi), fitted.get(int(midi)), keys, columns, paths) for midi in KEYS}
    return Instrument(
        name,
        with_interpolated_responses(built),
        fit_velocity_curve([key.summary.velocities for key in keys]),
        {n: _keyboard_law(n, column, base[n], keys) for n, column in columns.items()},
        tuple(_warnings(keys, columns)),
    )


def fit_velocity_curve(velocities: Sequence[Sequence[float]]) -> VelocityCurve:
    """Fit one velocity curve to the velocities of each key's layers, ascending, m/s. Single layers are not used.

    The n layers of a key, soft to loud, stand for the middles of n equal parts of the MIDI range, because a library's
    own mapping is not in its recordings. A weak prior about the default curve stabilises the fit with few layers.
    """
    points = [
        (127 * (i + 0.5) / len(layers), math.log(v))
        for layers in velocities
        if len(layers) > 1
        for i, v in enumerate(layers)
    ]
    if not points:
        return VelocityCurve()
    prior, precision = VelocityCurve(), np.diag(1 / np.square(VELOCITY_PRIOR_SD))
    midi, log_v = np.array(points).T
    rows = np.column_stack([np.ones(len(midi)), (midi - 64) / 63])
    total = precision + rows.T @ rows / LAYER_SD**2
    weighted = precision @ [math.log(prior.at_64), prior.rise] + rows.T @ log_v / LAYER_SD**2
    middle, rise = np.linalg.solve(total, weighted)
    layers = tuple((m, math.exp(v)) for m, v in points)
    return VelocityCurve(math.exp(middle), max(float(rise), LEAST_RISE), "layers", layers)


def _mean_gain(keys: Sequence[KeyFit], own: list[dict], base: dict[str, np.ndarray]) -> np.ndarray:
    """Reference of the gain's law [88]: the mean over the fitted keys, in place of a value from the literature."""
    mass = base["M_S/L"] * base["L"] if is_force(keys[0].note.quantity) else np.ones(len(KEYS))
    log_gains = [math.log(o["gain"] / mass[key.midi - LOWEST_KEY]) for o, key in zip(own, keys, strict=True)]
    return mass * math.exp(np.mean(log_gains))


class _Column(NamedTuple):
    """One quantity over the keyboard, on the scale of its law."""

    law: Law
    centre: np.ndarray  # mean of the law [88]
    played: np.ndarray  # value of every key: from the law, from its own fit, or from both [88]
    sd: np.ndarray  # of `played` [88]
    own: np.ndarray  # value of the fit [keys]
    own_sd: np.ndarray  # [keys]
    state: list[ValueState]  # [keys]


def _column(name: str, keys: Sequence[KeyFit], values: np.ndarray, base: np.ndarray) -> _Column:
    quantity, fitted = LAW_QUANTITIES[name], np.array([key.midi for key in keys])
    own, reference, index = quantity.scaled(values), quantity.scaled(base), fitted - LOWEST_KEY
    sd = np.array([key.sd[name] for key in keys])
    deviation = own - reference[index]
    law = fit_law(fitted.astype(float), deviation, sd, KEYS.astype(float), quantity.prior)
    kept = np.array([_keeps_fit(key, name) for key in keys])
    pulled = ~kept & (np.abs(law.value - deviation) > PULLED * sd)
    centre = reference + law.mean
    # A key that was never recorded also deviates from the law by the scatter between keys.
    played, played_sd = centre.copy(), np.hypot(law.sd, law.scatter)
    played[index] = reference[index] + np.where(kept, deviation, law.value)
    played_sd[index] = np.where(kept, sd, law.value_sd)
    state = np.select([law.outlier, pulled], ["outlier", "pulled"], "fitted").tolist()
    return _Column(law, centre, played, played_sd, own, sd, state)


def _keeps_fit(key: KeyFit, name: str) -> bool:
    """Return True if a key keeps its own value. Its modes and knock were measured with its own force."""
    return LAW_QUANTITIES[name].keeps_fit or key.note.modal_response is not None


def _key(
    midi: int,
    j: int | None,
    keys: Sequence[KeyFit],
    columns: dict[str, _Column],
    paths: Callable[[int], OutputPath | None],
) -> Key:
    """Return one key; `keys[j]` is its fit, if it has one."""
    values = {name: _value(name, column, midi - LOWEST_KEY, j) for name, column in columns.items()}
    note = note_from_quantities({n: value.value for n, value in values.items()}, midi, keys[0].note.quantity)
    sign = math.copysign(1.0, sum(math.copysign(1.0, key.note.gain) for key in keys) or 1.0)
    note = note._replace(gain=sign * note.gain)
    if j is None:
        state = "interpolated" if keys[0].midi < midi < keys[-1].midi else "extrapolated"
        return Key(note._replace(path=paths(midi)), state, values, is_interpolated=True)
    own, states = keys[j].note, {columns[name].state[j] for name in columns if not LAW_QUANTITIES[name].keeps_fit}
    worst: ValueState = next(state for state in WORST_FIRST if state in states)
    return Key(note._replace(path=own.path, modal_response=own.modal_response), worst, values, keys[j].summary)


def _value(name: str, column: _Column, i: int, j: int | None) -> KeyValue:
    """Return one quantity of the key with the index `i`; `j` is the index of its fit, if it has one."""
    unscaled, law, own = LAW_QUANTITIES[name].unscaled, column.law, None
    if j is not None:
        value, interval = float(unscaled(column.own[j])), _interval(name, column.own[j], column.own_sd[j])
        own = OwnFit(value, interval, column.state[j], float(law.z[j]))
    interval = _interval(name, column.played[i], column.sd[i])
    return KeyValue(float(unscaled(column.played[i])), interval, float(unscaled(column.centre[i])), own)


def _interval(name: str, y: Any, sd: Any) -> tuple[Any, Any]:
    """Return the ends of the 95 % interval."""
    unscaled = LAW_QUANTITIES[name].unscaled
    return unscaled(y - HALF_WIDTH_95 * sd), unscaled(y + HALF_WIDTH_95 * sd)


def _keyboard_law(name: str, column: _Column, base: np.ndarray, keys: Sequence[KeyFit]) -> KeyboardLaw:
    quantity, law = LAW_QUANTITIES[name], column.law
    low, high = _interval(name, column.centre, law.sd)
    return KeyboardLaw(
        unit=quantity.unit,
        scale=quantity.scale,
        literature=None if name == "gain" else base,
        value=quantity.unscaled(column.centre),
        low=low,
        high=high,
        scatter=law.scatter,
        length_keys=law.length,
        outliers=tuple(midi_to_note(key.midi) for key, out in zip(keys, law.outlier, strict=True) if out),
    )


def _path_law(keys: Sequence[KeyFit]) -> Callable[[int], OutputPath | None]:
    """Return the output path at any key: a Gaussian process over octaves and keys, from the paths of the fitted keys.

    A fitted key keeps its own path with all residuals. Other keys get only the smooth part.
    """
    paths = [(key.midi, key.note.path, float(key.note.f0)) for key in keys if key.note.path is not None]
    points = [(midi, *point) for midi, path, f0 in paths for point in _third_octave_means(path, f0)]
    if not points:
        return lambda _: None
    midi, octave, db, count = np.array(points).T

    def covariance(m: np.ndarray, o: np.ndarray) -> np.ndarray:
        near = np.exp(-0.5 * ((o[:, None] - octave) / OCTAVES) ** 2)
        drift = np.exp(-0.5 * ((m[:, None] - midi) / DRIFT_KEYS) ** 2)
        return near * (COMMON_DB**2 + DRIFT_DB**2 * drift)

    weights = np.linalg.solve(covariance(midi, octave) + np.diag(ROUGH_DB**2 / count), db)
    return lambda key: OutputPath(THIRDS, covariance(np.full(len(THIRDS), float(key)), np.log2(THIRDS)) @ weights)


def _third_octave_means(path: OutputPath, f0: float) -> np.ndarray:
    """Mean octave, mean dB and number of partials in each third of an octave [thirds, 3]; f0 in Hz.

    The path of the knock does not count, because keybed and action sound there too.
    """
    partials = path.frequency > BAND[1] * f0
    octave = np.log2(path.frequency[partials])
    _, cell, count = np.unique(np.floor(3 * octave), return_inverse=True, return_counts=True)
    return (
        np.stack([np.bincount(cell, octave), np.bincount(cell, path.db[partials]), count**2], axis=1) / count[:, None]
    )


def _warnings(keys: Sequence[KeyFit], columns: dict[str, _Column]) -> list[str]:
    warnings = [
        f"{midi_to_note(key.midi)}: {n} lies {abs(z):.1f} standard deviations {'above' if z > 0 else 'below'} the "
        f"prediction of the other keys; {'it is kept' if _keeps_fit(key, n) else 'the value of the law is used'}"
        for n, column in columns.items()
        for key, z, out in zip(keys, column.law.z, column.law.outlier, strict=True)
        if out
    ]
    unconverged = [midi_to_note(key.midi) for key in keys if not key.summary.converged]
    if unconverged:
        warnings.append(f"The fits of {', '.join(unconverged)} did not converge; their intervals are doubled.")
    if len(keys) < ENOUGH_KEYS:
        warnings.append(
            f"Only {counted(len(keys), 'key')} of this instrument {'are' if len(keys) > 1 else 'is'} "
            "fitted. The shape of the laws comes from the literature, and outliers cannot be detected."
        )
    return warnings
