"""The figures of the page, one at a time, for a notebook."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

from ..errors import FitError, ParameterError
from ..result import Result
from .build import contact_curves, envelopes_of, known_of, level_curves, reference_curves
from .drawing import STYLE
from .figures import draw_force, draw_levels, draw_spectrum
from .figures_known import draw_correlations
from .figures_ringing import draw_envelope

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["Plots"]


@dataclass(frozen=True)
class Plots:
    """Figures of one fit, of its reference recording. Each goes to `ax`, or to new axes, which are returned.

    A fit that was read back shows force, levels and correlations at once; spectrum and envelopes read its recording
    again. They raise `FitError` if that is not at its place or was changed.
    """

    result: Result

    def spectrum(self, ax: Axes | None = None) -> Axes:
        """Measured, initial and fitted spectrum, dB over Hz, with the bands of the paper's criterion."""
        curves, dropped = reference_curves(self.result), tuple(self.result.document["criterion"]["dropped"])
        return _drawn(ax, lambda axes: draw_spectrum(axes, curves, dropped))

    def force(self, ax: Axes | None = None) -> Axes:
        """The hammer's force on the string, N over ms from the first touch, before and after the fit."""
        curves = contact_curves(self.result)
        return _drawn(ax, lambda axes: draw_force(axes, curves))

    def levels(self, ax: Axes | None = None) -> Axes:
        """Levels of the partials, dB, measured with 95 % bars, initial and fitted."""
        curves = level_curves(self.result)
        return _drawn(ax, lambda axes: draw_levels(axes, curves))

    def envelopes(self, ax: Axes | None = None, *, number: int | None = None) -> Axes:
        """Level of partial `number`, the strongest if None, dB over s: measured, by the string's law, as the key rings.

        Raises `ParameterError` if no such partial was found.
        """
        heard = self.result.reference
        known = heard.partials.number
        own = int(known[heard.level.argmax()]) if number is None else number
        if own not in known:
            raise ParameterError(f"number={number} is no partial of this recording; choose one of {known.tolist()}")
        (envelope,) = envelopes_of(self.result, [own])
        return _drawn(ax, lambda axes: draw_envelope(axes, envelope))

    def correlations(self, ax: Axes | None = None) -> Axes:
        """Correlations of the estimates, %; without a measured velocity, those at the reference's velocity as shown.

        Raises `FitError` if the fit has no intervals, as the paper's recipes have none.
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
        if axes.get_legend_handles_labels()[0]:
            axes.legend()
    return axes
