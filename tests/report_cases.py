"""An invented fit and its result, and a parser of the page, for the tests of the report."""

from __future__ import annotations

import functools
import re
from dataclasses import replace
from html.parser import HTMLParser
from types import SimpleNamespace
from typing import Any

import numpy as np

from pianofit.analysis import Analysis, Partials
from pianofit.felt import LAWS
from pianofit.inference.parametrisation import names_of
from pianofit.model import Simulation
from pianofit.model.modal_response import ModalResponse
from pianofit.model.note import Note
from pianofit.model.output_path import OutputPath
from pianofit.parameters import Geometry, Hammer, String
from pianofit.recording.recording import Recording
from pianofit.report.page import draw_figures
from pianofit.result import FittedRecording, Result
from pianofit.result.cross_validation import CrossValidation, LeftOutRecording
from pianofit.result.fitted_recording import RenderedFit
from pianofit.schema.decode import builtins_of, convert
from pianofit.schema.fit import Criterion, Fit, LevelErrors, PartialLevels
from pianofit.schema.modal_response import FittedModalResponse
from pianofit.schema.quantities import Quantities

NAMES = ("original", "initial", "fitted")
FORCE = "static force of the felt at 0.5 mm, at the reference velocity shown"
F0, B, COUNT = 92.33, 2.3e-4, 40
SHARED = names_of(LAWS["hunt-crossley"])
ONSET_S = 0.03


# --- sounds and strokes -----------------------------------------------------------------------------------------------


def sound(f0, inharmonicity, count, tilt, rate, seconds, seed=None, noise=0.0, lead=ONSET_S):
    """Return samples, and level in dB and decay of each partial: damped partials after `lead` seconds of silence."""
    k = np.arange(1, count + 1)
    frequency, decay = k * f0 * np.sqrt(1 + inharmonicity * k**2), 0.6 + 0.004 * k**2
    level = -tilt * k + 4 * np.cos(1.7 * k)
    if seed is not None:
        level = level + np.random.default_rng(seed).normal(0, 3, count)
    kept = frequency < 0.45 * rate
    t = np.arange(round(seconds * rate)) / rate - lead
    samples = np.zeros_like(t)
    for f, a, b in zip(frequency[kept], decay[kept], level[kept], strict=True):
        samples += 10 ** (b / 20) * np.exp(-a * np.maximum(t, 0)) * np.sin(2 * np.pi * f * np.maximum(t, 0))
    samples *= 0.25
    samples += noise * np.random.default_rng(1).normal(size=len(t))
    return samples, level, decay


def stroke(duration, depth, stiffness, exponent, loss):
    """Return a stroke whose felt (Hunt and Crossley) is compressed by half a sine; duration in ms, depth in m."""
    ms = np.linspace(0, 6, 500)
    phase, touches = np.pi * ms / duration, ms <= duration
    u = np.where(touches, depth * np.sin(phase), 0.0)
    rate = np.where(touches, 1e3 * depth * np.pi / duration * np.cos(phase), 0.0)
    force = np.maximum(stiffness * np.maximum(u, 0) ** exponent * (1 + loss * rate), 0)
    pulse, modes = SimpleNamespace(force=force, compression=u), SimpleNamespace(step=1e-3 * ms[1])
    return Simulation(modes, pulse, None)  # pyright: ignore[reportArgumentType]


def example_strokes(velocities=(3.2, 0.6, 1.5), count=7, rate=16_000, seconds=2.0):
    """Return the sounds of the velocity slider by velocity, and True: these are within the recordings."""
    velocity = np.geomspace(min(velocities), max(velocities), count)
    tones = [sound(80.0 + 5 * i, 2e-4, 4, 1.0, rate, min(seconds, 2.5), lead=0.0)[0] for i in range(count)]
    return {v: 0.05 * v * x for v, x in zip(velocity.tolist(), tones, strict=True)}, True


# --- the result -------------------------------------------------------------------------------------------------------


