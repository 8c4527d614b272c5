"""What the model does by itself (Figures 2 to 4 of the paper), and what its κ and b2 mean."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from .direct import Strike
from .limits import Bend, Blindness
from .looks import FITTED, GLOBAL, INITIAL, THREE, figure, key, mark_truth

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["b2_over_decades", "force_over_compression", "force_over_time", "kappa_by_grid", "velocity_spectra"]


def force_over_time(strikes: list[Strike], trip: float) -> Figure:
    """Figure 2; `trip` is the wave's way to the agraffe and back, s."""
    made = figure(4.6)
    axes = made.add_axes((0.06, 0.20, 0.93, 0.77))
    for strike, look in zip(strikes, THREE, strict=True):
        label = f"{strike.velocity:g} m/s: {1e3 * strike.contact:.2f} ms"
        axes.plot(1e3 * strike.time, strike.force, label=label, **look)
        heights = np.interp(strike.humps, strike.time, strike.force)
        axes.plot(1e3 * strike.humps, heights, ls="none", marker="v", ms=6, color=look["color"])
    axes.set(xlabel="time from the first touch (ms)", ylabel="force of the hammer (N)", xlim=(0, None))
    top = max(strike.force.max() for strike in strikes)
    axes.set_ylim(0, 1.17 * top)
    first = 1e3 * strikes[-1].humps[0] if len(strikes[-1].humps) else 0.1
    axes.annotate("", (first, 1.05 * top), (first + 1e3 * trip, 1.05 * top), arrowprops={"arrowstyle": "<->"})
    text = f"2x₀/c = {1e3 * trip:.2f} ms: to the agraffe and back"
    axes.text(first + 500 * trip, 1.07 * top, text, ha="center", va="bottom", fontsize=9)
    key(made, axes)
    return made


def force_over_compression(strike: Strike) -> Figure:
    """Figure 3."""
    made = figure(4.6)
    axes = made.add_axes((0.22, 0.13, 0.56, 0.84))
    pressed = strike.compression > 0
    u, force = 1e3 * strike.compression[pressed], strike.force[pressed]
    axes.fill(u, force, color="#dce9f3", lw=0)
    axes.plot(u, force, **THREE[1])
    falling = len(force) - 1 - int(np.argmax(force[::-1] >= 0.15 * force.max()))
    for i in (int(np.argmax(force >= 0.35 * force.max())), falling):  # which way round the loop is run
        axes.annotate("", (u[i + 2], force[i + 2]), (u[i - 2], force[i - 2]),
                      arrowprops={"arrowstyle": "-|>", "color": THREE[1]["color"], "mutation_scale": 20})  # fmt: skip
    axes.set(xlabel="compression of the felt (mm)", ylabel="force (N)", xlim=(0, 1.03 * u.max()), ylim=(0, None))
    text = f"area: {1e3 * strike.loop:.3g} mJ\n{100 * strike.loop / strike.hammer_energy:.2g} % of the hammer's energy"
    axes.text(0.04, 0.94, text, transform=axes.transAxes, va="top")
    return made


def velocity_spectra(strikes: list[Strike]) -> Figure:
    """Figure 4, one below the other."""
    made = figure(6.6)
    top = max(s.level.max() for s in strikes)
    first = None
    for row, (strike, look) in enumerate(zip(strikes, THREE, strict=True)):
        axes = made.add_axes((0.06, 0.70 - 0.305 * row, 0.93, 0.265), sharex=first)
        axes.plot(1e-3 * strike.frequency, strike.level, **(look | {"ls": "-", "lw": 1.0}))
        mark_truth(axes.axvline, 1e-3 * strike.centroid)
        axes.text(1e-3 * strike.centroid + 0.03, top + 2, f"centroid {strike.centroid:.0f} Hz", va="top", fontsize=9)
        axes.text(0.995, 0.95, f"{strike.velocity:g} m/s", transform=axes.transAxes, ha="right", va="top", fontsize=11)
        axes.set(ylim=(top - 100, top + 6), ylabel="level (dB)")
        if row < len(strikes) - 1:
            axes.tick_params(labelbottom=False)
        else:
            axes.set_xlabel("frequency (kHz)")
        first = first or axes
    return made


def kappa_by_grid(by_band: dict[str, list[Bend]]) -> Figure:
    """κ as fitted, scheme by scheme."""
    made = figure(4.4)
    axes = made.add_axes((0.07, 0.24, 0.92, 0.73))
    looks = ((FITTED, "o"), (INITIAL, "s"))
    for (label, bends), (color, marker) in zip(by_band.items(), looks, strict=True):
        axes.plot(range(len(bends)), [b.kappa for b in bends], ls="none", marker=marker, ms=8, color=color, label=label)
    some = next(iter(by_band.values()))
    mark_truth(axes.axhline, some[0].kappa_true, label="true")
    names = [
        "prewarped modes" if b.kind == "continuous" else f"N = {b.points}\n{1e-3 * b.rate:g} kHz" for b in some
    ]  # fmt: skip
    axes.set_xticks(range(len(some)), names)
    axes.set(ylabel="κ that is found (m²/s)")
    axes.margins(x=0.06, y=0.12)
    axes.grid(visible=False, axis="x")
    key(made, axes)
    return made


def b2_over_decades(seen: Blindness) -> Figure:
    """The criterion's change from its least, band by band, and what noise does to it."""
    made = figure(4.6)
    axes = made.add_axes((0.07, 0.22, 0.90, 0.75))
    looks = (("band1", "band 1", GLOBAL, ":"), ("band2", "band 2", FITTED, "-"), ("band3", "band 3", INITIAL, "--"))
    for band, label, color, stroke in looks:
        axes.plot(seen.b2, seen.criterion[band], color=color, ls=stroke, lw=1.8, label=label)
        low, high = seen.noise[band] - seen.spread[band], seen.noise[band] + seen.spread[band]
        axes.axhspan(max(low, 1e-12), high, color=color, alpha=0.15, lw=0)
    mark_truth(axes.axvline, seen.true)
    axes.text(seen.true * 1.15, 0.97, "the paper's b₂, and the truth", va="top", fontsize=9,
              transform=axes.get_xaxis_transform())  # fmt: skip
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set(xlabel="b₂ (m²/s), all else at the truth", ylabel="criterion")
    key(made, axes)
    return made
