"""A synthetic piano for the tests of keyboard laws, player and sampler.

It is the literature's piano, changed by smooth laws. Its keys are available as notes, as recordings that the model
computed at a higher rate than any fit uses, and as the `fit.json` of a fit with given errors.
"""

from __future__ import annotations

import json
import math
from collections.abc import Collection, Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from pianofit.analysis.note_names import midi_to_note
from pianofit.instrument import Instrument, Key
from pianofit.instrument.files import instrument_record
from pianofit.instrument.key_quantities import LAW_QUANTITIES, key_quantities
from pianofit.io.files import encode_wav
from pianofit.literature import typical
from pianofit.model.modal_response import ModalResponse, VelocityGain
from pianofit.model.modes import mode_frequencies
from pianofit.model.note import Note
from pianofit.model.output_path import OutputPath
from pianofit.parameters import FIT_NAMES, Geometry, Hammer, String
from pianofit.schema.decode import builtins_of
from pianofit.schema.derived import Derived
from pianofit.schema.fit import (
    BandValue,
    Criterion,
    Diagnostics,
    Fit,
    LevelErrors,
    Minimum,
    PartialLevels,
    PathEntry,
    Pickup,
    RecordingFit,
)
from pianofit.schema.instrument import FitSummary
from pianofit.schema.quantities import Covariance, Quantities, Quantity

PRESSED = 0.3e-3  # m, compression at which the fits of a library determine the force
RATE = 44_100
LAYERS = (0.7, 1.7, 4.0)  # m/s
# Two modes of every partial: decay over that of the string model, and relative amplitude.
PARTS = ((1.5, 1.0), (0.3, 0.2))
# Standard deviations of logarithms, typical of the fit of an uncalibrated key.
ERRORS = {"c": 2e-4, "kappa": 5e-3, "b1": 0.1, "b2": 0.1, "K_H": 0.1, "mu": 0.2, "p": 0.04, "M_H": 0.03, "x0": 5e-3}


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
    """The key with an individual level of every partial."""
    note, k = true_note(midi), np.arange(1, 16)
    frequency = mode_frequencies(note.string, note.geometry.length, len(k))
    return note._replace(path=OutputPath(frequency, 3 * np.sin(1.7 * k)))


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
    return note._replace(modal_response=ringing)


def true_instrument(keys: range = range(21, 109)) -> Instrument:
    """The whole instrument; MIDI velocity 64 is 1.3 m/s."""
    return piano_of({midi: true_note(midi) for midi in keys})


def piano_of(notes: Mapping[int, Note], recorded: Collection[int] = (), name: str = "twin") -> Instrument:
    """An instrument of these notes with the default velocity curve."""
    return Instrument(name, {m: Key(note, fit=FitSummary() if m in recorded else None) for m, note in notes.items()})


def with_notes(piano: Instrument, notes: Mapping[int, Note]) -> Instrument:
    """The instrument with these notes in place of its own, or in addition to them."""
    keys = {midi: replace(piano.keys.get(midi, Key(note)), note=note) for midi, note in notes.items()}
    return replace(piano, keys={**piano.keys, **keys})


def notes_of(piano: Instrument) -> dict[int, Note]:
    """The notes of all keys."""
    return {midi: key.note for midi, key in piano.keys.items()}


def document_of(piano: Instrument) -> dict[str, Any]:
    """The content of the `instrument.json`."""
    return json.loads(json.dumps(builtins_of(instrument_record(piano)), allow_nan=False))


def covariance_of(errors: Mapping[str, float], velocities: tuple[float, ...], p: float, pressed: float) -> Covariance:
    """Covariance of a fit: K_H and p trade off, so that the error `K_H` is that of the force at `pressed`, m."""
    strokes = ["v_H0" if i == len(velocities) - 1 else f"v_H0 {i + 1}" for i in range(len(velocities))]
    names = (*(name for name in FIT_NAMES if name != "v_H0"), "x0", "width", *strokes)
    root = np.diag([errors.get(name, 0.0) for name in names])
    root[names.index("K_H"), names.index("p")] = -p * math.log(pressed) * errors.get("p", 0.0)
    return Covariance(names, root @ root.T)


