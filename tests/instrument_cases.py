"""A synthetic piano for the tests of keyboard laws, player and sampler.

It is the literature's piano, changed by smooth laws. Its keys are available as notes, as recordings that the model
computed at a higher rate than any fit uses, and as the `fit.json` of a fit with given errors.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from pianofit.analysis import midi_to_note
from pianofit.instrument import Instrument
from pianofit.instrument.collect_fits import NAMES, key_observables
from pianofit.io.files import encode_wav
from pianofit.literature import typical
from pianofit.model.modal_response import ModalResponse, VelocityGain
from pianofit.model.modes import mode_frequencies
from pianofit.model.note import Note
from pianofit.model.output_path import OutputPath
from pianofit.parameters import Geometry, Hammer, String

RATE = 44_100
LAYERS = (0.7, 1.7, 4.0)  # m/s
# Two modes of every partial: decay over that of the string model, and relative amplitude.
PARTS = ((1.5, 1.0), (0.3, 0.2))
# Standard deviations of logarithms, typical of the fit of an uncalibrated key.
ERRORS = {"c": 2e-4, "kappa": 5e-3, "b1": 0.1, "b2": 0.1, "K_H": 0.3, "mu": 0.2, "p": 0.04, "M_H": 0.03, "x0": 5e-3}


def true_note(midi: int) -> Note:
    """The true key, struck at 4 m/s."""
    it, x = typical(midi), (midi - 60) / 40
    g = it.geometry
    string = String(
        it.string.c * 2 ** (4 * x**3 / 1200), it.string.kappa * 1.3 * math.exp(-0.1 * x), it.string.b1 * 0.8,
        it.string.b2 * 1.4 * math.exp(0.2 * x),
    )  # fmt: skip
    hammer = Hammer(it.hammer.K_H * 0.5, 0.15, it.hammer.p + 0.08 + 0.05 * x, 0.8 * it.hammer.M_H, 4.0)
    geometry = Geometry(g.length, g.mass, 0.11 * g.length, min(g.width, 0.1 * g.length), 0.5 * g.length)
    frequency = 30.0 * 2.0 ** np.arange(10)
    path = OutputPath(frequency, 3 * np.sin(np.log2(frequency / 30)))
    return Note(string, hammer, geometry, "pressure", 0.02 * math.exp(0.5 * x), path)


def uneven_note(midi: int) -> Note:
    """The key with an individual level and decay of every partial."""
    note, k = true_note(midi), np.arange(1, 16)
    frequency = mode_frequencies(note.string, note.geometry.length, len(k))
    return note._replace(path=OutputPath(frequency, 3 * np.sin(1.7 * k), 1 + 0.4 * np.cos(2.3 * k)))


def rung(midi: int, partials: int = 10) -> Note:
    """The key with two modes a partial, `PARTS`, with individual levels and a knock."""
    note, random = true_note(midi), np.random.default_rng(midi)
    length, k = note.geometry.length, np.arange(1, partials + 1)
    law = note.string.b1 + note.string.b2 * (k * np.pi / length) ** 2
    frequency = mode_frequencies(note.string, length, partials)
    ratio, part = np.array(PARTS).T
    pole = -np.outer(law, ratio) + 2j * np.pi * frequency[:, None]
    level = 100 * np.exp(1j * (random.uniform(0, 6, partials) + np.array([[0.0], [0.7]]))) / k
    pattern = (level[..., None] * part).reshape(2, -1)
    knock = random.normal(size=(2, 9_000)) * np.exp(-np.arange(9_000) / 1_000)
    part = VelocityGain(np.array([0.5, 4.0]), np.array([[1.0], [1.3 + 0.2j]]) * np.ones(2 * partials))
    ringing = ModalResponse(np.repeat(k, 2), pole.ravel(), np.full(2 * partials, 0.1), pattern, 5 * knock, RATE, part)
    return note._replace(ringing=ringing)


def true_instrument(keys: range = range(21, 109)) -> Instrument:
    """The whole instrument; MIDI velocity 64 is 1.3 m/s."""
    return Instrument("twin", {midi: true_note(midi) for midi in keys}, velocity_at_64=1.3, velocity_slope=1.5)


def fit_document(note: Note, errors: dict[str, float], velocities: tuple[float, ...] = LAYERS) -> dict:
    """The `fit.json` of a note, from a fit with these errors (standard deviations of logarithms)."""
    s, h, g = note.string, note.hammer, note.geometry
    values = s._asdict() | h._asdict() | {"x0": g.strike_position, "width": g.width, "M_S": g.mass, "L": g.length}

    def entry(name: str, value: float) -> dict:
        sd = errors.get(name)
        span = None if sd is None else [value * math.exp(-1.959964 * sd), value * math.exp(1.959964 * sd)]
        status = "scaled" if name in ("v_H0", "K_H", "mu") else "fitted"
        return {"value": float(value), "unit": "", "interval": span, "status": status, "note": ""}

    path = note.path
    return {
        "schema": 4, "program": "pianofit", "converged": True, "claims": "", "messages": [], "invariants": {},
        "minima": [],
        "parameters": {name: entry(name, value) for name, value in values.items()},
        "recordings": [
            {"file": f"{v}.wav", "rate": RATE, "v_H0": v, "gain": note.gain, "first": v == velocities[-1],
             "gain_status": "fitted", "v_H0_status": "scaled"} for v in velocities
        ],
        "pickup": {"quantity": note.quantity,
                   "path": None if path is None else {"frequency": path.frequency.tolist(), "db": path.db.tolist()}},
        "derived": {}, "levels": {"fitted_db": 1.2}, "diagnostics": {},
    }  # fmt: skip


def force_entry(note: Note, at: float, sd: float) -> dict:
    """The entry of such a fit for the felt force at the compression `at`, m."""
    value = note.hammer.K_H * at**note.hammer.p / note.geometry.mass
    span = [value * math.exp(-1.959964 * sd), value * math.exp(1.959964 * sd)] if sd else None
    return {"value": value, "unit": "N/kg", "interval": span, "note": ""}


def write_fit(folder: Path, midi: int, document: dict, prefix: str = "twin") -> Path:
    """Write a fit where `pianofit batch` does."""
    file = folder / "keys" / f"{prefix}-{midi_to_note(midi).replace('#', 's')}" / "fit.json"
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(json.dumps(document))
    return file


def library(folder: Path, keys: list[int], seed: int = 0, *, errors: dict[str, float] = ERRORS) -> Path:
    """A folder of fits whose parameters have random `errors`."""
    random = np.random.default_rng(seed)
    for midi in keys:
        note = true_note(midi)
        off = {name: math.exp(sd * random.normal()) for name, sd in errors.items()}
        string = String(*(x * off.get(n, 1.0) for n, x in note.string._asdict().items()))
        # K_H and p trade off: their errors keep the force at 1 mm.
        p, force = note.hammer.p * off.get("p", 1.0), errors.get("K_H", 0.0) / 3
        at_1_mm = note.hammer.K_H * 1e-3**note.hammer.p * math.exp(force * random.normal())
        hammer = note.hammer._replace(K_H=at_1_mm / 1e-3**p, mu=note.hammer.mu * off.get("mu", 1.0), p=p,
                                       M_H=note.hammer.M_H * off.get("M_H", 1.0))  # fmt: skip
        geometry = note.geometry._replace(strike_position=note.geometry.strike_position * off.get("x0", 1.0))
        fitted = note._replace(string=string, hammer=hammer, geometry=geometry)
        spread_p = errors.get("p", 0.0) * note.hammer.p
        stated = errors | {"K_H": math.hypot(force, math.log(1e3) * spread_p)}
        document = fit_document(fitted, stated)
        document["invariants"]["F/M_S"] = force_entry(fitted, 1e-3, force)
        write_fit(folder, midi, document)
    return folder


def record_key(
    folder: Path, midi: int, random: np.random.Generator, noise_db: float = -60.0, layers: tuple[float, ...] = LAYERS
) -> list[Path]:
    """Recordings of the key's layers, 4 s, computed at twice their rate and with noise."""
    files = []
    for i, velocity in enumerate(layers):
        note = true_note(midi)
        struck = note._replace(hammer=note.hammer._replace(v_H0=velocity))
        sound = struck.render_stroke(2 * RATE, 8 * RATE, touch=RATE // 10)[0][::2]
        noise = 10 ** (noise_db / 20) * np.sqrt(np.mean(sound[:RATE] ** 2))
        files.append(folder / f"{midi}-{i}.wav")
        files[-1].write_bytes(encode_wav(sound + random.normal(0.0, noise, len(sound)), RATE))
    return files


def truth(name: str, keys: list[int]) -> np.ndarray:
    """True values of one quantity of `NAMES` [keys], on the scale of its law."""
    assert name in NAMES
    values = np.array([key_observables(true_note(midi), midi)[name] for midi in keys])
    return values if name == "cents" else np.log(values)


def law_errors(document: dict, names: Iterable[str], keys: list[int]) -> dict[str, tuple[float, float]]:
    """(rms error of the law, of the literature) over the keys; logarithms, cents for the tuning."""
    found = {}
    for name in names:
        law = document["laws"][name]
        rows = [np.array(law[column])[np.array(keys) - 21] for column in ("value", "literature")]
        scaled = [row if name == "cents" else np.log(row) for row in rows]
        rms = [float(np.sqrt(np.mean((row - truth(name, keys)) ** 2))) for row in scaled]
        found[name] = (rms[0], rms[1])
    return found
