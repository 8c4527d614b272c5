"""Figures 6 and 7 of the paper, and what its claims about sounds and parameters come to."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from ...report.build import spectrum_db
from .cases import RECIPES
from .claims import SYMBOLS
from .looks import DEFAULT, FITTED, GREY, INITIAL, LINES, PURPLE, figure, key, mark_truth, marks
from .studies import Effect, Stroke

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["descriptors", "predicted_levels", "remains", "repeated_values", "spectra", "waveforms"]

READ = RECIPES["read"]
TOP = 6000.0  # Hz of the spectra
EDGES = (1e-3, 1e3)  # what is further off than this, as a factor, is drawn here


def spectra(stroke: Stroke) -> Figure:
    """Figure 6: measured above, the fits below."""
    made, rate = figure(7.2), stroke.case.recording.rate
    first = axes = made.add_axes((0.06, 0.70, 0.93, 0.265))
    levels = {name: spectrum_db(stroke.sounds[name], rate, TOP) for name in ("measured", "three bands", READ)}
    top = max(level.max() for _, level in levels.values())
    for row, (name, (frequency, level)) in enumerate(levels.items()):
        axes = made.add_axes((0.06, 0.70 - 0.305 * row, 0.93, 0.265), sharex=first) if row else first
        look: dict[str, Any] = LINES[name] | {"lw": 0.9, "ls": "-"}
        axes.plot(1e-3 * frequency, level, **look)
        axes.text(0.99, 0.95, name, transform=axes.transAxes, ha="right", va="top", fontsize=11)
        axes.set(ylim=(top - 90, top + 6), ylabel="level (dB)")
        axes.tick_params(labelbottom=row == len(levels) - 1)
    axes.set_xlabel("frequency (kHz)")
    return made


def waveforms(stroke: Stroke, spans: tuple[tuple[float, float], ...]) -> Figure:
    """Figure 7: measured, before and after, over each of `spans`, s."""
    made, rate = figure(6.4), stroke.case.recording.rate
    first = axes = made.add_axes((0.06, 0.595, 0.93, 0.375))
    for row, (start, stop) in enumerate(spans):
        axes = made.add_axes((0.06, 0.14, 0.93, 0.375), sharey=first) if row else first
        part = slice(int(start * rate), int(stop * rate))
        time = 1e3 * np.arange(part.start, part.stop) / rate
        for name, label, look in (
            ("measured", "measured", {"lw": 2.6, "alpha": 0.45}),
            ("initial", "before", {"ls": (0, (7, 2, 1, 2))}),
            ("three bands", "after: three bands", {"lw": 1.3}),
            (READ, "after: three bands, string read", {"lw": 1.3}),
        ):
            whole: dict[str, Any] = LINES[name] | look
            axes.plot(time, stroke.sounds[name][part], label=label, **whole)
        axes.set(ylabel="velocity at the pickup (m/s)", xlabel="time from the onset (ms)" if row else None)
    key(made, first)
    return made


def descriptors(strokes: list[Stroke]) -> Figure:
    """Attack time and centroid of all sounds over velocity."""
    made = figure(4.9)
    for left, unit, scale, field in (
        (0.06, "attack time (ms)", 1e3, "attack"),
        (0.56, "spectral centroid (Hz)", 1.0, "centroid"),
    ):
        axes = made.add_axes((left, 0.21, 0.43, 0.75))
        velocity = np.array([stroke.case.velocity for stroke in strokes])
        names = ("measured", "initial", "global criterion", "three bands", READ)
        for name in names:
            value = [scale * getattr(stroke.closeness[name], field) for stroke in strokes]
            look = marks(name) | {"ls": LINES[name]["ls"], "lw": 1.0}
            if name == "measured":
                look |= {"ms": 11, "mfc": "none", "mew": 1.8}
            axes.plot(velocity, value, **look)
        axes.set(xlabel="hammer velocity (m/s)", ylabel=unit, ylim=(0, None))
        axes.margins(x=0.05)
    key(made, axes)
    return made


def predicted_levels(by: dict[str, list[float]], velocities: list[float], origin: float) -> Figure:
    """Errors of the partials' levels at velocities that were not fitted; `by` has them in dB, [velocities] each."""
    made = figure(4.4)
    axes = made.add_axes((0.06, 0.21, 0.93, 0.75))
    kinds = {
        "initial": ("initial values", INITIAL), "nearest": (f"the recording at {origin:g} m/s itself", GREY),
        "paper": (f"three bands at {origin:g} m/s", FITTED), "read": (f"{READ}, at {origin:g} m/s", PURPLE),
    }  # fmt: skip
    at = np.arange(len(velocities))
    for n, (kind, (label, color)) in enumerate(kinds.items()):
        bars = axes.bar(at + 0.2 * (n - 1.5), by[kind], 0.18, color=color, label=label)
        axes.bar_label(bars, fmt="%.2g", fontsize=8.5, padding=2)
    axes.set_xticks(at, [f"{velocity:g} m/s" for velocity in velocities])
    axes.set(ylabel="error of the partials' levels (dB, rms)")
    axes.margins(x=0.02)
    axes.grid(visible=False, axis="x")
    key(made, axes)
    return made


