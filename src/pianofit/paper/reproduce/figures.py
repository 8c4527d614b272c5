"""The page's figures, each by the name under which page and files have it; all draw what was found and decide nothing.

One look for each sound wherever it appears. Lines are told apart by colour and by stroke: the page must be readable in
grey and by colour-blind eyes (Okabe and Ito's colours).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from ...report.build import spectrum_db
from ...report.drawing import FITTED, INITIAL, INK, MEASURED
from .band3 import WITHIN
from .cases import RECIPES
from .claims import SYMBOLS
from .judged import SPANS
from .studies import PRINTED, STRINGS, Findings

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["FIGURES"]

WIDTH = 11.25  # inches; the page shows it 1128 pixels wide
GREY = "#9aa3ad"
GLOBAL = "#b8860b"
DEFAULT = "#009e73"
PURPLE = "#8a5a9e"
READ = RECIPES["read"]
LINES: dict[str, dict[str, Any]] = {
    "measured": {"color": MEASURED, "ls": "-", "lw": 1.2},
    "initial": {"color": INITIAL, "ls": (0, (4, 1.6)), "lw": 1.2},
    "global criterion": {"color": GLOBAL, "ls": (0, (1, 1.2)), "lw": 1.8},
    "three bands": {"color": FITTED, "ls": "-", "lw": 1.6},
    READ: {"color": PURPLE, "ls": (0, (8, 1.5)), "lw": 1.6},
    "default recipe": {"color": DEFAULT, "ls": (0, (6, 1.5, 1, 1.5)), "lw": 1.4},
}
MARKERS = {"measured": "o", "initial": "s", "global criterion": "^", "three bands": "D", READ: "P"}
# Three velocities, soft to hard.
THREE = (
    {"color": "#56b4e9", "ls": (0, (5, 1.5)), "lw": 1.5},
    {"color": FITTED, "ls": "-", "lw": 1.5},
    {"color": INITIAL, "ls": "-", "lw": 1.5},
)
TRUTH = {"color": INK, "lw": 1.0, "ls": (0, (3, 2))}
TOP = 6000.0  # Hz of the spectra
EDGES = (1e-3, 1e3)  # what is further off than this, as a factor, is drawn here
AXES = {"F": "felt's stiffness over the true one (as its force)", "M_H": "hammer's mass over the true one"}


def figure(height: float, rows: int = 1, columns: int = 1, **shared: Any) -> tuple[Figure, list[Any]]:
    """An empty one of the page's width, inches, and its axes."""
    from matplotlib.figure import Figure

    made = Figure(figsize=(WIDTH, height), layout="constrained")
    return made, made.subplots(rows, columns, squeeze=False, **shared).ravel().tolist()


def keyed(made: Figure) -> Figure:
    """The figure with one legend at the lower edge, of what its first axes show."""
    handles, labels = made.axes[0].get_legend_handles_labels()
    made.legend(handles, labels, loc="outside lower center", ncols=len(labels))
    return made


def stacked(height: float, depth: float, shown: Sequence[tuple[str, np.ndarray, np.ndarray, str]]) -> Figure:
    """Spectra one below the other, each a name, Hz, dB and colour, down to `depth` below the highest level, dB."""
    made, rows = figure(height, len(shown), sharex=True, sharey=True)
    top = max(level.max() for _, _, level, _ in shown)
    for axes, (name, frequency, level, color) in zip(rows, shown, strict=True):
        axes.plot(1e-3 * frequency, level, color=color, lw=0.9)
        axes.text(0.99, 0.95, name, transform=axes.transAxes, ha="right", va="top", fontsize=11)
        axes.set(ylim=(top - depth, top + 6), ylabel="level (dB)")
    rows[-1].set_xlabel("frequency (kHz)")
    return made


def marks(name: str) -> dict[str, Any]:
    """How points of a sound look."""
    return {"color": LINES[name]["color"], "marker": MARKERS[name], "ls": "none", "ms": 7, "label": name}


def force_over_time(f: Findings) -> Figure:
    """Figure 2."""
    made, (axes,) = figure(4.6)
    for stroke, look in zip(f.strikes, THREE, strict=True):
        label = f"{stroke.velocity:g} m/s: {1e3 * stroke.contact:.2f} ms"
        axes.plot(1e3 * stroke.time, stroke.force, label=label, **look)
        heights = np.interp(stroke.humps, stroke.time, stroke.force)
        axes.plot(1e3 * stroke.humps, heights, ls="none", marker="v", ms=6, color=look["color"])
    top, hardest = max(stroke.force.max() for stroke in f.strikes), f.strikes[-1]
    axes.set(xlabel="time from the first touch (ms)", ylabel="force of the hammer (N)", xlim=(0, None))
    axes.set_ylim(0, 1.17 * top)
    first = 1e3 * hardest.humps[0] if len(hardest.humps) else 0.1
    axes.annotate("", (first, 1.05 * top), (first + 1e3 * f.trip, 1.05 * top), arrowprops={"arrowstyle": "<->"})
    text = f"2x₀/c = {1e3 * f.trip:.2f} ms: to the agraffe and back"
    axes.text(first + 500 * f.trip, 1.07 * top, text, ha="center", va="bottom", fontsize=9)
    return keyed(made)


