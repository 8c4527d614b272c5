"""From the fits of single keys to a whole instrument: the document that becomes `instrument.json`.

Every quantity of `collect_fits.NAMES` has a keyboard law (`laws`). The output path has a law over keys and frequency. A
fitted key combines its fit with the laws. Any other key takes the values of the laws. The values are converted to
string, hammer, geometry, gain and path, so that every key can be played.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from .. import __version__
from ..analysis.note_names import midi_to_note
from ..conversions import HALF_WIDTH_95, hertz_of
from ..errors import ParameterError
from ..io.number_format import counted
from ..modal_response_file import modal_response_document
from ..model.modal_response import decays_and_beats
from ..model.note import Note
from ..model.output_path import OutputPath
from ..parameters import PARAMETERS, Geometry, Hammer, String
from .collect_fits import (
    HIGHEST_KEY,
    LOWEST_KEY,
    NAMES,
    KeyFit,
    is_force,
    key_observables,
    literature,
    reference_compression,
)
from .laws import Law, Prior, fit_law
from .text import TITLES
from .velocity import velocity_map

__all__ = ["CHANGED", "KEY_STATES", "NEIGHBOURS", "SCHEMA", "build_instrument"]

SCHEMA = 2
KEY_STATES = ("fitted", "pulled", "outlier", "interpolated", "extrapolated")
# State of a key whose values were set by hand on the playable page.
CHANGED = "changed"
# Entry `ringing` of a key that was never recorded, see `interpolate_keys`.
NEIGHBOURS = "neighbours"
# Number of lowest partials whose beating and decays are listed.
LOWEST_PARTIALS = 4
KEYS = np.arange(LOWEST_KEY, HIGHEST_KEY + 1)
# Standard deviations of an instrument from the literature's grand: offset, tilt and smooth deviations, in logarithms
# (cents for the tuning). Chosen once, after the spreads of the initial values.
PRIORS = {
    "cents": Prior(20.0, 15.0, 10.0), "B": Prior(0.7, 0.5, 0.5), "b1": Prior(0.7, 0.5, 0.6),
    "d2": Prior(1.0, 0.7, 0.8), "M_H/M_S": Prior(0.6, 0.4, 0.5), "K/M_S": Prior(1.5, 1.0, 1.0),
    "p": Prior(0.2, 0.1, 0.15), "mu": Prior(1.2, 0.5, 0.8), "x0/L": Prior(0.2, 0.2, 0.2),
    "width/L": Prior(0.3, 0.3, 0.3), "L": Prior(0.3, 0.3, 0.2), "M_S/L": Prior(0.5, 0.3, 0.3),
    "pickup/L": Prior(0.5, 0.3, 0.2), "gain": Prior(3.0, 1.5, 1.0),
}  # fmt: skip
# Quantities that are given, or that a recording determines much better than a law. A key keeps its own values.
OWN_VALUE_QUANTITIES = ("cents", "L", "M_S/L", "pickup/L")
# A value is pulled if the law moved it by more than this many of its own standard deviations.
PULLED = 0.5
# Standard deviations of the output path's law, dB: common to all keys, drift over the keyboard, single partials.
COMMON_DB, DRIFT_DB, ROUGH_DB = 6.0, 4.0, 4.0
OCTAVES, DRIFT_KEYS = 1.0, 15.0
THIRDS = 20.0 * 2 ** (np.arange(31) / 3)  # Hz


def build_instrument(keys: Sequence[KeyFit], name: str = "") -> dict[str, Any]:
    """The document of an instrument from the fits of its keys.

    Raises `ParameterError` without a fit.
    """
    if not keys:
        raise ParameterError("no fit was given; an instrument needs at least one fit.json")
    own = [key_observables(key.note, key.midi) for key in keys]
    base = {n: np.array([literature(int(m)).get(n, 1.0) for m in KEYS]) for n in NAMES}
    base["gain"] = _same_gain(keys, own, base)
    columns = {n: _column(n, keys, np.array([o[n] for o in own]), base[n]) for n in NAMES}
    paths, place = _path_law(keys), {key.midi: j for j, key in enumerate(keys)}
    return {
        "schema": SCHEMA,
        "program": "pianofit",
        "kind": "instrument",
        "name": name,
        "quantity": keys[0].note.quantity,
        "velocity": velocity_map([key.velocities for key in keys]),
        "laws": {n: _law_document(n, column, base[n], keys) for n, column in columns.items()},
        "keys": [_key(int(midi), place.get(int(midi)), keys, columns, paths) for midi in KEYS],
        "messages": _messages(keys, columns),
        "versions": {"pianofit": __version__, "numpy": np.__version__},
    }


def _same_gain(keys: Sequence[KeyFit], own: list[dict], base: dict[str, np.ndarray]) -> np.ndarray:
    """Reference of the gain's law [88]: the mean over the fitted keys, in place of a value from the literature."""
    mass = base["M_S/L"] * base["L"] if is_force(keys[0].note.quantity) else np.ones(len(KEYS))
    log_gains = [math.log(o["gain"] / mass[key.midi - LOWEST_KEY]) for o, key in zip(own, keys, strict=True)]
    return mass * math.exp(np.mean(log_gains))


