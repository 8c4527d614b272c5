"""The figures of the page, by the names that the page and the files use. They only draw the findings.

Each sound has the same line style in all figures. Lines differ in colour and in dashes, so that they are readable in
greyscale and for colour-blind readers (colours of Okabe and Ito).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from ...report.figures import spectrum_db
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
TOP = 6000.0  # highest frequency of the spectra, Hz
EDGES = (1e-3, 1e3)  # ratios beyond these are drawn at them


FIGURES: dict[str, Callable[[Findings], Any]] = {}  # name -> function that makes a Matplotlib figure


def drawn(
    name: str, height: float, rows: int = 1, columns: int = 1, *, share: str = "", key: bool = True, **labels: Any
):
    """Register a function in `FIGURES` that draws findings on one axes or on a list of axes; `height` is in inches.

    `share`: which of "x" and "y" the axes share. `key`: add one legend at the lower edge, from the first axes.
    `labels`: arguments of `Axes.set`, for all axes.
    """

    def register(draw: Callable[[Findings, Any], None]) -> Callable[[Findings, Any], None]:
        def figure(f: Findings) -> Any:
            from matplotlib.figure import Figure

            fig = Figure(figsize=(WIDTH, height), layout="constrained")
            panels = (
                fig.subplots(rows, columns, squeeze=False, sharex="x" in share, sharey="y" in share).ravel().tolist()
            )
            for axes in panels:
                axes.set(**labels)
            draw(f, panels if len(panels) > 1 else panels[0])
            if key:
                handles, words = panels[0].get_legend_handles_labels()
                fig.legend(handles, words, loc="outside lower center", ncols=len(words))
            return fig

        FIGURES[name] = figure
        return draw

    return register


def stack(rows: Sequence[Any], depth: float, shown: Sequence[tuple[str, np.ndarray, np.ndarray, str]]) -> None:
    """Draw spectra (name, Hz, dB, colour) one below the other, down to `depth`, dB, below the highest level."""
    top = max(level.max() for _, _, level, _ in shown)
    for axes, (name, frequency, level, color) in zip(rows, shown, strict=True):
        axes.plot(1e-3 * frequency, level, color=color, lw=0.9)
        axes.text(0.99, 0.95, name, transform=axes.transAxes, ha="right", va="top", fontsize=11)
        axes.set_ylim(top - depth, top + 6)
    rows[-1].set_xlabel("frequency (kHz)")


def bars(
    axes: Any, names: Sequence[str], groups: Sequence[tuple[Sequence[float], str, str]], apart: float, **ticks: Any
) -> list[Any]:
    """Draw groups of bars (values [names], colour, label) side by side."""
    at, middle = np.arange(len(names)), 0.5 * (len(groups) - 1)
    axes.set_xticks(at, names, **ticks)
    axes.grid(visible=False, axis="x")
    return [
        axes.bar(at + apart * (n - middle), value, apart - 0.02, color=color, label=label)
        for n, (value, color, label) in enumerate(groups)
    ]


@drawn("figure-2", 4.6, xlabel="time from the first contact (ms)", ylabel="force of the hammer (N)")
def force_over_time(f: Findings, axes: Any) -> None:
    """Figure 2."""
    for stroke, look in zip(f.strikes, THREE, strict=True):
        label = f"{stroke.velocity:g} m/s: {1e3 * stroke.contact:.2f} ms"
        axes.plot(1e3 * stroke.time, stroke.force, label=label, **look)
        heights = np.interp(stroke.maxima, stroke.time, stroke.force)
        axes.plot(1e3 * stroke.maxima, heights, ls="none", marker="v", ms=6, color=look["color"])
    top, maxima = max(stroke.force.max() for stroke in f.strikes), f.strikes[-1].maxima
    axes.set(xlim=(0, None), ylim=(0, 1.17 * top))
    first = 1e3 * maxima[0] if len(maxima) else 0.1
    axes.annotate("", (first, 1.05 * top), (first + 1e3 * ROUND_TRIP, 1.05 * top), arrowprops={"arrowstyle": "<->"})
    text = f"2x₀/c = {1e3 * ROUND_TRIP:.2f} ms: to the agraffe and back"
    axes.text(first + 500 * ROUND_TRIP, 1.07 * top, text, ha="center", va="bottom", fontsize=9)


@drawn("figure-3", 4.6, key=False, xlabel="compression of the felt (mm)", ylabel="force (N)", box_aspect=0.6)
def force_over_compression(f: Findings, axes: Any) -> None:
    """Figure 3, with arrows for the direction of the loop."""
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
    share = 100 * stroke.loop / stroke.hammer_energy
    text = f"area: {1e3 * stroke.loop:.3g} mJ\n{share:.2g} % of the hammer energy"
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
    "band-3", 5.6, key=False, xscale="log", yscale="log", xlabel="hammer mass, relative to the true value",
    ylabel="felt stiffness (as force), relative to the true value",
)  # fmt: skip
def criterion_plane(f: Findings, axes: Any) -> None:
    """The criterion of band 3 over two coordinates, with its minima."""
    plane = f.plane
    x, y = np.exp(plane.second), np.exp(plane.first)
    level = np.log10(np.clip(np.where(np.isfinite(plane.criterion), plane.criterion, np.nan), 1e-6, 1e2))
    levels = np.arange(np.floor(4 * np.nanmin(level)) / 4, min(np.nanmax(level), 0.5) + 0.1, 0.125)
    shown = axes.contourf(x, y, level, levels=levels, cmap="viridis", extend="max")
    shown.set_rasterized(True)
    for n, minimum in enumerate(plane.minima):
        at = np.exp(minimum.z[1]), np.exp(minimum.z[0])
        look = {"marker": "o", "ms": 9} if n else {"marker": "*", "ms": 17}
        axes.plot(*at, color="white", mec="black", mew=1.0, ls="none", **look)
        side = "right" if minimum.z[1] > 0.8 * plane.second[-1] else "left"
        axes.annotate(f"{minimum.cost:.2g}", at, xytext=(0, 11), ha=side, color="white", textcoords="offset points",
                      fontsize=9.5, fontweight="bold")  # fmt: skip
    for axis in (axes.xaxis, axes.yaxis):
        log_axis(axis)
    axes.grid(visible=False)
    scale = [t for t in (-4, -3, -2, -1.5, -1, -0.5, 0) if t >= levels[0]]
    axes.figure.colorbar(shown, ax=axes, fraction=0.03, pad=0.01, label="criterion in band 3", ticks=scale,
                         format=lambda t, _: f"{10.0**t:.2g}")  # fmt: skip


@drawn(
    "searches", 4.8, yscale="log", xlabel="searches of each method, sorted by their final criterion",
    ylabel="criterion in band 3",
)  # fmt: skip
def searches(f: Findings, axes: Any) -> None:
    """Final criterion of every search, sorted for each method."""
    for name, label, color, marker in (
        ("start", "start", GREY, "x"), ("gradient", "gradient descent", INITIAL, "s"),
        ("squares", "least squares", PURPLE, "^"), ("annealed", "annealing", FITTED, "o"),
        ("polished", "annealing, then least squares", GLOBAL, "D"),
    ):  # fmt: skip
        value = np.clip(np.sort(f.search_comparison.ends[name]), None, 10.0)
        inside = "none" if name == "polished" else color
        axes.plot(1 + np.arange(len(value)), value, color=color, marker=marker, ms=6, lw=1.0, label=label, mfc=inside)
    line, text = WITHIN * f.search_comparison.least, "below this line: the deepest minimum"
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
    """Figure 7: measured, before and after the fit, over each of `SPANS`."""
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
        ([stroke.closeness[kind].level_db for stroke in f.predictions.values()], color, label)
        for kind, color, label in (
            ("initial", INITIAL, "initial values"), ("nearest", GREY, f"the recording at {origin}"),
            ("paper", FITTED, f"three bands at {origin}"), ("read", PURPLE, f"{SOUNDS['read']}, at {origin}"),
        )
    ]  # fmt: skip
    for group in bars(axes, [f"{velocity:g} m/s" for velocity in f.predictions], groups, 0.2):
        axes.bar_label(group, fmt="%.2g", fontsize=8.5, padding=2)
    axes.margins(x=0.02)


@drawn("repeated", 4.6, yscale="log", ylabel="fitted value, relative to the true value")
def repeated_values(f: Findings, axes: Any) -> None:
    """Values of every repeated fit over the true value; hollow: over the paper's, for μ of a relaxing felt."""
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
def remains(f: Findings, panels: list[Any]) -> None:
    """The criterion after a fit, band by band and effect by effect."""
    looks = {recipe: (LINES[recipe]["color"], LINES[recipe]["label"]) for recipe in f.plan.effect_recipes}
    for axes, (band, title) in zip(panels, BANDS.items(), strict=True):
        groups = [
            ([stroke.closeness[recipe].criterion[band] for stroke in f.effects.values()], *look)
            for recipe, look in looks.items()
        ]
        bars(axes, [*f.effects], groups, 0.27, rotation=30, ha="right")
        axes.set_title(title)
        axes.margins(x=0.04)
    panels[0].set_ylabel("criterion after the fit")


