"""The figures of the page, one at a time, for a notebook."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

from ..errors import FitError
from ..inference import Result
from .build import reference_curves
from .build_felt import known_of
from .drawing import LINES, STYLE
from .figures import band_edges, draw_levels, draw_spectra, shade_bands
from .figures_known import draw_correlations

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["Plots"]


@dataclass(frozen=True)
class Plots:
    """Figures of one fit, of its reference recording. Each goes to `ax`, or to new axes, which are returned.

    Raises
    ------
    FitError
        If the fit was read back from a file, which holds no recordings.
    """

    result: Result

    def spectrum(self, ax: Axes | None = None) -> Axes:
        """Measured, initial and fitted spectrum, dB over Hz, with the bands of the paper's criterion."""
        curves = reference_curves(self.result)
        edges = band_edges(curves, tuple(self.result.document["criterion"]["dropped"]))

        def draw(axes: Axes) -> None:
            draw_spectra(axes, curves, edges[0][0], edges[-1][1])
            shade_bands(axes, [(low, high, "", left_out) for low, high, _, left_out in edges])
            axes.set_ylabel("level (dB)")
            axes.legend()

        return _drawn(ax, draw)

    def force(self, ax: Axes | None = None) -> Axes:
        """The hammer's force on the string, N over ms from the first touch, before and after the fit."""
        curves = reference_curves(self.result)

        def draw(axes: Axes) -> None:
            for name in ("initial", "fitted"):
                axes.plot(curves.force_ms, getattr(curves, f"force_{name}"), label=name, **LINES[name])
            axes.set(xlabel="time from the first touch (ms)", ylabel="force (N)")
            axes.set_ylim(bottom=0.0)
            axes.legend()

        return _drawn(ax, draw)

    def levels(self, ax: Axes | None = None) -> Axes:
        """Levels of the partials, dB, measured with 95 % bars, initial and fitted."""
        curves = reference_curves(self.result)

        def draw(axes: Axes) -> None:
            draw_levels(axes, curves)
            axes.set_xlabel("partial number k")
            axes.legend()

        return _drawn(ax, draw)

    def correlations(self, ax: Axes | None = None) -> Axes:
        """Correlations of the estimates, %; without a measured velocity, those at the reference's velocity as shown.

        Raises
        ------
        FitError
            If the fit has no intervals, as the paper's recipes have none.
        """
        _ = self.result.covariance
        known = known_of(self.result)
        if known is None:
            raise FitError("this fit has no intervals, so no correlations; fit with recipe='default'")
        return _drawn(ax, lambda axes: draw_correlations(axes, known), (6.4, 5.6))


def _drawn(ax: Axes | None, draw: Callable[[Axes], None], size: tuple[float, float] = (8.0, 4.4)) -> Axes:
    import matplotlib.pyplot as plt

    with plt.rc_context(STYLE):
        axes = plt.subplots(figsize=size, layout="constrained")[1] if ax is None else ax
        draw(axes)
    return axes