def _scale(name: str, x: np.ndarray) -> np.ndarray:
    return x if name == "cents" else np.log(x)


def _unscale(name: str, y: Any) -> Any:
    """Values of points on a law's scale."""
    return (y if name == "cents" else np.exp(y)).tolist()


class _Column(NamedTuple):
    """One quantity over the keyboard, on the scale of its law."""

    law: Law
    centre: np.ndarray  # mean of the law [88]
    played: np.ndarray  # value of every key: from the law, from its own fit, or from both [88]
    sd: np.ndarray  # of `played` [88]
    own: np.ndarray  # value of the fit [keys]
    own_sd: np.ndarray  # [keys]
    state: list[str]  # one of `KEY_STATES` [keys]


def _column(name: str, keys: Sequence[KeyFit], values: np.ndarray, base: np.ndarray) -> _Column:
    fitted = np.array([key.midi for key in keys])
    own, reference, index = _scale(name, values), _scale(name, base), fitted - LOWEST_KEY
    sd = np.array([key.sd[name] for key in keys])
    deviation = own - reference[index]
    law = fit_law(fitted.astype(float), deviation, sd, KEYS.astype(float), PRIORS[name])
    kept = np.array([_uses_own_value(key, name) for key in keys])
    pulled = ~kept & (np.abs(law.value - deviation) > PULLED * sd)
    centre = reference + law.mean
    # A key that was never recorded also deviates from the law by the scatter between keys.
    played, played_sd = centre.copy(), np.hypot(law.sd, law.scatter)
    played[index] = reference[index] + np.where(kept, deviation, law.value)
    played_sd[index] = np.where(kept, sd, law.value_sd)
    state = np.select([law.outlier, pulled], ["outlier", "pulled"], "fitted").tolist()
    return _Column(law, centre, played, played_sd, own, sd, state)


def _key(
    midi: int,
    j: int | None,
    keys: Sequence[KeyFit],
    columns: dict[str, _Column],
    paths: Callable[[int], OutputPath | None],
) -> dict[str, Any]:
    """One key of the document; `keys[j]` is its fit, if it has one."""
    i, key, quantity = midi - LOWEST_KEY, None if j is None else keys[j], keys[0].note.quantity
    entries = {
        n: {
            "value": _unscale(n, column.played[i]),
            "interval": _interval(n, column.played[i], column.sd[i]),
            "law": _unscale(n, column.centre[i]),
        }
        | (
            {}
            if j is None
            else {
                "own": _unscale(n, column.own[j]),
                "own_interval": _interval(n, column.own[j], column.own_sd[j]),
                "state": column.state[j],
                "z": float(column.law.z[j]),
            }
        )
        for n, column in columns.items()
    }
    string, hammer, geometry, gain = to_parameters(midi, {n: entry["value"] for n, entry in entries.items()}, quantity)
    if key is None:
        state = "interpolated" if keys[0].midi < midi < keys[-1].midi else "extrapolated"
        path, ringing, fit = paths(midi), NEIGHBOURS, None
    else:
        state = max(
            (entry["state"] for n, entry in entries.items() if n not in OWN_VALUE_QUANTITIES), key=KEY_STATES.index
        )
        path = key.note.path
        ringing = None if key.note.ringing is None else modal_response_document(key.note.ringing, whole=True)
        fit = {
            "file": key.file,
            "recordings": key.recordings,
            "levels_db": key.levels_db,
            "converged": key.converged,
            "velocities": list(key.velocities),
            "layers": [layer._asdict() for layer in key.layers],
            "partials": _partials(key.note),
        }
    sign = math.copysign(1.0, sum(math.copysign(1.0, other.note.gain) for other in keys) or 1.0)
    return {
        "midi": midi,
        "note": midi_to_note(midi),
        "state": state,
        "string": string._asdict(),
        "hammer": {n: getattr(hammer, n) for n in ("K_H", "mu", "p", "M_H")},
        "geometry": geometry._asdict(),
        "gain": sign * gain,
        "path": _path_document(path),
        "ringing": ringing,
        "told": entries,
        "fit": fit,
    }


def _partials(note: Note) -> list[dict[str, Any]]:
    """Lowest partials: split of the two beating modes, cents, and ratio of late to early T60."""
    decays = [] if note.ringing is None else decays_and_beats(note.ringing)
    return [
        {
            "partial": partial.number,
            "late_over_early": _finite(partial.late / partial.early),
            "split_cents": _finite(1200 * math.log2(1 + partial.beat_frequency / partial.frequency)),
        }
        for partial in decays
        if partial.number <= LOWEST_PARTIALS
    ]


def _finite(value: float) -> float | None:
    """None instead of NaN, which JSON does not have."""
    return None if math.isnan(value) else value