@drawn("kappa", 4.4, ylabel="fitted κ (m²/s)")
def kappa_by_grid(f: Findings, axes: Any) -> None:
    """Fitted κ for each scheme."""
    for (label, fits), color, marker in zip(f.dispersion_errors.items(), (FITTED, INITIAL), "os", strict=True):
        axes.plot(range(len(fits)), [b.kappa for b in fits], ls="none", marker=marker, ms=8, color=color, label=label)
    *grids, prewarped = next(iter(f.dispersion_errors.values()))
    axes.axhline(prewarped.kappa_true, label="true", **TRUTH)
    names = [f"N = {b.points}\n{1e-3 * b.rate:g} kHz" for b in grids]
    axes.set_xticks(range(len(names) + 1), [*names, "prewarped modes"])
    axes.margins(x=0.06, y=0.12)
    axes.grid(visible=False, axis="x")


@drawn("b2", 4.6, xscale="log", yscale="log", xlabel="b₂ (m²/s), all others at their true values", ylabel="criterion")
def b2_over_decades(f: Findings, axes: Any) -> None:
    """The criterion over b2 for each band, and its spread by noise."""
    result = f.b2_sensitivity
    for (band, label), color, stroke in zip(BANDS.items(), (GLOBAL, FITTED, INITIAL), (":", "-", "--"), strict=True):
        axes.plot(result.b2, result.criterion[band], color=color, ls=stroke, lw=1.8, label=label)
        low, high = (
            result.noise[band] - result.spread[band],
            result.noise[band] + result.spread[band],
        )
        axes.axhspan(max(low, 1e-12), high, color=color, alpha=0.15, lw=0)
    axes.axvline(result.true, **TRUTH)
    across = axes.get_xaxis_transform()
    axes.text(result.true * 1.15, 0.97, "true b₂, equal to the paper's", va="top", fontsize=9, transform=across)
