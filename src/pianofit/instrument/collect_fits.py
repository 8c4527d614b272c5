"""Fits of single keys from a folder, on one velocity scale and as quantities that a recording determines.

Lengths and masses are mostly assumed, and recordings determine only some combinations of parameters (invariants). The
keyboard laws use those, so that an assumption does not appear as a difference between keys. An uncalibrated fit
determines its velocities up to a factor: (K_H, μ, v_H0, gain) → (K_H s^(1-p), μ/s, s v_H0, gain/s) does not change the
sound. The loudest recording of every such key is set to `LOUDEST`, which puts all keys on one scale.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..analysis.note_names import midi_to_note, note_to_midi
from ..conversions import HALF_WIDTH_95, midi_of
from ..errors import FitError
from ..fit_file import note_from_document, read_fit
from ..io.files import printable, reference_row
from ..io.number_format import is_number
from ..literature import PICKUP, typical
from ..model.note import Note
from ..parameters import FIT_NAMES, PARAMETERS, Hammer
from ..report.identifiability_text import half_interval

__all__ = [
    "HIGHEST_KEY",
    "LOUDEST_VELOCITY",
    "LOWEST_KEY",
    "NAMES",
    "KeyFit",
    "Layer",
    "find_fits",
    "key_observables",
    "literature",
    "load_keys",
    "is_force",
    "instrument_name",
]

LOWEST_KEY, HIGHEST_KEY = 21, 108
# Assumed velocity of the loudest recording of an uncalibrated key, m/s: a fortissimo.
LOUDEST_VELOCITY = 4.0
# Names of the laws, in the order of the page. All except `cents` are smooth on a log scale.
NAMES = ("cents", "B", "b1", "d2", "M_H/M_S", "K/M_S", "p", "mu", "x0/L", "width/L", "L", "M_S/L", "pickup/L", "gain")
# Standard deviations (of logarithms; cents for `cents`) of values without an interval: small for given values.
DEFAULT_SD = {"cents": 3.0, "width/L": 0.3, "L": 1e-3, "M_S/L": 1e-3, "pickup/L": 1e-3, "x0/L": 1e-2, "gain": 0.1}
DEFAULT_SD_OTHER = 0.1
# Factor on the intervals of a fit that did not converge.
NONCONVERGED_FACTOR = 2.0
# Name of an instrument and of a key, with a separator or with a capital letter: "take2" does not contain the key E2.
_KEY = re.compile(r"(.*?)(?:(?:^|[-_ ])(?=[a-g])|[-_ ]?(?=[A-G]))([A-Ga-g][#sb♯♭]?(?:-1|\d))")


class Layer(NamedTuple):
    """One recording that a key was fitted to."""

    file: str
    sha256: str  # of its bytes
    contact: float  # time at which the hammer touches the string, s
    velocity: float  # of the hammer, m/s


class KeyFit(NamedTuple):
    """The fit of one key."""

    midi: int
    file: str
    note: Note  # with gain and velocity of the loudest recording
    sd: dict[str, float]  # by `NAMES`
    velocities: tuple[float, ...]  # of the recordings, ascending, m/s
    levels_db: float | None  # rms error of the partials' levels
    converged: bool
    recordings: int
    layers: tuple[Layer, ...] = ()  # the recordings with file names, soft to loud


def is_force(quantity: str) -> bool:
    """True if the recorded quantity is proportional to the string mass."""
    return quantity in ("bridge-force", "pressure")


def reference_compression(midi: float) -> float:
    """u_ref, m: largest compression of the literature's hammer of the key if a rigid string stops it from 2 m/s."""
    h = typical(midi).hammer
    return float((0.5 * (h.p + 1) * h.M_H * 2.0**2 / h.K_H) ** (1 / (h.p + 1)))


def key_observables(note: Note, midi: int) -> dict[str, float]:
    """The quantities `NAMES`, which a recording of the key determines.

    Deviation of f0 from equal temperament (cents), B, b1 and d2 = b2 π²/L² (decay rate b1 + d2 k², 1/s), ratios to
    string mass and length, the felt force at u_ref over the string mass (N/kg), p, μ (s/m), and the gain, times M_S for
    bridge force and pressure.
    """
    s, h, g = note.string, note.hammer, note.geometry
    return {
        "cents": 100 * (midi_of(note.f0) - midi),
        "B": note.B,
        "b1": s.b1,
        "d2": s.b2 * (math.pi / g.length) ** 2,
        "M_H/M_S": h.M_H / g.mass,
        "K/M_S": h.K_H * reference_compression(midi) ** h.p / g.mass,
        "p": h.p,
        "mu": h.mu,
        "x0/L": g.strike_position / g.length,
        "width/L": g.width / g.length,
        "L": g.length,
        "M_S/L": g.mass / g.length,
        "pickup/L": g.pickup / g.length,
        "gain": abs(note.gain) * (g.mass if is_force(note.quantity) else 1.0),
    }


