"""Calls with arguments of wrong types, for a process without a runtime type checker."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from bad_files import note as sound

import pianofit as pf
from pianofit import bensa2005
from pianofit.errors import PianofitError

# None of these is a text, a number, an array of floats, a path, or an object of pianofit.
WRONG: tuple[Any, ...] = ([], {}, object(), b"x", len, 1j, (1, 2, 3), np.array(["x"]))
F3 = pf.preset("chabassier-F3")
NOTE = pf.Note(F3.string, F3.hammer, F3.geometry, "bridge-force", 0.1)
SPRING = pf.FeltLaw("spring", {"k": pf.Parameter("N/m", "stiffness", 1.0, 1e6)}, lambda u, _, felt: felt.k * u)
TABLE = {"rate": 88_200.0, "n_modes": 32}


def recording() -> pf.Recording:
    return pf.recording_from_samples(sound(), 22_050)


def modes() -> Any:
    return pf.mode_table(F3.string, F3.geometry, **TABLE)


# Calls by the argument that the error must name.
CALLS = {
    "preset": pf.preset,
    "note of a typical key": pf.typical,
    "path": pf.load_recording,
    "path of a setup": pf.Setup.from_toml,
    "path of a note": pf.load_note,
    "path of a result": pf.Result.load,
    "channel": lambda x: pf.load_recording("none.wav", channel=x),
    "rate": lambda x: pf.recording_from_samples(sound(), x),
    "rate of a file": lambda x: pf.encode_wav(sound(), x),
    "path of a sound": lambda x: pf.write_wav(x, sound(), 22_050),
    "note": lambda x: pf.analyse(recording(), note=x),
    "f0": lambda x: pf.analyse(recording(), f0=x),
    "recording": pf.analyse,
    "recording 1": pf.fit,
    "note of a fit": lambda x: pf.fit(recording(), note=x),
    "f0 of a fit": lambda x: pf.fit(recording(), f0=x),
    "velocity": lambda x: pf.fit(recording(), velocity=x),
    "seed": lambda x: pf.fit(recording(), seed=x),
    "intervals": lambda x: pf.fit(recording(), intervals=x),
    "method": lambda x: bensa2005.fit(recording(), method=x),
    "evaluations": lambda x: bensa2005.fit(recording(), evaluations=x),
    "length": lambda x: pf.Setup(length=x),
    "felt": lambda x: pf.Setup(felt=x),
    "notes": lambda x: pf.predict_recording(x, recording()),
    "recording of a validation": lambda x: pf.cross_validate(x),
    "analyses": lambda x: pf.cross_validate(*[recording()] * 3, analyses=x),
    "setup": lambda x: pf.cross_validate(*[recording()] * 3, setup=x or 1),  # an empty table is a setup
    "string": lambda x: pf.simulate(x, F3.hammer, F3.geometry),
    "string of other values": lambda x: pf.simulate(F3.string._replace(c=x), F3.hammer, F3.geometry),
    "hammer": lambda x: pf.simulate(F3.string, x, F3.geometry),
    "hammer of other values": lambda x: pf.simulate(F3.string, F3.hammer._replace(M_H=x), F3.geometry),
    "geometry": lambda x: pf.simulate(F3.string, F3.hammer, x),
    "rate of a sound": lambda x: pf.simulate(F3.string, F3.hammer, F3.geometry, rate=x),
    "quantity": lambda x: pf.mode_table(F3.string, F3.geometry, **TABLE, quantity=x),
    "kind": lambda x: pf.mode_table(F3.string, F3.geometry, **TABLE, kind=x),
    "n_modes": lambda x: pf.mode_table(F3.string, F3.geometry, rate=88_200.0, n_modes=x),
    "modes": lambda x: pf.levels(x),
    "modes of a strike": lambda x: pf.strike(x, F3.hammer, steps=1024),
    "steps": lambda x: pf.strike(modes(), F3.hammer, steps=x),
    "drive": lambda x: pf.levels(modes(), x),
    "samples": lambda x: pf.waveform(modes(), np.ones(32), rate=44_100, samples=x),
    "free": lambda x: pf.levels(modes(), free=x),
    "force": lambda x: pf.pluck(modes(), x),
    "seconds": lambda x: NOTE.render(seconds=x),
    "velocity of a sound": lambda x: NOTE.render(x),
    "velocity of levels": lambda x: NOTE.levels(x),
    "cents": NOTE.with_cents,
    "path of a fit": lambda x: pf.find_fits([x]),
    "string of a grid": lambda x: pf.contact_grid(x, F3.hammer, F3.geometry),
    "hammer of a grid": lambda x: pf.contact_grid(F3.string, x, F3.geometry),
    "geometry of a grid": lambda x: pf.contact_grid(F3.string, F3.hammer, x),
    "name": lambda x: pf.FeltLaw(x, {}, force=max),
    "gain": lambda x: NOTE._replace(gain=x).render(seconds=0.1),
    "path of extras": lambda x: pf.load_extras([x], ""),
    "path of answers": lambda x: pf.count_answers([x]),
    "path of a key": lambda x: pf.load_keys([x]),
    "path of an instrument": pf.load_instrument,
    "path of a listening test": lambda x: pf.write_listening_test("a", "b", x),
    "seed of a song": lambda x: pf.PlayOptions(seed=x).check(),
    "tuning": lambda x: pf.write_tuning("out", x),
    "keys of a data set": lambda x: next(pf.notes(1, options=pf.NoteOptions(keys=x))),
    "count": lambda x: NOTE.levels(2.0, count=x),
    "channel of a recording": lambda x: pf.fit(recording(), channel=x),
    "parameter of a law": lambda x: pf.FeltLaw("own", {"parameter": x}, force=max),
    "displacement": lambda x: pf.simulate(F3.string, F3.hammer, F3.geometry, n_modes=64, displacement=x),
}


# Values of the right type that cannot be used, by the word that the error must have.
VALUES = {
    "velocity": (lambda x: pf.fit(recording(), velocity=x), (True,)),
    "cents": (NOTE.with_cents, (1e5, -1e5, float("nan"))),
    "force=": (lambda x: pf.pluck(modes(), x), (True, np.array([1.0, 2.0]), "2")),
    "M_H": (
        lambda x: pf.simulate(F3.string, F3.hammer._replace(M_H=x), F3.geometry),
        (np.array([0.003, 0.004]),),
    ),
    "c=": (lambda x: pf.simulate(F3.string._replace(c=x), F3.hammer, F3.geometry), (np.array([300.0, 320.0]),)),
    "count": (lambda x: NOTE.levels(2.0, count=x), (0, 1.5)),
    "k=": (lambda x: SPRING.hammer(k=x, M_H=0.01, v_H0=1.0), (True, "2")),
    "drive": (lambda x: pf.levels(modes(), x), (np.ones((2, 32)), np.zeros(0), np.array(1.0), np.ones(32, complex))),
    "frequency": (lambda x: pf.spectrum(modes(), np.ones(32), x, 30.0), (np.ones((2, 3)), np.array(1.0))),
    "length=0": (lambda x: pf.mode_table(F3.string, F3.geometry._replace(length=x), **TABLE), (0.0, 0)),
    "parameters=": (lambda x: pf.FeltLaw("own", x, force=max), (None, 3, [])),
    "storage=": (lambda x: pf.FeltLaw("own", {}, force=max, storage=x), (3, "E")),
    "unit=": (lambda x: pf.FeltLaw("own", {"k": pf.Parameter(x, "", 1.0, 2.0)}, force=max), (3, None)),
    "lower=": (lambda x: pf.FeltLaw("own", {"k": pf.Parameter("1", "", x, 2.0)}, force=max), ("a", None, True)),
    "gain=": (lambda x: NOTE._replace(gain=x).render(seconds=0.1), (np.nan, "a", np.inf)),
    "cents=": (NOTE.with_cents, (np.nan, np.inf)),
    "velocity=": (NOTE._replace(hammer=pf.Pluck(1.0)).levels, (np.array([1.0, 2.0]), "a", 2.0)),
    "weight": (lambda x: pf.predict_recording([(x, NOTE)], recording()), (0.0, -1.0, np.nan, True)),
    "finite as float32": (lambda x: pf.encode_wav(x, 22_050), (np.full(3, 1e39), np.array([np.nan]))),
    "paths=": (pf.find_fits, ("batch", Path("batch"))),
    "paths": (lambda x: pf.load_extras(x, ""), ("batch", Path("batch"))),
    "files=": (pf.load_keys, ("fit.json", None)),
    "files": (pf.count_answers, ("answers.json", None)),
    "progress": (lambda x: pf.write_dataset("none", 1, progress=x), ("x", 1, {})),
    "seed": (lambda x: pf.fit(recording(), seed=x), (True, -1)),
    "start": (lambda x: pf.fit(recording(), start={"M_H": x}), (True, 0.0)),
    "displacement": (CALLS["displacement"], (np.zeros(3), np.full(64, np.nan))),
    "gains": (
        lambda x: pf.predict_recording(NOTE, recording(), gains=x),
        ("x", [np.nan], [1j], np.array(["x"]), {}),
    ),
    "force": (lambda x: pf.FeltLaw("own", {}, force=x), (None, "F", 3.0)),
    "rate": (lambda x: pf.mode_table(F3.string, F3.geometry, rate=x, n_modes=8), (0.0, -1.0)),
    "Pluck": (lambda x: pf.strike(modes(), x, steps=512), (pf.Pluck(1.0),)),
}


def refusal(call: Callable[[Any], Any], wrong: Any) -> str | None:
    """Message of the error, with its class if it is not a PianofitError; None if the value is accepted."""
    try:
        call(wrong)
    except PianofitError as error:
        return str(error)
    except Exception as error:
        return f"{type(error).__name__}\n{error}"
    return None


def faults() -> Iterator[str]:
    """Yield wrong values that are accepted, or rejected without the name of the argument on one line."""
    for name, call in CALLS.items():
        for wrong in WRONG:
            words = refusal(call, wrong)
            if words is None or name.split()[0] not in words or "\n" in words:
                yield f"{name} = {wrong!r}: {words!r}"
    for word, (call, values) in VALUES.items():
        for wrong in values:
            words = refusal(call, wrong)
            if words is None or word not in words or "\n" in words:
                yield f"{word} = {wrong!r}: {words!r}"
    yield from refused_numbers()


def refused_numbers() -> Iterator[str]:
    """Yield names of numbers that are valid but refused, such as those of NumPy."""
    one = pf.NoteOptions(keys=("C5", "C5"), seconds=0.05, rate=np.int64(22_050))  # pyright: ignore[reportArgumentType]
    if len([*pf.notes(np.int64(1), options=one)]) != 1:  # pyright: ignore[reportArgumentType]
        yield "a whole number of NumPy is refused"
    if SPRING.hammer(k=np.float32(2.0), M_H=np.float64(0.01), v_H0=np.int64(1)).k != 2.0:
        yield "a number of NumPy is refused"
    if "no such file" not in str(refusal(lambda x: pf.load_recording("none.wav", channel=x), np.int64(2))):
        yield "a channel of NumPy is refused"
    for note in ("A4", "69", 69, np.int64(69)):
        if pf.analyse(recording(), note=note).note != "A4":
            yield f"note = {note!r}"


if __name__ == "__main__":
    print(*faults(), sep="\n", end="")