def to_parameters(midi: int, at: dict[str, float], quantity: str) -> tuple[String, Hammer, Geometry, float]:
    """String, hammer (at 2 m/s), geometry and gain from a key's values by `NAMES`, clipped to `PARAMETERS`."""
    length = at["L"]
    mass = at["M_S/L"] * length
    f0 = hertz_of(midi + at["cents"] / 100)
    c = 2 * length * f0
    strike = at["x0/L"] * length
    string = {
        "c": c,
        "kappa": c * length * math.sqrt(at["B"]) / math.pi,
        "b1": at["b1"],
        "b2": at["d2"] * (length / math.pi) ** 2,
    }
    hammer = {
        "K_H": at["K/M_S"] * mass / reference_compression(midi) ** at["p"],
        "mu": at["mu"],
        "p": at["p"],
        "M_H": at["M_H/M_S"] * mass,
        "v_H0": 2.0,
    }
    # The contact window stays on the string.
    width = min(at["width/L"] * length, 1.98 * strike, 1.98 * (length - strike))
    geometry = Geometry(length, mass, strike, width, at["pickup/L"] * length)
    gain = at["gain"] / (mass if is_force(quantity) else 1.0)
    return String(**_boxed(string)), Hammer(**_boxed(hammer)), geometry, gain


def _boxed(values: dict[str, float]) -> dict[str, float]:
    return {n: float(np.clip(x, PARAMETERS[n].lower, PARAMETERS[n].upper)) for n, x in values.items()}


def _uses_own_value(key: KeyFit, name: str) -> bool:
    """True if a key keeps its own value. Its modes and knock were measured with its own force."""
    return name in OWN_VALUE_QUANTITIES or key.note.ringing is not None


def _interval(name: str, y: float, sd: float) -> list[float]:
    """95 % interval."""
    return _unscale(name, np.array([y - HALF_WIDTH_95 * sd, y + HALF_WIDTH_95 * sd]))


def _law_document(name: str, column: _Column, base: np.ndarray, keys: Sequence[KeyFit]) -> dict[str, Any]:
    law, centre = column.law, column.centre
    return {
        "unit": TITLES[name][1] if name != "gain" else "",
        "scale": "linear" if name == "cents" else "log",
        "literature": None if name == "gain" else base.tolist(),
        "value": _unscale(name, centre),
        "low": _unscale(name, centre - HALF_WIDTH_95 * law.sd),
        "high": _unscale(name, centre + HALF_WIDTH_95 * law.sd),
        "scatter": law.scatter,
        "length_keys": law.length,
        "outliers": [midi_to_note(key.midi) for key, out in zip(keys, law.outlier, strict=True) if out],
    }


def _path_document(path: OutputPath | None) -> dict[str, list[float]] | None:
    if path is None:
        return None
    decay = path.decay_at(path.frequency)
    return {"frequency": path.frequency.tolist(), "db": path.db.tolist(), "decay": decay.tolist()}


def _path_law(keys: Sequence[KeyFit]) -> Callable[[int], OutputPath | None]:
    """Output path at any key: a Gaussian process over octaves and keys, from the paths of the fitted keys.

    A fitted key keeps its own path with all residuals. Other keys get only the smooth part.
    """
    points = [
        (key.midi, *point) for key in keys if key.note.path is not None for point in _third_octave_means(key.note.path)
    ]
    if not points:
        return lambda _: None
    midi, octave, db, count = np.array(points).T

    def covariance(m, o):
        near = np.exp(-0.5 * ((o[:, None] - octave) / OCTAVES) ** 2)
        drift = np.exp(-0.5 * ((m[:, None] - midi) / DRIFT_KEYS) ** 2)
        return near * (COMMON_DB**2 + DRIFT_DB**2 * drift)

    weights = np.linalg.solve(covariance(midi, octave) + np.diag(ROUGH_DB**2 / count), db)

    def at(key: int) -> OutputPath:
        return OutputPath(THIRDS, covariance(np.full(len(THIRDS), float(key)), np.log2(THIRDS)) @ weights)

    return at


def _third_octave_means(path: OutputPath) -> np.ndarray:
    """Mean octave, mean dB and number of points in each third of an octave [thirds, 3]."""
    octave = np.log2(path.frequency)
    _, cell, count = np.unique(np.floor(3 * octave), return_inverse=True, return_counts=True)
    return np.stack([np.bincount(cell, octave) / count, np.bincount(cell, path.db) / count, count], axis=1)


def _messages(keys: Sequence[KeyFit], columns: dict[str, _Column]) -> list[str]:
    messages = [
        f"{midi_to_note(key.midi)}: {n} lies {abs(z):.1f} standard deviations {'above' if z > 0 else 'below'} the "
        f"prediction of the other keys; {'it is kept' if _uses_own_value(key, n) else 'the value of the law is used'}"
        for n, column in columns.items()
        for key, z, out in zip(keys, column.law.z, column.law.outlier, strict=True)
        if out
    ]
    unconverged = [midi_to_note(key.midi) for key in keys if not key.converged]
    if unconverged:
        messages.append(f"The fits of {', '.join(unconverged)} did not converge; their intervals are doubled.")
    if len(keys) < 5:
        messages.append(
            f"Only {counted(len(keys), 'key')} of this instrument {'are' if len(keys) > 1 else 'is'} "
            "fitted. The shape of the laws comes from the literature, and outliers cannot be detected."
        )
    return messages