def literature(midi: int) -> dict[str, float]:
    """The same quantities of the literature's key; its gain is arbitrary."""
    it = typical(midi)
    width = min(it.geometry.width, 0.1 * it.geometry.length)
    geometry = it.geometry._replace(width=width, pickup=PICKUP * it.geometry.length)
    return key_observables(Note(it.string, it.hammer, geometry, "velocity", 1.0, None), midi)


def find_fits(paths: Sequence[Path], prefix: str | None = None) -> list[Path]:
    """The `fit.json` files among paths: files themselves, and `keys/KEY/fit.json` in folders.

    Raises `FitError` if there is none, or if a folder holds several instruments and `prefix` names none.
    """
    found: list[Path] = []
    for path in paths:
        name = printable(path)
        if path.is_file():
            found.append(path)
            continue
        if not path.is_dir():
            raise FitError(f"{name}: no such file or folder; give what pianofit batch or pianofit fit wrote")
        in_folder = (
            sorted(path.glob("keys/*/fit.json")) or sorted(path.glob("*/fit.json")) or sorted(path.glob("fit.json"))
        )
        if not in_folder:
            raise FitError(f"{name}: holds no keys/KEY/fit.json; give the folder that pianofit batch wrote")
        found += in_folder
    owners = {file: instrument_name(file) for file in found}
    if prefix is not None:
        chosen = [file for file in found if owners[file] == prefix]
        if not chosen:
            names = ", ".join(sorted(repr(printable(name)) for name in set(owners.values())))
            raise FitError(f"--prefix {prefix!r}: no key has this prefix; available: {names}")
        return chosen
    several = sorted({name for name in owners.values() if name})
    if len(several) > 1:
        named = ", ".join(map(printable, several))
        raise FitError(f"{printable(paths[0])}: holds several instruments, {named}; choose one by --prefix")
    return found


def instrument_name(file: Path) -> str:
    """The instrument in the name of a fit's folder, such as cp80 in cp80-Fs2; empty if there is none."""
    return _key_of(file)[0]


def _key_of(file: Path) -> tuple[str, int | None]:
    """The instrument and the key in the folder's name, such as cp80-Fs2."""
    match = _KEY.fullmatch(file.resolve().parent.name)
    return (match[1], note_to_midi(match[2])) if match else ("", None)


def load_keys(files: Sequence[Path]) -> list[KeyFit]:
    """Read the fit of one key from every file, in ascending order of keys.

    Raises `FitError` for a file that is not a `fit.json`, for two fits of one key, for a key beyond the keyboard, and
    for recordings of different quantities.
    """
    keys: dict[int, KeyFit] = {}
    for file in files:
        key = _load_key(file)
        if (other := keys.get(key.midi)) is not None:
            raise FitError(
                f"{printable(file)}: is {midi_to_note(key.midi)}, and so is {other.file}; leave one out, or choose an "
                "instrument by --prefix"
            )
        keys[key.midi] = key
    kinds = sorted({key.note.quantity for key in keys.values()})
    if len(kinds) > 1:
        raise FitError(
            f"{printable(files[0])}: the keys were recorded as {' and '.join(kinds)}; an instrument needs one quantity"
        )
    return [keys[midi] for midi in sorted(keys)]


def _load_key(file: Path) -> KeyFit:
    document, name = read_fit(file), printable(file)
    note, _ = note_from_document(document, file)
    midi = _midi(note, file)
    rows = [row for row in document["recordings"] if isinstance(row, dict)]
    path = reference_row(rows)[1].get("group")
    # The note has the output path of the reference recording, and a gain belongs to a path.
    own = [i for i, row in enumerate(rows) if row.get("group") == path]
    loud = max(own, key=lambda i: _positive(rows[i].get("v_H0"), f"recordings[{i}].v_H0", name))
    gain = _positive(rows[loud].get("gain"), f"recordings[{loud}].gain", name, signed=True)
    velocities = np.unique([_positive(row.get("v_H0"), f"recordings[{i}].v_H0", name) for i, row in enumerate(rows)])
    calibrated = any(row.get(key) == "given" for row in rows for key in ("gain_status", "v_H0_status"))
    if not isinstance(note.hammer, Hammer):
        raise FitError(f"{name}: an instrument cannot use a relaxing felt; fit with --felt hunt-crossley")
    # The law is in log μ, so a felt without loss gets the smallest allowed μ.
    h = note.hammer._replace(v_H0=float(velocities[-1]), mu=max(note.hammer.mu, PARAMETERS["mu"].lower))
    scale = 1.0 if calibrated else LOUDEST_VELOCITY / h.v_H0
    hammer = h._replace(K_H=h.K_H * scale ** (1 - h.p), mu=h.mu / scale, v_H0=h.v_H0 * scale)
    levels = document.get("levels")
    error: Any = levels.get("fitted_db") if isinstance(levels, dict) else None
    converged = document.get("converged") is True
    sd = _deviations(document, note, midi, converged, scale)
    ringing = None if note.ringing is None else note.ringing.scale_velocity(scale)
    path = None if note.path is None else note.path._replace(velocity_discrepancy=None)  # only predictions use it
    return KeyFit(
        midi,
        name,
        note._replace(hammer=hammer, gain=gain / scale, path=path, ringing=ringing),
        sd,
        tuple((velocities * scale).tolist()),
        float(error) if is_number(error) else None,
        converged,
        len(rows),
        _layers(document, rows, scale),
    )


