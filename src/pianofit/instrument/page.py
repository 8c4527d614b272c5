"""HTML page of an instrument: every parameter over the keyboard with the literature's values, and a table of all keys.

It runs no script. Its figures have the colours and line styles of the report: those of initial values for the
literature, and those of fits for the law.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Any

import numpy as np

from .. import __version__
from ..analysis.note_names import midi_to_note
from ..conversions import HIGHEST_KEY, LOWEST_KEY
from ..io.number_format import number
from ..report import html
from ..report.drawing import BAND, FITTED, GROUPS, INITIAL, MARKERS, MEASURED, Panel, key_axis, log_axis
from ..schema.instrument import PartialEntry
from .instrument import KEY_STATES, Instrument, Key
from .key_quantities import LOUDEST_VELOCITY, law_compression, law_quantities

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# Deviation of a fit from the prediction of the other keys from which the table names it, standard deviations.
NAMED_Z = 2.0
FIGURES = {
    "string": ("cents", "B", "b1", "d2"),
    "hammer": ("M_H/M_S", "F/M_S", "local_exponent", "mu", "skin"),
    "geometry": ("x0/L", "width/L", "L", "M_S/L"),
}
DECAYS = {"split_cents": "split of the two beating modes (cents)", "late_over_early": "late T60 over early T60"}
# Text of a column of the table, from the number of a key and the key.
Cell = Callable[[int, Key], str]
# Columns by title.
STRING_COLUMNS: dict[str, Cell] = {
    "f₀, Hz": lambda _, key: f"{key.note.f0:.2f}",
    "B": lambda _, key: number(key.values["B"].value, 3),
    "b₁, 1/s": lambda _, key: number(key.note.string.b1, 3),
    "b₂, m²/s": lambda _, key: number(key.note.string.b2, 3),
    "M<sub>S</sub>, g": lambda _, key: number(1e3 * key.note.geometry.mass, 3),
    "x₀/L": lambda _, key: number(key.values["x0/L"].value, 3),
}
HAMMER_COLUMNS: dict[str, Cell] = {
    "M<sub>H</sub>, g": lambda _, key: number(1e3 * key.note.hammer.M_H, 3),
    "u, mm": lambda midi, _: number(1e3 * law_compression(midi), 3),
    "F, N": lambda _, key: number(key.values["F/M_S"].value * key.note.geometry.mass, 3),
    "F/M<sub>S</sub>, N/kg": lambda _, key: number(key.values["F/M_S"].value, 3),
    "K<sub>H</sub>, N/m<sup>p</sup>": lambda _, key: number(key.note.hammer.K_H, 3),
    "p": lambda _, key: f"{key.note.hammer.p:.3f}",
    "μ, s/m": lambda _, key: number(key.note.hammer.mu, 2),
}
FIT_COLUMNS: dict[str, Cell] = {
    "recordings": lambda _, key: str(key.fit.recordings) if key.fit else "–",
    "levels, dB": lambda _, key: "–" if not key.fit or key.fit.levels_db is None else f"{key.fit.levels_db:.2f}",
}


def write_page(path: str | os.PathLike[str], instrument: Instrument) -> None:
    """Write the page completely, or not at all.

    Raises
    ------
    OutputError
        If `path` cannot be written.
    """
    html.write_page(
        path,
        "page.html.j2",
        package="pianofit.instrument",
        title=instrument.name or "Instrument",
        contents=True,
        warnings=instrument.warnings,
        quantity=instrument.quantity,
        recorded=len(instrument.recorded),
        evenness=instrument.evenness,
        beyond=instrument.beyond_strings,
        states=[(state, count, KEY_STATES[state]) for state, count in instrument.state_counts.items()],
        unit=instrument.law.hammer_parameters[instrument.law.size].unit,
        columns=[*_columns(instrument)],
        figures=html.pictures(_panels(instrument)),
        rows=[_row(midi, key, instrument) for midi, key in instrument.keys.items()],
        loudest=f"{LOUDEST_VELOCITY:g}",
        u_low=1e3 * law_compression(LOWEST_KEY),
        u_high=1e3 * law_compression(HIGHEST_KEY),
        version=__version__,
    )


def _columns(instrument: Instrument) -> dict[str, Cell]:
    """Cells of the columns of numbers, by title."""
    return STRING_COLUMNS | (HAMMER_COLUMNS if instrument.law.key_quantities else {}) | FIT_COLUMNS


def _row(midi: int, key: Key, instrument: Instrument) -> dict[str, Any]:
    fits = {name: x.own_fit for name, x in key.values.items()}
    moved = [f"{name} {own.z:+z.1f}" for name, own in fits.items() if own and abs(own.z) > NAMED_Z]
    return {
        "note": midi_to_note(midi),
        "state": key.state,
        "cells": [cell(midi, key) for cell in _columns(instrument).values()],
        "moved": ", ".join(moved),
        "is_recorded": key.fit is not None,
    }


def _panels(instrument: Instrument) -> dict[str, list[Panel]]:
    """Panels, by figure."""
    shown = {name: [law for law in names if law in instrument.laws] for name, names in FIGURES.items()}
    figures = {name: [_law_panel(instrument, law) for law in laws] for name, laws in shown.items()}
    others = [Panel(draw, (instrument,)) for draw in (_paths, _velocities, _residuals)]
    figures["sound"] = [_law_panel(instrument, "level"), *others]
    fits = [(midi, key.fit) for midi, key in instrument.keys.items() if key.fit]
    partials = [(midi, partial) for midi, fit in fits for partial in fit.partials]
    figures["decays"] = [Panel(_decays, (partials, name), title) for name, title in DECAYS.items() if partials]
    return figures


def _law_panel(instrument: Instrument, name: str) -> Panel:
    return Panel(_law, (instrument, name), legend_rows=2, columns=3)


def _law(axes: Axes, instrument: Instrument, name: str) -> None:
    law, quantity = instrument.laws[name], law_quantities(instrument.law)[name]
    values = {midi: key.values[name] for midi, key in instrument.keys.items()}
    x = np.arange(LOWEST_KEY, HIGHEST_KEY + 1)
    if law.literature is not None:
        axes.plot(x, law.literature, color=INITIAL, ls=(0, (4, 1.6)), lw=1.2, label="literature")
    axes.fill_between(x, law.low, law.high, color=BAND, lw=0, label="95 % of the law")
    axes.plot(x, law.value, color=FITTED, lw=1.5, label="law")
    axes.plot(
        [*values], [value.value for value in values.values()], ".", ms=3, color=FITTED, label="posterior of the key"
    )
    fits = {midi: value.own_fit for midi, value in values.items() if value.own_fit}
    fitted = np.array([fit.value for fit in fits.values()])
    low, high = np.array([fit.interval for fit in fits.values()]).T
    bars = np.maximum([fitted - low, high - fitted], 0.0)
    label = "fit of the key"
    axes.errorbar([*fits], fitted, yerr=bars, fmt="o", ms=3.6, lw=1, color=MEASURED, label=label, zorder=4)
    axes.set_title(quantity.title + (f" ({quantity.unit})" if quantity.unit not in ("", "1") else ""))
    key_axis(axes)
    if quantity.scale == "log" and name != "local_exponent":
        _log(axes, [*law.low, *law.high, *fitted, *([] if law.literature is None else law.literature)])


def _log(axes: Axes, shown: Iterable[float]) -> None:
    low, high = min(shown), max(shown)
    decades = np.log10(high / low)
    if decades < 0.6:
        return
    axes.set_yscale("log")
    axes.set_ylim(low * 10 ** (-0.05 * decades - 0.02), high * 10 ** (0.05 * decades + 0.02))
    log_axis(axes.yaxis, (1, 2, 5) if decades < 2.5 else (1,))


def _paths(axes: Axes, instrument: Instrument) -> None:
    for midi, key in instrument.keys.items():
        path = key.note.path
        if path is None or not (key.fit or midi in range(24, HIGHEST_KEY + 1, 12)):
            continue
        style = {"lw": 1.3, "zorder": 3, "color": FITTED, "alpha": 0.8}
        if key.fit:
            style = {"lw": 0.9, "zorder": 2, "color": MEASURED, "alpha": 0.5}
        axes.semilogx(path.frequency, path.db, **style)
    axes.set_title("output path (dB): of each fit, and smooth part at C1 to C8")
    axes.set(xlabel="frequency (Hz)", xlim=(20, 2e4))


def _residuals(axes: Axes, instrument: Instrument) -> None:
    levels = {midi: key.fit.levels_db for midi, key in instrument.keys.items() if key.fit}
    shown = {midi: level for midi, level in levels.items() if level is not None}
    axes.vlines([*shown], 0, [*shown.values()], color=MEASURED, lw=3)
    axes.set(title="residual of the partial levels of each fit (dB rms)")
    axes.set_ylim(bottom=0)
    key_axis(axes)


def _decays(axes: Axes, partials: list[tuple[int, PartialEntry]], name: str) -> None:
    """One quantity of the lowest partials of the keys with a modal response."""
    values = [(midi, entry.partial, getattr(entry, name)) for midi, entry in partials]
    for partial in sorted({k for _, k, _ in values}):
        shown = [(midi, value) for midi, k, value in values if k == partial and value is not None]
        axes.plot(
            *np.reshape(shown, (-1, 2)).T,
            marker=MARKERS[(partial - 1) % len(MARKERS)],
            ls="none",
            ms=5,
            color=GROUPS[(partial - 1) % len(GROUPS)],
            label=f"partial {partial}",
        )
    key_axis(axes)
    _log(axes, [value for _, _, value in values if value is not None] or [1.0])


def _velocities(axes: Axes, instrument: Instrument) -> None:
    curve, x = instrument.velocity, range(1, 128)
    if curve.layers:
        axes.plot(*np.array(curve.layers).T, "o", ms=3.6, color=MEASURED)
    axes.plot(x, [curve.at(v) for v in x], color=FITTED, lw=1.5)
    _log(axes, [0.1, 10.0])
    law = instrument.law
    unit = law.hammer_parameters[law.size].unit
    size = law.hammer_parameters[law.size].meaning.removeprefix("initial ")
    axes.set(title=f"{size}; points: recorded layers", xlabel="MIDI velocity", ylabel=unit, xlim=(0, 128))
