"""HTML page of an instrument: every parameter over the keyboard with the literature's values, and a table of all keys.

It uses `report.html` and runs no script. Its figures have the colours and line styles of the report: those of initial
values for the literature, and those of fits for the law. An outlier is a cross with its name.
"""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Any

import numpy as np

from ..io.number_format import number
from ..report import html
from ..report.drawing import BAND, FITTED, INITIAL, MEASURED, WRONG, log_axis, make_figure, page_style, svg
from ..report.figures_recordings import GROUPS as COLOURS
from .collect_fits import HIGHEST_KEY, LOUDEST_VELOCITY, LOWEST_KEY, reference_compression
from .laws import OUTLIER_SD
from .text import STATES, TITLES, counts
from .velocity import hammer_velocity

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["write_page"]

LITERATURE, LAW = INITIAL, FITTED
CS = {24: "C1", 36: "C2", 48: "C3", 60: "C4", 72: "C5", 84: "C6", 96: "C7", 108: "C8"}
MARKERS = "osD^"
GROUPS = {
    "string": ("cents", "B", "b1", "d2"),
    "hammer": ("M_H/M_S", "K/M_S", "p", "mu"),
    "geometry": ("x0/L", "width/L", "L", "M_S/L"),
}
RINGING = {"split_cents": "split of the two beating modes (cents)", "late_over_early": "late T60 over early T60"}


def write_page(path: str | os.PathLike[str], document: dict[str, Any]) -> None:
    """Write the page of a document of `build_instrument`. A failed write leaves no file.

    Raises `OutputError` if `path` cannot be written.
    """
    state_counts, figures = counts(document), _draw(document)
    html.write_page(
        path,
        "page.html.j2",
        package="pianofit.instrument",
        strict=False,
        title=document["name"] or "Instrument",
        contents=True,
        doc=document,
        quantity=document["quantity"],
        known=sum(key["fit"] is not None for key in document["keys"]),
        states=[(state, state_counts[state], words) for state, words in STATES.items() if state_counts[state]],
        figures={name: html.picture(panels) for name, panels in figures.items()},
        rows=[_row(key) for key in document["keys"]],
        outlying=f"{OUTLIER_SD:g}",
        loudest=f"{LOUDEST_VELOCITY:g}",
        u_low=1e3 * reference_compression(LOWEST_KEY),
        u_high=1e3 * reference_compression(HIGHEST_KEY),
    )


def _row(key: dict[str, Any]) -> dict[str, Any]:
    s, h, g, fit = key["string"], key["hammer"], key["geometry"], key["fit"]
    rounded = [key["told"]["B"]["value"], s["b1"], s["b2"], 1e3 * h["M_H"], 1e3 * g["mass"], h["K_H"]]
    cells = [
        f"{s['c'] / (2 * g['length']):.2f}",
        *(number(x, 3) for x in rounded),
        f"{h['p']:.3f}",
        number(h["mu"], 2),
        str(fit["recordings"]) if fit else "–",
        f"{fit['levels_db']:.2f}" if fit and fit["levels_db"] is not None else "–",
    ]
    changed = [
        f"{n} ({t['state']})" if t["state"] == "outlier" else n
        for n, t in key["told"].items()
        if t.get("state") in ("pulled", "outlier")
    ]
    return {"note": key["note"], "state": key["state"], "cells": cells, "words": ", ".join(changed), "fit": fit}


def _draw(document: dict[str, Any]) -> dict[str, list[bytes]]:
    """SVGs of the panels, by figure."""
    with page_style():
        figures = {name: [_law_panel(document, law) for law in names] for name, names in GROUPS.items()}
        figures["sound"] = [
            _law_panel(document, "gain"),
            *(make_figure(draw, document) for draw in (_paths, _velocities, _residuals)),
        ]
        rows = [(key["midi"], entry) for key in document["keys"] for entry in (key["fit"] or {}).get("partials", ())]
        if rows:
            figures["ringing"] = [make_figure(_partials, rows, name, title=title) for name, title in RINGING.items()]
        return {name: [svg(figure) for figure in panels] for name, panels in figures.items()}


def _law_panel(document: dict[str, Any], name: str) -> Figure:
    return make_figure(_law, document, name, legend_rows=2, columns=3)


