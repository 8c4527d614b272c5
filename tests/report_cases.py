"""Curves and document of an invented fit, and a parser of the page, for the tests of the report."""

from __future__ import annotations

import dataclasses
import re
from html.parser import HTMLParser

import numpy as np

from pianofit.model.modal_response import PartialDecay
from pianofit.report.figure_data import (
    Envelope,
    Felt,
    IdentifiabilityData,
    ModalResponseCurves,
    RecordingCurves,
    Strokes,
)
from pianofit.report.figures import COMPARED, draw_figures
from pianofit.report.page import FigureData

NAMES = ("original", "initial", "fitted")
FORCE = "static force of the felt at 0.5 mm, at the reference velocity shown"


def note(f0, inharmonicity, count, tilt, rate, seconds, seed=None, noise=0.0, lead=0.03):
    """Return samples, and level in dB and decay of each partial: damped partials after `lead` seconds of silence."""
    k = np.arange(1, count + 1)
    frequency, decay = k * f0 * np.sqrt(1 + inharmonicity * k**2), 0.6 + 0.004 * k**2
    level = -tilt * k + 4 * np.cos(1.7 * k)
    if seed is not None:
        level = level + np.random.default_rng(seed).normal(0, 3, count)
    kept = frequency < 0.45 * rate
    t = np.arange(round(seconds * rate)) / rate - lead
    sound = np.zeros_like(t)
    for f, a, b in zip(frequency[kept], decay[kept], level[kept], strict=True):
        sound += 10 ** (b / 20) * np.exp(-a * np.maximum(t, 0)) * np.sin(2 * np.pi * f * np.maximum(t, 0))
    sound *= 0.25
    sound += noise * np.random.default_rng(1).normal(size=len(t))
    return sound, level, decay


def pulse(ms, duration, depth, stiffness, exponent, loss):
    """Return force in N and compression in mm of a felt (Hunt and Crossley) compressed by half a sine."""
    phase = np.pi * ms / duration
    u = np.where(ms <= duration, depth * np.sin(phase), 0.0)
    rate = np.where(ms <= duration, 1e3 * depth * np.pi / duration * np.cos(phase), 0.0)
    return np.maximum(stiffness * np.maximum(u, 0) ** exponent * (1 + loss * rate), 0), 1e3 * u


