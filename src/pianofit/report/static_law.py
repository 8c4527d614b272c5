"""Static law of the felt, with its 95 % band: force over compression.

The covariance of a fit is that of logarithms. The static force K_H u^p of the felt at compression u has the logarithm
log F = log K_H + p log u, whose derivative by log p is p log u. Its 95 % band follows from the covariance by these
derivatives. The band of other felt laws follows from their own derivatives in the same way, to first order.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from ..conversions import HALF_WIDTH_95
from ..felt import law_of
from ..felt.steps import static_force
from ..result import FittedRecording, Result
from .drawing import (
    LINES,
    LOOP,
    MEASURED,
    Panel,
    log_axis,
    span,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# Points of the law, and of the loop of a stroke: more than a picture resolves.
LAW_POINTS, LOOP_POINTS = 48, 400
SMALLEST_REACH = 1e-12  # m, of a law, also without contact
LARGEST_EXPONENT = 300.0  # so that exp does not overflow
LARGEST_BAND = 1e6  # factor up to which the band of a law is drawn


@dataclass(frozen=True)
class StaticLaw:
    """Static force of a felt over compression. In `force` and `slow`, the rows are the law and the ends of its band.

    Without a band, its ends equal the law. A relaxing felt has two laws: `force` for sudden compression, and `slow`.
    """

    compression_mm: np.ndarray  # [n]
    force: np.ndarray  # [3, n], N
    slow: np.ndarray | None = None  # [3, n], N

    def divided_by(self, mass: float) -> StaticLaw:
        """Return the law per mass, N/kg."""
        return StaticLaw(self.compression_mm, self.force / mass, None if self.slow is None else self.slow / mass)

    def at(self, compression_mm: float) -> np.ndarray:
        """Return the force and the ends of its band at a compression, interpolated between logarithms [3]."""
        x, logs = np.log(self.compression_mm), np.log(np.maximum(self.force, np.finfo(float).tiny))
        return np.exp([np.interp(math.log(compression_mm), x, log) for log in logs])


# --- the law and its band ---------------------------------------------------------------------------------------------


def static_law(result: Result, reach: float | None = None) -> StaticLaw:
    """Return the static law with its band, up to the compression `reach`, m; that of the strokes if None."""
    hammer = result.note.hammer
    reach = max(largest_compression(result) if reach is None else reach, SMALLEST_REACH)
    u = reach * np.linspace(0.0, 1.0, LAW_POINTS + 1)[1:]
    scale_open, intervals = result.fit.velocity_scale_open, result.fit.has_intervals
    shared = result.covariance.of_shared(scale_open) if intervals else None

    def with_band(slow: bool) -> np.ndarray:
        force, by_name = static_force(u, hammer, slow)
        if shared is None:
            return np.stack([force] * 3)
        derivative = np.stack([by_name.get(name, np.zeros(len(u))) for name in shared.names], axis=1)
        sd = np.sqrt(np.maximum(np.einsum("ni,ij,nj->n", derivative, shared.matrix, derivative), 0.0))
        half = np.minimum(HALF_WIDTH_95 * sd, LARGEST_EXPONENT)
        return force * np.exp(np.stack([0 * half, -half, half]))

    return StaticLaw(1e3 * u, with_band(False), with_band(True) if law_of(hammer).slow else None)


def largest_compression(result: Result) -> float:
    """Return the largest compression of the felt in all strokes of the fit, m.

    If the fit was loaded from a file, its fastest stroke is simulated again.
    """
    if result.recordings:
        return max(float(np.max(fitted.fitted.simulation.pulse.compression)) for fitted in result.recordings)
    fastest = max(result.minima_notes[0], key=lambda note: float(note.hammer.v_H0))
    return float(np.max(fastest.strike(round(result.fit.reference.rate)).pulse.compression))


# --- figures of one fit -----------------------------------------------------------------------------------------------


def draw_felt(result: Result) -> list[Panel]:
    """Draw the static law with its band, and the loops of force over compression of all strokes."""
    law, loops = static_law(result), [_loop(fitted) for fitted in result.recordings]
    rows, panels = 1 if law.slow is None else 2, {"Linear axes": draw_static_law, "Logarithmic axes": _logarithmic}
    mark = result.fit.derived.reference_compression_mm

    def draw_panel(axes: Axes, draw: Any) -> None:
        draw(axes, law, loops)
        if law.compression_mm[0] <= mark <= law.compression_mm[-1]:
            style = {"marker": "o", "ms": 5, "ls": "none", "color": LINES["fitted"]["color"], "zorder": 6}
            axes.plot(mark, law.at(mark)[0], label="reference compression", **style)

    return [Panel(draw_panel, (draw,), title, legend_rows=rows + 1, columns=3) for title, draw in panels.items()]


def draw_static_law(axes: Axes, law: StaticLaw, loops: Sequence[tuple[np.ndarray, np.ndarray]] = ()) -> None:
    """Draw the static law with its band over the compressions of the strokes, and their loops."""
    for i, (compression, force) in enumerate(loops):
        axes.plot(compression, force, color=LOOP, lw=1.1, zorder=3, label="" if i else "during the stroke")
    _draw_law(axes, law)
    top = max(0.0, span(law.force[0], *(force for _, force in loops))[1])
    axes.set(xlim=(0.0, 1.03 * law.compression_mm[-1]), ylim=(0.0, 1.25 * max(top, 1e-9)))


def _loop(fitted: FittedRecording) -> tuple[np.ndarray, np.ndarray]:
    """Return compression, mm, and force, N, of a stroke during contact; NaN in between."""
    pulse = fitted.fitted.simulation.pulse
    compression, force = np.asarray(pulse.compression), np.asarray(pulse.force)
    end = int(np.flatnonzero(compression > 0)[-1]) + 2 if (compression > 0).any() else 0
    shown = slice(0, end, max(1, end // LOOP_POINTS))
    contact = np.where(compression > 0, 1.0, np.nan)[shown]
    return 1e3 * compression[shown] * contact, force[shown] * contact


def _draw_law(axes: Axes, law: StaticLaw) -> None:
    name = "static law" if law.slow is None else "sudden compression"
    draw_band(axes, law.compression_mm, law.force, LINES["fitted"], name)
    if law.slow is not None:
        draw_band(axes, law.compression_mm, law.slow, LINES["initial"], "slow compression")
    axes.set(xlabel="compression of the felt (mm)", ylabel="force (N)")


def draw_band(axes: Axes, u: np.ndarray, force: np.ndarray, style: dict[str, Any], name: str) -> None:
    """Draw a static force with its 95 % band [3, n]."""
    low, high = np.clip(force[1:], force[0] / LARGEST_BAND, force[0] * LARGEST_BAND)
    if (high > low).any():
        axes.fill_between(u, low, high, color=style["color"], alpha=0.18, lw=0, zorder=1, label=f"{name}, 95 %")
    axes.plot(u, force[0], label=name, **style)


def _logarithmic(axes: Axes, law: StaticLaw, loops: Sequence[tuple[np.ndarray, np.ndarray]]) -> None:
    """Draw one and a half decades of compression, with a mark at the largest compression of each recording."""
    _draw_law(axes, law)
    u, force = law.compression_mm[-1], law.force[0, -1]
    if not (u > 0 and force > 0 and np.isfinite(force)):
        return
    curves = law.force[:, law.compression_mm >= u / 32]
    axes.set(xscale="log", yscale="log", xlim=(u / 32, 1.15 * u))
    axes.set_ylim(max(curves[0].min() / 30, curves[1].min() / 2, force * 1e-9), min(30 * force, 2 * curves[2].max()))
    transform, largest = axes.get_xaxis_transform(), [span(compression)[1] for compression, _ in loops]
    axes.plot(largest, [0.03] * len(largest), "|", color=MEASURED, ms=13, mew=2, transform=transform, zorder=5)
    log_axis(axes.xaxis, (1, 3))
    log_axis(axes.yaxis, (1,))