def _layers(document: dict, rows: list[dict], scale: float) -> tuple[Layer, ...]:
    """The recordings of a fit with file names, and their velocities on the instrument's scale."""
    ringing = document.get("ringing") or {}
    delay = {
        layer.get("file"): layer.get("contact_s") for layer in ringing.get("layers") or () if isinstance(layer, dict)
    }
    layers = [
        Layer(
            row["file"],
            str(row.get("sha256")),
            float(row["onset_s"] + (delay.get(row["file"]) or 0.0)),
            float(row["v_H0"] * scale),
        )
        for row in rows
        if isinstance(row.get("file"), str) and is_number(row.get("onset_s"))
    ]
    return tuple(sorted(layers, key=lambda layer: layer.velocity))


def _midi(note: Note, file: Path) -> int:
    """The key in the folder's name if it is within 1.5 semitones of the pitch, otherwise the nearest key.

    The tolerance is for pianos that are out of tune.
    """
    pitch = midi_of(note.f0)
    _, named = _key_of(file)
    midi = named if named is not None and abs(named - pitch) < 1.5 else round(pitch)
    if not LOWEST_KEY <= midi <= HIGHEST_KEY:
        raise FitError(f"{printable(file)}: f0 is {pitch - 69:+.1f} semitones from A4, beyond a piano's A0 to C8")
    return midi


def _positive(x: Any, key: str, name: str, *, signed: bool = False) -> float:
    if not is_number(x) or x == 0 or (x < 0 and not signed):
        raise FitError(f"{name}: {key} is {x!r}, not a usable number; give the file that pianofit fit wrote")
    return float(x)


def _deviations(document: dict, note: Note, midi: int, converged: bool, scale: float) -> dict[str, float]:
    """Standard deviations of `NAMES` (logarithms; cents), from the 95 % intervals."""
    s = {name: _spread(document["parameters"].get(name)) for name in (*FIT_NAMES, "x0")}
    sd: dict[str, float | None] = {
        "cents": None if s["c"] is None else 1200 / math.log(2) * s["c"],
        "B": None if s["kappa"] is None else 2 * math.hypot(s["kappa"], s["c"] or 0.0),
        "b1": s["b1"],
        "d2": s["b2"],
        "M_H/M_S": s["M_H"],
        "p": s["p"],
        "mu": s["mu"],
        "x0/L": s["x0"],
        "K/M_S": _felt_spread(s, document, note, midi, scale),
    }
    factor = 1.0 if converged else NONCONVERGED_FACTOR
    by_name = {name: sd.get(name) for name in NAMES}
    return {n: DEFAULT_SD.get(n, DEFAULT_SD_OTHER) if x is None else max(factor * x, 1e-4) for n, x in by_name.items()}


def _spread(entry: Any) -> float | None:
    """Standard deviation of the logarithm, from an interval."""
    half = half_interval(entry)
    return None if half is None else half / HALF_WIDTH_95


def _felt_spread(s: dict[str, float | None], document: dict, note: Note, midi: int, scale: float) -> float | None:
    """Standard deviation of log K(u_ref), with velocities on the scale of `LOUDEST`.

    The felt is determined best at compressions u that occur in the strokes, where its force has the error e. At u_ref

        var log K(u_ref) = e² + ln²(u_ref/u) var p + 2 ln(u_ref/u) cov(log F, p).

    The covariance follows from var log K_H. If that contains the common scale of the velocities, the covariance is 0,
    since u is the compression at which force and exponent are uncorrelated.
    """
    h, invariants = note.hammer, document.get("invariants")
    entry: Any = invariants.get("F/M_S") if isinstance(invariants, dict) else None
    error = _spread(entry)
    value: Any = entry.get("value") if isinstance(entry, dict) else None
    if s["K_H"] is None or s["p"] is None or error is None or not (is_number(value) and value > 0):
        return s["K_H"]
    log_u = math.log(value * note.geometry.mass / h.K_H) / h.p
    if log_u >= 0:  # at least a metre of compression, which is not a felt
        return s["K_H"]
    p, covariance = s["p"] * float(h.p), 0.0
    velocity = document["parameters"].get("v_H0")
    if not (isinstance(velocity, dict) and velocity.get("status") == "scaled"):
        covariance = (error**2 + (log_u * p) ** 2 - s["K_H"] ** 2) / (2 * log_u)
        covariance = float(np.clip(covariance, -error * p, error * p))
    distance = math.log(reference_compression(midi)) - log_u - math.log(scale)
    return math.sqrt(max(error**2 + (distance * p) ** 2 + 2 * distance * covariance, 1e-6))