def fit_document(
    note: Note, errors: dict[str, float], velocities: tuple[float, ...] = LAYERS, pressed: float = PRESSED
) -> dict:
    """The `fit.json` of a note, from a fit with these errors (standard deviations of logarithms).

    The error `K_H` is that of the force at the compression `pressed`, m.
    """
    s, h, g = note.string, note.hammer, note.geometry
    values = s._asdict() | h._asdict() | {"x0": g.strike_position, "width": g.width, "M_S": g.mass, "L": g.length}
    criterion = Criterion({"global": BandValue(0.2, 0.1)}, (), 30.0, (50.0, 150.0, 850.0, 950.0))
    levels, one = LevelErrors(2.0, 1.2, None, 1), np.ones(1)
    recordings = [
        RecordingFit(
            file=f"{v}.wav", sha256=str(i), channel="average", rate=RATE, onset_s=0.1, stroke_value=v,
            stroke_interval=None,
            stroke_status="scaled", stroke_initial=None, note=None, gain=note.gain, gain_status="fitted",
            is_reference=v == velocities[-1], pitch_offset_cents=0.0, path_group=0, stroke=i, criterion=criterion,
            levels=levels, partials=PartialLevels(one, one, one, one, one),
        )
        for i, v in enumerate(velocities)
    ]  # fmt: skip
    path = None if note.path is None else PathEntry(note.path.frequency, note.path.db)
    covariance = covariance_of(errors, velocities, float(h.p), pressed)
    own = {name: float(values[name]) for name in (*FIT_NAMES, "x0", "width") if name != "v_H0"}
    minimum = Minimum(1.0, 0.0, own, np.array(velocities), None, None, covariance)
    fit = Fit(
        recipe="default", felt="hunt-crossley", seed=0,
        converged=True, identifiability_statement="", warnings=(), invariants=Quantities({}),
        parameters=Quantities.of(quantity(name, value, errors.get(name)) for name, value in values.items()),
        recordings=tuple(recordings), minima=(minimum,), pickup=Pickup(note.quantity, path), levels=levels,
        criterion=criterion, derived=Derived(1.0, 1e-4, 1.0, 0.2, (), 0.0, ()), diagnostics=Diagnostics(1, 1),
    )  # fmt: skip
    return builtins_of(fit)


def quantity(name: str, value: float, sd: float | None) -> Quantity:
    """A parameter with this standard deviation of its logarithm."""
    interval = None if sd is None else (value * math.exp(-1.959964 * sd), value * math.exp(1.959964 * sd))
    return Quantity(name, float(value), "", interval, "scaled" if name in ("v_H0", "K_H", "mu") else "fitted")


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
        # K_H and p trade off: their errors keep the force at `PRESSED`.
        p, force = note.hammer.p * off.get("p", 1.0), errors.get("K_H", 0.0)
        pressed = note.hammer.K_H * PRESSED**note.hammer.p * math.exp(force * random.normal())
        hammer = note.hammer._replace(K_H=pressed / PRESSED**p, mu=note.hammer.mu * off.get("mu", 1.0), p=p,
                                       M_H=note.hammer.M_H * off.get("M_H", 1.0))  # fmt: skip
        geometry = note.geometry._replace(strike_position=note.geometry.strike_position * off.get("x0", 1.0))
        fitted = note._replace(string=string, hammer=hammer, geometry=geometry)
        write_fit(folder, midi, fit_document(fitted, errors))
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
    """True values of one of the `LAW_QUANTITIES` [keys], on the scale of its law."""
    return LAW_QUANTITIES[name].scaled([key_quantities(true_note(midi), midi)[name] for midi in keys])


def law_errors(piano: Instrument, names: Iterable[str], keys: list[int]) -> dict[str, tuple[float, float]]:
    """(rms error of the law, of the literature) over the keys; logarithms, cents for the tuning."""
    found = {}
    for name in names:
        law = piano.laws[name]
        assert law.literature is not None
        scaled = [LAW_QUANTITIES[name].scaled(row[np.array(keys) - 21]) for row in (law.value, law.literature)]
        rms = [float(np.sqrt(np.mean((row - truth(name, keys)) ** 2))) for row in scaled]
        found[name] = (rms[0], rms[1])
    return found