def _law(axes: Axes, document: dict[str, Any], name: str) -> None:
    law, keys = document["laws"][name], document["keys"]
    x = np.arange(LOWEST_KEY, HIGHEST_KEY + 1)
    if law["literature"]:
        axes.plot(x, law["literature"], color=LITERATURE, ls=(0, (4, 1.6)), lw=1.2, label="literature")
    axes.fill_between(x, law["low"], law["high"], color=BAND, lw=0, label="95 % of the law")
    axes.plot(x, law["value"], color=LAW, lw=1.5, label="law")
    axes.plot(x, [key["told"][name]["value"] for key in keys], ".", ms=3, color=LAW, label="used for playing")
    own = [(key["midi"], key["note"], key["told"][name]) for key in keys if key["fit"] is not None]
    at = np.array([midi for midi, _, _ in own])
    value = np.array([entry["own"] for _, _, entry in own])
    span = np.array([entry["own_interval"] for _, _, entry in own]).T
    bars = np.maximum([value - span[0], span[1] - value], 0.0)
    axes.errorbar(at, value, yerr=bars, fmt="o", ms=3.6, lw=1, color=MEASURED, label="fit of the key", zorder=4)
    for midi, note, entry in own:
        if entry["state"] == "outlier":
            axes.plot(midi, entry["own"], "x", ms=9, mew=2, color=WRONG, zorder=5)
            axes.annotate(note, (midi, entry["own"]), (6, 4), textcoords="offset points", color=WRONG)
    title, unit = TITLES[name]
    axes.set_title(title + (f" ({unit})" if unit != "1" else ""))
    _keyboard(axes)
    if name not in ("cents", "p"):
        _log(axes, [*law["low"], *law["high"], *value, *(law["literature"] or [])])


def _keyboard(axes: Axes) -> None:
    axes.set_xlim(LOWEST_KEY - 1, HIGHEST_KEY + 1)
    axes.set_xticks(list(CS), list(CS.values()))


def _log(axes: Axes, shown: list[float]) -> None:
    low, high = min(shown), max(shown)
    decades = np.log10(high / low)
    if decades < 0.6:
        return
    axes.set_yscale("log")
    axes.set_ylim(low * 10 ** (-0.05 * decades - 0.02), high * 10 ** (0.05 * decades + 0.02))
    log_axis(axes.yaxis, (1, 2, 5) if decades < 2.5 else (1,))


def _paths(axes: Axes, document: dict[str, Any]) -> None:
    for key in document["keys"]:
        if key["path"] is not None and (key["fit"] is not None or key["midi"] in CS):
            fitted = key["fit"] is not None
            style = {"lw": 0.9, "zorder": 2, "color": MEASURED, "alpha": 0.5}
            if not fitted:
                style = {"lw": 1.3, "zorder": 3, "color": LAW, "alpha": 0.8}
            axes.semilogx(key["path"]["frequency"], key["path"]["db"], **style)
    axes.set_title("output path (dB): of each fit, and smooth part at C1 to C8")
    axes.set(xlabel="frequency (Hz)", xlim=(20, 2e4))


def _residuals(axes: Axes, document: dict[str, Any]) -> None:
    fitted = [key for key in document["keys"] if key["fit"] and key["fit"]["levels_db"] is not None]
    axes.vlines([k["midi"] for k in fitted], 0, [k["fit"]["levels_db"] for k in fitted], color=MEASURED, lw=3)
    axes.set(title="residual of the partial levels of each fit (dB rms)")
    axes.set_ylim(bottom=0)
    _keyboard(axes)


def _partials(axes: Axes, rows: list[tuple[int, dict[str, Any]]], name: str) -> None:
    """One quantity of the lowest partials of the keys with a modal response."""
    for partial in sorted({entry["partial"] for _, entry in rows}):
        shown = [(midi, x[name]) for midi, x in rows if x["partial"] == partial and x[name] is not None]
        axes.plot(
            *np.reshape(shown, (-1, 2)).T,
            marker=MARKERS[(partial - 1) % len(MARKERS)],
            ls="none",
            ms=5,
            color=COLOURS[(partial - 1) % len(COLOURS)],
            label=f"partial {partial}",
        )
    _keyboard(axes)
    _log(axes, [entry[name] for _, entry in rows if entry[name] is not None] or [1.0])


def _velocities(axes: Axes, document: dict[str, Any]) -> None:
    law = document["velocity"]
    if law["layers"]:
        axes.plot(*np.array(law["layers"]).T, "o", ms=3.6, color=MEASURED)
    x = range(1, 128)
    axes.plot(x, [hammer_velocity(v, law["at_64"], law["rise"]) for v in x], color=LAW, lw=1.5)
    _log(axes, [0.1, 10.0])
    axes.set(title="hammer velocity; points: recorded layers", xlabel="MIDI velocity", ylabel="m/s", xlim=(0, 128))