def repeated_values(by: dict[str, list[dict[str, float]]], true: dict[str, float], printed: dict[str, float]) -> Figure:
    """Every repeated fit's values over the truth; over the paper's, drawn hollow, where there is no truth."""
    made = figure(4.6)
    axes = made.add_axes((0.07, 0.20, 0.92, 0.77))
    for side, (recipe, rows) in enumerate(by.items()):
        for n, name in enumerate(rows[0]):
            known = name in true
            value = np.array([row[name] for row in rows]) / (true if known else printed)[name]
            at = n + 0.4 * side - 0.32 + 0.24 * np.arange(len(value)) / max(len(value) - 1, 1)
            look = marks(recipe) | {"ms": 6, "label": recipe if n == 0 else None}
            look |= {} if known else {"mfc": "none"}
            axes.plot(at, np.clip(value, *EDGES), **look)
    mark_truth(axes.axhline, 1.0)
    axes.set_yscale("log")
    axes.set_ylim(0.7 * EDGES[0], 1.4 * EDGES[1])
    names = [*next(iter(by.values()))[0]]
    axes.set_xticks(range(len(names)), [SYMBOLS[name] for name in names])
    axes.set(ylabel="found, over the truth")
    axes.margins(x=0.02)
    key(made, axes)
    return made


def remains(done: list[Effect], recipes: dict[str, str]) -> Figure:
    """The criterion that remains after a fit, band by band, with one effect after the other."""
    made = figure(5.0)
    first = axes = made.add_axes((0.07, 0.34, 0.29, 0.58))
    bands = {"band1": "band 1", "band2": "band 2", "band3": "band 3"}
    colors = {"paper": FITTED, "read": PURPLE, "default": DEFAULT}
    for n, (band, title) in enumerate(bands.items()):
        axes = made.add_axes((0.07 + 0.315 * n, 0.34, 0.29, 0.58), sharey=first) if n else first
        for m, recipe in enumerate(recipes):
            at = np.arange(len(done)) + 0.27 * (m - 0.5 * (len(recipes) - 1))
            value = [one.remains[recipe][band] for one in done]
            axes.bar(at, value, 0.25, color=colors[recipe], label=recipes[recipe])
        axes.set_yscale("log")
        axes.set_title(title)
        axes.set_xticks(range(len(done)), [one.name for one in done], rotation=30, ha="right")
        axes.grid(visible=False, axis="x")
        axes.margins(x=0.04)
        axes.tick_params(labelleft=not n)
    first.set_ylabel("criterion that remains")
    key(made, first)
    return made