@functools.cache
def example_recordings(
    rate=16_000, seconds=2.0, count=COUNT, f0=F0, quiet=0.1, path=True, velocities=(4.0,), modes=False
) -> tuple[FittedRecording, ...]:
    """Return recordings of one string and their sounds, all equal except for velocity, sound and stroke."""
    sizes = (rate, seconds, count, f0, quiet, path, modes)
    return tuple(_fitted_recording(place, velocity, *sizes) for place, velocity in enumerate(velocities, start=1))


def _fitted_recording(place, velocity, rate, seconds, count, f0, quiet, path, modes):
    k = np.arange(1, count + 1)
    measured, level, decay = sound(f0, B, count, 0.9, rate, seconds, seed=3, noise=1e-4)
    initial, level_initial, _ = sound(f0 * 1.001, 0.7 * B, count, 1.9, rate, seconds)
    fitted, level_fitted, _ = sound(f0, B, count, 0.95, rate, seconds)
    if place > 1:
        measured = velocity / 4 * sound(60.0 + 10 * place, 2e-4, 4, 1.0, rate, seconds)[0]
        fitted = 0.3 * measured[::-1]
    frequency = k * f0 * np.sqrt(1 + B * k**2)
    note = Note(
        String(2 * f0, 2 * f0 * np.sqrt(B) / np.pi, 0.6, 0.004 / np.pi**2),
        Hammer(5.2e9, 0.2, 2.56, 5.687e-3, velocity), Geometry(1.0, 0.00618, 0.12, 0.02, 0.5), "bridge-force", 0.0123,
        OutputPath(frequency, 3 * np.sin(k / 9)) if path else None,
    )  # fmt: skip
    random, square = np.random.default_rng(5), np.zeros((count, count))
    cents = random.normal(0, 0.6, count)
    partials = Partials(
        k, frequency * 2 ** (cents / 1200), frequency * 0.4 * np.log(2) / 1200, square,
        decay * np.exp(random.normal(0, 0.2, count)), 0.05 * decay, square, decay, 0.05 * decay, np.zeros((count, 3)),
            level, np.full(count, 0.3), square,
        np.zeros(count), np.full(count, 40.0), np.zeros(count), np.zeros(0, int), np.zeros(0),
    )  # fmt: skip
    analysis = Analysis(
        f0, 0.01, B, 1e-6, 0.6, 0.01, 0.004, 1e-4, partials, 0.5, 0.1, 4.31, (), np.ones(count), "F#2", ()
    )
    onset = round(ONSET_S * rate)
    frames = np.stack([measured, 0.5 * np.roll(measured, 9)]) if modes else measured[None]
    recording = Recording(
        measured, frames, rate, onset, 1e-4, 0.0, 0, "cp80-Fs2-FF.flac", "ab" * 32, len(frames), "left", "PCM_16", ()
    )
    loops = stroke(2.6, 9e-4, 1.5e9, 2.55, 0.1), stroke(2.2, 1.6e-4 * velocity, 5.2e9, 2.56, 0.2)
    sounds = (
        RenderedFit(note, quiet * initial if place == 1 else initial, loops[0]),
        RenderedFit(note, fitted, loops[1]),
    )
    ringing = None
    if modes:
        stereo = np.stack([fitted, 0.5 * np.roll(fitted, 9)])
        pole = -decay + 2j * np.pi * frequency
        response = ModalResponse(k, pole, np.full(count, 0.1), np.ones((2, count), complex), np.zeros((2, 0)), rate)
        ringing = RenderedFit(note._replace(modal_response=response), stereo.mean(axis=0), loops[1], stereo)
    criterion, errors = Criterion({}, (), 30.0, (46.0, 138.0, 790.0, 3800.0)), LevelErrors(9.0, 1.0, None, count)
    levels = PartialLevels(k, level, np.full(count, 0.3), level_initial, level_fitted)
    return FittedRecording(*sounds, recording, analysis, levels, criterion, errors, ringing)


def example_result(fit: Fit | None = None, recordings: tuple[FittedRecording, ...] = (), **sizes: Any) -> Result:
    """Return a result with this fit, and with the recordings, which are made with `sizes` if none are given."""
    fit = fit or example_fit()
    sizes = {"velocities": tuple(row.stroke_value for row in fit.recordings)} | sizes
    recordings = recordings or example_recordings(**sizes)
    notes = tuple(fitted.final.note for fitted in recordings)
    return Result(fit, recordings, (notes,) * max(len(fit.minima), 1))


