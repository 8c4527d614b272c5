"""The page's figures, by the names under which page and files have them; all draw what was found and decide nothing.

One look for each sound wherever it appears. Lines are told apart by colour and by stroke: the page must be readable in
grey and by colour-blind eyes (Okabe and Ito's colours).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from ...report.build import spectrum_db
from ...report.drawing import FITTED, INITIAL, INK, MEASURED, log_axis
from .band3 import WITHIN
from .claims import SPANS, SYMBOLS
from .direct import ROUND_TRIP
from .strokes import SOUNDS
from .studies import PRINTED, STRINGS, Findings

__all__ = ["FIGURES"]

WIDTH = 11.25  # inches; the page shows it 1128 pixels wide
GREY = "#9aa3ad"
GLOBAL = "#b8860b"
DEFAULT = "#009e73"
PURPLE = "#8a5a9e"
LINES: dict[str, dict[str, Any]] = {
    "measured": {"color": MEASURED, "ls": "-", "lw": 1.2, "label": "measured"},
    "initial": {"color": INITIAL, "ls": (0, (4, 1.6)), "lw": 1.2, "label": "initial"},
    "global": {"color": GLOBAL, "ls": (0, (1, 1.2)), "lw": 1.8, "label": SOUNDS["global"]},
    "paper": {"color": FITTED, "ls": "-", "lw": 1.6, "label": SOUNDS["paper"]},
    "read": {"color": PURPLE, "ls": (0, (8, 1.5)), "lw": 1.6, "label": SOUNDS["read"]},
    "default": {"color": DEFAULT, "ls": (0, (6, 1.5, 1, 1.5)), "lw": 1.4, "label": SOUNDS["default"]},
}
MARKERS = {"measured": "o", "initial": "s", "global": "^", "paper": "D", "read": "P"}
# Three velocities, soft to hard.
THREE = (
    {"color": "#56b4e9", "ls": (0, (5, 1.5)), "lw": 1.5},
    {"color": FITTED, "ls": "-", "lw": 1.5},
    {"color": INITIAL, "ls": "-", "lw": 1.5},
)
TRUTH = {"color": INK, "lw": 1.0, "ls": (0, (3, 2))}
BANDS = {"band1": "band 1", "band2": "band 2", "band3": "band 3"}
TOP = 6000.0  # Hz of the spectra
EDGES = (1e-3, 1e3)  # what is further off than this, as a factor, is drawn here


FIGURES: dict[str, Callable[[Findings], Any]] = {}  # each makes a figure of matplotlib


def drawn(
    name: str, height: float, rows: int = 1, columns: int = 1, *, share: str = "", key: bool = True, **labels: Any
):
    """Enter in `FIGURES` what draws findings on one axes, or on a list of them, of a height in inches.

    `share`: which of "x" and "y" the axes share. `key`: one legend at the lower edge, of what the first axes show.
    `labels`: what `Axes.set` takes, of each.
    """

    def of(draw: Callable[[Findings, Any], None]) -> Callable[[Findings, Any], None]:
        def figure(f: Findings) -> Any:
            from matplotlib.figure import Figure

            made = Figure(figsize=(WIDTH, height), layout="constrained")
            every = (
                made.subplots(rows, columns, squeeze=False, sharex="x" in share, sharey="y" in share).ravel().tolist()
            )
            for axes in every:
                axes.set(**labels)
            draw(f, every if len(every) > 1 else every[0])
            if key:
                handles, words = every[0].get_legend_handles_labels()
                made.legend(handles, words, loc="outside lower center", ncols=len(words))
            return made

        FIGURES[name] = figure
        return draw

    return of


def stack(rows: Sequence[Any], depth: float, shown: Sequence[tuple[str, np.ndarray, np.ndarray, str]]) -> None:
    """Spectra one below the other, each a name, Hz, dB and colour, down to `depth` below the highest level, dB."""
    top = max(level.max() for _, _, level, _ in shown)
    for axes, (name, frequency, level, color) in zip(rows, shown, strict=True):
        axes.plot(1e-3 * frequency, level, color=color, lw=0.9)
        axes.text(0.99, 0.95, name, transform=axes.transAxes, ha="right", va="top", fontsize=11)
        axes.set_ylim(top - depth, top + 6)
    rows[-1].set_xlabel("frequency (kHz)")


def bars(
    axes: Any, names: Sequence[str], groups: Sequence[tuple[Sequence[float], str, str]], apart: float, **ticks: Any
) -> list[Any]:
    """Groups of bars side by side, each its values [names], colour and label."""
    at, middle = np.arange(len(names)), 0.5 * (len(groups) - 1)
    axes.set_xticks(at, names, **ticks)
    axes.grid(visible=False, axis="x")
    return [
        axes.bar(at + apart * (n - middle), value, apart - 0.02, color=color, label=label)
        for n, (value, color, label) in enumerate(groups)
    ]


@drawn("figure-2", 4.6, xlabel="time from the first touch (ms)", ylabel="force of the hammer (N)")
def force_over_time(f: Findings, axes: Any) -> None:
    """Figure 2."""
    for stroke, look in zip(f.strikes, THREE, strict=True):
        label = f"{stroke.velocity:g} m/s: {1e3 * stroke.contact:.2f} ms"
        axes.plot(1e3 * stroke.time, stroke.force, label=label, **look)
        heights = np.interp(stroke.humps, stroke.time, stroke.force)
        axes.plot(1e3 * stroke.humps, heights, ls="none", marker="v", ms=6, color=look["color"])
    top, humps = max(stroke.force.max() for stroke in f.strikes), f.strikes[-1].humps
    axes.set(xlim=(0, None), ylim=(0, 1.17 * top))
    first = 1e3 * humps[0] if len(humps) else 0.1
    axes.annotate("", (first, 1.05 * top), (first + 1e3 * ROUND_TRIP, 1.05 * top), arrowprops={"arrowstyle": "<->"})
    text = f"2x₀/c = {1e3 * ROUND_TRIP:.2f} ms: to the agraffe and back"
    axes.text(first + 500 * ROUND_TRIP, 1.07 * top, text, ha="center", va="bottom", fontsize=9)


@drawn("figure-3", 4.6, key=False, xlabel="compression of the felt (mm)", ylabel="force (N)", box_aspect=0.6)
def force_over_compression(f: Findings, axes: Any) -> None:
    """Figure 3, with arrows that say which way round the loop is run."""
    stroke = f.strikes[-1]
    pressed = stroke.compression > 0
    u, force = 1e3 * stroke.compression[pressed], stroke.force[pressed]
    axes.fill(u, force, color="#dce9f3", lw=0)
    axes.plot(u, force, **THREE[1])
    falling = len(force) - 1 - int(np.argmax(force[::-1] >= 0.15 * force.max()))
    arrow = {"arrowstyle": "-|>", "color": THREE[1]["color"], "mutation_scale": 20}
    for i in (int(np.argmax(force >= 0.35 * force.max())), falling):
        axes.annotate("", (u[i + 2], force[i + 2]), (u[i - 2], force[i - 2]), arrowprops=arrow)
    axes.set(xlim=(0, 1.03 * u.max()), ylim=(0, None))
    text = f"area: {1e3 * stroke.loop:.3g} mJ\n{100 * stroke.loop / stroke.hammer_energy:.2g} % of the hammer's energy"
    axes.text(0.04, 0.94, text, transform=axes.transAxes, va="top")


@drawn("figure-4", 6.6, 3, share="xy", key=False, ylabel="level (dB)")
def velocity_spectra(f: Findings, rows: list[Any]) -> None:
    """Figure 4, with the spectral centroids."""
    looks = zip(f.strikes, THREE, strict=True)
    stack(rows, 100, [(f"{s.velocity:g} m/s", s.frequency, s.level, look["color"]) for s, look in looks])
    for axes, stroke in zip(rows, f.strikes, strict=True):
        at, across = 1e-3 * stroke.centroid, axes.get_xaxis_transform()
        axes.axvline(at, **TRUTH)
        axes.text(at + 0.03, 0.96, f"centroid {stroke.centroid:.0f} Hz", va="top", fontsize=9, transform=across)


@drawn(
    "band-3", 5.6, key=False, xscale="log", yscale="log", xlabel="hammer's mass over the true one",
    ylabel="felt's stiffness over the true one (as its force)",
)  # fmt: skip
def plane(f: Findings, axes: Any) -> None:
    """The criterion of band 3 over two coordinates, with its minima."""
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
    for axis in (axes.xaxis, axes.yaxis):
        log_axis(axis)
    axes.grid(visible=False)
    scale = [t for t in (-4, -3, -2, -1.5, -1, -0.5, 0) if t >= levels[0]]
    axes.figure.colorbar(shown, ax=axes, fraction=0.03, pad=0.01, label="criterion in band 3", ticks=scale,
                         format=lambda t, _: f"{10.0**t:.2g}")  # fmt: skip


@drawn(
    "searches", 4.8, yscale="log", xlabel="searches, each method's own sorted by where they ended",
    ylabel="criterion in band 3",
)  # fmt: skip
def searches(f: Findings, axes: Any) -> None:
    """Where every search ended, sorted method by method."""
    for name, label, color, marker in (
        ("start", "start", GREY, "x"), ("gradient", "gradient descent", INITIAL, "s"),
        ("squares", "least squares", PURPLE, "^"), ("annealed", "annealing", FITTED, "o"),
        ("polished", "annealing, then least squares", GLOBAL, "D"),
    ):  # fmt: skip
        value = np.clip(np.sort(f.race.ends[name]), None, 10.0)
        inside = "none" if name == "polished" else color
        axes.plot(1 + np.arange(len(value)), value, color=color, marker=marker, ms=6, lw=1.0, label=label, mfc=inside)
    line, text = WITHIN * f.race.least, "below this line: the deepest minimum"
    axes.axhline(line, **TRUTH)
    axes.text(0.995, 1.05 * line, text, ha="right", va="bottom", fontsize=9, transform=axes.get_yaxis_transform())
    axes.locator_params(axis="x", integer=True)
    axes.margins(x=0.02)


@drawn("figure-6", 7.2, 3, share="xy", key=False, ylabel="level (dB)")
def spectra(f: Findings, rows: list[Any]) -> None:
    """Figure 6: measured above, the fits below."""
    rate, sounds = f.origin.recording.rate, f.origin.sounds
    shown = [(LINES[name], spectrum_db(sounds[name], rate, TOP)) for name in ("measured", *STRINGS)]
    stack(rows, 90, [(look["label"], *spectrum, look["color"]) for look, spectrum in shown])


@drawn("figure-7", 6.4, 2, share="y", ylabel="velocity at the pickup (m/s)")
def waveforms(f: Findings, rows: list[Any]) -> None:
    """Figure 7: measured, before and after, over each of `SPANS`."""
    stroke = f.strokes[f.plan.waveform]
    rate = stroke.recording.rate
    looks = {"measured": {"lw": 2.6, "alpha": 0.45}, "initial": {"label": "before", "ls": (0, (7, 2, 1, 2))}}
    looks |= {recipe: {"label": f"after: {SOUNDS[recipe]}", "lw": 1.3} for recipe in STRINGS}
    for axes, (start, stop) in zip(rows, SPANS, strict=True):
        part = np.arange(int(start * rate), int(stop * rate))
        for name, look in looks.items():
            axes.plot(1e3 * part / rate, stroke.sounds[name][part], **LINES[name] | look)
    rows[-1].set_xlabel("time from the onset (ms)")


@drawn("descriptors", 4.9, 1, 2, xlabel="hammer velocity (m/s)")
def descriptors(f: Findings, both: list[Any]) -> None:
    """Attack time and centroid of all sounds over velocity."""
    kinds = (("attack", 1e3, "attack time (ms)"), ("centroid", 1.0, "spectral centroid (Hz)"))
    for axes, (measure, scale, unit) in zip(both, kinds, strict=True):
        for name, marker in MARKERS.items():
            value = [scale * getattr(stroke.closeness[name], measure) for stroke in f.strokes.values()]
            look = {"ms": 11, "mfc": "none", "mew": 1.8} if name == "measured" else {"ms": 7}
            axes.plot([*f.strokes], value, marker=marker, **LINES[name] | look | {"lw": 1.0})
        axes.set(ylabel=unit, ylim=(0, None))
        axes.margins(x=0.05)


@drawn("predictions", 4.4, ylabel="error of the partials' levels (dB, rms)")
def predicted_levels(f: Findings, axes: Any) -> None:
    """Errors of the partials' levels at velocities that were not fitted, dB."""
    origin = f"{f.plan.origin:g} m/s"
    groups = [
        ([one.closeness[kind].level_db for one in f.predictions.values()], color, label)
        for kind, color, label in (
            ("initial", INITIAL, "initial values"), ("nearest", GREY, f"the recording at {origin} itself"),
            ("paper", FITTED, f"three bands at {origin}"), ("read", PURPLE, f"{SOUNDS['read']}, at {origin}"),
        )
    ]  # fmt: skip
    for group in bars(axes, [f"{velocity:g} m/s" for velocity in f.predictions], groups, 0.2):
        axes.bar_label(group, fmt="%.2g", fontsize=8.5, padding=2)
    axes.margins(x=0.02)