def force_over_compression(f: Findings) -> Figure:
    """Figure 3."""
    made, (axes,) = figure(4.6)
    axes.set_box_aspect(0.6)
    stroke = f.strikes[-1]
    pressed = stroke.compression > 0
    u, force = 1e3 * stroke.compression[pressed], stroke.force[pressed]
    axes.fill(u, force, color="#dce9f3", lw=0)
    axes.plot(u, force, **THREE[1])
    falling = len(force) - 1 - int(np.argmax(force[::-1] >= 0.15 * force.max()))
    arrow = {"arrowstyle": "-|>", "color": THREE[1]["color"], "mutation_scale": 20}
    for i in (int(np.argmax(force >= 0.35 * force.max())), falling):  # which way round the loop is run
        axes.annotate("", (u[i + 2], force[i + 2]), (u[i - 2], force[i - 2]), arrowprops=arrow)
    axes.set(xlabel="compression of the felt (mm)", ylabel="force (N)", xlim=(0, 1.03 * u.max()), ylim=(0, None))
    text = f"area: {1e3 * stroke.loop:.3g} mJ\n{100 * stroke.loop / stroke.hammer_energy:.2g} % of the hammer's energy"
    axes.text(0.04, 0.94, text, transform=axes.transAxes, va="top")
    return made


def velocity_spectra(f: Findings) -> Figure:
    """Figure 4, with the spectral centroids."""
    looks = zip(f.strikes, THREE, strict=True)
    made = stacked(6.6, 100, [(f"{s.velocity:g} m/s", s.frequency, s.level, look["color"]) for s, look in looks])
    for axes, stroke in zip(made.axes, f.strikes, strict=True):
        at, across = 1e-3 * stroke.centroid, axes.get_xaxis_transform()
        axes.axvline(at, **TRUTH)
        axes.text(at + 0.03, 0.96, f"centroid {stroke.centroid:.0f} Hz", va="top", fontsize=9, transform=across)
    return made


def kappa_by_grid(f: Findings) -> Figure:
    """κ as fitted, scheme by scheme."""
    made, (axes,) = figure(4.4)
    for (label, bends), color, marker in zip(f.bends.items(), (FITTED, INITIAL), "os", strict=True):
        axes.plot(range(len(bends)), [b.kappa for b in bends], ls="none", marker=marker, ms=8, color=color, label=label)
    some = next(iter(f.bends.values()))
    axes.axhline(some[0].kappa_true, label="true", **TRUTH)
    names = ["prewarped modes" if b.prewarped else f"N = {b.points}\n{1e-3 * b.rate:g} kHz" for b in some]
    axes.set_xticks(range(len(some)), names)
    axes.set(ylabel="κ that is found (m²/s)")
    axes.margins(x=0.06, y=0.12)
    axes.grid(visible=False, axis="x")
    return keyed(made)


def b2_over_decades(f: Findings) -> Figure:
    """The criterion over b2, band by band, and what noise does to it."""
    made, (axes,) = figure(4.6)
    seen = f.blindness
    looks = (("band1", "band 1", GLOBAL, ":"), ("band2", "band 2", FITTED, "-"), ("band3", "band 3", INITIAL, "--"))
    for band, label, color, stroke in looks:
        axes.plot(seen.b2, seen.criterion[band], color=color, ls=stroke, lw=1.8, label=label)
        low, high = seen.noise[band] - seen.spread[band], seen.noise[band] + seen.spread[band]
        axes.axhspan(max(low, 1e-12), high, color=color, alpha=0.15, lw=0)
    axes.axvline(seen.true, **TRUTH)
    across = axes.get_xaxis_transform()
    axes.text(seen.true * 1.15, 0.97, "the paper's b₂, and the truth", va="top", fontsize=9, transform=across)
    axes.set(xscale="log", yscale="log", xlabel="b₂ (m²/s), all else at the truth", ylabel="criterion")
    return keyed(made)