def with_reference(result: Result, **changes: Any) -> Result:
    """Return the result with changes of its reference recording."""
    first, *others = result.recordings
    return replace(result, recordings=(replace(first, **changes), *others))


# --- the fit ----------------------------------------------------------------------------------------------------------


def example_fit(content: dict[str, Any] | None = None, **changes: Any) -> Fit:
    """Return the fit of one recording, or with this `content`."""
    return convert((content or example_content()) | changes, Fit, "example", "")


def levels_content(count=COUNT, offset=0.0):
    """Return the compared levels of a recording."""
    recorded, initial, fitted = (
        (sound(F0, B, count, tilt, 100, 0.1, seed=seed)[1] + offset).tolist()
        for tilt, seed in ((0.9, 3), (1.9, None), (0.95, None))
    )
    k = list(range(1, count + 1))
    return {"number": k, "measured": recorded, "error": [0.3] * count, "initial": initial, "fitted": fitted}


def covariance_content(strokes=1, free=("c", "kappa", "K_H", "p", "M_H"), size=0.01):
    """Return a random covariance of the logarithms of the shared parameters, then of the velocities."""
    names = (*SHARED, *("v_H0" if i == 1 else f"v_H0 {i}" for i in range(1, strokes + 1)))
    factor = np.zeros((len(names), len(names)))
    rows = [names.index(name) for name in free]
    factor[np.ix_(rows, rows)] = np.random.default_rng(4).normal(0, size, (len(rows), len(rows)))
    return {"names": list(names), "matrix": (factor @ factor.T).tolist()}