def example_curves(rate=44100, seconds=3.0, count=40, f0=92.33, quiet=0.1, path=True):
    """Return the curves of a fit of one string."""
    B, k = 2.3e-4, np.arange(1, count + 1)
    measured, level, decay = note(f0, B, count, 0.9, rate, seconds, seed=3, noise=1e-4)
    initial, level_initial, _ = note(f0 * 1.001, 0.7 * B, count, 1.9, rate, seconds)
    fitted, level_fitted, _ = note(f0, B, count, 0.95, rate, seconds)
    t = np.arange(len(measured)) / rate
    bins = np.arange(0, rate // 2, 3)  # Hz
    bins = bins[(bins > 0.4 * f0) & (bins < (count + 1.5) * f0)]
    damped = [np.fft.rfft((x * np.exp(-30 * t))[:rate], rate)[bins] for x in (measured, initial, fitted)]
    spectra = [20 * np.log10(np.abs(x)) for x in damped]
    attack = slice(round(0.028 * rate), round(0.06 * rate))
    random = np.random.default_rng(5)
    law = 1200 * np.log2(np.sqrt(1 + B * k**2))
    ms = np.linspace(0, 6, 500)
    force_initial, compression_initial = pulse(ms, 2.6, 9e-4, 1.5e9, 2.55, 0.1)
    force_fitted, compression_fitted = pulse(ms, 2.2, 6.5e-4, 5.2e9, 2.56, 0.2)
    return FigureData(
        bins.astype(float), dict(zip(COMPARED, spectra, strict=True)), (0.5 * f0, 1.5 * f0, 8.6 * f0, float(bins[-1])),
        1e3 * (t[attack] - 0.03),
        {"measured": measured[attack], "initial": initial[attack], "fitted": fitted[attack]},
        k, law + random.normal(0, 0.6, count), np.full(count, 0.4), law,
        decay * np.exp(random.normal(0, 0.2, count)), 0.05 * decay, decay,
        {"measured": level, "initial": level_initial, "fitted": level_fitted}, np.full(count, 0.3),
        3 * np.sin(k / 9) if path else None,
        ms, {"initial": force_initial, "fitted": force_fitted},
        {"initial": compression_initial, "fitted": compression_fitted},
        rate, {"original": measured, "initial": quiet * initial, "fitted": fitted},
    )  # fmt: skip


def with_recordings(curves, velocities=(3.2, 0.6, 1.5), count=7):
    """Return the same for several recordings, the first being that of the curves, with all optional parts."""
    rate, k, level, random = curves.sound_rate, curves.number, curves.levels["measured"], np.random.default_rng(8)
    seconds = len(curves.sounds["original"]) / rate
    recordings = []
    for place, velocity in enumerate(velocities, start=1):
        sound = velocity / 4 * note(60.0 + 10 * place, 2e-4, 4, 1.0, rate, seconds)[0]
        force, u = pulse(np.linspace(0, 3, 120), 2.5, 3e-4 * velocity, 5e9, 2.5, 0.1)
        recordings.append(RecordingCurves(
            place, velocity, 1.0 + 0.1 * place, k, level - 3 * place, np.full(len(k), 0.5),
            level - 3 * place + random.normal(0, 1, len(k)), u, force, rate, 0.03, sound, 0.3 * sound[::-1],
        ))  # fmt: skip
    u = np.linspace(0.02, 1.0, 48)
    law = 30 * u**2.5 * np.array([1.0, 0.8, 1.25])[:, None]
    names = ("c", "kappa", "K_H", "mu", "p", "M_H")
    correlation = np.corrcoef(random.normal(size=(len(names), 9)))
    half_widths = (
        ("f0", 1e-4, True),
        ("F/M_S", 0.3, True),
        ("v/v_ref 2", 0.1, True),
        ("K_H", 9.0, False),
        ("p", 0.1, False),
    )
    velocity = np.geomspace(min(velocities), max(velocities), count)
    tones = [note(80.0 + 5 * i, 2e-4, 4, 1.0, rate, min(seconds, 2.5), lead=0.0)[0] for i in range(count)]
    strokes = Strokes(
        velocity, tuple(0.05 * v * x for v, x in zip(velocity, tones, strict=True)), rate, count - 1, True
    )
    return dataclasses.replace(
        curves,
        recordings=tuple(recordings),
        reference_index=0,
        paths=((60.0 * k, 3 * np.sin(k / 3)), (60.0 * k, np.cos(k / 5))),
        felt=Felt(u, law, 0.7 * law),
        identifiability=IdentifiabilityData(names, correlation, half_widths),
        strokes=strokes,
    )


def with_ringing(curves):
    """Return the same for a key with modes and knock, in stereo."""
    time, frames = np.linspace(0.0, 3.0, 200), np.linspace(0.0, 3.0, 80, endpoint=False)
    bands = np.geomspace(60.0, 6000.0, 24)
    envelopes = tuple(
        Envelope(k, 92.0 * k, time, -10 * k - 9 * time, -10 * k - 20 * time, -9.5 * k - 9 * time) for k in range(1, 7)
    )
    level = -20 - 8 * frames - np.arange(24)[:, None]
    decays = (
        PartialDecay(1, 92.331, 3, 4.25, 12.5, 0.75, 6.5, (0.0125, 0.25)),
        PartialDecay(2, 184.9, 1, 3.0, 3.0, np.nan, np.nan, (0.02, 0.02)),
    )

    def stereo(x):
        return np.stack([x, 0.5 * np.roll(x, 9)])

    return dataclasses.replace(
        curves, sounds={"original": stereo(curves.sounds["original"]), "fitted": stereo(curves.sounds["fitted"]),
                        "string model": curves.sounds["initial"]},
        ringing=ModalResponseCurves(envelopes, frames, bands, level, level + 3 * np.sin(5 * frames), decays),
    )  # fmt: skip


def ringing_entry(by="modes and knock", left_out=(8.2, 3.9, 2.6)):
    """Return the entry of `fit.json` for such a key."""
    errors = dict(zip(("law", "modes", "modes and knock"), left_out, strict=True)) if left_out else None
    entry = {"by": by, "left_out_db": errors, "layers": [{"file": "/a folder/a.wav", "contact_s": 0.002}]}
    modes = {"partial": [1, 1, 1, 2]}
    return entry if by == "law" else entry | {"modes": modes, "pattern": [], "knock": None}


def fit_of_recordings(count=3, **changes):
    """Return the document of a fit of several recordings."""
    template = example_fit()["recordings"][0]
    recordings = [
        template | {"file": f"/a folder/recording-{i}.flac", "v_H0": 4.0 / i, "v_H0_interval": [3.6 / i, 4.4 / i],
               "first": i == 1, "cents": -0.5 * i, "group": i % 2, "levels": {"initial_db": 9.0, "fitted_db": 1.0 + i}}
        for i in range(1, count + 1)
    ]  # fmt: skip
    ratios = {
        f"v/v_ref {i}": {
            "value": 1 / i,
            "unit": "1",
            "interval": [0.905 / i, 1.105 / i],
            "note": f"/a folder/recording-{i}.flac",
            "status": "fitted",
        }
        for i in range(2, count + 1)
    }
    fit = example_fit(recordings=recordings, minima=[minimum(0.7, 0.0), minimum(0.3, 1.25)])
    return fit | {"invariants": fit["invariants"] | ratios} | changes


def minimum(share, above):
    """Return one of several minima of the objective."""
    parameters = {"c": 184.661, "K_H": 1.1e10 * (1 + above), "p": 2.56 - 0.1 * above, "mu": 1.0, "M_H": 5.687e-3}
    return {
        "share": share,
        "F": -120.5 + above,
        "parameters": parameters,
        "velocities": [4.0, 2.0, 4 / 3],
        "path_db": None,
    }


def example_held_out(count=3):
    """Return the result of a cross-validation."""
    rows = [
        {"file": f"/a folder/recording-{i}.flac", "v_H0": 0.7 * i, "predicted_v_H0": 0.72 * i, "partials": 20 + i,
         "predicted_db": 1.0 + 0.25 * i, "nearest_db": 3.0 + 0.5 * i, "blend_db": 0.875 if 1 < i < count else None,
         "inner": 1 < i < count}
        for i in range(1, count + 1)
    ]  # fmt: skip
    return {"recordings": rows, "median_inner_db": 1.5, "worst_inner_db": 1.625, "messages": []}


def example_fit(**changes):
    def entry(value, unit, interval, status, initial, note=""):
        return {"value": value, "unit": unit, "interval": interval, "status": status, "initial": initial, "note": note}

    def invariant(value, unit, interval, note=""):
        return {"value": value, "unit": unit, "interval": interval, "note": note, "status": "fitted"}

    length = "scales with an assumed length of 1 m"
    fit = {
        "schema": 4,
        "program": "pianofit",
        "recipe": "default",
        "felt": "hunt-crossley",
        "seed": 0,
        "converged": True,
        "claims": "One uncalibrated recording does not determine the felt. A smooth unknown output path with a hammer "
        "from the literature explains these levels as well.",
        "messages": ["The string's length was not given.", "μ is at its upper bound."],
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
        "recordings": [{"file": "cp80-Fs2-FF.flac", "sha256": "ab" * 32, "channel": "left",
            "rate": 44100, "onset_s": 0.03, "v_H0": 4.0,
                   "v_H0_interval": [1.6, 10.0], "v_H0_status": "scaled", "gain": 0.0123, "gain_status": "fitted",
                   "first": True, "cents": 0.0, "group": 0, "levels": {"initial_db": 12.31, "fitted_db": 2.64}}],
        "minima": [],
        "derived": {"f0": 92.331, "B": 2.3e-4, "f1": 92.34, "contact_ms": 2.214, "max_force_N": 33.42,
                    "max_compression_mm": 0.65, "glide_cents": 4.31, "later_contacts": []},
        "criterion": {"global": {"initial": 0.83, "final": 0.059}, "band1": {"initial": 1.1, "final": 0.02},
                      "band2": {"initial": 0.7, "final": 0.08}, "band3": {"initial": 0.9, "final": 0.9},
                      "dropped": [], "sigma": 30.0, "borders": [46.0, 138.0, 790.0, 3800.0]},
        "levels": {"initial_db": 12.31, "fitted_db": 2.64, "path_only_db": 2.6, "partials": 40},
        "diagnostics": {"evaluations": 812, "correlated": []},
        "versions": {"pianofit": "0.1.0", "python": "3.12.4", "jax": "0.10.0"},
    }  # fmt: skip
    return fit | changes


_DRAWN: dict = {}


def drawn_once(curves, dropped=(), held_out=()):
    """Replace `draw_figures`: draw each set of curves once."""
    key = id(curves), dropped, repr(held_out)
    if key not in _DRAWN:
        _DRAWN[key] = (
            curves,
            draw_figures(curves, dropped, held_out),
        )  # the reference to the curves keeps their id unique
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