def plane(f: Findings) -> Figure:
    """The criterion of band 3 over two coordinates, with its minima."""
    made, (axes,) = figure(5.6)
    seen = f.plane
    x, y = np.exp(seen.second), np.exp(seen.first)
    level = np.log10(np.clip(np.where(np.isfinite(seen.criterion), seen.criterion, np.nan), 1e-6, 1e2))
    levels = np.arange(np.floor(4 * np.nanmin(level)) / 4, min(np.nanmax(level), 0.5) + 0.1, 0.125)
    shown = axes.contourf(x, y, level, levels=levels, cmap="viridis", extend="max")
    shown.set_rasterized(True)
    for n, minimum in enumerate(seen.minima):
        at = np.exp(minimum.z[1]), np.exp(minimum.z[0])
        look = {"marker": "o", "ms": 9} if n else {"marker": "*", "ms": 17}
        axes.plot(*at, color="white", mec="black", mew=1.0, ls="none", **look)
        side = "right" if minimum.z[1] > 0.8 * seen.second[-1] else "left"
        axes.annotate(f"{minimum.cost:.2g}", at, xytext=(0, 11), ha=side, color="white", textcoords="offset points",
                      fontsize=9.5, fontweight="bold")  # fmt: skip
    axes.set(xscale="log", yscale="log", xlabel=AXES[seen.names[1]], ylabel=AXES[seen.names[0]])
    for axis, reach, ticks in ((axes.xaxis, x, (0.5, 0.7, 1, 1.4, 2)), (axes.yaxis, y, (0.1, 0.2, 0.5, 1, 2, 5, 10))):
        inside = [t for t in ticks if reach[0] <= t <= reach[-1]]
        axis.set_ticks(inside, [f"{t:g}" for t in inside])
        axis.set_ticks([], minor=True)
    axes.grid(visible=False)
    scale = [t for t in (-4, -3, -2, -1.5, -1, -0.5, 0) if t >= levels[0]]
    made.colorbar(shown, ax=axes, fraction=0.03, pad=0.01, label="criterion in band 3", ticks=scale,
                  format=lambda t, _: f"{10.0**t:.2g}")  # fmt: skip
    return made


def searches(f: Findings) -> Figure:
    """Where every search ended, sorted method by method."""
    made, (axes,) = figure(4.8)
    kinds = (
        ("start", "start", GREY, "x"), ("gradient", "gradient descent", INITIAL, "s"),
        ("squares", "least squares", PURPLE, "^"), ("annealed", "annealing", FITTED, "o"),
        ("polished", "annealing, then least squares", GLOBAL, "D"),
    )  # fmt: skip
    for name, label, color, marker in kinds:
        value = np.clip(np.sort(getattr(f.race, name)), None, 10.0)
        inside = "none" if name == "polished" else color
        at = np.arange(1, len(value) + 1)
        axes.plot(at, value, color=color, marker=marker, ms=6, lw=1.0, label=label, mfc=inside)
    line, across = WITHIN * f.race.least, axes.get_yaxis_transform()
    axes.axhline(line, **TRUTH)
    text = "below this line: the deepest minimum"
    axes.text(0.995, 1.05 * line, text, ha="right", va="bottom", fontsize=9, transform=across)
    axes.set(
        xlabel="searches, each method's own sorted by where they ended", ylabel="criterion in band 3", yscale="log"
    )
    axes.locator_params(axis="x", integer=True)
    axes.margins(x=0.02)
    return keyed(made)


def spectra(f: Findings) -> Figure:
    """Figure 6: measured above, the fits below."""
    sounds, rate = f.origin.sounds, f.origin.case.recording.rate
    names = ("measured", "three bands", READ)
    return stacked(7.2, 90, [(n, *spectrum_db(sounds[n], rate, TOP), LINES[n]["color"]) for n in names])


def waveforms(f: Findings) -> Figure:
    """Figure 7: measured, before and after, over each of `SPANS`."""
    stroke = f.at(f.plan.waveform)
    made, rows = figure(6.4, len(SPANS), sharey=True)
    rate = stroke.case.recording.rate
    for axes, (start, stop) in zip(rows, SPANS, strict=True):
        part = slice(int(start * rate), int(stop * rate))
        time = 1e3 * np.arange(part.start, part.stop) / rate
        for name, label, look in (
            ("measured", "measured", {"lw": 2.6, "alpha": 0.45}),
            ("initial", "before", {"ls": (0, (7, 2, 1, 2))}),
            ("three bands", "after: three bands", {"lw": 1.3}),
            (READ, f"after: {READ}", {"lw": 1.3}),
        ):
            axes.plot(time, stroke.sounds[name][part], label=label, **(LINES[name] | look))
        axes.set_ylabel("velocity at the pickup (m/s)")
    rows[-1].set_xlabel("time from the onset (ms)")
    return keyed(made)