def example_content() -> dict[str, Any]:
    """Return the content of the `fit.json` of one recording."""

    def entry(value, unit, interval, status, initial, note=""):
        return {"value": value, "unit": unit, "interval": interval, "status": status, "initial": initial, "note": note}

    def invariant(value, unit, interval, note=""):
        return {"value": value, "unit": unit, "interval": interval, "note": note, "status": "fitted"}

    length = "scales with an assumed length of 1 m"
    bands = {"global": (0.83, 0.059), "band1": (1.1, 0.02), "band2": (0.7, 0.08), "band3": (0.9, 0.9)}
    criterion = {
        "bands": {name: {"initial": initial, "final": final} for name, (initial, final) in bands.items()},
        "excluded_bands": [], "sigma": 30.0, "borders": [46.0, 138.0, 790.0, 3800.0],
    }  # fmt: skip
    levels = {"initial_db": 12.31, "fitted_db": 2.64, "initial_hammer_db": 2.6, "partials": 40}
    k = np.arange(1, COUNT + 1)
    path = {"frequency": (k * F0 * np.sqrt(1 + B * k**2)).tolist(), "db": (3 * np.sin(k / 9)).tolist()}
    return {
        "schema": 8, "program": "pianofit", "kind": "fit", "recipe": "default", "felt": "hunt-crossley", "seed": 0,
        "converged": True,
        "identifiability_statement": "One uncalibrated recording does not determine the felt. A smooth unknown output "
        "path with a hammer from the literature explains these levels as well.",
        "warnings": ["The string's length was not given.", "μ is at its upper bound."],
        "invariants": {
            "f0": invariant(92.331, "Hz", [92.321, 92.341]),
            "B": invariant(2.3e-4, "1", [2.254e-4, 2.346e-4]),
            "M_H/M_S": invariant(0.92, "1", [0.8928, 0.948]),
            "x0/L": invariant(0.12, "1", None),
            "F/M_S": invariant(118.0, "N/kg", [112.2, 124.0], FORCE),
        },
        "parameters": {
            "c": entry(184.661, "m/s", [184.652, 184.670], "scaled", 184.7, length),
            "kappa": entry(0.8914, "m²/s", [0.871, 0.912], "scaled", 0.87, length),
            "b1": entry(0.5682, "1/s", [0.531, 0.607], "fitted", 0.5),
            "b2": entry(4.05e-4, "m²/s", [3.6e-4, 4.5e-4], "scaled", 1.004e-10, length),
            "K_H": entry(1.09949e10, "N/m^p", [8.1e9, 1.49e10], "scaled", 1.51647e9, "assumed string mass"),
            "mu": entry(1.0, "s/m", None, "at-bound", 0.1, "upper bound 1 s/m"),
            "p": entry(2.56, "1", None, "not-identifiable", 2.55),
            "M_H": entry(5.687e-3, "kg", [5.2e-3, 6.2e-3], "scaled", 6.79e-3),
            "v_H0": entry(4.0, "m/s", [1.6, 10.0], "scaled", 4.0, "its scale comes from the prior"),
            "M_S": entry(0.00618, "kg", None, "assumed", None),
            "L": entry(1.0, "m", None, "assumed", None),
            "x0": entry(0.12, "m", None, "given", None),
        },
        "recordings": [{
            "file": "cp80-Fs2-FF.flac", "sha256": "ab" * 32, "channel": "left", "rate": 44100, "onset_s": ONSET_S,
            "stroke_value": 4.0, "stroke_interval": [1.6, 10.0], "stroke_status": "scaled", "stroke_initial": 4.0,
            "note": None,
            "gain": 0.0123, "gain_status": "fitted", "is_reference": True, "pitch_offset_cents": 0.0, "path_group": 0,
            "stroke": 0, "criterion": criterion, "levels": levels, "partials": levels_content(),
        }],
        "pickup": {"quantity": "bridge-force", "path": path},
        "minima": [minimum(1.0, 0.0) | {"covariance": covariance_content()}],
        "derived": {
            "f0": 92.331, "B": 2.3e-4, "f1": 92.34, "reference_compression_mm": 0.5, "recontacts": [],
            "glide_cents": 4.31, "glide": [],
            "quantities": {
                "contact_time": invariant(2.214, "ms", [2.15, 2.28]),
                "peak_force": invariant(33.42, "N", [31.0, 36.0]) | {"status": "scaled"},
                "peak_compression": invariant(0.65, "mm", [0.6, 0.7]) | {"status": "not-identifiable"},
                "felt_force": invariant(0.73, "N", [0.69, 0.77], "at 0.5 mm") | {"status": "scaled"},
                "T60_1": invariant(12.1, "s", [11.3, 13.0]),
            },
        },
        "criterion": criterion,
        "levels": levels,
        "diagnostics": {"evaluations": 812, "partials": 40, "correlated": []},
        "versions": {"pianofit": "0.1.0", "python": "3.12.4", "jax": "0.10.0"},
    }  # fmt: skip


def content_of_recordings(count=3, velocities=(3.2, 0.6, 1.5)) -> dict[str, Any]:
    """Return the content of the `fit.json` of several recordings in two path groups."""
    content = example_content()
    (template,), path = content["recordings"], content["pickup"]["path"]
    velocities = [*velocities, *(4.0 + i for i in range(count))][:count]
    content["recordings"] = [
        template | {
            "file": f"/a folder/recording-{i}.flac", "stroke_value": v, "stroke_interval": [0.9 * v, 1.1 * v],
            "is_reference": i == 1, "pitch_offset_cents": -0.5 * i, "path_group": i % 2, "stroke": i - 1,
            "levels": template["levels"] | {"initial_db": 9.0, "fitted_db": 1.0 + 0.1 * i},
            "partials": levels_content(offset=-3.0 * i),
        }
        for i, v in enumerate(velocities, start=1)
    ]  # fmt: skip
    content["invariants"] |= {
        f"v/v_ref {i}": {
            "value": 1 / i, "unit": "1", "interval": [0.905 / i, 1.105 / i], "status": "fitted",
            "note": f"/a folder/recording-{i}.flac",
        }
        for i in range(2, count + 1)
    }  # fmt: skip
    content["pickup"]["paths"] = {"0": path, "1": path | {"db": np.cos(np.arange(COUNT) / 5).tolist()}}
    covariance = {"covariance": covariance_content(count)}
    content["minima"] = [minimum(0.7, 0.0) | covariance, minimum(0.3, 1.25) | covariance]
    return content


