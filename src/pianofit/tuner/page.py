"""HTML page of a tuning: tuning curves next to the piano as found, inharmonicity, beats, and a table of all keys."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Any

import numpy as np

from .. import __version__
from ..conversions import HIGHEST_KEY, LOWEST_KEY
from ..instrument.build import ENOUGH_KEYS
from ..instrument.key_quantities import literature
from ..io.number_format import number
from ..report import html
from ..report.drawing import (
    BAND,
    FITTED,
    GROUP,
    GROUPS,
    HATCH,
    INITIAL,
    LAW,
    MARKERS,
    MEASURED,
    Panel,
    key_axis,
    log_axis,
)
from ..schema.tuning import IntervalValue, OctaveType, TunedKey, Tuning

if TYPE_CHECKING:
    from collections.abc import Sequence

    from matplotlib.axes import Axes

# Highest partial whose beats have an own mark in the picture.
MARKED_PARTIALS = len(MARKERS)
# Colour and line style of the curve of each octave type, and how strongly its band is coloured.
CURVES: dict[OctaveType, tuple[str, Any]] = {
    "2:1": (LAW, (0, (6, 1.6))),
    "4:2": (FITTED, "-"),
    "6:3": (GROUP, (0, (2, 1.2))),
}
BAND_ALPHA = 0.18
HEIGHT = 4.4  # of the picture of the tuning, inches
# Space above and below the values that set the vertical axis, cents.
MARGIN_CENTS = 3.0
# Keys next to the outermost recorded ones that the second panel shows.
MARGIN_KEYS = 3


def write_page(path: str | os.PathLike[str], tuning: Tuning) -> None:
    """Write the page completely, or not at all; raises `OutputError`."""
    by_note = {key.note: key for key in tuning.keys}
    html.write_page(
        path,
        "page.html.j2",
        package="pianofit.tuner",
        title=f"Tuning of {tuning.name}" if tuning.name else "Tuning",
        contents=True,
        tuning=tuning,
        recorded=[key for key in tuning.keys if key.recorded],
        a4_found=by_note["A4"].first_partial,
        judged=sum(key.recorded for key in tuning.keys) >= ENOUGH_KEYS,
        off=[by_note[note] for note in tuning.off],
        wide=[by_note[note] for note in tuning.wide_unisons],
        beating=[key for key in tuning.keys if key.beats],
        pictures=html.pictures(panels_of(tuning)),
        span=span_text,
        version=__version__,
    )


def span_text(it: IntervalValue | None, digits: int | None = None) -> str:
    """Return a value with its interval, in cents to a tenth or with significant digits."""
    if it is None:
        return ""
    texts = [f"{x:+z.1f}" if digits is None else number(x, digits) for x in (it.value, *it.interval)]
    return f"{texts[0]} [{texts[1]}, {texts[2]}]"


def panels_of(tuning: Tuning) -> dict[str, list[Panel]]:
    """Return the panels of the page, by picture."""
    recorded = [key.midi for key in tuning.keys if key.recorded]
    near = (recorded[0] - MARGIN_KEYS, recorded[-1] + MARGIN_KEYS)
    spans = [(LOWEST_KEY - 1, HIGHEST_KEY + 1), (max(near[0], LOWEST_KEY - 1), min(near[1], HIGHEST_KEY + 1))]
    return {
        "curves": [Panel(_curves, (tuning, span), heights=(HEIGHT,), legend_rows=2, columns=3) for span in spans],
        "others": [Panel(_inharmonicity, (tuning,), columns=3), Panel(_beats, (tuning,))],
    }


def _curves(axes: Axes, tuning: Tuning, span: tuple[int, int]) -> None:
    """Draw tuning curves and the piano as found over some keys (Railsback's picture)."""
    keys = [key for key in tuning.keys if span[0] <= key.midi <= span[1]]
    x, law, recorded = [key.midi for key in keys], _rows([key.law for key in keys]), [k for k in keys if k.recorded]
    axes.fill_between(x, law[1], law[2], color=HATCH, alpha=0.45, lw=0)
    axes.plot(x, law[0], color=MEASURED, lw=1.0, label="as found: law")
    for name, (colour, style) in CURVES.items():
        curve = _rows([key.curves[name] for key in keys])
        axes.fill_between(x, curve[1], curve[2], color=colour, alpha=BAND_ALPHA, lw=0)
        axes.plot(x, curve[0], color=colour, ls=style, lw=1.5, label=f"{name} octaves")
    _points(axes, recorded, "as_found", "as found: recorded")
    # Curves of high partials leave the frame in the treble, where these partials are inaudible.
    shown = [*law[0], *_rows([key.curves["2:1"] for key in keys])[0], *_rows([k.as_found for k in recorded]).ravel()]
    axes.set_ylim(min(shown) - MARGIN_CENTS, max(shown) + MARGIN_CENTS)
    axes.set_title(f"partial 1 from equal temperament at A4 = {tuning.a4:g} Hz (cents)")
    key_axis(axes, span)


def _inharmonicity(axes: Axes, tuning: Tuning) -> None:
    x = [key.midi for key in tuning.keys]
    B = _rows([key.B for key in tuning.keys])
    axes.fill_between(x, B[1], B[2], color=BAND, lw=0)
    axes.plot(x, B[0], color=FITTED, lw=1.5, label="all keys")
    axes.plot(x, [literature(midi)["B"] for midi in x], color=INITIAL, ls=(0, (4, 1.6)), lw=1.2, label="literature")
    _points(axes, [key for key in tuning.keys if key.recorded], "B", "recorded keys")
    axes.set_yscale("log")
    log_axis(axes.yaxis, (1,))
    axes.set_title("inharmonicity B")
    key_axis(axes)


def _beats(axes: Axes, tuning: Tuning) -> None:
    for i in range(MARKED_PARTIALS):
        shown = [(key.midi, beat.rate.value) for key in tuning.keys for beat in key.beats if beat.partial == i + 1]
        if shown:
            style = {"marker": MARKERS[i], "color": GROUPS[i], "ls": "none", "ms": 5}
            axes.plot(*np.transpose(shown), **style, label=f"partial {i + 1}")
    axes.set_title("beats of the lowest partials of recorded keys (Hz)")
    axes.set_ylim(bottom=0)
    key_axis(axes)


def _points(axes: Axes, keys: Sequence[TunedKey], field: str, label: str) -> None:
    value, low, high = _rows([getattr(key, field) for key in keys])
    bars = np.array([value - low, high - value])
    style: dict[str, Any] = {"fmt": "o", "ms": 3.6, "lw": 1, "color": MEASURED, "zorder": 4}
    axes.errorbar([key.midi for key in keys], value, yerr=bars, label=label, **style)


def _rows(values: Sequence[IntervalValue]) -> np.ndarray:
    """Values and the lower and upper ends of their intervals [3, values]."""
    return np.array([(it.value, *it.interval) for it in values]).T