@drawn("repeated", 4.6, yscale="log", ylabel="found, over the truth")
def repeated_values(f: Findings, axes: Any) -> None:
    """Every repeated fit's values over the truth; over the paper's, drawn hollow, where there is no truth."""
    true, printed = f.true, PRINTED["final"]
    for side, recipe in enumerate(STRINGS):
        look = LINES[recipe] | {"ls": "none", "marker": MARKERS[recipe], "ms": 6}
        for n, name in enumerate(SYMBOLS):
            value = np.array([row[name] for row in f.repeated[recipe]]) / true.get(name, printed[name])
            at = n + 0.4 * side - 0.32 + 0.24 * np.arange(len(value)) / max(len(value) - 1, 1)
            more = ({"label": None} if n else {}) | ({} if name in true else {"mfc": "none"})
            axes.plot(at, np.clip(value, *EDGES), **look | more)
    axes.axhline(1.0, **TRUTH)
    axes.set_ylim(0.7 * EDGES[0], 1.4 * EDGES[1])
    axes.set_xticks(range(len(SYMBOLS)), [*SYMBOLS.values()])
    axes.margins(x=0.02)


@drawn("effects", 5.0, 1, 3, share="y", yscale="log")
def remains(f: Findings, each: list[Any]) -> None:
    """The criterion that remains after a fit, band by band, with one effect after the other."""
    looks = {recipe: (LINES[recipe]["color"], LINES[recipe]["label"]) for recipe in f.plan.effect_recipes}
    for axes, (band, title) in zip(each, BANDS.items(), strict=True):
        groups = [
            ([one.closeness[recipe].criterion[band] for one in f.effects.values()], *look)
            for recipe, look in looks.items()
        ]
        bars(axes, [*f.effects], groups, 0.27, rotation=30, ha="right")
        axes.set_title(title)
        axes.margins(x=0.04)
    each[0].set_ylabel("criterion that remains")