def descriptors(f: Findings) -> Figure:
    """Attack time and centroid of all sounds over velocity."""
    made, both = figure(4.9, 1, 2)
    velocity = [stroke.case.velocity for stroke in f.strokes]
    kinds = (("attack", 1e3, "attack time (ms)"), ("centroid", 1.0, "spectral centroid (Hz)"))
    for axes, (field, scale, unit) in zip(both, kinds, strict=True):
        for name in MARKERS:
            value = [scale * getattr(stroke.closeness[name], field) for stroke in f.strokes]
            look = marks(name) | {"ls": LINES[name]["ls"], "lw": 1.0}
            look |= {"ms": 11, "mfc": "none", "mew": 1.8} if name == "measured" else {}
            axes.plot(velocity, value, **look)
        axes.set(xlabel="hammer velocity (m/s)", ylabel=unit, ylim=(0, None))
        axes.margins(x=0.05)
    return keyed(made)


def predicted_levels(f: Findings) -> Figure:
    """Errors of the partials' levels at velocities that were not fitted, dB."""
    made, (axes,) = figure(4.4)
    done, origin = f.predictions, f.plan.origin
    kinds = (
        ("initial", "initial values", INITIAL),
        ("nearest", f"the recording at {origin:g} m/s itself", GREY),
        ("paper", f"three bands at {origin:g} m/s", FITTED),
        ("read", f"{READ}, at {origin:g} m/s", PURPLE),
    )
    at = np.arange(len(done))
    for n, (kind, label, color) in enumerate(kinds):
        value = [p.closeness[kind].level_db for p in done]
        bars = axes.bar(at + 0.2 * (n - 1.5), value, 0.18, color=color, label=label)
        axes.bar_label(bars, fmt="%.2g", fontsize=8.5, padding=2)
    axes.set_xticks(at, [f"{p.velocity:g} m/s" for p in done])
    axes.set(ylabel="error of the partials' levels (dB, rms)")
    axes.margins(x=0.02)
    axes.grid(visible=False, axis="x")
    return keyed(made)


def repeated_values(f: Findings) -> Figure:
    """Every repeated fit's values over the truth; over the paper's, drawn hollow, where there is no truth."""
    made, (axes,) = figure(4.6)
    true, printed = f.tables["full"].true, PRINTED["final"]
    for side, recipe in enumerate(STRINGS):
        rows = f.repeated[recipe]
        for n, name in enumerate(SYMBOLS):
            value = np.array([row[name] for row in rows]) / true.get(name, printed[name])
            at = n + 0.4 * side - 0.32 + 0.24 * np.arange(len(value)) / max(len(value) - 1, 1)
            look = marks(RECIPES[recipe]) | {"ms": 6, "label": None if n else RECIPES[recipe]}
            axes.plot(at, np.clip(value, *EDGES), **look, **({} if name in true else {"mfc": "none"}))
    axes.axhline(1.0, **TRUTH)
    axes.set(yscale="log", ylabel="found, over the truth")
    axes.set_ylim(0.7 * EDGES[0], 1.4 * EDGES[1])
    axes.set_xticks(range(len(SYMBOLS)), [*SYMBOLS.values()])
    axes.margins(x=0.02)
    return keyed(made)


def remains(f: Findings) -> Figure:
    """The criterion that remains after a fit, band by band, with one effect after the other."""
    made, all_bands = figure(5.0, 1, 3, sharey=True)
    done, recipes = f.effects, f.plan.effect_recipes
    colors = {"paper": FITTED, "read": PURPLE, "default": DEFAULT}
    for axes, band in zip(all_bands, ("band1", "band2", "band3"), strict=True):
        for m, recipe in enumerate(recipes):
            at = np.arange(len(done)) + 0.27 * (m - 0.5 * (len(recipes) - 1))
            value = [one.closeness[recipe].criterion[band] for one in done]
            axes.bar(at, value, 0.25, color=colors[recipe], label=RECIPES[recipe])
        axes.set(yscale="log", title=band.replace("band", "band "))
        axes.set_xticks(range(len(done)), [one.name for one in done], rotation=30, ha="right")
        axes.grid(visible=False, axis="x")
        axes.margins(x=0.04)
    all_bands[0].set_ylabel("criterion that remains")
    return keyed(made)


FIGURES: dict[str, Callable[[Findings], Figure]] = {
    "figure-2": force_over_time, "figure-3": force_over_compression, "figure-4": velocity_spectra, "band-3": plane,
    "searches": searches, "figure-6": spectra, "figure-7": waveforms, "descriptors": descriptors,
    "predictions": predicted_levels, "repeated": repeated_values, "effects": remains, "kappa": kappa_by_grid,
    "b2": b2_over_decades,
}  # fmt: skip