def fit_of_recordings(count=3, **changes: Any) -> Fit:
    """Return the fit of several recordings."""
    return example_fit(content_of_recordings(count), **changes)


def minimum(weight, above):
    """Return one of several minima of the objective."""
    parameters = {"c": 184.661, "K_H": 1.1e10 * (1 + above), "p": 2.56 - 0.1 * above, "mu": 1.0, "M_H": 5.687e-3}
    return {
        "weight": weight, "negative_log_posterior": -120.5 + above, "parameters": parameters,
        "stroke_values": [4.0, 2.0, 4 / 3], "path_db": None, "path_velocity_discrepancy": None,
    }  # fmt: skip


def response_content(render_model="modes and knock", left_out=(8.2, 3.9, 2.6)):
    """Return the entry of the modal response of a key."""
    errors = dict(zip(("string model", "modes", "modes and knock"), left_out, strict=True)) if left_out else None
    layers = [{"file": "/a folder/a.wav", "contact_s": 0.002}]
    entry = {"render_model": render_model, "leave_one_out_db": errors, "layers": layers}
    modes = {"partial": [1, 1, 1, 2], "frequency": [92.3, 92.4, 92.5, 184.9], "decay": [1.0, 2.0, 3.0, 1.0]}
    response = {"modes": modes, "modal_amplitudes": [{"real": [1.0] * 4, "imag": [0.0] * 4}]}
    return entry if render_model == "string model" else entry | {"response": response}


def modal_response(*arguments: Any, **named: Any) -> FittedModalResponse:
    """Return the same as a record."""
    return convert(response_content(*arguments, **named), FittedModalResponse, "example", "")


def quantities(**entries: dict[str, Any]) -> Quantities:
    """Return a table of quantities from the entries of a file."""
    return convert(entries, Quantities, "example", "")


def example_held_out(count=3) -> CrossValidation:
    """Return the result of a cross-validation."""
    rows = tuple(
        LeftOutRecording(
            f"/a folder/recording-{i}.flac", 0.7 * i, 0.72 * i, 1.0 + 0.25 * i, 20 + i, 3.0 + 0.5 * i,
            0.875 if 1 < i < count else None, 1 < i < count,
        )
        for i in range(1, count + 1)
    )  # fmt: skip
    return CrossValidation(rows, 1.5, 1.625, (), None)  # pyright: ignore[reportArgumentType]


# --- the page ---------------------------------------------------------------------------------------------------------

_DRAWN: dict[Any, Any] = {}


def drawn_once(result, held_out=None):
    """Replace `draw_figures`: draw each fit with the same recordings once."""
    texts = {"identifiability_statement": "", "warnings": (), "versions": {}, "recipe": "", "converged": True}
    key = id(result.recordings), repr(builtins_of(replace(result.fit, **texts))), repr(held_out and held_out.recordings)
    if key not in _DRAWN:  # the reference to the result keeps the id of its recordings unique
        _DRAWN[key] = result, draw_figures(result, held_out)
    return _DRAWN[key][1]


def drawn_in(text):
    """Return the SVG elements of a page."""
    return re.findall(r"<svg.*?</svg>", text, re.DOTALL)


class Page(HTMLParser):
    """Tags with their attributes, in order, the text of scripts, and the visible text."""

    def __init__(self, text):
        super().__init__()
        self.tags, self.scripts, self.texts = [], [], []
        self.feed(text)

    def handle_starttag(self, tag, attributes):  # noqa: D102  (names of the base class)
        self.tags.append((tag, dict(attributes)))

    def handle_data(self, text):  # noqa: D102
        (self.scripts if self.cdata_elem == "script" else [] if self.cdata_elem else self.texts).append(text)

    def all(self, tag):
        """Return the attributes of every such tag."""
        return [attributes for name, attributes in self.tags if name == tag]

    @property
    def drawings(self):
        """Return the attributes of the frames of all panels."""
        return [div for div in self.all("div") if div.get("class") == "drawing"]

    @property
    def text(self):
        """Return the visible text with single spaces."""
        return re.sub(r"\s+", " ", " ".join(self.texts))