@drawn("kappa", 4.4, ylabel="κ that is found (m²/s)")
def kappa_by_grid(f: Findings, axes: Any) -> None:
    """κ as fitted, scheme by scheme."""
    for (label, bends), color, marker in zip(f.bends.items(), (FITTED, INITIAL), "os", strict=True):
        axes.plot(range(len(bends)), [b.kappa for b in bends], ls="none", marker=marker, ms=8, color=color, label=label)
    *grids, prewarped = next(iter(f.bends.values()))
    axes.axhline(prewarped.kappa_true, label="true", **TRUTH)
    names = [f"N = {b.points}\n{1e-3 * b.rate:g} kHz" for b in grids]
    axes.set_xticks(range(len(names) + 1), [*names, "prewarped modes"])
    axes.margins(x=0.06, y=0.12)
    axes.grid(visible=False, axis="x")


@drawn("b2", 4.6, xscale="log", yscale="log", xlabel="b₂ (m²/s), all else at the truth", ylabel="criterion")
def b2_over_decades(f: Findings, axes: Any) -> None:
    """The criterion over b2, band by band, and what noise does to it."""
    seen = f.blindness
    for (band, label), color, stroke in zip(BANDS.items(), (GLOBAL, FITTED, INITIAL), (":", "-", "--"), strict=True):
        axes.plot(seen.b2, seen.criterion[band], color=color, ls=stroke, lw=1.8, label=label)
        low, high = seen.noise[band] - seen.spread[band], seen.noise[band] + seen.spread[band]
        axes.axhspan(max(low, 1e-12), high, color=color, alpha=0.15, lw=0)
    axes.axvline(seen.true, **TRUTH)
    across = axes.get_xaxis_transform()
    axes.text(seen.true * 1.15, 0.97, "the paper's b₂, and the truth", va="top", fontsize=9, transform=across)
